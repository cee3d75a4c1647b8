"""The interactive figure of published numbers: each row, its ratio, and why it is judged so."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby
from typing import Any

import numpy as np

from .live_axes import Live, hover, plot
from .published import BEYOND, VERDICTS, label_of
from .style import COLOURS

TALLEST, ROW = 900, 19  # of the figure and of a row [pixel]

CHOOSE = """
const kept = [...all.data["paper"].keys()].filter((i) => all.data["paper"][i] === select.value);
const found = {};
for (const name of Object.keys(shown.data)) found[name] = kept.map((i) => all.data[name][i]);
shown.data = found;
rows.factors = found["row"].slice().reverse();
figure.height = Math.min(tallest, 120 + each * found["row"].length);
"""


def printed_and_ours(numbers: Sequence[Mapping[str, Any]]) -> Live:
    """Ours divided by printed, row by row; a menu chooses the paper.

    numbers: rows of `reproduction.reproduce`, as dictionaries
    """
    from bokeh.layouts import column
    from bokeh.models import BoxAnnotation, ColumnDataSource, CustomJS, FactorRange, Select, Span

    from ..scenarios.reproduction import MET, SHAPE

    papers = {
        str(name): _columns(list(rows)) for name, rows in groupby(numbers, lambda r: r["scenario"])
    }
    first = next(iter(papers))
    shown = ColumnDataSource(papers[first])
    rows = FactorRange(factors=papers[first]["row"][::-1])
    made = plot(
        "", "ours / printed", "", log=False, x_axis_type="log", y_range=rows,
        x_range=(0.8 / BEYOND, 1.25 * BEYOND), height=_height(papers[first]),
    )  # fmt: skip
    for width, alpha in ((SHAPE, 0.06), (None, 0.12)):
        low, high = (1 - MET, 1 + MET) if width is None else (1 / width, width)
        made.add_layout(BoxAnnotation(left=low, right=high, fill_color="black", fill_alpha=alpha,
                                      line_color=None))  # fmt: skip
    made.add_layout(Span(location=1.0, dimension="height", line_color="black"))
    dots = made.scatter(
        "ratio", "row", source=shown, color="colour", marker="mark", size=10, line_width=2,
        legend_field="verdict",
    )  # fmt: skip
    made.add_layout(made.legend[0], "right")
    tips = [("row", "@row"), ("printed", "@printed"), ("ours", "@ours"), ("ratio", "@exact{g}"),
            ("verdict", "@verdict"), ("source", "@source"), ("reading", "@reading"),
            ("open because", "@reason")]  # fmt: skip
    hover(made, [dots], tips)
    if len(papers) == 1:
        return Live(_SAID, made)
    select = Select(title="paper", value=first, options=[*papers], width=220)
    code = CustomJS(
        args={"all": _all(papers), "select": select, "shown": shown, "rows": rows,
              "figure": made, "tallest": TALLEST, "each": ROW},
        code=CHOOSE,
    )  # fmt: skip
    select.js_on_change("value", code)
    return Live(f"{_SAID} The menu chooses the paper.", column(select, made,
                sizing_mode="scale_width"))  # fmt: skip


_SAID = (
    "Our number divided by the printed one, row by row: in the dark band a row is met, in the pale "
    "one it is in the printed order. Under the pointer stand both numbers, the source, how the "
    "paper was read, and why a row is open."
)


def _all(papers: Mapping[str, Mapping[str, Any]]) -> Any:
    """The rows of all papers, with the paper of each."""
    from bokeh.models import ColumnDataSource

    columns: dict[str, Any] = {
        name: [value for of in papers.values() for value in of[name]]
        for name in next(iter(papers.values()))
    }
    return ColumnDataSource(columns | {"paper": [p for p, of in papers.items() for _ in of["row"]]})


def _height(columns: Mapping[str, Any]) -> int:
    return min(TALLEST, 120 + ROW * len(columns["row"]))


def _columns(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The columns of the rows of a paper; a row that stands twice gets a number."""
    names: list[str] = []
    for row in rows:
        name = label_of(row)
        again = sum(n.split(" #")[0] == name for n in names)
        names.append(f"{name} #{again + 1}" if again else name)
    ratio = np.array([row["ratio"] for row in rows], float)
    drawn = np.nan_to_num(ratio, nan=BEYOND, posinf=BEYOND).clip(1 / BEYOND, BEYOND)
    marks = {"s": "square", "D": "diamond", "^": "triangle", "X": "x"}
    looks = [VERDICTS.get(row["verdict"], (COLOURS[1], "X")) for row in rows]
    return {
        "row": names,
        "ratio": drawn.tolist(),
        "exact": np.nan_to_num(ratio, nan=0.0, posinf=np.finfo(float).max).tolist(),
        "printed": [f"{'< ' * row['at_most']}{_number(row, 'value')}" for row in rows],
        "ours": [_number(row, "ours") for row in rows],
        "verdict": [row["verdict"] for row in rows],
        "colour": [colour for colour, _ in looks],
        "mark": [marks[mark] for _, mark in looks],
        "source": [row["source"] for row in rows],
        "reading": [row["reading"] for row in rows],
        "reason": [row["reason"] or "–" for row in rows],
    }


def _number(row: Mapping[str, Any], which: str) -> str:
    """A number with its unit; with all digits beside one of other software."""
    digits = 9 if row.get("agreement") is not None else 4
    return f"{row[which]:.{digits}g} {row['unit']}".rstrip()
