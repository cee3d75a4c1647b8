"""The plan of a sweep: everything that determines its numbers, for the computing processes."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import NamedTuple

import jax
import numpy as np

from ..learning.machine import Machine
from ..learning.watch import Watch
from ..runtime import capacity
from ..schemes import Scheme
from ..signals.task import Task, Trial
from ..uncertainty import Uncertainty
from .grid import Grid, Variant


class Chunk(NamedTuple):
    """Members of one variant that are computed and stored together.

    Without a grid, the variants are the schemes and the members the machines, see `Grid`.

    scheme: position of the variant in the plan
    name: name of the variant
    number: number of the chunk
    start, stop: the members of the chunk are start, ..., stop - 1
    """

    scheme: int
    name: str
    number: int
    start: int
    stop: int

    @property
    def size(self) -> int:
        """The number of members in the chunk."""
        return self.stop - self.start


@dataclasses.dataclass(frozen=True, eq=False)
class Plan:
    """A sweep with its drawn machines.

    drawn: (machines,) drawn numbers by the name of a leaf
    axes: the grid of the sweep
    The other fields are those of `Sweep`.
    """

    machine: Machine
    schemes: Mapping[str, Scheme]
    task: Task
    trials: int
    uncertainty: Uncertainty
    machines: int
    seed: int
    drawn: Mapping[str, np.ndarray]
    keep: tuple[str, ...]
    chunk: int
    lanes: int
    quantities: Mapping[str, Callable[[Trial], jax.Array]]
    watch: Watch | None = None
    axes: Grid = dataclasses.field(default_factory=Grid)

    @cached_property
    def variants(self) -> dict[str, Variant]:
        """What the programs compute, by name."""
        return self.axes.variants(self.machine, self.schemes, self.task, self.trials)

    @property
    def longest(self) -> int:
        """The largest number of trials of a variant."""
        return self.axes.longest(self.trials)

    @property
    def members(self) -> int:
        """The number of machines at all points of a variant."""
        return self.machines * self.axes.points

    def chunks(self) -> list[Chunk]:
        """All chunks, variant by variant."""
        return [
            Chunk(i, name, number, start, min(start + self.chunk, self.members))
            for i, name in enumerate(self.variants)
            for number, start in enumerate(range(0, self.members, self.chunk))
        ]


def that_fits(plan: Plan, hosts, name: str, need: int, room: int) -> str:
    """What would fit where a chunk of a variant needs more bytes than there is room for.

    hosts: what computes the chunks, see `Host`
    """
    # From two tiles on, the RAM of a chunk is linear in its size; a single tile needs less, since
    # there is no loop over tiles.
    tile, size = plan.lanes * hosts.environment["devices"], min(plan.chunk, plan.members)
    small = min(2 * tile, size)
    least = next(hosts.chunk_bytes((name,), small))[1] if small < size else need
    if least > room:
        return (
            f"{small} machines at a time need {capacity.shown(least)} already; keep fewer signals, "
            "take fewer trials, or shorten them"
        )
    fits = int(small + (room - least) / (need - least) * (size - small)) // tile * tile
    return f"chunk = {fits} would fit"
