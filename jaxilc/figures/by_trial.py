"""Errors against the trial, with a logarithmic axis."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from .style import (
    COLOURS,
    grid,
    labelled,
    legend_beside,
    marks_of,
    names_of,
    new_axes,
    style_of,
    trial_axis,
)

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes

    from ..sweeps.summary import SchemeSummary
    from ..theory import Certificate


def error_by_trial(
    dataset: xr.Dataset,
    *,
    metric: str = "settled_error",
    scale: float = 1.0,
    unit: str = "",
    published: Iterable = (),
    ax: Axes | None = None,
) -> Axes:
    """The error of one machine against the trial, for each scheme, with printed values.

    A printed value has the scheme's colour; it is an open circle, or a caret below a printed upper
    bound. A trial that diverged is left out. The legend says in which trial learning diverged, and
    from which trial on an error has grown.

    dataset: over (scheme, trial), as `run_schemes` gives it
    metric: name of a variable over these
    scale, unit: the errors are shown as `scale` times those of the dataset, in `unit`
    published: rows with scheme, trial (None for a scheme that does not learn, shown at trial 1),
        quantity, value [unit], at_most
    Raises ValueError for a dataset of many machines, which `error_band` shows.
    """
    from matplotlib.markers import CARETDOWNBASE

    if dataset.sizes.get("sample", 1) > 1:
        raise ValueError(
            f"error_by_trial: the dataset has {dataset.sizes['sample']} machines; allowed is one, "
            "and error_band shows many"
        )
    ax = new_axes(ax)
    published = [
        p for p in published if p.quantity == metric and (p.trial or 1) <= dataset.sizes["trial"]
    ]
    for i, name in enumerate(names_of(dataset)):
        errors = dataset[metric].sel(scheme=name)
        errors = scale * errors.max([d for d in errors.dims if d != "trial"])
        if "diverged" in dataset:
            errors = errors.where(~dataset["diverged"].sel(scheme=name))
        ax.semilogy(
            dataset["trial"],
            errors,
            label=name + _course(dataset, name),
            **style_of(i),
            **marks_of(i, len(errors)),
        )
        for p in published:
            if p.scheme == name:
                mark = {
                    "marker": CARETDOWNBASE if p.at_most else "o",
                    "markersize": 9 if p.at_most else 6,
                }
                ax.plot([p.trial or 1], [p.value], **mark, mfc="none", color=style_of(i)["color"])
    if any(not p.at_most for p in published):
        ax.plot([], [], "o", mfc="none", color="k", label="published")
    if any(p.at_most for p in published):
        ax.plot(
            [],
            [],
            marker=CARETDOWNBASE,
            linestyle="none",
            markersize=9,
            mfc="none",
            color="k",
            label="published: less",
        )
    ax.set(ylabel=labelled(metric, unit))
    trial_axis(ax)
    grid(ax)
    legend_beside(ax)
    return ax


def error_band(
    dataset: xr.Dataset,
    *,
    metric: str = "settled_error",
    tolerance: float | None = None,
    scale: float = 1.0,
    unit: str = "",
    summary: list[SchemeSummary] | None = None,
    ax: Axes | None = None,
) -> Axes:
    """A sweep: median, 5-95 % band and worst machine against the trial, with the tolerance.

    The legend says which share of the machines diverged; these count as infinite in every quantile.
    The axis ends at ten times the largest median, so that an unstable machine does not hide the
    others.

    dataset: over (scheme, sample, trial), one machine a sample
    metric: name of a variable over these
    tolerance: largest error that passes [unit of the dataset]
    scale, unit: the errors are shown as `scale` times those of the dataset, in `unit`
    summary: what `summarise` gives for this dataset and metric, None to have it computed
    """
    from ..sweeps.summary import summarise

    ax, trial = new_axes(ax), dataset["trial"]
    rows = summarise(dataset, tolerance, metric=metric) if summary is None else summary
    medians = np.concatenate([row.median for row in rows])
    for i, row in enumerate(rows):
        style, marks = style_of(i), marks_of(i, len(trial))
        lost = f" ({row.diverged:.1%} diverged)" if row.diverged else ""
        ax.semilogy(trial, scale * row.median, label=row.scheme + lost, **style, **marks)
        ax.fill_between(
            trial, scale * row.low, scale * row.high, color=style["color"], alpha=0.2, linewidth=0
        )
        ax.semilogy(
            trial,
            scale * row.worst,
            **{**style, "linestyle": "none"},
            **{**marks, "markevery": 1, "markersize": 2},
        )
    ax.plot([], [], color="k", label="median")
    ax.fill_between([], [], [], color="k", alpha=0.2, linewidth=0, label="5–95 %")
    ax.plot([], [], "k.", markersize=3, label="worst machine")
    if tolerance is not None:
        ax.axhline(
            scale * tolerance,
            color="k",
            linewidth=0.8,
            linestyle="--",
            label=f"tolerance {scale * tolerance:g} {unit}",
        )
    if np.any(np.isfinite(medians)):
        ax.set_ylim(top=10.0 * scale * np.max(medians[np.isfinite(medians)]))
    ax.set(ylabel=labelled(metric, unit), title=f"{dataset.sizes['sample']} machines")
    trial_axis(ax)
    grid(ax)
    legend_beside(ax)
    return ax


def _course(dataset: xr.Dataset, name: str) -> str:
    """The text for the legend: in which trial a scheme diverged, or its error began to grow."""
    for what, since in (("diverged", "diverged_at"), ("grown", "grown_from")):
        trial = int(dataset[since].sel(scheme=name)) if since in dataset else 0
        if trial:
            return (
                f" ({what} from trial {trial} on)"
                if what == "grown"
                else f" ({what} at trial {trial})"
            )
    return ""


def certificate(
    found: Certificate,
    *,
    scale: float = 1.0,
    unit: str = "",
    title: str = "",
    ax: Axes | None = None,
) -> Axes:
    """The RMS error of every machine by trial, predicted by theory and simulated.

    found: certificate from `theory.certify`
    scale, unit: the errors are shown as `scale` times those found, in `unit`
    """
    ax = new_axes(ax)
    trial = np.arange(1, found.predicted.shape[1] + 1)
    for errors, colour, dash, label in (
        (found.simulated, COLOURS[0], "-", "simulated"),
        (found.predicted, COLOURS[1], "--", "predicted"),
    ):
        shown = np.where(np.isfinite(errors) & (errors > 0), scale * errors, np.nan)
        ax.semilogy(trial, shown.T, color=colour, linewidth=0.5, alpha=0.35, linestyle=dash)
        ax.semilogy(
            trial,
            shown[0],
            color=colour,
            linewidth=2,
            linestyle=dash,
            label=f"{label} (thick: nominal)",
        )
    ax.set(ylabel=labelled("RMS error", unit), title=f"{title}: {len(found.claim)} machines")
    trial_axis(ax)
    grid(ax)
    legend_beside(ax)
    return ax
