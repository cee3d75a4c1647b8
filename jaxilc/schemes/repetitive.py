"""Repetitive control: what is learned between trials, learned within one long trial each period."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax

from ..pytree.aliases import Array, Leaf
from ..pytree.fields import child, leaf, pytree, static
from ..pytree.needs import known
from ..signals.task import Sample, Task
from .learning_filter import LearningFilter
from .scheme import Scheme, limited

AROUND = np.array([-1, 0, 1, 2])  # samples from which a value between two of them is interpolated
ROOM = 1.25  # of the memory, over the period with which the scheme is made
MOST = 3  # periods at once; there are 2^P - 1 places at which P of them look back


class Passed(NamedTuple):
    """What is remembered, the newest sample last.

    v: (M, n_u) what was added to the input;  e: (M, n_y) errors
    """

    v: Array
    e: Array


@pytree
class RepetitiveControl(Scheme):
    """The law of a `LearningFilter`, from period to period of one long trial.

        v[k] = sum_i keep_i v[k - n + i - m] + sum_i L_i e[k - n + 1 + lead + i - l]

    n = period / dt is the period in samples, m and l are the middle taps of keep and L. Between
    trials the same law is u_{j+1} = Q u_j + L e_j; here the trial before is the period before
    (Hara, Yamamoto, Omata, Nakano 1988). So L and Q may look ahead, as far as a period allows, and
    in the first period v is zero. Where n is no whole number, values between samples come from four
    samples around them (Lagrange). It stands beside a feedback, in parallel:

        WithFeedback(RepetitiveControl(learning_filter(L, Q), period=0.25), PID(...))

    `theory.repetitive_condition` tells whether it converges, what is left at each frequency, and
    what a wrong period costs. Of several periods n_1 .. n_P each is learned as if it were alone: in
    place of the delay z^-n stands W = 1 - prod_i (1 - z^-n_i), such as z^-n_1 + z^-n_2 -
    z^-(n_1 + n_2). That is larger than 1 between the harmonics, so it asks more of the law.

    law: taps L and keep, from `learning_filter` or given; one law in all samples
    period: () of what repeats [s], or (P,) of up to three at once; each at least what L and keep
        look ahead and three samples more
    longest: the longest period, or sum of several, that may be set [s]; None is 1.25 times `period`

    `check` raises ValueError for a period that is too short for the law, or longer than `longest`,
    and where `longest` cannot be told because `period` is traced. A traced period outside of this
    range makes the input NaN, so that the machine counts as diverged.
    """

    law: LearningFilter = child()
    period: Leaf = leaf(interval="(0, inf)")
    longest: float | None = static(default=None, interval="(0, inf)", optional=True)

    def __post_init__(self) -> None:
        if self.longest is None and known(self.period):
            object.__setattr__(self, "longest", ROOM * float(np.sum(self.period)))

    def check(self, task: Task) -> None:
        if self.law.starts:
            raise ValueError(
                f"RepetitiveControl: law has starts = {self.law.starts}; allowed is (), one law in "
                "all samples"
            )
        self.law.check(task)
        longest = self._longest
        if not known(self.period):
            return
        values = np.asarray(self.period)
        if values.ndim > 1 or not 0 < values.size <= MOST or not self._fits(values, task.dt):
            raise ValueError(
                f"RepetitiveControl: period = {values} s is outside its allowed range "
                f"[{self._least * task.dt:g}, {longest:g}]: from what the law looks ahead, to "
                f"`longest`, which is for the sum of up to {MOST} periods"
            )

    def initial_state(self, task: Task) -> Passed:
        # as many samples before the newest as the longest period and the taps look back
        past = int(np.ceil(self._longest / task.dt)) + AROUND[-1] + 1
        of = {"v": task.inputs, "e": task.outputs}
        return Passed(*(jnp.zeros((past - self._ends(n)[0], of[n])) for n in of))

    def act(self, state: Passed, sample: Sample) -> tuple[Passed, Array]:
        e = _with(state.e, sample.r - sample.y)
        v_past = state.v
        if sample.applied is not None:  # what an actuator has let through
            v_past = v_past.at[-1].set(sample.applied)
        v = jnp.zeros_like(v_past[-1])
        for sign, period in delays(jnp.asarray(self.period)):
            periods = period / sample.dt
            whole = jnp.floor(periods)
            weights = sign * lagrange(periods - whole)
            weights = jnp.where(self._fits(self.period, sample.dt), weights, jnp.nan)
            v = v + self._of_period("v", self.law.keep, v_past, whole - 1, weights)
            v = v + self._of_period("e", self.law.L, e, whole, weights)
        v = limited(v, self.law.limit)
        return Passed(_with(v_past, v), e), v

    @property
    def _longest(self) -> float:
        if self.longest is None:
            raise ValueError(
                "RepetitiveControl: longest = None, and period is traced; allowed is the longest "
                "period that it may have [s]"
            )
        return self.longest

    @property
    def _least(self) -> int:
        """The shortest period in samples, with which nothing is needed that is yet to come."""
        return max(self._ends("e")[1], self._ends("v")[1] + 1) + 2

    def _fits(self, period: Leaf, dt: float) -> Leaf:
        xp = np if known(period) else jnp
        least = self._least * dt * (1 - 1e-9)
        return xp.all(period >= least) & (xp.sum(period) <= self._longest)

    def _ends(self, name: str) -> tuple[int, int]:
        """The first and the last sample that the taps see, from the same place a period later."""
        middle = self.law._taps("L" if name == "e" else "keep") // 2
        ahead = 1 + self.law.lead if name == "e" else 0
        return min(ahead - middle, 0), ahead + middle

    def _of_period(
        self, name: str, taps: Array, past: Array, whole: Array, weights: Array
    ) -> Array:
        """(n_u,) the taps on the samples a period ago; the newest of `past` is `whole` later."""
        last = self._ends(name)[1]
        count = taps.shape[0] + len(AROUND) - 1
        first = len(past) - whole.astype(int) + last - taps.shape[0] - AROUND[-1]
        seen = lax.dynamic_slice_in_dim(past, first, count)
        between = sum(
            weights[i] * seen[AROUND[-1] - j : count - (len(AROUND) - 1) + AROUND[-1] - j]
            for i, j in enumerate(AROUND)
        )
        if taps.ndim == 1:
            return taps @ between
        return jnp.einsum("pij,pj->i", taps, between)


def delays(period: Array | np.ndarray) -> Iterator[tuple[float, Array]]:
    """The sign and the delay of each term of 1 - prod_i (1 - delay i)."""
    of_each = jnp.atleast_1d(period)
    for chosen in product((0.0, 1.0), repeat=len(of_each)):
        if any(chosen):
            yield -((-1.0) ** sum(chosen)), jnp.dot(np.array(chosen), of_each)


def _with(past: Array, newest: Array) -> Array:
    return jnp.concatenate([past[1:], newest[None]])


def lagrange(share: Array | float) -> Array:
    """(4,) weights of x[-1], x[0], x[1], x[2] in x[share], share in [0, 1)."""
    weights = []
    for i, at in enumerate(AROUND):
        others = np.delete(AROUND, i)
        weights.append(jnp.prod((share - others) / (at - others)))
    return jnp.stack(weights)
