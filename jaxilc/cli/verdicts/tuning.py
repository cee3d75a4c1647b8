"""The verdicts of `tune`, `pareto` and `worst-case`: one or two sentences each.

They are made of the numbers that a command has already.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from ..tables import number
from .case import Case
from .next_command import Verdict

NEAR = 1.05  # factor above the least error within which fewer trials count as enough
FEW = 6  # weights that are named, and settings of the worst machine that a command repeats


def tune_verdict(case: Case, numbers: dict[str, Any], params: Path) -> Verdict:
    """What the tuning gained on machines not seen.

    numbers: result of `tuning_numbers`, whose metric is that of the case
    params: the file of parameters that was written
    """
    metric = case.metric.replace(" ", "_")
    rows, last = numbers["figures"][metric], str(numbers["trials"])
    given, tuned = rows["given"][last], rows["tuned"][last]
    held, scheme = numbers["held_out"], numbers["scheme"]
    if held["step"] == 0:
        said = "No step was better than the weights as given on the machines held out."
        return Verdict((said,), "the worst machine", case.on("worst-case", scheme))
    changed = [
        f"{name} = {number(row['tuned'])} (was {number(row['given'])})"
        for name, row in numbers["weights"].items()
    ]
    more = f" and {len(changed) - FEW} more" if len(changed) > FEW else ""
    median, worst = (
        f"{case.size(tuned[of])} in place of {case.size(given[of])}" for of in ("median", "worst")
    )
    first = (
        f"{', '.join(changed[:FEW])}{more}: of {numbers['samples']} machines not seen, the median "
        f"{case.metric} of trial {last} is {median}, the worst {worst}."
    )
    second = []
    if tuned["worst"] > given["worst"]:
        second.append("The worst machine has become worse: --risk worst or cvar tunes for it.")
    elif held["reason"] == "steps" and held["step"] == held["steps"]:
        second.append("The last step was the best: more --steps may gain more.")
    of = case.asked.without(scheme)
    command = "sweep" if case.uncertain else "run"
    what = "many machines" if case.uncertain else "the whole run"
    following = of.following(command, scheme=scheme, params=params)
    return Verdict((first, *second), what, following)


def front_verdict(
    case: Case, scheme: str, numbers: dict[str, Any], folder: Path, names: tuple[str, str]
) -> Verdict:
    """Between what ends the front lies, and the point that is nearest to the best of both.

    numbers: result of `front_numbers`
    folder: folder with the files of parameters
    names: the two objectives, as they were written
    """
    points = {share: row for share, row in numbers["points"].items() if share != "given"}
    given = numbers["points"]["given"]
    if not points:
        return Verdict(("No point of the front is finite.",))
    share = _knee(points)
    row = points[share]
    said = (
        f"The point of share {share} is nearest to the least of both: {names[0]} is "
        f"{number(row['first'])} and {names[1]} {number(row['second'])}, in place of "
        f"{number(given['first'])} and {number(given['second'])} with the weights as given."
    )
    first, second = ([row[k] for row in points.values()] for k in ("first", "second"))
    ends = (
        f"Over {len(points)} points {names[0]} goes from {number(min(first))} to "
        f"{number(max(first))}, {names[1]} from {number(max(second))} to {number(min(second))}."
    )
    params = folder / f"params-share-{share}.json"
    of = case.asked.without(scheme)
    following = of.following("run", scheme=scheme, params=params, trials=numbers["trials"])
    return Verdict((said, ends) if len(points) > 1 else (said,), "that point", following)


def _knee(points: dict[str, dict[str, Any]]) -> str:
    """The point with the least sum of both objectives, each as a share of its range."""
    names = ("first", "second")
    low = {k: min(row[k] for row in points.values()) for k in names}
    span = {k: max(row[k] for row in points.values()) - low[k] for k in names}

    def far(share: str) -> float:
        parts = [(points[share][k] - low[k]) / span[k] if span[k] > 0 else 0.0 for k in names]
        return sum(x if math.isfinite(x) else math.inf for x in parts)

    return min(points, key=far)


def budget_verdict(case: Case, scheme: str, numbers: dict[str, Any], folder: Path) -> Verdict:
    """The fewest trials with which the error is near the least, on machines not seen.

    numbers: result of `budget_numbers`
    folder: folder with the files of parameters
    """
    rows = {int(J): row for J, row in numbers["budgets"].items()}
    least = min(row["tuned"]["median"] for row in rows.values())
    J = min((J for J, row in rows.items() if row["tuned"]["median"] <= NEAR * least), default=None)
    if J is None:
        return Verdict(("No number of trials leads to a finite error.",))
    tuned, given = rows[J]["tuned"], rows[J]["given"]
    enough = (
        f"{J} trials are enough for a median {case.metric} within 5 % of the least of "
        f"{len(rows)} budgets"
        if len(rows) > 1
        else f"Tuned for {J} trials"
    )
    said = (
        f"{enough}: {case.size(tuned['median'])}, in place of {case.size(given['median'])} with "
        f"the weights as given (worst of {numbers['samples']} machines: {case.size(tuned['worst'])}"
        f" in place of {case.size(given['worst'])})."
    )
    of = case.asked.without(scheme)
    params = folder / f"params-{J}-trials.json"
    following = of.following("run", scheme=scheme, params=params, trials=J)
    return Verdict((said,), "that tuning", following)


def worst_case_verdict(case: Case, scheme: str, numbers: dict[str, Any]) -> Verdict:
    """How much larger the error of the worst machine is, and which search found it.

    numbers: result of `worst_case_numbers`, with the trial
    """
    searches, nominal = numbers["searches"], numbers["nominal"]
    name = max(searches, key=lambda one: searches[one]["loss"])
    worst, trial = searches[name], numbers["trial"]
    times = ""
    if 0 < nominal < math.inf and math.isfinite(worst["value"]):
        times = f", {number(worst['value'] / nominal)} times that of the nominal machine"
    ends = (
        f"has a {case.metric} of {case.size(worst['value'])} in trial {trial}{times}"
        if math.isfinite(worst["value"])
        else f"diverges within {trial} trials"
    )
    said = f"{scheme}: the worst machine {ends}; found by {name}."
    second = case.beside_tolerance(worst["value"])
    if len(worst["set"]) > FEW:
        what, following = "what theory claims", case.on("certify", scheme)
    else:
        settings = (*case.asked.set, *worst["set"])
        what = "that machine"
        following = case.asked.following("run", scheme=scheme, set=settings)
    return Verdict((said, *([second] if second else [])), what, following)
