"""A learning filter by steps along the directions of a window, as a `Tuning` moves it."""

from __future__ import annotations

import jax
import numpy as np

from ..pytree.fields import Leaf, leaf, pytree, static
from ..schemes import LearningFilter, Scheme
from ..schemes.scheme import Feedforward
from ..signals.task import Task, Trial
from ..tuning import Tuning
from .window import Filters, Window

WEIGHT = "z"


@pytree
class ShapedFilter(Scheme):
    """A `LearningFilter` whose taps are start + directions z.

    z:    (P,) steps, first those of L
    L, keep: (p,), (p',) taps at z = 0
    of_L, of_keep: (p, P_L), (p', P - P_L) directions as columns, see `Window`
    lead: as in `LearningFilter`
    """

    z: Leaf = leaf()
    L: Leaf = leaf()
    keep: Leaf = leaf()
    of_L: Leaf = leaf()
    of_keep: Leaf = leaf()
    lead: int = static(default=0, interval="[0, inf)", whole=True)

    @classmethod
    def around(cls, window: Window, start: Filters) -> ShapedFilter:
        """The filter with these taps at z = 0."""
        z = [0.0] * (window.of_L.shape[1] + window.of_keep.shape[1])
        return cls(z, start.L, start.keep, window.of_L, window.of_keep, window.lead)

    def taps(self) -> LearningFilter:
        """The filter by its taps."""
        count = self.of_L.shape[1]
        L = self.L + self.of_L @ self.z[:count]
        return LearningFilter(L, keep=self.keep + self.of_keep @ self.z[count:], lead=self.lead)

    def check(self, task: Task) -> None:
        self.taps().check(task)

    def initial_memory(self, task: Task) -> Feedforward:
        return self.taps().initial_memory(task)

    def learn(self, memory: Feedforward, trial: Trial) -> Feedforward:
        return self.taps().learn(memory, trial)


def better_of(problem: Tuning, window: Window, one: Filters, other: Filters) -> Filters:
    """The filters of less loss on the held-out machines, the first of them where both are alike.

    problem: a tuning of the steps z of a `ShapedFilter` around `one`
    """
    steps = [np.zeros(window.of_L.shape[1] + window.of_keep.shape[1]), window.steps(one, other)]
    names, loss = list(problem.start), jax.jit(problem.held_out_loss)
    of_one, of_other = (float(loss(dict(zip(names, z, strict=True)))) for z in steps)
    return other if of_other < of_one or not np.isfinite(of_one) else one
