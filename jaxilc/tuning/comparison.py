"""The sweep that compares schemes on machines which a tuning has not used."""

from __future__ import annotations

from collections.abc import Mapping

from ..schemes import Scheme
from ..sweeps.sweep import Sweep
from .losses import Losses


def comparison_of(
    tuned_for: Losses,
    schemes: Mapping[str, Scheme],
    trials: int | None,
    machines: int,
    seed: int | None,
) -> Sweep:
    """The sweep of `Tuning.comparison`, not run yet.

    tuned_for: the losses of the tuning, which know its machines and its task
    The other arguments are those of `Tuning.comparison`, which also says what is raised.
    """
    used = tuned_for.machines
    if seed in (used.seed, used.seed + 1):
        raise ValueError(
            f"compare: seed = {seed} is one of {used.seed} and {used.seed + 1}, whose plants "
            "tuning or choosing has seen"
        )
    planned = Sweep(
        used.machine,
        schemes,
        tuned_for.task,
        trials or tuned_for.trials,
        used.uncertainty,
        machines=machines,
        seed=used.seed + 2 if seed is None else seed,
        quantities=tuned_for.quantities,
    )
    planned.need_room(copies=2)  # without a store, the dataset is in the RAM twice
    return planned
