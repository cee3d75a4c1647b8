"""A figure, described once: its panels, their axes, and what is drawn in layers.

A description has no library of plots in it. `paper.draw` turns it into axes of Matplotlib, and
`page.live` into a model of Bokeh that answers to the pointer; colours, dashes and marks mean the
same in both. Arrays of a layer are in the units of the axes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from .style import BLACK, COLOURS, Dash

Ends = tuple[float | None, float | None]
Place: TypeAlias = Literal["", "beside", "above", "best", "lower left", "upper right"]
Points: TypeAlias = Sequence[float] | np.ndarray
MOST_TIPS = 12  # parameters that the pointer shows
Tips: TypeAlias = Mapping[str, Sequence[object] | np.ndarray]


class Axis(NamedTuple):
    """What an axis shows.

    name, unit: a unit of the SI gets the prefix that is read best
    log: whether it is logarithmic
    ends: its ends, None for those that follow from the layers; they may fall
    whole: whether it has whole numbers only;  most: ticks at most, 0 for as many as fit
    ticks: where they are; empty for where they fit
    names: texts that stand at 0, 1, 2 ... in place of numbers
    """

    name: str = ""
    unit: str = ""
    log: bool = False
    ends: Ends | None = None
    whole: bool = False
    most: int = 0
    ticks: Sequence[float] = ()
    names: Sequence[str] = ()


TRIAL, TIME = Axis("trial", whole=True, most=10), Axis("time [s]")
FREQUENCY = Axis("frequency [Hz]", log=True)


@dataclass(frozen=True, kw_only=True)
class Layer:
    """What all layers have.

    name: in the legend; layers of one name are hidden together on a page
    tips: what the pointer shows besides the coordinates: a value for each point, by its name
    """

    name: str = ""
    colour: str = COLOURS[0]
    alpha: float = 1.0
    tips: Tips = field(default_factory=dict)


@dataclass(frozen=True)
class Curve(Layer):
    """A line through points, or points alone.

    x, y: (n,), or y (lines, n) for lines with the same x, of which each has its tips
    dash: of the line, as in `style.DASHES`; empty for no line
    mark: at the points, as in `style.MARKS`; empty for none;  size: of the mark
    filled: whether the marks are;  rim: the colour around them, that of the layer if empty
    marked: which points have one, (first, every), None for all
    steps: whether the line is level up to the next point
    texts: a text beside each point, on paper
    """

    x: Points
    y: Points
    dash: Dash = "-"
    width: float = 1.5
    mark: str | int = ""
    size: float = 6.0
    filled: bool = True
    rim: str = ""
    marked: tuple[int, int] | None = None
    steps: bool = False
    texts: Sequence[str] = ()

    @property
    def shown_mark(self) -> str | int:
        """The mark, and a dot for a line of one point, which nobody would see."""
        return self.mark or ("." if len(self.x) == 1 else "")


@dataclass(frozen=True)
class Band(Layer):
    """What lies between two curves; x, low, high: (n,)."""

    x: Points
    low: Points
    high: Points
    steps: bool = False
    alpha: float = field(default=0.25, kw_only=True)


@dataclass(frozen=True)
class Rule(Layer):
    """A line across the panel at a value of an axis, vertical at one of "x"."""

    at: float
    across: str = "y"
    dash: Dash = "-"
    width: float = 0.8
    colour: str = field(default=BLACK, kw_only=True)


@dataclass(frozen=True)
class Shade(Layer):
    """The part of a panel from one value of an axis to another."""

    low: float
    high: float
    across: str = "x"
    colour: str = field(default=COLOURS[5], kw_only=True)
    alpha: float = field(default=0.12, kw_only=True)


@dataclass(frozen=True)
class Bars(Layer):
    """Horizontal bars with their numbers, at 0, 1, 2 ... of y; values, colours: (n,)."""

    values: Sequence[float]
    colours: Sequence[str]


class Colours(NamedTuple):
    """What colours show; one scale for all panels of a figure.

    name, unit: of the number
    ends: numbers of the first and the last colour;  log: whether they are spaced by ratios
    palette: its name, with `_r` for one that begins with its last colour
    cut: whether there are numbers below the first colour, which have its colour
    """

    name: str
    unit: str
    ends: tuple[float, float]
    log: bool = True
    palette: str = "viridis_r"
    cut: bool = False


@dataclass(frozen=True)
class Cells(Layer):
    """A map: a cell for each point, without a colour where the value is not finite.

    x, y: (n,), (m,) centres of the cells, or (n+1,), (m+1,) their edges
    values: (n, m);  shows: their colours
    """

    x: Points
    y: Points
    values: np.ndarray
    shows: Colours


@dataclass(frozen=True)
class Where(Layer):
    """The points of a map, as `Cells`, at which something holds: a line, or on a page crosses."""

    x: Points
    y: Points
    holds: np.ndarray
    colour: str = field(default=BLACK, kw_only=True)


@dataclass(frozen=True)
class Panel:
    """Axes with layers, drawn in their order.

    legend: "beside" or "above" the panel, or where in it, such as "lower left", with so many
        columns; empty for none
    note: a text in its upper right corner
    equal: whether a unit is as long along x as along y
    """

    x: Axis
    y: Axis
    layers: Sequence[Layer]
    title: str = ""
    legend: Place = "beside"
    columns: int = 1
    note: str = ""
    equal: bool = False

    @property
    def is_map(self) -> bool:
        """Whether it has cells, whose edges are its ends."""
        return any(isinstance(of, Cells) for of in self.layers)

    def heights(self) -> np.ndarray:
        """All values of y of its curves and bands."""
        held = {Curve: ("y",), Band: ("low", "high")}
        found = [getattr(of, name) for of in self.layers for name in held.get(type(of), ())]
        return np.concatenate([np.ravel(of) for of in found]) if found else np.zeros(0)


@dataclass(frozen=True)
class Figure:
    """Panels row by row.

    caption: sentences that say what is seen, for a page
    columns: how many stand side by side
    size: of paper, width and height [in]; None for a height of 2.6 in for each row
    shares: axes that all panels share, "x", "y", "xy" or none
    heights, widths: of rows and of columns, relative to each other
    below: whether one legend for all panels stands below them, in place of their own
    """

    panels: Sequence[Panel]
    caption: str = ""
    columns: int = 1
    size: tuple[float, float] | None = None
    shares: str = "x"
    heights: Sequence[float] | None = None
    widths: Sequence[float] | None = None
    below: bool = False


def tips_of(drawn: Mapping[str, ArrayLike]) -> dict[str, np.ndarray]:
    """(S,) values by the name of a parameter; of an array each element; the first ones of many."""
    found: dict[str, np.ndarray] = {}
    for name, values in drawn.items():
        values = np.asarray(values, float)
        flat = values.reshape(len(values), -1)
        several = {f"{name}[{i}]": flat[:, i] for i in range(flat.shape[1])}
        found |= {name: values} if values.ndim == 1 else several
    varying = {name: of for name, of in found.items() if np.ptp(of) > 0}
    return dict([*varying.items()][:MOST_TIPS])
