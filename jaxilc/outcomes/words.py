"""Numbers and counted sentences as text."""

from __future__ import annotations

import re
from collections.abc import Iterable

import numpy as np

from ..figures.units import prefixed

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


def counted(reasons: Iterable[str]) -> dict[str, int]:
    """The number of times that each reason is given.

    Reasons that differ only in their numbers are counted together, with the range of each number.
    """
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
