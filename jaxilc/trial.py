"""One trial: the scan over time."""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax

from .machine import Machine
from .schemes import Scheme
from .signals import Sample, Task, Trial


def run_trial(machine: Machine, scheme: Scheme, task: Task, memory, key) -> Trial:
    """The machine under the scheme for one trial of the task, from rest.

    memory: what the scheme knows (`scheme.memory(task)` before the first trial);  key: of this trial's noise
    Pure; to be called inside `jit`. Fields of the returned `Trial` have N or N+1 rows.
    """
    machine = machine.sampled(task.dt)
    plant, dt, r = machine.plant, task.dt, jnp.asarray(task.reference)
    draws = machine.draws(key, task)
    future = jnp.pad(r[1:], ((0, scheme.preview - 1), (0, 0)), mode="edge")
    if scheme.preview == 1:
        future = future[:, None, :]

    def tick(carry, now):
        x, state, v_last = carry
        k, r_k, row, d_u, d_y, noise, next_r = now
        y = machine.measure(_plus(plant.output(x), d_y), noise)
        ahead = next_r if scheme.preview == 1 else lax.dynamic_slice_in_dim(future, k, scheme.preview)
        state, command = scheme.act(state, Sample(r_k, ahead, y, row, dt))
        v, u = machine.actuate(command, v_last, dt)
        return (plant.step(x, _plus(u, d_u), dt), state, v), (y, u, scheme.signals(state))

    rows = (
        jnp.arange(task.N),
        r[:-1],
        scheme.table(memory, task),
        draws.input,
        *(None if d is None else d[:-1] for d in (draws.output, draws.sensor)),
        future if scheme.preview == 1 else None,
    )
    start = (plant.init(), scheme.init(task), jnp.zeros(task.inputs))
    (x, _, _), (y, u, signals) = lax.scan(tick, start, rows, length=task.N)
    last = machine.measure(_plus(plant.output(x), _last(draws.output)), _last(draws.sensor))
    return Trial(r, jnp.concatenate([y, last[None]]), u, dt, signals)


def _plus(signal, d):
    return signal if d is None else signal + d


def _last(rows):
    return None if rows is None else rows[-1]
