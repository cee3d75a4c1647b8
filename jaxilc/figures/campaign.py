"""The figure of a campaign on a real machine: errors on their prediction, and the last trial."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from .description import TIME, TRIAL, Axis, Band, Curve, Figure, Layer, Panel
from .paper import drawn
from .style import COLOURS, PALE, colour_of

if TYPE_CHECKING:
    from ..hardware.calibration import Expected
    from ..hardware.journal import Manifest
    from ..hardware.prediction import Prediction

AHEAD = 5  # trials after the last one whose prediction is shown


class LastTrial(NamedTuple):
    """A measured trial against time.

    number: its number
    time: (N+1,) [s];  r, y: (N+1, n_y);  u: (N, n_u)
    """

    number: int
    time: np.ndarray
    r: np.ndarray
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


def bands_by_trial(
    live: list[Manifest], prediction: Prediction, expected: Expected | None = None
) -> Bands:
    """The prediction of each trial of a campaign, and of some trials after them.

    A trial that was not learned from is followed by one with the same prediction.

    live: manifests of the start and of the trials that count, see `Journal.live`
    expected: what the trials so far expect of the next one, which stands in place of the prediction
    """
    from ..hardware.calibration import kept
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
    bands = Bands(number[known], *(end.copy() for end in (low, median, high)))
    own = {m["trial"]: kept(m) for m in live[1:]} | {last + 1: expected}
    for i, trial in enumerate(bands.trial):
        own_band = own.get(int(trial))
        if own_band is not None:
            bands.low[i], bands.median[i], bands.high[i] = (end[0] for end in own_band.rms)
    return bands


@drawn
def campaign_figure(
    rows: Sequence[Manifest],
    *,
    unit: str = "",
    input_unit: str = "",
    bands: Bands | None = None,
    last: LastTrial | None = None,
) -> Figure:
    """The errors by trial with a logarithmic axis, and below them the RMS input; two axes.

    With the last trial there are three more axes: reference and output, error, and input against
    time. Trials that were undone are open marks.

    rows: result of `Journal.log`
    unit, input_unit: units of y and of u
    bands: predicted RMS error by trial
    """
    measured = [row for row in rows if row["event"] == "trial"]
    names = [*measured[0]] if measured else []
    errors = ["rms_error", *(n for n in names if n.startswith("max_error_"))]
    efforts = [n for n in names if n.startswith("effort_")]
    predicted = [] if bands is None or not len(bands.trial) else _predicted(bands)
    trials = [row["trial"] for row in measured] + ([] if bands is None else [*bands.trial])
    room = 0.05 * np.ptp(trials or [0.0]) or 0.5
    along = TRIAL._replace(ends=(min(trials) - room, max(trials) + room)) if trials else TRIAL
    panels = [
        Panel(along, Axis("error", unit, log=True), predicted + _by_trial(measured, errors, 0)),
        Panel(along, Axis("RMS input", input_unit), _by_trial(measured, efforts, 2)),
        *([] if last is None else _last_trial(last, unit, input_unit)),
    ]
    return Figure(
        panels,
        "The error and the input of each measured trial, on what was predicted. Under the pointer "
        "stand its file and its warnings.",
        size=(7.2, 1.6 + 2.2 * 5) if last else None, shares="",
    )  # fmt: skip


def _by_trial(measured, names: Sequence[str], colour: int) -> list[Layer]:
    """Metrics of the measured trials by name; the colours begin with the one of that number."""
    layers: list[Layer] = []
    for i, name in enumerate(names):
        label = name.replace("_", " ")
        label = label if len(names) > 2 or name == "rms_error" else label.removesuffix(" 0")
        for counts in (True, False):
            of = [row for row in measured if bool(row["live"]) == counts]
            if of:
                tips = {"file": [str(row["source"]) for row in of],
                        "warnings": [str(row["warnings"]) or "–" for row in of]}  # fmt: skip
                layers.append(Curve(
                    [row["trial"] for row in of], [row[name] for row in of], mark="o",
                    dash="-" * counts, size=5 - counts, filled=counts, colour=colour_of(i + colour),
                    name=label + ", undone" * (not counts), tips=tips,
                ))  # fmt: skip
    return layers


def _predicted(bands: Bands) -> list[Layer]:
    """The predicted band, and its median; an infinite end is drawn up to the top of the axis."""
    ends = np.concatenate([bands.low, bands.median, bands.high])
    largest = np.max(ends, where=np.isfinite(ends), initial=np.finfo(float).tiny)
    low, median, high = (np.minimum(end, 10 * largest) for end in bands[1:])
    hue, name = COLOURS[4], "predicted, 95 %"
    layers: list[Layer] = []
    if np.any(low < high):
        layers.append(Band(bands.trial, low, high, colour=hue, alpha=0.35, name=name))
        if len(bands.trial) == 1:  # a single trial has no width
            x, y = [*bands.trial] * 2, [*low, *high]
            layers = [Curve(x, y, width=8, colour=hue, alpha=0.35, name=name)]
    said = "predicted, median"
    return [*layers, Curve(bands.trial, median, width=1, colour=hue, name=said)]


def _last_trial(last: LastTrial, unit: str, input_unit: str) -> list[Panel]:
    """Reference and output, error, and input of a trial against time."""
    r, y, u = (np.asarray(x).reshape(len(x), -1) for x in last[2:])
    outputs: list[Layer] = []
    for i in range(y.shape[1]):
        which, colour = f" {i}" * (y.shape[1] > 1), colour_of(i)
        outputs += [
            Curve(last.time, r[:, i], width=3, colour=PALE, name=f"reference{which}"),
            Curve(last.time, y[:, i], width=1, colour=colour, name=f"output{which}"),
        ]
    errors = [Curve(last.time, e, width=0.8, colour=colour_of(i)) for i, e in enumerate((r - y).T)]
    inputs = [
        Curve(last.time[:-1], of, width=0.8, steps=True, colour=colour_of(i + 2))
        for i, of in enumerate(u.T)
    ]
    along = TIME._replace(ends=(last.time[0], last.time[-1]))
    silent = along._replace(name="")
    return [
        Panel(silent, Axis("output", unit), outputs, f"trial {last.number}"),
        Panel(silent, Axis("error", unit), errors),
        Panel(along, Axis("input", input_unit), inputs),
    ]
