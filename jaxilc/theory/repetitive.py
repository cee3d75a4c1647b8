"""Repetitive control in running operation: whether it converges, and what is between harmonics.

With e_0 the error under the feedback alone, T the closed loop from what is added to the output, and
the law u' = Q u + L e over a delay W of one period,

    e = S e_0,    S = (1 - Q W) / (1 - (Q - L T) W).

|Q - L T| < 1 at all frequencies is the condition of the same law between trials, but what happens
at the ends of a trial does not matter here. As |W| <= 1, it suffices for any period (small gain;
Hara, Yamamoto, Omata, Nakano 1988). At the harmonics of the period, where W = 1, little is left
where Q is near 1. Between them |S| exceeds 1: what does not
repeat with the period becomes larger there, the more the wider Q is (the waterbed). For a period
that is no whole number of samples W has the interpolation of `RepetitiveControl` in it. For P
periods at once W is 1 - prod_i (1 - W_i), so |W| <= 2^P - 1, and |Q - L T| < 1 / (2^P - 1)
suffices. On measured lines T = P / (1 + C P), and a response P that is off by s makes T off by at
most s / (|1 + C P| (|1 + C P| - |C| s)).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from ..learning.machine import Machine
from ..plants import StateSpace
from ..pytree.in_short import in_short
from ..pytree.ranges import require
from ..schemes import LearningFilter, RepetitiveControl, Scheme, WithFeedback
from ..schemes.repetitive import AROUND, delays, lagrange
from ..signals.task import Task
from ..uncertainty import Population, drawn_machines
from .condition import condition, premise
from .frequency import FrequencyTest, on_supremum, parts_of
from .law import law_response
from .learning_map import limit_names
from .loop import linear_loop, on_circle, response
from .on_lines import MeasuredResponse
from .outlook import NO_LIMIT

POINTS = 32  # frequencies between two harmonics
FROM_PERIOD_TO_PERIOD = (
    "sup |Q - L T| < 1: by small gain the loop through the delay of a period is stable, and each "
    "frequency comes nearer to its limit by about this factor or more in every period (Hara, "
    "Yamamoto, Omata, Nakano 1988)"
)
ON_LINES = (
    "|Q - L T| < 1 on the measured lines and within their doubt: between periods each of these "
    "frequencies comes nearer to its limit by this factor or more, if the loop is stable"
)
MOST, AT_ONCE = 2**20, 2**12  # frequencies of a sensitivity, and that are computed at once


class RepetitiveTest(NamedTuple):
    """What repetitive control promises for one machine, for a family, or on measured lines.

    test: (2^P - 1) |Q - L T| < 1 at all frequencies, with its premises; P = 1 for one period. Of a
        family it is that of its worst machine; on lines it has the doubt of each line in it
    period: of what is remembered [s], the sum of several
    frequencies: (F,) [Hz];  sensitivity: (F,) |S|, the error over that of the feedback alone, of a
        family the largest
    worst, worst_at: the largest |S|, and its frequency [Hz]
    harmonics: (H,) multiples of 1 / period below the Nyquist frequency, of each period [Hz]
    left: (H,) |S| at these
    at: the numbers of the worst machine of a family, by name
    """

    test: FrequencyTest
    period: float
    frequencies: np.ndarray
    sensitivity: np.ndarray
    worst: float
    worst_at: float
    harmonics: np.ndarray
    left: np.ndarray
    at: dict[str, float]
    __repr__ = in_short


def repetitive_condition(
    machine: Machine | Population | MeasuredResponse,
    scheme: Scheme,
    task: Task,
    *,
    points: int = POINTS,
    wrong: float = 0.0,
    sigmas: float = 3.0,
) -> RepetitiveTest:
    """Whether repetitive control beside a feedback converges, and its sensitivity.

    machine: one; a `Population`, for the worst of those that are drawn; or the measured response of
        one without its feedback. Lines claim nothing: they tell the value of the condition, and,
        joined by straight lines, the sensitivity between the first and the last of them
    scheme: `WithFeedback(RepetitiveControl(...), feedback)`, or a `RepetitiveControl` alone
    points: frequencies between two harmonics, so that no narrow peak is missed
    wrong: relative error of the period: the true period is (1 + wrong) times that of the scheme,
        and `harmonics` are those of the true one
    sigmas: standard deviations by which a measured line may be off

    Raises ValueError for another scheme, for several channels, for a period of more than 2^20
    frequencies, for lines without a harmonic or above the Nyquist frequency, and where machine,
    scheme and task do not fit.
    """
    repetitive = scheme.learning if isinstance(scheme, WithFeedback) else scheme
    if not isinstance(repetitive, RepetitiveControl):
        raise ValueError(
            f"repetitive_condition: scheme is a {type(scheme).__name__}; allowed are a "
            "RepetitiveControl and WithFeedback(RepetitiveControl(...), feedback)"
        )
    if task.inputs != 1 or task.outputs != 1:
        raise ValueError(
            f"repetitive_condition: the task has {task.inputs} inputs and {task.outputs} outputs; "
            "allowed is one of each"
        )
    require("repetitive_condition", "wrong", wrong, "(-1, inf)")
    require("repetitive_condition", "sigmas", sigmas, "[0, inf)")
    require("repetitive_condition", "points", points, "[2, 1e4]", whole=True)
    repetitive.check(task)
    each, dt = np.atleast_1d(np.asarray(repetitive.period, float)), float(task.dt)
    period = float(np.sum(each))
    count = int(0.5 / dt * points * period)
    if count > MOST:
        raise ValueError(
            f"repetitive_condition: points = {points} make {count:,} frequencies of a period of "
            f"{period / dt:g} samples; allowed are {MOST:,}"
        )
    f = np.arange(1, count + 1) / (points * period)
    longer = (1 + wrong) * each
    true = np.unique(
        np.concatenate([np.arange(1, int(0.5 / dt * one) + 1) / one for one in longer])
    )
    filters, size_of_W = repetitive.law, 2 ** len(each) - 1
    law, whole = (
        dataclasses.replace(scheme, learning=of) if isinstance(scheme, WithFeedback) else of
        for of in (filters, _times(size_of_W, filters))
    )
    machines: list[Any] = [machine]
    drawn: Mapping[str, np.ndarray] = {}
    if isinstance(machine, Population):
        machines, drawn = [machine.machine_of(i) for i in range(machine.size)], machine.drawn
    if isinstance(machine, MeasuredResponse):
        f, true = (_within(machine, of, dt) for of in (f, true))
        tests = [_on_lines(machine, whole, task, sigmas)]
    else:
        tests = [_on_circle(one, whole, task) for one in machines]
    # one that does not hold is worse than any that does
    top = max(range(len(tests)), key=lambda i: (not (c := tests[i].condition).holds, c.value))
    loops = [_loop_of(one, law, task) for one in machines]
    size, left = (
        np.concatenate([_sensitivity(loops, law, task, each, part) for part in _in_parts(of)])
        for of in (f, true)
    )
    worst, at = int(np.argmax(size)), {name: float(of[top]) for name, of in drawn.items()}
    of_size = float(size[worst]), float(f[worst])
    return RepetitiveTest(tests[top], period, f, size, *of_size, true, left, at)


def _times(size: int, of: LearningFilter) -> LearningFilter:
    return dataclasses.replace(of, L=size * of.L, keep=size * of.keep)


def _in_parts(f: np.ndarray) -> list[np.ndarray]:
    return np.array_split(f, max(1, -(-len(f) // AT_ONCE)))


def _loop_of(
    machine: Machine | MeasuredResponse, law: Scheme, task: Task
) -> Callable[[np.ndarray], np.ndarray]:
    """T at frequencies [Hz]."""
    if not isinstance(machine, MeasuredResponse):
        loop = linear_loop(machine, law, task)
        return lambda f: np.asarray(response(loop, f, task.dt))[:, 0, 0]
    C, lines = _feedback_of(law, task), machine.frequencies

    def closed(f):
        P = np.interp(f, lines, machine.response.real) + 1j * np.interp(
            f, lines, machine.response.imag
        )
        return P / (1 + C(f) * P)

    return closed


def _feedback_of(law: Scheme, task: Task) -> Callable[[np.ndarray], np.ndarray]:
    """C at frequencies [Hz], read off the loop around a delay of one sample: C = 1 / T - z."""
    delay = Machine(StateSpace([[0.0]], [[1.0]], [[1.0]], dt=task.dt))
    T = _loop_of(delay, law, task)
    return lambda f: 1 / T(f) - np.asarray(on_circle(f, task.dt))


def _within(measured: MeasuredResponse, f: np.ndarray, dt: float) -> np.ndarray:
    low, high = measured.frequencies[[0, -1]]
    within = f[(f >= low) & (f <= high)]
    if high > 0.5 / dt or not len(within):
        raise ValueError(
            f"repetitive_condition: the lines go from {low:g} to {high:g} Hz; allowed are those up "
            f"to {0.5 / dt:g} Hz, the Nyquist frequency, with a harmonic of the period among them"
        )
    return within


def _on_circle(machine: Machine, law: Scheme, task: Task) -> FrequencyTest:
    """sup |Q - L T| < 1. An operation without ends asks for nothing else, but a linear loop."""
    parts = parts_of(machine, law, task)
    names = limit_names(drawn_machines(machine, {}, {}), law, task)
    free = premise(NO_LIMIT, not names, ", ".join(names))
    about = [parts.loop], task, [*parts.premises, free], list, None
    return on_supremum(parts.bounds, FROM_PERIOD_TO_PERIOD, *about)


def _on_lines(measured: MeasuredResponse, law: Scheme, task: Task, sigmas: float) -> FrequencyTest:
    """|Q - L T| with the doubt of each line; nothing is claimed of what lines do not tell."""
    f, P, std = measured.frequencies, measured.response, measured.std
    Q, L = (np.asarray(part)[:, 0, 0] for part in law_response(law, task, f))
    C, off = _feedback_of(law, task)(f), sigmas * std
    loop = np.abs(1 + C * P)
    surely = loop - np.abs(C) * off
    with np.errstate(divide="ignore"):
        doubt = np.where(surely > 0, off / (loop * np.maximum(surely, 0)), np.inf)
    size = np.abs(Q - L * P / (1 + C * P)) + np.abs(L) * doubt
    top, above = int(np.argmax(size)), f[size >= 1]
    known = measured.averages_known and np.any(std)
    said = "lines do not tell it" + ("" if known else ", and their doubt is not known")
    told = premise("loop stable, and nothing between the lines or beyond them", False, said)
    claim = condition(size[top], ON_LINES, premises=[told])
    return FrequencyTest(claim, f, size, float(f[top]), float(above[0]) if len(above) else np.inf)


def _sensitivity(loops, law: Scheme, task: Task, each: np.ndarray, f: np.ndarray) -> np.ndarray:
    """(F,) the largest |S| of closed loops T at frequencies [Hz]."""
    Q, L = (np.asarray(part)[:, 0, 0] for part in law_response(law, task, f))
    W = np.zeros(len(f), complex)
    for sign, period in delays(each):
        whole, share = divmod(float(period) / float(task.dt), 1.0)
        late = np.exp(-2j * np.pi * float(task.dt) * np.outer(f, whole + AROUND))
        W += sign * (late @ np.asarray(lagrange(share)))
    return np.max([np.abs((1 - Q * W) / (1 - (Q - L * T(f)) * W)) for T in loops], axis=0)
