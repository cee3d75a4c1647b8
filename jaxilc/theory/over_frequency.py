"""A curve over frequency: its grid of lines, its largest value, and where it first reaches 1."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ..signals.task import Task
from .condition import Condition, Premise, condition
from .enclosure import Arc, size, supremum
from .loop import Loop


class FrequencyTest(NamedTuple):
    """A condition with the curve behind it.

    condition:   on the supremum, whose value is enclosed from above
    frequencies: (F,) [Hz]
    magnitude:   (F,) what must stay below 1
    worst:       frequency of the supremum [Hz]
    critical:    first frequency at which the magnitude reaches 1 [Hz]; inf if it never does
    """

    condition: Condition
    frequencies: np.ndarray
    magnitude: np.ndarray
    worst: float
    critical: float


def grid(task: Task, *, points: int = 1000, near=()) -> np.ndarray:
    """(F,) frequencies [Hz] from 0.001 / duration to the Nyquist frequency.

    They are equidistant in the logarithm, and denser around the poles z that `near` gives.
    """
    nyquist, near = 0.5 / task.dt, np.asarray(near, complex)
    near = near[np.abs(near) > 1e-3]
    centre, width = np.abs(np.angle(near)), np.abs(np.log(np.abs(near)))
    around = (centre[:, None] + width[:, None] * np.linspace(-3, 3, 31)).ravel() / (
        2 * np.pi * task.dt
    )
    lowest = 1e-3 / task.duration
    return np.unique(
        np.concatenate(
            [np.geomspace(lowest, nyquist, points), around[(around > lowest) & (around < nyquist)]]
        )
    )


class Largest(NamedTuple):
    """The largest value of a curve.

    value:    the supremum, enclosed from above
    worst:    its frequency [Hz]
    critical: frequency at which 1 is first reached [Hz]
    radius:   largest |pole| of the loops
    """

    value: float
    worst: float
    critical: float
    radius: float


def on_supremum(
    bounds: Callable,
    theorem: str,
    loops: list[Loop],
    task: Task,
    premises: list[Premise],
    of_whole: Callable,
    frequencies,
) -> FrequencyTest:
    """The condition on the supremum of a function of the angle.

    bounds:   the function, as `enclosure.supremum` takes it
    of_whole: () -> further premises, on the whole trial; not called where the condition fails
              anyway
    """
    f = lines(task, frequencies, loops)
    curve, found = enclosed(bounds, loops, task, f)
    premises = [*premises, *(of_whole() if found.value < 1 else [])]
    return FrequencyTest(
        condition(found.value, theorem, premises=premises), f, curve, found.worst, found.critical
    )


def enclosed(bounds: Callable, loops: list[Loop], task: Task, f):
    """The curve on the lines f (F,) [Hz], and its largest value.

    Where a loop is unstable nothing is claimed, and the largest value is that on the lines.
    """
    to_angle, radius = 2 * np.pi * task.dt, max(map(radius_of, loops))

    def magnitude(f):
        angle = to_angle * np.asarray(f, float)
        return np.nan_to_num(bounds(angle, np.zeros_like(angle))[0], nan=np.inf, posinf=np.inf)

    curve = magnitude(f)
    value, worst = float(np.max(curve)), float(f[np.argmax(curve)])
    if radius < 1 - 1e-9:
        found = supremum(bounds, 0.0, np.pi)
        worst = found.angle / to_angle if found.value > value else worst
        value = max(found.bound, value)
    return curve, Largest(value, worst, _first_crossing(magnitude, f, curve, worst), radius)


def lines(task: Task, frequencies, loops: list[Loop]) -> np.ndarray:
    """The frequencies asked for, checked; or a `grid` that is denser around the poles."""
    if frequencies is None:
        return grid(
            task,
            near=np.concatenate(
                [[], *(np.linalg.eigvals(loop.A) for loop in loops if np.all(np.isfinite(loop.A)))]
            ),
        )
    f = np.asarray(frequencies, float)
    if (
        f.ndim != 1
        or len(f) < 2
        or f[0] <= 0
        or f[-1] > 0.5 / task.dt * (1 + 1e-9)
        or np.any(np.diff(f) <= 0)
    ):
        raise ValueError(
            f"frequencies = {f} must ascend within (0, {0.5 / task.dt:g}] Hz, Nyquist at dt = "
            f"{task.dt:g} s"
        )
    return f


def weight_on(weight, centre, h, dt) -> np.ndarray:
    """(F,) a weight on arcs.

    weight: a number; or a function of f [Hz], of which the largest value at the middle and the ends
            of each arc is taken
    """
    if not callable(weight):
        return np.broadcast_to(np.asarray(weight, float), np.shape(centre))
    at = np.clip(np.stack([centre - h, centre, centre + h]), 0.0, np.pi) / (2 * np.pi * dt)
    return np.max(np.stack([np.broadcast_to(weight(f), f.shape) for f in at]), axis=0).astype(float)


def radius_of(loop: Loop) -> float:
    return (
        float(np.max(np.abs(np.linalg.eigvals(loop.A)), initial=0.0))
        if np.all(np.isfinite(loop.A))
        else np.inf
    )


def largest_on(arc: Arc, h):
    """What `supremum` asks of a response on arcs: values at the centres, and upper bounds."""
    return size(arc.value), np.max(arc.ends(h), axis=0) + h**2 * arc.curve


def _first_crossing(magnitude, f, curve, worst) -> float:
    """The first frequency at which the curve reaches 1, refined between the lines.

    Where no line reaches 1, it is the frequency of the peak, if that does.
    """
    if not np.any(curve >= 1):
        return float(worst) if magnitude([worst])[0] >= 1 else np.inf
    i = int(np.argmax(curve >= 1))
    low, high = f[max(i - 1, 0)], f[i]
    for _ in range(4 if i else 0):
        fine = np.linspace(low, high, 33)
        i = max(int(np.argmax(magnitude(fine) >= 1)), 1)
        low, high = fine[i - 1], fine[i]
    return float(high)
