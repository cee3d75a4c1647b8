"""`reproduce`: every published number compared with ours."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .. import figures
from ..scenarios import reproduction
from ..scenarios.published import COMPARED
from ..scenarios.reproduction import SHAPE
from .outcome import Figure, Outcome, Progress, silent
from .request import Request
from .table import Table
from .verdict import Verdict
from .words import number

if TYPE_CHECKING:
    from ..figures.page import Live

COLUMNS = ("scheme", "trial", "quantity", "published", "ours", "ratio", "verdict")
IN_NUMBERS = ("trial", "published", "ours", "ratio")  # columns of numbers
DIGITS = 9  # of a number of other software, and of ours beside it
NEAR = 1e-2  # difference below which the ratio to such a number is shown with eight digits
BESIDE = (
    "the printed numbers and ours, and their ratios; the bands are those of a row that is met, and "
    "of one in the printed order."
)


def reproduce(
    scenarios: Sequence[str] = (),
    *,
    reading: str | None = None,
    folder: Path | None = None,
    progress: Progress = silent,
) -> Outcome:
    """Every published number beside ours, with a verdict and how the paper was read.

    Each row says what was fitted, and an open row why it is open.

    scenarios: names of scenarios; all if none is given
    reading: of a paper that has several; the one that is taken if none is given
    folder: for a picture of each paper; none is written if it is not given
    """
    rows = reproduction.reproduce(
        scenarios, reading, progress=lambda done, whole, name: progress(name, done, whole)
    )
    numbers = [row.as_dict() for row in rows]
    papers = groupby(numbers, key=lambda row: row["scenario"])
    return Outcome(
        command="reproduce",
        numbers=numbers,
        verdict=reproduce_verdict(numbers),
        folder=folder,
        tables=_tables(numbers),
        figures={
            str(name): Figure(
                f"{name}: {BESIDE}",
                partial(figures.printed_and_ours, list(of_paper), title=str(name)),
            )
            for name, of_paper in papers
        },
        live=partial(_live, numbers),
    )


def _live(numbers: Sequence[dict[str, Any]]) -> list[Live]:
    from ..figures.browsers import papers

    return [papers(numbers)]


# Tables
# --------------------------------------------------------------------------------------------------


def _tables(numbers: Sequence[dict[str, Any]]) -> list[Table | str]:
    """A table of published numbers for each scenario, with lines below it.

    The lines have the source of the rows, and how the paper was read; rows of a scheme with the
    same text share a line. Where numbers of other software are all of one quantity, it stands in
    the title with its unit, so that many digits fit beside each other.

    numbers: rows of `reproduction.reproduce`, as dictionaries
    """
    shown: list[Table | str] = [_title(numbers)]
    for scenario, group in groupby(numbers, key=lambda row: row["scenario"]):
        rows = list(group)
        software = all(row["agreement"] is not None for row in rows)
        alike = {(row["quantity"], row["unit"]) for row in rows} if software else set()
        title, columns = scenario, list(COLUMNS)
        if len(alike) == 1:
            (quantity, unit) = alike.pop()
            title += f", {quantity.replace('_', ' ')}" + f" [{unit}]" * bool(unit)
            columns.remove("quantity")
            rows = [row | {"unit": ""} for row in rows]
        table = Table(title=title)
        for column in columns:
            table.add_column(column, justify="right" if column in IN_NUMBERS else "left")
        for row in rows:
            texts = dict(zip(COLUMNS, _cells(row), strict=True))
            table.add_row(*(texts[name] for name in columns))
        shown += [table, *_lines(rows)]
    return shown


def _lines(rows: Sequence[dict[str, Any]]) -> list[str]:
    """How the rows of a scenario were read, as lines; the first row of a line has its place."""
    trials: dict[tuple[str, str, str], list[str]] = {}
    for row in rows:
        of_row = trials.setdefault((row["source"], row["scheme"], _reading(row)), [])
        of_row += [str(row["trial"])] if row["trial"] else []
    lines = []
    for (source, scheme, text), of in trials.items():
        of = list(dict.fromkeys(of))
        at = f", trial{'s' * (len(of) > 1)} {', '.join(of)}" if of else ""
        lines.append(f"{source}, {scheme}{at}: {text}")
    return lines


def _cells(row: dict[str, Any]) -> tuple[str, ...]:
    """The cells of a row, in the order of `COLUMNS`.

    A comparison with another scheme has the quantity that is compared, and `% less` or `% of it`.
    """
    for ending, unit in zip(COMPARED, ("% less", "% of it"), strict=True):
        if row["against"] and row["quantity"].endswith(ending):
            row = row | {"quantity": row["quantity"].removesuffix(ending), "unit": unit}
    return (
        row["scheme"],
        "" if row["trial"] is None else str(row["trial"]),
        row["quantity"].replace("_", " "),
        *_compared(row),
        row["verdict"],
    )


def _compared(row: dict[str, Any]) -> tuple[str, str, str]:
    """The published number, ours and their ratio; those of other software with all digits."""
    if row["agreement"] is None:
        less = "< " * row["at_most"]
        published = f"{less}{row['value']:g} {row['unit']}"
        return published, number(row["ours"]), f"{row['ratio']:.2f}"
    near = abs(row["ratio"] - 1.0) < NEAR
    published = f"{row['value']:.{DIGITS}g} {row['unit']}".rstrip()
    return published, f"{row['ours']:.{DIGITS}g}", f"{row['ratio']:.{8 if near else 2}f}"


def _title(numbers: Sequence[dict[str, Any]]) -> str:
    """A text with the count of each verdict, first on the numbers of papers.

    Those to which a number was fitted are counted apart from the others, which test what was read
    and fitted.
    """
    printed = [row for row in numbers if row["agreement"] is None]
    others = [row for row in numbers if row["agreement"] is not None]
    parts = []
    if printed or not others:
        count = {v: sum(row["verdict"] == v for row in printed) for v in ("met", "shape", "open")}
        in_shape = f"{count['shape']} in shape (the printed order, within a factor of {SHAPE:g})"
        met = f"{count['met']} met within 30 %"
        parts.append(f"{len(printed)} published numbers: {met}, {in_shape}, {count['open']} open")
        parts += [_parted(printed)] if printed else []
    if others:
        agree = sum(row["verdict"] == "agrees" for row in others)
        rest = len(others) - agree
        parts.append(f"{len(others)} numbers of other software: {agree} agree, {rest} open")
    return "; ".join(parts)


def _parted(printed: Sequence[dict[str, Any]]) -> str:
    """How many numbers of papers are met, of those fitted to and of those predicted, as text."""
    fitted = [row["verdict"] == "met" for row in printed if row["among_fitted"]]
    predicted = [row["verdict"] == "met" for row in printed if not row["among_fitted"]]
    return (
        f"fitted to: {sum(fitted)} of {len(fitted)} met, "
        f"predicted: {sum(predicted)} of {len(predicted)} met"
    )


def _reading(row: dict[str, Any]) -> str:
    """The options, how the paper was read, what was fitted, and why the row is open, as text."""
    options = [f"{name} {value}" for name, value in row["options"].items() if name != "plant"]
    against = [f"compared with {row['against']}"] if row["against"] else []
    reason = [f"open: {row['reason']}"] if row["reason"] else []
    searched = [f"a space of readings was searched in {row['searched']}"] if row["searched"] else []
    return "; ".join([*options, row["reading"], *against, row["fitted"], *reason, *searched])


# The verdict
# --------------------------------------------------------------------------------------------------


def reproduce_verdict(rows: Sequence[dict[str, Any]]) -> Verdict:
    """How many published numbers are met, and which one is farthest from ours.

    rows: rows of `reproduction.reproduce`, as dictionaries
    """
    open_rows = [row for row in rows if row["verdict"] == "open"]
    first = _counted(rows)
    if not rows:
        return Verdict((first,))
    farthest = max(open_rows or rows, key=_off)
    at = f", trial {farthest['trial']}" if farthest["trial"] else ""
    value = f"{farthest['value']:g} {farthest['unit']}".rstrip()
    off = abs(farthest["ratio"] - 1.0)
    ours = (
        f"differs by {off:.2g} of the {value} of other software"
        if farthest["agreement"] is not None and off < NEAR
        else f"is {number(farthest['ratio'])} times the printed {value}"
    )
    second = (
        f"The farthest{' open' if open_rows else ''} one is that of {farthest['scenario']}, "
        f"{farthest['scheme']}{at}: ours {ours}."
    )
    settings = tuple(f"{name}={value}" for name, value in farthest["options"].items())
    again = Request(farthest["scenario"], set=settings, trials=farthest["trial"])
    return Verdict(
        (first, second), "that number", again.following("run", scheme=farthest["scheme"])
    )


def _counted(rows: Sequence[dict[str, Any]]) -> str:
    """How many numbers of papers are met, and how many of other software agree."""
    of_papers = [row for row in rows if row["agreement"] is None]
    printed = [row["verdict"] for row in of_papers]
    others = [row["verdict"] for row in rows if row["agreement"] is not None]
    parts = []
    if printed or not others:
        parts.append(
            f"{printed.count('met')} of {len(printed)} published numbers are met within 30 %, "
            f"{printed.count('shape')} in shape, {printed.count('open')} open"
            + (f" ({_parted(of_papers)})." if of_papers else ".")
        )
    if others:
        agree = f"{others.count('agrees')} of {len(others)} numbers of other software agree"
        parts.append(f"{agree}, {others.count('open')} open.")
    return " ".join(parts)


def _off(row: dict[str, Any]) -> float:
    ratio = row["ratio"]
    return abs(math.log(ratio)) if 0 < ratio < math.inf else math.inf
