"""What `jaxilc tune` and `jaxilc worst-case` print, as plain numbers under stable keys and as
tables.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

from ..sweeps.summary import summarise
from .tables import number, sweep_figures
from .titled_table import Table

if TYPE_CHECKING:
    import xarray as xr

    from ..scenarios import Scenario
    from ..tuning.problem import Tuned

WHICH = ("given", "tuned")


def tuning_figures(
    scenario: Scenario, scheme: str, tuned: Tuned, dataset: xr.Dataset
) -> dict[str, Any]:
    """Weights, held-out losses, and by figure, `given` or `tuned`, and trial the quantiles [shown
    unit] over a comparison's machines.
    """
    trials, samples = dataset.sizes["trial"], dataset.sizes["sample"]
    by_figure = {}
    for figure in dict.fromkeys((scenario.judged_by, "max_error")):
        now = dataclasses.replace(scenario, judged_by=figure, trials=trials)
        of = sweep_figures(now, summarise(dataset, 1.0, metric=figure), 1.0, samples)["schemes"]
        by_figure[figure] = {"unit": scenario.shown(figure)[1]} | {
            which: of[which]["by_trial"] for which in WHICH
        }
    return {
        "scenario": scenario.name,
        "scheme": scheme,
        "trials": trials,
        "samples": samples,
        "weights": {
            name: {"given": tuned.start[name], "tuned": value}
            for name, value in tuned.values.items()
        },
        "held_out": {
            "given": tuned.before,
            "tuned": tuned.after,
            "step": tuned.step,
            "reason": tuned.reason,
        },
        "figures": by_figure,
    }


def tuning_tables(scenario: Scenario, figures: dict[str, Any]) -> list[Table]:
    """The weights, and given against tuned by trial for each figure."""
    weights = Table("weight", title=f"{scenario.title}\n{figures['scheme']}: weights")
    for column in WHICH:
        weights.add_column(column, justify="right")
    weights.add_column("allowed")
    for name, row in figures["weights"].items():
        weights.add_row(
            name,
            *(f"{row[which]:.6g}" for which in WHICH),
            scenario.allowed(f"{figures['scheme']}.{name}"),
        )
    found = [weights]
    for figure, rows in figures["figures"].items():
        what = f"{figure.replace('_', ' ')} [{rows['unit']}] of {figures['samples']} machines never seen"
        table = Table(title=f"{what}: median (95 %, worst)")
        for column in ("trial", *WHICH, "median given / tuned", "worst given / tuned"):
            table.add_column(column, justify="right")
        for j in rows["given"]:
            given, tuned = (rows[which][j] for which in WHICH)
            cells = (
                f"{number(row['median'])} ({number(row['high'])}, {number(row['worst'])})"
                for row in (given, tuned)
            )
            table.add_row(j, *cells, *(_ratio(given[q], tuned[q]) for q in ("median", "worst")))
        found.append(table)
    return found


def worst_case_tables(scenario: Scenario, figures: dict[str, Any]) -> list[Table]:
    """What each search found and what it cost; the numbers of the worst machine."""
    what = f"{figures['figure'].replace('_', ' ')} [{figures['unit']}] at trial {figures['trial']}"
    title = f"{scenario.title}\n{figures['scheme']}: largest {what}, nominal {number(figures['nominal'])}"
    table = Table("search", title=title)
    for column in ("found", "evaluations", "of them until found", "until level with chance"):
        table.add_column(column, justify="right")
    for name, row in figures["searches"].items():
        level = row["level_with_chance"]
        table.add_row(
            name,
            number(row["value"]),
            str(row["evaluations"]),
            str(row["needed"]),
            "never" if level is None else str(level),
        )
    worst = max(figures["searches"].values(), key=lambda row: row["loss"])
    rebuilt = Table("--set", title="the worst machine")
    for setting in worst["set"]:
        rebuilt.add_row(setting)
    return [table, rebuilt]


def _ratio(one: float, other: float) -> str:
    return number(one / other) if other else "–"
