"""What the processes that compute a sweep are given: everything that determines its numbers."""

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

    scheme: the scheme's place in the sweep
    name: its name
    number: of the chunk
    start, stop: its machines are start, ..., stop - 1
    """

    scheme: int
    name: str
    number: int
    start: int
    stop: int

    @property
    def size(self) -> int:
        """How many machines it has."""
        return self.stop - self.start


@dataclasses.dataclass(frozen=True, eq=False)
class Plan:
    """A sweep whose machines are drawn. The fields are those of `Sweep`, and

    drawn: (machines,) drawn numbers by the name of a leaf
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
