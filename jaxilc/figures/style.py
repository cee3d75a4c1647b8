"""The common style of all figures: colours, dashes, marks, labels with units, limits."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, TypeAlias, TypedDict

import numpy as np

if TYPE_CHECKING:
    import xarray as xr
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
BOUND = 11  # the mark of a printed upper bound, a caret below it


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


def marks_of(i: int, points: int, marks: int = 8) -> Style:
    """Open marks at some points of the i-th curve.

    Neighbouring curves have their marks at different points, so that curves that coincide are seen.
    """
    every = max(points // marks, 1)
    mark = MARKS[(i + i // len(MARKS)) % len(MARKS)]
    return {"mark": mark, "marked": (i % every, every), "size": 4, "filled": False}


def shades_of(trials: Sequence[int]) -> list[str]:
    """A colour for each trial, from yellow over green to dark blue for the last one.

    The colours differ in lightness too, so that they can be told apart in print and by readers who
    are blind to some colours.
    """
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    if len(trials) == 1:
        return [COLOURS[0]]
    return [to_hex(colormaps["viridis"](1.0 - at)) for at in np.linspace(0.25, 0.95, len(trials))]


def labelled(name: str, unit: str) -> str:
    """A label such as `settled error [µm]`."""
    return name.replace("_", " ") + (f" [{unit}]" if unit else "")


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


def limits_of(values, *, pad: float = 1.5) -> tuple[float, float] | None:
    """Limits of a logarithmic axis that hold all positive finite values, and no empty decade.

    pad: factor between the outermost values and the ends
    """
    found = np.asarray(values, float)
    found = found[np.isfinite(found) & (found > 0)]
    return (found.min() / pad, found.max() * pad) if found.size else None


def edges_of(x: Sequence[float] | np.ndarray, log: bool) -> np.ndarray:
    """(n+1,) the edges of the cells of n values, in the middle between them on their axis."""
    at = np.log(x) if log else np.asarray(x, float)
    middle = (at[1:] + at[:-1]) / 2
    ends = np.concatenate([[2 * at[0] - middle[0]], middle, [2 * at[-1] - middle[-1]]])
    return np.exp(ends) if log else ends
