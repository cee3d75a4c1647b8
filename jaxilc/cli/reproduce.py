"""`jaxilc reproduce`: every published number compared with ours."""

from __future__ import annotations

from typing import Annotated

import typer

from .completion import scenarios_from
from .console import out
from .options import PAPERS, Json, Precision, Report
from .results import written


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command(rich_help_panel=PAPERS)(reproduce)


def reproduce(
    scenario: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[SCENARIO]...",
            help="Scenarios; all if none is given.",
            autocompletion=scenarios_from,
        ),
    ] = None,
    json_file: Json = None,
    report: Report = None,
    precision: Precision = "float64",
) -> None:
    """Every published number beside ours, with a verdict and how the paper was read.

    Each row says what was fitted, and an open row why it is open.

    Example: jaxilc reproduce cao-2019 dai-2014 --json out/reproduce.json
    """
    from .progress import working

    with working("reproduce") as told:
        from .asked import begin

        begin(precision)
        from ..scenarios import reproduction

        rows = reproduction.reproduce(
            scenario or (), progress=lambda done, whole, name: told(name, done, whole)
        )
    from ..figures.report import command_report
    from .reproduction_tables import READING_FITS, narrow_reproduction, reproduction_table
    from .verdicts.published import reproduce_verdict

    numbers = [row.as_dict() for row in rows]
    table = reproduction_table(numbers)
    for part in [table] if out.width >= READING_FITS else narrow_reproduction(numbers):
        out.print(part, highlight=False)
    verdict = reproduce_verdict(numbers)
    page = command_report(report, "reproduce", [table], verdict=verdict)
    written(page, json_file, numbers, verdict)
