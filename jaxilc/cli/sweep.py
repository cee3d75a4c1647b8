"""`jaxilc sweep`: schemes against many uncertain machines."""

from __future__ import annotations

from functools import partial
from typing import Annotated

import typer

from .groups import add
from .options import (
    SIMULATE,
    GridAxes,
    Machines,
    MetricName,
    Resume,
    Seed,
    Simulated,
    Spread,
    Written,
    left,
)
from .present import tell
from .progress import run_sweep


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    add(app, sweep, SIMULATE)


def sweep(
    what: Simulated,
    written: Written,
    machines: Machines = 1024,
    seed: Seed = 0,
    spread: Spread = None,
    metric: MetricName = None,
    tolerance: Annotated[
        float | None,
        typer.Option(help="Largest metric that passes, the one tables show, in its unit."),
    ] = None,
    grid: GridAxes = None,
    resume: Resume = False,
    dask: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Compute on workers of this Dask scheduler: its address, or the file it wrote.",
        ),
    ] = None,
    bounds: Annotated[
        bool,
        typer.Option(
            "--bounds",
            help="Contraction of each trial; d1, d2 and premises of Cao 2019, on each machine.",
        ),
    ] = False,
    sampling: Annotated[str | None, left("--sampling", "Sweep(sampling=...) does it")] = None,
    keep: Annotated[list[str] | None, left("--keep", "Sweep(keep=...) does it")] = None,
) -> None:
    """Schemes against many uncertain machines: yield, quantiles, worst case, figure, dataset.

    With --grid they run at every point of a grid; tables and figure are those of the best point.

    Example: jaxilc sweep cao-2019 --machines 4096 --spread 0.2 --out out/wide
    """
    tell(
        "sweep",
        what.request(spread=spread, metric=metric, tolerance=tolerance),
        written,
        folder=written.out_dir,
        bar=False,
        machines=machines,
        seed=seed,
        sampling=sampling or "monte-carlo",
        grid=grid or (),
        keep=keep or (),
        bounds=bounds,
        resume=resume,
        run=partial(run_sweep, cluster=dask),
    )
