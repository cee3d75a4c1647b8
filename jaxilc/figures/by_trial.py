"""Errors against the trial, with a logarithmic axis."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from .style import (
    COLOURS,
    grid,
    legend_beside,
    limits_of,
    marks_of,
    names_of,
    new_axes,
    style_of,
    trial_axis,
)
from .units import name_axis

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes

    from ..theory import Certificate

# Colours of what is claimed: monotone, converges, diverges, not claimed.
HUES = (COLOURS[0], COLOURS[2], COLOURS[1], "0.45")
SAID = {"monotone": "claimed monotone", "converges": "claimed to converge",
        "diverges": "claimed to diverge", "not claimed": "nothing claimed"}  # fmt: skip


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
    held = limits_of([v for line in ax.lines for v in line.get_ydata()])
    if held:
        ax.set_ylim(*held)
    ax.set_title(f"{metric.replace('_', ' ')} by trial, one machine", fontsize="medium")
    trial_axis(ax)
    grid(ax)
    name_axis(ax.yaxis, metric, unit)
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
    ax: Any = None,
) -> np.ndarray:
    """What theory claims of each machine, and the errors that it predicts and simulation has.

    Above, the RMS error of each machine by trial, in the colour of its claim; the median prediction
    is dashed. Below, how many machines have each claim. Two axes.

    found: certificate from `theory.certify`
    scale, unit: the errors are shown as `scale` times those found, in `unit`
    """
    from matplotlib.ticker import MaxNLocator

    from ..theory.certificates import CLAIMS

    top, bottom = axes = new_axes(
        ax, 2, size=(7.2, 5.2), sharex=False, height_ratios=(3.2, 1), squeeze=True
    )
    trial, looks = np.arange(1, found.predicted.shape[1] + 1), dict(zip(CLAIMS, HUES, strict=False))
    counts = {name: int(np.sum(found.claim == name)) for name in CLAIMS}
    for name in CLAIMS:
        of_claim = found.claim == name
        errors = np.where(np.isfinite(found.simulated), scale * found.simulated, np.nan)[of_claim]
        if len(errors):
            width = {"linewidth": 0.6, "alpha": 0.6} if len(errors) > 3 else {"linewidth": 1.2}
            top.semilogy(trial, errors.T, color=looks[name], **width)
            top.plot([], [], color=looks[name], label=f"simulated, {SAID.get(name, name)}")
    sure = np.where(np.isfinite(found.predicted) & (found.predicted > 0), found.predicted, np.nan)
    if np.any(np.isfinite(sure)):
        known = np.any(np.isfinite(sure), axis=0)
        middle = np.full(len(trial), np.nan)
        middle[known] = scale * np.nanmedian(sure[:, known], axis=0)
        top.semilogy(trial, middle, "k--", linewidth=1.4, label="predicted, median machine")
    held = limits_of([v for line in top.lines for v in line.get_ydata()])
    if held:
        first = scale * np.nanmax(np.where(np.isfinite(sure[:, 0]), sure[:, 0], 0), initial=0)
        top.set_ylim(held[0], min(held[1], 1e3 * first) if first > 0 else held[1])
    top.set_title(f"{title}: {len(found.claim)} machines".removeprefix(": "), fontsize="medium")
    trial_axis(top)
    grid(top)
    name_axis(top.yaxis, "RMS error", unit)
    top.legend(fontsize="small", loc="upper left", bbox_to_anchor=(1.0, 1.02))
    shown = [name for name in CLAIMS if counts[name]] or list(CLAIMS[:1])
    names = [SAID.get(name, name) for name in shown]
    bars = bottom.barh(
        names, [counts[n] for n in shown], color=[looks[n] for n in shown], height=0.6
    )
    bottom.bar_label(bars, padding=4, fontsize="small")
    bottom.set(xlabel="machines", xlim=(0, 1.12 * len(found.claim)))
    bottom.xaxis.set_major_locator(MaxNLocator(8, integer=True))
    bottom.set_axisbelow(True)
    bottom.invert_yaxis()
    bottom.grid(True, axis="x", alpha=0.25)
    return axes
