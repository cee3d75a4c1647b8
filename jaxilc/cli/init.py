"""`jaxilc init`: a plant file with comments, to begin with."""

from __future__ import annotations

import json
import os
import re
from importlib import resources
from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from ..outcomes.outcome import Outcome, Verdict
from ..outcomes.request import Request
from .options import InputColumn, OutputColumn, Pages, TimeColumn, file_to_write
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
        "# Here u is the set-point of a closed drive; `jaxilc init --set-point --record FILE.csv`\n"
        "# writes this file for a drive of which one move was recorded.\n"
        "[plant]\n"
    ),
    '#input_unit = "mm"': 'input_unit = "mm"',
    '"ilc.filter.cutoff"': '"ilc.scheme.filter.cutoff"',
    '"ilc.scheme.lead"': '"ilc.scheme.scheme.lead"',
}
AT_REST = 0.01  # of the stroke of a set-point, by which its first value may miss 0
_OF_DRIVE = re.compile(r"(?<=\[plant\]\n)kind.*?\n(?=\n)", re.DOTALL)
_REFERENCE = re.compile(r"(?<=\n)reference = .*")


def init(
    file: Annotated[
        Path, Argument(metavar="[FILE]", help="The file to write.", callback=file_to_write)
    ] = Path("axis.toml"),
    set_point: Annotated[
        bool,
        Option("--set-point", help="Correct the set-point of a closed drive: u is r in trial 1."),
    ] = False,
    record: Annotated[
        Path | None,
        Option(metavar="FILE", help="With --set-point: a recorded move of the drive, as columns."),
    ] = None,
    time_name: TimeColumn = "t",
    input_name: InputColumn = "u",
    output_name: OutputColumn = "y",
    force: Annotated[bool, Option("--force", help="Replace a file that exists.")] = False,
) -> None:
    """Write a plant file with comments: a machine, its task, schemes and uncertainty.

    With --set-point and --record the machine is fitted to the record, whose set-point is the task.

    Example: jaxilc init axis.toml
    """
    from ..storage.files import atomically

    if file.suffix != ".toml":
        raise ValueError(f"{file} is not a name that ends with .toml")
    if file.exists() and not force:
        raise FileExistsError(f"{file} exists already; add --force to replace it")
    columns = (
        ("--time", time_name, "t"),
        ("--input", input_name, "u"),
        ("--output", output_name, "y"),
    )
    for option, name, usual in columns:
        if record is None and name != usual:
            raise ValueError(f"{option} {name} names a column of --record, which is not given")
    content = (resources.files("jaxilc.scenarios") / "axis.toml").read_text("utf-8")
    for part, other in (SET_POINT if set_point else {}).items():
        content = content.replace(part, other)
    if record is not None:
        if not set_point:
            raise ValueError("--record is for --set-point; otherwise: jaxilc identify RECORD")
        content = _of_record(content, record, file, (time_name, input_name, output_name))
    file.parent.mkdir(parents=True, exist_ok=True)
    atomically(file, lambda opened: opened.write(content.encode()))
    own = "uncertainty" if record is not None else "plant, task and uncertainty"
    said = f"{file} runs as it is; put your own {own} into it."
    following = Request(str(file)).following("run")
    verdict = Verdict((said,), "its first trials", following)
    present(Outcome(command="init", numbers={}, verdict=verdict, kept=[file]), Pages())


def _of_record(content: str, record: Path, file: Path, names: tuple[str, str, str]) -> str:
    """The file for a drive of which a move was recorded, in columns of these names."""
    from ..identification.record_files import read_record_file

    time, set_point, position = names
    read = read_record_file(record, time=time, input=set_point, output=position)
    values = read.record.u[:, 0].tolist()
    first = values[0]
    if abs(first) > AT_REST * (max(values) - min(values)):
        raise ValueError(
            f"{record}: {set_point} begins at {first:.6g}, where the move must begin at 0, as the "
            f"plant does; subtract {first:.6g} from {set_point} and {position}, in each trial, too"
        )
    place, *called = (json.dumps(of) for of in (os.path.relpath(record, file.parent), *names))
    columns = zip(("time", "input", "output"), called, strict=True)
    plant = [f"{name} = {column}\n" for name, column in columns]
    fitted = f'kind = "identified"            # fitted once, to the record\nrecord = {place}\n'
    unit = json.dumps((read.output_units or ("",))[0] or "mm")
    parts = {
        "dt = 0.001\n": f"dt = {read.record.dt!r}\n",
        '\nunit = "mm"': f"\nunit = {unit}",
        'input_unit = "mm"': f"input_unit = {unit}",
        '"plant.B"': '"plant.gain"',
    }
    for part, other in parts.items():
        content = content.replace(part, other)
    content = _OF_DRIVE.sub(lambda _: f"{fitted}{''.join(plant)}poles = 2\n", content)
    moved = f"reference = {{ csv = {place}, column = {called[1]} }}"
    return _REFERENCE.sub(lambda _: moved, content)
