"""`jaxilc reproduce`: every published number compared with ours."""

from __future__ import annotations

from typing import Annotated

import typer

from .completion import scenarios_from
from .groups import add
from .options import PAPERS, Details, Written
from .present import tell


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    add(app, reproduce, PAPERS)


def reproduce(
    written: Written,
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
    details: Details = False,
) -> None:
    """Every published number and conclusion beside ours, and how the paper was read.

    Printed are a line for each paper, and what is not met; --details says why. With --out there is
    a picture for each paper, with the printed numbers and ours; a report has all rows.

    Example: jaxilc reproduce cao-2019 --reading amplitude --report out/cao-2019.html
    """
    tell(
        "reproduce",
        scenario or (),
        written,
        details=details,
        folder=written.out_dir,
        reading=reading,
    )
