"""What `jaxilc design` prints: its progress, a table of the laws, and the verdict in sentences."""

from __future__ import annotations

import math
import shlex
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..design.candidates import Absent, Candidate
from ..pytree.named_paths import get_at
from .console import out
from .progress import progress_bar
from .titled_table import Table

if TYPE_CHECKING:
    from ..design import Designed, Recommended
    from ..design.judging import Verdict
    from ..design.proof import Proof
    from ..scenarios import Scenario

EDGES = {"low": "notch from", "high": "notch to"}
CAUSES = {
    "law": "the filter and the number of trials",
    "limits": "the limits of the actuator",
    "noise": "noise",
    "machines": "the uncertainty of the machine",
}


class Progress:
    """A context whose value prints what a design has found so far, and shows a bar."""

    def __init__(self, chosen: Scenario, steps: int):
        self.chosen, self.steps = chosen, steps
        self.began, self.lock, self.bars = time.perf_counter(), threading.Lock(), {}
        self.first = True

    def __enter__(self) -> Progress:
        self.bar = progress_bar("said")
        self.bar.__enter__()
        self.whole = self.bar.add_task("frequency", total=None, said="")
        return self

    def __exit__(self, *error) -> None:
        self.bar.__exit__(*error)

    def __call__(self, stage: str, what: Any) -> None:
        with self.lock:
            getattr(self, f"_{stage}")(what)

    def _safe(self, what: Candidate | Absent) -> None:
        self.bar.update(self.whole, said=what.name)
        if self.first and isinstance(what, Candidate):
            self.first = False
            out.print(_first_answer(self.chosen, what), highlight=False, soft_wrap=True)

    def _tuning(self, what: tuple[str, int, int]) -> None:
        name, step, steps = what
        self.bar.update(self.whole, description="tuning", said="")
        if name not in self.bars:
            self.bars[name] = self.bar.add_task(f"tuning {name}", total=steps, said="")
        self.bar.update(self.bars[name], completed=step)

    def _tuned(self, what: Candidate) -> None:
        if what.name in self.bars:
            self.bar.update(self.bars[what.name], completed=self.steps, said="done")

    def _judging(self, what: int) -> None:
        self.bar.update(self.whole, description=f"judging on {what} machines")

    def _judged(self, what: list) -> None:
        self.bar.update(self.whole, description="judged")

    def _proving(self, what: Candidate) -> None:
        self.bar.update(self.whole, description=f"certifying {what.name}")


def _first_answer(chosen: Scenario, what: Candidate) -> str:
    scale, unit = chosen.shown_scale, chosen.shown_unit
    return (
        f"A first safe answer, by frequency alone: {_with_weights(what, chosen)}. "
        f"|Q (1 - L P)| is at most {what.largest:.2f}; predicted rms error of trial "
        f"{chosen.trials}: {what.predicted * scale:.3g} {unit}".rstrip()
        + ". Tuning and judging follow."
    )


def _with_weights(what: Candidate, chosen: Scenario) -> str:
    return ", ".join(filter(None, (what.words, weights_said(what, chosen))))


def weights_said(what: Candidate, chosen: Scenario) -> str:
    """The weights of a law in words, with the units that are known."""
    task = chosen.task
    units = dict.fromkeys(("cutoff", "low", "high"), " Hz")
    per = f" {task.input_unit}/{task.unit}" if task.input_unit and task.unit else ""
    units |= dict.fromkeys(("gamma_p", "gamma_d"), "" if task.input_unit == task.unit else per)
    said = []
    for path in what.bounds:
        name = path.rpartition(".")[2]
        value = f"{float(get_at(what.scheme, path)):.4g}{units.get(name, '')}"
        said.append(f"{EDGES.get(name, name)} = {value}")
    lead = _lead(what.scheme)
    return ", ".join(said + ([f"lead = {lead} samples"] if lead else []))


def _lead(scheme: Any) -> int:
    while scheme is not None:
        if hasattr(scheme, "lead"):
            return int(scheme.lead)
        scheme = getattr(scheme, "learning", None) or getattr(scheme, "scheme", None)
    return 0


def design_table(chosen: Scenario, found: Designed) -> Table:
    """A row for each law that was tried: the recommended one first."""
    scale, unit = chosen.shown(chosen.judged_by)
    name = chosen.judged_by.replace("_", " ")
    table = Table(
        "law", "|Q (1 - L P)|", f"95 % [{unit}]" if unit else "95 %", "settled", "verdict",
        title=f"{chosen.name}: {name} on {found.machines} machines, trials {found.trials} to "
        f"{found.long}",
    )  # fmt: skip
    best = None if found.chosen is None else found.chosen.verdict
    for one in (*((best,) if best else ()), *found.others):
        verdict = "recommended" if one is best else "lost" if one.lost else "larger error"
        table.add_row(
            one.candidate.name,
            f"{one.candidate.largest:.3f}",
            f"{one.error * scale:.4g}",
            f"trial {one.settled_at}",
            verdict,
        )
    for one in found.absent:
        table.add_row(one.name, "", "", "", "no safe weights")
    return table


def lines_of(chosen: Scenario, found: Designed, chosen_law: Recommended) -> list[str]:
    """The verdict in sentences, without the next command."""
    one, limits = chosen_law.verdict, chosen_law.limits
    scale, unit = chosen.shown(chosen.judged_by)

    def size(value: float) -> str:
        return f"{value * scale:.3g} {unit}".rstrip()

    name = chosen.judged_by.replace("_", " ")
    law = one.candidate
    lines = [
        *_reasons(found),
        f"Take {law.name}: {_with_weights(law, chosen)}.",
        f"Of {found.machines} machines that the design has not seen, 95 % stay at or below a {name}"
        f" of {size(one.error)} from trial {found.trials} to {found.long}; half of them stay at or "
        f"below {size(one.median)}, all of them at or below {size(one.worst)}.",
        safety_said(chosen_law.proof),
    ]
    if chosen.tolerance is not None:
        lines.append(
            f"Tolerance {chosen.tolerance:g} {unit}: "
            + (
                f"95 % of the machines are within it from trial {one.tolerated_from} on."
                if one.tolerated_from
                else f"{one.summary.yield_share:.0%} of the machines are within it at the end; "
                "95 % is not reached."
            )
        )
    lines += [
        f"Stop after trial {one.settled_at}: what later trials gain is less than 5 %.",
        f"Most of the error comes from {CAUSES[limits.largest]}: without noise and limits the "
        f"nominal machine reaches {size(limits.law)}, with the limits of the actuator "
        f"{size(limits.limits)}, with noise too {size(limits.noise)}, and 95 % of the uncertain "
        f"machines {size(limits.machines)}.",
    ]
    return lines


def next_line(target: Path) -> str:
    """The next commands."""
    file = shlex.quote(str(target))
    return (
        f"Next: jaxilc run {file}, and then on the machine: "
        f"jaxilc next --state out/campaign --plant-file {file} --out trial-1.csv"
    )


def safety_said(proof: Proof) -> str:
    """How safe a law is, where the margin is least, and what theory claims."""
    nominal, worst = proof.claims
    said = (
        f"|Q (1 - L P)| is at most {proof.worst:.3f}, so the margin is {proof.margin:.3f}; it is "
        f"least at {proof.at:.3g} Hz"
    )
    if proof.machine:
        at = ", ".join(f"{name} = {value:.4g}" for name, value in proof.machine.items())
        said += f" on the worst of {proof.machines} machines ({at})"
    said += f"{_beyond(proof)}. Theory claims for the long run, of the nominal machine: {nominal}"
    said += f"; of the worst: {worst}." if proof.machine else "."
    doubts = {r for c, r in zip(proof.claims, proof.reasons, strict=True) if c == "not claimed"}
    return said + "".join(f" Not claimed because {reason}." for reason in sorted(doubts))


def proof_numbers(proof: Proof) -> dict[str, Any]:
    """The numbers of a proof, as JSON."""
    of_set = None
    if proof.whole is not None:
        of_set = {
            "bound": proof.whole.bound if proof.whole.proved else None,
            "how": proof.whole.how,
        }
    further = None if math.isnan(proof.further) else proof.further
    return proof._asdict() | {"margin": proof.margin, "whole": of_set, "further": further}


def _beyond(proof: Proof) -> str:
    """What is proved of machines that are none of the family."""
    said = ""
    if proof.whole is not None:
        at_most = f"proved to be at most {proof.whole.bound:.3f}, " if proof.whole.proved else ""
        said += (
            f"; of the machines between these it is {at_most or 'not proved: '}{proof.whole.how}"
        )
    if proof.further > 0:
        said += (
            f"; each of them may differ from its model by {100 * proof.further:.2g} % at any "
            "frequency"
        )
    return said


def lost_lines(found: Designed) -> list[str]:
    """Why no law can be recommended, and what to do."""
    return [
        *_reasons(found),
        "No law holds on every machine. Narrow the uncertainty (a better fit, `jaxilc identify`), "
        "lower --margin, or give the axis a feedback that damps its resonance.",
    ]


def _reasons(found: Designed) -> list[str]:
    """Why laws are out of question."""
    return [
        *(f"{one.name}: {one.why}." for one in found.absent),
        *(f"{one.candidate.name}: {one.lost}." for one in found.others if one.lost),
    ]


def design_numbers(chosen: Scenario, found: Designed) -> dict[str, Any]:
    """Every number of a design, as JSON."""
    scale, unit = chosen.shown(chosen.judged_by)

    def of(one: Verdict) -> dict[str, Any]:
        law = one.candidate
        return {
            "law": law.name,
            "weights": {path: float(get_at(law.scheme, path)) for path in law.bounds},
            "lead": _lead(law.scheme),
            "largest_contraction": law.largest,
            "error_95": one.error * scale,
            "error_median": one.median * scale,
            "error_worst": one.worst * scale,
            "settled_at": one.settled_at,
            "tolerated_from": one.tolerated_from,
            "lost": one.lost,
        }

    best = found.chosen
    return {
        "metric": chosen.judged_by,
        "unit": unit,
        "trials": found.trials,
        "judged_to_trial": found.long,
        "machines": found.machines,
        "chosen": None if best is None else of(best.verdict),
        "others": [of(one) for one in found.others],
        "absent": {one.name: one.why for one in found.absent},
        "limits": best and {k: v * scale for k, v in best.limits._asdict().items()},
        "proof": best and proof_numbers(best.proof),
    }
