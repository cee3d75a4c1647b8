"""Interactive figures of a campaign: its errors on what was predicted, and its trials."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from . import browsers
from .live_axes import Live, hover, legend, plot, shown_in, within
from .style import COLOURS, labelled

if TYPE_CHECKING:
    from ..signals.task import Task
    from .campaign import Bands


def errors(
    rows: Sequence[Mapping[str, Any]], *, unit: str = "", bands: Bands | None = None
) -> Live:
    """The RMS error of each measured trial on its predicted band; its file under the pointer.

    rows: result of `Journal.log`
    unit: unit of y
    bands: predicted RMS error by trial
    """
    from bokeh.models import ColumnDataSource

    measured = [row for row in rows if row["event"] == "trial"]
    factor, unit = shown_in([row["rms_error"] for row in measured], unit)
    made = plot("", "trial", labelled("rms error", unit))
    shown: list[float] = [factor * row["rms_error"] for row in measured]
    if bands is not None and len(bands.trial):
        finite = np.isfinite(bands.high)
        low, high = (factor * np.asarray(end) for end in (bands.low, bands.high))
        look = {"fill_alpha": 0.3, "color": COLOURS[4], "legend_label": "predicted, 95 %"}
        made.varea(bands.trial[finite], low[finite], high[finite], **look)
        made.line(bands.trial, factor * bands.median, color=COLOURS[4],
                  legend_label="predicted, median")  # fmt: skip
        shown += [*low, *high[finite]]
    for name, counts in (("measured", True), ("undone", False)):
        of = [row for row in measured if row["live"] == counts]
        if not of:
            continue
        largest = [max(v for n, v in row.items() if n.startswith("max_error")) for row in of]
        source = ColumnDataSource(
            {
                "trial": [row["trial"] for row in of],
                "rms": [factor * row["rms_error"] for row in of],
                "largest": [factor * float(value) for value in largest],
                "file": [str(row["source"]) for row in of],
                "said": [str(row["warnings"]) or "–" for row in of],
            }
        )
        look = {"color": COLOURS[0], "legend_label": name, "source": source}
        if counts:
            made.line("trial", "rms", line_width=2, **look)
        fill = COLOURS[0] if counts else None
        dots = made.scatter("trial", "rms", size=8, fill_color=fill, **look)
        tips = [("trial", "@trial"), ("rms error", f"@rms{{g}} {unit}")]
        tips += [("largest", f"@largest{{g}} {unit}"), ("file", "@file"), ("warnings", "@said")]
        hover(made, [dots], tips)
    within(made, shown)
    legend(made)
    return Live(
        "The RMS error of each measured trial, on what was predicted of it. Under the pointer "
        "stand its largest error, its file and its warnings.",
        made,
    )


def signals(task: Task, measured: Mapping[int, Mapping[str, Any]]) -> Live:
    """Output, error and input of the measured trial that a slider chooses.

    measured: `y` (N+1, n_y) and `u` (N, n_u) by the number of the trial
    """
    import xarray as xr

    r = np.asarray(task.reference, float).reshape(len(np.asarray(task.time)), -1)
    y, u = (
        np.stack([np.asarray(of[n], float).reshape(len(of[n]), -1) for of in measured.values()])
        for n in ("y", "u")
    )
    dims = ("scheme", "trial", "time", "channel")
    dataset = xr.Dataset(
        {
            "r": (dims[2:], r),
            "y": (dims, y[None], {"units": task.unit}),
            "e": (dims, r - y[None], {"units": task.unit}),
            "u": (("scheme", "trial", "input_time", "input"), u[None], {"units": task.input_unit}),
        },
        coords={"scheme": ["measured"], "trial": list(measured), "time": np.asarray(task.time)},
    )
    return browsers.trials(dataset, unit=task.unit)
