"""PID feedback in position form and in increment form."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from ..pytree import leaf, need_channels, pytree, static
from ..signals import Sample, Task
from .scheme import Scheme, limited, need_square


class PIDState(NamedTuple):
    """integral: (n,) [unit of u];  e, slope, u: (n,) error, filtered de/dt and input of the sample before."""

    integral: jax.Array
    e: jax.Array
    slope: jax.Array
    u: jax.Array


@pytree
class PID(Scheme):
    """PID with derivative filter, input limit and anti-windup, channel by channel.

        position:  u[k] = kp e[k] + ki dt sum_{i<=k} e[i] + kd s[k]
        increment: u[k] = u[k-1] + kp (e[k] - e[k-1]) + ki dt e[k] + kd (s[k] - s[k-1])
        s[k] = (tau s[k-1] + e[k] - e[k-1]) / (tau + dt), which is the backward difference of e for tau = 0

    Before the first sample e = 0. Where u hits `limit`, the position form stops integrating unless the error drives it back
    (conditional integration); the increment form starts from the limited u and so needs no more.
    kp [u/y], ki [u/(y s)], kd [u s/y]: () or (n,);  tau: derivative filter [s];  limit: largest |u|, None for none
    """

    kp: jax.Array = leaf(0.0)
    ki: jax.Array = leaf(0.0)
    kd: jax.Array = leaf(0.0)
    tau: jax.Array = leaf(0.0, "[0, inf)")
    limit: jax.Array | None = leaf(None, "(0, inf)", optional=True)
    form: str = static("position", choices=("position", "increment"))

    def check(self, task: Task) -> None:
        need_square(self, task)
        need_channels(self, task.outputs, "kp", "ki", "kd", "tau", "limit")

    def init(self, task: Task) -> PIDState:
        return PIDState(*(jnp.zeros(task.outputs),) * 4)

    def act(self, state: PIDState, sample: Sample):
        e = sample.r - sample.y
        slope = (self.tau * state.slope + e - state.e) / (self.tau + sample.dt)
        if self.form == "increment":
            u = state.u + self.kp * (e - state.e) + self.ki * sample.dt * e + self.kd * (slope - state.slope)
            u = limited(u, self.limit)
            return PIDState(state.integral, e, slope, u), u
        integral = state.integral + self.ki * sample.dt * e
        u = self.kp * e + integral + self.kd * slope
        if self.limit is not None:
            winding = (jnp.abs(u) > self.limit) & (u * self.ki * e > 0)
            integral = jnp.where(winding, state.integral, integral)
            u = limited(self.kp * e + integral + self.kd * slope, self.limit)
        return PIDState(integral, e, slope, u), u
