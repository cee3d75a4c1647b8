"""A grid at a glance: maps over two axes or lines over one, on paper and on a page."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import cycle, product
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from ..pytree.aliases import Value
from ..pytree.ranges import share_text, value_text
from .description import Axis, Band, Cells, Colours, Curve, Figure, Layer, Panel, Rule, Shade, Where
from .page import HEIGHT, Live, panel_of, plot, shown_in, side_by_side
from .paper import draw, edges_on, named
from .style import BLACK, COLOURS, GREY, edges_of, labelled, limits_of, style_of

if TYPE_CHECKING:
    import xarray as xr
    from bokeh.models import ColumnDataSource, UIElement
    from bokeh.plotting import figure as Plot
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

    from ..sweeps.points import BestPoint
    from .description import Tips


WIDE = 20.0  # ratio of the ends of an axis from which on it is logarithmic
EVEN, UNEVEN = 0.1, 0.5  # shares by which steps between values differ on one axis or the other
MOST_PANELS = 5  # of a third axis
MARKS = "oXsDP"
EDGE = COLOURS[1]  # around where a machine diverges, seen on each colour of a map
QUANTILES = {"high": 0.95, "median": 0.5, "worst": 1.0}
SHOWN = {
    "high": "95 % {} of the last trial",
    "median": "median {} of the last trial",
    "worst": "worst {} of the last trial",
    "yield": "share of machines within the tolerance",
    "best_trial": "trial of the least {}, median",
    "diverged": "share of machines that diverge",
}


def grid_map(
    dataset: xr.Dataset,
    *,
    shows: str = "high",
    metric: str = "settled_error",
    tolerance: float | None = None,
    scale: float = 1.0,
    unit: str = "",
    best: list[BestPoint] | None = None,
    marks: Mapping[str, Mapping[str, Value]] | None = None,
) -> np.ndarray:
    """A sweep over a grid: a number of each point, in a panel for each scheme.

    The two axes with most values make a map, a single one a line; beside the line of an error is
    the band of 5 to 95 %. Each value of a third axis has a panel, up to five of them, among which
    are its ends and that of the best point. All further axes are as at the best point, which has a
    star unless machines diverge everywhere. On a map a line encloses the points at which a machine
    diverges, and an infinite error is blank; beside a line these points are grey.

    dataset: over (scheme, axes of the grid, sample, trial)
    shows: `high`, `median` or `worst`, a quantile over the machines of the error of the last trial;
        `yield`, the share of machines within the tolerance; `best_trial`, the trial of the least
        error, in the median; `diverged`, the share of machines that diverge
    metric, tolerance, scale, unit: as for `error_band`
    best: what `best_points` gives for this dataset, metric and tolerance, None to have it computed
    marks: named points beside the star, each as values of axes by name, in the panel that is
        nearest in the third axis; a point without a value of a drawn axis is left out
    Returns the panels, scheme by scheme.
    Raises ValueError for a dataset without an axis of several values or of a sweep that is not
    complete, for a number that is not known, and for a yield without a tolerance.
    """
    from ..sweeps.points import best_points, labels_for, last_errors

    if shows not in SHOWN:
        raise ValueError(f"grid_map: shows = {shows!r} is not one of {', '.join(SHOWN)}")
    if shows == "yield" and tolerance is None:
        raise ValueError("grid_map: shows = 'yield' needs a tolerance, and it is None")
    dataset, by_size, drawn = in_order(dataset)
    best = best_points(dataset, tolerance, metric=metric) if best is None else best
    last, of_error = last_errors(dataset, metric), shows in QUANTILES
    numbers = numbers_of(dataset, last, shows, metric, tolerance) * (scale if of_error else 1.0)
    errors = scale * last
    lost = (dataset["diverged_at"] > 0).any("sample")
    seen = numbers if len(drawn) == 2 else errors  # beside a line stands its band
    limits = limits_of(seen.values, pad=1.2) if of_error else None
    of_trials = tuple(dataset["trial"].values[[0, -1]].tolist())
    ends = limits or (of_trials if shows == "best_trial" else (0, 1))
    unit = unit if of_error else ""
    palette = "viridis" if shows == "yield" else "viridis_r"  # what is good is bright
    name, log = SHOWN[shows].format(metric.replace("_", " ")), limits is not None
    shown = Colours(name, unit, ends, log=log, palette=palette)
    chosen = [(of, at) for of in best for at in _beside(dataset, by_size[2:], of)]
    columns = len(chosen) // len(best)
    panels = []
    for i, (of, at) in enumerate(chosen):
        point = {axis: x for axis, x in (of.point | at).items() if axis not in drawn}
        here, members, gone = (
            x.sel(scheme=of.scheme, **point).values for x in (numbers, errors, lost)
        )
        labels = [labels_for(dataset, axis, of.scheme) for axis in drawn]
        layers = layers_of(labels, here, members if of_error else None, gone, shown, i // columns)
        if len(drawn) == 2 and gone.any() and not gone.all():
            layers.append(Curve([], [], colour=EDGE, name="around where a machine diverges"))
        if of.anywhere and at.items() <= of.point.items():
            best_at = dataset.coords.to_dataset().sel(of.point)
            point = {str(one.name): best_at[one.name].item() for one in labels}
            layers += marked("best", "*", labels, point, here)
        for (name, mark), sign in zip((marks or {}).items(), cycle(MARKS), strict=False):
            if _nearest(mark, [other for one, other in chosen if one is of], at):
                layers += marked(name, sign, labels, mark, here)
        beside = (labels_for(dataset, k, of.scheme).sel({k: v}) for k, v in at.items())
        title = ", ".join([of.scheme, *map(_said, beside)])
        panels.append(Panel(*axes_of_map(labels, shown), layers, title, legend=""))
    wide = columns if columns > 1 else len(best)
    size = 1.4 + 3.4 * wide, 0.4 + 3.0 * (len(panels) // wide)
    return np.ravel(draw(Figure(panels, columns=wide, size=size, shares="y", below=True)))


def axes_of_map(labels: list[xr.DataArray], shown: Colours) -> tuple[Axis, Axis]:
    """The axes of a map over two axes of a grid, or of a line over one; text stands at numbers."""
    made = []
    for one in labels:
        kind, (_, log) = one.dtype.kind, standing(one)
        names = [] if kind in "fi" else [value_text(x) for x in one.values]
        whole = kind == "i" and not log
        made.append(Axis(called_of(one), log=log, names=names, whole=whole, most=9 * whole))
    if len(made) == 1:
        ends = shown.ends if shown.log else None
        made.append(Axis(shown.name, shown.unit, log=shown.log, ends=ends))
    return made[0], made[1]


def layers_of(
    labels: list[xr.DataArray], here: np.ndarray, members: np.ndarray | None, lost: np.ndarray,
    shown: Colours, number: int, tips: Tips | None = None, mark: str = "", name: str = "",
) -> list[Layer]:  # fmt: skip
    """The map of a number over two axes of a grid, or its line, named and marked, over one.

    here: what is shown at each point;  lost: whether a machine diverges there
    members: (points, sample) errors whose band is drawn beside a line, None for no band
    number: of the scheme, for its colour
    """
    places = [standing(one) for one in labels]
    if len(places) == 2:
        (x, _), (y, _) = places
        return [Cells(x, y, here, shown, tips=tips or {}), Where(x, y, lost, colour=EDGE)]
    ((x, log),), style = places, style_of(number)
    layers: list[Layer] = []
    if members is not None:
        low, high = np.quantile(members, (0.05, 0.95), axis=-1, method="inverted_cdf")
        layers.append(Band(x, low, high, colour=style["colour"]))
    look = style | {"mark": mark}
    layers.append(Curve(x, here, name=name, tips=tips or {}, **look))
    edges = np.clip(edges_of(x, log), x.min(), x.max())  # of a scheme the values may fall
    return layers + [
        Shade(edges[j], edges[j + 1], colour="#e0e0e0", alpha=1.0) for j in np.flatnonzero(lost)
    ]


def in_order(dataset: xr.Dataset) -> tuple[xr.Dataset, list[str], list[str]]:
    """The dataset with its numbers rising, its axes of several values by size, and those drawn.

    Raises ValueError for a dataset without an axis of several values.
    """
    from ..sweeps.summary import axes_of

    by_size = sorted(axes_of(dataset), key=lambda axis: -dataset.sizes[axis])
    by_size = [axis for axis in by_size if dataset.sizes[axis] > 1]
    if not by_size:
        raise ValueError("grid_map: the dataset has no axis of a grid with several values")
    drawn = [axis for axis in axes_of(dataset) if axis in by_size[:2]]
    rising = [axis for axis in by_size if dataset[axis].dtype.kind in "fi"]
    return dataset.sortby(rising), by_size, drawn


def numbers_of(dataset, errors, shows, metric, tolerance) -> xr.DataArray:
    """(scheme, axes) what is shown of each point; a quantile of errors may be infinite."""
    from ..sweeps.summary import errors_of, learned_errors

    if shows == "yield":
        return (errors <= tolerance).mean("sample")
    if shows == "diverged":
        return (dataset["diverged_at"] > 0).mean("sample")
    if shows == "best_trial":
        at = learned_errors(errors_of(dataset, metric)).argmin("trial")
        return at.copy(data=dataset["trial"].values[at.values]).median("sample")
    found = np.quantile(errors.values, QUANTILES[shows], axis=-1, method="inverted_cdf")
    return errors.isel(sample=0, drop=True).copy(data=found)


def _beside(dataset: xr.Dataset, axes: list[str], of: BestPoint) -> list[dict[str, Value]]:
    """The values of a third axis that have a panel of their own; an empty one if there is none."""
    if not axes:
        return [{}]
    values = dataset[axes[0]].values.tolist()
    best = values.index(of.point[axes[0]])
    spread = np.linspace(0, len(values) - 1, min(MOST_PANELS, len(values))).round().astype(int)
    if best not in spread:
        inner = np.argmin(np.abs(spread[1:-1] - best)) + 1
        spread[inner] = best
    return [{axes[0]: values[i]} for i in spread]


def _nearest(
    mark: Mapping[str, Value], panels: list[dict[str, Value]], at: dict[str, Value]
) -> bool:
    """Whether of these panels that at a value of the third axis is nearest to a point."""
    for axis, here in at.items():
        if axis in mark and mark[axis] != here:
            others = [panel[axis] for panel in panels]
            if isinstance(here, str) or isinstance(mark[axis], str) or mark[axis] in others:
                return False
            return here == min(others, key=lambda x: abs(x - mark[axis]))
    return True


def called_of(labels: xr.DataArray) -> str:
    """The path of an axis, as it was given, with its unit."""
    unit = labels.attrs.get("units", "")
    return f"{labels.name} [{unit}]" if unit else str(labels.name)


def _said(label: xr.DataArray) -> str:
    """A single value with the name of its axis."""
    return f"{label.name} = {value_text(label.item())}"


def standing(labels: xr.DataArray) -> tuple[np.ndarray, bool]:
    """Where the values of an axis stand, text at its numbers, and whether it is logarithmic."""
    values = labels.values
    if values.dtype.kind not in "fi":
        return np.arange(len(values)), False
    if values.min() <= 0:
        return values, False
    even = _unevenness(np.log(values)) <= EVEN and _unevenness(values) >= UNEVEN
    return values, bool(even or values.max() / values.min() > WIDE)


def _unevenness(values: np.ndarray) -> float:
    """The share by which steps from value to value differ; infinite if there is one at most."""
    steps = np.diff(np.sort(values))
    return float(np.ptp(steps) / steps.max()) if len(steps) > 1 else np.inf


def _place(labels: xr.DataArray, value: str | float) -> float:
    """Where a value stands along an axis: at itself, at its number if it is text; NaN off it."""
    if labels.dtype.kind in "fi" and not isinstance(value, str):
        return value if labels.values.min() <= value <= labels.values.max() else np.nan
    known = labels.values.tolist()
    return known.index(value) if value in known else np.nan


def marked(name: str, sign: str, labels: list[xr.DataArray], point, here) -> list[Layer]:
    """A point with its name, if it is known and lies within the axes; on a line at its height."""
    at = [_place(of, point[of.name]) for of in labels if of.name in point]
    if len(at) < len(labels) or not np.all(np.isfinite(at)):
        return []
    if len(at) == 1:
        places = standing(labels[0])[0]
        by_size = np.argsort(places)
        at.append(np.interp(at[0], places[by_size], here[by_size]))
    size, (x, y) = 11 if sign == "*" else 7, at
    return [Curve([x], [y], "", mark=sign, size=size, colour="#ffffff", rim=BLACK, name=name)]


# How the error contracts over a grid, beside where the bounds say that it does
# --------------------------------------------------------------------------------------------------


LINES: dict[str, tuple[Literal["--", "-", ":"], str]] = {
    "d2": ("--", "black"),
    "sigma_max": ("-", "#1b7837"),
    "radius": (":", "#762a83"),
}
PREMISES = {"linear": "o", "alone": ".", "signs": "//", "damped": "\\\\", "printed": "--"}
PALE = "0.55"  # of a hatch
WIDEST = 10.0  # factor of a trial at which the colours end
CONTRACTION = "|e| of a trial over that of the trial before"


def contraction_of(dataset: xr.Dataset) -> xr.DataArray:
    """The factor by which the 2-norm of the error of each machine changes in a trial.

    It is the geometric mean over the trials before which the error was above rounding; infinite
    where the machine diverges, and NaN where there is no such trial.

    dataset: of a sweep with a `theory.BoundsWatch`
    """
    norm = dataset["contraction_norm"].isel(trial=slice(1, None))  # the first has none before it
    with np.errstate(divide="ignore"):
        mean = norm.copy(data=np.log(norm.values)).mean("trial")
    return mean.copy(data=np.exp(mean.values)).where(dataset["diverged_at"] <= 0, np.inf)


def contraction_map(
    dataset: xr.Dataset,
    *,
    bounds: xr.Dataset | None = None,
    marks: Mapping[str, Mapping[str, Value]] | None = None,
) -> np.ndarray:
    """The observed contraction of a trial over a grid, a panel for each scheme, and its bounds.

    The colour is the median over the machines of `contraction_of`: blue falls, red grows, grey is
    unknown. The lines are those on which a bound is 1: d2 of Cao 2019, and of the law frozen at its
    start the largest singular value and the spectral radius, all of the nominal machine and before
    any trial. A region is hatched where a premise of d2 fails on a machine; the legend names those
    that fail everywhere. Over a single axis contraction and bounds are lines, and the band holds 5
    to 95 % of the machines, where it is known of all.

    dataset: over (scheme, axes of the grid, sample, trial), of a sweep with a `theory.BoundsWatch`
    bounds: the same grid on the nominal machine alone, such as with `sigma_steps`, which take long
        on all machines; None for machine 0 of the dataset
    marks: named points, each as values of axes by name
    Returns the panels, scheme by scheme.
    Raises ValueError for a dataset without these variables, and for one with no axis, or more than
    two axes, of several values.
    """
    from ..sweeps.points import labels_for

    if "contraction_norm" not in dataset:
        raise ValueError("contraction_map: the sweep had no BoundsWatch, which compares its trials")
    dataset, by_size, drawn = in_order(dataset)
    if len(by_size) > 2:
        raise ValueError(
            f"contraction_map: the dataset has the axes {', '.join(by_size)}; allowed are two, "
            "dataset.sel({...}) chooses the others"
        )
    nominal = (dataset if bounds is None else in_order(bounds)[0]).isel(sample=0)
    seen, schemes = contraction_of(dataset), [str(name) for name in dataset["scheme"].values]
    shown = Colours(CONTRACTION, "", (1 / WIDEST, WIDEST), palette="RdBu_r")
    panels, of_maps = [], []
    for name in schemes:
        labels, of = [labels_for(dataset, axis, name) for axis in drawn], dataset.sel(scheme=name)
        places = [standing(one)[0] for one in labels]
        here = _only(seen.sel(scheme=name).median("sample"), drawn)
        lines = {n: _only(nominal[n].sel(scheme=name), drawn) for n in LINES if n in nominal}
        lines = {n: values for n, values in lines.items() if np.any(np.isfinite(values))}
        known = {n: of[n] for n in PREMISES if not np.any(np.isnan(of[n]))}
        held = {n: _only((values == 1).all("sample"), drawn) for n, values in known.items()}
        of_maps.append((places, lines, held))
        along, up = axes_of_map(labels, shown)
        within = np.clip(here, 1 / WIDEST, WIDEST) if len(places) == 2 else here
        members = _only(seen.sel(scheme=name), [*drawn, "sample"])
        gone = np.zeros(here.shape, bool)  # none: what diverged has a factor, which is infinite
        layers = layers_of(labels, within, members, gone, shown, 0, name="observed")
        if len(places) == 1:
            up = up._replace(ends=None)
            layers.append(Rule(1.0, colour=GREY))
            for n, values in lines.items():
                layers.append(Curve(places[0], values, LINES[n][0], colour=LINES[n][1], name=n))
        for (mark, point), sign in zip((marks or {}).items(), cycle(MARKS), strict=False):
            layers += marked(mark, sign, labels, point, here)
        lost = [premise for premise, where in held.items() if not where.any()]
        if lost:
            layers.append(Curve([], [], "", name=f"fails everywhere: {', '.join(lost)}"))
        panels.append(Panel(along, up, layers, name, legend=""))
    size, several = (1.4 + 4.4 * len(panels), 4.8), len(drawn) == 1
    figure = Figure(panels, columns=len(panels), size=size, shares="y" * several)
    axes = np.ravel(draw(figure))
    for ax, (places, lines, held) in zip(axes, of_maps, strict=True):
        handles = [] if several else _bounds(ax, places, lines, held)
        ax.legend(
            handles=[*handles, *named(ax).values()], loc="upper center",
            bbox_to_anchor=(0.5, -0.16), ncols=2, fontsize="small",
        )  # fmt: skip
    return axes


def _only(array: xr.DataArray, drawn: list[str]) -> np.ndarray:
    """(axes that are drawn) an array of one scheme, whose other axes have one value."""
    return array.squeeze([dim for dim in array.dims if dim not in drawn]).transpose(*drawn).values


def _bounds(ax: Axes, places, lines, held) -> list[Artist]:
    """Add lines on which bounds are 1, hatches where premises fail; what a legend names of them."""
    from matplotlib.colors import ListedColormap
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    ax.set_facecolor("0.85")
    handles: list[Artist] = []
    for name, values in lines.items():
        (dashes, colour), low, high = LINES[name], np.nanmin(values), np.nanmax(values)
        label = f"{name} = 1" if low < 1 < high else f"{name} from {low:.4g} to {high:.4g}"
        handles.append(Line2D([], [], linestyle=dashes, color=colour, label=label))
        if low < 1 < high:
            ax.contour(*places, values.T, [1.0], colors=colour, linestyles=dashes)
    for name, where in held.items():
        if where.any() and not where.all():
            hatch = PREMISES[name]
            fails = np.ma.masked_where(where, np.ones(where.shape)).T
            ax.pcolor(
                *edges_on(ax, *places), fails, cmap=ListedColormap(["none"]),
                hatch=hatch, edgecolors=PALE, linewidth=0,
            )  # fmt: skip
            handles.append(Patch(fill=False, hatch=hatch, ec=PALE, label=f"{name} fails"))
    return handles


# The map that answers to the hand: each point has its numbers, and its learning
# --------------------------------------------------------------------------------------------------


MOST_VALUES = 64  # values of an axis that are drawn; of more, so many and the best one
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


def live_grid(dataset: xr.Dataset, *, best: list[BestPoint], metric: str, **look: Value) -> Live:
    """A map for each scheme with the numbers of a point on hover, and its learning on a click.

    metric, look: as for `live_map`
    """
    from bokeh.models import TabPanel, Tabs

    parts = [_with_learning(live_map(dataset, of, metric=metric, **look), metric) for of in best]
    tabs = [TabPanel(child=part, title=of.scheme) for part, of in zip(parts, best, strict=True)]
    return Live(
        "Each cell, or dot along a single axis, is a point of the grid, and its colour or height "
        "the error that 95 % of its machines do not exceed in the last trial. There is a cross, or "
        "a grey stripe, where a machine diverges, and no colour where the error is not finite. The "
        "star is the best point, at which all axes are that are not drawn. Under the pointer stand "
        "the numbers of a point; a click shows how it learns.",
        parts[0] if len(parts) == 1 else Tabs(tabs=tabs, sizing_mode="stretch_width"),
    )


def live_map(
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
    known = {str(one.name): one.values.tolist() for one in labels}
    values = [dict(zip(known, row, strict=True)) for row in product(*known.values())]
    shape = tuple(one.size for one in labels)
    lost = (dataset["diverged_at"] > 0).any("sample").values.reshape(shape)
    tips: dict[str, list[Value]] = {
        called_of(one): [row[str(one.name)] for row in values] for one in labels
    }
    curves = {}
    for name, words in SHOWN.items():
        if name != "yield" or tolerance is not None:
            found = numbers_of(dataset, last, name, metric, tolerance).values
            found = scale * factor * found if name in QUANTILES else found
            curves[name] = np.reshape(found, shape)
            tips[words.format(metric.replace("_", " "))] = [
                _told(x, name, unit) for x in np.ravel(found)
            ]
    for name, bound in _of_bounds(dataset).items():
        tips[name] = [f"{x:.4g}" for x in bound.values.ravel()]
    nearest = [some[i].tolist().index(j) for i, j in enumerate(at)]
    best = int(np.ravel_multi_index(nearest, shape))
    high = curves["high"]
    low, top = limits_of(high, pad=1.0) or (1.0, 10.0)
    called = SHOWN["high"].format(metric).replace("_", " ")
    shown = Colours(called, unit, (low, max(top, 1.001 * low)))
    along, up = axes_of_map(labels, shown)
    layers = layers_of(labels, high, None, lost, shown, 0, tips, "o", "95 %")
    if len(labels) == 1:
        up, x = Axis(labelled(up.name, unit), log=True), standing(labels[0])[0]
        for name, dash in (("median", "--"), ("worst", ":")):
            layers.append(Curve(x, curves[name], dash, name=name))
    if of.anywhere:
        layers += marked("best", "*", labels, values[best], high)
    made = panel_of(Panel(along, up, layers, legend="upper right"), width=560, height=height)
    *_, cells = (r for r in made.renderers if "t0" in r.data_source.data)  # of a line its marks
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

    errors = drawn.factor * errors_of(drawn.dataset, metric)
    count = errors.sizes["trial"]
    most = int(np.clip(ROOM // (len(CURVES) * len(drawn.values)), 2, count))
    some = np.unique(np.round(np.linspace(0, count - 1, most)).astype(int))
    errors = errors.isel(trial=some)
    found = np.quantile(errors.values, LEVELS, axis=-2, method="inverted_cdf")
    shown = np.where(np.isfinite(found) & (found > 0), found, np.nan).astype(np.float32)
    shown = shown.reshape(len(LEVELS), -1)
    chosen = drawn.points.selected.indices[0]
    part = slice(chosen * len(some), (chosen + 1) * len(some))
    first = dict(zip(CURVES, (of[part] for of in shown), strict=True))
    every = ColumnDataSource(dict(zip(CURVES, shown, strict=True)))
    now = ColumnDataSource({"j": errors["trial"].values, **first})
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
    if count <= MOST_VALUES:
        return np.arange(count)
    return np.unique([best, *np.round(np.linspace(0, count - 1, MOST_VALUES)).astype(int)])


def _told(value: float, name: str, unit: str) -> str:
    """A number of a point, as its hover text has it."""
    if not np.isfinite(value):
        return "diverged"
    if name in ("yield", "diverged"):
        return share_text(value)
    return f"{value:.4g} {unit}".rstrip() if name in QUANTILES else f"{value:g}"
