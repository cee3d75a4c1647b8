"""Figures of identification: a record, the model compared with it, and repeats of a motion."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .description import FREQUENCY, TIME, Axis, Band, Curve, Figure, Layer, Panel, Rule, Shade
from .paper import drawn
from .style import COLOURS, GREY, PALE, colour_of

if TYPE_CHECKING:
    from ..identification import Identified, Record
    from ..identification.potential import Potential
    from ..identification.repeats import Repeats
    from ..theory.on_lines import MeasuredResponse


@drawn
def record_figure(record: Record, *, input_unit: str = "", output_unit: str = "") -> Figure:
    """Input and output of an experiment against time (Cao 2019, Fig. 2 and 3); two axes."""
    panels = []
    for name, signal, unit in (("input", record.u, input_unit), ("output", record.y, output_unit)):
        values, time = np.reshape(signal, (len(signal), -1)).T, np.arange(len(signal)) * record.dt
        layers = [
            Curve(time, of, steps=name == "input", width=0.8, colour=colour_of(i),
                  name=f"{i}" * (len(values) > 1))
            for i, of in enumerate(values)
        ]  # fmt: skip
        panels.append(Panel(TIME, Axis(name, unit), layers))
    return Figure(panels, "The recorded experiment: what was put in, and what was measured.")


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
    residuals: list[Layer] = []
    for i, (measured, simulated) in enumerate(zip(y.T, identified.simulated.T, strict=True)):
        which, colour = f" {i}" * (y.shape[1] > 1), colour_of(i)
        fits = f"fit {identified.fit[i]:.2f} %"
        if identified.samples <= last:
            fits += f", validation {identified.validation_fit[i]:.2f} %"
        said = f"simulated{which}: {fits}"
        outputs += [Curve(time, measured, width=3, colour=PALE, name=f"measured{which}"),
                    Curve(time, simulated, width=1, colour=colour, name=said)]  # fmt: skip
        difference = scale * (measured - simulated)
        residuals.append(Curve(time, difference, width=0.8, colour=colour))
    untouched, said = [], ""
    if identified.samples <= last:
        untouched.append(Shade(time[identified.samples], time[-1], name="not fitted"))
        said = " The shaded part was not fitted: it tests the model."
    output, residual = Axis("output", output_unit), Axis("residual", unit)
    panels = [
        Panel(along, output, [*outputs, *untouched], legend="above", columns=3),
        Panel(along, residual, [*residuals, *untouched], legend=""),
    ]
    if input_unit is not None:
        inputs = [
            Curve(time, np.append(of, of[-1:])[: len(time)], steps=True, width=1,
                  colour=colour_of(i + 2), name=f"input {i}" * (u.shape[1] > 1))
            for i, of in enumerate(u.T)
        ]  # fmt: skip
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
    from ..identification.response_estimation import response_band

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
    if np.any(std) and measured.averages_known:
        half = 1.96 * std / np.sqrt(2)  # std is that of the complex number
        low = np.maximum(size - half, 1e-3 * size)
        above.append(Band(f, low, size + half, colour=PALE, alpha=0.4, name="scatter, 95 %"))
    said = f"fitted: {identified.fit[0]:.2f} %"
    for name, response, colour, width in (("measured", G, PALE, 3), (said, fitted, COLOURS[0], 1)):
        above.append(Curve(f, np.abs(response), colour=colour, width=width, name=name))
        phase = np.unwrap(np.angle(response)) * 180 / np.pi
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
