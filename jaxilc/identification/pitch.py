"""How a signal repeats: with which pitch in the position, from a record, and whether in its trial.

Two thirds of a trial choose the period and its harmonics; the other third, which they have not
seen, judges them. So do the first two thirds with the last one, and the last two with the first.
Over even steps, as of the time, the mean of all periods that are seen foretells the rest, too: few
long periods of any shape, where three harmonics tell many short ones. The better of both counts.
A period that even steps show has a sample for each half wave of its harmonics: faster ones would
look like slow ones.
"""

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
        cosine, sine = np.cos(angle), np.sin(angle)
        found += [-k * sine, k * cosine] if slope else [cosine, sine]
    return np.stack(found, axis=1)


# Whether an error repeats within its trial
# --------------------------------------------------------------------------------------------------

ORDERS = 1, 2, 3
PERIODS = 3, 40  # within what is seen, at least and at most
SAMPLES = 1000  # to which a trial is averaged, about
JUDGED = 0.7  # share of the squares that is foretold, from which it repeats


class Recurrence(NamedTuple):
    """How a signal repeats within its trial.

    period: [unit of what it repeats over], from the first two thirds
    share: of the squares of the third that was not seen, as far as it is foretold; the smaller one
    """

    period: float
    share: float

    @property
    def repeats(self) -> bool:
        return self.share >= JUDGED


def recurrence_of(over, signal) -> Recurrence | None:
    """How a signal (N,) repeats over the time, or over a position; None where nothing can be told.

    That is so where the position does not move enough, and in short records.
    """
    block = max(1, len(signal) // SAMPLES)
    x, s = (
        np.asarray(a, float)[: len(signal) // block * block].reshape(-1, block).mean(axis=1)
        for a in (over, signal)
    )
    third = len(x) // 3
    ways = ((slice(0, 2 * third), slice(2 * third, None)), (slice(third, None), slice(0, third)))
    found = []
    try:
        for how in (_foretold, _repeated) if _even_step(x) else (_foretold,):
            both = [how(x, s, *way) for way in ways]
            found.append(Recurrence(both[0].period, min(one.share for one in both)))
    except ValueError:  # too short, at rest, or nothing but a line
        return None
    return max(found, key=lambda one: one.share)


def _even_step(x) -> float:
    """The step from sample to sample; 0 where steps differ, or there is none."""
    steps = np.diff(x) if len(x) > 1 else np.zeros(1)
    step = abs(float(steps[0]))
    return step if float(np.ptp(steps)) <= 1e-6 * step else 0.0


def _repeated(x, s, seen: slice, rest: slice) -> Recurrence:
    """The period with which a part that is seen repeats itself, of any shape."""
    line, n = beside(x), len(s[seen])
    flat = s - line @ np.linalg.lstsq(line[seen], s[seen])[0]
    part = flat[seen]
    lags = np.arange(n // PERIODS[1] + 1, n // 2 + 1)
    off = np.array([np.mean((part[lag:] - part[:-lag]) ** 2) for lag in lags])
    off[: int(np.argmax(off > np.var(part)))] = np.inf  # a smooth signal is like its next samples
    at = int(np.argmin(off))
    alike = off[at] + ALIKE * 2 * float(np.var(part))
    parts = [lag for k in range(5, 1, -1) if (lag := round(lags[at] / k)) >= lags[0]]
    period = next((lag for lag in parts if off[lag - lags[0]] <= alike), lags[at])
    phase = np.arange(len(s)) % period
    mean = np.bincount(phase[seen], part) / np.bincount(phase[seen])
    return Recurrence(float(period * abs(x[1] - x[0])), _share(s, mean[phase], line, rest))


def _share(s, foretold, line, rest: slice) -> float:
    """The share of the squares of the rest that is foretold.

    A slope of the rest, or its constant, is none of the period's.
    """
    both = np.stack([s, foretold], axis=1)[rest]
    whole, told = (both - line[rest] @ np.linalg.lstsq(line[rest], both)[0]).T
    left = float(np.sum((whole - told) ** 2))
    return max(0.0, 1 - left / max(float(whole @ whole), 1e-300))


def _foretold(x, s, seen: slice, rest: slice) -> Recurrence:
    """The period of a part that is seen, and what it foretells of the rest."""
    span = float(np.ptp(x[seen]))
    least = max(span / PERIODS[1], 2 * max(ORDERS) * _even_step(x))
    found = pitch_of(x[seen], s[seen], least=least, most=span / PERIODS[0], orders=ORDERS)
    line, of_period = beside(x), waves(x, 1 / found.pitch, ORDERS)
    weights = np.linalg.lstsq(np.hstack([line, of_period])[seen], s[seen])[0]
    foretold = of_period @ weights[line.shape[1] :]
    return Recurrence(found.pitch, _share(s, foretold, line, rest))
