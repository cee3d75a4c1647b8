"""What a real machine plays of a scheme in the next trial, and what the scheme's feedback did in a
measured one.
"""

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
    """What the machine plays in the next trial, by name; each (N, n), but `reference` (N+1, n).

    u: the whole input, of a scheme that only plays back
    feedforward: what is added to the input of the feedback
    reference: what the feedback follows in place of the task's reference, of a scheme that learns
        one
    table.NAME: rows of a law that acts within the trial, such as FFDL-MFAILC, which the controller
        must then run
    feedback.NAME: the same of a feedback that learns

    Each scheme says what it plays, see `Scheme.played`.
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
    """The unit of a signal or schedule, by its name; none for the weights of a law."""
    last = name.rpartition(".")[2]
    if last in ("r", "y", "reference"):
        return task.unit
    return {"t": "s"}.get(
        last, task.input_unit if last in ("u", "u_last", "feedforward", "feedback") else ""
    )


@jax.jit
def replay(scheme: Scheme, task: Task, memory, y, actuator: Actuator | None = None):
    """The scheme's `act` over a measured output: its input (N, n_u), as the actuator would have
    applied it, and its signals by name.

    y: (N+1, n_y) measured;  memory: of the trial in which it was measured
    `act` sees nothing of the machine but y, so this is what the feedback contributed in that trial,
    exactly, wherever the controller runs the same law on the same samples. A feedback that is not
    the scheme's, such as a drive's own loops, belongs to the machine.
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
