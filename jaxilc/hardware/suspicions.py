"""What refuses a measured trial by default: that its machine, or its file, is not what it was.

A trial teaches the next input. From a dead encoder, another unit or another schedule a law learns
as eagerly as from a good trial, and the machine then plays it. So a trial is compared with the
reference, with the trial before and with what was played, and each refusal says what was seen, what
is suspected, and the option that accepts it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..learning.playback import unit_of
from ..signals.task import Task
from .checks import Finding

STILL = 0.02  # share of the range of the last trial below which a channel counts as constant
DEAD = 1e-3  # share of the range of the reference, where no trial before has moved
TRAVEL = 0.25  # share of that range over which a channel that stands still ought to have moved
FASTER = 5.0  # times the fastest step of reference and last trial that no motion exceeds
ROUGH = 20.0  # times the median step: in the first trial, a step below it may be noise
MISPLAYED = 0.1  # share of the input's rms by which the recorded input may differ
GROWN, GROWN_BEYOND = 10.0, 3.0  # times the best error; the second for one above the band, too
LEAST = 1e-6  # share of the range of the reference; errors below it are rounding
LEARNED = {"u", "feedforward", "reference"}  # schedules that are learned from errors
LARGER = 1.1  # the next input may exceed what learning from a constant error would give by 10 %
EXPLAINS = 0.7  # share of the power of a difference that its cause explains
SAME_UNIT = 0.02  # share by which a factor between units may differ
UNITS = (10.0, 25.4, 180 / np.pi, 1e3, 1e6)  # what one unit is of another, mostly


def accepting(name: str) -> str:
    """How a refusal ends: the option that accepts what was seen."""
    return f"--set campaign.accept={name} accepts it"


def _refused(name: str, text: str, accept: tuple[str, ...]) -> Finding:
    if name in accept:
        return Finding("warning", f"{text} (accepted)")
    return Finding("refusal", f"{text}; {accepting(name)}")


def frozen(
    name: str, signal, expected, moved, accept: tuple[str, ...], *, still: float = STILL
) -> list[Finding]:
    """Channels that stand still while they ought to move.

    name: name of the signal
    signal, expected: (rows, n) the signal and what it is compared with, in one unit
    moved: (rows, n) what makes the signal move; where it stands still too, nothing is said
    still: share of the expected range below which a channel counts as constant
    """
    found = []
    for i, (s, x) in enumerate(zip(np.transpose(signal), np.transpose(expected), strict=True)):
        called = name if np.shape(signal)[1] == 1 else f"{name}{i}"
        span = np.ptp(x)
        if span == 0 or not np.any(np.ptp(moved, axis=0) > 0):
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


def _longest_run(s) -> tuple[int, int]:
    """The first and the last sample of the longest run of equal values."""
    ends = np.flatnonzero(np.concatenate([np.diff(s) != 0, [True]]))
    starts = np.concatenate([[0], ends[:-1] + 1])
    longest = int(np.argmax(ends - starts))
    return int(starts[longest]), int(ends[longest])


def jumped(y, r, last_y, accept: tuple[str, ...], unit: str) -> list[Finding]:
    """A step of an output that the motion cannot make.

    last_y: (N+1, n_y) output of the trial before, None without one
    """
    found = []
    for i in range(np.shape(y)[1]):
        steps = np.abs(np.diff(y[:, i]))
        usual = np.max(np.abs(np.diff(r[:, i])))
        if last_y is not None:
            usual = max(usual, float(np.max(np.abs(np.diff(last_y[:, i])))))
        grid = float(np.min(steps[steps > 0], initial=np.inf))
        allowed = max(FASTER * usual, 3 * min(grid, usual))
        if last_y is None:
            allowed = max(allowed, ROUGH * float(np.median(steps)))
        k = int(np.argmax(steps))
        if usual > 0 and steps[k] > allowed:
            called = "y" if np.shape(y)[1] == 1 else f"y{i}"
            text = (
                f"{called} jumps by {steps[k]:.3g} {unit} at sample {k + 1}, where reference and "
                f"last trial make steps of {usual:.3g} {unit} at most; suspected is the encoder "
                "(lost counts, noise) or a wrong unit"
            )
            found.append(_refused("jump", text, accept))
    return found


def misplayed(u, commanded, others: Mapping[int, Any], accept: tuple[str, ...]) -> list[Finding]:
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
        f"{size:.3g}; {whose}, or another unit or file"
    )
    return [_refused("schedule", text, accept)]


def grown_beyond(
    error: float, best: float, changed: str, accept: tuple[str, ...], unit: str
) -> list[Finding]:
    """The refusal of an error that is far beyond the best of the campaign.

    changed: what changed, as `what_changed` names it
    """
    text = (
        f"the RMS error is {error:.4g} {unit}, {error / best:.3g} times the best; "
        f"suspected is {changed or 'the encoder, a wrong unit or schedule, or a changed machine'}"
    )
    return [_refused("growth", text, accept)]


def peak(name: str, schedule, task: Task) -> float:
    """The largest value of a schedule; of a reference, the largest distance from the task's."""
    if name == "reference" and np.shape(schedule) == np.shape(task.reference):
        schedule = schedule - np.asarray(task.reference)
    return float(np.max(np.abs(schedule), initial=0.0))


def larger(
    schedules: Mapping[str, Any],
    played: Mapping[str, float],
    learned: int,
    task: Task,
    accept: tuple[str, ...],
) -> list[Finding]:
    """A next schedule that is larger than learning from a constant error would make it.

        peak <= 1.1 j / (j - 1) largest,    j > 1: number of trials that are learned from

    From u_1 = 0 a constant error makes u_{j+1} = j / (j - 1) u_j; one that falls makes less. After
    the first trial twice what it played is allowed; where it played nothing, nothing is a bound.

    played: the largest value of each schedule in the trials so far
    learned: j
    """
    found = []
    for name in LEARNED & schedules.keys():
        largest, reached = played.get(name, 0.0), peak(name, schedules[name], task)
        allowed = LARGER * (1 + 1 / max(1, learned - 1)) * largest
        if largest and reached > allowed:
            unit = unit_of(name, task)
            text = (
                f"the next {name} would reach {reached:.6g} {unit}, where {largest:.6g} {unit} is "
                f"the largest that was played and {allowed:.4g} {unit} is allowed; suspected is "
                "the encoder, a wrong unit, or a law that diverges"
            )
            found.append(_refused("input", text, accept))
    return found


def what_changed(y, last_y) -> str:
    """What explains the difference of two outputs: a gain, another unit, or a lag.

    The difference d = y - y_last is fitted by y_last and by its differences; the one is named that
    explains at least `EXPLAINS` of its power. Friction shows as a lag, as a limit of the force
    does. Returns an empty text where neither explains it.
    """
    i = int(np.argmax(np.sum((y - last_y) ** 2, axis=0)))
    d, old = (x[:, i] - x[0, i] for x in (y - last_y, last_y))
    if not np.any(d) or not np.any(old):
        return ""
    (gain, of_gain), (lag, of_lag) = _fitted(d, old), _fitted(d, -np.gradient(old))
    if max(of_gain, of_lag) < EXPLAINS:
        return ""
    if of_lag > of_gain:
        return f"a lag that is {lag:+.2g} samples longer (delay, friction, or a limit)"
    now = 1 + gain
    if any(abs(now / one - 1) < SAME_UNIT for unit in UNITS for one in (unit, 1 / unit)):
        return f"another unit: y is {now:.4g} times that of the last trial"
    return "" if abs(now) < STILL else f"a gain that changed by {gain:+.0%}"


def _fitted(d, by) -> tuple[float, float]:
    """The factor of the best fit, and the share of the power that it explains."""
    size = float(by @ by)
    if not size:
        return 0.0, 0.0
    factor = float(d @ by) / size
    return factor, factor**2 * size / float(d @ d)


def _rms(signal) -> float:
    return float(np.sqrt(np.mean(np.square(signal))))
