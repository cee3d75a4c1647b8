"""The verdicts of `list`, `run` and `sweep`: one or two sentences, and the next command.

They are made of the numbers that a command has already.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..tables import number
from . import trends
from .case import Case
from .next_command import Verdict
from .trends import Trend, trend_of

ENOUGH = 0.95  # share of machines within the tolerance with which a scheme is not in question


def list_verdict(case: Case, values: Mapping[str, Any], options: Sequence[str]) -> Verdict:
    """How much can be set, and a run with one of the values, as it stands.

    values: values by path, as `Scenario.settable` has them
    options: names of the options of the scenario
    """
    said = (f"{len(values) + len(options)} values can be set in {case.asked.source}.",)
    if not case.learns:
        return Verdict(said, *(case.remedy("") if case.designable else ()))
    heads = [f"{name}." for name in sorted(case.learns, key=lambda name: not case.learns[name])]
    single = [path for path, value in values.items() if np.asarray(value).shape == ()]
    floats = [path for path in single if np.asarray(values[path]).dtype.kind == "f"]
    path = next((p for head in heads for p in floats if p.startswith(head)), None)
    changed = () if path is None else (f"{path}={float(values[path]):.6g}",)
    return Verdict(said, "with another value", case.asked.following("run", set=changed))


def run_verdict(
    case: Case, numbers: dict[str, Any], errors: Mapping[str, Sequence[float]]
) -> Verdict:
    """Which scheme ends with the least error, how far it came, and where it goes.

    numbers: result of `run_numbers`
    errors: errors of the trials by scheme [unit of the case], infinite where a trial diverged
    """
    trials, errors = numbers["trials"], case.of_learned(errors)
    best = min(errors, key=lambda name: (_diverged(errors[name]), errors[name][-1]))
    first, last = errors[best][0], errors[best][-1]
    course = trend_of(errors[best])
    if course.kind == trends.DIVERGES:
        which = best if len(errors) == 1 else "Every scheme"
        said = (f"{which} diverges within {trials} trials.",)
        return Verdict(said, *case.remedy(best))
    if last > trends.EXACT * first:
        course = _with_rms(course, numbers["schemes"][best])
    begun = f", after {case.size(first)} in trial 1" if trials > 1 else ""
    it = f"; {_subject(course)}" if course.words and case.learns[best] else ""
    said = f"{case.head(best)}trial {trials} has a {case.metric} of {case.size(last)}{begun}{it}."
    passed = case.tolerance is None or last <= case.tolerance
    return Verdict(
        _both(said, case.beside_tolerance(last)), *_after_run(case, best, course, passed, trials)
    )


def _with_rms(course: Trend, row: dict[str, Any]) -> Trend:
    """The trend of a metric; it also grows if the rms error of the same run does.

    row: numbers of a scheme of a run
    """
    if course.kind in (trends.FALLS, trends.SETTLED) and row["grown_from"]:
        times, best = number(row["grown_to"]), row["best"]
        words = f"its rms error has grown {times} times since trial {best}"
        return course._replace(kind=trends.GROWS, words=words)
    return course


def _subject(course: Trend) -> str:
    """The words of a trend with a subject."""
    return course.words if course.words.startswith("its ") else f"it {course.words}"


def _after_run(case: Case, best: str, course: Trend, passed: bool, trials: int) -> tuple[str, str]:
    if not case.learns[best] or course.kind == trends.GROWS:
        return case.remedy(best)
    if course.kind == trends.FALLS and (case.tolerance is None or not passed):
        return "until it settles", case.on("run", best, trials=2 * trials)
    if not passed:
        return case.remedy(best)
    if case.uncertain:
        return "many machines", case.on("sweep", best)
    return "what theory claims", case.on("certify", best)


def sweep_verdict(
    case: Case, numbers: dict[str, Any], highs: Mapping[str, Sequence[float]]
) -> Verdict:
    """Which scheme has the largest yield, or the least error on 95 % of the machines.

    numbers: result of `sweep_numbers`
    highs: 95 % quantile of each trial by scheme [unit of the case]
    """
    rows, highs = numbers["schemes"], case.of_learned(highs)
    best = min(rows, key=lambda name: (-(rows[name]["yield"] or 0.0), _last(highs[name])))
    row, course, lost = rows[best], trend_of(highs[best]), _lost(rows[best], case.metric)
    said = f"{case.head(best)}{_yield(case, numbers, row)}{_spread(case, numbers, row)}."
    if lost:
        second = lost
    elif course.words and case.learns[best]:
        second = f"The 95 % {case.metric} {course.words}."
    else:
        second = ""
    enough = row["yield"] is None or row["yield"] >= ENOUGH
    return Verdict(_both(said, second), *_after_sweep(case, best, not lost, enough))


def _yield(case: Case, numbers: dict[str, Any], row: dict[str, Any]) -> str:
    """How many machines end within the tolerance; empty if none is known."""
    if row["yield"] is None:
        return ""
    machines, (low, high) = numbers["samples"], row["yield_interval"]
    which = (
        f"{_percent(row['yield'])} of {machines} machines (95 % interval {_percent(low)} to "
        f"{_percent(high)})"
    )
    if row["yield"] == 1:
        which = f"all {machines} machines"
    return f"{which} end within {case.size(numbers['tolerance'])}; "


def _spread(case: Case, numbers: dict[str, Any], row: dict[str, Any]) -> str:
    """The 95 % quantile of the last trial, and the worst machine."""
    at = row["by_trial"][str(numbers["trials"])]
    which = "of them" if row["yield"] is not None else f"of {numbers['samples']} machines"
    if not math.isfinite(at["high"]):
        return f"fewer than 95 % {which} end with an error that has not diverged"
    worst = case.size(at["worst"]) if math.isfinite(at["worst"]) else "one that has diverged"
    return (
        f"95 % {which} end with a {case.metric} of at most {case.size(at['high'])}, the worst "
        f"(machine {at['worst_sample']}) with {worst}"
    )


def _lost(row: dict[str, Any], metric: str) -> str:
    """A sentence on the machines that diverge or whose metric grows, empty if there are none."""
    parts = []
    if row["diverged"]:
        parts.append(
            f"{_percent(row['diverged'])} of the machines diverge, the first in trial "
            f"{row['diverged_at']}"
        )
    if row["semi_converged"]:
        times = number(row["grown_to"])
        parts.append(
            f"on {_percent(row['semi_converged'])} the {metric} has grown up to {times} times "
            "since its best trial"
        )
    said = "; ".join(parts)
    return f"{said[:1].upper()}{said[1:]}." if said else ""


def _after_sweep(case: Case, best: str, sound: bool, enough: bool) -> tuple[str, str]:
    if not case.learns[best] or not sound:
        return case.remedy(best)
    if not enough:
        if case.designable:
            return case.remedy(best)
        return "the worst machine", case.on("worst-case", best)
    return "what theory claims", case.on("certify", best)


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"


def _both(first: str, second: str) -> tuple[str, ...]:
    """The sentences that are not empty."""
    return tuple(one for one in (first, second) if one)


def _diverged(errors: Sequence[float]) -> bool:
    return not all(math.isfinite(error) for error in errors)


def _last(errors: Sequence[float]) -> float:
    """The error of the last trial, for comparison: infinite where it is no number."""
    return errors[-1] if not math.isnan(errors[-1]) else math.inf
