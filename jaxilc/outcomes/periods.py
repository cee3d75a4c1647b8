"""What `certify` tells of repetitive control: its condition, the waterbed, and a wrong period."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ..theory.condition import HOLDS
from ..theory.repetitive import POINTS, largest_gain, repetitive_condition, side_by_side
from .outcome import Progress
from .words import number

if TYPE_CHECKING:
    from ..scenarios import Scenario
    from ..uncertainty import Population

WRONG = 0.01  # relative error of a period whose price is told
ENOUGH = 2**14  # frequencies, about


def of_periods(
    chosen: Scenario, population: Population, progress: Progress
) -> dict[str, dict[str, Any]]:
    """The condition of each scheme of repetitive control, as numbers by its name.

    tracked: largest change of a period that is tracked [s per s]; None where it stays
    in_parallel: the number of those that stand side by side
    times: by how much the condition is stricter for it
    verdict, reasons: of the condition on the worst machine, and the premises that are broken
    machines, at: number of machines, and the numbers of the worst one
    condition, condition_at: its largest value, and where [Hz]
    grows, grows_at: the largest growth of what does not repeat in the period, and where [Hz]
    left, left_if_wrong: shares of the first harmonic that are left of the nominal machine, with the
        right period and with a true one that is WRONG longer
    no_gain_if_wrong: the first harmonic that is then not made smaller [Hz]; None if there is none
    """
    found = {}
    for name, scheme in chosen.schemes.items():
        beside, _ = side_by_side(scheme)
        if not beside:
            continue
        progress(name)
        harmonics = 0.5 * sum(float(np.sum(one.period)) for one in beside) / float(chosen.task.dt)
        how = {"points": int(np.clip(ENOUGH / harmonics, 2, POINTS))}
        worst, right, wrong = (
            repetitive_condition(machine, scheme, chosen.task, wrong=by, **how)
            for machine, by in (
                (population, 0.0),
                (chosen.machine, 0.0),
                (chosen.machine, WRONG),
            )
        )
        tracking, periods = beside[0].tracking, [np.atleast_1d(one.period) for one in beside]
        condition, lost = worst.test.condition, wrong.harmonics[wrong.left >= 1]
        found[name] = {
            "tracked": None if tracking is None else float(tracking.fastest),
            "times": largest_gain(0.0 if tracking is None else float(tracking.fastest)),
            "period": np.concatenate(periods).astype(float).tolist(),
            "in_parallel": len(beside),
            "verdict": str(condition.verdict),
            "reasons": [f"{one.name}: {one.detail}" for one in condition.broken],
            "machines": population.size,
            "at": worst.at,
            "condition": float(condition.value),
            "condition_at": worst.test.worst,
            "grows": worst.worst,
            "grows_at": worst.worst_at,
            "left": float(right.left[0]),
            "left_if_wrong": float(wrong.left[0]),
            "no_gain_if_wrong": float(lost[0]) if len(lost) else None,
        }
    return found


def period_sentences(name: str, numbers: dict[str, Any]) -> list[str]:
    """The content of `of_periods` for one scheme, in words."""
    count, parallel = numbers["machines"], numbers["in_parallel"]
    several = 1 if parallel > 1 else 2 ** len(numbers["period"]) - 1
    several = numbers["times"] if numbers["tracked"] else several
    period = " and ".join(number(one) for one in numbers["period"]) + " s"
    if numbers["tracked"]:
        period += f", which is tracked and changes by {number(numbers['tracked'])} s/s at most,"
    at = ", ".join(f"{key} = {number(value)}" for key, value in numbers["at"].items())
    times, L = (
        f"{number(several)} " if several > 1 else "",
        "L" if parallel == 1 else f"{parallel} L",
    )
    value = (
        f"{times}|Q (1 - {L} T)| is at most "
        f"{number(numbers['condition'])}, at {number(numbers['condition_at'])} Hz"
        + (f" on the worst ({at})" if at else "")
    )
    if numbers["verdict"] == HOLDS:
        whose = "the nominal machine" if count == 1 else f"all {count} machines"
        head = f"converges from period to period of {period} on {whose}: {value}"
    else:
        why = f"; not held is {'; '.join(numbers['reasons'])}" if numbers["reasons"] else ""
        head = f"is not certified from period to period of {period.rstrip(',')}: {value}{why}"
    lost = numbers["no_gain_if_wrong"]
    beyond = "" if lost is None else f"; that at {number(lost)} Hz is then no smaller"
    return [
        f"{name} {head}.",
        f"{name}: what does not repeat in the period grows up to {number(numbers['grows'])} times, "
        f"at {number(numbers['grows_at'])} Hz. Of the first harmonic {number(numbers['left'])} is "
        f"left, or {number(numbers['left_if_wrong'])} if the true period is {100 * WRONG:g} % "
        f"longer{beyond}.",
    ]
