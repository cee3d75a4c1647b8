"""The pitch with which a signal repeats in the position, from a record."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

from ..pytree.aliases import Numbers, Value
from ..pytree.in_short import in_short
from ..pytree.ranges import require

FINE = 8  # pitches tried for each turn more or less over the range
MOST = 200_000  # pitches that are tried
ALIKE = 0.02  # share of the explained squares by which a shorter pitch may be behind


class Pitch(NamedTuple):
    """What `pitch_of` found.

    pitch: the period [unit of position]
    doubt: its standard error, if what is left is white; other rests make it larger
    amplitudes: (len(orders),) of the harmonics [unit of signal]
    share: of the squares of the signal that the harmonics explain, 0 to 1
    """

    pitch: float
    doubt: float
    amplitudes: np.ndarray
    share: float
    __repr__ = in_short


def pitch_of(
    position: Value,
    signal: Value,
    *,
    least: float,
    most: float,
    orders: tuple[int, ...] = (1, 2, 3),
    known: Sequence[float] = (),
) -> Pitch:
    """The pitch with which a signal repeats over the position, by least squares.

        signal ~ c_0 + c_1 x + c_2 s + sum_i a_i cos(2 pi i x / pitch) + b_i sin(2 pi i x / pitch)

    s is the direction of motion, so that friction does not count as a harmonic. All pitches from
    `least` to `most` are tried, so closely that none is missed, and the best one is refined. Where
    a part of it explains as much (all orders fit a multiple of the pitch too), the part is taken.

    position: (N,) where it was, over two of the longest pitches or more
    signal: (N,) an error, an input or a torque there
    least, most: range of the pitch [unit of position]
    orders: harmonics that are looked for
    known: other pitches, such as that of the magnets beside that of the screw; what their harmonics
        of the same orders explain is no part of the one that is looked for

    Raises ValueError for signals that do not fit, for a motion that is shorter than two pitches of
    `most`, for a range of more pitches than can be tried, and for orders that are no harmonics.
    """
    x, s = (np.asarray(a, float).ravel() for a in (position, signal))
    require("pitch_of", "least", least, "(0, inf)")
    require("pitch_of", "most", most, f"({least:g}, inf)")
    if not orders:
        raise ValueError("pitch_of: orders = () is empty; allowed is at least one")
    for order in orders:
        require("pitch_of", "orders", order, "[1, inf)", whole=True)
    if len(x) != len(s) or len(x) < 10 * len(orders) + 10:
        raise ValueError(
            f"pitch_of: position {x.shape} and signal {s.shape}; allowed are as many of each, "
            f"{10 * len(orders) + 10} or more"
        )
    if not (np.all(np.isfinite(x)) and np.all(np.isfinite(s))):
        raise ValueError("pitch_of: position or signal is not finite")
    span = float(np.ptp(x))
    if span < 2 * most:
        raise ValueError(
            f"pitch_of: most = {most:g} with a motion over {span:g}; allowed is at most half of it"
        )
    count = int(FINE * max(orders) * span * (1 / least - 1 / most)) + 2
    if count > MOST:
        raise ValueError(
            f"pitch_of: least = {least:g} makes {count:,} pitches to try over {span:g}; allowed "
            f"are {MOST:,}"
        )
    for pitch in known:
        require("pitch_of", "known", pitch, "(0, inf)")
    line = np.hstack([beside(x), *(waves(x, 1 / pitch, orders) for pitch in known)])
    rest = s - line @ np.linalg.lstsq(line, s)[0]
    total = float(rest @ rest)
    if total <= 1e-24 * float(s @ s):
        raise ValueError("pitch_of: the signal is a straight line and a direction, and no more")

    def explained(per: float) -> float:
        """The squares that the harmonics of 1 / per explain, beside the rest."""
        A = np.hstack([line, waves(x, per, orders)])
        return total - float(np.sum((s - A @ np.linalg.lstsq(A, s)[0]) ** 2))

    grid = np.linspace(1 / most, 1 / least, count)
    best = grid[int(np.argmax([explained(per) for per in grid]))]
    step = grid[1] - grid[0]

    def refined(near: float) -> float:
        width = (max(near - step, 0.5 / most), near + step)
        return float(minimize_scalar(lambda p: -explained(p), bounds=width, method="bounded",
                                     options={"xatol": 1e-9 * near}).x)  # fmt: skip

    best = refined(best)
    for part in range(max(orders), 1, -1):
        if part * best <= 1 / least:
            shorter = refined(part * best)
            if explained(shorter) >= (1 - ALIKE) * explained(best):
                best = shorter
                break
    A = np.hstack([line, waves(x, best, orders)])
    c = np.linalg.lstsq(A, s)[0]
    own = c[line.shape[1] :]
    left = s - A @ c
    slope = waves(x, best, orders, slope=True) @ own
    slope = slope - A @ np.linalg.lstsq(A, slope)[0]
    noise = np.sqrt(left @ left / (len(x) - A.shape[1] - 1))
    return Pitch(
        1 / best,
        float(noise / np.linalg.norm(slope) / best**2),
        np.hypot(*own.reshape(-1, 2).T),
        1 - float(left @ left) / total,
    )


def beside(x: Numbers) -> Numbers:
    """(N, 3) what counts as no harmonic: a constant, a slope, and the direction of motion."""
    return np.stack([np.ones_like(x), x - np.mean(x), np.sign(np.gradient(x))], axis=1)


def waves(x: Numbers, per: float, orders: tuple[int, ...], slope: bool = False) -> Numbers:
    """(N, 2 len(orders)) cosine and sine of each harmonic, or their derivative by 1 / pitch."""
    found = []
    for i in orders:
        angle, k = 2 * np.pi * i * per * x, 2 * np.pi * i * x
        found += (
            [-k * np.sin(angle), k * np.cos(angle)] if slope else [np.cos(angle), np.sin(angle)]
        )
    return np.stack(found, axis=1)
