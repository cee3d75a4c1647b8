"""A sweep at a glance: one panel a scheme, and the yield against the tolerance beside them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from .style import COLOURS, limits_of, names_of, readable, trial_axis
from .units import name_axis, written

if TYPE_CHECKING:
    import xarray as xr

    from ..sweeps.summary import SchemeSummary

GROWS = 10.0  # an error is shown up to so many times that of the first trial
SAME = 1e-3  # relative difference of medians below which no trial is better than the others
MANY = 4  # schemes from which on three panels stand side by side


def error_band(
    dataset: xr.Dataset,
    *,
    metric: str = "settled_error",
    tolerance: float | None = None,
    scale: float = 1.0,
    unit: str = "",
    summary: list[SchemeSummary] | None = None,
) -> np.ndarray:
    """A sweep: a panel for each scheme, and the share of machines within any tolerance; n+1 axes.

    A panel shows the median, the band of 5 to 95 %, the worst machine, the tolerance, and the trial
    of the least median. All panels have the same limits, which follow from the errors. What leaves
    them at the top, such as a scheme that diverges, is cut off there and told in the panel. The
    last axes show which share of the machines ends within a tolerance, against the tolerance.

    dataset: over (scheme, sample, trial), one machine a sample
    metric: name of a variable over these
    tolerance: largest error that passes [unit of the dataset]
    scale, unit: the errors are shown as `scale` times those of the dataset, in `unit`
    summary: what `summarise` gives for this dataset and metric, None to have it computed
    """
    from ..sweeps.summary import errors_of, summarise

    rows = summarise(dataset, tolerance, metric=metric) if summary is None else summary
    trial = np.asarray(dataset["trial"])
    limit = None if tolerance is None else scale * tolerance
    limits = _limits(rows, scale, limit)
    figure, panels, share = _panels(len(rows))
    for i, (row, ax) in enumerate(zip(rows, panels, strict=True)):
        ax.set_yscale("log")
        _panel(ax, row, trial, i, scale, limit, limits)
        ax.grid(True, alpha=0.25)
    for i, ax in enumerate(panels):
        trial_axis(ax, 6)
        name_axis(ax.yaxis, metric, unit)
        place, below = ax.get_subplotspec(), i + _columns(len(rows)) < len(rows)
        ax.tick_params(labelleft=place.is_first_col(), labelbottom=not below)
        ax.set_ylabel(ax.get_ylabel() if place.is_first_col() else "")
        ax.set_xlabel("" if below else ax.get_xlabel())
    last = scale * errors_of(dataset, metric).isel(trial=-1).values
    _shares(share, names_of(dataset), last, (metric, unit, limit), limits)
    _explain(figure, limit, unit)
    figure.suptitle(f"{dataset.sizes['sample']} machines, {len(trial)} trials", fontsize="medium")
    return np.array([*panels, share])


def _columns(count: int) -> int:
    """How many panels stand side by side."""
    return 3 if count > MANY else min(count, 2)


def _panels(count: int) -> tuple[Any, list[Any], Any]:
    """The figure, the panels with shared axes, and the axes of the shares beside them."""
    from matplotlib.figure import Figure

    columns = _columns(count)
    rows = math.ceil(count / columns)
    size = (3.4 + 2.4 * columns + 0.8 * (columns == 1), 1.3 + 2.1 * max(rows, 1.4))
    figure = Figure(figsize=size, layout="constrained", dpi=150)
    ratios = (*[1.0] * columns, 1.35 if columns > 1 else 1.0)
    cells = figure.add_gridspec(rows, columns + 1, width_ratios=ratios)
    panels: list[Any] = []
    for i in range(count):
        shared = panels[0] if panels else None
        cell = cells[i // columns, i % columns]
        panels.append(figure.add_subplot(cell, sharex=shared, sharey=shared))
    return figure, panels, figure.add_subplot(cells[:, columns])


def _limits(rows, scale: float, limit: float | None) -> tuple[float, float]:
    """Limits that hold what learns, and the tolerance; a scheme that grows counts up to GROWS."""
    shown = [] if limit is None else [limit]
    for row in rows:
        low, median, high = (scale * np.asarray(x) for x in (row.low, row.median, row.high))
        top = top_of(median)
        for values in (low, median, high):
            kept = values[np.isfinite(values) & (values > 0)]
            shown += np.minimum(kept, top).tolist()
    return limits_of(shown) or (0.1, 10.0)


def top_of(median) -> float:
    """Up to where the errors are shown whose first median is positive; infinite for others."""
    return GROWS * median[0] if 0 < median[0] < np.inf else np.inf


def _panel(ax, row, trial, i: int, scale: float, limit: float | None, limits) -> None:
    """Median, band, worst machine, tolerance and best trial of one scheme, within the limits."""
    colour, top = COLOURS[i % len(COLOURS)], limits[1]
    low, median, high, worst = (
        scale * np.asarray(x, float) for x in (row.low, row.median, row.high, row.worst)
    )
    inside = np.where(low < top, low, np.nan)  # where all machines are beyond the top
    ax.fill_between(trial, inside, np.minimum(high, top), color=colour, alpha=0.22, linewidth=0)
    ax.plot(trial, np.where(worst <= top, worst, np.nan), ":", color=colour, linewidth=1.0)
    ax.plot(trial, np.where(median <= top, median, np.nan), color=colour, linewidth=1.6)
    if limit is not None:
        ax.axhline(limit, color="k", linewidth=0.8, linestyle="--")
    known = median[np.isfinite(median) & (median > 0)]
    if known.size and known.max() > (1 + SAME) * known.min():
        best = int(np.argmin(np.where(np.isfinite(median) & (median > 0), median, np.inf)))
        ax.plot(trial[best], median[best], "o", mfc="none", color=colour, markersize=6)
    ax.set_ylim(*limits)
    ax.set_xlim(trial[0] - 0.5, trial[-1] + 0.5)
    look = {"color": readable(colour), "loc": "left", "fontweight": "bold"}
    ax.set_title(row.scheme, fontsize="small", **look)
    said = _said(row, high > top * 1.001, trial)
    if said:
        ax.text(
            0.98, 0.96, said, transform=ax.transAxes, ha="right", va="top", fontsize="x-small",
            bbox={"facecolor": "w", "edgecolor": "none", "alpha": 0.7, "pad": 1.5},
        )  # fmt: skip


def _said(row, beyond, trial) -> str:
    """What a panel tells in words: the yield, machines that diverged, a band that is cut off."""
    lines = []
    if np.isfinite(row.yield_share):
        lines.append(f"{row.yield_share:.1%} within tolerance")
    if row.diverged:
        lines.append(f"{row.diverged:.1%} diverged")
    if np.any(beyond):
        since = trial[np.flatnonzero(beyond)[0]]
        lines.append(f"band cut off at the top\nfrom trial {since} on")
    return "\n".join(lines)


def _shares(ax, names, last: np.ndarray, shown: tuple, held: tuple[float, float]) -> None:
    """The share of the machines whose last error is within a tolerance, against the tolerance.

    last: (schemes, machines) errors of the last trial, inf where one diverged
    shown: name of the metric, its unit, and the tolerance
    held: ends of the axis of tolerances
    """
    metric, unit, limit = shown
    for i, errors in enumerate(last):
        found = np.sort(errors[(errors > held[0]) & (errors <= held[1])])
        zero = np.mean(errors <= held[0])
        share = np.concatenate([[zero], zero + np.arange(1, len(found) + 1) / len(errors)])
        at = np.concatenate([[held[0]], found])
        at, share = np.append(at, held[1]), np.append(share, share[-1])
        ax.plot(
            at, 100 * share, drawstyle="steps-post", color=COLOURS[i % len(COLOURS)],
            linewidth=1.6, label=names[i],
        )  # fmt: skip
    ax.set(xscale="log", xlim=held, ylim=(-3, 103), ylabel="machines within [%]")
    if limit is not None:
        ax.axvline(limit, color="k", linewidth=0.8, linestyle="--")
    ax.set_title("yield against tolerance", fontsize="small", loc="left")
    name_axis(ax.xaxis, f"tolerance of the last {metric.replace('_', ' ')}", unit)
    ax.grid(True, alpha=0.25)
    ax.tick_params(axis="x", labelrotation=30)


def _explain(figure, limit: float | None, unit: str) -> None:
    """One line below all panels that says what the lines are."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles: list[Any] = [
        Line2D([], [], color="0.3", linewidth=1.6, label="median"),
        Patch(color="0.3", alpha=0.22, linewidth=0, label="5 to 95 %"),
        Line2D([], [], color="0.3", linestyle=":", label="worst machine"),
        Line2D([], [], color="0.3", marker="o", mfc="none", linestyle="", label="best trial"),
    ]
    if limit is not None:
        said = f"tolerance {written(limit, unit)}"
        handles.append(Line2D([], [], color="k", linestyle="--", linewidth=0.8, label=said))
    figure.legend(handles=handles, loc="outside lower center", ncols=5, fontsize="small")
