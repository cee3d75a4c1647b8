"""PID feedback in position form and in increment form."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp

from ..pytree.aliases import Array, Leaf, Tree
from ..pytree.fields import leaf, pytree, static
from ..pytree.needs import need_channels
from ..signals.rows import plus
from ..signals.task import Sample, Task
from .scheme import Scheme, limited, need_square
from .sliding_mode import filtered_difference


class PIDState(NamedTuple):
    """The state of `PID`; all but `integral` are values of the sample before.

    integral: (n,) integral part of the input [unit of u]
    e: (n,) error [unit of y]
    slope: (n,) filtered de/dt [unit of y per s]
    u: (n,) input [unit of u]
    r: (n,) reference [unit of y]; None where it is not needed
    feedforward: (n,) feedforward f [unit of u]; None where it is not needed
    """

    integral: Array
    e: Array
    slope: Array
    u: Array
    r: Tree
    feedforward: Tree


@pytree
class PID(Scheme):
    """PID with derivative filter, feedforward of the reference, input limit and anti-windup.

        position:  u[k] = kp e[k] + ki dt sum_{i<=k} e[i] + kd s[k] + f[k]
        increment: u[k] = u[k-1] + kp (e[k] - e[k-1]) + ki dt e[k] + kd (s[k] - s[k-1])
                          + f[k] - f[k-1]
        s[k] = (tau s[k-1] + e[k] - e[k-1]) / (tau + dt)
        f[k] = kv (r[k+1] - r[k]) / dt + ka (r[k+2] - r[k+1] - r[k] + r[k-1]) / (2 dt^2)

    Each channel has its own loop. For tau = 0, s is the backward difference of e. Before the first
    sample e = 0 and f = 0. Where u reaches `limit`, the position form stops the integration unless
    the error drives u back (conditional integration). The increment form continues from the limited
    u and needs no other anti-windup.

    f is the feedforward of velocity and acceleration. Its differences are central with respect to
    the middle of the interval over which u[k] is held. So an integrator follows exactly with kv
    alone, and a double integrator follows with zero phase with ka alone:
    y[k] = (r[k+1] + 2 r[k] + r[k-1]) / 4. Before and after the trial the reference is constant. f
    is not learned; under `WithFeedback` it belongs to the contribution of the feedback.

    kp: () or (n,) proportional gain [u/y]
    ki: () or (n,) integral gain [u/(y s)]
    kd: () or (n,) derivative gain [u s/y]
    tau: () or (n,) time constant of the derivative filter [s]
    limit: () or (n,) largest |u| [unit of u]; None: no limit
    kv: () or (n,) gain of the velocity feedforward [u s/y]; None: no such feedforward
    ka: () or (n,) gain of the acceleration feedforward [u s^2/y]; None: no such feedforward. It
        needs a preview of two samples.
    """

    kp: Leaf = leaf(default=0.0)
    ki: Leaf = leaf(default=0.0)
    kd: Leaf = leaf(default=0.0)
    tau: Leaf = leaf(default=0.0, interval="[0, inf)")
    limit: Leaf | None = leaf(default=None, interval="(0, inf)", optional=True)
    form: str = static(default="position", choices=("position", "increment"))
    kv: Leaf | None = leaf(default=None, optional=True)
    ka: Leaf | None = leaf(default=None, optional=True)
    clips = ("limit",)

    @property
    def preview(self) -> int:
        return 1 if self.ka is None else 2

    def check(self, task: Task) -> None:
        need_square(self, task)
        need_channels(self, task.outputs, "kp", "ki", "kd", "tau", "limit", "kv", "ka")

    def initial_state(self, task: Task) -> PIDState:
        rest = jnp.zeros(task.outputs)
        before = None if self.ka is None else jnp.asarray(task.reference[0])
        remembered = self.form == "increment" and (self.kv is not None or self.ka is not None)
        return PIDState(rest, rest, rest, rest, before, rest if remembered else None)

    def act(self, state: PIDState, sample: Sample) -> tuple[PIDState, Array]:
        e = sample.r - sample.y
        slope = filtered_difference(state.slope, e, state.e, self.tau, sample.dt)
        f, r = self._feedforward(state, sample), None if self.ka is None else sample.r
        if self.form == "increment":
            u = (
                state.u
                + self.kp * (e - state.e)
                + self.ki * sample.dt * e
                + self.kd * (slope - state.slope)
            )
            u = limited(u if f is None else u + (f - state.feedforward), self.limit)
            return PIDState(state.integral, e, slope, u, r, f), u
        integral = state.integral + self.ki * sample.dt * e
        u = plus(self.kp * e + integral + self.kd * slope, f)
        if self.limit is not None:
            winding = (jnp.abs(u) > self.limit) & (u * self.ki * e > 0)
            integral = jnp.where(winding, state.integral, integral)
            u = limited(plus(self.kp * e + integral + self.kd * slope, f), self.limit)
        return PIDState(integral, e, slope, u, r, None), u

    def _feedforward(self, state: PIDState, sample: Sample) -> Array | None:
        """The feedforward f[k] (n,), or None where there is no feedforward."""
        f, dt = None, sample.dt
        if self.kv is not None:
            f = self.kv * (sample.ahead[0] - sample.r) / dt
        if self.ka is not None:
            f = plus(
                self.ka * (sample.ahead[1] - sample.ahead[0] - sample.r + state.r) / (2 * dt**2), f
            )
        return f
