"""The results of `jaxilc tune`, `pareto` and `worst-case`, as numbers with stable keys.

As in `numbers`, keys keep their names: `samples` counts machines, `figure` names a metric.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ..pytree.named_paths import get_at
from ..sweeps.summary import summarise
from .numbers import sweep_numbers

if TYPE_CHECKING:
    import xarray as xr

    from ..scenarios import Scenario
    from ..tuning import Tuned, Tuning
    from ..tuning.trade_off import Point
    from ..tuning.worst_machine import WorstMachine
    from ..uncertainty import Uncertainty

WHICH = ("given", "tuned")


def tuning_numbers(
    scenario: Scenario, scheme: str, tuned: Tuned, dataset: xr.Dataset
) -> dict[str, Any]:
    """Weights and held-out losses, and quantiles over the machines of a comparison [shown unit].

    Quantiles are stored by metric, by `given` or `tuned`, and by trial.

    dataset: result of `Tuning.compare`
    """
    trials, machines = dataset.sizes["trial"], dataset.sizes["sample"]
    by_metric = {}
    for metric in dict.fromkeys((scenario.judged_by, "max_error")):
        now = dataclasses.replace(scenario, judged_by=metric, trials=trials)
        summary = summarise(dataset, 1.0, metric=metric)
        of = sweep_numbers(now, summary, 1.0, machines)["schemes"]
        by_metric[metric] = {"unit": scenario.shown(metric)[1]} | {
            which: of[which]["by_trial"] for which in WHICH
        }
    return {
        "scenario": scenario.name,
        "scheme": scheme,
        "trials": trials,
        "samples": machines,
        "weights": {
            name: {"given": tuned.start[name], "tuned": value}
            for name, value in tuned.values.items()
        },
        "held_out": {
            "given": tuned.before,
            "tuned": tuned.after,
            "step": tuned.step,
            "steps": len(tuned.loss),
            "reason": tuned.reason,
        },
        "figures": by_metric,
    }


def front_numbers(
    problem: Tuning, points: Sequence[Point], given: Sequence[float], shares: Sequence[float]
) -> dict[str, Any]:
    """Both objectives and the weights for each point of a front, and for the weights as given.

    given: both objectives with the weights as given
    shares: all shares that were asked for
    """
    rows = {"given": {"first": given[0], "second": given[1], "weights": problem.start}}
    rows |= {
        str(p.share): {"first": p.first, "second": p.second, "weights": p.tuned.values}
        for p in points
    }
    left = sorted(set(shares) - {p.share for p in points})
    return {"trials": problem.trials, "points": rows, "left_out": left}


def budget_numbers(
    scenario: Scenario, found: Mapping[int, Tuned], dataset: xr.Dataset
) -> dict[str, Any]:
    """The metric of trial J [shown unit] for each number J of trials of a tuning.

    found: result of `by_trials`
    dataset: sweep of all tuned schemes, named by J as text, and of the scheme `given`
    """
    metric, (scale, unit) = scenario.judged_by, scenario.shown(scenario.judged_by)
    summary = {row.scheme: row for row in summarise(dataset, 1.0, metric=metric)}

    def at(name: str, J: int) -> dict[str, float]:
        return {
            of: scale * float(getattr(summary[name], of)[J - 1])
            for of in ("median", "high", "worst")
        }

    rows = {
        str(J): {
            "given": at("given", J),
            "tuned": at(str(J), J),
            "weights": tuned.values,
            "held_out": {"given": tuned.before, "tuned": tuned.after},
        }
        for J, tuned in found.items()
    }
    return {"figure": metric, "unit": unit, "samples": dataset.sizes["sample"], "budgets": rows}


def worst_case_numbers(found: WorstMachine, uncertainty: Uncertainty) -> dict[str, Any]:
    """The result and cost of each search, with the machine as arguments of `--set`."""
    searches = {
        name: {
            "value": search.value,
            "loss": search.case.loss,
            "evaluations": search.case.evaluations,
            "needed": search.needed,
            "level_with_chance": search.level_with_chance,
            "numbers": search.case.values,
            "set": _settings(search.case.subject, uncertainty),
        }
        for name, search in found.searches.items()
    }
    return {"nominal": found.nominal, "searches": searches}


def _settings(machine, uncertainty: Uncertainty) -> list[str]:
    """The drawn leaves, element by element, as arguments of `--set`."""
    found = []
    for name in uncertainty:
        value = np.asarray(get_at(machine, name))
        for index in np.ndindex(value.shape):
            element = "".join(f"[{i}]" for i in index)
            found.append(f"{name}{element}={float(value[index])!r}")
    return found
