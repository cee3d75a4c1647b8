"""What holds for single runs where trials differ by chance.

The record that reaches the law is drawn for each trial (`Variation`), so learning is a product of
random maps,

    w_{j+1} = M_j w_j + c_j,    M_j = A - L P_j H_j Y

with A, L and Y of the law and the machine, and P_j, H_j of `RecordMoments`. That E[M] contracts
says nothing of a run: M = 1 - 2.2 b with b = 0 or 1, and E[b] = 0.8, has the mean -0.76, and its
products grow in every run. What does hold for single runs is claimed, in one of these senses:

    for every draw   ||M|| < 1 for the worst of all that can be drawn
    in mean square   E|w_j - w'_j|^2 of two runs with the same draws falls to zero: the operator
                     T(X) = E[M X M^T] contracts. It keeps positive matrices positive, so it does if
                     some Z > 0 shrinks under its adjoint, T*(Z) < Z; then E|d_j|^2_Z falls in every
                     trial, for Z = I the distance itself. E[M (x) M] is never formed. The squares
                     of what a run leaves have then a finite mean: X = T(X) + C
    almost surely    each run forgets its start, since its Lyapunov exponent is negative; single
                     trials may stray so far that their squares have no mean. Where every M is
                     triangular in one order of the samples the exponent is exact,
                     max_i E log|M_ii|. Otherwise it is at most E log||M_k ... M_1|| / k, for which
                     drawn products give an interval
    in the mean      only the mean of all runs converges, and nothing is claimed of a run

Runs diverge almost surely where that exponent is exact and positive, or where a part of w is pushed
alike in every trial by errors that do not depend on w: w_j / j comes to the mean push, however low
the error was before. Where the mean of all runs diverges, their mean square does.

Noise of sensors and of disturbances, and the scatter of the initial state, add to C. Where nothing
else is drawn, M is the same in every trial, and the error of a late trial is Gaussian with a mean m
and the covariance S = Y X Y^T + F F^T. So of the mean square Q of its samples, with the eigenvalues
l_i of S and a_i of m along them, each over their number, E exp(s Q) is known and with it, by
Chernoff's bound,

    P[Q > q] <= p,    q = min_s (log E exp(s Q) - log p) / s,    0 < s < 1 / (2 max l)
    log E exp(s Q) = sum_i (s a_i^2 / (1 - 2 s l_i) - log(1 - 2 s l_i) / 2)

which is never above the bound of Laurent and Massart (Ann. Stat. 28, 2000, lemma 1), that follows
from it. Else only the mean of Q is known, and by Markov's inequality q = E[Q] / p.
"""

from __future__ import annotations

import dataclasses
import itertools
from functools import lru_cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jax.flatten_util import ravel_pytree

from ..learning.machine import Machine
from ..learning.variation import Variation
from ..pytree.in_short import in_short
from ..runtime.tiles import tiled_with
from ..schemes import Scheme
from ..signals.task import Task
from .condition import CONVERGES, DIVERGES, MONOTONE, NOT_CLAIMED, ROUNDING
from .learning_map import MOST, View, alone, count_of, first_of, learning_of, slopes
from .spectrum import drifting, norm_of, reachable, triangular_radius
from .trials import disturbed


class RecordMoments(NamedTuple):
    """First and second moments of the record of a trial, over what is drawn of it.

    A trial has the output y, of K = N + 1 rows. The record that reaches the law has the error

        e' = P (r - H y)

    H holds back what comes late (`late`, `delayed`), and P is 0 where a sample was lost (`dropped`)
    or the trial has ended (`shortest`); both are drawn for each trial, and H y keeps y[0] at its
    start. E[H], E[H Y H^T] and E[p_k p_l] are exact here, for any matrix Y.

    kept: (K,) chance of each sample to be in the record
    counted: (K,) share of each sample in the mean square error of a trial, in the mean
    both: (K, K) chance of two samples to be in it together
    held: (K, K) E[H]
    late: largest delay of the record as a whole, in samples
    delays: of samples that come late by themselves, E[H] (K, K), and vec E[H Y H^T] - vec E[H] Y
        E[H]^T (K^2, K^2); None where none does
    """

    kept: np.ndarray
    counted: np.ndarray
    both: np.ndarray
    held: np.ndarray
    late: int
    delays: tuple[np.ndarray, scipy.sparse.csr_array] | None
    __repr__ = in_short

    @classmethod
    def of(cls, variation: Variation, rows: int) -> RecordMoments:
        """The moments of a variation of one machine, whose leaves are numbers."""
        k = np.arange(rows)
        kept, both = np.ones(rows), np.ones((rows, rows))
        if variation.shortest is not None:
            kept = _chance_to_last(float(variation.shortest), rows - 1)
            both = np.minimum.outer(kept, kept)  # a trial that lasts to k has lasted to l < k
        ends = -np.diff(kept, append=0.0) / np.maximum(
            k, 1
        )  # its last sample is k; over its number
        counted = np.where(k > 0, np.cumsum(ends[::-1])[::-1], 0.0)
        if variation.dropped is not None:
            stays = np.where(k == 0, 1.0, 1.0 - float(variation.dropped))
            both = both * np.where(np.eye(rows, dtype=bool), stays, np.outer(stays, stays))
            kept = kept * stays
        held = np.mean([S.toarray() for S in _shifts(rows, variation.late)], axis=0)
        delays = None
        if variation.delayed is not None:
            delays = _of_delays(float(variation.delayed), variation.delay, rows)
            held = delays[0] @ held
        return cls(kept, counted, both, held, variation.late, delays)

    @property
    def certain(self) -> bool:
        """Whether every trial has the same record."""
        return self.in_time and bool(np.all(self.both == np.outer(self.kept, self.kept)))

    @property
    def in_time(self) -> bool:
        """Whether no sample comes late."""
        return self.delays is None and not self.late

    def reach(self, n: int) -> np.ndarray:
        """(K n, K n) the largest |H - E[H]| of each entry, over all that can be drawn."""
        far = np.where(self.held < 1, np.maximum(self.held, 1 - self.held), 0.0)
        return np.kron(np.where(self.held > 0, far, 0.0), np.eye(n))

    def covariance(self, Y, r=None, y=None) -> np.ndarray:
        """Cov[e'] given y, (K n, K n), in the mean over y.

        Y: (K n, K n) E[y y^T]
        r, y: (K n,) the reference and E[y]; None for the part that is quadratic in y
        """
        square, mean = self._held(Y), _both_sides(self.held, Y)
        if r is not None and y is not None:
            late = _rows(self.held, y[:, None])[:, 0]
            other = np.outer(r, r) - np.outer(r, late) - np.outer(late, r)
            square, mean = square + other, mean + other
        return self._lost(square) - self._lost(mean, together=np.outer(self.kept, self.kept))

    def covariance_back(self, Z) -> np.ndarray:
        """The adjoint of Y -> covariance(Y): <covariance(Y), Z> = <Y, it>."""
        mean = _both_sides(self.held.T, self._lost(Z, together=np.outer(self.kept, self.kept)))
        return self._held_back(self._lost(Z)) - mean

    def _lost(self, Y, together=None):
        together = self.both if together is None else together
        n = len(Y) // len(together)
        return Y * together if n == 1 else Y * np.kron(together, np.ones((n, n)))

    def _held(self, Y) -> np.ndarray:
        """E[H Y H^T]."""
        if self.late:
            Y = np.mean([_both_sides(S, Y) for S in _shifts(len(self.kept), self.late)], axis=0)
        if self.delays is None:
            return Y
        mean, joint = self.delays
        return _both_sides(mean, Y) + _by_channels(joint, Y, len(self.kept))

    def _held_back(self, Z) -> np.ndarray:
        if self.delays is not None:
            mean, joint = self.delays
            Z = _both_sides(mean.T, Z) + _by_channels(joint.T, Z, len(self.kept))
        if not self.late:
            return Z
        back = (S.T for S in _shifts(len(self.kept), self.late))
        return np.mean([_both_sides(S, Z) for S in back], axis=0)


@lru_cache(maxsize=4)
def _shifts(rows: int, late: int) -> tuple:
    """What holds a record back as a whole, by each delay."""
    k = np.arange(rows)
    return tuple(_selects(np.maximum(k - d, 0)) for d in range(late + 1))


def _chance_to_last(shortest: float, N: int) -> np.ndarray:
    """(N+1,) the chance that a trial lasts to k, of a length drawn as `variation.there_until` does.

    The last sample is the whole part of N (shortest + (1 - shortest) x), x uniform in [0, 1).
    """
    if shortest >= 1:
        return np.ones(N + 1)
    return 1 - np.clip((np.arange(N + 1) / N - shortest) / (1 - shortest), 0.0, 1.0)


def _of_delays(delayed: float, most: int, rows: int) -> tuple[np.ndarray, scipy.sparse.csr_array]:
    """E[H] where samples come late by themselves, and what E[H Y H^T] has beyond E[H] Y E[H]^T.

    Sample k needs delta_k samples to arrive, independent of the others. The newest that is there
    at k has the age a if delta_(k-a) <= a while delta_s > k - s for the newer ones, k - a < s <= k.
    Ages at instants further apart than `most` have no sample in common and are independent.
    """
    in_time = np.array([0.0, *(1 - delayed * (most - x) / most for x in range(most + 1))])

    def chance(low: int, high: int) -> float:
        """P(low < delta <= high), from -1."""
        low, high = (min(x, most) + 1 for x in (low, high))
        return max(0.0, in_time[high] - in_time[low]) if high > low else 0.0

    def together(apart: int, ages: tuple[int, ...]) -> float:
        """The chance of an age at k, and, if two are given, of another at k + apart."""
        of_all = 1.0
        for s in range(-most, apart + 1):
            low, high = -1, most
            for at, age in zip((0, apart), ages, strict=False):
                if at - age < s <= at:
                    low = max(low, at - s)
                elif s == at - age:
                    high = min(high, age)
            of_all *= chance(low, high)
        return of_all

    ages, k = range(most + 1), np.arange(rows)
    alone = np.array([together(0, (a,)) for a in ages])
    mean = sum(
        p * _selects(np.maximum(k - a, 0)) for a, p in zip(ages, alone, strict=True)
    ).toarray()
    to, of, chances = [], [], []
    for apart, a, b in itertools.product(range(most + 1), ages, ages):
        more = together(apart, (a, b)) - alone[a] * alone[b]
        here, there = k[: rows - apart], k[apart:]
        pairs = [(here, there, np.maximum(here - a, 0), np.maximum(there - b, 0))]
        if apart:
            pairs.append((*pairs[0][1::-1], *pairs[0][:1:-1]))
        for i, j, m, n in pairs:
            to.append(i * rows + j)
            of.append(m * rows + n)
            chances.append(np.full(len(i), more))
    entries = np.concatenate(chances), (np.concatenate(to), np.concatenate(of))
    return mean, scipy.sparse.csr_array(entries, shape=(rows**2, rows**2))


def _selects(at: np.ndarray) -> scipy.sparse.csr_array:
    """The (K, K) matrix that takes rows `at` of a signal."""
    rows = len(at)
    return scipy.sparse.csr_array((np.ones(rows), (np.arange(rows), at)), shape=(rows, rows))


def _rows(S, Y) -> np.ndarray:
    """S applied to the rows of a (K n, m) matrix, alike for each of n channels."""
    K = S.shape[1]
    return np.asarray(S @ Y.reshape(K, -1)).reshape(Y.shape)


def _both_sides(S, Y) -> np.ndarray:
    """S Y S^T, alike for each channel."""
    return _rows(S, _rows(S, Y).T).T


def _by_channels(joint, Y, K: int) -> np.ndarray:
    """A map of (K, K) matrices, applied to each pair of channels of a (K n, K n) matrix."""
    n = len(Y) // K
    pairs = Y.reshape(K, n, K, n).transpose(0, 2, 1, 3).reshape(K * K, n * n)
    found = np.asarray(joint @ pairs).reshape(K, K, n, n)
    return found.transpose(0, 2, 1, 3).reshape(Y.shape)


# What holds for single runs
# --------------------------------------------------------------------------------------------------

SENSES = SURELY, STILL, EVERY, SQUARE, ALMOST, MEAN = (
    "",
    "but for noise",
    "for every draw",
    "in mean square",
    "almost surely",
    "in the mean",
)
ALONE = 1 - 1e-9  # below which an exact square or exponent counts as contracting
NOTHING = 1e-14  # share of the reference that counts as nothing
ROOM = 2**24  # numbers that a solution may hold
POWERS, WORK = (256, 4096), 2**28  # trials that are summed, and their number times n^3
KRYLOV = 400  # steps of GMRES after them, at most
SOLVED = 1e-8  # relative residual up to which a stationary variance counts as found
BLOCKS, LENGTHS = 32, (1, 4, 16, 64)  # drawn products, and their numbers of trials
SURE = 1e-6  # chance with which the interval of an exponent may be wrong
LOOKED_AT = 64  # trials at least, in which limits are looked at; then with what noise leaves
MARGIN = 5.0  # standard deviations, of a limit that counts as never met
PRODUCTS = 256  # rows up to which products are drawn
FEWER = "of so many inputs nothing is claimed but that a mean square falls at once, without limits"
RARE = 0.05  # chance with which a late trial may have more error than is told
TILTS = np.geomspace(1e-9, 0.95, 512)  # 2 s max l; each gives a bound, of which the least counts
WHOLE = 1e-10  # share of squares above which a direction is surely one of all that are moved
DOUBLINGS = 40  # of the number of trials that are summed, at most
# the part of a machine that draws a noise, the field of its size, and where it acts as `disturbed`
# has it; the law sees that of the sensor as it sees noise of the output
NOISE = {
    "sensor": ("sensor", "noise", "output"),
    "output": ("disturbance", "output_noise", "output"),
    "input": ("disturbance", "input_noise", "input"),
    "start": ("variation", "scatter", "offset"),
}


class Parts(NamedTuple):
    """The matrices of one machine, of the w that learning moves.

    start: (n,) w of the first trial
    M, c: (n, n), (n,) the mean map of learning
    L: (n, K n_y) from the errors that the record shows to the next w
    Y, y: (K n_y, n), (K n_y,) the output Y w + y
    T, t: (m, n), (m,) what limits act on, T w + t, in units of their bounds
    B, F, G: (n, D), (K n_y, D), (m, D) what noise of variance 1 adds to the next w, to the output
        and to what limits act on
    r: (K n_y,) the reference
    """

    start: np.ndarray
    M: np.ndarray
    c: np.ndarray
    L: np.ndarray
    Y: np.ndarray
    y: np.ndarray
    T: np.ndarray
    t: np.ndarray
    B: np.ndarray
    F: np.ndarray
    G: np.ndarray
    r: np.ndarray

    def closer(self, astray) -> Parts:
        """These with limits that are closer by so much (K,), in units of the bounds."""
        room = np.concatenate([[1.0], np.where(astray < 1, 1 - astray, np.nan)])[:, None]
        return self._replace(T=self.T / room, t=self.t / room[:, 0], G=self.G / room)

    def within(self, V) -> Parts:
        """These for z of w = start + V z, where learning leaves the other directions alone."""
        moved = self.M @ self.start + self.c - self.start
        return self._replace(
            start=np.zeros(V.shape[1]),
            M=V.T @ self.M @ V,
            c=V.T @ moved,
            L=V.T @ self.L,
            Y=self.Y @ V,
            y=self.y + self.Y @ self.start,
            T=self.T @ V,
            t=self.t + self.T @ self.start,
            B=V.T @ self.B,
        )


class UnderChance(NamedTuple):
    """What holds for single runs of one machine.

    certain: whether every trial is learned from alike, so that only noise and the initial state
        differ; then claims on the mean are claims on the distance of two runs for every draw
    clear: whether no limit is met within `MARGIN` standard deviations
    sense: one of `SENSES`
    claim: what is claimed in this sense, of `condition.CLAIMS`
    reason: on what it rests
    left: root mean square error, over all that is drawn, that learning leaves in the long run;
        infinite where its square has no mean, NaN where it is not known
    most: the error of a late trial is at most this but with a chance of `RARE`; likewise
    rms: (J,) the same in each trial, by theory, or a bound of it; NaN where it is not known
    """

    certain: bool
    clear: bool
    sense: str
    claim: str
    reason: str
    left: float
    most: float
    rms: np.ndarray
    __repr__ = in_short


def draws(machines: Machine) -> bool:
    """Whether something is drawn for each trial of these machines."""
    return bool(noise_of(machines)) or not learned_alike(machines)


def learned_alike(machines: Machine) -> bool:
    """Whether each trial of these machines has the same samples in its record."""
    return machines.variation is None or machines.variation.alike


def under_chance(
    machines: Machine,
    scheme: Scheme,
    task: Task,
    view: View,
    trials: int,
    *,
    astray=None,
    in_norm=False,
) -> list[UnderChance]:
    """What holds for single runs of each machine, of which the premises of `linearity` hold.

    astray: (S, K) as for `outlooks`
    in_norm: whether errors are bounded in norm alone, and nothing is claimed but that E|d_j|^2
        falls in every trial, where there is no limit: for many inputs, unless all is certain
    """
    parts_of, found = tiled_with(_parts, lanes=1, view=view, noise=noise_of(machines)), []
    for i in range(count_of(machines)):  # the matrices of one alone are large
        one = alone(machines, i)
        machine = first_of(one)
        drawn = partial(_products, machine, scheme, task, view)
        parts = Parts(*(np.asarray(part)[0] for part in parts_of((scheme, task), one)))
        parts = parts if astray is None else parts.closer(astray[i])
        variation = machine.variation or Variation()
        found.append(_judged(parts, variation, task, trials, drawn, in_norm=in_norm))
    return found


# Of one machine
# --------------------------------------------------------------------------------------------------


def _judged(
    parts: Parts, variation: Variation, task: Task, trials: int, drawn, *, in_norm: bool
) -> UnderChance:
    moments = RecordMoments.of(variation, task.N + 1)
    n_y = task.outputs
    kept, held = np.repeat(moments.kept, n_y), np.kron(moments.held, np.eye(n_y))
    A = parts.M + (parts.L * kept) @ (held @ parts.Y)  # learning from a record without error
    possible = (A != 0) + (parts.L * kept != 0) @ (held != 0.0) @ (parts.Y != 0)
    run = _Run(parts, moments, n_y)
    moving = parts.M @ parts.start + parts.c != parts.start
    at = reachable(possible, moving | (np.diag(run.added(parts.start)) > 0))
    if len(at):  # else no trial moves anything
        parts, A = parts.within(np.eye(len(A))[:, at]), A[np.ix_(at, at)]
    whole = _Pattern.of(A, parts, moments, n_y)
    drifts = _drifting(A, parts, moments, n_y) if len(parts.t) == 1 else ""
    moves = np.concatenate([A - np.eye(len(A)), parts.L * kept, parts.B], axis=1)
    V = _range_of(moves)
    run = run._replace(parts=parts if V is None else parts.within(V))
    two = "the distance of two runs with the same draws falls"
    if in_norm and not moments.certain:
        factor = run.factor()
        known = factor < 1 and len(parts.t) == 1
        left, rms = run.bounds(factor, trials) if known else (np.inf, np.full(trials, np.nan))
        said = f"{two} to {factor**0.5:.6g} of itself in every trial, or below" if known else FEWER
        quantile = left / np.sqrt(RARE)
        sense, claim = (SQUARE, MONOTONE) if known else (MEAN, NOT_CLAIMED)
        return UnderChance(False, True, sense, claim, said, left, quantile, rms)
    with np.errstate(over="ignore", invalid="ignore"):
        rms, clear = run.course(max(trials, LOOKED_AT if len(parts.t) > 1 else 1))
        rms, worst, at_once, factor, growth = rms[:trials], 0.0, True, 0.0, 1.0
        if not moments.certain:
            worst, (at_once, factor, growth) = run.worst_norm(kept, held), run.decay(whole.square)
        left, most, calm = run.left() if factor < 1 else (np.inf, np.inf, True)

    def found(sense, claim, said):
        known = claim in (MONOTONE, CONVERGES) and sense != ALMOST
        of_error = (left, most) if known else (np.inf, np.inf)
        return UnderChance(moments.certain, clear and calm, sense, claim, said, *of_error, rms)

    if worst < 1:
        return found(EVERY, MONOTONE, f"{two} to {worst:.6g} of itself in every trial, or below")
    if at_once:
        said = f"{two} to {factor**0.5:.6g} of itself in every trial, or below"
        return found(SQUARE, MONOTONE, said)
    if factor < 1:
        said = f"{two} in the end; it grows at most {growth**0.5:.3g} times before"
        return found(SQUARE, CONVERGES, said)
    if len(at) and whole.exponent > -np.log(ALONE) and len(parts.t) == 1:  # no limit holds it
        said = f"a run grows by {np.exp(whole.exponent):.4g} in a trial, in the long run"
        return found(ALMOST, DIVERGES, said)
    if drifts:
        return found(ALMOST, DIVERGES, drifts)
    if not len(at):
        return found(MEAN, NOT_CLAIMED, "no trial moves what is learned")
    exponent = drawn()
    if exponent < np.log(ALONE):
        by = f"to {np.exp(exponent):.4g} of itself in a trial, or below, in the long run"
        return found(ALMOST, CONVERGES, f"{two} {by}; single trials may stray far")
    grows = "can grow far before it falls" if whole.square < ALONE else "is not seen to fall"
    said = "what holds for the mean of all runs does not hold for single ones: their mean square "
    return found(MEAN, NOT_CLAIMED, said + grows)


class _Run(NamedTuple):
    """The moments of learning on one machine, trial by trial.

    outputs: number n_y of them
    """

    parts: Parts
    moments: RecordMoments
    outputs: int

    def squares(self, X) -> np.ndarray:
        """T(X) = E[M X M^T]."""
        M, L, Y = self.parts.M, self.parts.L, self.parts.Y
        if self.moments.certain:
            return M @ X @ M.T
        return M @ X @ M.T + L @ self.moments.covariance(Y @ X @ Y.T) @ L.T

    def squares_back(self, Z) -> np.ndarray:
        """T*(Z) = E[M^T Z M]."""
        M, L, Y = self.parts.M, self.parts.L, self.parts.Y
        return M.T @ Z @ M + Y.T @ self.moments.covariance_back(L.T @ Z @ L) @ Y

    def worst_norm(self, kept, held) -> float:
        """An upper bound of ||M|| over all that can be drawn."""
        lost = kept < 1
        middle = np.where(lost, 0.5, 1.0)[:, None] * held
        reach = norm_of(self.moments.reach(self.outputs)) + 0.5 * np.max(lost) * norm_of(held)
        L, Y = self.parts.L, self.parts.Y
        A = self.parts.M + (L * kept) @ (held @ Y)
        return norm_of(A - L @ middle @ Y) + norm_of(L) * norm_of(Y) * reach

    def factor(self) -> float:
        """The largest eigenvalue of T*(I), below 1 where it surely is; infinite if it overflows."""
        at_once = self.squares_back(np.eye(len(self.parts.M)))
        if not np.all(np.isfinite(at_once)):
            return np.inf
        norm = float(np.linalg.eigvalsh(at_once)[-1])
        return norm if norm < 1 - ROUNDING * np.finfo(float).eps * len(at_once) else max(norm, 1.0)

    def bounds(self, factor: float, trials: int) -> tuple[float, np.ndarray]:
        """Bounds of the root mean square error in the long run, and (J,) of each trial.

            tr X <= tr C / (1 - factor),    E|w_j - v_j|^2 <= factor^(j-1) E|w_1 - v_1|^2

        of X = T(X) + C, and of the run v_j that has the same draws and began long ago.
        """
        parts = self.parts
        w = np.linalg.lstsq(np.eye(len(parts.M)) - parts.M, parts.c)[0]
        spread = float(np.trace(self.added(w))) / (1 - factor)
        Y, F, e = self._shared(w)
        of_output = norm_of(Y)
        left = np.sqrt(e @ e + of_output**2 * spread + np.sum(F**2))
        far = of_output * np.sqrt(np.sum((parts.start - w) ** 2) + spread)
        return float(left), left + far * factor ** (np.arange(trials) / 2)

    def decay(self, square: float) -> tuple[bool, float, float]:
        """Whether T contracts at once, its factor in a trial, and the growth before.

            E|w_k - w'_k|^2 <= growth factor^k |w_0 - w'_0|^2

        Where T* does not contract I, some Z > 0 is looked for that shrinks: a sum of its powers, or
        the solution of Z - T*(Z) = I. Where none is found the factor is infinite, unless T is known
        to have a spectral radius `square` below 1 and its powers are seen to fall: then the factor
        is that radius, and the growth is the largest trace of them.
        """
        n, eps, norm = len(self.parts.M), np.finfo(float).eps, self.factor()
        if norm < 1 or not np.isfinite(norm):
            return norm < 1, norm, 1.0
        doubt, known = ROUNDING * eps * n * norm, square < ALONE
        Z, last, most = self._powers(self.squares_back, np.eye(n), 1 / eps if known else n / doubt)
        if last > 1 and np.isfinite(last):
            Z, _ = self._rest(self.squares_back, np.eye(n), Z)
        shrinks = Z - self.squares_back(Z)
        if np.all(np.isfinite(shrinks)):
            sizes, falls = scipy.linalg.eigvalsh(Z), scipy.linalg.eigvalsh(shrinks)[0]
            falls -= doubt * sizes[-1]
            if sizes[0] > 0 and falls > 0:
                return False, float(1 - falls / sizes[-1]), float(sizes[-1] / sizes[0])
        return (False, square, most) if known and last < 1 else (False, np.inf, np.inf)

    def _powers(self, squares, C, most: float) -> tuple[np.ndarray, float, float]:
        """The sum of the powers of `squares` on C, the trace of the last, and the largest trace.

        It ends where a trace is small. Of powers that do not fall, or whose trace, which that of
        the sum exceeds, is above `most`, the last is told as infinite.
        """
        n, X, power, sizes = len(C), C, C, [np.trace(C)]
        for _ in range(int(np.clip(WORK / n**3, *POWERS))):
            power = squares(power)
            sizes.append(np.trace(power))
            if not sizes[-1] < most:
                return X, np.inf, np.inf
            X = X + power
            if sizes[-1] < SOLVED / 10 * sizes[0]:
                break
        falls = sizes[-1] <= sizes[-2]
        return X, float(sizes[-1]) if falls else np.inf, float(max(sizes))

    def _rest(self, squares, C, X) -> tuple[np.ndarray, float]:
        """X of X - squares(X) = C from one that is near, and the share of C that is missing."""
        n = len(C)
        held = scipy.sparse.linalg.LinearOperator(
            (n * n, n * n), lambda x: x - squares(x.reshape(n, n)).ravel()
        )
        turns = int(np.clip(ROOM / n**2, 20, KRYLOV))
        how = {"rtol": SOLVED / 10, "restart": turns, "maxiter": KRYLOV // turns}
        X = scipy.sparse.linalg.gmres(held, C.ravel(), X.ravel(), **how)[0].reshape(n, n)
        X = (X + X.T) / 2
        return X, float(np.linalg.norm(X - squares(X) - C) / np.linalg.norm(C))

    def _solved(self, C) -> tuple[np.ndarray, float]:
        """X of X - T(X) = C, and the share of C that is missing; C is positive."""
        X, last, _ = self._powers(self.squares, C, np.inf)
        if last < SOLVED / 10 * np.trace(C):
            return X, last / np.trace(C)
        return self._rest(self.squares, C, X) if np.isfinite(last) else (X, np.inf)

    def course(self, trials: int) -> tuple[np.ndarray, bool]:
        """(J,) root mean square error of each trial, and whether no limit is met in them."""
        parts, certain = self.parts, self.moments.certain
        w, X, found, clear = parts.start, np.zeros_like(parts.M), [], True
        C, moves = self.added(w), True
        for _ in range(trials):
            found.append(self._error(w, X))
            clear = clear and self._clear(w, X)
            if moves:
                C, before = C if certain else self.added(w), X
                X = self.squares(X) + C
                moves = not certain or np.linalg.norm(X - before) > SOLVED * np.linalg.norm(X)
            w = parts.M @ w + parts.c
        return np.array(found), clear

    def left(self) -> tuple[float, float, bool]:
        """The root mean square error in the long run, its quantile, and whether no limit is met.

        The errors are NaN where they cannot be computed.
        """
        M, n = self.parts.M, len(self.parts.M)
        w = np.linalg.lstsq(np.eye(n) - M, self.parts.c)[0]
        C = self.added(w)
        of_record = np.linalg.norm(self.parts.L) * np.linalg.norm(self.parts.r)
        X, missing = 0 * M, 0.0
        if np.linalg.norm(C) > (NOTHING * of_record) ** 2:
            X, missing = _summed(M, C) if self.moments.certain else self._solved(C)
        if missing > SOLVED or np.diag(X).min(initial=0.0) < -SOLVED * np.diag(X).max(initial=0.0):
            return np.nan, np.nan, len(self.parts.t) == 1  # no limit but the one always there
        left = self._error(w, X)
        most = self._quantile(w, X) if self.moments.certain else left / np.sqrt(RARE)
        return left, most, self._clear(w, X) and self._clear_on_the_way(w, X)

    def added(self, w) -> np.ndarray:
        """C: what is added to the covariance of w in a trial that plays w in the mean."""
        parts = self.parts
        C = parts.B @ parts.B.T
        if self.moments.certain:
            return C
        y, noise = parts.Y @ w + parts.y, parts.F @ parts.F.T
        if self.moments.in_time:  # then the errors decide, and an error of 0 adds exactly 0
            found = self.moments.covariance(np.outer(parts.r - y, parts.r - y) + noise)
        else:
            found = self.moments.covariance(np.outer(y, y) + noise, parts.r, y)
        return C + parts.L @ found @ parts.L.T

    def _astray(self, X) -> np.ndarray:
        """(m,) `MARGIN` standard deviations of what limits act on."""
        T, G = self.parts.T, self.parts.G
        squares = np.sum((T @ X) * T, axis=1) + np.sum(G**2, axis=1)
        return MARGIN * np.sqrt(np.maximum(squares, 0.0))

    def _clear(self, w, X) -> bool:
        """Whether no limit is met within `MARGIN` standard deviations."""
        return bool(np.all(np.abs(self.parts.T @ w + self.parts.t) + self._astray(X) <= 1))

    def _clear_on_the_way(self, end, X) -> bool:
        """The same of the trials that `course` need not look at, until the mean is at its end."""
        parts = self.parts
        if len(parts.t) == 1:
            return True
        room, w = 1 - self._astray(X), parts.start
        near = SOLVED * max(np.linalg.norm(end), np.linalg.norm(w))
        for j in range(MOST):
            if j >= LOOKED_AT and np.any(np.abs(parts.T @ w + parts.t) > room):
                return False
            if np.linalg.norm(w - end) <= near:
                break
            w = parts.M @ w + parts.c
        return True

    def _error(self, w, X) -> float:
        parts = self.parts
        e = parts.r - parts.Y @ w - parts.y
        squares = e**2 + np.sum((parts.Y @ X) * parts.Y, axis=1) + np.sum(parts.F**2, axis=1)
        of_sample = np.mean(squares.reshape(-1, self.outputs), axis=1)
        return float(np.sqrt(max(self.moments.counted @ of_sample, 0.0)))

    def _shared(self, w) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Y, F and the mean error, each sample by the root of its share in the mean square."""
        parts = self.parts
        share = np.sqrt(np.repeat(self.moments.counted, self.outputs) / self.outputs)
        e = share * (parts.r - parts.Y @ w - parts.y)
        return share[:, None] * parts.Y, share[:, None] * parts.F, e

    def _quantile(self, w, X) -> float:
        """The root mean square error above which a trial is with a chance of `RARE` or less.

        The error is Gaussian, with the mean of w and the covariance of X and of the noise.
        """
        Y, F, e = self._shared(w)
        sizes, V = np.linalg.eigh(Y @ X @ Y.T + F @ F.T)
        squares, sizes = (V.T @ e) ** 2, sizes.clip(0.0)
        if sizes[-1] <= 0:
            return float(np.sqrt(np.sum(squares)))
        s = TILTS[:, None] / (2 * sizes[-1])
        left = 1 - 2 * s * sizes
        logs = np.sum(s * squares / left - np.log(left) / 2, axis=1)
        return float(np.sqrt(np.min((logs - np.log(RARE)) / s[:, 0])) * (1 + SOLVED))


class _Pattern(NamedTuple):
    """What the diagonals tell if every map that can be drawn is triangular in one order.

    square: max_i E[M_ii^2], the spectral radius of T; infinite where the maps are not triangular
    exponent: max_i E log|M_ii|, the Lyapunov exponent; minus infinity likewise
    """

    square: float
    exponent: float

    @classmethod
    def of(cls, A, parts: Parts, moments: RecordMoments, n_y: int) -> _Pattern:
        acts = (parts.L != 0).astype(float), (parts.Y != 0).astype(float)
        possible = np.kron(moments.held != 0, np.eye(n_y))
        drawn = acts[0] @ possible @ acts[1]
        pairs = np.einsum("ki,ik->k", acts[0], acts[1])
        unknown = cls(np.inf, -np.inf)
        if not np.isfinite(triangular_radius((A != 0) + drawn)):
            return unknown
        if np.any(np.diag(drawn) != pairs) or np.any(pairs > 1):
            return unknown  # what is drawn acts on the diagonal in more than one way
        at = np.argmax(acts[0] * acts[1].T, axis=1)
        k = np.arange(len(A))
        shown = np.repeat(moments.kept * np.diag(moments.held), n_y)[at]
        still = np.abs(np.diag(A))
        moved = np.abs(np.diag(A) - parts.L[k, at] * parts.Y[at, k])
        square = float(np.max((1 - shown) * still**2 + shown * moved**2, initial=0.0))
        exponent = float(np.max(_log(still, 1 - shown) + _log(moved, shown), initial=-np.inf))
        return cls(square, exponent)


def _drifting(A, parts: Parts, moments: RecordMoments, n_y: int) -> str:
    """Why an error surely grows with the number of trials, in words; empty where none is known to.

    The push of `drifting` is then the mean of what is drawn, by the law of large numbers.
    """
    shows = np.kron(moments.kept[:, None] * moments.held != 0, np.eye(n_y)) @ (parts.Y != 0)
    alike = ~np.any((parts.L != 0) @ shows, axis=1)
    seen = np.repeat(moments.counted, n_y) > 0
    size = np.linalg.norm(parts.r) + np.linalg.norm(parts.y)
    least = float(SOLVED * np.linalg.norm(parts.Y) * np.linalg.norm(parts.L) * size)
    return drifting(A, parts.c, parts.Y, parts.L, least=least, outputs=n_y, alike=alike, seen=seen)


def _summed(M, C) -> tuple[np.ndarray, float]:
    """X above sum_i M^i C M^i^T by next to nothing, and 0; or infinity if it is not seen to be.

    Any X with X - M X M^T > C is above the sum. It is made for C and a little more, of twice as
    many trials each time: P X P^T, for P = M^n, is what follows on the first n.
    """
    more = SOLVED * np.linalg.norm(C)
    X, P = C + more * np.eye(len(C)), M
    for _ in range(DOUBLINGS):
        X, P = X + P @ X @ P.T, P @ P
        size = np.linalg.norm(P)
        if size <= np.finfo(float).eps or not np.isfinite(size):
            break
    off = np.linalg.norm(X - M @ X @ M.T - C - more * np.eye(len(C)))
    off += np.finfo(float).eps * len(C) * np.linalg.norm(M) ** 2 * np.linalg.norm(X)
    return X, 0.0 if off < more else np.inf


def _log(size, chance):
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(chance > 0, chance * np.log(size), 0.0)


def _range_of(moves) -> np.ndarray | None:
    """(n, p) an orthonormal basis of the columns; None where they span everything."""
    squares = moves @ moves.T
    if np.linalg.eigvalsh(squares)[0] > WHOLE * np.trace(squares):
        return None  # as nearly always, and seen in a tenth of the time
    V, sizes, _ = np.linalg.svd(moves, full_matrices=False)
    there = sizes > ROUNDING * np.finfo(moves.dtype).eps * sizes[0]
    return None if np.sum(there) == len(moves) else V[:, there]


# By the programs of machine and law
# --------------------------------------------------------------------------------------------------


def noise_of(machines: Machine) -> tuple[str, ...]:
    """What adds noise to a trial of these machines: names of `NOISE`."""
    parts = ((name, getattr(machines, of), size) for name, (of, size, _) in NOISE.items())
    return tuple(name for name, of, size in parts if getattr(of, size, None) is not None)


def _noisy(machine: Machine, noise: dict[str, jax.Array]) -> Machine:
    """The machine with this noise, of variance 1, in place of what it draws."""
    one = machine
    for name, x in noise.items():
        of, size, acts_on = NOISE[name]
        one = disturbed(one, acts_on, getattr(getattr(machine, of), size) * x)
    return one


def _parts(common, machine, *, view: View, noise: tuple[str, ...]) -> tuple:
    scheme, task = common
    rest = ravel_pytree(machine.plant.sampled(task.dt).initial_state())[0]
    shapes = {
        "sensor": (task.N + 1, task.outputs),
        "output": (task.N + 1, task.outputs),
        "input": (task.N, task.inputs),
        "start": rest.shape,
    }
    still, unravel = ravel_pytree({name: jnp.zeros(shapes[name]) for name in noise})
    start = learning_of(machine, scheme, task, view).start

    def at(w, d):
        one = _noisy(machine, unravel(d))
        following, _, output, limits = learning_of(one, scheme, task, view).turn(w)
        if one.variation is not None and one.variation.shortest is not None:
            drawn = dataclasses.replace(one.variation, shortest=None)
            whole = dataclasses.replace(one, variation=drawn)
            output = learning_of(whole, scheme, task, view).turn(w).output
        return following, output, jnp.concatenate([jnp.zeros(1), *limits.values()])

    (c, y, t), ((M, Y, T), of_noise) = slopes(at, start, still)
    B, F, G = of_noise if noise else [jnp.zeros((len(x), 1)) for x in (c, y, t)]
    found = learning_of(machine, scheme, task, view)
    r = jnp.asarray(machine.sampled(task.dt).at_trial(task, None)[1].reference).ravel()
    _, (L,) = slopes(partial(found.from_record, start), jnp.zeros(y.size))
    return start, M, c - M @ start, L, Y, y - Y @ start, T, t - T @ start, B, F, G, r


def _products(machine, scheme, task, view: View) -> float:
    """The upper end of an interval of the Lyapunov exponent; infinite where the maps are large."""
    if len(view.moving) > PRODUCTS:
        return np.inf
    keys = jax.random.split(jax.random.key(5), BLOCKS)
    run = tiled_with(_drawn_product, lanes=1, view=view)
    logs = np.asarray(run((machine, scheme, task), keys))
    with np.errstate(divide="ignore"):
        sizes = logs / np.array(LENGTHS)
    t = scipy.special.stdtrit(BLOCKS - 1, 1 - SURE / len(LENGTHS))
    above = np.mean(sizes, axis=0) + t * np.std(sizes, axis=0, ddof=1) / np.sqrt(BLOCKS)
    return float(np.min(np.nan_to_num(above, nan=np.inf)))


def _drawn_product(common, key, *, view: View):
    """log ||M_k ... M_1|| of drawn maps for k of `LENGTHS`, by key."""
    machine, scheme, task = common

    def turn(now, key):
        product, size = now
        found = learning_of(machine, scheme, task, view, key)
        _, push = jax.linearize(found.following, found.start)
        product = jax.vmap(push, in_axes=1, out_axes=1)(product)
        length = jnp.linalg.norm(product)
        grown = size + jnp.log(length)
        return (product / jnp.where(length > 0, length, 1.0), grown), grown

    unit = jnp.eye(len(view.moving))
    _, logs = jax.lax.scan(turn, (unit, jnp.zeros(())), jax.random.split(key, LENGTHS[-1]))
    return logs[np.array(LENGTHS) - 1]  # Frobenius norms, never below ||M_k ... M_1||
