"""The figure of a campaign on a real machine."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from .style import COLOURS, grid, labelled, legend_beside, new_axes, trial_axis

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def campaign_figure(
    rows: Sequence[dict[str, Any]],
    *,
    unit: str = "",
    input_unit: str = "",
    ax: Sequence[Axes] | None = None,
) -> Any:
    """The errors by trial with a logarithmic axis, and below them the RMS input; two axes.

    Trials that were undone are open marks.

    rows: result of `Journal.log`
    unit, input_unit: units of y and of u
    """
    top, bottom = axes = new_axes(ax, rows=2)
    measured = [row for row in rows if row["event"] == "trial"]
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
    top.set(yscale="log", ylabel=labelled("error", unit))
    bottom.set(ylabel=labelled("RMS input", input_unit))
    trial_axis(bottom)
    for axis in axes:
        grid(axis)
        if axis.has_data():
            legend_beside(axis)
    return axes
