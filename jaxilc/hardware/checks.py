"""The checks of a measured trial before it is learned from, and of the next input of a machine."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from ..learning.machine import Actuator
from ..pytree.ranges import require
from ..schemes import Scheme
from ..schemes.parts import trials_of_step
from ..signals.task import Task, Trial
from .journal import METRICS

AT_LIMIT = 1e-3  # share of the limit; an input that is this close to it counts as saturated
AS_PLAYED = 1e-4  # share of a schedule's peak by which the machine's record of it may differ
# Share of the input's peak by which the recorded input may differ from the replayed one.
AS_COMMANDED = 0.01
# Share of a signal's peak by which two files of one trial may differ; one may have 9 digits only.
SAME = 1e-8
# What `Rules.accept` may name: the refusals of `suspicions`.
ACCEPTED = ("frozen", "jump", "schedule", "growth", "input")
LITTLE = 0.5  # share of the error; if repeated trials differ by more, little can be learned


class Rules(NamedTuple):
    """The rules for what is refused; a number that is None is not checked.

    limit: largest |u| that is played, at which an input counts as saturated [unit of u]; None takes
        the actuator's limit
    correction: largest distance of a learned reference from the task's [unit of y]
    saturation: largest share of samples at the limit, of any input
    accept_saturation: warn of saturation instead of refusing
    repeatability: largest RMS difference of two trials of one schedule, over all outputs, in the
        unit of y
    growth: share by which the RMS error may exceed that of the last trial without a warning
    stop_on_growth: refuse growth instead of warning
    accept: what is not refused but warned of, of `ACCEPTED`; see `suspicions`
    """

    limit: float | None = None
    correction: float | None = None
    saturation: float = 0.05
    accept_saturation: bool = False
    repeatability: float | None = None
    growth: float = 0.02
    stop_on_growth: bool = False
    accept: tuple[str, ...] = ()

    def checked(self) -> Rules:
        """These rules; raises ValueError for a number outside its range."""
        ranges = {"saturation": "[0, 1]", "growth": "[0, inf)"} | dict.fromkeys(
            ("limit", "correction", "repeatability"), "(0, inf)"
        )
        for name, allowed in ranges.items():
            if getattr(self, name) is not None:
                require("", name, getattr(self, name), allowed)
        for name in self.accept:
            if name not in ACCEPTED:
                raise ValueError(f"accept = {name!r} is none of {', '.join(ACCEPTED)}")
        return self

    def limits(self, actuator: Actuator | None, inputs: int) -> np.ndarray | None:
        """(n_u,) the limits that apply to the inputs, None if there are none."""
        limit = self.limit if self.limit is not None else getattr(actuator, "limit", None)
        return None if limit is None else np.broadcast_to(np.asarray(limit, float), (inputs,))


class Finding(NamedTuple):
    """A finding of a check.

    kind: `note`, `warning` or `refusal`
    text: description of the finding, with its numbers
    """

    kind: str
    text: str


def saturation(u, actuator: Actuator | None, rules: Rules) -> list[Finding]:
    """The share of samples of the measured input u (N, n_u) that are at the limit.

    At these samples the input equals the limit, whatever was learned from the error.
    """
    limits = rules.limits(actuator, u.shape[1])
    if limits is None:
        return [
            Finding(
                "note",
                "saturation was not looked at: neither campaign.limit nor the machine gives one",
            )
        ]
    at = np.abs(u) >= limits - np.maximum(AT_LIMIT * limits, _resolution(actuator))
    share, i = float(np.max(np.mean(at, axis=0))), int(np.argmax(np.mean(at, axis=0)))
    if not share:
        return []
    first = int(np.argmax(at[:, i]))
    text = (
        f"input {i} is at its limit {limits[i]:g} in {share:.2%} of the samples, "
        f"first at sample {first}"
    )
    if share > rules.saturation and not rules.accept_saturation:
        return [
            Finding(
                "refusal",
                f"{text}; allowed are {rules.saturation:.2%}, or "
                "--set campaign.accept_saturation=true",
            )
        ]
    return [Finding("warning", text)]


def as_commanded(u, replayed, actuator: Actuator | None, task: Task) -> list[Finding]:
    """Compare the measured input with that of the scheme, replayed over the measured output."""
    off = np.max(np.abs(u - replayed), axis=1)
    allowed = AS_COMMANDED * np.max(np.abs(u), initial=0.0) + np.max(_resolution(actuator))
    if np.max(off) <= allowed:
        return []
    k, unit = int(np.argmax(off)), task.input_unit
    return [
        Finding(
            "warning",
            f"the measured input is up to {off[k]:.3g} {unit} away (sample {k}) from the scheme's "
            "over the measured output: was another schedule played, or is the machine's feedback, "
            "its delay or its limit not the scheme's?",
        )
    ]


def as_played(
    recorded: Mapping[str, np.ndarray],
    schedules: Mapping[str, np.ndarray],
    actuator: Actuator | None,
) -> list[Finding]:
    """Compare the schedules that the machine recorded with those that it was given."""
    findings = []
    for name in recorded.keys() & schedules.keys():
        off = np.max(np.abs(recorded[name] - schedules[name]), axis=1)
        allowed = AS_PLAYED * np.max(np.abs(schedules[name])) + np.max(_resolution(actuator))
        if np.max(off) > allowed:
            k = int(np.argmax(off))
            text = (
                f"{name} is {off[k]:.3g} away at sample {k} from the schedule of this trial: "
                "another one was played"
            )
            findings.append(Finding("refusal", text))
    return findings


def repeated(trial: Trial, last_y, rules: Rules, unit: str) -> list[Finding]:
    """Compare two trials of one schedule, whose difference does not repeat and cannot be learned.

    last_y: (N+1, n_y) output of the other trial
    """
    difference, error = _rms(np.asarray(trial.y) - last_y), _rms(trial.e)
    text = (
        "the same schedule as in the last trial: RMS difference of the outputs "
        f"{difference:.3g} {unit}, RMS error {error:.3g} {unit}"
    )
    if rules.repeatability is not None and difference > rules.repeatability:
        return [Finding("refusal", f"{text}; allowed is {rules.repeatability:.3g} {unit}")]
    return [Finding("warning" if difference > LITTLE * error else "note", text)]


def experiment_numbers(scheme: Scheme, task: Task, live: list[dict[str, Any]]) -> list[int]:
    """Which experiment of its learning step each trial is, and the one after them.

    The number is 0 for a trial that plays what was learned, as all do of most schemes.

    live: manifests of the start and of the trials
    """
    learned = np.cumsum([0, *(bool(m["learned"]) for m in live[1:])])
    return (learned % trials_of_step(scheme, task)).tolist()


def comparable(scheme: Scheme, task: Task, live: list[dict[str, Any]]) -> list[tuple[int, float]]:
    """The numbers and errors of the trials before with which the error of this one is compared.

    Of a scheme that makes experiments these are the trials that played what it had learned; an
    experiment itself is compared with none.

    live: manifests of the start and of the trials before
    """
    *before, now = experiment_numbers(scheme, task, live)
    return [
        (m["trial"], m[METRICS]["error"])
        for m, experiment in zip(live[1:], before, strict=True)
        if not experiment and not now
    ]


def grown(error: float, history: list[tuple[int, float]], rules: Rules, unit: str) -> list[Finding]:
    """Compare the error of this trial with that of the last one.

    history: (trial, RMS error over all outputs) for the trials before, in order
    """
    if not history or error <= (1 + rules.growth) * history[-1][1]:
        return []
    last, (best, least) = history[-1][1], min(history, key=lambda row: row[1])
    text = (
        f"the RMS error grew from {last:.4g} to {error:.4g} {unit}, by {error / last - 1:.1%}; "
        f"the best was trial {best} with {least:.4g} {unit}: "
        f"--undo {best - 1} goes back to what it played"
    )
    return [Finding("refusal" if rules.stop_on_growth else "warning", text)]


def beyond_limits(
    schedules: Mapping[str, np.ndarray], task: Task, actuator: Actuator | None, rules: Rules
) -> list[Finding]:
    """Check the next schedules against the input limit and the largest reference correction."""
    findings = []
    for name, schedule in schedules.items():
        departure, unit, limits = schedule, task.input_unit, None
        if name == "reference":
            unit, departure = task.unit, schedule - np.asarray(task.reference)
            # If several outputs share one reference, the output that is nearest to it counts.
            if departure.shape != schedule.shape:
                departure = departure[:, [np.argmin(np.max(np.abs(departure), axis=0))]]
            limits = (
                None if rules.correction is None else np.full(schedule.shape[1], rules.correction)
            )
        elif name in ("u", "feedforward", "table.u"):
            limits = rules.limits(actuator, schedule.shape[1])
        if not np.all(np.isfinite(schedule)):
            k = int(np.argmin(np.isfinite(schedule).all(axis=1)))
            findings.append(Finding("refusal", f"the next {name} is not finite at sample {k}"))
        elif limits is not None and np.any(np.abs(departure) > limits):
            k, i = np.unravel_index(int(np.argmax(np.abs(departure) / limits)), schedule.shape)
            option = "campaign.limit" if name != "reference" else "campaign.largest_correction"
            away = " away from the task's" if name == "reference" else ""
            text = (
                f"the next {name} is {departure[k, i]:.6g} {unit}{away} at sample {k}; "
                f"allowed are +-{limits[i]:g} {unit} ({option})"
            )
            findings.append(Finding("refusal", text))
    return findings


def _resolution(actuator: Actuator | None):
    step = getattr(actuator, "resolution", None)
    return 0.0 if step is None else np.asarray(step, float)


def same(one, other) -> bool:
    """Whether two records of a signal come from one measurement.

    They do if they agree to eight digits; two different trials of a machine never agree so well.
    """
    return np.shape(one) == np.shape(other) and bool(
        np.max(np.abs(np.asarray(one) - other)) <= same_up_to(one)
    )


def same_up_to(signal) -> float:
    """The largest difference that two records of one measurement may have."""
    return SAME * float(np.max(np.abs(signal)))


def rms_over_all(trial: Trial) -> float:
    """Root mean square error over the samples k = 1..N that were measured, and all outputs."""
    there = slice(1, None) if trial.weight is None else np.any(trial.weight != 0, axis=(1, 2))
    return _rms(np.asarray(trial.e)[there][trial.weight is not None :])


def _rms(signal) -> float:
    return float(np.sqrt(np.mean(np.asarray(signal) ** 2)))
