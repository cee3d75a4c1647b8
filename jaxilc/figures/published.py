"""Figures of published numbers: what a paper prints, and what was simulated here."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np

from .description import Axis, Curve, Figure, Layer, Panel, Rule, Shade
from .paper import draw
from .style import BLACK, COLOURS

if TYPE_CHECKING:
    from ..pytree.aliases import Value

# A verdict has its colour and its mark, so that both can be distinguished in print.
VERDICTS = {
    "met": (COLOURS[2], "s"),
    "agrees": (COLOURS[2], "D"),
    "shape": (COLOURS[5], "^"),
    "open": (COLOURS[1], "X"),
}
BESIDE = (
    "the printed numbers and ours, and their ratios; the bands are those of a row that is met, and "
    "of one in the printed order."
)
BEYOND = 10.0  # ratio beyond which a row is drawn at the border, likewise below 1 / BEYOND


def reproduction_figures(numbers: Sequence[Mapping[str, Value]]) -> list[tuple[str, np.ndarray]]:
    """One picture for each paper, as pairs of caption and axes.

    numbers: rows of `reproduction.reproduce`, as dictionaries
    """
    return [
        (f"{scenario}: {BESIDE}", printed_and_ours(list(rows), title=str(scenario)))
        for scenario, rows in groupby(numbers, key=lambda row: row["scenario"])
    ]


def printed_and_ours(
    rows: Sequence[Mapping[str, Value]], *, title: str = "", ax: np.ndarray | None = None
) -> np.ndarray:
    """The numbers of a paper and ours, row by row; two axes with a common list of rows.

    Left are the two numbers, printed as an open circle (a bound as an open triangle) and ours as a
    filled mark, each in the unit that its row names. Right is ours divided by printed, with the
    bands in which a row is `met` and in which it may be in `shape`. Rows to which a number was
    fitted are written in italics.

    rows: rows of `reproduction.reproduce` of one scenario, as dictionaries
    """
    axes = draw(numbers_of_paper(rows, title), ax)
    axes[0].tick_params(axis="y", labelsize="x-small")
    for text, row in zip(axes[0].get_yticklabels(), rows, strict=True):
        text.set_style("italic" if row["among_fitted"] else "normal")
    return axes


def numbers_of_paper(rows: Sequence[Mapping[str, Value]], title: str = "") -> Figure:
    """What `printed_and_ours` draws; under the pointer stands how a row was read and judged."""
    from ..scenarios.reproduction import MET, SHAPE

    at, bound = np.arange(len(rows)), np.array([row["at_most"] for row in rows], bool)
    printed, ours, ratio = (
        np.array([row[name] for row in rows], float) for name in ("value", "ours", "ratio")
    )
    told = {
        "row": [label_of(row) for row in rows],
        "printed": ["< " * row["at_most"] + _number(row, "value") for row in rows],
        "ours": [_number(row, "ours") for row in rows],
        "ours / printed": [f"{of:.4g}" for of in ratio],
        "source": [row.get("source", "") for row in rows],
        "reading": [row.get("reading", "") for row in rows],
        "open because": [row.get("reason") or "–" for row in rows],
    }

    def points(x, which, mark: str, name: str, colour: str, size: float, filled=True) -> Curve:
        """The rows that are chosen, as marks."""
        tips = {name: [of[i] for i in np.flatnonzero(which)] for name, of in told.items()}
        return Curve(
            x[which], at[which], "", mark=mark, size=size, filled=filled,
            name=name, colour=colour, tips=tips,
        )  # fmt: skip

    left: list[Layer] = [
        points(printed, which, mark, name, BLACK, 6, filled=False)
        for which, mark, name in ((~bound, "o", "printed"), (bound, "<", "printed as a bound"))
        if which.any()
    ]
    right: list[Layer] = [
        Shade(1 / SHAPE, SHAPE, colour=BLACK, alpha=0.06),
        Shade(1 - MET, 1 + MET, colour=BLACK, alpha=0.12),
        Rule(1.0, "x"),
    ]
    drawn = np.nan_to_num(ratio, nan=BEYOND, posinf=BEYOND).clip(1 / BEYOND, BEYOND)
    for verdict, (colour, mark) in VERDICTS.items():
        which = np.array([row["verdict"] == verdict for row in rows], bool)
        if which.any():
            positive = which & (ours > 0) & np.isfinite(ours)
            gap, name = np.full(positive.sum(), np.nan), f"ours, {verdict}"
            ends = (printed[positive], ours[positive], gap), (at[positive], at[positive], gap)
            x, y = (np.stack(of, axis=1).ravel() for of in ends)
            left.append(Curve(x, y, width=0.8, colour=colour))
            left.append(points(ours, positive, mark, name, colour, 5))
            right.append(points(drawn, which, mark, name, colour, 5))
    rows_down = Axis(names=told["row"], ends=(len(rows) - 0.4, -0.6))
    over = Axis("ours / printed", log=True, ends=(0.8 / BEYOND, 1.25 * BEYOND))
    along = Axis("number, in the unit of its row", log=True)
    return Figure(
        [Panel(along, rows_down, left, title, legend="best"),
         Panel(over, rows_down, right, "bands: met, shape", legend="")],
        "The printed numbers and ours, row by row, and ours divided by printed: in the dark band a "
        "row is met, in the pale one it is in the printed order. Under the pointer stand both "
        "numbers, the source, how the paper was read, and why a row is open.",
        columns=2, size=(9.0, 1.6 + 0.19 * len(rows)), shares="y", widths=(3, 2),
    )  # fmt: skip


def _number(row: Mapping[str, Value], which: str) -> str:
    """A number with its unit; with all digits beside one of other software."""
    digits = 9 if row.get("agreement") is not None else 4
    return f"{row[which]:.{digits}g} {row['unit']}".rstrip()


def label_of(row: Mapping[str, Value]) -> str:
    """The name of a row: scheme, trial, quantity with unit, and the options that differ."""
    at = f", trial {row['trial']}" if row["trial"] else ""
    unit = f" [{row['unit']}]" if row["unit"] else ""
    return f"{row['scheme']}{at}, {row['quantity'].replace('_', ' ')}{unit}{options_of(row)}"


def options_of(row: Mapping[str, Value]) -> str:
    """The options of a row that differ within its paper, each after a comma."""
    return "".join(
        f", {value:g} Hz" if name == "frequency" else f", {name} {value}"
        for name, value in row["options"].items()
        if name not in ("plant", "reading", "axis", "disturbance")
    )
