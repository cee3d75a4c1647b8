"""Figures as engineers read them. Each function takes a dataset and returns the axes it drew on.

Schemes keep their colour and line style through all figures of a dataset, so that they can be told apart in print.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes

    from .identification import Identified
    from .records import Record
    from .theory import Certificate
    from .trade_off import Point
    from .tuning import Tuned

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#000000")  # safe for the colour-blind
DASHES = ("-", "--", "-.", ":", (0, (5, 1)), (0, (3, 1, 1, 1)), (0, (1, 1)))


def _style(dataset: xr.Dataset, scheme: str) -> dict:
    i = [str(s) for s in dataset["scheme"].values].index(scheme)
    return {"color": COLOURS[i % len(COLOURS)], "linestyle": DASHES[i % len(DASHES)]}


def _axes(ax: Axes | None, rows: int = 1):
    """The axes given, or those of a new figure without pyplot's global state."""
    if ax is not None:
        return ax
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.2, 1.6 + 2.6 * rows), layout="constrained", dpi=150)
    return figure.subplots(rows, 1, sharex=True)


def _names(dataset: xr.Dataset) -> list[str]:
    return [str(s) for s in dataset["scheme"].values]


def _worst_channel(array: xr.DataArray, *keep: str) -> xr.DataArray:
    return array.max([d for d in array.dims if d not in keep])


def error_by_trial(
    dataset: xr.Dataset,
    *,
    figure: str = "settled_error",
    scale: float = 1.0,
    unit: str = "",
    published: Iterable = (),
    ax: Axes | None = None,
) -> Axes:
    """Error of one machine against the trial, log axis; printed values as open circles in the scheme's colour.

    dataset: dims (scheme, trial);  scale, unit: of the errors shown;  published: rows with scheme, trial, quantity, value [unit]
    """
    ax = _axes(ax)
    for name in _names(dataset):
        errors = scale * _worst_channel(dataset[figure].sel(scheme=name), "trial")
        ax.semilogy(dataset["trial"], errors, label=name, **_style(dataset, name))
        printed = [(p.trial, p.value) for p in published if (p.scheme, p.quantity) == (name, figure) and p.trial]
        if printed:
            ax.plot(*zip(*printed, strict=True), "o", mfc="none", color=_style(dataset, name)["color"], label=f"{name}, published")
    ax.set(xlabel="trial", ylabel=f"{figure.replace('_', ' ')} [{unit}]")
    ax.grid(True, which="both", alpha=0.25)
    ax.legend()
    return ax


def tracking(dataset: xr.Dataset, scheme: str, trials: Sequence[int], *, scale: float = 1.0, unit: str = "", ax=None):
    """Output, error and input of one scheme against time, for chosen trials; three axes.

    dataset: with y, e (scheme, trial, time, channel) and u (scheme, trial, input_time, input);  scale, unit: of the error shown
    """
    top, middle, bottom = axes = _axes(ax, rows=3)
    chosen = dataset.sel(scheme=scheme)
    shades = np.linspace(0.75, 0.0, len(trials))
    for channel in range(dataset.sizes["channel"]):
        top.plot(
            dataset["time"], dataset["r"].isel(channel=channel), color="#999999", linewidth=3, label="reference" if channel == 0 else None
        )
    for trial, shade in zip(trials, shades, strict=True):
        now, colour = chosen.sel(trial=trial), str(shade)
        for channel in range(dataset.sizes["channel"]):
            label = f"trial {trial}" if channel == 0 else None
            top.plot(dataset["time"], now["y"].isel(channel=channel), color=colour, linewidth=1, linestyle=DASHES[channel % 4], label=label)
            error = scale * now["e"].isel(channel=channel)
            middle.plot(dataset["time"], error, color=colour, linewidth=1, linestyle=DASHES[channel % 4])
        for i in range(dataset.sizes["input"]):
            bottom.plot(dataset["input_time"], now["u"].isel(input=i), color=colour, linewidth=1, linestyle=DASHES[i % 4])
    last = scale * np.nanmax(np.abs(chosen["e"].sel(trial=list(trials)[1:] or list(trials)).values), initial=0.0)
    if np.isfinite(last) and last > 0:
        middle.set_ylim(-1.2 * last, 1.2 * last)
    top.set(ylabel=f"output [{dataset['y'].attrs.get('units', '')}]", title=scheme)
    middle.set(ylabel=f"error [{unit}]")
    bottom.set(ylabel=f"input [{dataset['u'].attrs.get('units', '')}]", xlabel="time [s]")
    for axis in axes:
        axis.grid(True, alpha=0.25)
    top.legend(ncols=3, fontsize="small")
    return axes


def error_band(
    dataset: xr.Dataset,
    *,
    figure: str = "settled_error",
    tolerance: float | None = None,
    scale: float = 1.0,
    unit: str = "",
    ax: Axes | None = None,
) -> Axes:
    """A sweep: median, 5-95 % band and worst sample against the trial, log axis, with the tolerance.

    What lies more than ten times above every median (an unstable machine) is off the scale.
    dataset: dims (scheme, sample, trial);  tolerance: in the unit of the dataset
    """
    from .summary import summarise

    ax = _axes(ax)
    rows = summarise(dataset, tolerance or 1.0, figure=figure)
    medians = np.concatenate([row.median for row in rows])
    for row in rows:
        style, trial = _style(dataset, row.scheme), dataset["trial"]
        ax.semilogy(trial, scale * row.median, label=f"{row.scheme}: median, 5–95 %", **style)
        ax.fill_between(trial, scale * row.low, scale * row.high, color=style["color"], alpha=0.2, linewidth=0)
        ax.semilogy(trial, scale * row.worst, color=style["color"], linewidth=0.8, alpha=0.8, marker=".", markersize=3, linestyle="none")
    ax.plot([], [], "k.", markersize=3, label="worst sample")
    if np.any(np.isfinite(medians)):
        ax.set_ylim(top=10.0 * scale * np.max(medians[np.isfinite(medians)]))
    if tolerance is not None:
        ax.axhline(scale * tolerance, color="k", linewidth=0.8, label=f"tolerance {scale * tolerance:g} {unit}")
    ax.set(xlabel="trial", ylabel=f"{figure.replace('_', ' ')} [{unit}]", title=f"{dataset.sizes['sample']} machines")
    ax.grid(True, which="both", alpha=0.25)
    ax.legend(fontsize="small")
    return ax


def certificate(found: Certificate, *, scale: float = 1.0, unit: str = "", title: str = "", ax: Axes | None = None) -> Axes:
    """Root mean square error by trial as theory predicts it and as it was simulated, every machine, log axis.

    found: from `theory.certify`;  scale, unit: of the error shown
    """
    ax = _axes(ax)
    trial = np.arange(1, found.predicted.shape[1] + 1)
    for errors, colour, label in ((found.observed, COLOURS[0], "simulated"), (found.predicted, COLOURS[1], "predicted")):
        shown = np.where(np.isfinite(errors) & (errors > 0), scale * errors, np.nan)
        ax.semilogy(trial, shown.T, color=colour, linewidth=0.5, alpha=0.35)
        ax.semilogy(trial, shown[0], color=colour, linewidth=2, label=f"{label} (thick: nominal)")
    ax.set(xlabel="trial", ylabel=f"RMS error [{unit}]", title=f"{title}: {len(found.sigma)} machines")
    ax.grid(True, which="both", alpha=0.25)
    ax.legend(fontsize="small")
    return ax


def save(axes, path: str | Path) -> Path:
    """Write the figure that holds the axes."""
    figure = np.ravel(axes)[0].figure
    figure.savefig(path)
    return Path(path)


def record_figure(record: Record, *, input_unit: str = "", output_unit: str = "", ax=None):
    """An identification experiment against time, input over output (Cao 2019, Fig. 2 and 3); two axes."""
    top, bottom = axes = _axes(ax, rows=2)
    for axis, signal, style in ((top, record.u, {"drawstyle": "steps-post"}), (bottom, record.y, {})):
        signal = np.reshape(signal, (len(signal), -1))
        for i, values in enumerate(signal.T):
            label = f"{i}" if signal.shape[1] > 1 else None
            axis.plot(np.arange(len(signal)) * record.dt, values, color=COLOURS[i % len(COLOURS)], linewidth=0.8, label=label, **style)
        if signal.shape[1] > 1:
            axis.legend(ncols=4, fontsize="small")
        axis.grid(True, alpha=0.25)
    top.set(ylabel=f"input [{input_unit}]")
    bottom.set(ylabel=f"output [{output_unit}]", xlabel="time [s]")
    return axes


def validation_figure(record: Record, identified: Identified, *, output_unit: str = "", scale: float = 1.0, unit: str = "", ax=None):
    """Measured and simulated output, and their difference (Cao 2019, Fig. 4); the part that was not fitted is shaded; two axes.

    scale, unit: of the residual shown
    """
    top, bottom = axes = _axes(ax, rows=2)
    y = np.reshape(record.y, (len(record.y), -1))
    time = np.arange(len(y)) * record.dt
    for i in range(y.shape[1]):
        name, colour = f" {i}" * (y.shape[1] > 1), COLOURS[i % len(COLOURS)]
        fits = f"fit {identified.fit[i]:.2f} %"
        if identified.samples < len(y):
            fits += f", validation {identified.validation_fit[i]:.2f} %"
        top.plot(time, y[:, i], color="#999999", linewidth=3, label=f"measured{name}")
        top.plot(time, identified.simulated[:, i], color=colour, linewidth=1, label=f"simulated{name}: {fits}")
        bottom.plot(time, scale * (y[:, i] - identified.simulated[:, i]), color=colour, linewidth=0.8)
    for axis in axes:
        axis.set_xlim(time[0], time[-1])
        if identified.samples < len(y):
            axis.axvspan(time[identified.samples], time[-1], color="#e69f00", alpha=0.12, linewidth=0, label="not fitted")
        axis.grid(True, alpha=0.25)
    top.set(ylabel=f"output [{output_unit}]")
    bottom.set(ylabel=f"residual [{unit}]", xlabel="time [s]")
    top.legend(ncols=3, fontsize="small", loc="lower right", bbox_to_anchor=(1.0, 1.0))
    return axes


def loss_by_step(tuned: Tuned, *, ax: Axes | None = None) -> Axes:
    """A tuning: loss on the plants tuned on against the step, each start, and on the held-out ones where they were looked at."""
    ax = _axes(ax)
    for k, losses in enumerate(tuned.loss.T):
        ax.plot(losses, color=COLOURS[0], linewidth=0.8, alpha=0.8, label="plants tuned on" if k == 0 else None)
    for k, losses in enumerate(tuned.held_out.T):
        looked = np.flatnonzero(np.isfinite(losses))
        ax.plot(looked, losses[looked], "o--", color=COLOURS[1], markersize=3, linewidth=0.5, label="held-out plants" if k == 0 else None)
    ax.plot(tuned.step, tuned.after, "k*", markersize=10, label="chosen")
    ax.set(xlabel="step", ylabel="loss")
    ax.grid(True, alpha=0.25)
    ax.legend(fontsize="small")
    return ax


def worst_against_chance(drawn, found: Mapping[str, float], *, nominal: float, figure: str = "", unit: str = "", ax=None) -> Axes:
    """A search for the worst machine: distribution of the figure over drawn machines, log axis, and what each search found.

    drawn: (S,) figures of the machines drawn by chance;  found: largest figure by the name of the search;  nominal: figure
    """
    ax = _axes(ax)
    drawn = np.asarray(drawn)
    drawn = drawn[np.isfinite(drawn) & (drawn > 0)]
    low, high = drawn.min(), drawn.max() * (1 + 1e-9)
    ax.hist(drawn, bins=np.geomspace(low, high, 60) if high > 1.01 * low else 10, color="#999999", label=f"{len(drawn)} machines drawn")
    ax.axvline(nominal, color="k", linewidth=0.8, label=f"nominal {nominal:.4g}")
    for i, (name, value) in enumerate(found.items()):
        if np.isfinite(value):
            ax.axvline(value, color=COLOURS[i % len(COLOURS)], linestyle=DASHES[i % len(DASHES)], label=f"{name} {value:.4g}")
    ax.set(xscale="log", yscale="log", xlabel=f"{figure.replace('_', ' ')} [{unit}]", ylabel="machines")
    ax.grid(True, which="both", alpha=0.25)
    ax.legend(fontsize="small")
    return ax


def pareto_front(points: Iterable[Point], *, first: str = "", second: str = "", ax: Axes | None = None) -> Axes:
    """A trade-off: both objectives of each point, its share of the first one beside it.

    points: from `trade_off.pareto`;  first, second: names of the objectives
    """
    ax = _axes(ax)
    points = sorted(points, key=lambda p: p.first)
    ax.plot([p.first for p in points], [p.second for p in points], "o-", color=COLOURS[0], drawstyle="steps-post")
    for p in points:
        ax.annotate(f"{p.share:g}", (p.first, p.second), textcoords="offset points", xytext=(6, 4), fontsize="small")
    ax.set(xlabel=first, ylabel=second)
    ax.grid(True, alpha=0.25)
    return ax
