"""`jaxilc worst-case`: the machine within the uncertainty with the largest final error."""

from __future__ import annotations

from typing import Annotated

import typer

from .groups import add
from .options import DESIGN, OneSimulated, Seed, Written, at_least
from .present import tell


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    add(app, worst_case, DESIGN)


def worst_case(
    what: OneSimulated,
    written: Written,
    trial: Annotated[
        int | None,
        typer.Option(help="Trial whose metric is to be large; the scenario's last if not given."),
    ] = None,
    starts: Annotated[int, typer.Option(help="Places to climb from.")] = 16,
    steps: Annotated[int, typer.Option(help="Steps of each climb.")] = 30,
    evaluations: Annotated[
        int | None,
        typer.Option(help="Learning processes to spend on either search, in place of --steps."),
    ] = None,
    draws: Annotated[int | None, typer.Option(help="A larger search by chance besides.")] = None,
    seed: Seed = 0,
) -> None:
    """The worst machine by climbing the gradient of its error, against machines drawn by chance.

    A gradient counts as three evaluations on top of the one that it belongs to.

    Example: jaxilc worst-case cao-2019 --scheme cfdl-mfailc --trial 40 --draws 10000
    """
    at_least(1, trial=trial, starts=starts, steps=steps, draws=draws)
    tell(
        "worst_case",
        what.request(trial),
        written,
        folder=written.out_dir,
        starts=starts,
        steps=steps,
        evaluations=evaluations,
        draws=draws,
        seed=seed,
    )
