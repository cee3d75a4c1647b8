"""The output of experiments that start from rest, as records hold it."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from ..learning.machine import Machine
from ..signals.task import Task
from .records import Record, played


def output_from_rest(machine: Machine, task: Task, u) -> jax.Array:
    """(T (N+1), n_y) the outputs of T experiments below each other, each from rest, without noise.

    task: task of one experiment
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
