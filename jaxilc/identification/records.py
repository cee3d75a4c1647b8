"""Recorded experiments, as a machine plays them; `record_files` reads them from files."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..learning.machine import Machine
from ..learning.within_trial import run_trial
from ..plants import Plant
from ..pytree.in_short import in_short
from ..schemes import Scheme
from ..schemes.scheme import Feedforward
from ..signals.task import Task, Trial


class Record(NamedTuple):
    """The record of an experiment.

    u: (N, n_u) input, held over each sample
    y: (N+1, n_y) output; y[0] is measured before u[0] acts
    dt: sample time [s]
    trials: number T of experiments of equal length, each from rest, that stand below each other; u
        is then (T N, n_u) and y (T (N+1), n_y)
    """

    u: jax.Array | np.ndarray
    y: jax.Array | np.ndarray
    dt: float
    trials: int = 1
    __repr__ = in_short


def excite(machine: Machine, u, dt: float, *, key: jax.Array | None = None) -> Record:
    """Run an open-loop experiment: the machine plays u from rest, its encoder records the output.

    The record holds the input as the actuator applied it, with limits and converter. A disturbance
    at the input is not recorded, as on a real machine.

    u: (N, n_u) or (N,), for instance `references.m_sequence`
    dt: sample time [s]
    key: key of the noise, None for a fixed one; may be batched by `vmap`
    Raises ValueError for an input that is not finite or does not fit the plant.
    """
    u = as_columns("excite", "u", u)
    task = task_of(machine.plant, u, dt)
    machine.check(task)
    trial = played(machine, task, u, jax.random.key(0) if key is None else key)
    return Record(trial.u, trial.y, dt)


def as_columns(function, name, values) -> np.ndarray:
    """The values as (rows, channels); raises ValueError where they are not finite."""
    values = np.asarray(values, dtype=float)
    values = values[:, None] if values.ndim == 1 else values
    if values.ndim != 2:
        raise ValueError(
            f"{function}: {name} has shape {values.shape}; allowed are (rows,) and (rows, channels)"
        )
    if not np.all(np.isfinite(values)):
        k = int(np.argmin(np.isfinite(values).all(axis=1)))
        raise ValueError(f"{function}: {name} is not finite at sample {k}")
    return values


def task_of(plant: Plant, u, dt: float) -> Task:
    """The task of an experiment: its length and sample time, with a reference of zero."""
    return Task(np.zeros((len(u) + 1, plant.n_y)), dt=dt, inputs=u.shape[1])


@jax.jit
def played(machine: Machine, task: Task, u, key) -> Trial:
    """The trial that plays u back; the plain Scheme has only its feedforward."""
    return run_trial(machine, Scheme(), task, Feedforward(u), key)


def output_from_rest(machine: Machine, task: Task, u) -> jax.Array:
    """(T (N+1), n_y) the outputs of T experiments below each other, each from rest, without noise.

    u: (T N, n_u) inputs of the experiments below each other
    """
    key = jax.random.key(0)
    if len(u) == task.N:
        return played(machine, task, u, key).y
    of_each = jnp.reshape(jnp.asarray(u), (-1, task.N, u.shape[1]))
    y = jax.vmap(lambda one: played(machine, task, one, key).y)(of_each)
    return y.reshape(-1, y.shape[2])


def first_of(record: Record):
    """(N, n_u) the input of the first experiment of a record."""
    return record.u[: len(record.u) // record.trials]


def delayed(signal: np.ndarray, by: int) -> np.ndarray:
    """A signal (..., N), later by some samples, from rest."""
    moved = np.zeros_like(signal)
    moved[..., by:] = signal[..., : signal.shape[-1] - by]
    return moved
