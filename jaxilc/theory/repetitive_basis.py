"""Basis functions within one long trial: whether their weights converge, by the map of a period.

The loop of machine, feedback and `RepetitiveBasis` is linear, and the functions are those of one
period, so from sample to sample it is x[k+1] = M[k] x[k] + what acts on it, with M the same a
period later. Its product over a period is the monodromy matrix, whose eigenvalues are within the
unit circle if and only if all comes to its limit exponentially (Floquet; Bittanti, Colaneri 2009,
ch. 3). Where `keep` is 1, what the functions hold of a disturbance at the input is then removed: w
is its negative. Harmonics hold what acts anywhere, since a linear loop makes of each the same one.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from ..learning.machine import Machine
from ..plants.position import Harmonics
from ..pytree.in_short import in_short
from ..schemes import RepetitiveBasis, Scheme, WithFeedback
from ..schemes.repetitive import BEFORE
from ..signals.task import Task
from ..uncertainty import Population, drawn_machines
from .condition import Condition, condition, premise
from .frequency import of_poles, reduced
from .learning_map import limit_names
from .linearity import invariant_loop
from .loop import Loop
from .outlook import NO_LIMIT
from .repetitive import members, worst_of

PERIODS, WHOLE = 64, 1e-6  # periods that are tried for a whole number of samples, and what is whole
MOST, AT_ONCE = 2**17, 2**10  # samples of these periods, and maps that are multiplied at once
OF_PERIOD = (
    "the largest |eigenvalue| of the map of a period is below 1: the weights and the error come to "
    "their limit, nearer by this factor in the long run in every period (Floquet)"
)


class PeriodTest(NamedTuple):
    """What basis functions within one trial promise.

    condition: the largest |eigenvalue| of the map of one period, below 1; of a family that of its
        worst machine
    period: of the functions [s]
    at: the numbers of the worst machine of a family, by name
    """

    condition: Condition
    period: float
    at: dict[str, float]

    def __repr__(self) -> str:
        return in_short(self)


def basis_condition(machine: Machine | Population, scheme: Scheme, task: Task) -> PeriodTest:
    """Whether the weights of a `RepetitiveBasis` beside a feedback converge.

    machine: one, or a `Population`, for the worst of those that are drawn
    scheme: `WithFeedback(RepetitiveBasis(...), feedback)`, or a `RepetitiveBasis` alone

    Raises ValueError for another scheme, for functions of an angle, which follow the motion, for a
    period of which no 64 make a whole number of samples, for more than 2^17 of these samples, and
    where machine, scheme and task do not fit.
    """
    basis, feedback = basis_of(scheme)
    if basis is None or basis.angle is not None:
        what = type(scheme).__name__ if basis is None else "RepetitiveBasis of an angle"
        raise ValueError(
            f"basis_condition: scheme is a {what}; allowed are a RepetitiveBasis of the time and "
            "WithFeedback(RepetitiveBasis(...), feedback)"
        )
    basis.check(task)
    functions = basis.functions
    period = float(
        functions.pitch if isinstance(functions, Harmonics) else functions.high - functions.low
    )
    count, samples = _whole(period / float(task.dt))
    machines, drawn = members(machine)
    plays, learns, ends = _of_samples(basis, samples, float(task.dt), period)
    parts, found = np.array_split(np.arange(samples), -(-samples // AT_ONCE)), []
    names = limit_names(drawn_machines(machines[0], {}, {}), scheme, task)  # and of all others
    for one in machines:
        loop = reduced(one, feedback, task)
        premises = (
            invariant_loop(one, feedback, task),
            of_poles([loop]),
            premise(NO_LIMIT, not names, ", ".join(names)),
        )
        maps = (
            _maps(loop, plays[k], learns[k], ends[k], float(basis.keep), basis.by_period)
            for k in parts
        )
        product = functools.reduce(lambda before, of: of @ before, map(_product, maps))
        radius = float(np.max(np.abs(np.linalg.eigvals(product)))) ** (1 / count)
        found.append(condition(radius, OF_PERIOD, premises=premises))
    top = worst_of(found)
    return PeriodTest(found[top], period, {name: float(of[top]) for name, of in drawn.items()})


def basis_of(scheme: Scheme) -> tuple[RepetitiveBasis | None, Scheme | None]:
    """The `RepetitiveBasis` of a scheme, and the feedback beside it; None without one."""
    if isinstance(scheme, WithFeedback) and isinstance(scheme.learning, RepetitiveBasis):
        return scheme.learning, scheme.feedback
    return (scheme, None) if isinstance(scheme, RepetitiveBasis) else (None, None)


def _whole(samples: float) -> tuple[int, int]:
    """The smallest number of periods that take a whole number of samples, and that number."""
    for count in range(1, PERIODS + 1):
        total = count * samples
        if abs(total - round(total)) <= WHOLE:
            if total > MOST:
                raise ValueError(
                    f"basis_condition: {count} periods of {samples:g} samples take {total:,.0f}; "
                    f"allowed are {MOST:,}"
                )
            return count, round(total)
    raise ValueError(
        f"basis_condition: the period is {samples:.9g} samples; allowed is one of which up to "
        f"{PERIODS} make a whole number"
    )


def _of_samples(
    basis: RepetitiveBasis, samples: int, dt: float, period: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(K, m) what each function plays and learns by, and (K,) whether a period has ended there."""
    t = jnp.arange(samples) * dt
    plays = np.asarray(basis.functions.at(t))
    lead = jnp.broadcast_to(basis.lead, plays.shape[1])
    each = [basis.functions.at(t - one)[:, i] for i, one in enumerate(lead)]
    turn = np.floor(np.arange(-1, samples) * dt / period + BEFORE)
    return plays, np.asarray(basis.gain * jnp.stack(each, axis=1)), np.diff(turn) > 0


def _maps(
    loop: Loop, plays: np.ndarray, learns: np.ndarray, ends: np.ndarray, keep: float, late: bool
) -> np.ndarray:
    """(K, s, s) maps of a sample, of the state of the loop, the weights and what they wait for."""
    (A, B, C), (K, m) = (np.asarray(part) for part in loop), plays.shape
    n, size = len(A), m * B.shape[1]
    channels = np.eye(B.shape[1])
    u = np.einsum("km,ij->kimj", plays, channels).reshape(K, -1, size)
    change = np.einsum("km,ij->kmij", learns, channels).reshape(K, size, -1) @ -C
    x, w, waits = slice(0, n), slice(n, n + size), slice(n + size, n + 2 * size)
    M = np.zeros((K, n + 2 * size, n + 2 * size))
    M[:, x, x], M[:, x, w] = A, B @ u
    M[:, w, w] = np.eye(size)
    if not late:
        M[:, w, w], M[:, w, x] = keep * np.eye(size), change
        return M
    M[:, waits, waits], M[:, waits, x] = np.eye(size), change
    ended = np.eye(n + 2 * size)
    ended[w, w], ended[w, waits], ended[waits, waits] = keep * np.eye(size), np.eye(size), 0.0
    return np.where(ends[:, None, None], M @ ended, M)


def _product(maps: np.ndarray) -> np.ndarray:
    """(s, s) the maps one after the other, the first of them first."""
    while len(maps) > 1:
        rest = maps[len(maps) - len(maps) % 2 :]
        maps = np.concatenate([maps[1::2] @ maps[: 2 * (len(maps) // 2) : 2], rest])
    return maps[0]
