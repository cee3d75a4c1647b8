"""The machines of a tuning: how they are drawn, and how they run in tiles."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from ..learning.machine import Machine
from ..runtime.lanes import usual_lanes
from ..runtime.tiles import tiled
from ..uncertainty import Uncertainty, draw, drawn_machine


@dataclasses.dataclass(frozen=True, eq=False)
class Machines:
    """The set that a tuning draws its machines from; the fields are those of `Tuning`."""

    machine: Machine
    uncertainty: Uncertainty
    seed: int
    sampling: str
    lanes: int
    starts: int

    def drawn(self, seed: int, size: int, *, nominal: bool) -> tuple[Any, dict[str, Any]]:
        """The numbers and drawn values of `size` machines, as a batch for `tiled`.

        nominal: whether the nominal machine, number 0, is one of them
        """
        skipped = 0 if nominal else 1
        # The corners do not depend on the seed, so for another seed another sampling is used.
        other = self.sampling == "corners" and seed != self.seed
        sampling = "sobol" if other else self.sampling
        drawn = draw(self.machine, self.uncertainty, size + skipped, seed=seed, sampling=sampling)
        count = len(next(iter(drawn.values()))) if drawn else size + skipped
        values = {name: jnp.asarray(values[skipped:]) for name, values in drawn.items()}
        return jnp.arange(skipped, count), values

    def one(self, numbered, seed: int) -> tuple[Machine, jax.Array]:
        """One machine of a batch, and the key of its noise.

        numbered: an element of the batch
        """
        number, drawn = numbered
        machine = drawn_machine(self.machine, self.uncertainty, drawn)
        return machine, jax.random.fold_in(jax.random.key(seed), number)

    def tiled(self, of_one, batch):
        """The result of `tiled(of_one)` over a batch and, under `vmap`, over all starts."""
        of_a_device = -(-len(batch[0]) // jax.device_count())
        wide = usual_lanes() is None  # all machines of all starts in one tile, if they fit
        lanes = self.lanes if wide else min(self.lanes, of_a_device)
        return tiled(of_one, lanes=max(1, lanes // self.starts))
