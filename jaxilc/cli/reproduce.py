"""`jaxilc reproduce`: every published number compared with ours."""

from __future__ import annotations

from typing import Annotated

import typer

from .completion import scenarios_from
from .groups import add
from .options import PAPERS, Written
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
) -> None:
    """Every published number beside ours, with a verdict and how the paper was read.

    Each row says what was fitted, and an open row why it is open. With --out, and in a report,
    there is a picture for each paper, with the printed numbers and ours.

    Example: jaxilc reproduce cao-2019 --reading amplitude --report out/cao-2019.html
    """
    tell("reproduce", scenario or (), written, folder=written.out_dir, reading=reading)
