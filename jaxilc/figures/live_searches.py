"""Interactive figures of searches: the worst machine, a trade-off, and a budget of trials."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from .live_axes import DASHED, Live, hover, legend, plot, shown_in, within
from .style import COLOURS, labelled

if TYPE_CHECKING:
    from ..tuning.worst_machine import WorstMachine

MOST = 2000  # machines drawn that a page shows one by one; of more, so many quantiles


def chance(worst: WorstMachine, *, metric: str, unit: str = "") -> Live:
    """The share of drawn machines that err no more than so much, and what each search found.

    metric, unit: name and unit of what is large
    """
    drawn = np.sort(worst.by_chance[np.isfinite(worst.by_chance)])
    count, word = len(worst.by_chance), metric.replace("_", " ")
    factor, unit = shown_in([*drawn, worst.nominal], unit)
    made = plot("", labelled(word, unit), "machines drawn [%]", log=False)
    share = 100 * np.arange(1, len(drawn) + 1) / max(count, 1)
    some = np.unique(np.linspace(0, max(len(drawn) - 1, 0), MOST).astype(int))[: len(drawn)]
    line = made.step(
        factor * drawn[some], share[some], mode="after", color="#737373", line_width=2,
        legend_label=f"{count} machines drawn",
    )  # fmt: skip
    hover(made, [line], [("machines that err less", "@y{g} %"), (word, f"@x{{g}} {unit}")])
    lines = {"nominal machine": (worst.nominal, {})}
    lines |= {name: (one.value, one.case.values) for name, one in worst.searches.items()}
    for i, (name, (value, machine)) in enumerate(lines.items()):
        if not np.isfinite(value):
            continue
        colour = COLOURS[(i - 1) % len(COLOURS)] if i else "#000000"
        mark = made.scatter(
            [factor * value], [100.0 if i else 0.0], size=12, color=colour, legend_label=name,
            marker="diamond" if i else "circle",
        )  # fmt: skip
        made.line(
            [factor * value] * 2, [0, 100], color=colour, legend_label=name,
            line_dash=DASHED[i % len(DASHED)], line_width=2,
        )  # fmt: skip
        tips = [(name, f"@x{{g}} {unit}")]
        hover(made, [mark], tips + [(path, f"{of:.4g}") for path, of in machine.items()])
    legend(made)
    return Live(
        "The curve says which share of the machines drawn by chance errs no more than so much; "
        "each line is a machine that was searched for. Under the pointer on a diamond stand the "
        "parameters of that machine.",
        made,
    )


def climbing(worst: WorstMachine, *, metric: str, unit: str = "") -> Live:
    """The largest error that each search has found, against the evaluations that it has spent.

    metric, unit: name and unit of what is large
    """
    courses = {name: np.asarray(one.course) for name, one in worst.searches.items()}
    factor, unit = shown_in(np.concatenate([*courses.values()]), unit)
    word = metric.replace("_", " ")
    made = plot("", "evaluations of the learning", labelled(word, unit), log=False,
                x_axis_type="log")  # fmt: skip
    drawn = []
    for i, (name, course) in enumerate(courses.items()):
        each = worst.searches[name].case.evaluations / len(course)
        changed = np.flatnonzero(np.diff(course, prepend=-np.inf, append=np.nan))
        at = np.unique([*changed[changed < len(course)], len(course) - 1])
        look = {"color": COLOURS[i % len(COLOURS)], "legend_label": name, "name": name}
        spent, found = each * (at + 1), np.where(np.isfinite(course[at]), course[at], np.nan)
        dash = DASHED[i % len(DASHED)]
        made.step(spent, factor * found, mode="after", line_width=2, line_dash=dash, **look)
        drawn.append(made.scatter(spent, factor * found, size=5, **look))
    tips = [("search", "$name"), ("evaluations", "@x{0}"), (word, f"@y{{g}} {unit}")]
    hover(made, drawn, tips)
    legend(made)
    return Live(
        f"The largest {word} that each search has found so far, against the evaluations of the "
        "learning that it has spent; a gradient counts as three more.",
        made,
    )


def front(rows: Mapping[str, Mapping[str, Any]], *, first: str, second: str) -> Live:
    """The points of a trade-off; the weights of each under the pointer.

    rows: `first`, `second` and `weights` by the share of the first objective; `given` among them
    first, second: the objectives, as they were asked for
    """
    made = plot("", first, second, log=False)
    tuned = sorted((r["first"], r["second"], name) for name, r in rows.items() if name != "given")
    xs, ys, names = zip(*tuned, strict=True) if tuned else ((), (), ())
    look = {"color": COLOURS[0], "legend_label": "tuned"}
    made.step(xs, ys, mode="after", line_dash="dashed", **look)
    drawn = [made.scatter(source=_points(rows, names), x="x", y="y", size=9, **look)]
    if "given" in rows:
        drawn.append(
            made.scatter(source=_points(rows, ["given"]), x="x", y="y", size=11, fill_color=None,
                         line_width=2, color=COLOURS[1], legend_label="as given")
        )  # fmt: skip
    weights = list(next(iter(rows.values()))["weights"])
    tips = [("share of the first", "@name"), (first, "@x{g}"), (second, "@y{g}")]
    hover(made, drawn, tips + [(name, f"@w{i}{{g}}") for i, name in enumerate(weights)])
    legend(made)
    return Live(
        "Both objectives of each point on the held-out machines; less is better. Under the pointer "
        "stand the share of the first objective and the weights.",
        made,
    )


def _points(rows: Mapping[str, Mapping[str, Any]], names: Sequence[str]) -> Any:
    """The columns of points of a trade-off."""
    from bokeh.models import ColumnDataSource

    weights = [list(rows[name]["weights"].values()) for name in names]
    columns: dict[str, Any] = {
        "x": [rows[name]["first"] for name in names],
        "y": [rows[name]["second"] for name in names],
        "name": list(names),
    }
    columns |= {f"w{i}": list(of) for i, of in enumerate(zip(*weights, strict=True))}
    return ColumnDataSource(columns)


def budgets(rows: Mapping[str, Mapping[str, Any]], *, metric: str, unit: str = "") -> Live:
    """The error of trial J as given, and as tuned for J trials; the weights under the pointer.

    rows: `given`, `tuned` (quantiles each) and `weights` by J as text
    metric, unit: name and unit of the error
    """
    from bokeh.models import ColumnDataSource

    trials, word = [int(J) for J in rows], metric.replace("_", " ")
    medians = [row[which]["median"] for row in rows.values() for which in ("given", "tuned")]
    factor, unit = shown_in(medians, unit)
    made, drawn = plot("", "number of trials", labelled(word, unit)), []
    weights = {
        f"w{i}": [row["weights"][name] for row in rows.values()]
        for i, name in enumerate(next(iter(rows.values()))["weights"])
    }
    for which, colour in (("given", COLOURS[1]), ("tuned", COLOURS[0])):
        for of, dash in (("median", "solid"), ("worst", "dashed")):
            values = factor * np.array([row[which][of] for row in rows.values()], float)
            source = ColumnDataSource(
                {"x": trials, "y": np.where(np.isfinite(values), values, np.nan)} | weights
            )
            name = f"{which}, {of}"
            look = {"source": source, "color": colour, "legend_label": name, "name": name}
            made.line("x", "y", line_dash=dash, line_width=2, **look)
            drawn.append(made.scatter("x", "y", size=7, **look))
    tips = [("weights", "$name"), ("trials", "@x"), (word, f"@y{{g}} {unit}")]
    names = next(iter(rows.values()))["weights"]
    tips += [(f"tuned {name}", f"@w{i}{{g}}") for i, name in enumerate(names)]
    hover(made, drawn, tips)
    within(made, [c for r in made.renderers for c in r.data_source.data["y"]])
    legend(made)
    return Live(
        f"The {word} of trial J over machines that no tuning has seen, with the weights as given "
        "and with those tuned for J trials. Under the pointer stand the tuned weights.",
        made,
    )
