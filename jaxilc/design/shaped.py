"""A learning filter by steps along the directions of a window, as a `Tuning` moves it."""

from __future__ import annotations

import jax
import numpy as np

from ..pytree.fields import Leaf, leaf, pytree, static
from ..schemes import LearningFilter, Scheme
from ..schemes.scheme import Feedforward
from ..signals.task import Limit, Task, Trial
from ..tuning import Tuning
from .window import Filters, Window, moved_by

WEIGHT = "z"


@pytree
class ShapedFilter(Scheme):
    """A `LearningFilter` whose taps are start + directions z.

    z:    (P,) steps, first those of L
    L, keep: taps at z = 0, see `Filters`
    of_L, of_keep: directions as columns, unit: factors of the steps; see `Window`
    lead, limit, starts: as in `LearningFilter`
    """

    z: Leaf = leaf()
    L: Leaf = leaf()
    keep: Leaf = leaf()
    of_L: Leaf = leaf()
    of_keep: Leaf = leaf()
    lead: int = static(default=0, interval="[0, inf)", whole=True)
    unit: Leaf | None = leaf(default=None, optional=True)
    limit: Leaf | None = leaf(default=None, interval="(0, inf)", optional=True)
    starts: tuple[int, ...] = static(default=())
    clips = ("limit",)

    @classmethod
    def around(cls, window: Window, start: Filters) -> ShapedFilter:
        """The filter with these taps at z = 0."""
        z = [0.0] * window.number_of_steps()
        return cls(
            z, start.L, start.keep, window.of_L, window.of_keep, window.lead, window.unit,
            window.limit, starts=window.starts,
        )  # fmt: skip

    def taps(self) -> LearningFilter:
        """The filter by its taps."""
        start = Filters(self.L, self.keep)
        L, keep = moved_by(start, self.of_L, self.of_keep, self.z, self.unit)
        return LearningFilter(L, keep, self.limit, lead=self.lead, starts=self.starts)

    def segments(self) -> list[LearningFilter]:
        """As of a `LearningFilter`."""
        return self.taps().segments()

    def check(self, task: Task) -> None:
        self.taps().check(task)

    def initial_memory(self, task: Task) -> Feedforward:
        return self.taps().initial_memory(task)

    def learn(self, memory: Feedforward, trial: Trial) -> Feedforward:
        return self.taps().learn(memory, trial)

    def limits(self, task: Task, memory: Feedforward, trial: Trial) -> dict[str, Limit]:
        return self.taps().limits(task, memory, trial)


def better_of(problem: Tuning, window: Window, one: Filters, other: Filters) -> Filters:
    """The filters of less loss on the held-out machines, the first of them where both are alike.

    problem: a tuning of the steps z of a `ShapedFilter` around `one`
    """
    steps = [np.zeros(window.number_of_steps()), window.steps(one, other)]
    names, loss = list(problem.start), jax.jit(problem.held_out_loss)
    of_one, of_other = (float(loss(dict(zip(names, z, strict=True)))) for z in steps)
    return other if of_other < of_one or not np.isfinite(of_one) else one
