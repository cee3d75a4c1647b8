"""Figures on a page: a description becomes a model of Bokeh that answers to the pointer.

Hover texts, and the sliders and menus of `browsers`, run in the browser; nothing is asked from a
server. A click on a name in a legend hides its layers and shows them again.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from .description import Axis, Band, Bars, Cells, Curve, Figure, Layer, Panel, Rule, Shade, Where
from .style import BOUND, READABLE, Dash, edges_of, labelled, limits_of, placed, power_of, prefixed

if TYPE_CHECKING:
    from bokeh.models import Axis as AxisOfPage
    from bokeh.models import GlyphRenderer, LayoutDOM, Range
    from bokeh.plotting import figure as Plot

    from .description import Points

WIDTH, HEIGHT, TALLEST = 860, 360, 900  # of a figure, and of a row at most [pixel]
NARROW = 240  # below which no figure stands beside another one [pixel]
INCH = HEIGHT / 4.2  # pixels for an inch of paper
BAR = 16  # width of a band at a single point [pixel]
POINTS = 4000  # of a long curve that is thinned
UNSEEN = 1e-6  # of the lower end of a logarithmic axis, where a band ends that reaches to zero
LINES = {"-": "solid", "--": "dashed", "-.": "dashdot", ":": "dotted"}
MARKS = {
    "o": "circle", ".": "circle", "s": "square", "^": "triangle",
    "<": "triangle", "D": "diamond", "x": "x", "X": "x", "P": "cross", "*": "star", "p": "hex",
    BOUND: "inverted_triangle",
}  # fmt: skip

ROUNDED = "return String(Number(tick.toPrecision(2)))"
NUMBER = """
const size = Math.abs(tick);
if (!tick || size < 1e-9 * Math.abs(ticks[1] - ticks[0])) return "0";
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
    model: LayoutDOM


def live(figure: Figure | Live) -> Live:
    """A described figure, with its caption; one that is interactive already as it is."""
    return figure if isinstance(figure, Live) else Live(figure.caption, model_of(figure))


def model_of(figure: Figure) -> LayoutDOM:
    """The panels in rows; those that share an axis move together."""
    from bokeh.layouts import column

    wide = figure.columns
    made: list[Plot] = []
    rows = -(-len(figure.panels) // wide)
    tall = min(INCH * (figure.size or (WIDTH, 1.6 + 2.6 * rows))[1], TALLEST * rows)
    heights, widths = (
        whole * np.asarray(parts or np.ones(count)) / np.sum(parts or count)
        for whole, parts, count in ((tall, figure.heights, rows), (WIDTH, figure.widths, wide))
    )
    for i, panel in enumerate(figure.panels):
        share = {"x_range": made[i - wide].x_range} if "x" in figure.shares and i >= wide else {}
        if "y" in figure.shares and i % wide:
            share["y_range"] = made[i - 1].y_range
        size = {"width": int(widths[i % wide]), "height": int(heights[i // wide])}
        made.append(panel_of(panel, **size, **share))
        if "y" in figure.shares and i % wide:
            made[-1].yaxis.major_label_text_font_size = "0pt"
    lines = [side_by_side(*made[i : i + wide]) if wide > 1 else made[i]
             for i in range(0, len(made), wide)]  # fmt: skip
    return lines[0] if len(lines) == 1 else column(*lines, sizing_mode="stretch_width")


def spoken() -> str:
    """A script that gives the sliders of a page the names and values that a screen reader says."""
    return Path(__file__).with_name("spoken.js").read_text(encoding="utf-8")


def side_by_side(*models: LayoutDOM) -> LayoutDOM:
    """Models in a row, as wide as their widths are to each other; on a narrow page in several."""
    from bokeh.layouts import row

    for one in models:
        one.sizing_mode = "stretch_width"
        one.styles = {"flex": f"{one.width or 1} 1 {NARROW}px", "min-width": f"{NARROW}px"}
    return row(*models, sizing_mode="stretch_width", styles={"flex-wrap": "wrap"})


def panel_of(panel: Panel, **options: int | str | Range) -> Plot:
    """One panel; under the pointer stand the coordinates and the tips of each named layer."""
    from bokeh.models import BasicTicker

    x, y = _shown_as(panel, "x"), _shown_as(panel, "y")
    options = ({"x_axis_type": "log"} if panel.x.log else {}) | options
    made = plot(panel.title, x.label, y.label, log=panel.y.log, **options)
    held = limits_of(panel.heights()) if y.axis.log and not panel.is_map else None
    for range_, way in ((made.x_range, x), (made.y_range, y)):
        ends = way.axis.ends or (held if way is y else None)
        for name, end in zip(("start", "end"), ends or (), strict=False):
            if end is not None:
                setattr(range_, name, way.factor * end)
    for axis, way in ((made.xaxis[0], x), (made.yaxis[0], y)):
        if way.axis.names:
            at_texts(axis, way.axis.names)
        elif way.axis.whole or way.axis.ticks:
            axis.ticker = BasicTicker(min_interval=1, num_minor_ticks=0)
    told: dict[tuple, list[GlyphRenderer]] = {}
    for layer in panel.layers:
        drawn = DRAW[type(layer)](made, layer, x, y)
        for one in drawn:
            one.nonselection_glyph = None  # a point that is chosen does not make others pale
        if drawn and (layer.name or layer.tips):
            rows = [(way.axis.name, f"@{of}{{g}} {way.unit}".strip())
                    for of, way in (("x", x), ("y", y))
                    if way.axis.name and of in drawn[0].data_source.data
                    and not isinstance(layer, Cells)]  # fmt: skip
            rows += [(name, f"@t{i}{'{g}' * (np.asarray(of).dtype.kind == 'f')}")
                     for i, (name, of) in enumerate(layer.tips.items())]  # fmt: skip
            told.setdefault((*rows, "$name" * bool(layer.name)), []).extend(drawn)
    for (*rows, head), drawn in told.items():
        hover(made, drawn, rows, head)
    legend(made, {"beside": "right", "above": "above"}.get(panel.legend, panel.legend))
    return made


class _Way(NamedTuple):
    """How an axis is shown: its numbers are multiplied by a factor, and then in a unit."""

    axis: Axis
    factor: float
    unit: str

    @property
    def label(self) -> str:
        return labelled(self.axis.name, self.unit)

    def shown(self, values: Points) -> np.ndarray:
        """Values in the unit; NaN for what has no place on the axis."""
        values = self.factor * placed(values)
        return np.where((values > 0) | (not self.axis.log), values, np.nan)


def _shown_as(panel: Panel, way: str) -> _Way:
    """An axis in the unit in which its curves are read best, as `style.name_axis` does on paper."""
    axis: Axis = getattr(panel, way)
    found = [np.ravel(getattr(of, way)) for of in panel.layers if isinstance(of, Curve)]
    values = np.concatenate([*found, []])
    if not axis.log:
        largest = np.max(np.abs(values), where=np.isfinite(values), initial=0.0)
        if READABLE[0] <= largest <= 2 * READABLE[1]:
            return _Way(axis, 1.0, axis.unit)
        values = np.array([largest])
    return _Way(axis, *shown_in(values, axis.unit))


def shown_in(values, unit: str) -> tuple[float, str]:
    """The factor and the unit in which the median of positive values is read best."""
    found = np.atleast_1d(np.asarray(values, float))
    found = found[np.isfinite(found) & (found > 0)]
    if not found.size or power_of(unit) is None:
        return 1.0, unit
    middle = float(np.median(found))
    number, name = prefixed(middle, unit)
    return number / middle, name


def plot(title: str, x: str, y: str, *, log: bool = True, **options: int | str | Range) -> Plot:
    """An empty figure of the common size, with labelled axes."""
    from bokeh.models import BasicTicker, CustomJSTicker, CustomJSTickFormatter, LinearAxis, LogAxis
    from bokeh.plotting import figure

    size = {"width": WIDTH, "height": HEIGHT, "sizing_mode": "stretch_width"} | options
    size |= {"y_axis_type": "log"} if log else {}
    made = figure(
        title=title, x_axis_label=x, y_axis_label=y, tools="pan,wheel_zoom,box_zoom,reset",
        toolbar_location="above", **size,
    )  # fmt: skip
    made.toolbar.logo = None
    axes = [made.xaxis[0], made.yaxis[0]]
    for axis in axes:
        if isinstance(axis, LogAxis):
            axis.ticker = CustomJSTicker(major_code=MAJOR, minor_code=MINOR)
        if isinstance(axis, LogAxis | LinearAxis):
            axis.formatter = CustomJSTickFormatter(code=NUMBER)
    if x == "trial":
        axes[0].ticker = BasicTicker(min_interval=1, num_minor_ticks=0)
    return made


def at_texts(axis: AxisOfPage, names: Sequence[str]) -> None:
    """Put texts at 0, 1, 2 ... of an axis."""
    from bokeh.models import BasicTickFormatter, FixedTicker

    axis.ticker, axis.formatter = FixedTicker(ticks=[*range(len(names))]), BasicTickFormatter()
    axis.major_label_overrides = dict(enumerate(names))


def legend(made: Plot, place: str = "right") -> None:
    """The legend right of the figure, above it or in it; a click on a name hides its curves."""
    if made.legend:
        if place in ("right", "above"):
            made.add_layout(made.legend[0], place)
        made.legend.visible = bool(place)
        made.legend.location = "bottom_left" if place == "lower left" else "top_right"
        made.legend.click_policy = "hide"
        made.legend.label_text_font_size = "9pt"


def hover(
    made: Plot, renderers: list[GlyphRenderer], rows: Sequence[tuple[str, str]], head: str = ""
) -> None:
    """Rows of a name and a value for the point under the pointer.

    rows: `@x{g}` is the value of column x with four digits, of any size; a unit may follow
    head: what stands above them, such as `$name`, the name of the curve
    """
    from bokeh.models import HoverTool

    parts = [(name.replace("_", " "), *value.partition(" ")) for name, value in rows]
    lines = f"<div><b>{head}</b></div>" * bool(head) + "".join(
        f'<div><span style="color: #555">{_literal(name)}:</span> '
        f"{value.replace('{g}', '{%.4g}')}{blank}{_literal(unit)}</div>"
        for name, value, blank, unit in parts
    )
    shown = f'<div style="max-width: 28em; white-space: normal">{lines}</div>'
    told = {name: "printf" for _, value in rows for name in re.findall(r"(@\w+)\{g\}", value)}
    made.add_tools(HoverTool(renderers=renderers, tooltips=shown, formatters=told))


def _literal(text: str) -> str:
    """A text for a tooltip, in which nothing stands for a column or for a tag."""
    return escape(text).replace("@", "&#64;").replace("$", "&#36;")


def thinned(values, points: int, *, times: bool = False) -> np.ndarray:
    """(about `points`,) values: the least and the largest of each column of samples, or times."""
    with np.errstate(over="ignore"):
        values = np.asarray(values, np.float32)
    values = np.where(np.isfinite(values), values, np.nan)
    if len(values) <= points:
        return values
    starts = np.linspace(0, len(values), points // 2 + 1).astype(int)[:-1]
    if times:
        ends = np.append(starts[1:], len(values)) - 1
        return np.column_stack([values[starts], values[(starts + ends) // 2]]).ravel()
    low, high = np.fmin.reduceat(values, starts), np.fmax.reduceat(values, starts)
    falling = values[starts] > values[np.append(starts[1:], len(values)) - 1]
    pairs = np.where(falling[:, None], np.stack([high, low], 1), np.stack([low, high], 1))
    return pairs.ravel().astype(np.float32)


# Layers
# --------------------------------------------------------------------------------------------------


def _look(of: Layer) -> dict[str, str | float]:
    look: dict[str, str | float] = {"color": of.colour, "alpha": of.alpha}
    return look | ({"legend_label": of.name, "name": of.name} if of.name else {})


def _tips(of: Layer) -> dict[str, np.ndarray]:
    """The columns of the tips of a layer."""
    return {f"t{i}": np.asarray(values) for i, values in enumerate(of.tips.values())}


def _dash(of: Dash) -> dict[str, str | list[int] | None]:
    """The dash of a line; one that is written out is in widths of the line."""
    dash = LINES.get(of) if isinstance(of, str) else [round(2 * part) for part in of[1]]
    return {"line_dash": dash}


def _curve(made: Plot, of: Curve, x: _Way, y: _Way) -> list[GlyphRenderer]:
    from bokeh.models import ColumnDataSource

    tips, look, line = _tips(of), _look(of), {"line_width": of.width + 0.5, **_dash(of.dash or "-")}
    if np.ndim(of.y) == 2 and len(of.x) > 1:
        several = {"xs": [x.shown(of.x)] * len(of.y), "ys": [*y.shown(of.y)], **tips}
        source = ColumnDataSource(several)
        return [made.multi_line("xs", "ys", source=source, hover_line_width=4, **line, **look)]
    columns = {"x": x.shown(np.resize(of.x, np.size(of.y))), "y": y.shown(np.ravel(of.y))}
    if not (of.shown_mark or tips):
        thin = thinned(columns["x"], POINTS, times=True)
        columns = {"x": thin, "y": thinned(columns["y"], POINTS)}
    drawn, source = [], ColumnDataSource(columns | tips)
    if of.dash and len(of.x) != 1:
        draw, more = (made.step, {"mode": "after"}) if of.steps else (made.line, {})
        drawn.append(draw("x", "y", source=source, **more, **line, **look))
    if of.shown_mark:
        first, every = of.marked or (0, 1)
        if of.marked:
            columns = {n: v[first::every] for n, v in (columns | tips).items()}
            source = ColumnDataSource(columns)
        fill: dict[str, str | None] = {} if of.filled else {"fill_color": None}
        fill |= {"line_color": of.rim} if of.rim else {}
        size = {"size": 1.3 * of.size, "marker": MARKS[of.shown_mark]}
        drawn.append(made.scatter("x", "y", source=source, **size, **look, **fill))
    return drawn


def _band(made: Plot, of: Band, x: _Way, y: _Way) -> list[GlyphRenderer]:
    """The parts of a band, between which there is none; on a log axis zero is below the axis."""
    at, low, high = x.shown(of.x), y.shown(of.low), y.shown(of.high)
    if y.axis.log:
        low = np.where(np.asarray(of.low, float) <= 0, UNSEEN * made.y_range.start, low)
    known = np.flatnonzero(np.isfinite(at) & np.isfinite(low) & np.isfinite(high))
    if len(at) == 1:
        made.segment(at, low, at, high, line_width=BAR, **_look(of))
        return []
    look = _look(of) | {"fill_alpha": of.alpha}
    del look["alpha"]
    draw, more = (made.varea_step, {"step_mode": "after"}) if of.steps else (made.varea, {})
    for part in np.split(known, np.flatnonzero(np.diff(known) > 1) + 1):
        draw(at[part], low[part], high[part], **more, **look)
    return []


def _rule(made: Plot, of: Rule, x: _Way, y: _Way) -> list[GlyphRenderer]:
    from bokeh.models import ColumnDataSource

    line, way = (made.vspan, x) if of.across == "x" else (made.hspan, y)
    source = ColumnDataSource({of.across: [way.factor * of.at], **_tips(of)})
    look = {"line_width": of.width + 0.5, **_dash(of.dash), **_look(of)}
    return [line(**{of.across: of.across}, source=source, **look)]


def _shade(made: Plot, of: Shade, x: _Way, y: _Way) -> list[GlyphRenderer]:
    look = {"fill_alpha": of.alpha, "line_color": None, **_look(of)}
    del look["alpha"], look["color"]
    look["fill_color"] = of.colour
    if of.across == "x":
        made.vstrip(x0=[x.factor * of.low], x1=[x.factor * of.high], **look)
    else:
        made.hstrip(y0=[y.factor * of.low], y1=[y.factor * of.high], **look)
    return []


def _bars(made: Plot, of: Bars, x: _Way, y: _Way) -> list[GlyphRenderer]:
    made.hbar(y=[*range(len(of.values))], right=[*of.values], height=0.6, color=[*of.colours])
    return []


def _cells(made: Plot, of: Cells, x: _Way, y: _Way) -> list[GlyphRenderer]:
    """A map, of which cells can be chosen, with its colours beside it."""
    from bokeh import palettes
    from bokeh.models import (
        ColorBar,
        ColumnDataSource,
        CustomJSTickFormatter,
        FixedTicker,
        LinearColorMapper,
        LogColorMapper,
    )

    values, shows = np.asarray(of.values, float), of.shows
    centres = np.meshgrid(of.x, of.y, indexing="ij")
    sides = np.meshgrid(edges_of(of.x, x.axis.log), edges_of(of.y, y.axis.log), indexing="ij")
    columns = {"left": sides[0][:-1, :-1], "right": sides[0][1:, :-1], "bottom": sides[1][:-1, :-1],
               "top": sides[1][:-1, 1:], "x": centres[0], "y": centres[1],
               "value": np.where(np.isfinite(values), values, np.nan)}  # fmt: skip
    source = ColumnDataSource({n: v.ravel() for n, v in columns.items()} | _tips(of))
    name, _, turned = shows.palette.partition("_")
    palette = palettes.__dict__[f"{name.title()}256"][:: -1 if turned else 1]
    kind = LogColorMapper if shows.log else LinearColorMapper
    colours = kind(palette=palette, low=shows.ends[0], high=shows.ends[1], nan_color="#e8e8e8")
    drawn = made.quad(
        "left", "right", "bottom", "top", source=source, line_color=None,
        fill_color={"field": "value", "transform": colours},
        selection_line_color="black", selection_line_width=3,
    )  # fmt: skip
    spaced = np.geomspace if shows.log else np.linspace
    bar = ColorBar(
        color_mapper=colours, title=labelled(shows.name, shows.unit), title_text_font_size="8pt",
        ticker=FixedTicker(ticks=spaced(*shows.ends, 5).tolist()),
        formatter=CustomJSTickFormatter(code=ROUNDED),
    )  # fmt: skip
    made.add_layout(bar, "right")
    return [drawn]


def _where(made: Plot, of: Where, x: _Way, y: _Way) -> list[GlyphRenderer]:
    i, j = np.nonzero(of.holds)
    at = np.asarray(of.x, float)[i], np.asarray(of.y, float)[j]
    made.scatter(*at, marker="x", size=6, color="#777777")
    return []


DRAW: dict[type[Layer], Callable[..., list[GlyphRenderer]]] = {
    Curve: _curve, Band: _band, Rule: _rule, Shade: _shade, Bars: _bars, Cells: _cells,
    Where: _where,
}  # fmt: skip
