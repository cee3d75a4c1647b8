"""How the error contracts over a grid, beside where the bounds say that it does."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from .grid_map import MARKS, called_of, in_order, marked, placed
from .style import COLOURS, grid, new_axes

if TYPE_CHECKING:
    import xarray as xr

LINES = {"d2": ("--", "black"), "sigma_max": ("-", "#1b7837"), "radius": (":", "#762a83")}
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
    seen, panels = contraction_of(dataset), dataset.sizes["scheme"]
    size, shared = (1.4 + 4.4 * panels, 4.8), {"sharey": len(drawn) == 1, "squeeze": False}
    axes = new_axes(None, 1, panels, size=size, **shared).ravel()
    for ax, name in zip(axes, map(str, dataset["scheme"].values), strict=True):
        labels = [labels_for(dataset, axis, name) for axis in drawn]
        places = [placed(ax, way, one) for way, one in zip("xy", labels, strict=False)]
        of = dataset.sel(scheme=name)
        here = _only(seen.sel(scheme=name).median("sample"), drawn)
        lines = {n: _only(nominal[n].sel(scheme=name), drawn) for n in LINES if n in nominal}
        lines = {n: values for n, values in lines.items() if np.any(np.isfinite(values))}
        held = {n: of[n] for n in PREMISES if not np.any(np.isnan(of[n]))}
        held = {n: _only((values == 1).all("sample"), drawn) for n, values in held.items()}
        if len(drawn) == 2:
            handles = _map(ax, places, here, lines, held)
            ax.set_ylabel(called_of(labels[1]))
        else:
            band = seen.sel(scheme=name).quantile(
                (0.05, 0.95), "sample", method="inverted_cdf", skipna=False
            )
            handles = _line(ax, *places, here, [_only(end, drawn) for end in band], lines)
        for (mark, point), sign in zip((marks or {}).items(), MARKS, strict=False):
            handles += marked(ax, mark, sign, labels, point, here)
        lost = [premise for premise, where in held.items() if not where.any()]
        if lost:
            handles += ax.plot([], [], " ", label=f"fails everywhere: {', '.join(lost)}")
        ax.set_title(name, fontsize="medium")
        ax.set_xlabel(called_of(labels[0]))
        ax.legend(
            handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2,
            fontsize="small",
        )  # fmt: skip
    if len(drawn) == 2:
        axes[0].figure.colorbar(axes[-1].collections[0], ax=[*axes], label=SHOWN)
    else:
        axes[0].set_ylabel(SHOWN)
    return axes


def _only(array: xr.DataArray, drawn: list[str]) -> np.ndarray:
    """(axes that are drawn) an array of one scheme, whose other axes have one value."""
    return array.squeeze([dim for dim in array.dims if dim not in drawn]).transpose(*drawn).values


def _map(ax: Any, places, here, lines, held) -> list[Any]:
    """Draw a map, and return what its legend names.

    here: (x, y) contraction;  lines, held: (x, y) bounds and premises, by name
    """
    from matplotlib.colors import ListedColormap, LogNorm
    from matplotlib.patches import Patch

    shown, handles = np.ma.masked_invalid(np.clip(here, 1 / WIDEST, WIDEST)), []
    ax.set_facecolor("0.85")
    look = {"norm": LogNorm(1 / WIDEST, WIDEST), "cmap": "RdBu_r"}
    ax.pcolormesh(*places, shown.T, shading="nearest", **look)
    for name, values in lines.items():
        (dashes, colour), low, high = LINES[name], np.nanmin(values), np.nanmax(values)
        label = f"{name} = 1" if low < 1 < high else f"{name} from {low:.4g} to {high:.4g}"
        handles += ax.plot([], [], dashes, color=colour, label=label)
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


def _line(ax: Any, x, here, band, lines) -> list[Any]:
    """Draw contraction (x,), its band and bounds (x,) along an axis, and return what is named."""
    ax.fill_between(x, *band, color=COLOURS[0], alpha=0.25, lw=0)
    handles = ax.plot(x, here, color=COLOURS[0], label="observed")
    for name, values in lines.items():
        dashes, colour = LINES[name]
        handles += ax.plot(x, values, dashes, color=colour, label=name)
    ax.axhline(1.0, color="0.5", lw=0.8)
    ax.set_yscale("log")
    grid(ax)
    return handles
