"""`jaxilc potential`: what learning can gain, from repeats of a motion."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .groups import add
from .options import DESIGN, OutputColumn, TimeColumn, Written, file_to_write
from .present import tell


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    add(app, potential, DESIGN)


def potential(
    record: Annotated[
        list[str],
        typer.Argument(
            metavar="RECORD...",
            help="Files with one trial each or with several, or the folder of a campaign.",
        ),
    ],
    written: Written,
    error: Annotated[
        str, typer.Option(metavar="NAME", help="Column or array of the error; e_0, e_1 ... too.")
    ] = "e",
    output_name: OutputColumn = "y",
    reference: Annotated[
        str, typer.Option(metavar="NAME", help="Of the reference, for a file without the error.")
    ] = "r",
    time_name: TimeColumn = "t",
    dt: Annotated[float | None, typer.Option(help="Sample time in s, without times.")] = None,
    unit: Annotated[str, typer.Option(help="Of the error, where no heading tells it.")] = "",
    columns: Annotated[
        str | None,
        typer.Option(metavar="A,B,C", help="Names of the columns of a file without a header."),
    ] = None,
    into: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Plant file that gets what is found, for `design` and `next`.",
            callback=file_to_write,
        ),
    ] = None,
) -> None:
    """Is learning worth it, up to which frequency, and when is it done?

    From two or more repeats of a motion with the same input: the part of the
    error that repeats, and what is new in each trial and is left by any law, with
    intervals. A first trial unlike the others, and a drift, are told apart. It says
    whether what repeats does so in a period or in the position within the trial, and
    which law follows.

    Example: jaxilc potential trial-1.csv trial-2.csv trial-3.csv trial-4.csv
    """
    tell(
        "potential",
        record,
        written,
        folder=written.out_dir,
        into=into,
        unit=unit,
        error=error,
        output=output_name,
        reference=reference,
        time=time_name,
        dt=dt,
        columns=[name.strip() for name in columns.split(",")] if columns else [],
    )
