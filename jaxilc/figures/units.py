"""Axes whose numbers have SI prefixes: 6.3e-5 mm is written as 63 nm."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

if TYPE_CHECKING:
    from matplotlib.axis import Axis

PREFIXES = {"p": -12, "n": -9, "µ": -6, "m": -3, "": 0, "k": 3, "M": 6}
SPELLED = {"u": "µ", "μ": "µ"}  # a letter and another code point for the same prefix
# Units that take prefixes, with the largest prefix that a reader expects of each.
PREFIXED = {"m": 0, "rad": 0, "V": 3, "A": 3, "N": 6, "s": 0, "W": 6, "Nm": 3, "Pa": 6, "Hz": 6}
SMALL, LARGE = 1e-3, 1e5  # numbers within are written without a power of ten
READABLE = (0.1, 1000.0)  # numbers within are read without another prefix


def power_of(unit: str) -> tuple[int, str] | None:
    """The power of ten of the prefix of a unit, and the unit without it; None for another unit."""
    if unit in PREFIXED:
        return 0, unit
    prefix = SPELLED.get(unit[:1], unit[:1])
    return (PREFIXES[prefix], unit[1:]) if prefix in PREFIXES and unit[1:] in PREFIXED else None


def prefixed(value: float, unit: str) -> tuple[float, str]:
    """A value with the prefix that leaves a number from 1 to 1000: (6.3e-5, mm) is (63, nm).

    Values of a unit without prefixes, zero, and values that are not finite are as given.
    """
    known = power_of(unit)
    if known is None or value == 0 or not math.isfinite(value):
        return value, unit
    power, plain = known
    # Ten digits are kept, so that a rounding error does not turn 1 µm into 1000 nm.
    size = math.floor(math.log10(float(f"{abs(value):.10g}"))) + power
    of_prefix = min(max(3 * math.floor(size / 3), -12), PREFIXED[plain])
    prefix = next(name for name, n in PREFIXES.items() if n == of_prefix)
    return value * 10.0 ** (power - of_prefix), prefix + plain


def written(value: float, unit: str, digits: int = 3) -> str:
    """A value as text with its prefix and unit, such as `63 nm`."""
    number, name = prefixed(value, unit)
    return f"{number:.{digits}g} {name}".rstrip()


def name_axis(axis: Axis, name: str, unit: str) -> None:
    """Label an axis, after all curves are drawn and its limits are set.

    Where numbers of a logarithmic axis would be smaller than 0.1 or larger than 1000, each tick has
    its own prefix and unit, such as 100 nm; on a linear axis the unit of the label is changed.
    """
    low, high = sorted(axis.get_view_interval())
    known = power_of(unit)
    name = name.replace("_", " ")
    axis.set_label_text(name + (f" [{unit}]" if unit else ""))
    if axis.get_scale() == "log":
        _log_ticks(axis, low, high)
        if known and (low < READABLE[0] * 0.999 or high > READABLE[1] * 1.001):
            axis.set_major_formatter(FuncFormatter(lambda value, _: written(value, unit)))
            axis.set_label_text(name)
        return
    largest = max(abs(low), abs(high))
    if not known or not math.isfinite(largest) or READABLE[0] <= largest <= 2 * READABLE[1]:
        return
    number, shown = prefixed(largest, unit)
    factor = number / largest
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{factor * value:.6g}"))
    axis.set_label_text(f"{name} [{shown}]")


def _log_ticks(axis: Axis, low: float, high: float) -> None:
    """Plain numbers; ticks at 1, 2 and 5 on fewer than two decades, at each decade on a few."""
    few = high < 1e2 * low
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if few else (1.0,), numticks=10))
    axis.set_major_formatter(FuncFormatter(lambda value, _: _plain(value)))
    axis.set_minor_formatter(NullFormatter())


def _plain(value: float) -> str:
    """A number as text; one that is very small or very large as a power of ten."""
    if value == 0 or SMALL <= abs(value) < LARGE:
        return f"{value:g}"
    power, sign = math.floor(math.log10(abs(value)) + 1e-9), "-" if value < 0 else ""
    times = "" if math.isclose(abs(value), 10.0**power) else rf"{abs(value) / 10.0**power:g}\cdot"
    return f"${sign}{times}10^{{{power}}}$"
