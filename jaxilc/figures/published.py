"""Figures of published numbers: what a paper prints, and what was simulated here."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby
from typing import Any

import numpy as np

from .style import COLOURS, grid, new_axes

# A verdict has its colour and its mark, so that both can be distinguished in print.
VERDICTS = {
    "met": (COLOURS[2], "s"),
    "agrees": (COLOURS[2], "D"),
    "shape": (COLOURS[5], "^"),
    "open": (COLOURS[1], "X"),
}
BEYOND = 10.0  # ratio beyond which a row is drawn at the border, likewise below 1 / BEYOND


def reproduction_figures(numbers: Sequence[Mapping[str, Any]]) -> list[tuple[str, np.ndarray]]:
    """One picture for each paper, as pairs of caption and axes.

    numbers: rows of `reproduction.reproduce`, as dictionaries
    """
    found = []
    for scenario, rows in groupby(numbers, key=lambda row: row["scenario"]):
        caption = (
            f"{scenario}: the printed numbers and ours, and their ratios; the bands are those of a "
            "row that is met, and of one in the printed order."
        )
        found.append((caption, printed_and_ours(list(rows), title=str(scenario))))
    return found


def printed_and_ours(
    rows: Sequence[Mapping[str, Any]], *, title: str = "", ax: Any = None
) -> np.ndarray:
    """The numbers of a paper and ours, row by row; two axes with a common list of rows.

    Left are the two numbers, printed as an open circle (a bound as an open triangle) and ours as a
    filled mark, each in the unit that its row names. Right is ours divided by printed, with the
    bands in which a row is `met` and in which it may be in `shape`. Rows to which a number was
    fitted are written in italics.

    rows: rows of `reproduction.reproduce` of one scenario, as dictionaries
    """
    from ..scenarios.reproduction import MET, SHAPE

    height = 1.6 + 0.19 * len(rows)
    axes = new_axes(ax, 1, 2, size=(9.0, height), sharey=True, width_ratios=(3, 2))
    left, right = axes
    at = np.arange(len(rows))
    printed = np.array([row["value"] for row in rows], float)
    ours = np.array([row["ours"] for row in rows], float)
    ratio = np.array([row["ratio"] for row in rows], float)
    bound = np.array([row["at_most"] for row in rows])
    drawn = np.nan_to_num(ratio, nan=BEYOND, posinf=BEYOND).clip(1 / BEYOND, BEYOND)
    right.axvspan(1 / SHAPE, SHAPE, color="#000000", alpha=0.06, linewidth=0)
    right.axvspan(1 - MET, 1 + MET, color="#000000", alpha=0.12, linewidth=0)
    right.axvline(1.0, color="k", linewidth=0.8)
    for which, mark, name in ((~bound, "o", "printed"), (bound, "<", "printed as a bound")):
        if which.any():
            left.plot(printed[which], at[which], mark, mfc="none", color="k", label=name)
    for verdict, (colour, mark) in VERDICTS.items():
        which = np.array([row["verdict"] == verdict for row in rows])
        if not which.any():
            continue
        shown = {"marker": mark, "linestyle": "none", "color": colour, "markersize": 5}
        positive = which & (ours > 0) & np.isfinite(ours)
        left.hlines(at[positive], printed[positive], ours[positive], color=colour, linewidth=0.8)
        left.plot(ours[positive], at[positive], label=f"ours, {verdict}", **shown)
        right.plot(drawn[which], at[which], **shown)
    left.set(xscale="log", ylim=(len(rows) - 0.4, -0.6), xlabel="number, in the unit of its row")
    right.set(
        xscale="log",
        xlabel="ours / printed",
        xlim=(0.8 / BEYOND, 1.25 * BEYOND),
        title="bands: met, shape",
    )
    left.set_yticks(at, [label_of(row) for row in rows], fontsize="x-small")
    for text, row in zip(left.get_yticklabels(), rows, strict=True):
        text.set_style("italic" if row["among_fitted"] else "normal")
    right.tick_params(axis="y", labelleft=False)
    grid(left)
    grid(right)
    left.set_title(title)
    left.legend(fontsize="x-small", loc="best")
    return axes


def label_of(row: Mapping[str, Any]) -> str:
    """The name of a row: scheme, trial, quantity with unit, and the options that differ."""
    at = f", trial {row['trial']}" if row["trial"] else ""
    unit = f" [{row['unit']}]" if row["unit"] else ""
    options = "".join(
        f", {value:g} Hz" if name == "frequency" else f", {name} {value}"
        for name, value in row["options"].items()
        if name not in ("plant", "reading", "axis", "disturbance")
    )
    return f"{row['scheme']}{at}, {row['quantity'].replace('_', ' ')}{unit}{options}"
