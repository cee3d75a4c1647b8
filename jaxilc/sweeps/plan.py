"""The plan of a sweep: everything that determines its numbers, for the computing processes."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import numpy as np

from ..learning.machine import Machine
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
