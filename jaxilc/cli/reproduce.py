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
    reading: Annotated[
        str | None,
        typer.Option(
            "--reading",
            metavar="NAME",
            help="Reading of a paper that has several; the one that is taken if none is given.",
        ),
    ] = None,
    json_file: Json = None,
    report: Report = None,
    precision: Precision = "float64",
) -> None:
    """Every published number beside ours, with a verdict and how the paper was read.

    Each row says what was fitted, and an open row why it is open. A report has a picture for each
    paper, with the printed numbers and ours.

    Example: jaxilc reproduce cao-2019 --reading amplitude --report out/cao-2019.html
    """
    from .progress import working

    with working("reproduce") as told:
        from .asked import begin

        begin(precision)
        from ..scenarios import reproduction

        rows = reproduction.reproduce(
            scenario or (), reading, progress=lambda done, whole, name: told(name, done, whole)
        )
    from ..figures.published import reproduction_figures
    from ..figures.report import command_report
    from .reproduction_tables import READING_FITS, narrow_reproduction, reproduction_table
    from .verdicts.published import reproduce_verdict

    numbers = [row.as_dict() for row in rows]
    table = reproduction_table(numbers)
    narrow = narrow_reproduction(numbers)
    for part in [table] if out.width >= READING_FITS else narrow:
        out.print(part, highlight=False)
    verdict = reproduce_verdict(numbers)
    pictures = [] if report is None else reproduction_figures(numbers)
    live = []
    if report is not None:
        from ..figures.live_published import printed_and_ours

        live = [printed_and_ours(numbers)]
    page = command_report(
        report,
        "reproduce",
        [part for part in narrow if not isinstance(part, str)],
        pictures,
        lines=[part for part in narrow if isinstance(part, str)],
        verdict=verdict,
        live=live,
    )
    written(page, json_file, numbers, verdict)
