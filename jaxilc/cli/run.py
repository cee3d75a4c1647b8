"""`jaxilc list` shows the scenarios and their settings, `jaxilc run` learns on one machine."""

from __future__ import annotations

from typing import Annotated

import typer

from .completion import scenarios_from
from .groups import add
from .options import SIMULATE, Details, MetricName, Pages, Replace, Seed, Simulated, Written
from .present import present, tell
from .start import begin


def register(app: typer.Typer) -> None:
    """Add the commands to the command line."""
    add(app, list_, SIMULATE, "list")
    add(app, run, SIMULATE)


def list_(
    scenario: Annotated[
        str | None,
        typer.Argument(
            metavar="[SCENARIO]", help="Show all that can be set.", autocompletion=scenarios_from
        ),
    ] = None,
) -> None:
    """List the scenarios, or all that can be set in one.

    Example: jaxilc list cao-2019
    """
    from ..outcomes import listing

    if scenario is not None:
        begin()
    present(listing.scenarios() if scenario is None else listing.settings(scenario), Pages())


def run(
    what: Simulated,
    written: Written,
    metric: MetricName = None,
    seed: Seed = 0,
    replace: Replace = False,
    details: Details = False,
) -> None:
    """Learn on the nominal machine: errors beside the published ones, figures, dataset.

    Example: jaxilc run cao-2019 --scheme ffdl-mfailc --set ffdl-mfailc.lam=0.5
    """

    tell(
        "run",
        what.request(metric=metric),
        written,
        details=details,
        folder=written.out_dir,
        seed=seed,
        replace=replace,
    )
