"""What a trial tells of the parameters of a basis, such as the bins of a map over the position.

A parameter is learned where its function is excited: a map over the position where the motion
visits the bin. By X, what the model makes of each function, and G = X' W_q X of the scaled columns,
a combination of parameters that G does not see is not learned in this trial; all others are. The
learning map theta_{j+1} = F(theta_j) is that of the simulator itself, so its derivative holds for
any machine, linear or not, near the parameters where it is taken.
"""

from __future__ import annotations

from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np

from ..learning.machine import Machine
from ..learning.over_trials import check
from ..pytree.in_short import in_short
from ..schemes import BasisFunctions, Scheme, WithFeedback
from ..schemes.bases import pushed
from ..schemes.basis_functions import Parameters
from ..schemes.gradient import answers
from ..schemes.quadratic_cost import weights_of
from ..schemes.scheme import Memory
from ..signals.task import Task
from .linearity import alike_trials
from .trials import step

TOLD = 1e-8  # share of the largest eigenvalue of the scaled G, above which a trial tells


class Visits(NamedTuple):
    """What one trial tells of each parameter.

    names: (m,) of the parameters
    seconds: (m,) how long the function acts in the trial, sum |f| / max |f| dt [s]
    doubt: (m,) standard error of the parameter after one trial, per unit of white noise of the
        output; inf where the trial does not tell it
    told: (m,) whether the trial tells the parameter
    rate: largest |eigenvalue| of the derivative of learning, in all that the trial tells: below 1
        these parameters converge from near by. In all there is, where what the trial does not tell
        is moved, too, and moves the rest on a machine that is not the model. NaN where nothing is
        told
    """

    names: tuple[str, ...]
    seconds: np.ndarray
    doubt: np.ndarray
    told: np.ndarray
    rate: float
    __repr__ = in_short


def visits(machine: Machine, scheme: Scheme, task: Task, *, memory: Memory = None) -> Visits:
    """Which parameters of a basis learning finds on this motion, and how fast.

    scheme: `BasisFunctions` with a basis that is linear in theta, alone or beside a feedback that
        does not learn
    memory: where the derivative of learning is taken; None: before the first trial

    What changes is taken as after its last change. Raises ValueError for another scheme, where
    machine, scheme and task do not fit, and for a machine whose trials do not start alike, or are
    not learned from alike.
    """
    law = scheme.learning if isinstance(scheme, WithFeedback) else scheme
    if not isinstance(law, BasisFunctions) or not law.basis.linear:
        raise ValueError(
            f"visits: scheme is a {type(law).__name__}; allowed are BasisFunctions with a basis "
            "that is linear in theta, and WithFeedback(BasisFunctions(...), feedback)"
        )
    if isinstance(scheme, WithFeedback) and scheme.feedback.learns:
        raise ValueError(
            f"visits: the feedback, a {type(scheme.feedback).__name__}, learns too, which moves "
            "the parameters; allowed is one that does not"
        )
    check(machine, scheme, task)
    alike = alike_trials(machine, scheme, task)
    if not alike.held:
        raise ValueError(f"visits: {alike.detail}")
    task = machine.at_trial(task, None)[1]
    memory = scheme.initial_memory(task) if memory is None else memory
    columns, X, Q, M = (np.asarray(a) for a in _seen(machine, scheme, task, memory))
    size = np.max(np.abs(columns), axis=(0, 1))
    seconds = np.sum(np.abs(columns), axis=(0, 1)) / np.where(size > 0, size, 1.0) * task.dt

    G = np.einsum("kim,ij,kjn->mn", X, Q, X)
    s = np.sqrt(np.diag(G))
    s = np.where(s > 0, s, 1.0)
    values, V = np.linalg.eigh(G / np.outer(s, s))
    seen = values > TOLD * max(values[-1], 1e-300)
    hidden = V[:, ~seen]
    told = np.sum(hidden**2, axis=1) < TOLD**0.5
    inverse = (V[:, seen] / values[seen]) @ V[:, seen].T / np.outer(s, s)
    QX = np.einsum("ij,kjm->kim", Q, X)
    doubt = np.sqrt(np.diag(inverse @ np.einsum("kim,kin->mn", QX, QX) @ inverse))
    rate = np.nan
    if np.any(seen):
        moved = V.T @ (M * np.outer(s, 1 / s)) @ V
        across = np.abs(moved[~seen][:, seen]), np.abs(moved[seen][:, ~seen])
        if min(np.max(x, initial=0.0) for x in across) <= TOLD**0.5:
            moved = moved[seen][:, seen]
        rate = float(np.max(np.abs(np.linalg.eigvals(moved))))
    names = law.basis.names(task.outputs, task.inputs)
    return Visits(names, seconds, np.where(told, doubt, np.inf), told, rate)


@jax.jit
def _seen(machine: Machine, scheme: Scheme, task: Task, memory: Memory):
    """The functions, what the model makes of them, the weight of the error, and dF / dtheta."""
    machine, scheme = machine.unlimited().sampled(task.dt), scheme.unlimited().prepared(task)
    beside = isinstance(scheme, WithFeedback)
    law = cast(BasisFunctions, scheme.learning if isinstance(scheme, WithFeedback) else scheme)
    own = memory.learning if beside else memory

    def following(theta):
        known = Parameters(theta)
        new = step(machine, scheme, task, memory._replace(learning=known) if beside else known)
        return (new.learning if beside else new).theta

    r = jnp.asarray(task.reference)
    columns = law.basis.columns(r, task.dt, task.inputs)
    push, _ = answers(law.model, jnp.zeros((task.N, task.inputs)), task.dt)
    Q = weights_of(law, "w_q")[0]
    told = law.basis.seen(r, task.dt, task.inputs)
    return columns, told * pushed(push, columns), Q, jax.jacfwd(following)(own.theta)
