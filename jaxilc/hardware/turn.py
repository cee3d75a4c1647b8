"""A measured trial of a campaign, and the memory and schedules that follow from it."""

from __future__ import annotations

import hashlib
from typing import Any, NamedTuple

import jax
import numpy as np

from ..learning.machine import Actuator
from ..learning.metrics import measure
from ..pytree.in_short import in_short
from ..schemes import Scheme
from ..signals.task import Task, Trial
from . import checks
from .checks import Finding, Rules
from .named_arrays import arrays_of, not_a_number


class Turn(NamedTuple):
    """A measured trial and the results that follow from it, before they are stored.

    trial: number of the trial
    record: the trial with the signals of the scheme
    memory, schedules: memory and schedules for the next trial
    metrics: metrics of this trial by name: those of `Metrics`, and `error`, the RMS error over all
        outputs
    hashes: hashes of the measured signals and of the schedules that were played
    findings: findings of the checks, refusals included
    learned: False for a trial that was only inspected
    source: file of the trial
    input: `measured`, or `replayed` where the file had no u and the scheme's law gave it
    """

    trial: int
    record: Trial
    memory: Any
    schedules: dict[str, np.ndarray]
    metrics: dict[str, Any]
    hashes: dict[str, str]
    findings: list[Finding]
    learned: bool
    source: str
    input: str = "measured"
    __repr__ = in_short

    @property
    def refusals(self) -> list[str]:
        """The texts of the findings for which the trial is refused."""
        return [f.text for f in self.findings if f.kind == "refusal"]


def refuse(findings: list[Finding]) -> None:
    """Raises ValueError with the refusals among the findings, if there are any."""
    texts = [f.text for f in findings if f.kind == "refusal"]
    if texts:
        raise ValueError("; ".join(texts))


def is_same_trial(stored: dict[str, np.ndarray], record: Trial, *, with_input: bool) -> bool:
    """Whether a measured trial equals a stored one, up to the rounding of a file.

    with_input: whether the input was measured too and is compared
    """
    return checks.same(stored["y"], record.y) and (
        not with_input or checks.same(stored["u"], record.u)
    )


def known_as(entry: dict[str, Any]) -> str:
    """A text that says as which trial an entry is stored already."""
    if entry["learned"]:
        return "which was learned from already;"
    undo = f"--undo {entry['trial'] - 1}"
    return f"which was looked at already; {undo} forgets it, so that it can be learned from; or"


def hash_of(*arrays) -> str:
    """SHA-256 of the values of arrays, in double precision."""
    return hashlib.sha256(
        b"".join(np.ascontiguousarray(a, dtype=float).tobytes() for a in arrays)
    ).hexdigest()


def of_the_next(
    memory: Any,
    schedules: dict[str, np.ndarray],
    task: Task,
    actuator: Actuator | None,
    rules: Rules,
) -> list[Finding]:
    """The findings on the memory after a trial, and on the schedules of the next one."""
    wrong = not_a_number(arrays_of(memory))
    text = f"what would be learned is not a number in {wrong}"
    findings = [Finding("refusal", text)] if wrong else []
    return findings + checks.beyond_limits(schedules, task, actuator, rules)


def metrics_of(record: Trial, task: Task, error: float) -> dict[str, Any]:
    """The metrics of a trial as the journal stores them.

    error: RMS error over all outputs [unit of y]
    """
    metrics = _measured(record, task)._asdict()
    return {"error": error} | {name: np.asarray(v).tolist() for name, v in metrics.items()}


_measured = jax.jit(measure)  # one program instead of one for each operation


@jax.jit
def learned(scheme: Scheme, task: Task, memory: Any, trial: Trial):
    """The memory after a trial."""
    return scheme.prepared(task).learn(memory, trial)
