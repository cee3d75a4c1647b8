"""Basis functions within one trial: weights of functions of the period, learned as it runs."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp

from ..plants.position import Harmonics, Splines
from ..pytree.aliases import Array, Leaf
from ..pytree.fields import child, leaf, pytree, scalar, static
from ..signals.task import Sample, Task
from .scheme import Scheme, need_square

BEFORE = 1e-9  # of a period, by which rounding may put its end too early


class Learned(NamedTuple):
    """What `RepetitiveBasis` knows within a trial.

    w: (m, n_u) weights;  waiting: (m, n_u) what they change by at the end of the period
    k: () number of the sample;  turn: () number of the period
    """

    w: Array
    waiting: Array
    k: Array
    turn: Array


@pytree
class RepetitiveBasis(Scheme):
    """Functions of the time within a period, whose weights are learned in one long trial.

        u[k] = f(t)' w[k],   w[k+1] = keep w[k] + gain f(t - lead) e[k],   t = k dt

    It stands beside a feedback, `WithFeedback(RepetitiveBasis(...), PID(...))`, each input with
    weights of its own for the error of its own output. With `Harmonics(period, orders)` this is
    adaptive feedforward cancellation, the same as a resonator for each harmonic (Bodson, Sacks,
    Khosla 1994): from e to u it is linear and does the same at all samples,

        C(z) = sum_h gain_h z^-1 (cos(a_h + b_h) - keep z^-1 cos b_h)
                                / (1 - 2 keep z^-1 cos a_h + keep^2 z^-2)

    with a_h = 2 pi h dt / period and b_h = 2 pi h lead / period. With all harmonics of a period of
    n samples, n odd, and gains of 2 g / n (g / n for the constant) it is `RepetitiveControl` with
    one tap L = g and keep = 1, whose lead is lead / dt - 1. Fewer functions let less noise in.

    functions: `Harmonics` with the period [s] as pitch, or `Splines(0, period, count, closed=True)`
    gain: () or (m,) of each function [unit of u per unit of e]
    lead: () or (m,) by which the output is later than the input, as delay or phase of the closed
        loop at the function [s]
    keep: () what is left of a weight after a step; below 1 it forgets, and is more robust
    by_period: whether the weights change at the end of a period only, by the sum over it
    angle: number of the output that is taken in the place of t, in the units of the functions, such
        as that of a spindle; the law does not see its error. None: none
    """

    functions: Harmonics | Splines = child()
    gain: Leaf = leaf()
    lead: Leaf = leaf(default=0.0)
    keep: Leaf = scalar(default=1.0, interval="(0, 1]")
    by_period: bool = static(default=False)
    angle: int | None = static(default=None, interval="[0, inf)", whole=True, optional=True)

    def check(self, task: Task) -> None:
        m = len(self.functions.names)
        for name in ("gain", "lead"):
            shape = getattr(self, name).shape
            if shape not in ((), (m,)):
                raise ValueError(
                    f"RepetitiveBasis: {name} has shape {shape}; allowed are () and ({m},), one "
                    "for each function"
                )
        if self.angle is not None and self.angle >= task.outputs:
            raise ValueError(
                f"RepetitiveBasis: angle = {self.angle} is none of the task's outputs 0.."
                f"{task.outputs - 1}"
            )
        seen = tuple(i for i in range(task.outputs) if i != self.angle)
        need_square(self, task.of_outputs(seen))

    def initial_state(self, task: Task) -> Learned:
        zero = jnp.zeros((len(self.functions.names), task.inputs))
        return Learned(zero, zero, jnp.zeros(()), jnp.full((), jnp.inf))

    def act(self, state: Learned, sample: Sample) -> tuple[Learned, Array]:
        e, w, waiting = sample.r - sample.y, state.w, state.waiting
        t = state.k * sample.dt
        if self.angle is not None:
            t, e = sample.y[self.angle], jnp.delete(e, self.angle)
        turn = jnp.floor(self._turns(t) + BEFORE)
        if self.by_period:
            ended = turn > state.turn
            w = jnp.where(ended, self.keep * w + waiting, w)
            waiting = jnp.where(ended, 0.0, waiting)
        u = self.functions.at(t) @ w
        seen = self.functions.at(t - self.lead)  # of a lead each, its own function
        seen = jnp.diagonal(seen) if seen.ndim == 2 else seen
        change = (self.gain * seen)[:, None] * e
        if self.by_period:
            waiting = waiting + change
        else:
            w = self.keep * w + change
        return Learned(w, waiting, state.k + 1, turn), u

    def signals(self, state: Learned) -> dict[str, Array]:
        return {"weights": state.w.ravel()}

    def _turns(self, t: Array) -> Array:
        """() the number of periods since 0."""
        if isinstance(self.functions, Harmonics):
            return t / self.functions.pitch
        return (t - self.functions.low) / (self.functions.high - self.functions.low)
