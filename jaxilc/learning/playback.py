"""The signals that a real machine plays in the next trial, and the feedback of a measured trial."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ..schemes import Scheme
from ..signals.task import Sample, Task
from .machine import Actuator


def schedules(scheme: Scheme, memory, task: Task) -> dict[str, np.ndarray]:
    """The signals that the machine plays in the next trial, by name.

    u: (N, n_u) whole input, for a scheme that only plays back [unit of u]
    feedforward: (N, n_u) input that is added to that of the feedback [unit of u]
    reference: (N+1, n_y) reference that the feedback follows in place of that of the task, for a
        scheme that learns a reference [unit of y]
    table.NAME: (N, n) rows of a law that acts within the trial, such as FFDL-MFAILC, which the
        controller must then compute
    feedback.NAME: the same for a feedback that learns

    Each scheme declares what it plays, see `Scheme.played`.
    Raises ValueError for a scheme that learns nothing.
    """
    found = _compiled(scheme, memory, task)
    if not scheme.learns or not found:
        raise ValueError(
            f"{type(scheme).__name__} learns nothing that a machine could play; allowed are "
            "schemes that learn"
        )
    return {
        name: np.asarray(values, float).reshape(len(values), -1) for name, values in found.items()
    }


@jax.jit
def _compiled(scheme: Scheme, memory, task: Task) -> dict[str, Any]:
    return scheme.played(scheme.schedule(memory, task), task)


def unit_of(name: str, task: Task) -> str:
    """The unit of a signal or schedule, by its name; an empty text for the weights of a law."""
    last = name.rpartition(".")[2]
    if last in ("r", "y", "reference"):
        return task.unit
    return {"t": "s"}.get(
        last, task.input_unit if last in ("u", "u_last", "feedforward", "feedback") else ""
    )


@jax.jit
def replay(scheme: Scheme, task: Task, memory, y, actuator: Actuator | None = None):
    """The input and the signals of a scheme, computed from a measured output.

    The input (N, n_u) is that which the actuator would have applied. The signals are by name.

    memory: memory of the trial in which y was measured
    y: (N+1, n_y) measured output [unit of y]
    actuator: actuator of the machine; None: the command is applied as it is

    Of the signals of the machine `act` sees only y. So this is exactly what the feedback
    contributed in that trial, if the controller computes the same law on the same samples. A
    feedback that is not part of the scheme, such as the loops of a drive, belongs to the machine.
    """
    scheme = scheme.prepared(task)
    r = jnp.asarray(task.reference)
    future = jnp.pad(r[1:], ((0, scheme.preview - 1), (0, 0)), mode="edge")
    windows = jnp.stack([future[i : i + task.N] for i in range(scheme.preview)], axis=1)

    def tick(carry, now):
        state, v_last, u_last = carry
        state, u = scheme.act(state, Sample(*now, task.dt, u_last))
        v, u = (u, u) if actuator is None else actuator.apply(u, v_last, task.dt)
        return (state, v, None if actuator is None else u), (u, scheme.signals(state))

    rows, rest = (
        (r[:-1], windows, jnp.asarray(y)[:-1], scheme.schedule(memory, task)),
        jnp.zeros(task.inputs),
    )
    start = (scheme.initial_state(task), rest, None if actuator is None else rest)
    return lax.scan(tick, start, rows, length=task.N)[1]
