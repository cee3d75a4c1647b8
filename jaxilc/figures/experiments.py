"""Figures of what a machine did: a record and its model, repeats of a motion, and a campaign."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from .description import (
    FREQUENCY,
    TIME,
    TRIAL,
    Axis,
    Band,
    Curve,
    Figure,
    Layer,
    Panel,
    Rule,
    Shade,
)
from .paper import drawn
from .style import COLOURS, GREY, PALE, colour_of

if TYPE_CHECKING:
    from ..hardware.calibration import Expected
    from ..hardware.journal import Manifest
    from ..hardware.prediction import Prediction
    from ..identification import Identified, Record
    from ..identification.potential import Potential
    from ..identification.record_files import Repeats
    from ..pytree.aliases import Value
    from ..theory.on_lines import MeasuredResponse


@drawn
def record_figure(record: Record, *, input_unit: str = "", output_unit: str = "") -> Figure:
    """Input and output of an experiment against time (Cao 2019, Fig. 2 and 3); two axes."""
    panels = []
    for name, signal, unit in (("input", record.u, input_unit), ("output", record.y, output_unit)):
        time = np.arange(len(signal)) * record.dt
        layers = _channels(time, signal, "{}", steps=name == "input", width=0.8)
        panels.append(Panel(TIME, Axis(name, unit), layers))
    return Figure(panels, "The recorded experiment: what was put in, and what was measured.")


def _channels(x, values, name: str = "", first: int = 0, **look: Value) -> list[Layer]:
    """A curve for each channel of values (n, channels); of several each has its number in its name.

    first: number of the first colour
    """
    lines = np.reshape(values, (len(values), -1)).T
    return [
        Curve(x, of, name=name.format(i) * (len(lines) > 1), colour=colour_of(first + i), **look)
        for i, of in enumerate(lines)
    ]


@drawn
def validation_figure(
    record: Record,
    identified: Identified,
    *,
    output_unit: str = "",
    scale: float = 1.0,
    unit: str = "",
    input_unit: str | None = None,
) -> Figure:
    """Measured and simulated output, and their difference (Cao 2019, Fig. 4); two axes.

    The part that was not fitted is shaded.

    output_unit: unit of the output
    scale, unit: the difference is shown as `scale` times that of the record, in `unit`
    input_unit: unit of the input, which then has axes of its own above these; None for no such axes
    """
    y, u = (np.reshape(x, (len(x), -1)) for x in (record.y, record.u))
    time, last = np.arange(len(y)) * record.dt, len(y) - 1
    along = TIME._replace(ends=(time[0], time[-1]))
    outputs: list[Layer] = []
    for i, (measured, simulated) in enumerate(zip(y.T, identified.simulated.T, strict=True)):
        which, colour = f" {i}" * (y.shape[1] > 1), colour_of(i)
        fits = f"fit {identified.fit[i]:.2f} %"
        if np.isfinite(identified.validation_fit[i]):
            fits += f", validation {identified.validation_fit[i]:.2f} %"
        said = f"simulated{which}: {fits}"
        outputs += [Curve(time, measured, width=3, colour=PALE, name=f"measured{which}"),
                    Curve(time, simulated, width=1, colour=colour, name=said)]  # fmt: skip
    untouched, said = [], ""
    if identified.samples <= last:
        untouched.append(Shade(time[identified.samples], time[-1], name="not fitted"))
        said = " The shaded part was not fitted: it tests the model."
    output, residual = Axis("output", output_unit), Axis("residual", unit)
    residuals = _channels(time, scale * (y - identified.simulated), width=0.8)
    panels = [
        Panel(along, output, [*outputs, *untouched], legend="above", columns=3),
        Panel(along, residual, [*residuals, *untouched], legend=""),
    ]
    if input_unit is not None:
        held = np.append(u, u[-1:], axis=0)[: len(time)]
        inputs = _channels(time, held, "input {}", 2, steps=True, width=1)
        panels.insert(0, Panel(along, Axis("input", input_unit), [*inputs, *untouched]))
    return Figure(
        panels,
        "The record and what the identified plant makes of its input. The axes of time move "
        f"together; a click on a name hides its curve.{said}",
    )


@drawn
def response_figure(
    identified: Identified, dt: float, *, input_unit: str = "", output_unit: str = ""
) -> Figure:
    """The frequency response of a plant that was identified from a record, with its 95 % band.

    Where a parameter is not determined by the record, there is no band. Magnitude and phase; two
    axes.

    dt: sample time of the record [s]
    Raises ValueError as `response_band` does.
    """
    from ..identification.grown_response import response_band

    f, P, phase, factor, half = response_band(identified, dt)
    size = np.abs(P)
    above: list[Layer] = []
    below: list[Layer] = []
    if factor is not None and half is not None:
        above.append(Band(f, size / factor, size * factor, name="95 % band"))
        below.append(Band(f, phase - half, phase + half))
    above.append(Curve(f, size, name="identified plant"))
    below.append(Curve(f, phase))
    unit = f"{output_unit}/{input_unit}" if output_unit and input_unit else ""
    return _bode(
        f, above, below, unit, "frequency response of the identified plant",
        "The frequency response of the plant that was found, and where it lies with a probability "
        "of 95 %.",
    )  # fmt: skip


@drawn
def response_fit_figure(
    measured: MeasuredResponse, identified: Identified, *, unit: str = ""
) -> Figure:
    """A measured frequency response and the one fitted to it: magnitude, phase; two axes.

    The band is the 95 % interval of the magnitude of each line, where its scatter is known. The
    thin line is the magnitude of their difference.

    unit: output per input
    """
    f, G, std = (np.asarray(of) for of in measured[:3])
    fitted, size = identified.simulated[:, 0], np.abs(G)
    above: list[Layer] = []
    below: list[Layer] = []
    if measured.std_known:
        half = 1.96 * std / np.sqrt(2)  # std is that of the complex number
        low = np.maximum(size - half, 1e-3 * size)
        above.append(Band(f, low, size + half, colour=PALE, alpha=0.4, name="scatter, 95 %"))
    said = f"fitted: {identified.fit[0]:.2f} %"
    phases = [np.unwrap(np.angle(of)) * 180 / np.pi for of in (G, fitted)]
    phases[1] += 360 * np.round(np.median(phases[0] - phases[1]) / 360)  # on the same turn
    looks = (("measured", size, PALE, 3), (said, np.abs(fitted), COLOURS[0], 1))
    for (name, magnitude, colour, width), phase in zip(looks, phases, strict=True):
        above.append(Curve(f, magnitude, colour=colour, width=width, name=name))
        below.append(Curve(f, phase, colour=colour, width=width, name=name))
    difference = np.abs(G - fitted)
    above.append(Curve(f, difference, width=0.6, colour=COLOURS[1], name="difference"))
    return _bode(
        f, above, below, unit, "",
        "The measured frequency response, the one fitted to it, and the magnitude of their "
        "difference.",
    )  # fmt: skip


def _bode(f, above: list[Layer], below: list[Layer], unit: str, title: str, said: str) -> Figure:
    """Panels of magnitude and of phase with a common axis of frequencies f."""
    along = FREQUENCY._replace(ends=(f[0], f[-1]))
    return Figure(
        [Panel(along, Axis("magnitude", unit, log=True), above, title, "lower left"),
         Panel(along, Axis("phase", "deg"), below, legend="")],
        f"{said} The axes of frequency move together.",
    )  # fmt: skip


@drawn
def potential_figure(repeats: Repeats, found: Potential) -> Figure:
    """The error that repeats, each trial less that, and the densities of both; three axes.

    The density is the root of the power density. The line is the cutoff up to which learning pays.
    """
    e, unit, spectrum = repeats.e, repeats.unit, found.spectrum
    alike = e[found.trials - found.alike :]
    mean, time = alike.mean(axis=0), np.arange(e.shape[1]) * repeats.dt
    differences: list[Layer] = [
        Curve(time, one, width=0.6, colour=COLOURS[1], name="new in each trial")
        for one in alike - mean
    ]
    if found.start:
        first = Curve(time, e[0] - mean, width=0.8, colour=GREY, name="first trial, left out")
        differences.insert(0, first)
    f = spectrum.frequencies
    low, high = np.sqrt(np.clip(spectrum.ratio * spectrum.new, 0.0, None))
    new, repeatable = (
        np.sqrt(np.clip(of, 0.0, None)) for of in (spectrum.new, spectrum.repeatable)
    )
    seen = np.where(repeatable > 0, repeatable, np.nan)
    densities: list[Layer] = [
        Curve(f, seen, mark="o", size=3, name="repeats"),
        Band(f, np.where(low > 0, low, np.nan), np.where(low > 0, high, np.nan), name="repeats"),
        Curve(f, new, mark="s", size=3, colour=COLOURS[1], name="new in each trial"),
    ]
    if found.cutoff.value:
        densities.append(Rule(found.cutoff.value, "x", dash="--", name="worth learning up to here"))
    return Figure(
        [Panel(TIME, Axis("error that repeats", unit), [Curve(time, mean, width=1)]),
         Panel(TIME, Axis("trial less that", unit), differences),
         Panel(FREQUENCY, Axis("density", f"{unit}/√Hz" if unit else "", log=True), densities)],
        "What repeats, which learning can remove, and what is new in each trial.",
        size=(7.2, 7.6), shares="",
    )  # fmt: skip


# A campaign on a real machine: errors on their prediction, and the last trial
# --------------------------------------------------------------------------------------------------


AHEAD = 5  # trials after the last one whose prediction is shown


class LastTrial(NamedTuple):
    """A measured trial: time (N+1,) [s], r and y (N+1, n_y), u (N, n_u)."""

    number: int
    time: np.ndarray
    r: np.ndarray
    y: np.ndarray
    u: np.ndarray


class Bands(NamedTuple):
    """The predicted RMS error by trial of a campaign.

    trial: (J,) numbers of the trials, the next ones included
    low, median, high: (J,) ends of the band and median [unit of y]; of a plant file that gives
        neither uncertainty nor noise they are the same
    own: (J,) whether the band is that of the trials so far, which is to hold both errors of nine
        trials of ten, and not that of the plant file, which holds 95 % of the drawn machines
    """

    trial: np.ndarray
    low: np.ndarray
    median: np.ndarray
    high: np.ndarray
    own: np.ndarray


def bands_by_trial(
    live: list[Manifest], prediction: Prediction, expected: Expected | None = None
) -> Bands:
    """The prediction of each trial of a campaign, and of some trials after them.

    A trial that was not learned from is followed by one with the same prediction. What the trials
    so far expect of the next one stands in place of its prediction. A trial that has neither is
    left out.

    live: manifests of the start and of the trials that count, see `Journal.live`
    """
    from ..hardware.calibration import kept
    from ..hardware.prediction import next_step, steps

    last, step = live[-1]["trial"], next_step(live)
    # fewer than the trials so far, so that these are not pressed together
    ahead = max(1, min(AHEAD, len(live)))
    found = [*steps(live), *(step and step + i for i in range(ahead))]
    number = [m["trial"] for m in live[1:]] + [last + 1 + i for i in range(ahead)]
    own = {m["trial"]: kept(m) for m in live[1:]} | {last + 1: expected}
    stored = {m["trial"]: m for m in live[1:]}
    rows = []
    for trial, at in zip(number, found, strict=True):
        own_band = own.get(trial)
        if own_band is not None:
            rows.append((trial, *(end[0] for end in own_band.rms), True))
        elif (of := prediction.at(at, stored.get(trial))) is not None:
            low, median, high = (end[0] for end in of.rms)
            band = [median] * 3 if of.certain else (low, median, high)
            rows.append((trial, *band, False))
    trial, low, median, high, judged = np.array(rows, float).reshape(-1, 5).T
    return Bands(trial, low, median, high, judged > 0)


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
    room = max(0.05 * np.ptp(trials or [0.0]), 0.5)
    along = TRIAL._replace(ends=(min(trials) - room, max(trials) + room)) if trials else TRIAL
    panels = [
        Panel(along, Axis("error", unit, log=True), predicted + _by_trial(measured, errors, 0)),
        Panel(along, Axis("RMS input", input_unit), _by_trial(measured, efforts, 2)),
        *([] if last is None else _last_trial(last, unit, input_unit)),
    ]
    return Figure(
        panels,
        "The error and the input of each measured trial, on what was predicted of its RMS error. "
        "The band of the plant file holds 95 % of the drawn machines; in that of the trials so far "
        "nine trials of ten are to lie with both errors, the largest one in a band of its own. "
        "Under the pointer stand the file and the warnings of a trial.",
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
    """The predicted bands, and their median; an infinite end is drawn up to the top of the axis."""
    ends = np.stack([bands.low, bands.median, bands.high])
    largest = np.max(ends, where=np.isfinite(ends), initial=np.finfo(float).tiny)
    low, median, high = np.minimum(ends, 10 * largest)
    at = np.add.outer(bands.trial, (-0.5, 0.5)).ravel()
    layers: list[Layer] = []
    for which, hue, name in (
        (~bands.own, GREY, "95 % of drawn machines"),
        (bands.own, COLOURS[4], "90 % by the trials so far"),
    ):
        drawn = which & (low < high)
        from_, to = (np.repeat(np.where(drawn, end, np.nan), 2) for end in (low, high))
        if np.any(drawn):
            layers.append(Band(at, from_, to, colour=hue, alpha=0.35, name=name))
    return [
        *layers,
        Curve(bands.trial, median, width=1, colour=COLOURS[4], name="predicted, median"),
    ]


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
    along = TIME._replace(ends=(last.time[0], last.time[-1]))
    silent = along._replace(name="")
    return [
        Panel(silent, Axis("output", unit), outputs, f"trial {last.number}"),
        Panel(silent, Axis("error", unit), _channels(last.time, r - y, width=0.8)),
        Panel(
            along,
            Axis("input", input_unit),
            _channels(last.time[:-1], u, first=2, width=0.8, steps=True),
        ),
    ]
