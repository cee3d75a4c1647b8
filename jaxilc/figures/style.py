"""The common style of all figures: colours, dashes, marks, limits, and numbers with SI prefixes."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, TypeAlias, TypedDict

import numpy as np

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axis import Axis as AxisOfPaper
    from matplotlib.typing import ColorType

Dash: TypeAlias = str | tuple[int, tuple[int, ...]]
# Colour-blind readers can distinguish these colours.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#000000")
DASHES: tuple[Dash, ...] = ("-", "--", "-.", ":", (0, (5, 1)), (0, (3, 1, 1, 1)), (0, (1, 1)))
MARKS = ("s", "^", "D", "x", "P", "*", "p")  # circles are printed numbers
BLACK, GREY, PALE = "#000000", "#737373", "#999999"
# What has a look of its own, so that it is the same in each figure: laws before and after a tuning,
# and the schemes of each paper.
LOOKS = {
    name: number
    for names in (
        "tuned given",
        "pid cfdl-mfailc pfdl-mfailc ffdl-mfailc ilc-mfapc cfdl-mfapc",
        "feedback feedforward p-type higher-order fixed-filter switchable stop ladder series",
        "pid smc asmc ilc-asmc",
        "dilc milc",
    )
    for number, name in enumerate(names.split())
}
POINTS = 8  # of a curve that have a mark, about
BOUND = 11  # the mark of a printed upper bound, a caret below it
LARGEST = 1e300  # number that is drawn; the ends of an axis beyond it may not be finite


class Style(TypedDict, total=False):
    """Fields of a curve."""

    colour: str
    dash: Dash
    mark: str
    marked: tuple[int, int]
    size: float
    filled: bool


def names_of(dataset: xr.Dataset) -> list[str]:
    """The names of the schemes."""
    return [str(s) for s in dataset["scheme"].values]


def colour_of(i: int) -> str:
    """The colour of the i-th of several."""
    return COLOURS[i % len(COLOURS)]


def style_of(i: int) -> Style:
    """Colour and dash of the i-th scheme; no two of the first 49 have the same."""
    return {"colour": colour_of(i), "dash": DASHES[(i + i // len(COLOURS)) % len(DASHES)]}


def numbers_of(names: Iterable[str]) -> list[int]:
    """The number of the look of each name, for `style_of`; a name without its own takes a free one.

    So a scheme that is drawn alone, or beside fewer others, keeps its colour.
    """
    names = list(names)
    found: dict[str, int] = {}
    for name in names:
        own = LOOKS.get(name)
        if own is not None and own not in found.values():
            found[name] = own
    free = (i for i in itertools.count() if i not in found.values())
    return [found[name] if name in found else found.setdefault(name, next(free)) for name in names]


def marks_of(i: int, points: int) -> Style:
    """Open marks of the i-th curve, at other points than its neighbours, so that all are seen."""
    every = max(points // POINTS, 1)
    mark = MARKS[(i + i // len(MARKS)) % len(MARKS)]
    return {"mark": mark, "marked": (i % every, every), "size": 4, "filled": False}


def shades_of(trials: Sequence[int]) -> list[str]:
    """A colour for each trial, from yellow over green to dark blue for the last one.

    They differ in lightness too, for print and for readers who are blind to some colours.
    """
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    if len(trials) == 1:
        return [COLOURS[0]]
    return [to_hex(colormaps["viridis"](1.0 - at)) for at in np.linspace(0.25, 0.95, len(trials))]


def labelled(name: str, unit: str) -> str:
    """A label such as `settled error [µm]`; a path such as `ilc.gamma_p` stays as it is typed."""
    words = (word if "." in word else word.replace("_", " ") for word in name.split(" "))
    return " ".join(words) + (f" [{unit}]" if unit else "")


def readable(colour: ColorType, ground: ColorType = "white", least: float = 4.5) -> str:
    """A colour for text: the one given, or as much darker or lighter as the ground asks for.

    least: contrast of the text and its ground, (L1 + 0.05) / (L2 + 0.05) of their luminances, the
        lighter one first; 4.5 is what the Web Content Accessibility Guidelines 2.2 ask for (AA)
    """
    from matplotlib.colors import to_hex, to_rgb

    rgb, behind = np.array(to_rgb(colour)), luminance(ground)
    end = np.zeros(3) if behind > 0.18 else np.ones(3)
    for share in np.linspace(0.0, 1.0, 41):
        mixed = (1 - share) * rgb + share * end
        high, low = max(luminance(mixed), behind), min(luminance(mixed), behind)
        if (high + 0.05) / (low + 0.05) >= least:
            break
    return to_hex(mixed)


def luminance(colour: ColorType) -> float:
    """The relative luminance of a colour of sRGB, from 0 to 1 (WCAG 2.2)."""
    from matplotlib.colors import to_rgb

    rgb = np.array(to_rgb(colour))
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def placed(values) -> np.ndarray:
    """Values as figures show them: NaN in place of what is too large for the ticks of an axis."""
    values = np.asarray(values, float)
    return np.where(np.abs(values) <= LARGEST, values, np.nan)


def limits_of(values, *, pad: float = 1.5) -> tuple[float, float] | None:
    """Limits of a logarithmic axis that hold all positive finite values, and no empty decade.

    pad: factor between the outermost values and the ends
    """
    found = placed(values)
    found = found[found > 0]
    return (found.min() / pad, found.max() * pad) if found.size else None


def edges_of(x: Sequence[float] | np.ndarray, log: bool) -> np.ndarray:
    """(n+1,) the edges of the cells of n values, in the middle between them on their axis."""
    at = np.log(x) if log else np.asarray(x, float)
    middle = (at[1:] + at[:-1]) / 2
    ends = np.concatenate([[2 * at[0] - middle[0]], middle, [2 * at[-1] - middle[-1]]])
    return np.exp(ends) if log else ends


# Numbers with SI prefixes: 6.3e-5 mm is written as 63 nm
# --------------------------------------------------------------------------------------------------


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
    number, name = prefixed(float(f"{value:.{digits}g}"), unit)  # 999.9 nm is 1 µm, not 1e+03 nm
    return f"{number:.{digits}g} {name}".rstrip()


def name_axis(axis: AxisOfPaper, name: str, unit: str) -> None:
    """Label an axis, after all curves are drawn and its limits are set.

    Where numbers of a logarithmic axis would be smaller than 0.1 or larger than 1000, each tick has
    its own prefix and unit, such as 100 nm; on a linear axis the unit of the label is changed.
    """
    low, high = sorted(axis.get_view_interval())
    known = power_of(unit)
    axis.set_label_text(labelled(name, unit))
    if axis.get_scale() == "log":
        _log_ticks(axis, low, high)
        if known and (low < READABLE[0] * 0.999 or high > READABLE[1] * 1.001):
            axis.set_major_formatter(lambda value, _: written(value, unit))
            axis.set_label_text(labelled(name, ""))
        return
    largest = max(abs(low), abs(high))
    if not known or not math.isfinite(largest) or READABLE[0] <= largest <= 2 * READABLE[1]:
        return
    number, shown = prefixed(largest, unit)
    factor = number / largest
    axis.set_major_formatter(lambda value, _: f"{factor * value:.6g}")
    axis.set_label_text(labelled(name, shown))


def _log_ticks(axis: AxisOfPaper, low: float, high: float) -> None:
    """Plain numbers; ticks at 1, 2 and 5 on fewer than two decades, at each decade on a few."""
    from matplotlib.ticker import LogLocator, NullFormatter

    few = high < 1e2 * low
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if few else (1.0,), numticks=10))
    axis.set_major_formatter(lambda value, _: _plain(value))
    axis.set_minor_formatter(NullFormatter())


def _plain(value: float) -> str:
    """A number as text; one that is very small or very large as a power of ten."""
    if value == 0 or SMALL <= abs(value) < LARGE:
        return f"{value:g}"
    power, sign = math.floor(math.log10(abs(value)) + 1e-9), "-" if value < 0 else ""
    times = "" if math.isclose(abs(value), 10.0**power) else rf"{abs(value) / 10.0**power:g}\cdot"
    return f"${sign}{times}10^{{{power}}}$"
