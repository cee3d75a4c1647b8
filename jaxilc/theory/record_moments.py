"""First and second moments of the record of a trial, over what is drawn of it.

A trial has the output y, of K = N + 1 rows. The record that reaches the law has the error

    e' = P (r - H y)

H holds back what comes late (`late`, `delayed`), and P is 0 where a sample was lost (`dropped`) or
the trial has ended (`shortest`); both are drawn for each trial, and H y keeps y[0] at its start.
E[H], E[H Y H^T] and E[p_k p_l] are exact here, for any matrix Y, so that nothing needs to be drawn
to know how far single trials scatter about their mean.
"""

from __future__ import annotations

import itertools
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse

from ..learning.variation import Variation


class RecordMoments(NamedTuple):
    """The moments of what is drawn of the record of a trial with K rows.

    kept: (K,) chance of each sample to be in the record
    counted: (K,) share of each sample in the mean square error of a trial, in the mean
    both: (K, K) chance of two samples to be in it together
    held: (K, K) E[H]
    late: largest delay of the record as a whole, in samples
    of_delays: (K, K) E[H] of samples that come late by themselves; None where none does
    joint: (K^2, K^2) sparse; vec E[H Y H^T] - vec E[H] Y E[H]^T of these; None likewise
    """

    kept: np.ndarray
    counted: np.ndarray
    both: np.ndarray
    held: np.ndarray
    late: int
    of_delays: np.ndarray | None
    joint: Any

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
        held = np.mean([_selects(np.maximum(k - d, 0)) for d in range(variation.late + 1)], axis=0)
        of_delays = joint = None
        if variation.delayed is not None:
            of_delays, joint = _of_delays(float(variation.delayed), variation.delay, rows)
            held = of_delays @ held
        return cls(kept, counted, both, held, variation.late, of_delays, joint)

    @property
    def certain(self) -> bool:
        """Whether every trial has the same record."""
        return self.in_time and bool(np.all(self.both == np.outer(self.kept, self.kept)))

    @property
    def in_time(self) -> bool:
        """Whether no sample comes late."""
        return self.joint is None and not self.late

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
        if self.of_delays is None:
            return Y
        return _both_sides(self.of_delays, Y) + _by_channels(self.joint, Y, len(self.kept))

    def _held_back(self, Z) -> np.ndarray:
        if self.of_delays is not None:
            by_itself = _by_channels(self.joint.T, Z, len(self.kept))
            Z = _both_sides(self.of_delays.T, Z) + by_itself
        if not self.late:
            return Z
        back = (S.T for S in _shifts(len(self.kept), self.late))
        return np.mean([_both_sides(S, Z) for S in back], axis=0)


@lru_cache(maxsize=4)
def _shifts(rows: int, late: int) -> tuple:
    """What holds a record back as a whole, by each delay."""
    k = np.arange(rows)
    return tuple(_selects(np.maximum(k - d, 0), sparse=True) for d in range(late + 1))


def _chance_to_last(shortest: float, N: int) -> np.ndarray:
    """(N+1,) the chance that a trial lasts to k, of a length drawn as `arrival.there_until` does.

    The last sample is the whole part of N (shortest + (1 - shortest) x), x uniform in [0, 1).
    """
    if shortest >= 1:
        return np.ones(N + 1)
    return 1 - np.clip((np.arange(N + 1) / N - shortest) / (1 - shortest), 0.0, 1.0)


def _of_delays(delayed: float, most: int, rows: int) -> tuple[np.ndarray, Any]:
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
    mean = sum(p * _selects(np.maximum(k - a, 0)) for a, p in zip(ages, alone, strict=True))
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


def _selects(at, *, sparse: bool = False) -> Any:
    """The (K, K) matrix that takes rows `at` of a signal."""
    rows = len(at)
    found = scipy.sparse.csr_array((np.ones(rows), (np.arange(rows), at)), shape=(rows, rows))
    return found if sparse else found.toarray()


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
