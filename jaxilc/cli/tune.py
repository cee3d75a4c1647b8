"""`jaxilc tune`: weights tuned by gradients through the learning process."""

from __future__ import annotations

from typing import Annotated

import typer

from .groups import add
from .options import DESIGN, TERMS, OneSimulated, Tuned, Written, at_least, in_python
from .present import tell
from .progress import run_search


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    add(app, tune, DESIGN)


def tune(
    what: OneSimulated,
    how: Tuned,
    written: Written,
    objective: Annotated[str, typer.Option(help=TERMS)] = "final",
    limit: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=NUMBER",
            help="Largest d2 (Cao 2019, every machine) or contraction (nominal); repeatable.",
        ),
    ] = None,
    compare_trials: Annotated[int | None, in_python("--compare-trials")] = None,
) -> None:
    """Tune weights by gradient through the learning, and compare them on machines not seen.

    Example: jaxilc tune cao-2019 --scheme cfdl-mfailc --weights lam,eta,mu,phi0
    --set cfdl-mfailc.lead=3 --objective holding:20
    """
    at_least(1, compare_trials=compare_trials)
    tell(
        "tune",
        what.request(how.trials),
        written,
        folder=written.out_dir,
        **how.arguments(),
        objective=objective,
        limits=limit or (),
        compare_trials=compare_trials,
        run=run_search,
    )
