"""`reproduce`: every published number compared with ours."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from itertools import groupby
from pathlib import Path

from .. import figures
from ..figures import browsers
from ..figures.published import BESIDE, label_of
from ..scenarios import reproduction
from ..scenarios.from_file import options
from ..scenarios.published import COMPARED, NUMBER, Published
from ..scenarios.reproduction import Judged, Row, described
from .outcome import Figure, Numbers, Outcome, Progress, Table, Verdict, silent
from .request import Request
from .words import number

COLUMNS = ("scheme", "trial", "quantity", "published", "ours", "ratio", "verdict")
IN_NUMBERS = ("trial", "published", "ours", "ratio")  # columns of numbers
NUMBERS_IN_SUMMARY = ("fitted", "predicted", "10 %", "3 %", "hold")
DIGITS = 9  # of a number of other software, and of ours beside it
NEAR = 1e-2  # difference below which the ratio to such a number is shown with eight digits


def reproduce(
    scenarios: Sequence[str] = (),
    *,
    reading: str | None = None,
    folder: str | Path | None = None,
    progress: Progress = silent,
) -> Outcome:
    """Every published number and conclusion beside ours, with verdicts and how papers were read.

    A table has a line for each paper; below are the counted rows that are not met and the
    conclusions that do not hold; the details have all rows. There each row says what was fitted,
    and an open row why it is open.

    scenarios: names of scenarios; all if none is given
    reading: of a paper that has several; the one that is taken if none is given
    folder: for a picture of each paper; none is written if it is not given
    """
    rows, judged = reproduction.compared(
        scenarios, reading, progress=lambda done, whole, name: progress(name, done, whole)
    )
    numbers = [row.as_dict() for row in rows]
    papers = groupby(numbers, key=lambda row: row["scenario"])
    return Outcome(
        command="reproduce",
        numbers={
            "rows": numbers,
            "conclusions": [one.as_dict() for one in judged],
            "counted": reproduction.counted(rows),
        },
        verdict=reproduce_verdict(rows, judged),
        folder=None if folder is None else Path(folder),
        tables=_by_paper(rows, judged),
        lines=[
            *_not_met(numbers),
            *(_concluded(one, asked=False) for one in judged if not one.holds),
        ],
        details=[*_tables(numbers), *map(_concluded, judged)],
        figures={
            str(name): Figure(
                f"{name}: {BESIDE}",
                partial(figures.printed_and_ours, list(of_paper), title=str(name)),
            )
            for name, of_paper in papers
        },
        live=lambda: [browsers.papers(numbers)],
    )


# Tables
# --------------------------------------------------------------------------------------------------


def _by_paper(rows: Sequence[Row], judged: Sequence[Judged]) -> list[Table]:
    """The counts of each scenario, of numbers that its paper prints first, and of all, if any."""
    title = "independent printed numbers that are met, and conclusions that hold"
    table = Table("", "reading", right=NUMBERS_IN_SUMMARY, title=title)
    names = dict.fromkeys(row.scenario for row in rows if row.published.agreement is None)
    for name in [*names, *(["all"] if len(names) > 1 else [])]:
        of = [row for row in rows if name in ("all", row.scenario)]
        hold = [one.holds for one in judged if name in ("all", one.scenario)]
        reading = "" if name == "all" else dict(of[0].published.options).get("reading", "")
        count = [*reproduction.counted(of).values()]
        table.add_row(
            name,
            str(reading),
            *(f"{group['met']} of {group['numbers']}" for group in count),
            *(f"{sum(group[size] for group in count)}" for size in ("10 %", "3 %")),
            f"{sum(hold)} of {len(hold)}",
        )
    return [table] * bool(names)


def _not_met(numbers: Sequence[Numbers]) -> list[str]:
    """A line for each counted row that is not met, the open ones first, and one for the others."""
    rows = [row for row in numbers if row["verdict"] not in ("met", "agrees")]
    lines = [
        f"{row['verdict']}: {row['scenario']}, {label_of(row)}: printed {row['value']:g}, ours "
        f"{number(row['ours'])}"
        for row in sorted(rows, key=lambda row: row["verdict"])
        if row["kind"] == NUMBER
    ]
    others = len(rows) - len(lines)
    return lines + [f"nor are {others} that a paper repeats or derives (--details)"] * (others > 0)


def _concluded(one: Judged, *, asked: bool = True) -> str:
    """A conclusion of a paper, whether it holds, and our numbers."""
    sign = {"falls": " > ", "does not rise": " >= ", "alike": " ~ "}[one.conclusion.order]
    sides = sign.join(
        described(side) if isinstance(side, Published) else "it" for side in one.conclusion.sides
    )
    verdict = "holds" if one.holds else "does not hold"
    ours = f"asked of ours: {sign.join(map(number, one.ours))} {one.unit}".rstrip()
    place = f", {one.conclusion.source}" * asked
    said = f"{verdict}: {one.scenario}{place}: {one.conclusion.says}; {ours}"
    return f"{said} ({sides})" if asked else said


def _tables(numbers: Sequence[Numbers]) -> list[Table | str]:
    """A table of published numbers for each scenario, with lines below it on how they were read.

    Where numbers of other software are all of one quantity, it stands in the title with its unit,
    so that many digits fit beside each other.
    """
    shown: list[Table | str] = []
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


def _lines(rows: Sequence[Numbers]) -> list[str]:
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


def _cells(row: Numbers) -> tuple[str, ...]:
    """The cells of a row by `COLUMNS`; a comparison has its quantity, and `% less` or `% of it`."""
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


def _compared(row: Numbers) -> tuple[str, str, str]:
    """The published number, ours and their ratio; those of other software with all digits."""
    if row["agreement"] is None:
        less = "< " * row["at_most"]
        published = f"{less}{row['value']:g} {row['unit']}"
        return published, number(row["ours"]), f"{row['ratio']:.2f}"
    near = abs(row["ratio"] - 1.0) < NEAR
    published = f"{row['value']:.{DIGITS}g} {row['unit']}".rstrip()
    return published, f"{row['ours']:.{DIGITS}g}", f"{row['ratio']:.{8 if near else 2}f}"


def _reading(row: Numbers) -> str:
    """The options, how the paper was read, what was fitted, and why the row is open, as text."""
    options = [f"{name} {value}" for name, value in row["options"].items() if name != "plant"]
    against = [f"compared with {row['against']}"] if row["against"] else []
    reason = [f"open: {row['reason']}"] if row["reason"] else []
    searched = [f"a space of readings was searched in {row['searched']}"] if row["searched"] else []
    return "; ".join([*options, row["reading"], *against, row["fitted"], *reason, *searched])


# The verdict
# --------------------------------------------------------------------------------------------------


def reproduce_verdict(rows: Sequence[Row], judged: Sequence[Judged] = ()) -> Verdict:
    """How many published numbers are met, and which one is farthest from ours."""
    first = _counted(rows, judged)
    if not rows:
        return Verdict((first,))
    first_printed = [row for row in rows if row.published.kind == NUMBER] or rows
    open_rows = [row for row in first_printed if row.verdict == "open"]
    farthest = max(open_rows or first_printed, key=_off)
    of, off = farthest.published, abs(farthest.ratio - 1.0)
    at = f", trial {of.trial}" if of.trial else ""
    value = f"{of.value:g} {farthest.unit}".rstrip()
    ours = (
        f"differs by {off:.2g} of the {value} of other software"
        if of.agreement is not None and off < NEAR
        else f"is {number(farthest.ratio)} times the printed {value}"
    )
    second = (
        f"The farthest{' open' if open_rows else ''} one is that of {farthest.scenario}, "
        f"{of.scheme}{at}: ours {ours}."
    )
    usual = options(farthest.scenario)
    settings = tuple(f"{name}={x}" for name, x in of.options if usual.get(name) != x)
    again = Request(farthest.scenario, set=settings, trials=of.trial)
    other = ("--scheme", of.against) if of.against else ()
    return Verdict((first, second), "that number", again.following("run", *other, scheme=of.scheme))


def _counted(rows: Sequence[Row], judged: Sequence[Judged]) -> str:
    """How many numbers and conclusions of papers are met, and how many of other software agree."""
    count = reproduction.counted(rows)
    of, others = [*count.values()], [row for row in rows if row.published.agreement is not None]
    total = {name: sum(group[name] for group in of) for name in of[0]}
    parts = []
    if total["numbers"] or not others:
        parts.append(
            f"Of {total['numbers']} independent printed numbers {total['met']} are met within 30 % "
            f"or as bounds ({total['10 %']} within 10 %, {total['3 %']} within 3 %), "
            f"{total['shape']} have the printed order, {total['open']} are open. "
            + "; ".join(f"{name}: {g['met']} of {g['numbers']} met" for name, g in count.items())
            + "."
        )
    if judged:
        hold = sum(one.holds for one in judged)
        parts.append(f"{hold} of {len(judged)} comparisons with the conclusions of papers hold.")
    if others:
        agree = sum(row.verdict == "agrees" for row in others)
        rest = len(others) - agree
        parts.append(f"{agree} of {len(others)} numbers of other software agree, {rest} open.")
    return " ".join(parts)


def _off(row: Row) -> float:
    """How far a number is from the printed one; not at all where a bound is kept."""
    if row.published.at_most and row.verdict == "met":
        return 0.0
    return abs(math.log(row.ratio)) if 0 < row.ratio < math.inf else math.inf
