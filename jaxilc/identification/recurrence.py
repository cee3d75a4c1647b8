"""Whether an error repeats within its trial, over the time or over the position.

Two thirds of a trial choose the period and its harmonics; the other third, which they have not
seen, judges them. So do the first two thirds with the last one, and the last two with the first.
Over even steps, as of the time, the mean of all periods that are seen foretells the rest, too: few
long periods of any shape, where three harmonics tell many short ones. The better of both counts.
A period that even steps show has a sample for each half wave of its harmonics: faster ones would
look like slow ones.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .pitch import ALIKE, beside, pitch_of, waves

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
