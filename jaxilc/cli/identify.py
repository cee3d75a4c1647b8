"""`jaxilc identify`: a plant from a recorded experiment."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .console import out
from .options import DESIGN, Json, Report, folder_to_write
from .results import folder_of, written

NOT_WHITE = (
    "the residual is not white: another structure may fit better, and the intervals are too narrow"
)


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command(rich_help_panel=DESIGN)(identify)


def identify(
    record: Annotated[
        Path,
        typer.Argument(
            metavar="RECORD", help="Text file of columns with a header: time, input, output."
        ),
    ],
    poles: Annotated[int, typer.Option(help="Real poles.")] = 1,
    pairs: Annotated[int, typer.Option(help="Pairs of poles, real or complex.")] = 1,
    zeros: Annotated[int, typer.Option(help="Real zeros, of either sign.")] = 1,
    time_name: Annotated[str, typer.Option("--time", help="Column of the time [s].")] = "t",
    input_name: Annotated[str, typer.Option("--input", help="Column of the input.")] = "u",
    output_name: Annotated[str, typer.Option("--output", help="Column of the output.")] = "y",
    out_dir: Annotated[
        Path | None,
        typer.Option(
            "--out",
            help="Folder for all results; out/identify if not given.",
            callback=folder_to_write,
        ),
    ] = None,
    json_file: Json = None,
    report: Report = None,
) -> None:
    """A plant from a recorded experiment: parameters with 95 % intervals, fit, validation figure.

    Example: jaxilc identify record.csv --poles 1 --pairs 1 --zeros 1
    """
    from .asked import begin

    begin("float64")
    from .. import figures, identification
    from ..figures.report import command_report
    from ..identification.records import read_record
    from .tables import identification_table

    measured = read_record(record, time=time_name, input=input_name, output=output_name)
    found = identification.identify(measured, poles=poles, pairs=pairs, zeros=zeros)
    rows = found.summary()
    table = identification_table(str(record), rows)
    lines = [] if found.white else [NOT_WHITE]
    out.print(table)
    for line in lines:
        out.print(line, highlight=False)
    folder = folder_of(out_dir, "identify")
    drawn = {
        "record.png": figures.record_figure(measured),
        "validation.png": figures.validation_figure(measured, found),
    }
    paths = [figures.save(axes, folder / name) for name, axes in drawn.items()]
    asked = {"poles": poles, "pairs": pairs, "zeros": zeros}
    page = command_report(report, "identify", [table], paths, lines=lines, asked=asked)
    numbers = {name: {"value": value, "low": low, "high": high} for name, value, low, high in rows}
    sound = {"white": bool(found.white), "converged": bool(found.converged)}
    written([*paths, *page], json_file, numbers | sound)
