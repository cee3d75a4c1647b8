"""Repetitive control in running operation: whether it converges, and what is between harmonics.

With e_0 the error under the feedback alone, T the closed loop from what is added to the output, and
the law u' = Q u + L e over a delay W of one period,

    e = S e_0,    S = (1 - Q W) / (1 - (Q - L T) W).

|Q - L T| < 1 at all frequencies is the condition of the same law between trials; as |W| <= 1, it
suffices for any period (small gain; Hara, Yamamoto, Omata, Nakano 1988). At the harmonics of the
period, where W = 1, little is left where Q is near 1. Between them |S| exceeds 1: what does not
repeat with the period becomes larger there, the more the wider Q is (the waterbed). For a period
that is no whole number of samples W has the interpolation of `RepetitiveControl` in it. For P
periods at once W is 1 - prod_i (1 - W_i), so |W| <= 2^P - 1, and |Q - L T| < 1 / (2^P - 1)
suffices.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np

from ..learning.machine import Machine
from ..pytree.in_short import in_short
from ..pytree.ranges import require
from ..schemes import RepetitiveControl, Scheme, WithFeedback
from ..schemes.repetitive import AROUND, delays, lagrange
from ..signals.task import Task
from .frequency import FrequencyTest, learning_condition
from .law import law_response
from .loop import linear_loop, response

POINTS = 32  # frequencies between two harmonics
MOST, AT_ONCE = 2**20, 2**12  # frequencies of a sensitivity, and that are computed at once


class RepetitiveTest(NamedTuple):
    """What repetitive control promises for one machine.

    test: (2^P - 1) |Q - L T| < 1 at all frequencies, with its premises; P = 1 for one period
    period: of what is remembered [s], the sum of several
    frequencies: (F,) [Hz];  sensitivity: (F,) |S|, the error over that of the feedback alone
    worst, worst_at: the largest |S|, and its frequency [Hz]
    harmonics: (H,) multiples of 1 / period below the Nyquist frequency, of each period [Hz]
    left: (H,) |S| at these
    """

    test: FrequencyTest
    period: float
    frequencies: np.ndarray
    sensitivity: np.ndarray
    worst: float
    worst_at: float
    harmonics: np.ndarray
    left: np.ndarray
    __repr__ = in_short


def repetitive_condition(
    machine: Machine, scheme: Scheme, task: Task, *, points: int = POINTS, wrong: float = 0.0
) -> RepetitiveTest:
    """Whether repetitive control beside a feedback converges, and its sensitivity.

    scheme: `WithFeedback(RepetitiveControl(...), feedback)`, or a `RepetitiveControl` alone
    points: frequencies between two harmonics, so that no narrow peak is missed
    wrong: relative error of the period: the true period is (1 + wrong) times that of the scheme,
        and `harmonics` are those of the true one

    Raises ValueError for another scheme, for several channels, for a period of more than 2^20
    frequencies, and as `learning_condition`.
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
    require("repetitive_condition", "points", points, "[2, 1e4]", whole=True)
    repetitive.check(task)
    law = (
        dataclasses.replace(scheme, learning=repetitive.law)
        if isinstance(scheme, WithFeedback)
        else repetitive.law
    )
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
    size, left = (
        np.concatenate([_sensitivity(machine, law, task, each, part) for part in _in_parts(at)])
        for at in (f, true)
    )
    size_of_W = 2 ** len(each) - 1
    filters = repetitive.law
    scaled = dataclasses.replace(filters, L=size_of_W * filters.L, keep=size_of_W * filters.keep)
    whole = dataclasses.replace(scheme, learning=scaled) if law is not filters else scaled
    test = learning_condition(machine, whole, task)
    worst = int(np.argmax(size))
    return RepetitiveTest(test, period, f, size, float(size[worst]), float(f[worst]), true, left)


def _in_parts(f: np.ndarray) -> list[np.ndarray]:
    return np.array_split(f, max(1, -(-len(f) // AT_ONCE)))


def _sensitivity(machine, law: Scheme, task: Task, each: np.ndarray, f) -> np.ndarray:
    """(F,) |S| at frequencies [Hz]."""
    of = law_response(law, task, f)
    Q, L = (np.asarray(part)[:, 0, 0] for part in of)
    T = np.asarray(response(linear_loop(machine, law, task), f, task.dt))[:, 0, 0]
    W = np.zeros(len(f), complex)
    for sign, period in delays(each):
        whole, share = divmod(float(period) / float(task.dt), 1.0)
        late = np.exp(-2j * np.pi * float(task.dt) * np.outer(f, whole + AROUND))
        W += sign * (late @ np.asarray(lagrange(share)))
    return np.abs((1 - Q * W) / (1 - (Q - L * T) * W))
