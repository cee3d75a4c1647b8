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
    from .asked import begin

    begin(precision)
    from ..figures.report import command_report
    from ..scenarios import reproduction
    from .reproduction_tables import READING_FITS, narrow_reproduction, reproduction_table
    from .verdicts.published import reproduce_verdict

    numbers = [row.as_dict() for row in reproduction.reproduce(scenario or ())]
    table = reproduction_table(numbers)
    for part in [table] if out.width >= READING_FITS else narrow_reproduction(numbers):
        out.print(part, highlight=False)
    verdict = reproduce_verdict(numbers)
    page = command_report(report, "reproduce", [table], lines=verdict.lines)
    written(page, json_file, numbers, verdict)
