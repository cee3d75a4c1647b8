"""A measured trial of a campaign and what follows from it."""

from __future__ import annotations

import hashlib
from typing import Any, NamedTuple

import jax
import numpy as np

from ..learning.machine import Actuator
from ..learning.metrics import measure
from ..schemes import Scheme
from ..signals.task import Task, Trial
from . import checks
from .checks import Finding, Rules
from .named_arrays import arrays_of, not_a_number


class Turn(NamedTuple):
    """A measured trial and what follows from it; nothing is stored yet.

    trial: its number
    record: the trial with the signals of the scheme
    memory, schedules: of the next trial
    metrics: of this trial by name, those of `Metrics` and `error`, the RMS error over all outputs
    hashes: of what was measured and of what was played
    findings: what the checks found, refusals among them
    learned: False for a trial that was only looked at
    source: the file of the trial
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

    @property
    def refusals(self) -> list[str]:
        """The texts of the findings for which the trial is refused."""
        return [f.text for f in self.findings if f.kind == "refusal"]


def refuse(findings: list[Finding]) -> None:
    """Raises ValueError with what the checks refuse, if anything."""
    texts = [f.text for f in findings if f.kind == "refusal"]
    if texts:
        raise ValueError("; ".join(texts))


def is_same_trial(stored: dict[str, np.ndarray], record: Trial, *, with_input: bool) -> bool:
    """Whether a measured trial is a stored one, up to the digits that a file may lose.

    with_input: whether the input was measured too, and is compared
    """
    return checks.same(stored["y"], record.y) and (
        not with_input or checks.same(stored["u"], record.u)
    )


def known_as(entry: dict[str, Any]) -> str:
    """How a trial is known already."""
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
    """What is wrong with the memory after a trial, and with the schedules of the next one."""
    wrong = not_a_number(arrays_of(memory))
    text = f"what would be learned is not a number in {wrong}"
    findings = [Finding("refusal", text)] if wrong else []
    return findings + checks.beyond_limits(schedules, task, actuator, rules)


def metrics_of(record: Trial, task: Task, error: float) -> dict[str, Any]:
    """The metrics of a trial as the journal stores them. error: RMS error over all outputs"""
    metrics = measure(record, task)._asdict()
    return {"error": error} | {name: np.asarray(v).tolist() for name, v in metrics.items()}


@jax.jit
def learned(scheme: Scheme, task: Task, memory: Any, trial: Trial):
    """The memory after a trial."""
    return scheme.prepared(task).learn(memory, trial)
