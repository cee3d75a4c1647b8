"""What all interactive figures share: axes with plain numbers, legends, and what the pointer shows.

The figures are models of Bokeh. Buttons, sliders and hover texts run in the browser; nothing is
asked from a server.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from html import escape
from typing import Any, NamedTuple

import numpy as np

from .style import limits_of
from .units import power_of, prefixed

WIDTH, HEIGHT = 860, 360  # of a figure [pixel]
COUNTED = ("trial", "number of trials")  # labels of axes that have whole numbers
DASHED = ("solid", "dashed", "dashdot", "dotted")  # lines, so that colours are not needed

NUMBER = """
const size = Math.abs(tick);
if (size < 1e-15) return "0";
const text = Number(tick.toPrecision(6));
return size >= 1e6 || size < 1e-4 ? text.toExponential() : String(text);
"""
# Ticks of a logarithmic axis: each decade of many; 1, 2, 5 of few; even steps within less than one.
MAJOR = """
const {start, end} = cb_data.range;
const low = Math.min(start, end), high = Math.max(start, end);
if (!(low > 0 && high < Infinity)) return [];
const decades = Math.log10(high / low), found = [];
if (decades < 0.8) {
    const rough = (high - low) / 5, power = 10 ** Math.floor(Math.log10(rough));
    const step = power * [1, 2, 5, 10].find((n) => n * power >= rough);
    for (let k = Math.ceil(low / step); k * step <= high; k++) found.push(k * step);
    return found;
}
const each = decades < 2.5 ? [1, 2, 5] : [1], every = Math.max(1, Math.ceil(decades / 8));
for (let k = Math.floor(Math.log10(low)); k <= Math.log10(high); k++) {
    if (k % every) continue;
    for (const n of each) if (n * 10 ** k >= low && n * 10 ** k <= high) found.push(n * 10 ** k);
}
return found;
"""
MINOR = """
const {start, end} = cb_data.range;
const low = Math.min(start, end), high = Math.max(start, end), found = [];
if (!(low > 0 && high / low < 1e6)) return [];
for (let k = Math.floor(Math.log10(low)); k <= Math.log10(high); k++) {
    for (let n = 1; n < 10; n++) {
        if (n * 10 ** k >= low && n * 10 ** k <= high) found.push(n * 10 ** k);
    }
}
return found;
"""


class Live(NamedTuple):
    """An interactive figure.

    caption: sentences that say what is seen, and what can be done
    model: a model of Bokeh
    """

    caption: str
    model: Any


def shown_in(values, unit: str) -> tuple[float, str]:
    """The factor and the unit in which the median of positive values is read best."""
    found = np.atleast_1d(np.asarray(values, float))
    found = found[np.isfinite(found) & (found > 0)]
    if not found.size or power_of(unit) is None:
        return 1.0, unit
    middle = float(np.median(found))
    number, name = prefixed(middle, unit)
    return number / middle, name


def plot(title: str, x: str, y: str, *, log: bool = True, **options: Any) -> Any:
    """An empty figure of the common size, with labelled axes."""
    from bokeh.models import BasicTicker, CustomJSTicker, CustomJSTickFormatter, LinearAxis, LogAxis
    from bokeh.plotting import figure

    size: dict[str, Any] = {
        "width": WIDTH,
        "height": HEIGHT,
        "sizing_mode": "scale_width",
    } | options
    size |= {"y_axis_type": "log"} if log else {}
    made = figure(
        title=title,
        x_axis_label=x,
        y_axis_label=y,
        tools="pan,wheel_zoom,box_zoom,reset",
        toolbar_location="above",
        **size,
    )
    made.toolbar.logo = None
    axes: list[Any] = [made.xaxis[0], made.yaxis[0]]
    for axis in axes:
        if isinstance(axis, LogAxis):
            axis.ticker = CustomJSTicker(major_code=MAJOR, minor_code=MINOR)
        if isinstance(axis, LogAxis | LinearAxis):
            axis.formatter = CustomJSTickFormatter(code=NUMBER)
    if x in COUNTED:
        axes[0].ticker = BasicTicker(min_interval=1, num_minor_ticks=0)
    return made


def legend(made: Any) -> None:
    """The legend beside the figure; a click on a name hides its curves and shows them again."""
    if made.legend:
        made.add_layout(made.legend[0], "right")
        made.legend.click_policy = "hide"
        made.legend.label_text_font_size = "9pt"


def hover(made: Any, renderers: list[Any], rows: list[tuple[str, str]]) -> None:
    """Rows of a name and a value for the point under the pointer.

    rows: `@x{g}` is the value of column x with four digits, of any size
    """
    from bokeh.models import HoverTool

    columns = {name for _, value in rows for name in re.findall(r"(@\w+)\{g\}", value)}
    lines = "".join(
        f'<div><span style="color: #555">{_literal(name)}:</span> '
        f"{value.replace('{g}', '{%.4g}')}</div>"
        for name, value in rows
    )
    shown = f'<div style="max-width: 28em; white-space: normal">{lines}</div>'
    told: Any = dict.fromkeys(columns, "printf")
    made.add_tools(HoverTool(renderers=renderers, tooltips=shown, formatters=told))


def _literal(text: str) -> str:
    """A text for a tooltip, in which nothing stands for a column or for a tag."""
    return escape(text).replace("@", "&#64;").replace("$", "&#36;")


def within(made: Any, values: Iterable[float]) -> None:
    """Let a logarithmic axis hold all of the values that it can, and no empty decade."""
    found = limits_of(list(values))
    if found:
        made.y_range.start, made.y_range.end = found


def tolerance_line(made: Any, tolerance: float | None) -> None:
    """A dashed line at the tolerance, if there is one."""
    if tolerance is not None:
        from bokeh.models import Span

        line = Span(location=tolerance, dimension="width", line_dash="dashed", line_color="black")
        made.add_layout(line)
