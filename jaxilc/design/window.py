"""A window of taps for a learning law, and directions in it that matter alike at all frequencies.

    u_{j+1} = keep u_j + L e_j,    L(z) = sum_i L_i z^(1 + lead + i - n),    keep(z) = keep(1/z)

What learning feels of a change of L is its share of L P, so a direction of L is a peak at one
frequency, as narrow as the taps allow, with the height 1 / |P| there. A direction of keep is a peak
of the height 1. A step of 0.01 along any of them is then a small one, and no rate need be chosen.

keep is 1 at rest and flat there, 1 - keep = O(f^4), as that of a Butterworth filter of order 2 is.
Slow errors are the largest, and no step of a search may give them away. Of several channels that
holds for keep as a matrix, which is the identity at rest. A `Tuning` moves a `ShapedFilter` along
the directions.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..pytree.aliases import Leaf
from ..pytree.fields import leaf, pytree, static
from ..schemes import LearningFilter, Scheme
from ..schemes.scheme import Feedforward
from ..signals.task import Task, Trial
from ..theory.law import Law, Taps
from .responses import Family

BANDS = 0.1, 0.03  # shares of the largest |P| down to which a delay counts
WEAKEST = 0.1  # share of the largest |P| below which a direction of L becomes no higher


class Filters(NamedTuple):
    """Taps of L and of keep, the latter symmetric.

    L:    (p,), or (p, n_u, n_y) of several channels; with S segments (S, p) or (S, p, n_u, n_y)
    keep: (p',), (p', n_u, n_u), (S, p') or (S, p', n_u, n_u)
    """

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
    unit:    (n_u, n_y) factor of a step of each pair of channels, 0 where a pair is not learned;
             None of one channel
    starts, limit, dt: as in `LearningFilter`
    """

    lead: int
    of_L: np.ndarray
    of_keep: np.ndarray
    unit: np.ndarray | None = None
    starts: tuple[int, ...] = ()
    limit: Leaf | None = None
    dt: float | None = None

    def holding(self, law: Law) -> Filters:
        """The taps of a law of one channel, in each segment; keep is made flat at rest."""
        p, q = len(self.of_L), len(self.of_keep)
        L, keep = _within(law.L, 1 + self.lead, p), _within(law.keep, 0, q)
        flat = _flat(q)
        missing = np.array([1.0, 0.0]) - flat @ keep
        return self.throughout(Filters(L, keep + np.linalg.pinv(flat) @ missing))

    def nothing(self) -> Filters:
        """A law that learns nothing: L = 0, and keep = 1 as far as it must be."""
        L = np.zeros(len(self.of_L))
        keep = np.linalg.pinv(_flat(len(self.of_keep))) @ [1.0, 0.0]
        if self.unit is not None:
            L, keep = (
                np.multiply.outer(L, self.unit),
                np.multiply.outer(keep, np.eye(len(self.unit))),
            )
        return self.throughout(Filters(L, keep))

    def throughout(self, filters: Filters) -> Filters:
        """The taps of a law that is not scheduled, in each segment."""
        if not self.starts:
            return filters
        return Filters(*(np.stack([taps] * (1 + len(self.starts))) for taps in filters))

    def unscheduled(self) -> Window:
        """This window for a law that is the same in all samples."""
        return self._replace(starts=())

    def number_of_steps(self) -> int:
        """The number of steps z."""
        filters = self.nothing()
        rest_L, rest_keep = filters.L.size // len(self.of_L), filters.keep.size // len(self.of_keep)
        return rest_L * self.of_L.shape[1] + rest_keep * self.of_keep.shape[1]

    def steps(self, start: Filters, end: Filters) -> np.ndarray:
        """The steps along the directions from some taps to others, first those of L."""
        found = []
        for of, change, unit in (
            (self.of_L, end.L - start.L, self.unit),
            (self.of_keep, end.keep - start.keep, None),
        ):
            z = along(np.linalg.pinv(of, rcond=1e-9), change)
            if unit is not None:
                z = z / np.where(unit > 0, unit, np.inf)
            found.append(z.ravel())
        return np.concatenate(found)

    def moved(self, start: Filters, z) -> Filters:
        """The taps after steps z along the directions, first those of L; also of tracers.

        Of inputs that learn from no output in common, keep passes nothing from one to the other.
        """
        found, after, unit = [], 0, self.unit
        shared = None if unit is None else (unit > 0) @ (unit > 0).T
        for taps, of, factor in ((start.L, self.of_L, unit), (start.keep, self.of_keep, shared)):
            axis = 0 if taps.ndim % 2 else 1
            shape = (*taps.shape[:axis], of.shape[1], *taps.shape[axis + 1 :])
            size = int(np.prod(shape))
            steps = z[after : after + size].reshape(shape)
            found.append(taps + along(of, steps if factor is None else steps * factor))
            after += size
        return Filters(*found)

    def of(self, filters: Filters) -> LearningFilter:
        """The scheme with these taps."""
        return LearningFilter(
            filters.L, filters.keep, self.limit, lead=self.lead, starts=self.starts, dt=self.dt
        )

    def responses(self, frequencies, dt: float) -> tuple[np.ndarray, np.ndarray]:
        """(F, p) and (F, p'), from the taps to the responses of L and of keep, the latter real."""
        angle = 2 * np.pi * dt * np.asarray(frequencies)
        p, q = len(self.of_L), len(self.of_keep)
        of_L = np.exp(1j * np.outer(angle, 1 + self.lead + _places(p)))
        return of_L, np.cos(np.outer(angle, _places(q)))


def along(matrix, taps):
    """A matrix times taps, along the axis of the taps: the first one, or the second of segments."""
    front = taps if taps.ndim % 2 else taps.swapaxes(0, 1)
    found = (matrix @ front.reshape(front.shape[0], -1)).reshape(-1, *front.shape[1:])
    return found if taps.ndim % 2 else found.swapaxes(0, 1)


def window_of(
    family: Family,
    task: Task,
    taps: tuple[int, int],
    *,
    starts: tuple[int, ...] = (),
    limit: Leaf | None = None,
    coupled: bool = True,
    lead: int | None = None,
) -> Window:
    """The window of so many taps of L and of keep.

    coupled: whether each input learns from all errors, or from that of its own channel only
    lead: of its middle tap of L, None for the mean delay of the machine, see `leads_of`
    starts, limit: as in `LearningFilter`
    """
    P = family.P[0].reshape(len(family.frequencies), -1)  # each pair of channels by itself
    lead = leads_of(family, task)[0] if lead is None else lead
    farthest = max(0, task.N - 1 - taps[0] // 2)
    of_L, at = _peaks(taps[0])
    sizes, unit = np.abs(P[:, 0]), None
    if family.P.ndim == 4:
        rows = np.linalg.norm(family.P[0], axis=2)  # what reaches each output
        top = np.max(rows, axis=0)
        sizes = np.max(rows / top, axis=1)
        inputs, outputs = family.P.shape[3], family.P.shape[2]
        unit = np.ones((inputs, 1)) / top
        unit = unit if coupled else unit * np.eye(inputs, outputs)
    size = np.interp(at / task.dt, family.frequencies, sizes)
    of_L = of_L / np.maximum(size, WEAKEST * np.max(sizes))
    of_keep = _peaks(taps[1])[0]
    even = of_keep[:, [0, *range(1, taps[1], 2)]]  # without the sines
    flat = _flat(taps[1])
    even = even - np.linalg.pinv(flat) @ (flat @ even)
    lead = min(max(lead, 0), farthest)
    return Window(lead, of_L, even, unit, starts, limit, float(task.dt))


def leads_of(family: Family, task: Task) -> list[int]:
    """Leads at which the taps of L may lie, by mean delays of the nominal machine.

    The delay of a frequency counts by |P|^2; then alike where |P| is within `BANDS[0]` of its
    largest value; then by 1 / |P|^2, as it does for the inverse of P, where |P| is within
    `BANDS[1]`. They differ where a slow pole delays what is slow, which its inverse undoes by
    taps that lie together.
    """
    angle = 2 * np.pi * family.frequencies * task.dt
    P = family.P[0].reshape(len(angle), -1)
    delay = -np.gradient(np.unwrap(np.angle(P), axis=0), angle, axis=0)
    size = np.abs(P) / np.max(np.abs(P), axis=0)
    far, farther = (size >= share for share in BANDS)
    weights = size**2, far, farther / np.maximum(size, BANDS[1]) ** 2
    widths = np.gradient(angle)[:, None]
    means = [np.sum(delay * weight * widths) / np.sum(weight * widths) for weight in weights]
    return [max(0, round(float(mean)) - 1) for mean in means]


@pytree
class ShapedFilter(Scheme):
    """A `LearningFilter` whose taps are start + directions z.

    z:    (P,) steps, first those of L
    L, keep: taps at z = 0, see `Filters`
    of_L, of_keep: directions as columns, unit: factors of the steps; see `Window`
    lead, limit, starts: as in `LearningFilter`
    """

    z: Leaf = leaf()
    L: Leaf = leaf()
    keep: Leaf = leaf()
    of_L: Leaf = leaf()
    of_keep: Leaf = leaf()
    lead: int = static(default=0, interval="[0, inf)", whole=True)
    unit: Leaf | None = leaf(default=None, optional=True)
    limit: Leaf | None = leaf(default=None, interval="(0, inf)", optional=True)
    starts: tuple[int, ...] = static(default=())
    clips = ("limit",)

    @classmethod
    def around(cls, window: Window, start: Filters) -> ShapedFilter:
        """The filter with these taps at z = 0."""
        z = [0.0] * window.number_of_steps()
        return cls(
            z, start.L, start.keep, window.of_L, window.of_keep, window.lead, window.unit,
            window.limit, starts=window.starts,
        )  # fmt: skip

    def taps(self) -> LearningFilter:
        """The filter by its taps."""
        directions = self.of_L, self.of_keep, self.unit
        window = Window(self.lead, *directions, self.starts, self.limit)
        return window.of(window.moved(Filters(self.L, self.keep), self.z))

    def segments(self) -> list[LearningFilter]:
        """As of a `LearningFilter`."""
        return self.taps().segments()

    def check(self, task: Task) -> None:
        self.taps().check(task)

    def learn(self, memory: Feedforward, trial: Trial) -> Feedforward:
        return self.taps().learn(memory, trial)


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
