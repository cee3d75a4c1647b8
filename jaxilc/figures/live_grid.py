"""The map of a grid that answers to the hand: each point has its numbers, and its learning."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..pytree.aliases import Value
from ..pytree.ranges import value_text
from .description import Axis, Colours, Curve, Panel
from .grid_map import (
    QUANTILES,
    SHOWN,
    axes_of_map,
    called_of,
    contraction_of,
    in_order,
    layers_of,
    marked,
    numbers_of,
    standing,
)
from .page import HEIGHT, Live, panel_of, plot, shown_in, side_by_side
from .style import COLOURS, labelled, limits_of

if TYPE_CHECKING:
    import xarray as xr
    from bokeh.models import ColumnDataSource, UIElement
    from bokeh.plotting import figure as Plot

    from ..sweeps.points import BestPoint

MOST = 64  # values of an axis that are drawn; of more, so many and the best one
ROOM = 150_000  # numbers that the curves of all points of a scheme may have
CURVES = ("low", "median", "high")
CHOOSE = """
const i = points.selected.indices[0], n = shown.data["j"].length;
if (i === undefined) return;
const data = {j: shown.data["j"]};
for (const name of ["low", "median", "high"]) {
    data[name] = all.data[name].slice(i * n, (i + 1) * n);
}
shown.data = data;
told.text = names[i];
"""


class GridMap(NamedTuple):
    """The map of one scheme, or its line over a single axis.

    figure: of Bokeh
    points: its source, a row for each point, of which the chosen one is selected
    values: the values of the drawn axes at each point, by the names that belong to the scheme
    dataset: the points of the scheme, over the drawn axes, sample and trial
    factor, unit: of errors that are shown
    """

    figure: Plot
    points: ColumnDataSource
    values: list[dict[str, Value]]
    dataset: xr.Dataset
    factor: float
    unit: str

    def at(self, number: int) -> dict[str, Value]:
        """The values of all axes of the grid at a point, by all of their names."""
        from ..sweeps.summary import axes_of

        drawn = axes_of(self.dataset)
        place = np.unravel_index(number, [self.dataset.sizes[axis] for axis in drawn])
        here = self.dataset.coords.to_dataset().isel(dict(zip(drawn, place, strict=True)))
        return {str(name): x.item() for name, x in here.coords.items() if x.ndim == 0}


def grid(
    dataset: xr.Dataset,
    *,
    metric: str,
    tolerance: float | None = None,
    scale: float = 1.0,
    unit: str = "",
    best: list[BestPoint],
) -> Live:
    """A map for each scheme with the numbers of a point on hover, and its learning on a click.

    dataset, metric, tolerance, scale, unit, best: as for `grid_map`
    Raises ValueError as `grid_map` does.
    """
    from bokeh.models import TabPanel, Tabs

    made = partial(map_of, metric=metric, tolerance=tolerance, scale=scale, unit=unit)
    parts = [_with_learning(made(dataset, of), metric) for of in best]
    tabs = [TabPanel(child=part, title=of.scheme) for part, of in zip(parts, best, strict=True)]
    return Live(
        "Each cell, or dot along a single axis, is a point of the grid, and its colour or height "
        "the error that 95 % of its machines do not exceed in the last trial. There is a cross, or "
        "a grey stripe, where a machine diverges, and no colour where the error is not finite. The "
        "star is the best point, at which all axes are that are not drawn. Under the pointer stand "
        "the numbers of a point; a click shows how it learns.",
        parts[0] if len(parts) == 1 else Tabs(tabs=tabs, sizing_mode="stretch_width"),
    )


def map_of(
    dataset: xr.Dataset,
    of: BestPoint,
    *,
    metric: str,
    tolerance: float | None = None,
    scale: float = 1.0,
    unit: str = "",
    height: int = HEIGHT,
) -> GridMap:
    """The map of one scheme, with all numbers of `grid_map` on hover; the best point is chosen."""
    from bokeh.models import TapTool

    from ..sweeps.points import labels_for, last_errors

    dataset, _, drawn = in_order(dataset)
    there = {axis: of.point[axis] for axis in of.point if axis not in drawn}
    dataset = dataset.sel(scheme=[of.scheme], **there)
    at = [dataset[axis].values.tolist().index(of.point[axis]) for axis in drawn]
    some = [_some(dataset.sizes[axis], i) for axis, i in zip(drawn, at, strict=True)]
    dataset = dataset.isel(dict(zip(drawn, some, strict=True)))
    last = last_errors(dataset, metric)
    factor, unit = shown_in(scale * last.values, unit)
    labels = [labels_for(dataset, axis, of.scheme) for axis in drawn]
    places = np.meshgrid(*(np.arange(one.size) for one in labels), indexing="ij")
    known = {str(one.name): one.values.tolist() for one in labels}
    values = [
        {name: of[i] for (name, of), i in zip(known.items(), row, strict=True)}
        for row in zip(*(place.ravel() for place in places), strict=True)
    ]
    shape = tuple(one.size for one in labels)
    lost = (dataset["diverged_at"] > 0).any("sample").values.reshape(shape)
    tips: dict[str, list[Value]] = {
        called_of(one): [[*row.values()][i] for row in values] for i, one in enumerate(labels)
    }
    curves = {}
    for name, words in SHOWN.items():
        if name != "yield" or tolerance is not None:
            found = numbers_of(dataset, last, name, metric, tolerance).values
            found = scale * factor * found if name in QUANTILES else found
            curves[name] = np.reshape(found, shape)
            tips[words.format(metric.replace("_", " "))] = [
                _said(x, name, unit) for x in np.ravel(found)
            ]
    for name, bound in _of_bounds(dataset).items():
        tips[name] = [f"{x:.4g}" for x in bound.values.ravel()]
    nearest = [some[i].tolist().index(j) for i, j in enumerate(at)]
    best = int(np.ravel_multi_index(nearest, shape))
    low, top = limits_of(curves["high"], pad=1.0) or (1.0, 10.0)
    called = SHOWN["high"].format(metric).replace("_", " ")
    shown = Colours(called, unit, (low, max(top, 1.001 * low)))
    along, up = axes_of_map(labels, shown)
    high = curves["high"]
    if len(labels) == 1:
        up = Axis(labelled(up.name, unit), log=True)
    layers = layers_of(labels, high, None, lost, shown, 0, tips, "o", "95 %")
    if len(labels) == 1:
        x = standing(labels[0])[0]
        for name, dash in (("median", "--"), ("worst", ":")):
            layers.append(Curve(x, curves[name], dash, name=name))
    if np.isfinite(of.error):
        layers += marked("best", "*", labels, values[best], high)
    made = panel_of(Panel(along, up, layers, legend="upper right"), width=560, height=height)
    cells = next(r for r in made.renderers if "t0" in r.data_source.data)
    if len(labels) == 1:
        cells = [r for r in made.renderers if r.data_source is cells.data_source][-1]
    cells.data_source.selected.indices = [best]
    made.add_tools(TapTool(renderers=[cells], mode="replace"))
    return GridMap(made, cells.data_source, values, dataset, scale * factor, unit)


def _of_bounds(dataset: xr.Dataset) -> dict[str, xr.DataArray]:
    """What a `theory.BoundsWatch` found at each point, by words; empty without one."""
    if "contraction_norm" not in dataset:
        return {}
    return {
        "error of a trial over that before, median": contraction_of(dataset).median("sample"),
        "largest d2": dataset["d2"].max("sample"),
        "share of machines on which d2 is claimed": (dataset["claimed"] == 1).mean("sample"),
    }


def _with_learning(drawn: GridMap, metric: str) -> UIElement:
    """A map, and beside it how the chosen point learns."""
    from bokeh.layouts import column
    from bokeh.models import ColumnDataSource, CustomJS, Div

    from ..sweeps.summary import QUANTILES as LEVELS
    from ..sweeps.summary import errors_of

    count = drawn.dataset.sizes["trial"]
    most = int(np.clip(ROOM // (len(CURVES) * len(drawn.values)), 2, count))
    some = np.unique(np.round(np.linspace(0, count - 1, most)).astype(int))
    errors = drawn.factor * errors_of(drawn.dataset, metric).isel(trial=some)
    found = np.quantile(errors.values, LEVELS, axis=-2, method="inverted_cdf")
    shown = np.where(np.isfinite(found) & (found > 0), found, np.nan).astype(np.float32)
    shown = shown.reshape(len(LEVELS), -1)
    chosen = drawn.points.selected.indices[0]
    part = slice(chosen * len(some), (chosen + 1) * len(some))
    first = dict(zip(CURVES, (of[part] for of in shown), strict=True))
    every = ColumnDataSource(dict(zip(CURVES, shown, strict=True)))
    now = ColumnDataSource({"j": drawn.dataset["trial"].values[some], **first})
    names = [
        ", ".join(f"{name} = {value_text(x)}" for name, x in point.items())
        for point in drawn.values
    ]
    told = Div(text=names[chosen], render_as_text=True, styles={"font-weight": "600"})
    made = plot("", "trial", labelled(metric, drawn.unit), width=400)
    made.varea("j", "low", "high", source=now, fill_alpha=0.2, color=COLOURS[0],
               legend_label="5 to 95 %")  # fmt: skip
    made.line("j", "median", source=now, color=COLOURS[0], line_width=2, legend_label="median")
    made.legend.location, made.legend.label_text_font_size = "top_right", "8pt"
    react = CustomJS(
        args={"points": drawn.points, "all": every, "shown": now, "told": told, "names": names},
        code=CHOOSE,
    )
    drawn.points.selected.js_on_change("indices", react)
    return column(told, side_by_side(drawn.figure, made), sizing_mode="stretch_width")


def _some(count: int, best: int) -> np.ndarray:
    """Positions along an axis: all, or of many the ends, the best and some between them."""
    if count <= MOST:
        return np.arange(count)
    return np.unique([best, *np.round(np.linspace(0, count - 1, MOST)).astype(int)])


def _said(value: float, name: str, unit: str) -> str:
    """A number of a point, as its hover text has it."""
    if not np.isfinite(value):
        return "diverged"
    if name in ("yield", "diverged"):
        return f"{value:.1%}"
    return f"{value:.4g} {unit}".rstrip() if name in QUANTILES else f"{value:g}"
