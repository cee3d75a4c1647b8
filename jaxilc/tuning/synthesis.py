"""Filters of a learning law by convex optimisation, on the lines of a frequency response.

The law u_{j+1} = Q u_j + M e_j has the taps of Q, symmetric, and of M = Q L. On each line k and for
each plant P_k, known to within s_k,

    |Q - M P_k| + |M| s_k <= t <= 1 - margin

is a second-order cone in all taps together, so that the best taps are found for certain. What is
minimised is the loss of bandwidth, with what learning leaves in a trial and what it amplifies

    sum_band w (|1 - Q| + speed t) + sum_above w |Q| + effort sum w |M| |P|_median

where w shares the frequencies out evenly. Q is 1 at rest, and flat there, 1 - Q = O(f^4), as that
of a Butterworth filter of order 2 is, since slow errors are the largest. Q = 1 leaves no repeated
error; |Q - M P| is the share of an error that is left in each trial. CVXPY with Clarabel solves it:
the extra `synthesis`.

Lines above the last one of a record are not measured. There |Q| + |M| |P_last| <= 1 - margin is
asked for, which is enough if the plant is nowhere larger than at its last line.
"""

from __future__ import annotations

from collections.abc import Sequence
from types import ModuleType
from typing import NamedTuple

import numpy as np

from ..pytree.ranges import require
from ..schemes import LearningFilter
from ..theory.on_lines import Lines

SPEED = 0.1  # weight of what a trial leaves against what is never learned
EFFORT = 1e-2  # weight of the size of M, against noise
SPARE = 1e-3  # of the margin, kept for what lies between the lines
ROUNDS = 6  # in which plants that were left out and do not keep the margin are added
ADDED = 4  # of them in each round
FILLED = 60  # lines that are added above the last one of a record
MISSING = 'cvxpy with clarabel is needed for the synthesis: pip install "jaxilc[synthesis]"'


class Synthesis(NamedTuple):
    """Filters that were found.

    scheme: the law, to be simulated and certified
    peak:   largest |Q - M P| + |M| s on the lines it was found on
    loss:   mean |1 - Q| over the band
    band:   [Hz] up to which Q = 1 was wanted
    spacing: largest distance of two lines, in units of 1 / (duration of the taps)
    """

    scheme: LearningFilter
    peak: float
    loss: float
    band: float
    spacing: float


def synthesised(
    several: Sequence[Lines],
    *,
    band: float,
    margin: float = 0.1,
    taps: int = 41,
    lead: int = 0,
    speed: float = SPEED,
    effort: float = EFFORT,
) -> Synthesis:
    """The filters Q and M of an odd number of taps each, for all plants on all lines.

    several: responses and scatter of the plants; their law is not read. Of many plants those are
             taken that decide, a few more in each round, until all keep the margin
    band:    [Hz] up to which errors shall be learned
    lead:    samples of look-ahead of the middle tap of M, beyond the one from u[k] to y[k+1]

    Raises ValueError for a number outside its range, where no filters keep the margin, and for a
    missing extra with the command that installs it.
    """
    dt, nyquist = several[0].dt, 0.5 / several[0].dt
    require("synthesis", "margin", margin, "(0, 1)")
    need_taps(taps)
    require("synthesis", "lead", lead, "[0, inf)", whole=True)
    within, note = f"({several[0].f[0]}, {nyquist}]", ", from the first line to Nyquist"
    require("synthesis", "band", band, within, " Hz", note=note)
    allowed = (1 - margin) - SPARE
    chosen = [_first_and_extreme(one) for one in several]
    for _ in range(ROUNDS):
        lines = [_filled(_of(one, i)) for one, i in zip(several, chosen, strict=True)]
        q, m = _solved(lines, band, allowed, taps // 2, lead, speed, effort)
        missed = [_missed(_sizes(one, q, m, lead)[1], 1 - margin) for one in several]
        if not any(missed):
            break
        chosen = [sorted({*i, *more}) for i, more in zip(chosen, missed, strict=True)]
    scheme = LearningFilter(m, keep=np.r_[q[:0:-1], q], lead=lead, dt=dt)
    of_lines = [_sizes(one, q, m, lead) for one in several]
    peak = max(float(np.max(size)) for _, size in of_lines)
    Q, f = of_lines[0][0], several[0].f
    loss = float(np.mean(np.abs(1 - Q[f <= band])))
    spacing = max(float(np.max(np.diff(one.f))) * taps * dt for one in several)
    return Synthesis(scheme, peak, loss, band, spacing)


def need_taps(taps: int) -> None:
    """Raises ValueError for a number of taps that filters cannot have."""
    require("synthesis", "taps", taps, "[3, 501]", whole=True)
    if taps % 2 == 0:
        raise ValueError(f"synthesis: taps = {taps} is even; allowed are odd numbers")


def need_solver() -> ModuleType:
    """CVXPY. Raises ValueError, naming the command that installs it, where it is missing."""
    try:
        import cvxpy
    except ImportError:
        raise ValueError(MISSING) from None
    if "CLARABEL" not in cvxpy.installed_solvers():
        raise ValueError(MISSING)
    return cvxpy


# How it is done
# --------------------------------------------------------------------------------------------------


def _solved(lines: Sequence[Lines], band, allowed, reach: int, lead: int, speed, effort):
    """The taps q (reach + 1,), middle first, and m (2 reach + 1,), as `LearningFilter` has them."""
    cp = need_solver()
    q, m = cp.Variable(reach + 1), cp.Variable(2 * reach + 1)
    even = np.arange(reach + 1) ** 2
    loss, constraints = 0, [q[0] + 2 * cp.sum(q[1:]) == 1, even @ q == 0]
    for one in lines:
        C, E = _cosines(one, reach), _powers(one, reach, lead)
        Q, M = C @ q, [E.real @ m, E.imag @ m]
        t, size_of_m = cp.Variable(len(one.f)), cp.Variable(len(one.f))
        constraints += [cp.norm(cp.vstack(M), 2, axis=0) <= size_of_m]
        constraints += [t <= allowed, Q <= 1, Q >= 0]
        for P, s in zip(one.P, one.scatter, strict=True):
            R = E * P[:, None]
            left = cp.norm(cp.vstack([Q - R.real @ m, R.imag @ m]), 2, axis=0)
            constraints += [left + cp.multiply(s, size_of_m) <= t]
        w = np.gradient(one.f) / np.sum(np.gradient(one.f))
        within = one.f <= band
        loss += w[within] @ (cp.abs(1 - Q[within]) + speed * t[within])
        loss += effort * (w * np.median(np.abs(one.P), axis=0)) @ size_of_m
        if not np.all(within):
            loss += w[~within] @ cp.abs(Q[~within])
    problem = cp.Problem(cp.Minimize(loss), constraints)
    problem.solve(solver=cp.CLARABEL)
    if problem.status not in ("optimal", "optimal_inaccurate"):
        raise ValueError(
            f"synthesis: no filters of {2 * reach + 1} taps keep |Q (1 - L P)| <= {allowed:.3g} on "
            f"every line ({problem.status}); a smaller --margin, more --taps or a smaller spread "
            "may"
        )
    return np.asarray(q.value), np.asarray(m.value)


def _of(one: Lines, plants: Sequence[int]) -> Lines:
    """The lines of some of the plants."""
    return one._replace(P=one.P[plants], scatter=one.scatter[plants])


def _first_and_extreme(one: Lines) -> list[int]:
    """The nominal plant, and those with the largest and least response at some line."""
    size = np.abs(one.P)
    return sorted({0, int(np.argmax(np.max(size, axis=1))), int(np.argmin(np.min(size, axis=1)))})


def _missed(sizes, allowed: float) -> list[int]:
    """The plants that keep the margin least, of those that do not keep it."""
    peaks = np.max(sizes, axis=1)
    return [int(i) for i in np.argsort(-peaks)[:ADDED] if peaks[i] > allowed]


def _filled(one: Lines) -> Lines:
    """The lines with further ones up to Nyquist, on which Q alone and M P_last count as scatter."""
    nyquist, last = 0.5 / one.dt, float(one.f[-1])
    if last >= nyquist * (1 - 1e-3):
        return one
    f = np.linspace(last, nyquist, FILLED + 1)[1:]
    P = np.concatenate([one.P, np.zeros((len(one.P), FILLED))], axis=1)
    size = np.abs(one.P[:, -1:]) + one.scatter[:, -1:]
    scatter = np.concatenate([one.scatter, np.repeat(size, FILLED, axis=1)], axis=1)
    more = np.ones(FILLED, complex)
    return Lines(np.r_[one.f, f], P, scatter, np.r_[one.keep, more], np.r_[one.L, more], one.dt)


def _sizes(one: Lines, q, m, lead: int):
    """Q (F,), and |Q - M P| + |M| s (S, F)."""
    Q = _cosines(one, len(q) - 1) @ q
    M = _powers(one, len(m) // 2, lead) @ m
    return Q, np.abs(Q - M * one.P) + np.abs(M) * one.scatter


def _cosines(one: Lines, reach: int) -> np.ndarray:
    """(F, reach + 1) so that Q = C q with q_0 in the middle."""
    angle = 2 * np.pi * one.f * one.dt
    C = 2 * np.cos(np.multiply.outer(angle, np.arange(reach + 1)))
    C[:, 0] = 1.0
    return C


def _powers(one: Lines, reach: int, lead: int) -> np.ndarray:
    """(F, 2 reach + 1) z^(1 + lead + i - reach)."""
    angle = 2 * np.pi * one.f * one.dt
    return np.exp(1j * np.multiply.outer(angle, 1 + lead + np.arange(2 * reach + 1) - reach))
