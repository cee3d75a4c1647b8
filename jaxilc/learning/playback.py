"""The signals that a real machine plays in the next trial, and the feedback of a measured trial."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from ..pytree.aliases import Array, Tree, Value
from ..runtime.lanes import over_samples
from ..schemes import Scheme
from ..signals.rows import ahead_of
from ..signals.task import Sample, Task
from .machine import Actuator


def schedules(scheme: Scheme, memory: Tree, task: Task) -> dict[str, np.ndarray]:
    """The signals that the machine plays in the next trial, by name.

    u: (N, n_u) whole input, for a scheme that only plays back [unit of u]
    feedforward: (N, n_u) input that is added to that of the feedback [unit of u]
    reference: (N+1, n_y) reference that the feedback follows in place of that of the task, for a
        scheme that learns a reference [unit of y]
    table.NAME: (N, n) rows of a law that acts within the trial, such as FFDL-MFAILC, which the
        controller must then compute
    feedback.NAME, learning.NAME: the same for a feedback that learns, and for a learning part that
        has a feedback, where its names are those of the feedback

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
def _compiled(scheme: Scheme, memory: Tree, task: Task) -> dict[str, Tree]:
    return scheme.played(scheme.schedule(memory, task), task)


def unit_of(name: str, task: Task) -> str:
    """The unit of a signal or schedule, by its name; an empty text for the weights of a law."""
    of_output = dict.fromkeys(("r", "y", "reference"), task.unit)
    of_input = dict.fromkeys(("u", "u_last", "feedforward", "feedback"), task.input_unit)
    return ({"t": "s"} | of_output | of_input).get(name.rpartition(".")[2], "")


@jax.jit
def replay(
    scheme: Scheme, task: Task, memory: Tree, y: Value, actuator: Actuator | None = None
) -> tuple[Array, dict[str, Array]]:
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

    def tick(carry: Tree, now: Tree) -> tuple[Tree, Tree]:
        (r, seen, y, row), (state, v_last, u_last) = now, carry
        state, u = scheme.act(state, Sample(r, seen, y, row, task.dt, u_last))
        v, u = (u, u) if actuator is None else actuator.apply(u, v_last, task.dt)
        return (state, v, None if actuator is None else u), (u, scheme.signals(state))

    ahead, schedule = ahead_of(r[1:], scheme.preview), scheme.schedule(memory, task)
    rows, rest = (r[:-1], ahead, jnp.asarray(y)[:-1], schedule), jnp.zeros(task.inputs)
    start = (scheme.initial_state(task), rest, None if actuator is None else rest)
    found: tuple[Array, dict[str, Array]] = over_samples(tick, start, rows)[1]
    return found


@jax.jit
def applied(actuator: Actuator, u: Array, dt: float) -> Array:
    """(N, n_u) the input that an actuator at rest applies of a command u (N, n_u) [unit of u]."""
    found: tuple[Array, Array] = over_samples(
        lambda v, now: actuator.apply(now, v, dt), jnp.zeros_like(u[0]), u
    )
    return found[1]
