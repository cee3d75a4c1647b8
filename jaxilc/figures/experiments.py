"""Figures of identification: a recorded experiment, and the model compared with it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .style import COLOURS, grid, labelled, legend_beside, new_axes

if TYPE_CHECKING:
    from ..identification import Identified, Record
    from ..theory.on_lines import MeasuredResponse


def record_figure(
    record: Record, *, input_unit: str = "", output_unit: str = "", ax=None
) -> np.ndarray:
    """Input and output of an experiment against time (Cao 2019, Fig. 2 and 3); two axes."""
    top, bottom = axes = new_axes(ax, rows=2)
    for axis, signal, style in (
        (top, record.u, {"drawstyle": "steps-post"}),
        (bottom, record.y, {}),
    ):
        signal = np.reshape(signal, (len(signal), -1))
        for i, values in enumerate(signal.T):
            label = f"{i}" if signal.shape[1] > 1 else None
            axis.plot(
                np.arange(len(signal)) * record.dt,
                values,
                color=COLOURS[i % len(COLOURS)],
                linewidth=0.8,
                label=label,
                **style,
            )
        if signal.shape[1] > 1:
            legend_beside(axis)
        grid(axis)
    top.set(ylabel=labelled("input", input_unit))
    bottom.set(ylabel=labelled("output", output_unit), xlabel="time [s]")
    return axes


def validation_figure(
    record: Record,
    identified: Identified,
    *,
    output_unit: str = "",
    scale: float = 1.0,
    unit: str = "",
    ax=None,
) -> np.ndarray:
    """Measured and simulated output, and their difference (Cao 2019, Fig. 4); two axes.

    The part that was not fitted is shaded.

    output_unit: unit of the output
    scale, unit: the difference is shown as `scale` times that of the record, in `unit`
    """
    top, bottom = axes = new_axes(ax, rows=2)
    y = np.reshape(record.y, (len(record.y), -1))
    time = np.arange(len(y)) * record.dt
    for i in range(y.shape[1]):
        name, colour = f" {i}" * (y.shape[1] > 1), COLOURS[i % len(COLOURS)]
        fits = f"fit {identified.fit[i]:.2f} %"
        if identified.samples < len(y):
            fits += f", validation {identified.validation_fit[i]:.2f} %"
        top.plot(time, y[:, i], color="#999999", linewidth=3, label=f"measured{name}")
        top.plot(
            time,
            identified.simulated[:, i],
            color=colour,
            linewidth=1,
            label=f"simulated{name}: {fits}",
        )
        bottom.plot(
            time, scale * (y[:, i] - identified.simulated[:, i]), color=colour, linewidth=0.8
        )
    for axis in axes:
        axis.set_xlim(time[0], time[-1])
        if identified.samples < len(y):
            axis.axvspan(
                time[identified.samples],
                time[-1],
                color="#e69f00",
                alpha=0.12,
                linewidth=0,
                label="not fitted",
            )
        grid(axis)
    top.set(ylabel=labelled("output", output_unit))
    bottom.set(ylabel=labelled("residual", unit), xlabel="time [s]")
    top.legend(ncols=3, fontsize="small", loc="lower right", bbox_to_anchor=(1.0, 1.0))
    return axes


def response_figure(
    identified: Identified, dt: float, *, input_unit: str = "", output_unit: str = "", ax=None
) -> np.ndarray:
    """The frequency response of a plant that was identified from a record, with its 95 % band.

    Where a parameter is not determined by the record, there is no band. Magnitude and phase; two
    axes.

    dt: sample time of the record [s]
    Raises ValueError as `response_band` does.
    """
    from ..identification.model_response import response_band

    f, P, phase, factor, half = response_band(identified, dt)
    top, bottom = axes = new_axes(ax, rows=2)
    size = np.abs(P)
    if factor is not None and half is not None:
        look = {"color": COLOURS[0], "alpha": 0.25, "linewidth": 0}
        top.fill_between(f, size / factor, size * factor, label="95 % band", **look)
        bottom.fill_between(f, phase - half, phase + half, **look)
    top.loglog(f, size, color=COLOURS[0], label="identified plant")
    bottom.semilogx(f, phase, color=COLOURS[0])
    for axis in axes:
        axis.set_xlim(f[0], f[-1])
        grid(axis)
    unit = f"{output_unit}/{input_unit}" if output_unit and input_unit else ""
    top.set_title("frequency response of the identified plant", fontsize="medium")
    top.set_ylabel(labelled("magnitude", unit))
    bottom.set(ylabel=labelled("phase", "deg"), xlabel="frequency [Hz]")
    top.legend(fontsize="small", loc="lower left")
    return axes


def response_fit_figure(measured: MeasuredResponse, identified: Identified, *, ax=None):
    """A measured frequency response and the one fitted to it: magnitude, phase; two axes.

    The band is the 95 % interval of the magnitude of each line, where its scatter is known. The
    thin line is the magnitude of their difference.
    """
    top, bottom = axes = new_axes(ax, rows=2)
    f, G, std = measured
    fitted = identified.simulated[:, 0]
    size = np.abs(G)
    if np.any(std):
        half = 1.96 * std / np.sqrt(2)  # std is that of the complex number
        low = np.maximum(size - half, 1e-3 * size)
        top.fill_between(f, low, size + half, color="#999999", alpha=0.4, linewidth=0)
    top.plot(f, size, color="#999999", linewidth=3, label="measured")
    said = f"fitted: {identified.fit[0]:.2f} %"
    top.plot(f, np.abs(fitted), color=COLOURS[0], linewidth=1, label=said)
    top.plot(f, np.abs(G - fitted), color=COLOURS[1], linewidth=0.6, label="difference")
    top.set_yscale("log")
    for response, style in (
        (G, {"color": "#999999", "linewidth": 3}),
        (fitted, {"color": COLOURS[0], "linewidth": 1}),
    ):
        bottom.plot(f, np.unwrap(np.angle(response)) * 180 / np.pi, **style)
    for axis in axes:
        axis.set_xscale("log")
        axis.set_xlim(f[0], f[-1])
        grid(axis)
    top.set(ylabel="magnitude")
    bottom.set(ylabel=labelled("phase", "deg"), xlabel="frequency [Hz]")
    top.legend(ncols=3, fontsize="small", loc="lower right", bbox_to_anchor=(1.0, 1.0))
    return axes
