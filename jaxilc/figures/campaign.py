"""The figure of a campaign on a real machine: errors on their prediction, and the last trial."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from .style import COLOURS, grid, legend_beside, new_axes, trial_axis
from .units import name_axis

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from ..hardware.prediction import Prediction

AHEAD = 5  # trials after the last one whose prediction is shown


class LastTrial(NamedTuple):
    """A measured trial against time.

    number: its number
    time: (N+1,) [s];  r, y: (N+1, n_y);  u: (N, n_u)
    """

    number: int
    time: np.ndarray
    r: Any
    y: np.ndarray
    u: np.ndarray


class Bands(NamedTuple):
    """The predicted RMS error by trial of a campaign.

    trial: (J,) numbers of the trials, the next ones included
    low, median, high: (J,) ends of the 95 % band and median [unit of y]; the same where the plant
        file gives neither uncertainty nor noise
    """

    trial: np.ndarray
    low: np.ndarray
    median: np.ndarray
    high: np.ndarray


def bands_by_trial(live: list[dict[str, Any]], prediction: Prediction) -> Bands:
    """The prediction of each trial of a campaign, and of some trials after them.

    A trial that was not learned from is followed by one with the same prediction.

    live: manifests of the start and of the trials that count, see `Journal.live`
    """
    from ..hardware.prediction import next_step, steps

    last, step = live[-1]["trial"], next_step(live)
    # fewer than the trials so far, so that these are not pressed together
    ahead = max(1, min(AHEAD, len(live)))
    found = np.array([*steps(live), *range(step, step + ahead)])
    number = np.array([m["trial"] for m in live[1:]] + [last + 1 + i for i in range(ahead)])
    known = found <= prediction.trials
    low, median, high = (end[found[known] - 1] for end in prediction.rms)
    if prediction.certain:
        low, high = median, median
    return Bands(number[known], low, median, high)


def campaign_figure(
    rows: Sequence[dict[str, Any]],
    *,
    unit: str = "",
    input_unit: str = "",
    bands: Bands | None = None,
    last: LastTrial | None = None,
    ax: Sequence[Axes] | None = None,
) -> Any:
    """The errors by trial with a logarithmic axis, and below them the RMS input; two axes.

    With the last trial there are three more axes: reference and output, error, and input against
    time. Trials that were undone are open marks.

    rows: result of `Journal.log`
    unit, input_unit: units of y and of u
    bands: predicted RMS error by trial
    """
    size = (7.2, 1.6 + 2.2 * 5) if last else None
    axes = new_axes(ax, rows=5 if last else 2, size=size, sharex=False)
    top, bottom = axes[:2]
    measured = [row for row in rows if row["event"] == "trial"]
    if bands is not None and len(bands.trial):
        _band(top, bands)
    channels = {
        prefix: [n for n in (measured[0] if measured else ()) if n.startswith(prefix)]
        for prefix in ("max_error_", "effort_")
    }
    for axis, names, colours in (
        (top, ["rms_error", *channels["max_error_"]], COLOURS),
        (bottom, channels["effort_"], COLOURS[2:]),
    ):
        for name, colour in zip(names, colours, strict=False):
            live = [(row["trial"], row[name]) for row in measured if row["live"]]
            undone = [(row["trial"], row[name]) for row in measured if not row["live"]]
            label = (
                name.replace("_", " ")
                if len(names) > 2 or name == "rms_error"
                else name.replace("_", " ").removesuffix(" 0")
            )
            if live:
                axis.plot(*zip(*live, strict=True), "o-", color=colour, markersize=4, label=label)
            if undone:
                axis.plot(
                    *zip(*undone, strict=True),
                    "o",
                    mfc="none",
                    color=colour,
                    markersize=5,
                    label=f"{label}, undone",
                )
    top.set(yscale="log")
    for axis in (top, bottom):
        trial_axis(axis)
    bottom.sharex(top)
    if last is not None:
        _last_trial(axes[2:], last)
    for axis in axes:
        grid(axis)
        if axis.get_legend_handles_labels()[0]:
            legend_beside(axis)
    names = (("error", unit), ("RMS input", input_unit), ("output", unit), ("error", unit),
             ("input", input_unit))  # fmt: skip
    for axis, (name, of) in zip(axes, names, strict=False):
        name_axis(axis.yaxis, name, of)
    top.figure.align_ylabels(axes)
    return axes


def _band(axis: Axes, bands: Bands) -> None:
    """The predicted band, and its median; an infinite end is drawn up to the top of the axis."""
    ends = np.concatenate([bands.low, bands.median, bands.high])
    largest = np.max(ends, where=np.isfinite(ends), initial=np.finfo(float).tiny)
    low, median, high = (np.minimum(end, 10 * largest) for end in bands[1:])
    look: dict[str, Any] = {"color": COLOURS[4], "alpha": 0.35}
    if len(bands.trial) == 1:  # a single trial has no width
        axis.vlines(bands.trial, low, high, linewidth=8, **look)
    if np.any(low < high):
        axis.fill_between(bands.trial, low, high, linewidth=0, label="predicted, 95 %", **look)
    axis.plot(bands.trial, median, color=COLOURS[4], linewidth=1, label="predicted, median")


def _last_trial(axes: Sequence[Axes], last: LastTrial) -> None:
    """Reference and output, error, and input of a trial against time."""
    r, y, u = (np.asarray(x).reshape(len(x), -1) for x in last[2:])
    several = y.shape[1] > 1
    for i in range(y.shape[1]):
        name, colour = f" {i}" * several, COLOURS[i % len(COLOURS)]
        axes[0].plot(last.time, r[:, i], color="#999999", linewidth=3, label=f"reference{name}")
        axes[0].plot(last.time, y[:, i], color=colour, linewidth=1, label=f"output{name}")
        axes[1].plot(last.time, (r - y)[:, i], color=colour, linewidth=0.8)
    for i in range(u.shape[1]):
        axes[2].plot(
            last.time[:-1],
            u[:, i],
            color=COLOURS[(i + 2) % len(COLOURS)],
            linewidth=0.8,
            drawstyle="steps-post",
        )
    axes[0].set_title(f"trial {last.number}", fontsize="medium")
    axes[2].set_xlabel("time [s]")
    for axis in axes:
        axis.set_xlim(last.time[0], last.time[-1])
