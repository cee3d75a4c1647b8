"""`jaxilc pareto`: a front of two objectives, or the best result for each number of trials."""

from __future__ import annotations

from typing import Annotated

import typer

from ..outcomes.terms import numbers_of
from .groups import add
from .options import DESIGN, TERMS, OneSimulated, Tuned, Written, in_python, left
from .present import tell
from .progress import run_search


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    add(app, pareto, DESIGN)


def pareto(
    what: OneSimulated,
    how: Tuned,
    written: Written,
    objective: Annotated[
        list[str] | None, typer.Option(help=f"Give two, or one and --budgets. {TERMS}")
    ] = None,
    budgets: Annotated[
        str | None,
        typer.Option(metavar="J,K,L", help="Numbers of trials to tune for."),
    ] = None,
    first: Annotated[str | None, left("--first", "--objective, given first, does it")] = None,
    second: Annotated[str | None, left("--second", "--objective, given twice, does it")] = None,
    shares: Annotated[str | None, in_python("--shares")] = None,
) -> None:
    """Two objectives against each other, or one against the number of trials.

    Give --objective twice for the former, --budgets for the latter. Each point is a tuning by
    itself, from the weights as given, and leaves a parameter file. With --resume, more may follow.

    Example: jaxilc pareto li-2020 --scheme fixed-filter --weights learning.filter.cutoff=2:200
    --objective final --objective effort --trials 15 --steps 20
    """
    given = objective or ["final"]
    tell(
        "pareto",
        what.request(how.trials),
        written,
        folder=written.out_dir,
        **how.arguments(),
        objectives=(first or given[0], *given[1:], *([second] if second else ())),
        shares=numbers_of("--shares", shares) if shares else (),
        budgets=[int(J) for J in numbers_of("--budgets", budgets, whole=True)] if budgets else (),
        run=run_search,
    )
