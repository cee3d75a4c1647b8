"""Straight and circular segments, and chains of them with rounded corners."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from ..pytree.aliases import Numbers

FARTHEST = 1e9  # largest coordinate [mm]
SHORTEST = 1e-9  # coordinates that differ by less are one place [mm]


@dataclasses.dataclass(frozen=True)
class Straight:
    """The straight segment from `start` to `end`, (d,) each."""

    start: np.ndarray
    end: np.ndarray


@dataclasses.dataclass(frozen=True)
class Arc:
    """A circular arc in the plane of two axes; all other axes move linearly, as in a helix.

    The radius changes linearly from that of the start to that of the end, so that rounded numbers
    of a program still meet the end.

    start, end: (d,) ends
    centre:     (2,) centre in the plane
    plane:      the two axes, in the order in which a positive angle turns the first to the second
    sweep:      the angle [rad], positive anticlockwise
    """

    start: np.ndarray
    end: np.ndarray
    centre: np.ndarray
    plane: tuple[int, int]
    sweep: float

    @property
    def radii(self) -> np.ndarray:
        """(2,) distances of the start and the end from the centre."""
        ends = np.stack([self.start, self.end])[:, list(self.plane)]
        return np.linalg.norm(ends - self.centre, axis=1)

    @property
    def length(self) -> float:
        along = np.delete(self.end - self.start, self.plane)
        return float(np.hypot(np.mean(self.radii) * self.sweep, np.linalg.norm(along)))

    @property
    def _first_angle(self) -> float:
        x, y = self.start[list(self.plane)] - self.centre
        return float(np.arctan2(y, x))

    def at(self, s: Numbers) -> np.ndarray:
        """(M, d) positions at the lengths s, (M,)."""
        share = np.asarray(s, float) / self.length
        position = self.start + np.multiply.outer(share, self.end - self.start)
        angle = self._first_angle + share * self.sweep
        radius = self.radii[0] + share * (self.radii[1] - self.radii[0])
        round_it = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        position[..., list(self.plane)] = self.centre + radius[..., None] * round_it
        return position

    @property
    def slopes(self) -> tuple[np.ndarray, np.ndarray]:
        """The derivative of the position by the length at both ends, (d,) each."""
        found = []
        for radius, angle in zip(self.radii, (0.0, self.sweep), strict=True):
            slope = self.end - self.start
            cos, sin = np.cos(self._first_angle + angle), np.sin(self._first_angle + angle)
            around = self.sweep * radius * np.array([-sin, cos])
            slope[list(self.plane)] = around + (self.radii[1] - self.radii[0]) * np.array(
                [cos, sin]
            )
            found.append(slope / self.length)
        return found[0], found[1]


Segment = Straight | Arc


def lengths_and_slopes(segments: Sequence[Segment]) -> tuple[np.ndarray, np.ndarray]:
    """(M,) lengths of segments, and (M, 2, d) their slopes at both ends; straight ones at once."""
    ends = np.array([(segment.start, segment.end) for segment in segments])
    chords = ends[:, 1] - ends[:, 0]
    lengths = np.linalg.norm(chords, axis=1)
    with np.errstate(invalid="ignore"):  # the chord of a full circle, whose slopes follow below
        slopes = np.repeat((chords / lengths[:, None])[:, None], 2, axis=1)
    for i, segment in enumerate(segments):
        if isinstance(segment, Arc):
            lengths[i], slopes[i] = segment.length, segment.slopes
    return lengths, slopes


def turns(slopes: np.ndarray) -> np.ndarray:
    """(M-1,) the angles [rad] between segments, of (M, 2, d) slopes, where each one ends."""
    unit = slopes / np.linalg.norm(slopes, axis=-1, keepdims=True)
    a, b = unit[:-1, 1], unit[1:, 0]
    return 2 * np.arctan2(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1))


class Chain:
    """Segments one after the other as one curve over the length, with rounded corners.

        c(s) = p(s) + sum_i D_i b((s - s_i) / a),    D_i = p'(s_i+) - p'(s_i-)
        b(x) = a (int (x - v)^+ k(v) dv - x^+),      k(v) = 15/16 (1 - v^2)^2 for |v| < 1

    p is the chain of segments with its corners at s_i. A polygon is averaged over the length 2 a
    this way; arcs stay as they are. c has a continuous direction everywhere, and a continuous
    curvature where p has it on both sides of a corner. |c(s) - p(s)| is at most the tolerance, so
    each curve lies within the tolerance of the other. Both ends are met: there, the chain goes on
    as its image in the end point.

    tolerance: the largest |c(s) - p(s)|; a is chosen as large as that allows, but not above half of
        the chain's length
    """

    def __init__(self, segments: list[Segment], tolerance: float) -> None:
        self.segments = segments
        lengths, slopes = lengths_and_slopes(segments)
        self.ends, self._slopes = np.cumsum(lengths), slopes[:, 0]
        self.length = float(self.ends[-1])
        self._starts = np.array([segment.start for segment in segments])
        self._curved = np.array([isinstance(segment, Arc) for segment in segments])
        jumps = slopes[1:, 0] - slopes[:-1, 1]
        s = self.ends[:-1]
        self.corners = np.concatenate([-s[::-1], s, 2 * self.length - s[::-1]])
        d = len(segments[0].start)
        inner = jumps.reshape(-1, d)
        self.jumps = np.concatenate([-inner[::-1], inner, -inner[::-1]])
        self.reach = self._reach(tolerance) if len(inner) else self.length

    @property
    def finest(self) -> float:
        """The smallest of a and the radii of the arcs."""
        radii = (min(one.radii) for one in self.segments if isinstance(one, Arc))
        return float(min(self.reach, *radii, self.length))

    def _reach(self, tolerance: float) -> float:
        """The half width a of the average, for which the curve stays within the tolerance."""
        largest = np.max(np.linalg.norm(self.jumps, axis=1))
        least = 0.5 * self.length
        if not largest > 0:
            return least
        reach = min(least, tolerance / (_AT_CORNER * largest))
        for _ in range(200):
            near = np.add.outer(self.ends[:-1], reach * np.linspace(-1, 1, 9)).ravel()
            near = np.clip(near, 0.0, self.length)
            off = np.max(np.linalg.norm(self._rounding(near, reach), axis=1))
            if off <= tolerance:
                break
            reach *= max(0.5, 0.999 * tolerance / off)
        return reach

    def _rounding(self, s: Numbers, reach: float) -> np.ndarray:
        """(M, d) what rounding adds to the chain at the lengths s, (M,)."""
        first = np.searchsorted(self.corners, s - reach)
        last = np.searchsorted(self.corners, s + reach)
        total = np.zeros((len(s), self.jumps.shape[1]))
        for i in range(int(np.max(last - first, initial=0))):
            there = first + i < last
            at = first[there] + i
            bump = reach * _bump((s[there] - self.corners[at]) / reach)
            total[there] += bump[:, None] * self.jumps[at]
        return total

    def exact(self, s: Numbers) -> np.ndarray:
        """(M, d) positions on the segments themselves at the lengths s, (M,)."""
        s = np.asarray(s, float)
        of = np.minimum(np.searchsorted(self.ends, s, side="right"), len(self.segments) - 1)
        along = s - np.append(0.0, self.ends)[of]
        position = self._starts[of] + along[:, None] * self._slopes[of]
        curved = np.flatnonzero(self._curved[of])
        curved = curved[np.argsort(of[curved], kind="stable")]
        for at in np.split(curved, np.flatnonzero(np.diff(of[curved])) + 1):
            if len(at):
                position[at] = self.segments[of[at[0]]].at(along[at])
        return position

    def __call__(self, s: Numbers) -> np.ndarray:
        """(M, d) positions at the lengths s, (M,)."""
        s = np.asarray(s, float)
        position = self.exact(s)
        return position + self._rounding(s, self.reach) if len(self.segments) > 1 else position


_AT_CORNER = 0.15625  # b(0) / a


def _bump(x: Numbers) -> np.ndarray:
    """b(x) / a for |x| <= 1: the average of a corner less the corner itself."""
    x = np.abs(x)
    return np.maximum(_AT_CORNER - x / 2 + 15 / 16 * (x**2 / 2 - x**4 / 6 + x**6 / 30), 0.0)
