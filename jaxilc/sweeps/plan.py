"""The plan of a sweep: everything that determines its numbers, for the computing processes."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import numpy as np

from ..learning.machine import Machine
from ..runtime import capacity
from ..schemes import Scheme
from ..signals.task import Task, Trial
from ..uncertainty import Uncertainty


class Chunk(NamedTuple):
    """Machines under one scheme that are computed and stored together.

    scheme: position of the scheme in the sweep
    name: name of the scheme
    number: number of the chunk
    start, stop: the machines of the chunk are start, ..., stop - 1
    """

    scheme: int
    name: str
    number: int
    start: int
    stop: int

    @property
    def size(self) -> int:
        """The number of machines in the chunk."""
        return self.stop - self.start


@dataclasses.dataclass(frozen=True, eq=False)
class Plan:
    """A sweep with its drawn machines.

    drawn: (machines,) drawn numbers by the name of a leaf
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

    def chunks(self) -> list[Chunk]:
        """All chunks, scheme by scheme."""
        return [
            Chunk(i, name, number, start, min(start + self.chunk, self.machines))
            for i, name in enumerate(self.schemes)
            for number, start in enumerate(range(0, self.machines, self.chunk))
        ]


def that_fits(plan: Plan, hosts, name: str, need: int, room: int) -> str:
    """What would fit where a chunk of a scheme needs more bytes than there is room for.

    hosts: what computes the chunks, see `Host`
    """
    # From two tiles on, the RAM of a chunk is linear in its size; a single tile needs less, since
    # there is no loop over tiles.
    tile, size = plan.lanes * hosts.environment["devices"], min(plan.chunk, plan.machines)
    small = min(2 * tile, size)
    least = next(hosts.chunk_bytes((name,), small))[1] if small < size else need
    if least > room:
        return (
            f"{small} machines at a time need {capacity.shown(least)} already; keep fewer signals, "
            "take fewer trials, or shorten them"
        )
    fits = int(small + (room - least) / (need - least) * (size - small)) // tile * tile
    return f"chunk = {fits} would fit"
