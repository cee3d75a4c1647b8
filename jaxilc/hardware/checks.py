"""The checks of a measured trial before it is learned from, and of the next input of a machine.

A trial teaches the next input. From a dead encoder, another unit or another schedule a law learns
as eagerly as from a good trial, and the machine then plays it. So a trial is compared with the
reference, with the trial before and with what was played, and each refusal says what was seen, what
is suspected, and the option that accepts it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from ..learning.machine import Actuator
from ..learning.playback import unit_of
from ..pytree.ranges import require
from ..schemes import Scheme
from ..schemes.scheme import trials_of_step
from ..signals.task import Task, Trial
from .journal import METRICS, Manifest, is_part

AT_LIMIT = 1e-3  # share of the limit; an input that is this close to it counts as saturated
AS_PLAYED = 1e-4  # share of a schedule's peak by which the machine's record of it may differ
# Share of the input's peak by which the recorded input may differ from the replayed one.
AS_COMMANDED = 0.01
# Share of a peak by which two files of one trial may differ; the last digit of single precision, as
# a share of a number; and the digits to which one of the files may be rounded.
SAME, SINGLE, DIGITS = 1e-8, 2.0**-23, range(4, 9)
# What `Rules.accept` may name: the refusals of `checks`.
ACCEPTED = ("frozen", "sign", "jump", "schedule", "growth", "input")
LITTLE = 0.5  # share of the error; if repeated trials differ by more, little can be learned


class Rules(NamedTuple):
    """The rules for what is refused; a number that is None is not checked.

    limit: largest |u| that is played [unit of u]; None takes the actuator's limit. At the smaller
        of the two an input counts as saturated
    correction: largest distance of a learned reference from the task's [unit of y]
    saturation: largest share of samples at the limit, of any input
    accept_saturation: warn of saturation instead of refusing
    repeatability: largest RMS difference of two trials of one schedule, over all outputs, in the
        unit of y
    growth: share by which the RMS error may exceed that of the last trial without a warning
    stop_on_growth: refuse growth instead of warning
    accept: what is not refused but warned of, of `ACCEPTED`; see `checks`
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
            require("", name, getattr(self, name), allowed, optional=True)
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
    found = [of.limits(actuator, u.shape[1]) for of in (rules, Rules())]
    if found[0] is None:
        text = "saturation was not looked at: neither campaign.limit nor the machine gives one"
        return [Finding("note", text)]
    limits = np.min([of for of in found if of is not None], axis=0)
    at = np.abs(u) >= limits - np.maximum(AT_LIMIT * limits, _resolution(actuator))
    shares = np.mean(at, axis=0)
    i = int(np.argmax(shares))
    share = float(shares[i])
    if not share:
        return []
    text = (
        f"input {i} is at its limit {limits[i]:g} in {share:.2%} of the samples, "
        f"first at sample {int(np.argmax(at[:, i]))}"
    )
    if share > rules.saturation and not rules.accept_saturation:
        allowed = f"{rules.saturation:.2%}, or --set campaign.accept_saturation=true"
        return [Finding("refusal", f"{text}; allowed are {allowed}")]
    return [Finding("warning", text)]


def spaced(unit: str) -> str:
    """A unit behind its number; empty where there is none, as of an input without one."""
    return f" {unit}" if unit else ""


OF_SCHEME = (
    "the scheme's over the measured output: was another schedule played, or is the machine's "
    "feedback, its delay or its limit not the scheme's?"
)
OF_FEEDBACK = "its schedule with the recorded feedback: is that of another sample, unit or limit?"


def as_commanded(
    u, replayed, actuator: Actuator | None, task: Task, of: str = OF_SCHEME
) -> list[Finding]:
    """Compare the measured input with what it should be, which `of` says."""
    off = np.max(np.abs(u - replayed), axis=1)
    allowed = AS_COMMANDED * np.max(np.abs(u), initial=0.0) + np.max(_resolution(actuator))
    if np.max(off) <= allowed:
        return []
    k, unit = int(np.argmax(off)), spaced(task.input_unit)
    text = f"the measured input is up to {off[k]:.3g}{unit} away (sample {k}) from {of}"
    return [Finding("warning", text + shifted(u, replayed, allowed))]


def shifted(signal, wanted, allowed: float) -> str:
    """By how many samples, up to three, a signal (rows, n) is what it should be but for a shift."""
    pairs = (
        (float(np.max(np.abs(a - b))), s)
        for s in range(1, min(4, len(signal)))
        for a, b in ((signal[s:], wanted[:-s]), (signal[:-s], wanted[s:]))
    )
    off, s = min(pairs, default=(np.inf, 0))
    return f"; it is that one shifted by {s} sample{'s' * (s > 1)}" if off <= allowed else ""


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
    unit = spaced(unit)
    text = (
        "the same schedule as in the last trial: RMS difference of the outputs "
        f"{difference:.3g}{unit}, RMS error {error:.3g}{unit}"
    )
    if rules.repeatability is not None and difference > rules.repeatability:
        return [Finding("refusal", f"{text}; allowed is {rules.repeatability:.3g}{unit}")]
    return [Finding("warning" if difference > LITTLE * error else "note", text)]


def experiment_numbers(scheme: Scheme, task: Task, live: list[Manifest]) -> list[int]:
    """Which experiment of its learning step each trial is, and the one after them.

    The number is 0 for a trial that plays what was learned, as all do of most schemes.

    live: manifests of the start and of the trials
    """
    learned = np.cumsum([0, *(bool(m["learned"]) for m in live[1:])])
    return (learned % trials_of_step(scheme, task)).tolist()


def comparable(scheme: Scheme, task: Task, live: list[Manifest]) -> list[tuple[int, float]]:
    """The numbers and errors of the trials before with which the error of this one is compared.

    They are those of `of_learning`; an experiment is compared with none.

    live: manifests of the start and of the trials before
    """
    now = experiment_numbers(scheme, task, live)[-1]
    return [] if now else of_learning(scheme, task, live)


def of_learning(scheme: Scheme, task: Task, live: list[Manifest]) -> list[tuple[int, float]]:
    """The numbers and errors of the trials that played what was learned, thus no experiments.

    A trial that ended early has the error of a part. Trials before the last one that was accepted
    with a large error are of another machine.
    """
    numbers, begun = experiment_numbers(scheme, task, live), growth_accepted(live)
    return [
        (m["trial"], m[METRICS]["error"])
        for m, experiment in zip(live[1:], numbers, strict=False)
        if m["trial"] >= begun and not experiment and not is_part(m)
    ]


def learned_so_far(
    live: list[Manifest], *now: Mapping[str, float]
) -> tuple[int, dict[str, float], dict[str, float]]:
    """The number of whole trials that were learned from, and the largest value of each schedule.

    The last are the largest values until the first whole trial that was learned from: what the law
    began with, or the part of a trial has taught, is no measure of what a whole one teaches.

    live: manifests of the start and of the trials
    now: largest values of the schedules of a trial that is not among them
    """
    learned = [bool(m["learned"]) and not is_part(m) for m in live[1:]]
    peaks = [*(m.get("peaks", {}) for m in live[1:]), *now]
    begun = peaks[: learned.index(True) + 1] if any(learned) else peaks
    return sum(learned), _largest(peaks), _largest(begun)


def _largest(peaks: list[Mapping[str, float]]) -> dict[str, float]:
    names = dict.fromkeys(name for of in peaks for name in of)
    return {name: max(of.get(name, 0.0) for of in peaks) for name in names}


def grown(error: float, history: list[tuple[int, float]], rules: Rules, unit: str) -> list[Finding]:
    """Compare the error of this trial with that of the last one.

    history: (trial, RMS error over all outputs) for the trials before, in order
    """
    if not history or error <= (1 + rules.growth) * history[-1][1]:
        return []
    last, (best, least) = history[-1][1], min(history, key=lambda row: row[1])
    unit = spaced(unit)
    by = f", by {error / last - 1:.1%}" if last else ""
    text = (
        f"the RMS error grew from {last:.4g} to {error:.4g}{unit}{by}; "
        f"the best was trial {best} with {least:.4g}{unit}: "
        f"--undo {best - 1} goes back to what it played"
    )
    return [Finding("refusal" if rules.stop_on_growth else "warning", text)]


def beyond_limits(
    schedules: Mapping[str, np.ndarray], task: Task, actuator: Actuator | None, rules: Rules
) -> list[Finding]:
    """Check the next schedules against the input limit and the largest reference correction."""
    findings = []
    for name, schedule in schedules.items():
        departure, away, limits, option = schedule, "", None, "campaign.limit"
        if kind(name) == "reference" and rules.correction is not None:
            far = from_references(schedule, task)
            nearest = np.argmin(np.max(np.abs(far), axis=0), axis=-1)
            departure = np.take_along_axis(far, nearest[None, :, None], axis=-1)[..., 0]
            away, option = " away from the task's", "campaign.largest_correction"
            limits = np.full(schedule.shape[1], rules.correction)
        elif kind(name) in INPUTS:
            limits = rules.limits(actuator, schedule.shape[1])
            if rules.limit is None:
                option = (
                    "machine.actuator.limit of the plant; --set campaign.limit=LARGER lets the "
                    "machine clip it, or begin a campaign with a `limit` of the law, if it has one"
                )
        if not np.all(np.isfinite(schedule)):
            k = int(np.argmin(np.isfinite(schedule).all(axis=1)))
            findings.append(Finding("refusal", f"the next {name} is not finite at sample {k}"))
        elif limits is not None and np.any(np.abs(departure) > limits):
            k, i = np.unravel_index(int(np.argmax(np.abs(departure) / limits)), schedule.shape)
            unit = spaced(unit_of(name, task))
            text = (
                f"the next {name} is {departure[k, i]:.6g}{unit}{away} at sample {k}; "
                f"allowed are +-{limits[i]:g}{unit} ({option})"
            )
            findings.append(Finding("refusal", text))
    return findings


def too_fast(
    schedules: Mapping[str, np.ndarray], task: Task, actuator: Actuator | None
) -> list[Finding]:
    """Warn of next schedules of the input that change faster than the actuator can follow."""
    findings = list[Finding]()
    if actuator is None or actuator.rate is None:
        return findings
    for name in (name for name in schedules if kind(name) in INPUTS):
        rate, limit = actuator.limits(jnp.asarray(schedules[name]), task.dt)["actuator.rate"]
        slew, limits = np.abs(rate), np.broadcast_to(limit, rate.shape[1:])
        shares = np.mean(slew > (1 + AT_LIMIT) * limits, axis=0)
        i = int(np.argmax(shares))
        if shares[i]:
            most, unit = np.max(slew[:, i]), spaced(unit_of(name, task))
            text = (
                f"the next {name} changes by up to {most:.3g}{unit} a second, beyond the "
                f"rate {limits[i]:g} of the actuator in {shares[i]:.2%} of the samples, so that "
                "the machine plays another input"
            )
            findings.append(Finding("warning", text))
    return findings


def from_references(schedule, task: Task):
    """(N+1, n, 1) how far references are from those of the task.

    Where there are not as many, (N+1, n, n_y): of all outputs, of which the nearest to each counts.
    """
    r = np.asarray(task.reference)
    if schedule.shape == r.shape:
        return (schedule - r)[..., None]
    return schedule[..., None] - r[:, None]


def _resolution(actuator: Actuator | None):
    step = getattr(actuator, "resolution", None)
    return 0.0 if step is None else np.asarray(step, float)


def same(one, other) -> bool:
    """Whether two records of a signal come from one measurement.

    They do if they agree to eight digits, or, where one has fewer digits or decimals than the other
    one, from four on, to half of its last one. Two trials of a machine agree so well only where
    what differs between them is below the resolution of the encoder.
    """
    if np.shape(one) != np.shape(other):
        return False
    a, b = (np.ravel(np.asarray(x, float)) for x in (one, other))
    for decimals in (True, False):
        steps = np.maximum(x := _steps(a, decimals), y := _steps(b, decimals))
        if np.all(np.abs(a - b) <= _allowed(np.where(x == y, 0.0, steps), a)):
            return True
    return False


def same_up_to(signal, *last: float) -> float:
    """The largest difference that two records of one measurement may have.

    last: `last_digit` of each, since one may be the other one rounded
    """
    return float(_allowed(max(last, default=0.0), signal))


def _allowed(step, signal):
    """Half a step, after what single precision rounds, but less than a step; SAME without one."""
    peak = np.max(np.abs(signal))
    return np.where(step > 0, np.minimum(step / 2 + SINGLE / 2 * peak, 0.95 * step), SAME * peak)


def last_digit(signal) -> float:
    """The value of the last digit of a signal at its peak; 0 where it has more than eight."""
    return float(np.max(_steps(np.ravel(np.asarray(signal, float)), decimals=False)))


def count_of(y) -> float:
    """The count of an encoder of which all steps of y (rows, n_y) are multiples; 0 without one."""
    steps = np.abs(np.diff(y, axis=0))
    least = float(np.min(steps[steps > 0], initial=np.inf))
    for parts in range(1, 101 if np.isfinite(least) else 1):
        counts = steps * parts / least
        if np.max(np.abs(counts - np.round(counts))) < 1e-3:
            return least / parts
    return 0.0


def _steps(x: np.ndarray, decimals: bool) -> np.ndarray:
    """The value of the last digit of each sample, or of the last decimal; 0 beyond eight digits.

    Of numbers in single precision it is twice what that rounds, 2^-23 of each.
    """
    x = np.abs(x)
    places = np.floor(np.log10(np.where(x > 0, x, 1.0))) + 1
    if decimals and np.any(x):
        places = np.full(len(x), np.floor(np.log10(np.max(x))) + 1)
    with np.errstate(over="ignore", invalid="ignore"):
        for digits in DIGITS:
            whole = x * 10.0 ** (digits - places)
            if np.all(np.abs(whole - np.round(whole)) < 1e-6):
                return 10.0 ** (places - digits) * (np.any(x) if decimals else x > 0)
        if not decimals and np.all(np.abs(np.float32(x) - x) <= SAME / 2 * x):
            return SINGLE * x
    return np.zeros(len(x))


def rms_over_all(trial: Trial) -> float:
    """Root mean square error over the samples k = 1..N that were measured, and all outputs."""
    there = slice(1, None) if trial.weight is None else np.any(trial.weight != 0, axis=(1, 2))
    return _rms(np.asarray(trial.e)[there][trial.weight is not None :])


def _rms(signal) -> float:
    with np.errstate(over="ignore"):  # a square may be infinite
        return float(np.sqrt(np.mean(np.asarray(signal) ** 2)))


# What refuses a trial by default: its machine, or its file, is not what it was
# --------------------------------------------------------------------------------------------------

STILL = 0.02  # share of the range of the last trial below which a channel counts as constant
DEAD = 1e-3  # share of the range of the reference, where no trial before has moved
TRAVEL = 0.25  # share of that range over which a channel that stands still ought to have moved
NEARER = 0.5  # share of the error to its own reference that an output has to another's
MOVES = 0.1  # of the reference, up to which the sign of a motion is not judged
FASTER = 5.0  # times the largest usual step of an output, which no motion exceeds
LASTS = 7  # samples, of which a motion makes most steps as large, in one direction
ROUGH = 20.0  # times the median step: in the first trial, a step below it may be noise
MISPLAYED = 0.1  # share of the input's rms by which the recorded input may differ
GROWN, GROWN_BEYOND = 10.0, 3.0  # times the best error; the second for one above the band, too
TIMES = " times the best; "  # in the finding of such an error
LEAST = 1e-6  # share of the range of the reference; errors below it are rounding
LEARNED = {"u", "feedforward", "reference"}  # schedules that are learned from errors
INPUTS = {"u", "feedforward", "table.u"}  # schedules that a limit of the input is for
LARGER = 1.1  # the next input may exceed what learning from a constant error would give by 10 %
EXPLAINS = 0.6  # share of the power of a difference that friction or a lag explains
LEFT_BY_GAIN, LEFT_BY_DELAY = 0.05, 0.02  # shares of that power that a gain and a delay may leave
LIMITED, LATE = (0.3, 0.9), 0.2  # shares: of the first acceleration; of the speed, where it shows
BEGUN, FOLLOWS = 0.02, 0.3  # share of the stroke at its begin, and of that, which is followed then
SLOWER, HELD = 0.92, 2.0  # times the usual: the top speed under a limit, and the time near it
NEAR_TOP = 0.95  # share of the top speed
NARROW, JERK = 0.55, 1.2  # share of the power in a narrow band; peak of the first acceleration
LEAST_SAMPLES = 16  # of a trial whose difference is looked at
STANDS = 0.1  # share of the motion below which nothing is said of a gain
SAME_UNIT = 0.02  # share by which a factor between units may differ
UNITS = (10.0, 25.4, 180 / np.pi, 1e3, 1e6)  # what one unit is of another, mostly


TAKEN = " (accepted)"  # the end of a finding that would have refused its trial


def growth_accepted(live: list[Manifest]) -> int:
    """The last trial that was accepted with an error far beyond the best; 0 if there is none.

    live: manifests of the start and of the trials
    """
    texts = ((m["trial"], text) for m in live[1:] for _, text in m["findings"])
    return max((j for j, text in texts if TIMES in text and text.endswith(TAKEN)), default=0)


def _refused(name: str, text: str, accept: tuple[str, ...]) -> Finding:
    """The refusal, with the option that accepts what was seen; a warning where it is accepted."""
    if name in accept:
        return Finding("warning", f"{text}{TAKEN}")
    return Finding("refusal", f"{text}; --set campaign.accept={name} accepts it")


def frozen(
    name: str,
    signal,
    expected,
    moved,
    accept: tuple[str, ...],
    *,
    still: float = STILL,
    share: float = 1.0,
) -> list[Finding]:
    """Channels that stand still while they ought to move.

    signal: (rows, n) the signal; of a trial that ended early as far as it was measured
    expected: (N, n) what it is compared with, in its unit; nothing is said of less than a quarter
        of its range
    moved: (N, n) what makes the signal move; where it stands still too, nothing is said
    still: share of the expected range below which a channel counts as constant
    share: times what it is compared with, since it was moved by so much less

    Nothing is said of an output that was expected to move by less than two counts of the encoder.
    """
    found = []
    for i, (s, x) in enumerate(zip(np.transpose(signal), np.transpose(expected), strict=True)):
        called = name if np.shape(signal)[1] == 1 else f"{name}{i}"
        steps = np.abs(np.diff(x))
        of_encoder = name == "y" and still == STILL  # and not of the reference
        count = float(np.min(steps[steps > 0], initial=np.inf)) if of_encoder else 0.0
        span, x = share * np.ptp(x), share * x[: len(s)]
        if np.ptp(x) <= max(TRAVEL * span, 2 * count) or not np.any(np.ptp(moved, axis=0) > 0):
            continue
        if np.ptp(s) < still * span:
            seen = f"{called} is constant up to {np.ptp(s):.3g}, where a range of {span:.3g}"
        else:
            first, last = _longest_run(s)
            driven = np.ptp(moved[first : last + 1], axis=0) > TRAVEL * np.ptp(moved, axis=0)
            travelled = np.ptp(x[first : last + 1])
            if travelled <= TRAVEL * span or not np.any(driven):
                continue
            seen = f"{called} stands still from sample {first} to {last}, where {travelled:.3g}"
        source = "the encoder, its cable or" if name == "y" else "what records it:"
        text = f"{seen} was expected; suspected is {source} the column of the file"
        found.append(_refused("frozen", text, accept))
    return found


def as_the_command(y, last_y, commands: Mapping[str, np.ndarray], accept) -> list[Finding]:
    """Outputs that are what was commanded to the last digit: none follows it so well.

    y: (rows, n_y) output, as far as it was measured
    last_y: (N+1, n_y) output of the last whole trial, None before one was learned from; an axis
        that was within 100 counts of its command may have learned it to the last digit
    commands: (N or N+1, n) reference, input and schedules, each by what it is called
    """
    found = []
    for i, s in enumerate(np.transpose(y)):
        near = 100 * max(count_of(s[:, None]), last_digit(s), SAME * np.max(np.abs(s)))
        for called, x in ((of, x) for of, command in commands.items() for x in command.T):
            n = min(len(s), len(x))
            if np.ptp(x[:n]) <= TRAVEL * np.ptp(x) or not same(s[:n], x[:n]):
                continue
            if last_y is None or np.max(np.abs(x[:n] - last_y[:n, i])) > near:
                name = "y" if np.shape(y)[1] == 1 else f"y{i}"
                text = f"{name} is {called} to the last digit; suspected is the column of the file"
                found.append(_refused("frozen", text, accept))
                break
    return found


def exchanged(y, r, accept: tuple[str, ...]) -> list[Finding]:
    """Outputs of which each is nearer to the reference of another one of them than to its own.

    y: (rows, n_y) output, as far as it was measured;  r: (N+1, n_y) reference
    """
    off = np.sqrt(np.mean((y[:, :, None] - r[: len(y), None]) ** 2, axis=0))
    nearest, own = np.argmin(off, axis=1), np.arange(len(off))
    moved = np.flatnonzero(off[own, nearest] < NEARER * off[own, own])
    if not moved.size or sorted(nearest[moved]) != [*moved]:
        return []
    said = ", ".join(f"y{i} follows the reference of y{nearest[i]}" for i in moved)
    return [_refused("frozen", f"{said}; suspected is the order of the columns", accept)]


def of_other_sign(y, expected, r, accept: tuple[str, ...], unit: str) -> list[Finding]:
    """Outputs that are much nearer to the expected ones with their sign changed than as they are.

    From such a record a law learns in the wrong direction. Of n independent samples that have
    nothing to do with the expected ones it is so with a chance below 0.8^n. An output that is
    expected to move by less than a share MOVES of the reference is not judged: a load, or what is
    coupled from another axis, often has a sign that nobody knows.

    y, expected, r: (N+1, n_y) outputs, measured and of the nominal machine, and the reference
    """
    y, r = np.asarray(y), np.asarray(r)
    off, turned, moved, wanted = (
        np.sqrt(np.mean(x**2, axis=0)) for x in (y - expected, y + expected, expected, r)
    )
    text = (
        "{} is {:.3g}{} (rms) away from what the plant file expects, with the other sign {:.3g}; "
        "suspected is the sign of the column, or of the plant's gain in the file"
    )
    names = ["y"] if len(off) == 1 else [f"y{i}" for i in range(len(off))]
    return [
        _refused("sign", text.format(name, far, spaced(unit), near), accept)
        for name, far, near, by in zip(names, off, turned, moved, strict=True)
        if near < NEARER * far and by > MOVES * wanted.max()
    ]


def _longest_run(s) -> tuple[int, int]:
    """The first and the last sample of the longest run of equal values."""
    ends = np.flatnonzero(np.concatenate([np.diff(s) != 0, [True]]))
    starts = np.concatenate([[0], ends[:-1] + 1])
    longest = int(np.argmax(ends - starts))
    return int(starts[longest]), int(ends[longest])


def jumped(y, r, last_y, accept: tuple[str, ...], unit: str) -> list[Finding]:
    """A step of an output that the motion cannot make.

    A motion that lasts for samples, as the coupling of another axis makes it, is no step of an axis
    whose reference rests, up to the largest steps of all outputs. Where an axis is to move itself,
    such a motion may be its own in a wrong unit.

    y: (rows, n_y) output, as far as it was measured
    last_y: (N+1, n_y) output of the last whole trial, None without one
    """
    found, unit = [], spaced(unit)
    moved = [np.max(np.abs(np.diff(x, axis=0)), axis=0) for x in (r, last_y) if x is not None]
    own = np.max(moved, axis=0)
    for i, moves in enumerate(np.diff(y, axis=0).T):
        steps, around = np.abs(moves), sliding_window_view(moves, min(LASTS, len(moves)))
        # a lost count does not change the median, and noise has no mean
        both = np.abs([np.median(around, axis=1), np.mean(around, axis=1)])
        lasting = float(np.max(np.min(both, axis=0)))
        usual = own[i] if np.ptp(r[:, i]) else max(own[i], min(lasting, np.max(own)))
        grid = float(np.min(steps[steps > 0], initial=np.inf))
        allowed = max(FASTER * usual, 3 * min(grid, usual))
        if last_y is None:
            allowed = max(allowed, ROUGH * float(np.median(steps)))
        k = int(np.argmax(steps))
        if own[i] > 0 and steps[k] > allowed:
            called = "y" if np.shape(y)[1] == 1 else f"y{i}"
            text = (
                f"{called} jumps by {steps[k]:.3g}{unit} at sample {k + 1}, where the motion "
                f"makes steps of {usual:.3g}{unit} at most; suspected is the "
                "encoder (lost counts, noise) or a wrong unit"
            )
            found.append(_refused("jump", text, accept))
    return found


def misplayed(
    u, commanded, others: Mapping[int, np.ndarray], accept: tuple[str, ...]
) -> list[Finding]:
    """A recorded input that is not the schedule of this trial, which was its whole input.

    u, commanded: (N, n_u) the recorded input, and that of the scheme
    others: inputs of the trials before, by number, one of which may have been played
    """
    size, off = _rms(commanded), _rms(u - commanded)
    if off <= MISPLAYED * max(size, _rms(u)):
        return []
    found = [j for j, other in others.items() if _rms(u - other) <= 0.1 * off]
    whose = f"it is that of trial {found[0]}" if found else "suspected is another schedule"
    text = (
        f"the recorded input is {off:.3g} (rms) away from the one to play, whose rms is "
        f"{size:.3g}; {whose}, or another sign, unit or file"
    )
    return [_refused("schedule", text, accept)]


def grown_beyond(
    error: float, best: float, changed: Change, accept: tuple[str, ...], unit: str
) -> list[Finding]:
    """The refusal of an error that is far beyond the best of the campaign."""
    cause = changed.text or "the encoder, a wrong unit or schedule, or a changed machine"
    then = f" ({changed.then})" if changed.then else ""
    text = (
        f"the RMS error is {error:.4g}{spaced(unit)}, {error / best:.3g}{TIMES}"
        f"suspected is {cause}{then}"
    )
    return [_refused("growth", text, accept)]


def kind(name: str) -> str:
    """What a schedule is, whatever part plays it: one such as `reference`, or `table.NAME`."""
    within = name.split(".")
    return ".".join(within[within.index("table") :]) if "table" in within else within[-1]


def peak(name: str, schedule, task: Task):
    """() the largest value of what is learned; of a correction of the task's reference, its own.

    A reference of another shape is learned as a whole, from one that need not be the task's.

    schedule: (rows, n) array of NumPy or, in a traced program, of JAX
    """
    if kind(name) == "reference" and schedule.shape == np.shape(task.reference):
        schedule = schedule - np.asarray(task.reference)
    return abs(schedule).max(initial=0.0)


def larger(
    schedules: Mapping[str, np.ndarray],
    steps: int,
    played: Mapping[str, float],
    begun: Mapping[str, float],
    task: Task,
    accept: tuple[str, ...],
    grows: float = 1.0,
) -> list[Finding]:
    """A next schedule that is larger than learning from a constant error would make it.

        peak <= 1.1 g (largest + (largest + |u_1|) / j),    j > 0: learning steps so far

    A constant error adds the same in each step: u_{j+2} - u_1 = (j + 1) / j (u_{j+1} - u_1); one
    that falls adds less. Only a law of higher order makes more: g times as much. What the first
    step teaches has no bound, since u_1 was not learned, nor has anything where all was zero.

    steps: j, as many as trials that were learned from, but for a law that takes several at a time
    played, begun: the largest values so far, and those of u_1, see `learned_so_far`
    grows: g, of `schemes.scheme.growth_of`
    """
    found = []
    for name in (name for name in schedules if kind(name) in LEARNED):
        largest, reached = played.get(name, 0.0), peak(name, schedules[name], task)
        allowed = LARGER * grows * (largest + (largest + begun.get(name, 0.0)) / max(1, steps))
        if steps and largest and reached > allowed:
            unit = spaced(unit_of(name, task))
            text = (
                f"the next {name} would reach {reached:.6g}{unit}, where {largest:.6g}{unit} is "
                f"the largest that was played and {allowed:.4g}{unit} is allowed; suspected is "
                "the encoder, a wrong unit, or a law that diverges"
            )
            found.append(_refused("input", text, accept))
    return found


class Change(NamedTuple):
    """What made an output differ from the one that was expected.

    cause: `gain`, `unit`, `delay`, `limit`, `resonance`, `friction`, `lag`, or empty: none fits
    text: the cause with its size
    then: what to do about it
    """

    cause: str = ""
    text: str = ""
    then: str = ""


def what_changed(y, old, dt: float = 1.0) -> Change:
    """What explains the difference of an output from the one that was expected.

    The first that fits is named: a gain (or a unit) and a delay are the factor and the shift of the
    expected motion that leave at most 5 and 2 % of the power of the difference; a limit of force
    or speed makes the first acceleration smaller, where the motion begins as expected; a resonance
    puts most of the power of the difference of the accelerations into a narrow band; a limit of
    speed holds a top speed that is below the usual one for longer; friction follows the sign of the
    speed and breaks away with a jerk; what else is in step with the speed is a lag of a loop.

    y, old: (N+1, n_y) outputs, measured and expected;  dt: sampling time [s]
    """
    i = int(np.argmax(np.sum((y - old) ** 2, axis=0)))
    now, old = (np.asarray(x, float)[:, i] - x[0, i] for x in (y, old))
    d = now - old
    if len(d) < LEAST_SAMPLES or not np.any(d) or not np.any(old):
        return Change()
    factor, share = _fitted(d, old)
    if share > 1 - LEFT_BY_GAIN:
        return _gain(1 + factor)
    late, share = _shift(d, old)
    if share > 1 - LEFT_BY_DELAY:
        text = f"a delay that is {late * dt * 1e3:+.3g} ms ({late:+.2g} samples) longer"
        return Change("delay", text, "identify the plant again")
    peak, parted, narrow, frequency = _accelerations(now, old, dt)
    if narrow > NARROW and peak > JERK:
        text = f"a resonance at {frequency:.3g} Hz"
        return Change("resonance", text, "look for what is loose, and identify the plant again")
    begun = int(np.argmax(np.abs(old) > BEGUN * np.max(np.abs(old))))
    follows = now[begun] / old[begun]
    if LIMITED[0] < peak < LIMITED[1] and follows > FOLLOWS and parted > LATE:
        text = f"a limit of force or speed: the first acceleration reaches {peak:.0%} of the usual"
        return Change("limit", text, "look at supply, current limit and load; a slower motion fits")
    top, held = _top_speed(now, old)
    if top < SLOWER and held > HELD:
        text = f"a limit of speed: it stays at {top:.0%} of the usual top"
        return Change("limit", text, "look at supply, pressure and load; a slower motion fits")
    lag, share = _fitted(d, -np.gradient(old))
    rubbed = _rubbed(d, old)
    if (peak > JERK or rubbed > share + 0.02) and max(share, rubbed) > EXPLAINS:
        text = "friction (or play) that grew" if lag > 0 else "friction (or play) that fell"
        return Change("friction", text, "look at guides, grease and cover; warm the axis up")
    if share > EXPLAINS:
        text = f"a lag that is {lag:+.2g} samples longer (a gain of a loop, viscous friction)"
        return Change("lag", text, "look at the gains of the drive, and identify the plant again")
    return Change()


def _gain(now: float) -> Change:
    """The change where the output is `now` times the expected one."""
    if any(abs(now / one - 1) < SAME_UNIT for unit in (-1.0, *UNITS) for one in (unit, 1 / unit)):
        text = (
            f"another {'unit' if now > 0 else 'sign'}: y is {now:.4g} times that of the last trial"
        )
        return Change("unit", text, "look at the columns of the file")
    if abs(now) < STANDS:
        return Change()
    return Change("gain", f"a gain that changed by {now - 1:+.0%}", "identify the plant again")


def _shift(d, old) -> tuple[float, float]:
    """The shift of the expected motion [samples] that explains most, and the share it explains."""
    k, most = np.arange(len(old)), len(old) // 8
    start = _fitted(d, -np.gradient(old))[0]
    tried = np.clip(start * np.linspace(0.5, 2.0, 61), -most, most)
    left = [np.sum((np.interp(k - late, k, old) - old - d) ** 2) for late in tried]
    best = int(np.argmin(left))
    return float(tried[best]), float(1 - left[best] / np.sum(d**2))


def _accelerations(now, old, dt: float) -> tuple[float, float, float, float]:
    """How the acceleration differs from the expected one.

    Returns its largest value until the first top speed, over the expected one; the share of that
    speed that is reached when the outputs part; the share of the power of the difference that is
    within 20 % of the frequency of most power, 0 where the motion itself has as high ones; and this
    frequency [Hz].
    """
    n = len(old)
    speed, moved = _smooth(np.gradient(old)), _smooth(np.gradient(now))
    usual, found = _smooth(np.gradient(speed)), _smooth(np.gradient(moved))
    top = max(2, int(np.argmax(np.abs(speed) > 0.97 * np.max(np.abs(speed)))))
    sign = np.sign(speed[top])
    expected = np.max(sign * usual[:top])
    peak = float(np.max(sign * found[:top]) / expected) if expected > 0 else 1.0
    parted = _smooth(np.abs(now - old))
    part = int(np.argmax(parted > 0.03 * np.max(parted)))
    power = np.abs(np.fft.rfft((found - usual) * np.hanning(n))) ** 2
    f, k = np.fft.rfftfreq(n, dt), int(np.argmax(power))
    near = np.abs(f - f[k]) < 0.2 * f[k] + f[1]
    of_motion = f[int(np.argmax(np.abs(np.fft.rfft(usual * np.hanning(n)))))]
    narrow = float(np.sum(power[near]) / np.sum(power)) if f[k] > 1.5 * of_motion else 0.0
    return peak, float(np.abs(speed[part]) / np.max(np.abs(speed))), narrow, float(f[k])


def _top_speed(now, old) -> tuple[float, float]:
    """The top speed over the expected one, and the time near it over the expected time."""
    moved, speed = (np.abs(_smooth(np.gradient(x))) for x in (now, old))
    times = [np.mean(x > NEAR_TOP * np.max(x)) for x in (moved, speed)]
    return float(np.max(moved) / np.max(speed)), float(times[0] / times[1])


def _smooth(x) -> np.ndarray:
    """A signal without its highest frequencies: the mean over a fortieth of its length."""
    window = np.hanning(max(5, len(x) // 40 | 1) + 2)[1:-1]
    padded = np.pad(x, len(window) // 2, mode="edge")
    return np.convolve(padded, window / np.sum(window), "valid")


def _rubbed(d, old) -> float:
    """The share of the difference that a force against the speed explains, through a slow loop."""
    from scipy.signal import lfilter  # which takes half a second to load

    speed = np.gradient(old)
    sign = np.tanh(speed / (0.02 * np.max(np.abs(speed))))
    shares = []
    for rise in (5, 20, 40, 80):
        kept = np.exp(-1 / rise)
        shares.append(_fitted(d, lfilter([1 - kept], [1, -kept], sign))[1])
    return max(shares)


def _fitted(d, by) -> tuple[float, float]:
    """The factor of the best fit, and the share of the power that it explains."""
    size = float(by @ by)
    if not size:
        return 0.0, 0.0
    factor = float(d @ by) / size
    return factor, factor**2 * size / float(d @ d)
