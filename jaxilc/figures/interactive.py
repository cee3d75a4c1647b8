"""Figures that answer to the hand, for pages that are read offline: Bokeh models with captions.

Each function returns a `Live`: a caption in sentences and a model. Buttons, sliders and hover texts
run in the browser; nothing is asked from a server.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from .band import GROWS
from .style import COLOURS, limits_of, names_of
from .units import power_of, prefixed

if TYPE_CHECKING:
    import xarray as xr

    from ..sweeps.summary import SchemeSummary
    from ..theory import Certificate

WIDTH, HEIGHT = 860, 360  # of a figure [pixel]


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
    if log:
        from bokeh.models import LogTicker

        made.yaxis.ticker = LogTicker(mantissas=[1, 2, 5])
    return made


def _legend(made: Any) -> None:
    """The legend beside the figure; a click on a name hides its curves and shows them again."""
    if made.legend:
        made.add_layout(made.legend[0], "right")
        made.legend.click_policy = "hide"
        made.legend.label_text_font_size = "9pt"


def _hover(made: Any, renderers: list[Any], rows: list[tuple[str, str]]) -> None:
    from bokeh.models import HoverTool

    made.add_tools(HoverTool(renderers=renderers, tooltips=rows))


def learning(
    dataset: xr.Dataset,
    *,
    metric: str,
    scale: float = 1.0,
    unit: str = "",
    published: Iterable = (),
    tolerance: float | None = None,
) -> Live:
    """The errors of one machine by trial, a curve for each scheme, and the published numbers.

    tolerance: largest error that passes [unit]
    """
    curves = {}
    for name in names_of(dataset):
        errors = dataset[metric].sel(scheme=name)
        errors = scale * errors.max([d for d in errors.dims if d != "trial"]).values
        if "diverged" in dataset:
            errors = np.where(dataset["diverged"].sel(scheme=name).values, np.nan, errors)
        curves[name] = np.where(errors > 0, errors, np.nan)
    factor, unit = shown_in(np.concatenate([*curves.values()]), unit)
    word, trials = metric.replace("_", " "), np.asarray(dataset["trial"].values)
    made, drawn = plot("", "trial", f"{word} [{unit}]" if unit else word), []
    for i, (name, errors) in enumerate(curves.items()):
        look = {"color": COLOURS[i % len(COLOURS)], "legend_label": name, "name": name}
        drawn.append(made.line(trials, factor * errors, line_width=2, **look))
        drawn.append(made.scatter(trials, factor * errors, size=4, **look))
    _hover(made, drawn, [("scheme", "$name"), ("trial", "@x"), (word, f"@y{{0.000a}} {unit}")])
    due = [p for p in published if p.quantity == metric and (p.trial or 1) <= len(trials)]
    for i, name in enumerate(curves):
        rows = [p for p in due if p.scheme == name]
        at, values = [p.trial or 1 for p in rows], [factor * p.value for p in rows]
        if rows:
            look = {"color": COLOURS[i % len(COLOURS)], "fill_color": None, "size": 11}
            made.scatter(at, values, legend_label="published", **look)
    _limit(made, None if tolerance is None else factor * tolerance)
    _legend(made)
    said = f"The {word} of each trial. A click on a name hides its curve and shows it again; under"
    return Live(f"{said} the pointer stand the numbers.", made)


def band(
    rows: Sequence[SchemeSummary],
    *,
    metric: str,
    tolerance: float | None = None,
    scale: float = 1.0,
    unit: str = "",
) -> Live:
    """A sweep by trial: median, 5 to 95 % and the worst machine of each scheme.

    tolerance: largest error that passes [unit of the dataset]
    """
    factor, unit = shown_in(scale * np.concatenate([row.median for row in rows]), unit)
    scale, word = scale * factor, metric.replace("_", " ")
    made, drawn, seen = plot("", "trial", f"{word} [{unit}]" if unit else word), [], []
    for i, row in enumerate(rows):
        trials, colour = np.arange(1, len(row.median) + 1), COLOURS[i % len(COLOURS)]
        low, median, high, worst = (
            scale * np.asarray(x, float) for x in (row.low, row.median, row.high, row.worst)
        )
        top = GROWS * median[0] if np.isfinite(median[0]) else np.inf
        seen += [*np.minimum(high, top), *low]
        clip = np.minimum(high, 1e3 * top if np.isfinite(top) else np.finfo(float).max / 1e9)
        known = np.isfinite(low) & (low > 0) & np.isfinite(clip)
        pale = 0.2 if np.all(high <= top) else 0.05  # a band without an end would tint all others
        made.varea(
            trials[known], low[known], clip[known], fill_alpha=pale, color=colour,
            legend_label=row.scheme,
        )  # fmt: skip
        named = {"color": colour, "legend_label": row.scheme, "name": row.scheme}
        finite = np.where(np.isfinite(median), median, np.nan)
        drawn.append(made.line(trials, finite, line_width=2, **named))
        drawn.append(made.scatter(trials, finite, size=4, **named))
        made.line(trials, np.where(np.isfinite(worst), worst, np.nan), line_dash="dotted", **named)
    _hover(made, drawn, [("scheme", "$name"), ("trial", "@x"), ("median", f"@y{{0.000a}} {unit}")])
    limits = limits_of(np.array(seen))
    if limits:
        made.y_range.start, made.y_range.end = limits
    _limit(made, None if tolerance is None else scale * tolerance)
    _legend(made)
    return Live(
        f"The {word} by trial over all machines: the line is the median, the band holds 90 % of "
        "them, the dots are the worst machine of each trial. A click on a name hides a scheme and "
        "shows it again.",
        made,
    )


def certified(
    found: Certificate,
    drawn: Mapping[str, Any],
    *,
    name: str,
    scale: float = 1.0,
    unit: str = "",
) -> Live:
    """The simulated errors of each machine in the colour of its claim; its numbers on hover.

    drawn: (S,) values of the uncertain parameters, by path
    """
    from bokeh.models import ColumnDataSource

    from ..theory.certificates import CLAIMS
    from .by_trial import HUES, SAID

    factor, unit = shown_in(scale * found.simulated, unit)
    made = plot("", "trial", f"RMS error [{unit}]" if unit else "RMS error")
    trials = np.arange(1, found.simulated.shape[1] + 1)
    lines, columns = [], columns_of(drawn)
    for claim, hue in zip(CLAIMS, HUES, strict=False):
        chosen = np.flatnonzero(found.claim == claim)
        if not len(chosen):
            continue
        errors = factor * scale * found.simulated[chosen]
        source = ColumnDataSource(
            {
                "xs": [trials.tolist()] * len(chosen),
                "ys": [[v if np.isfinite(v) and v > 0 else None for v in row] for row in errors],
                "machine": chosen,
                "claim": [SAID.get(claim, claim)] * len(chosen),
                **{f"p{i}": values[chosen] for i, values in enumerate(columns.values())},
            }
        )
        colour = "#999999" if hue.startswith("0.") else hue
        look = {"color": colour, "line_width": 1.5, "line_alpha": 0.6, "hover_line_width": 4}
        lines.append(
            made.multi_line("xs", "ys", source=source, legend_label=SAID.get(claim, claim), **look)
        )
    _hover(made, lines, [("machine", "@machine"), ("claim", "@claim"), *_tips(columns)])
    _legend(made)
    return Live(
        f"{name}: the RMS error of each machine by trial, in the colour of what theory claims of "
        "it. Under the pointer stands which machine it is, and its parameters.",
        made,
    )


def columns_of(drawn: Mapping[str, Any], most: int = 12) -> dict[str, np.ndarray]:
    """(S,) values by the name of a parameter; of an array each element; the first ones of many."""
    found: dict[str, np.ndarray] = {}
    for name, values in drawn.items():
        values = np.asarray(values, float)
        flat = values.reshape(len(values), -1)
        if values.ndim == 1:
            found[name] = values
        else:
            found |= {f"{name}[{i}]": flat[:, i] for i in range(flat.shape[1])}
    varying = {name: v for name, v in found.items() if np.ptp(v) > 0}
    return dict(list(varying.items())[:most])


def _tips(columns: Mapping[str, np.ndarray]) -> list[tuple[str, str]]:
    return [(name, f"@p{i}{{0.0000e+0}}") for i, name in enumerate(columns)]


def _limit(made: Any, tolerance: float | None) -> None:
    if tolerance is not None:
        from bokeh.models import Span

        line = Span(location=tolerance, dimension="width", line_dash="dashed", line_color="black")
        made.add_layout(line)
