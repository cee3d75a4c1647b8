"""The verdict of `certify`: a sentence on each scheme, and the next command."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ...theory.certificates import CONVERGES, DIVERGES, GROWS, MONOTONE, NOTHING, TURNS
from ..certificate_tables import left_words, senses_words, transient_words
from ..tables import number
from .case import Case
from .next_command import Verdict


def certify_verdict(case: Case, numbers: Mapping[str, dict[str, Any]], scale: float) -> Verdict:
    """Which schemes are certified on every machine, which are not, and why.

    numbers: results of `certificate_numbers` by scheme
    scale: of the errors in them
    """
    certified, said = [], []
    for name, row in numbers.items():
        claims, machines = row["claims"], sum(row["claims"].values())
        if claims[MONOTONE] + claims[CONVERGES] == machines:
            what = (
                f"learning {_how(row)}{senses_words(row)} and leaves "
                f"{left_words(row, scale, case.unit)}"
            )
            first = np.inf if row["first"] is None else row["first"]
            if not (row["floor"] >= first or (row["quantile"] or 0.0) >= first):
                certified.append(name)
                said.append(
                    f"{name} is certified on {_all(machines)}: {what}.{transient_words(row)}"
                )
            else:
                first = f"{number(scale * row['first'])} {case.unit}".rstrip()
                said.append(
                    f"{name} is no gain on {_all(machines)}: {what}, where the first trial has "
                    f"{first}.{transient_words(row)}"
                )
        elif claims[DIVERGES]:
            said.append(f"{name} diverges on {claims[DIVERGES]} of {machines} machines.")
        else:
            reasons = row["reasons"][NOTHING]
            why = max(reasons, key=lambda reason: reasons[reason])
            said.append(
                f"{name} is not certified on {claims[NOTHING]} of {machines} machines: {why}."
            )
    return Verdict(tuple(said), *_after_certify(case, numbers, certified))


def _all(machines: int) -> str:
    return "the nominal machine" if machines == 1 else f"all {machines} machines"


def _how(row: dict[str, Any]) -> str:
    claims = row["claims"]
    if not claims[CONVERGES]:
        return "is monotone" + (f" until {row['held_by']} holds it" if row["held_by"] else "")
    return "converges" if not claims[MONOTONE] else "converges, on most of them in every trial"


def _after_certify(
    case: Case, numbers: Mapping[str, dict[str, Any]], certified: Sequence[str]
) -> tuple[str, str]:
    fit = [name for name in certified if not numbers[name]["transient"]["machines"]]
    if fit:
        best = min(fit, key=lambda name: numbers[name]["floor"])
        if case.asked.of_file:
            words = ("--state", "out/campaign", "--out", "trial-1.csv")
            scheme = case.asked.name_of(best, [*case.learns])
            return "on the machine", case.asked.following("next", *words, scheme=scheme)
        return "the worst machine", case.on("worst-case", best)
    lost = [name for name, row in numbers.items() if _ends_badly(row)]
    if lost:
        if case.designable:
            return case.remedy(lost[0])
        return "the worst machine", case.on("worst-case", lost[0])
    return "many machines by simulation", case.on("sweep", next(iter(numbers)))


def _ends_badly(row: dict[str, Any]) -> bool:
    """Whether a scheme diverges, or its error grows before it falls or at the end, somewhere."""
    grows = row["observed"][TURNS] or row["observed"][GROWS] or row["transient"]["machines"]
    return bool(row["claims"][DIVERGES] or grows)
