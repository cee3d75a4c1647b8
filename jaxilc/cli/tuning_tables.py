"""Tables and lines of `jaxilc tune`, `pareto` and `worst-case`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from .tables import number
from .titled_table import Table
from .tuning_numbers import WHICH

if TYPE_CHECKING:
    from ..scenarios import Scenario
    from ..tuning import Tuned


def tuning_tables(scenario: Scenario, numbers: dict[str, Any]) -> list[Table]:
    """The table of weights, and for each metric a table by trial, as given and as tuned."""
    scheme = numbers["scheme"]
    weights = Table("weight", title=f"{scenario.title}\n{scheme}: weights")
    for column in WHICH:
        weights.add_column(column, justify="right")
    weights.add_column("allowed")
    for name, row in numbers["weights"].items():
        cells = (f"{row[which]:.6g}" for which in WHICH)
        weights.add_row(name, *cells, scenario.allowed(f"{scheme}.{name}"))
    found = [weights]
    for metric, rows in numbers["figures"].items():
        what = f"{metric.replace('_', ' ')} [{rows['unit']}]"
        table = Table(
            title=f"{what} of {numbers['samples']} machines never seen: median (95 %, worst); "
            "ratios are given / tuned"
        )
        for column in ("trial", *WHICH, "ratio of medians", "ratio of worsts"):
            table.add_column(column, justify="right")
        for j in rows["given"]:
            given, tuned = (rows[which][j] for which in WHICH)
            ratios = (_ratio(given[q], tuned[q]) for q in ("median", "worst"))
            table.add_row(j, _quantiles(given), _quantiles(tuned), *ratios)
        found.append(table)
    return found


def tuning_lines(tuned: Tuned, numbers: dict[str, Any]) -> tuple[str, list[str]]:
    """One line with the held-out loss before and after tuning, and a line for each warning."""
    held = numbers["held_out"]
    result = (
        f"held-out loss {held['given']:.6g} -> {held['tuned']:.6g}, "
        f"step {tuned.step} of {len(tuned.loss)}"
    )
    warnings = [
        f"{name} lay on an end of its range and started from {value:g}"
        for name, value in tuned.nudged.items()
    ]
    if tuned.dropped.any():
        most = int(tuned.dropped.max())
        warnings.append(f"up to {most} machines a step had no finite slope and were left out")
    return result, warnings


def front_table(scenario: Scenario, scheme: str, numbers: dict[str, Any]) -> Table:
    """The table of both objectives and the weights for each point of a front."""
    what = f"{scheme}, {numbers['trials']} trials: objectives on held-out machines"
    table = Table("share of first", title=f"{scenario.title}\n{what}")
    for column in ("first", "second", *numbers["points"]["given"]["weights"]):
        table.add_column(column, justify="right")
    for name, row in numbers["points"].items():
        values = (row["first"], row["second"], *row["weights"].values())
        table.add_row(name, *(f"{value:.6g}" for value in values))
    return table


def budget_table(scenario: Scenario, scheme: str, numbers: dict[str, Any]) -> Table:
    """The table for each number of trials: the metric as given and as tuned, and the weights."""
    rows = numbers["budgets"]
    metric = f"{numbers['figure'].replace('_', ' ')} [{numbers['unit']}] of trial J"
    what = f"{metric} on {numbers['samples']} machines never seen: median (95 %, worst)"
    table = Table(title=f"{scenario.title}\n{scheme}, tuned for J trials: {what}")
    for column in ("J", *WHICH, *next(iter(rows.values()))["weights"]):
        table.add_column(column, justify="right")
    for J, row in rows.items():
        weights = (f"{value:.6g}" for value in row["weights"].values())
        table.add_row(J, *(_quantiles(row[which]) for which in WHICH), *weights)
    return table


def worst_case_tables(scenario: Scenario, numbers: dict[str, Any]) -> list[Table]:
    """The tables of the result and cost of each search, and of the worst machine for `--set`."""
    metric = f"{numbers['figure'].replace('_', ' ')} [{numbers['unit']}]"
    what = f"largest {metric} at trial {numbers['trial']}, nominal {number(numbers['nominal'])}"
    table = Table("search", title=f"{scenario.title}\n{numbers['scheme']}: {what}")
    for column in ("found", "evaluations", "of them until found", "until level with chance"):
        table.add_column(column, justify="right")
    for name, row in numbers["searches"].items():
        level = row["level_with_chance"]
        table.add_row(
            name,
            number(row["value"]),
            str(row["evaluations"]),
            str(row["needed"]),
            "never" if level is None else str(level),
        )
    worst = max(numbers["searches"].values(), key=lambda row: row["loss"])
    rebuilt = Table("--set", title="the worst machine")
    for setting in worst["set"]:
        rebuilt.add_row(setting)
    return [table, rebuilt]


def _quantiles(row: dict[str, float]) -> str:
    """A text `1.2 (1.5, 1.8)`: the median, and in brackets the 95 % quantile and the worst."""
    return f"{number(row['median'])} ({number(row['high'])}, {number(row['worst'])})"


def _ratio(one: float, other: float) -> str:
    return number(one / other) if other else "–"
