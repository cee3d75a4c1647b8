"""What `jaxilc learn-law` prints: its progress, a table, and the verdict in sentences."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..design.candidates import Candidate
from ..design.learned import LEARNED, SAFE
from . import design_lines
from .console import out
from .progress import progress_bar
from .titled_table import Table

if TYPE_CHECKING:
    from ..design import Learned, LearnedLaw
    from ..design.judging import Verdict
    from ..scenarios import Scenario

SAME = 1.02  # ratio of two errors up to which they count as equal


class Progress:
    """A context whose value prints what the learning of a law has found so far, and shows a bar."""

    def __init__(self, chosen: Scenario, asked: LearnedLaw):
        self.chosen, self.asked = chosen, asked

    def __enter__(self) -> Progress:
        self.bar = progress_bar("said")
        self.bar.__enter__()
        self.whole = self.bar.add_task("frequency", total=self.asked.steps or None, said="")
        return self

    def __exit__(self, *error) -> None:
        self.bar.__exit__(*error)

    def __call__(self, stage: str, what: Any) -> None:
        if stage == "safe" and isinstance(what, Candidate):
            self.bar.update(self.whole, said=what.name)
        elif stage == "found":
            said = "The taps by frequency response are found"
            if self.asked.steps:
                said += f"; {self.asked.steps} steps through learning follow"
            out.print(f"{said}.", highlight=False, soft_wrap=True)
        elif stage == "tuning":
            step, loss = what
            self.bar.update(
                self.whole, description="learning", completed=step, said=f"loss {loss:.4g}"
            )
        elif stage in ("gate", "proving", "judging"):
            self.bar.update(self.whole, description=stage, said="")


def law_table(chosen: Scenario, found: Learned) -> Table:
    """The errors of the last trial asked for: of the learned law, and of the best safe one."""
    scale, unit = chosen.shown(chosen.judged_by)
    at = f" [{unit}]" if unit else ""
    name = chosen.judged_by.replace("_", " ")
    table = Table(
        "law", "|Q (1 - L P)|", f"median{at}", f"95 %{at}", f"worst{at}",
        title=f"{chosen.name}: {name} of trial {found.trials} on {found.machines} machines",
    )  # fmt: skip
    for role, one in found.verdicts.items():
        largest = found.proof.worst if role == LEARNED and found.proof else one.candidate.largest
        name = role if role == LEARNED else f"{one.candidate.name}, safe"
        errors = (f"{error * scale:.4g}" for error in _errors(one, found.trials).values())
        table.add_row(name, f"{largest:.3f}", *errors)
    return table


def lines_of(chosen: Scenario, found: Learned) -> list[str]:
    """The verdict in sentences, without the next command."""
    if found.law is None:
        return [
            f"The learned law is refused: {found.refused}.",
            "More taps, a smaller --margin, or less uncertainty (a better fit, `jaxilc identify`) "
            "may give one that is not.",
        ]
    assert found.passed is not None
    assert found.proof is not None
    back = ""
    if found.passed.way:
        back = f", taken back by {found.passed.way:.0%} of the way to the start so as to be safe"
    begun = "Safe, but not the best" if _behind(found) else f"Take {LEARNED}"
    lines = [f"{begun}: {found.law.words}{back}. {_errors_said(chosen, found)}"]
    if SAFE in found.verdicts:
        lines.append(_compared(found))
    elif found.window.unit is not None:
        lines.append("There is no law of a few weights for several channels, to compare it with.")
    else:
        lines.append("No law of a few weights is safe on every machine, to compare it with.")
    lines.append(design_lines.safety_said(found.proof))
    return lines


def next_line(found: Learned, plant_file: Path, target: Path) -> str:
    """The next commands."""
    if found.law is None:
        return f"Next: jaxilc design {shlex.quote(str(plant_file))}"
    if _behind(found):
        return f"Next, for the safe law: jaxilc design {shlex.quote(str(plant_file))}"
    return design_lines.next_line(target)


def law_numbers(chosen: Scenario, found: Learned) -> dict[str, Any]:
    """Every number of a learned law, as JSON."""
    scale, unit = chosen.shown(chosen.judged_by)
    filters = None if found.passed is None else found.passed.filters
    return {
        "metric": chosen.judged_by,
        "unit": unit,
        "trials": found.trials,
        "judged_to_trial": found.long,
        "machines": found.machines,
        "refused": found.refused,
        "start": None if found.start is None else found.start.name,
        "errors": {
            role: {"law": one.candidate.name}
            | {name: error * scale for name, error in _errors(one, found.trials).items()}
            for role, one in found.verdicts.items()
        },
        "way_back": None if found.passed is None else found.passed.way,
        "L": None if filters is None else np.asarray(filters.L).tolist(),
        "Q": None if filters is None else np.asarray(filters.keep).tolist(),
        "lead": found.window.lead,
        "proof": found.proof and design_lines.proof_numbers(found.proof),
    }


def _errors(one: Verdict, trial: int) -> dict[str, float]:
    """Of one trial: the error that half, 95 % and all of the machines do not exceed."""
    of = one.summary
    both = {"median": of.median, "error_95": of.high, "worst": of.worst}
    return {name: float(values[trial - 1]) for name, values in both.items()}


def _errors_said(chosen: Scenario, found: Learned) -> str:
    scale, unit = chosen.shown(chosen.judged_by)
    one, name = found.verdicts[LEARNED], chosen.judged_by.replace("_", " ")
    errors = _errors(one, found.trials)

    def size(value: float) -> str:
        return f"{value * scale:.3g} {unit}".rstrip()

    return (
        f"Of {found.machines} machines that it has not seen, half are at or below a {name} of "
        f"{size(errors['median'])} in trial {found.trials} and 95 % at or below "
        f"{size(errors['error_95'])}; to trial {found.long} 95 % stay at or below "
        f"{size(one.error)}."
    )


def _gain(found: Learned) -> float:
    """The median error of the best safe law, in units of that of the learned law."""
    learned, safe = (_errors(found.verdicts[role], found.trials) for role in (LEARNED, SAFE))
    return safe["median"] / learned["median"] if learned["median"] > 0 else np.inf


def _behind(found: Learned) -> bool:
    """Whether the best safe law of a few weights leaves clearly less error."""
    return SAFE in found.verdicts and not _gain(found) > 1 / SAME


def _compared(found: Learned) -> str:
    safe, gain = found.verdicts[SAFE].candidate, _gain(found)
    law = f"the best safe law of a few weights, {safe.name}"
    began = " from which it began" if found.start is safe else ""
    if gain > SAME:
        return f"In the median that is {gain:.3g} times less than with {law}{began}."
    if gain > 1 / SAME:
        return f"In the median that is as much as with {law}{began}: more taps gain nothing here."
    return (
        f"In the median that is {1 / gain:.3g} times more than with {law}{began}: take that one, "
        "or more --taps."
    )
