"""How the error contracts over a grid, beside where the bounds say that it does."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from .description import Band, Cells, Colours, Curve, Figure, Layer, Panel, Rule
from .grid_map import MARKS, axes_of_map, in_order, marked, standing
from .paper import draw, named
from .style import GREY

if TYPE_CHECKING:
    import xarray as xr

LINES: dict[str, tuple[Any, str]] = {
    "d2": ("--", "black"),
    "sigma_max": ("-", "#1b7837"),
    "radius": (":", "#762a83"),
}
PREMISES = {"linear": "o", "alone": ".", "signs": "//", "damped": "\\\\", "printed": "--"}
PALE = "0.55"  # of a hatch
WIDEST = 10.0  # factor of a trial at which the colours end
SHOWN = "|e| of a trial over that of the trial before"


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
    marks: Mapping[str, Mapping[str, Any]] | None = None,
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
    shown, panels, of_maps = Colours(SHOWN, "", (1 / WIDEST, WIDEST), palette="RdBu_r"), [], []
    for name in schemes:
        labels, of = [labels_for(dataset, axis, name) for axis in drawn], dataset.sel(scheme=name)
        places = [standing(one)[0] for one in labels]
        here = _only(seen.sel(scheme=name).median("sample"), drawn)
        lines = {n: _only(nominal[n].sel(scheme=name), drawn) for n in LINES if n in nominal}
        lines = {n: values for n, values in lines.items() if np.any(np.isfinite(values))}
        held = {n: of[n] for n in PREMISES if not np.any(np.isnan(of[n]))}
        held = {n: _only((values == 1).all("sample"), drawn) for n, values in held.items()}
        of_maps.append((places, lines, held))
        along, up = axes_of_map(labels, shown)
        layers: list[Layer] = []
        if len(places) == 2:
            layers.append(Cells(*places, np.clip(here, 1 / WIDEST, WIDEST), shown))
        else:
            (x,), up = places, up._replace(ends=None)
            ends = seen.sel(scheme=name).quantile(
                (0.05, 0.95), "sample", method="inverted_cdf", skipna=False
            )
            low, high = (_only(end, drawn) for end in ends)
            layers += [Band(x, low, high), Curve(x, here, name="observed"), Rule(1.0, colour=GREY)]
            for n, values in lines.items():
                layers.append(Curve(x, values, LINES[n][0], colour=LINES[n][1], name=n))
        for (mark, point), sign in zip((marks or {}).items(), MARKS, strict=False):
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


def _bounds(ax: Any, places, lines, held) -> list[Any]:
    """Add lines on which bounds are 1 and hatches where premises fail; what a legend names.

    lines, held: (x, y) bounds and premises, by name
    """
    from matplotlib.colors import ListedColormap
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    ax.set_facecolor("0.85")
    handles: list[Any] = []
    for name, values in lines.items():
        (dashes, colour), low, high = LINES[name], np.nanmin(values), np.nanmax(values)
        label = f"{name} = 1" if low < 1 < high else f"{name} from {low:.4g} to {high:.4g}"
        handles.append(Line2D([], [], linestyle=dashes, color=colour, label=label))
        if low < 1 < high:
            ax.contour(*places, values.T, [1.0], colors=colour, linestyles=dashes)
    for name, where in held.items():
        if where.any() and not where.all():
            hatch = PREMISES[name]
            look = {"hatch": hatch, "edgecolors": PALE, "linewidth": 0}
            fails = np.ma.masked_where(where, np.ones(where.shape)).T
            ax.pcolor(*places, fails, shading="nearest", cmap=ListedColormap(["none"]), **look)
            handles.append(Patch(fill=False, hatch=hatch, ec=PALE, label=f"{name} fails"))
    return handles
