"""Whether an error is still falling, has settled, or grows: its course over the trials, in words.

    diverges  the error of a trial is not finite
    grows     that of the last trial is more than 1 + GROWTH times that of the best trial, as in
              `learning.divergence`
    falls     the median of the last trials is more than CHANGE below each trial before them
    settled   none of these; from the first trial on whose error is within CHANGE of that median

The last trials are a tenth of them, and three at least. Errors below EXACT of the first one count
as zero, since rounding alone moves them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import median
from typing import NamedTuple

from ..learning.divergence import GROWTH
from .words import number

DIVERGES, GROWS, FALLS, SETTLED, SINGLE = "diverges", "grows", "falls", "settled", "single"
CHANGE = 0.05  # share of an error that counts as a change, as in `jaxilc design`
EXACT = 1e-9
WINDOW = 3  # trials


class Trend(NamedTuple):
    """The course of an error over the trials.

    kind: `diverges`, `grows`, `falls`, `settled`, or `single` for one trial
    words: the end of a sentence whose subject is the error, empty for one trial
    best: number of the best trial
    """

    kind: str
    words: str
    best: int


def trend_of(errors: Sequence[float]) -> Trend:
    """The trend of the errors of J trials, infinite where a trial diverged."""
    first, J = errors[0], len(errors)
    if not all(math.isfinite(error) for error in errors):
        return Trend(DIVERGES, "diverges", _best(errors))
    if J == 1:
        return Trend(SINGLE, "", 1)
    level = [max(error, EXACT * first) for error in errors]
    best = _best(level)
    if level[-1] > (1 + GROWTH) * level[best - 1]:
        times = f" {number(level[-1] / level[best - 1])} times" if level[best - 1] > 0 else ""
        return Trend(GROWS, f"has grown{times} since trial {best}", best)
    window = min(max(WINDOW, J // 10), J - 1)
    last = median(level[-window:])
    if last < (1 - CHANGE) * min(level[:-window]):
        return Trend(FALLS, "is still falling", best)
    since = 1 + next(i for i, error in enumerate(level) if error <= last / (1 - CHANGE))
    if since == 1:
        return Trend(SETTLED, f"has not fallen by {CHANGE:.0%} since trial 1", best)
    return Trend(SETTLED, f"has settled since trial {since}", best)


def _best(errors: Sequence[float]) -> int:
    """The number of the first trial with the least error; 1 if none is finite."""
    return 1 + min(range(len(errors)), key=lambda i: (not math.isfinite(errors[i]), errors[i]))
