"""The closed loop of a machine and a linear feedback as a system of python-control."""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import numpy as np

from ..learning.machine import Machine
from ..plants.to_python_control import as_system
from ..schemes import Scheme
from ..signals.task import Task
from .linearity import invariant_loop
from .loop import tick_of

if TYPE_CHECKING:
    import control


def to_control(machine: Machine, scheme: Scheme | None, task: Task) -> control.StateSpace:
    """The `control.StateSpace` from what is learned and from the reference to the output.

        x[k+1] = A x[k] + B_w w[k] + B_r r[k+L],    y[k] = C x[k]

    The inputs are `learned[i]`, the signal w that the scheme learns and plays back, and then the
    reference, `reference[i]`. Under a scheme that learns nothing, or without a scheme, w is an
    input on top of what the scheme commands; under `OnReference` it corrects the reference. The
    outputs are `y[i]`, as the sensors measure them.

    L is the number of samples that the feedback really looks ahead in the reference, so that row k
    of that input is r[k+L]. For L > 0 the input is called `reference_ahead_L[i]`, and the last
    states of the system hold r[k], ..., r[k+L-1].

    It is the simulator's own sample, so the sample time is that of the task. Noise and disturbances
    are no part of it. Nor are the limits of actuator and scheme, which change nothing as long as
    none is met; `theory.outlook` tells whether one is. The state at the start of a trial is
    `theory.to_python_control.initial_state`.

    machine, scheme, task: as for `jaxilc.learn`; None is the machine alone
    Raises ValueError for a machine or a feedback that is not linear, naming which and by what, and
    as `theory.loop.tick_of` does.
    """
    linear = invariant_loop(machine, scheme, task)
    if not linear.held:
        raise ValueError(f"to_control: the loop is not linear: {linear.detail}")
    A, B_w, of_reference, C, _ = _linearised(machine, scheme, task)
    L = len(of_reference) - 1
    A, B_r, C = _with_reference_held(A, of_reference, C)
    B_w = np.vstack([B_w, np.zeros((len(A) - len(B_w), B_w.shape[1]))])
    reference = f"reference_ahead_{L}" if L else "reference"
    return as_system(
        A,
        np.hstack([B_w, B_r]),
        C,
        task.dt,
        inputs=_numbered("learned", B_w) + _numbered(reference, B_r),
        outputs=_numbered("y", C.T),
    )


def initial_state(machine: Machine, scheme: Scheme | None, task: Task) -> np.ndarray:
    """(n,) the state that the system of `to_control` has at the start of a trial of the task.

    It is `X0` of `forced_response`. The plant starts at its initial state, and the feedback may
    start from the task's reference, as `PID` with velocity feedforward does.
    """
    *_, of_reference, _, x0 = _linearised(machine, scheme, task)
    held = np.asarray(task.reference)[: len(of_reference) - 1]
    return np.concatenate([x0, held.reshape(-1)])


def _linearised(machine: Machine, scheme: Scheme | None, task: Task):
    """A (n, n), B_w (n, n_w), L + 1 matrices (n, n_y) of r[k], ..., r[k+L], C (n_y, n), x0 (n,)."""
    machine = machine.unlimited()
    scheme = None if scheme is None else scheme.unlimited()
    tick, fixed, rest = tick_of(machine, scheme, task)

    def following(x, w, r, ahead):
        return tick(fixed, rest._replace(x=x, w=w, r=r, ahead=ahead))[0]

    slopes = jax.jit(jax.jacfwd(following, (0, 1, 2, 3)))(rest.x, rest.w, rest.r, rest.ahead)
    C = jax.jit(jax.jacfwd(lambda x: tick(fixed, rest._replace(x=x))[1]))(rest.x)
    A, B_w, B_now, B_ahead = (np.asarray(slope, float) for slope in slopes)
    of_reference = [B_now, *(B_ahead[:, i] for i in range(B_ahead.shape[1]))]
    L = max((i for i, B in enumerate(of_reference) if np.any(B)), default=0)
    return A, B_w, of_reference[: L + 1], np.asarray(C, float), np.asarray(rest.x, float)


def _with_reference_held(A, of_reference: list[np.ndarray], C):
    """A, B_r and C with states that hold r[k], ..., r[k+L-1], where the input is r[k+L].

    of_reference: L + 1 matrices (n, n_y), how x[k+1] depends on r[k], ..., r[k+L]
    """
    *held, last = of_reference
    n, n_y, width = len(A), last.shape[1], sum(B.shape[1] for B in held)
    shift = np.eye(width, k=n_y)
    A = np.block([[A, np.hstack([*held, np.zeros((n, 0))])], [np.zeros((width, n)), shift]])
    B_r = np.vstack([last, np.eye(width, n_y, k=n_y - width)])
    return A, B_r, np.hstack([C, np.zeros((len(C), width))])


def _numbered(name: str, columns) -> list[str]:
    return [f"{name}[{i}]" for i in range(columns.shape[1])]
