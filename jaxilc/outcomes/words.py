"""Numbers, counts and the course of an error, in words."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from statistics import median
from typing import NamedTuple

import numpy as np

from ..figures.style import prefixed
from ..learning.divergence import GROWTH

NUMBER = re.compile(r"(?<![\w.])\d+(?:\.\d+)?(?:e[+-]?\d+)?(?![\w])")


def number(value: float) -> str:
    """A number with three significant digits; ∞ for an error that diverged, – for NaN."""
    if not np.isfinite(value):
        return "∞" if value == np.inf else "–"
    if value == 0 or 1e-3 <= abs(value) < 1e5:
        return np.format_float_positional(value, precision=3, fractional=False, trim="-")
    return f"{value:.2e}"


def sized(value: float, unit: str) -> str:
    """A number with its unit, with a prefix such as µ."""
    return " ".join(filter(None, (number((of := prefixed(value, unit))[0]), of[1])))


def several(count: int, one: str) -> str:
    """A count with its noun, in the plural unless it is one."""
    return f"{count} {one}{'s' * (count != 1)}"


def counted(reasons: Iterable[str]) -> dict[str, int]:
    """How often each reason is given; where numbers alone differ, as one with their ranges."""
    groups: dict[str, list[list[float]]] = {}
    for reason in reasons:
        groups.setdefault(NUMBER.sub("{}", reason), []).append(
            [float(x) for x in NUMBER.findall(reason)]
        )
    return {
        text.format(*map(_range, zip(*rows, strict=True))): len(rows)
        for text, rows in groups.items()
    }


def _range(values) -> str:
    low, high = (f"{end(values):.6g}" for end in (min, max))
    return low if low == high else f"{low} to {high}"


# The course of an error over the trials
# --------------------------------------------------------------------------------------------------


DIVERGES, GROWS, FALLS, SETTLED, SINGLE = "diverges", "grows", "falls", "settled", "single"
CHANGE = 0.05  # share of an error that counts as a change, as in `jaxilc design`
EXACT = 1e-9
WINDOW = 3  # trials


class Trend(NamedTuple):
    """The course of an error over the trials, and the number of the best one.

    kind: `diverges`, `grows`, `falls`, `settled`, or `single` for one trial
    words: the end of a sentence whose subject is the error, empty for one trial
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
