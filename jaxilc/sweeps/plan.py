"""The plan of a sweep: everything that determines its numbers, and the dataset that they fill.

The dimension over the machines is called `sample`, as in existing datasets.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import NamedTuple

import jax
import numpy as np

from ..learning.known_metrics import METRICS
from ..learning.metrics import Watch
from ..pytree.aliases import Value
from ..runtime import capacity
from ..runtime.tiles import OPEN
from ..schemes import Scheme
from ..schemes.scheme import trials_of_step
from ..signals.task import Task, Trial
from ..uncertainty import Population
from .grid import STEPS, TRIALS, Grid, Parts, Variant
from .store import Coordinate, Variable

SIGNALS = {"y": ("time", "channel"), "e": ("time", "channel"), "u": ("input_time", "input")}
WORK = 4  # arrays of the size of a metric over all machines and trials, needed for its quantiles


class Chunk(NamedTuple):
    """Members of one variant that are computed and stored together.

    Without a grid, the variants are the schemes and the members the machines, see `Grid`.

    scheme: position of the variant in the plan
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
    """A sweep as it is computed: with its drawn machines, its axes, and its lanes and chunk chosen.

    axes: those of the population's grid
    first: number of the first machine that is computed; with 1 the nominal one is left out
    The other fields are those of `Sweep`.
    """

    population: Population
    schemes: Mapping[str, Scheme]
    task: Task
    trials: int
    keep: tuple[str, ...] = ()
    quantities: Mapping[str, Callable[[Trial], jax.Array]] = dataclasses.field(default_factory=dict)
    watch: Watch | None = None
    axes: Grid = dataclasses.field(default_factory=Grid)
    chunk: int = OPEN
    lanes: int = OPEN
    first: int = 0

    @property
    def parts(self) -> Parts:
        return Parts(self.population.machine, self.schemes, self.task, self.trials)

    @cached_property
    def variants(self) -> dict[str, Variant]:
        """What the programs compute, by name."""
        return self.axes.variants(self.parts)

    @property
    def variables(self) -> dict[str, Variable]:
        """The variables by name: metrics, further quantities, signals that are kept, a watch's.

        A task with one output has no dimension `channel`, one with one input no dimension `input`.
        Numbers have the precision that is set now.
        Raises ValueError for a quantity with the name of a variable of the watch.
        """
        task, watch = self.task, self.watch
        dropped = {"channel"} if task.outputs == 1 else set()
        dropped |= {"input"} if task.inputs == 1 else set()
        real = "f8" if jax.config.jax_enable_x64 else "f4"

        def along(*axes: str) -> tuple[str, ...]:
            return ("scheme", "sample", *(axis for axis in axes if axis not in dropped))

        found = {
            m.name: Variable(
                along(*m.axes), real if m.dtype == "float" else m.dtype, m.unit_of(task), m.text
            )
            for m in METRICS
            if m.swept
        }
        for name in self.quantities:
            found[name] = Variable(along("trial"), real, "", "figure of a trial")
        for name in self.keep:
            unit = task.input_unit if name == "u" else task.unit
            found[name] = Variable(along(*SIGNALS[name]), real, unit, f"{name} of the last trial")
        for name, one in ({} if watch is None else watch.variables(task)).items():
            if name in found:
                said = "is a variable of the watch; choose another name"
                raise ValueError(f"quantity = {name!r} {said}")
            found[name] = Variable(along(*["trial"][: one.of_trials]), real, one.unit, one.text)
        return found

    @property
    def longest(self) -> int:
        """The largest number of trials of a variant."""
        given = (max(axis.values[TRIALS]) for axis in self.axes.axes if TRIALS in axis.values)
        return max(given, default=self.trials)

    @property
    def machines(self) -> int:
        """The number of machines at each point."""
        return self.population.size - self.first

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

    def bytes_stored(
        self,
        machines: float | None = None,
        trials: float | None = None,
        points: float | None = None,
    ) -> int:
        """Bytes of the whole dataset, before compression.

        machines, trials, points: their numbers, None for those of this plan
        """
        machines = self.machines if machines is None else machines
        points = self.axes.size if points is None else points
        lengths: dict[str, Value] = {
            "scheme": len(self.schemes),
            "sample": machines * points,
            "trial": self.longest if trials is None else trials,
            "channel": self.task.outputs,
            "input": self.task.inputs,
            "time": self.task.N + 1,
            "input_time": self.task.N,
        }
        of_each = self.variables.values()
        return sum(
            np.dtype(v.dtype).itemsize * math.prod(lengths[d] for d in v.dims) for v in of_each
        )

    def need_room(self, copies: int = 1) -> None:
        """Raises ValueError where `copies` of the dataset and its summary do not fit in RAM.

        The message says how many machines or trials would fit.
        """
        labels = len(self.population.uncertainty) + sum(len(axis.values) for axis in self.axes.axes)
        summary = 8 * WORK * len(self.schemes) * self.task.outputs

        def need(machines: float, trials: float, points: float = 1) -> float:
            return (
                copies * self.bytes_stored(machines, trials, points)
                + 8 * labels * machines * points
                + summary * machines * points * trials
                + 8 * trials
            )

        points = {"points": self.axes.size} if self.axes.axes else {}
        capacity.check_size("Sweep", need, machines=self.machines, trials=self.longest, **points)

    def coordinates(self) -> dict[str, Coordinate]:
        """Dimensions and values of each coordinate, with the drawn numbers and the grid's axes.

        Where a scheme makes experiments there are also the trials of a learning step.
        """
        task = self.task
        known = {
            "scheme": np.array(list(self.variants)),
            "sample": np.arange(self.members),
            "trial": np.arange(1, self.longest + 1),
            "channel": np.array(task.labels),
            "input": np.arange(task.inputs),
            "time": task.time,
            "input_time": task.time[:-1],
        }
        used = {d for v in self.variables.values() for d in v.dims}
        found: dict[str, Coordinate] = {
            name: ((name,), values) for name, values in known.items() if name in used
        }
        found |= {
            name: (("sample",), np.tile(values, self.axes.points))
            for name, values in self.population.drawn.items()
        }
        points = np.arange(self.members) // self.machines
        for axis, at in self.axes.places(points):
            found |= {name: (("sample",), labels[at]) for name, labels in axis.labels.items()}
        steps = np.array([trials_of_step(of.scheme, of.task) for of in self.variants.values()])
        found |= {STEPS: (("scheme",), steps)} if steps.max() > 1 else {}
        at_all = np.array([variant.fixed for variant in self.variants.values()])
        for axis, at in zip(self.axes.static, at_all.T, strict=True):
            found |= {name: (("scheme",), labels[at]) for name, labels in axis.labels.items()}
        return found
