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


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command(rich_help_panel=SIMULATE)(init)


def init(
    file: Annotated[
        Path,
        typer.Argument(metavar="[FILE]", help="The file to write.", callback=file_to_write),
    ] = Path("axis.toml"),
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
    content = (resources.files("jaxilc.scenarios") / "axis.toml").read_bytes()
    file.parent.mkdir(parents=True, exist_ok=True)
    atomically(file, lambda opened: opened.write(content))
    said = f"{file} runs as it is; put your own plant, task and uncertainty into it."
    following = Request(str(file)).following("run")
    verdict = Verdict((said,), "its first trials", following)
    present(Outcome(command="init", numbers={}, verdict=verdict, kept=[file]), Pages())
