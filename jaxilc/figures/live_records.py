"""Interactive figures of identification: a record beside its model, and frequency responses."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from .browsers import thinned
from .live_axes import Live, hover, legend, plot
from .style import COLOURS, labelled

if TYPE_CHECKING:
    from ..identification import Identified, Record
    from ..theory.on_lines import MeasuredResponse

POINTS = 4000  # of a signal
GREY = "#999999"


def validation(
    record: Record, identified: Identified, *, input_unit: str = "", output_unit: str = ""
) -> Live:
    """Input, measured and simulated output, and their difference, against time.

    input_unit, output_unit: units of the record
    """
    from bokeh.layouts import column
    from bokeh.models import BoxAnnotation, ColumnDataSource

    y, u = (np.reshape(x, (len(x), -1)) for x in (record.y, record.u))
    time = np.arange(len(y)) * record.dt
    made: list[Any] = []
    for name, unit in (("input", input_unit), ("output", output_unit), ("residual", output_unit)):
        share = {"x_range": made[0].x_range} if made else {}
        below = "time [s]" if name == "residual" else ""
        made.append(plot("", below, labelled(name, unit), log=False, height=210, **share))
    t = thinned(time, POINTS, times=True)
    for i, values in enumerate(u.T):
        held = np.append(values, values[-1:])[: len(time)]
        made[0].step(
            t, thinned(held, POINTS), mode="after", color=COLOURS[(i + 2) % len(COLOURS)],
            legend_label=f"input {i}" if u.shape[1] > 1 else "input",
        )  # fmt: skip
    for i, values in enumerate(y.T):
        which, colour = f" {i}" * (y.shape[1] > 1), COLOURS[i % len(COLOURS)]
        simulated = identified.simulated[:, i]
        source = ColumnDataSource(
            {"t": t, "y": thinned(values, POINTS), "s": thinned(simulated, POINTS),
             "d": thinned(values - simulated, POINTS)}
        )  # fmt: skip
        measured = made[1].line(
            "t", "y", source=source, color=GREY, line_width=4, legend_label=f"measured{which}"
        )
        made[1].line("t", "s", source=source, color=colour, legend_label=f"simulated{which}")
        of = made[2].line("t", "d", source=source, color=colour, legend_label=f"residual{which}")
        tips = [("time", "@t{g} s"), ("measured", f"@y{{g}} {output_unit}"),
                ("simulated", f"@s{{g}} {output_unit}")]  # fmt: skip
        hover(made[1], [measured], tips)
        hover(made[2], [of], [("time", "@t{g} s"), ("residual", f"@d{{g}} {output_unit}")])
    fitted_to = identified.samples
    for one in made:
        if fitted_to < len(y):
            one.add_layout(BoxAnnotation(left=time[fitted_to], fill_color="#e69f00",
                                         fill_alpha=0.12, line_color=None))  # fmt: skip
        legend(one)
    shaded = " The shaded part was not fitted: it tests the model." if fitted_to < len(y) else ""
    return Live(
        "The record and what the identified plant makes of its input. The axes of time move "
        f"together; a click on a name hides its curve.{shaded}",
        column(*made, sizing_mode="scale_width"),
    )


def response(
    identified: Identified, dt: float, *, input_unit: str = "", output_unit: str = ""
) -> Live | None:
    """The Bode diagram of the identified plant with its 95 % band.

    dt: sample time [s]
    Returns None for a plant that is not a `ProcessModel` of one input and one output.
    """
    from ..identification.model_response import response_band

    try:
        f, P, phase, factor, half = response_band(identified, dt)
    except ValueError:
        return None
    unit = f"{output_unit}/{input_unit}" if output_unit and input_unit else ""
    size, (top, bottom) = np.abs(P), _bode(unit)
    if factor is not None and half is not None:
        look = {"fill_alpha": 0.25, "color": COLOURS[0], "legend_label": "95 % band"}
        top.varea(f, size / factor, size * factor, **look)
        bottom.varea(f, phase - half, phase + half, **look)
    said = {"color": COLOURS[0], "line_width": 2, "legend_label": "identified plant"}
    one, other = top.line(f, size, **said), bottom.line(f, phase, **said)
    return _finished((top, bottom), (one, other), unit, "The frequency response of the plant that "
                     "was found, and where it lies with a probability of 95 %.")  # fmt: skip


def response_fit(measured: MeasuredResponse, identified: Identified, *, unit: str = "") -> Live:
    """A measured frequency response and the one fitted to it.

    unit: output per input
    """
    f, G, std = measured
    fitted, (top, bottom) = identified.simulated[:, 0], _bode(unit)
    if np.any(std):
        half = 1.96 * np.asarray(std) / np.sqrt(2)  # std is that of the complex number
        low = np.maximum(np.abs(G) - half, 1e-3 * np.abs(G))
        top.varea(f, low, np.abs(G) + half, color=GREY, fill_alpha=0.4,
                  legend_label="scatter, 95 %")  # fmt: skip
    drawn = []
    for name, values, colour, width in (
        ("measured", G, GREY, 4),
        ("fitted", fitted, COLOURS[0], 1.5),
    ):
        look = {"color": colour, "line_width": width, "legend_label": name}
        drawn.append(top.line(f, np.abs(values), **look))
        drawn.append(bottom.line(f, np.unwrap(np.angle(values)) * 180 / np.pi, **look))
    top.line(f, np.abs(G - fitted), color=COLOURS[1], legend_label="difference")
    return _finished((top, bottom), drawn, unit, "The measured frequency response, the one fitted "
                     "to it, and the magnitude of their difference.")  # fmt: skip


def _bode(unit: str) -> tuple[Any, Any]:
    """Figures of magnitude and of phase with a common axis of frequencies."""
    top = plot("", "", labelled("magnitude", unit), height=280, x_axis_type="log")
    bottom = plot(
        "", "frequency [Hz]", "phase [deg]", log=False, height=220, x_axis_type="log",
        x_range=top.x_range,
    )  # fmt: skip
    return top, bottom


def _finished(made, drawn, unit: str, caption: str) -> Live:
    from bokeh.layouts import column

    for one, name, of in zip(made, ("magnitude", "phase"), (unit, "deg"), strict=True):
        mine = [r for r in drawn if r in one.renderers]
        hover(one, mine, [("frequency", "@x{g} Hz"), (name, f"@y{{g}} {of}".rstrip())])
        legend(one)
    return Live(f"{caption} The axes of frequency move together.",
                column(*made, sizing_mode="scale_width"))  # fmt: skip
