"""The common style of all figures: colours, line styles, marks, axes, ticks, labels with units."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from .units import name_axis

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes

# Colour-blind readers can distinguish these colours.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#000000")
DASHES = ("-", "--", "-.", ":", (0, (5, 1)), (0, (3, 1, 1, 1)), (0, (1, 1)))
MARKS = ("s", "^", "D", "x", "P", "*", "p")  # circles are printed numbers


def names_of(dataset: xr.Dataset) -> list[str]:
    """The names of the schemes."""
    return [str(s) for s in dataset["scheme"].values]


def style_of(i: int) -> dict[str, Any]:
    """Colour and line style of the i-th scheme; no two of the first 49 have the same."""
    return {
        "color": COLOURS[i % len(COLOURS)],
        "linestyle": DASHES[(i + i // len(COLOURS)) % len(DASHES)],
    }


def marks_of(i: int, points: int, marks: int = 8) -> dict[str, Any]:
    """Open marks at some points of the i-th curve.

    Neighbouring curves have their marks at different points, so that curves that coincide are seen.
    """
    every = max(points // marks, 1)
    return {
        "marker": MARKS[(i + i // len(MARKS)) % len(MARKS)],
        "markevery": (i % every, every),
        "markersize": 4,
        "mfc": "none",
    }


def shades_of(trials: Sequence[int]) -> list[Any]:
    """A colour for each trial, from yellow over green to dark blue for the last one.

    The colours differ in lightness too, so that they can be told apart in print and by readers who
    are blind to some colours.
    """
    from matplotlib import colormaps

    if len(trials) == 1:
        return [COLOURS[0]]
    return [colormaps["viridis"](1.0 - at) for at in np.linspace(0.25, 0.95, len(trials))]


def new_axes(
    ax: Any, rows: int = 1, columns: int = 1, *, size: tuple[float, float] | None = None, **kwargs
) -> Any:
    """The given axes, or those of a new figure.

    size: width and height [in]; None for a height of 2.6 in for each row
    """
    if ax is not None:
        return ax
    from matplotlib.figure import Figure

    figure = Figure(figsize=size or (7.2, 1.6 + 2.6 * rows), layout="constrained", dpi=150)
    shared: dict[str, Any] = {"sharex": columns == 1}
    return figure.subplots(rows, columns, **(shared | kwargs))


def labelled(name: str, unit: str) -> str:
    """A label such as `settled error [µm]`."""
    return name.replace("_", " ") + (f" [{unit}]" if unit else "")


def grid(ax: Axes) -> None:
    """Add a pale grid after all curves are drawn, and plain numbers on logarithmic axes."""
    ax.grid(True, alpha=0.25)
    for axis in (ax.xaxis, ax.yaxis):
        if axis.get_scale() == "log":
            name_axis(axis, axis.get_label_text(), "")
            low, high = sorted(axis.get_view_interval())
            if high < 1e2 * low:
                axis.grid(True, which="minor", alpha=0.15)


def trial_axis(ax: Axes, ticks: int = 10) -> None:
    """Set ticks at whole numbers of trials along x, so many at most."""
    from matplotlib.ticker import MaxNLocator

    ax.set_xlabel("trial")
    ax.xaxis.set_major_locator(MaxNLocator(ticks, integer=True))


def legend_beside(ax: Axes) -> None:
    """Place the legend to the right of the axes, where it hides nothing."""
    ax.legend(fontsize="small", loc="upper left", bbox_to_anchor=(1.0, 1.02))


def legend_above(ax: Axes, columns: int = 2) -> None:
    """Place the legend above the axes, for long names; the axes then have no title."""
    ax.legend(fontsize="small", loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=columns)


def readable(colour: Any, ground: Any = "white", least: float = 4.5) -> str:
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


def luminance(colour: Any) -> float:
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
