"""Tables of `jaxilc reproduce`: the published numbers compared with ours."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from typing import Any

from ..scenarios.published import COMPARED
from ..scenarios.reproduction import SHAPE
from .tables import number
from .titled_table import Table

READING_FITS = 120  # least columns of a terminal for a column with the reading of a paper
COLUMNS = ("scheme", "trial", "quantity", "published", "ours", "ratio", "verdict")
IN_NUMBERS = ("trial", "published", "ours", "ratio")  # columns of numbers
DIGITS = 9  # of a number of other software, and of ours beside it
NEAR = 1e-2  # difference below which the ratio to such a number is shown with eight digits


def reproduction_table(numbers: Sequence[dict[str, Any]]) -> Table:
    """The table of published numbers for a terminal of at least 120 columns, and for a report.

    The last column says how the paper was read, what was fitted, and why a row is open.

    numbers: rows of `reproduction.reproduce`, as dictionaries
    """
    table = Table(title=counted(numbers))
    for column in ("scenario", *COLUMNS, "source", "reading"):
        table.add_column(column, justify="right" if column in IN_NUMBERS else "left")
    for row in numbers:
        table.add_row(row["scenario"], *_cells(row), row["source"], _reading(row))
    return table


def narrow_reproduction(numbers: Sequence[dict[str, Any]]) -> list[Table | str]:
    """The same for a terminal of 80 columns: a table for each scenario, with lines below it.

    The lines have the source of the rows, and how the paper was read; rows of a scheme with the
    same text share a line. Where numbers of other software are all of one quantity, it stands in
    the title with its unit, so that many digits fit beside each other.
    """
    shown: list[Table | str] = [counted(numbers)]
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


def counted(numbers: Sequence[dict[str, Any]]) -> str:
    """A text with the count of each verdict, first on the numbers of papers.

    Those to which a number was fitted are counted apart from the others, which test what was read
    and fitted.
    """
    printed = [row for row in numbers if row["agreement"] is None]
    others = [row for row in numbers if row["agreement"] is not None]
    said = []
    if printed or not others:
        count = {v: sum(row["verdict"] == v for row in printed) for v in ("met", "shape", "open")}
        in_shape = f"{count['shape']} in shape (the printed order, within a factor of {SHAPE:g})"
        met = f"{count['met']} met within 30 %"
        said.append(f"{len(printed)} published numbers: {met}, {in_shape}, {count['open']} open")
        said += [parted(printed)] if printed else []
    if others:
        agree = sum(row["verdict"] == "agrees" for row in others)
        rest = len(others) - agree
        said.append(f"{len(others)} numbers of other software: {agree} agree, {rest} open")
    return "; ".join(said)


def parted(printed: Sequence[dict[str, Any]]) -> str:
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
