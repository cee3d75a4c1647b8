"""Figures of identification: a recorded experiment, and the model compared with it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .style import COLOURS, grid, labelled, legend_beside, new_axes

if TYPE_CHECKING:
    from ..identification import Identified, Record
    from ..theory.measured import MeasuredResponse


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

    With the covariance S of the parameters and the derivatives g of log P by them, the standard
    deviations of log |P| and of the phase are those of Re(g)^T S Re(g) and Im(g)^T S Im(g). Where a
    parameter is not determined by the record, there is no band. Magnitude and phase; two axes.

    dt: sample time of the record [s]
    Raises ValueError for a plant that is not a `ProcessModel` of one input and one output.
    """
    from ..identification.model_response import response_and_slopes
    from ..plants import ProcessModel

    plant = identified.plant
    if not isinstance(plant, ProcessModel) or plant.n_u != 1 or plant.n_y != 1:
        raise ValueError(
            f"response_figure: the plant is a {type(plant).__name__}; allowed is a ProcessModel of "
            "one input and one output"
        )
    fields = [
        np.atleast_1d(np.asarray(getattr(plant, n), float))
        for n in ("gain", "zeros", "poles", "frequencies", "dampings", "delay")
    ]
    f = np.geomspace(1e-4 / dt, 0.5 / dt, 400)
    P, slopes = response_and_slopes(
        np.concatenate(fields), (len(fields[1]), len(fields[2]), len(fields[3])), f, dt
    )
    top, bottom = axes = new_axes(ax, rows=2)
    phase = np.unwrap(np.angle(P)) * 180 / np.pi
    std = _std_of_log(identified, fields, slopes / P[:, None])
    if std is not None:
        wide = np.exp(1.96 * np.minimum(std.real, 5.0))
        half = 1.96 * np.minimum(std.imag, np.pi) * 180 / np.pi
        look = {"color": COLOURS[0], "alpha": 0.25, "linewidth": 0}
        top.fill_between(f, np.abs(P) / wide, np.abs(P) * wide, label="95 % band", **look)
        bottom.fill_between(f, phase - half, phase + half, **look)
    top.loglog(f, np.abs(P), color=COLOURS[0], label="identified plant")
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


def _std_of_log(identified: Identified, fields, g: np.ndarray) -> np.ndarray | None:
    """(F,) standard deviations of log |P|, the real part, and of the phase, the imaginary part.

    fields: the parameters of the plant, each an array
    g: (F, P) derivatives of log P by them
    """
    names = ("gain", "zeros", "poles", "frequencies", "dampings", "delay")
    place = {f"{n}[{i}]": None for n, of in zip(names, fields, strict=True) for i in range(len(of))}
    place = {name: i for i, name in enumerate(place)}
    place |= {name: place[f"{name}[0]"] for name in names if f"{name}[0]" in place}
    known = [(k, place[n]) for k, n in enumerate(identified.parameters) if n in place]
    rows, columns = (np.array(x, int) for x in zip(*known, strict=True))
    S = np.asarray(identified.covariance)[np.ix_(rows, rows)]
    if not np.all(np.isfinite(S)):
        return None
    parts = (g[:, columns].real, g[:, columns].imag)
    variances = [np.einsum("fi,ij,fj->f", part, S, part) for part in parts]
    return np.sqrt(np.maximum(variances[0], 0)) + 1j * np.sqrt(np.maximum(variances[1], 0))


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
