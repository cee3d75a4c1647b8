"""`jaxilc certify`: the claims of theory for each machine, compared with simulation."""

from __future__ import annotations

import typer

from .groups import add
from .options import PROVE, Machines, Sampling, Seed, Simulated, Spread, Written
from .present import tell


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    add(app, certify, PROVE)


def certify(
    what: Simulated,
    written: Written,
    machines: Machines = 64,
    seed: Seed = 0,
    spread: Spread = None,
    sampling: Sampling = "monte-carlo",
) -> None:
    """Theory beside simulation: claims for the long run, and predictions of J trials.

    For schemes with the bounds of Cao 2019, their premises are checked too. Of
    repetitive control it tells the condition, what grows between the harmonics,
    and what a wrong period costs.

    Example: jaxilc certify cao-2019 --scheme cfdl-mfailc --trials 200 --machines 256
    """

    tell(
        "certify",
        what.request(spread=spread),
        written,
        folder=written.out_dir,
        machines=machines,
        seed=seed,
        sampling=sampling,
    )
