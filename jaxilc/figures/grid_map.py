"""A grid at a glance: the error over two axes as a map, or against the only axis as a band."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from .style import grid, labelled, limits_of, new_axes, style_of

if TYPE_CHECKING:
    import xarray as xr

    from ..sweeps.points import BestPoint

WIDE = 20.0  # ratio of the ends of an axis from which on it is logarithmic
COLOUR_MAP = "viridis_r"  # dark is a large error


def grid_map(
    dataset: xr.Dataset,
    *,
    metric: str = "settled_error",
    tolerance: float | None = None,
    scale: float = 1.0,
    unit: str = "",
    best: list[BestPoint] | None = None,
) -> np.ndarray:
    """A sweep over a grid: a panel for each scheme, with the error of the last trial at each point.

    The two axes with most values make a map of the 95 % quantile over the machines, a single one a
    line of the median with the band of 5 to 95 %; all others are as at the best point, which has a
    star. On a map a line encloses the points at which a machine diverges, and it is blank where
    more than 5 % do; beside a line these points are grey.

    dataset: over (scheme, axes of the grid, sample, trial)
    metric, tolerance, scale, unit: as for `error_band`
    best: what `best_points` gives for this dataset, metric and tolerance, None to have it computed
    Raises ValueError for a dataset without an axis of several values.
    """
    from ..sweeps.points import best_points, last_errors
    from ..sweeps.summary import axes_of

    several = sorted(axes_of(dataset), key=lambda axis: -dataset.sizes[axis])[:2]
    several = [axis for axis in axes_of(dataset) if axis in several and dataset.sizes[axis] > 1]
    if not several:
        raise ValueError("grid_map: the dataset has no axis of a grid with several values")
    dataset = dataset.sortby([axis for axis in several if dataset[axis].dtype.kind in "fi"])
    best = best_points(dataset, tolerance, metric=metric) if best is None else best
    errors, lost = last_errors(dataset, metric), (dataset["diverged_at"] > 0).any("sample")
    size = (1.4 + 3.4 * len(best), 3.4)
    panels = np.ravel(new_axes(None, 1, len(best), size=size, sharey=True))
    limits = limits_of(scale * errors.values, pad=1.2)
    for i, (of, ax) in enumerate(zip(best, panels, strict=True)):
        others = {axis: at for axis, at in of.point.items() if axis not in several}
        here, gone = (x.sel(scheme=of.scheme, **others) for x in (errors, lost))
        places = [_placed(ax, way, dataset[axis]) for way, axis in zip("xy", several, strict=False)]
        at = [_place(dataset[axis], of.point[axis]) for axis in several]
        drawn = _map if len(several) == 2 else _line
        drawn(ax, places, at, scale * here.values, gone.values, limits, style_of(i))
        ax.set_title(of.scheme, fontsize="medium")
        ax.set_xlabel(_called(dataset[several[0]]))
    called = labelled(f"{metric} of the last trial", unit)
    if len(several) == 2:
        panels[0].figure.colorbar(panels[-1].collections[0], ax=[*panels], label=f"95 % {called}")
    panels[0].set_ylabel(_called(dataset[several[1]]) if len(several) == 2 else called)
    return panels


def _called(labels: xr.DataArray) -> str:
    """The path of an axis, as it was given, with its unit."""
    unit = labels.attrs.get("units", "")
    return f"{labels.name} [{unit}]" if unit else str(labels.name)


def _place(labels: xr.DataArray, value: Any) -> float:
    """Where a value stands along an axis: at itself, or at its number if it is text."""
    return value if labels.dtype.kind in "fi" else labels.values.tolist().index(value)


def _placed(ax: Any, way: str, labels: xr.DataArray) -> np.ndarray:
    """Where the values of an axis stand; the scale and the ticks of x or y are set."""
    axis, values = (ax.xaxis, ax.yaxis)[way == "y"], labels.values
    numbers = values if values.dtype.kind in "fi" else np.arange(len(values))
    if numbers is not values:
        axis.set_ticks(numbers, [str(x) for x in values])
    elif values.min() > 0 and values.max() / values.min() > WIDE:
        (ax.set_xscale, ax.set_yscale)[way == "y"]("log")
    return numbers


def _map(ax: Any, places, at, errors, lost, limits, style) -> None:
    from matplotlib.colors import LogNorm

    high = np.quantile(errors, 0.95, axis=-1, method="inverted_cdf")
    shown = np.ma.masked_invalid(high).T
    norm = LogNorm(*limits) if limits else None
    ax.pcolormesh(*places, shown, shading="nearest", cmap=COLOUR_MAP, norm=norm)
    if lost.any() and not lost.all():
        ax.contour(*places, lost.T, levels=[0.5], colors="black", linewidths=1.0)
    ax.plot(*at, "*", color="white", mec="black", ms=11)


def _line(ax: Any, places, at, errors, lost, limits, style) -> None:
    (x,) = places
    low, median, high = np.quantile(errors, (0.05, 0.5, 0.95), axis=-1, method="inverted_cdf")
    ax.set_yscale("log")
    ax.fill_between(x, low, high, color=style["color"], alpha=0.25, lw=0)
    ax.plot(x, median, **style)
    edges = np.concatenate([x[:1], (x[1:] + x[:-1]) / 2, x[-1:]])
    for j in np.flatnonzero(lost):
        ax.axvspan(edges[j], edges[j + 1], color="0.88", lw=0, zorder=0)
    ax.plot(at, high[x == at], "*", color=style["color"], mec="black", ms=11)
    ax.set_ylim(limits)
    grid(ax)
