"""`jaxilc init`: a plant file with comments, to begin with."""

from __future__ import annotations

from importlib import resources
from pathlib import Path
from typing import Annotated

import typer

from ..outcomes.outcome import Outcome
from ..outcomes.request import Request
from ..outcomes.verdict import Verdict
from .options import SIMULATE, Pages, file_to_write
from .present import present

# What `--set-point` puts in place of parts of the file: its scheme then learns from u = r on.
SET_POINT = {
    'class = "Filtered"\n': (
        'class = "WarmStart"             # the first trial plays the reference: u = 1.0 r\n'
        "theta = [1.0]\n"
        'basis = { class = "PolynomialBasis", orders = [0] }\n'
        '[schemes.ilc.scheme]\nclass = "Filtered"\n'
    ),
    "[plant]\n": (
        "# Here u is the set-point of a closed drive. A record of both gives the plant:\n"
        '#   kind = "identified", record = "FILE.csv", input = "set", output = "y", poles = 2\n'
        "[plant]\n"
    ),
    '#input_unit = "mm"': 'input_unit = "mm"',
    '"ilc.filter.cutoff"': '"ilc.scheme.filter.cutoff"',
    '"ilc.scheme.lead"': '"ilc.scheme.scheme.lead"',
}


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command(rich_help_panel=SIMULATE)(init)


def init(
    file: Annotated[
        Path,
        typer.Argument(metavar="[FILE]", help="The file to write.", callback=file_to_write),
    ] = Path("axis.toml"),
    set_point: Annotated[
        bool,
        typer.Option(
            "--set-point", help="Correct the set-point of a closed drive: u is r in trial 1."
        ),
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace a file that exists.")] = False,
) -> None:
    """Write a plant file with comments: a machine, its task, schemes and uncertainty.

    Example: jaxilc init axis.toml
    """
    from ..storage.files import atomically

    if file.suffix != ".toml":
        raise ValueError(f"{file} is not a name that ends with .toml")
    if file.exists() and not force:
        raise FileExistsError(f"{file} exists already; add --force to replace it")
    content = (resources.files("jaxilc.scenarios") / "axis.toml").read_text("utf-8")
    for part, other in (SET_POINT if set_point else {}).items():
        content = content.replace(part, other)
    file.parent.mkdir(parents=True, exist_ok=True)
    atomically(file, lambda opened: opened.write(content.encode()))
    said = f"{file} runs as it is; put your own plant, task and uncertainty into it."
    following = Request(str(file)).following("run")
    verdict = Verdict((said,), "its first trials", following)
    present(Outcome(command="init", numbers={}, verdict=verdict, kept=[file]), Pages())
