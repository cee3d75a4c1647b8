"""Figures that answer to the hand, for pages that are read offline: Bokeh models with captions.

Each function returns a `Live`: a caption in sentences and a model. Buttons, sliders and hover texts
run in the browser; nothing is asked from a server.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from .band import top_of
from .live_axes import Live, hover, legend, plot, shown_in, tolerance_line, within
from .style import COLOURS, labelled, names_of

if TYPE_CHECKING:
    import xarray as xr

    from ..sweeps.summary import SchemeSummary
    from ..theory import Certificate


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
    made, drawn = plot("", "trial", labelled(word, unit)), []
    for i, (name, errors) in enumerate(curves.items()):
        look = {"color": COLOURS[i % len(COLOURS)], "legend_label": name, "name": name}
        drawn.append(made.line(trials, factor * errors, line_width=2, **look))
        drawn.append(made.scatter(trials, factor * errors, size=4, **look))
    hover(made, drawn, [("scheme", "$name"), ("trial", "@x"), (word, f"@y{{g}} {unit}")])
    due = [p for p in published if p.quantity == metric and (p.trial or 1) <= len(trials)]
    for i, name in enumerate(curves):
        rows = [p for p in due if p.scheme == name]
        at, values = [p.trial or 1 for p in rows], [factor * p.value for p in rows]
        if rows:
            look = {"color": COLOURS[i % len(COLOURS)], "fill_color": None, "size": 11}
            made.scatter(at, values, legend_label="published", **look)
    tolerance_line(made, None if tolerance is None else factor * tolerance)
    legend(made)
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
    made, drawn, seen = plot("", "trial", labelled(word, unit)), [], []
    for i, row in enumerate(rows):
        trials, colour = np.arange(1, len(row.median) + 1), COLOURS[i % len(COLOURS)]
        low, median, high, worst = (
            scale * np.asarray(x, float) for x in (row.low, row.median, row.high, row.worst)
        )
        top = top_of(median)
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
    hover(made, drawn, [("scheme", "$name"), ("trial", "@x"), ("median", f"@y{{g}} {unit}")])
    within(made, seen)
    tolerance_line(made, None if tolerance is None else scale * tolerance)
    legend(made)
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
        colour = "#737373" if hue.startswith("0.") else hue
        look = {"color": colour, "line_width": 1.5, "line_alpha": 0.6, "hover_line_width": 4}
        lines.append(
            made.multi_line("xs", "ys", source=source, legend_label=SAID.get(claim, claim), **look)
        )
    hover(made, lines, [("machine", "@machine"), ("claim", "@claim"), *tips_of(columns)])
    legend(made)
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


def tips_of(columns: Mapping[str, np.ndarray]) -> list[tuple[str, str]]:
    """The parameters of a machine, for `hover`."""
    return [(name, f"@p{i}{{g}}") for i, name in enumerate(columns)]
