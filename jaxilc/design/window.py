"""A window of taps for a learning law, and directions in it that matter alike at all frequencies.

    u_{j+1} = keep u_j + L e_j,    L(z) = sum_i L_i z^(1 + lead + i - n),    keep(z) = keep(1/z)

What learning feels of a change of L is its share of L P, so a direction of L is a peak at one
frequency, as narrow as the taps allow, with the height 1 / |P| there. A direction of keep is a peak
of the height 1. A step of 0.01 along any of them is then a small one, and no rate need be chosen.

keep is 1 at rest and flat there, 1 - keep = O(f^4), as that of a Butterworth filter of order 2 is.
Slow errors are the largest, and no step of a search may give them away.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..schemes import LearningFilter
from ..signals.task import Task
from ..theory.law import Law, Taps
from .responses import Family

WEAKEST = 0.1  # share of the largest |P| below which a direction of L becomes no higher


class Filters(NamedTuple):
    """Taps of L (p,) and of keep (p',), the latter symmetric."""

    L: np.ndarray
    keep: np.ndarray

    def towards(self, other: Filters, way: float) -> Filters:
        """The taps on the way to others; |keep - L P| is at no frequency above both ends."""
        return Filters(*((1 - way) * a + way * b for a, b in zip(self, other, strict=True)))


class Window(NamedTuple):
    """Where the taps of a law lie, and the directions in which they are changed.

    lead:    as in `LearningFilter`
    of_L:    (p, p) directions of L as columns
    of_keep: (p', m) directions of keep
    """

    lead: int
    of_L: np.ndarray
    of_keep: np.ndarray

    def holding(self, law: Law) -> Filters:
        """The taps of a law, those that lie in the window; keep is made flat at rest."""
        p, q = len(self.of_L), len(self.of_keep)
        L, keep = _within(law.L, 1 + self.lead, p), _within(law.keep, 0, q)
        flat = _flat(q)
        missing = np.array([1.0, 0.0]) - flat @ keep
        return Filters(L, keep + np.linalg.pinv(flat) @ missing)

    def nothing(self) -> Filters:
        """A law that learns nothing: L = 0, and keep = 1 as far as it must be."""
        q = len(self.of_keep)
        return Filters(np.zeros(len(self.of_L)), np.linalg.pinv(_flat(q)) @ [1.0, 0.0])

    def steps(self, start: Filters, end: Filters) -> np.ndarray:
        """The steps along the directions from some taps to others, first those of L."""
        changes = (self.of_L, end.L - start.L), (self.of_keep, end.keep - start.keep)
        return np.concatenate([np.linalg.lstsq(of, d, rcond=1e-9)[0] for of, d in changes])

    def of(self, filters: Filters) -> LearningFilter:
        """The scheme with these taps."""
        return LearningFilter(filters.L, keep=filters.keep, lead=self.lead)

    def responses(self, frequencies, dt: float) -> tuple[np.ndarray, np.ndarray]:
        """(F, p) and (F, p'), from the taps to the responses of L and of keep, the latter real."""
        angle = 2 * np.pi * dt * np.asarray(frequencies)
        p, q = len(self.of_L), len(self.of_keep)
        of_L = np.exp(1j * np.outer(angle, 1 + self.lead + _places(p)))
        return of_L, np.cos(np.outer(angle, _places(q)))


def window_of(family: Family, task: Task, taps: tuple[int, int]) -> Window:
    """The window of so many taps of L and of keep, around the mean delay of the machine."""
    P, angle = family.P[0], 2 * np.pi * family.frequencies * task.dt
    weight = np.abs(P) ** 2 * np.gradient(angle)
    delay = -np.gradient(np.unwrap(np.angle(P)), angle)
    lead = round(float(np.sum(delay * weight) / np.sum(weight))) - 1
    farthest = max(0, task.N - 1 - taps[0] // 2)
    of_L, at = _peaks(taps[0])
    size = np.interp(at / task.dt, family.frequencies, np.abs(P))
    of_L = of_L / np.maximum(size, WEAKEST * np.max(np.abs(P)))
    of_keep = _peaks(taps[1])[0]
    even = of_keep[:, [0, *range(1, taps[1], 2)]]  # without the sines
    flat = _flat(taps[1])
    even = even - np.linalg.pinv(flat) @ (flat @ even)
    return Window(min(max(lead, 0), farthest), of_L, even)


def _places(taps: int) -> np.ndarray:
    return np.arange(taps) - taps // 2


def _peaks(taps: int) -> tuple[np.ndarray, np.ndarray]:
    """Cosines and sines of height 1 in frequency, as columns, and their frequencies by 1 / dt."""
    k, i = _places(taps), np.arange(1, taps // 2 + 1)
    columns = [np.full(taps, 1 / taps)]
    for one in i:
        angle = 2 * np.pi * one * k / taps
        columns += [2 / taps * np.cos(angle), 2 / taps * np.sin(angle)]
    return np.stack(columns, axis=1), np.r_[0, np.repeat(i, 2)] / taps


def _flat(taps: int) -> np.ndarray:
    """(2, taps): keep(0), and its curvature."""
    k = _places(taps)
    return np.stack([np.ones(taps), k.astype(float) ** 2])


def _within(of: Taps, middle: int, taps: int) -> np.ndarray:
    """(taps,) those taps of a law of one channel that lie around the power `middle`."""
    found, at = np.zeros(taps), np.asarray(of.powers) - middle + taps // 2
    inside = (at >= 0) & (at < taps)
    found[at[inside]] = np.asarray(of.taps)[inside, 0, 0]
    return found
