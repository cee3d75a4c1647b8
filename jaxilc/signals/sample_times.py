"""The sample times of a reference, and the ranges that its parameters share."""

from __future__ import annotations

import numpy as np

from ..pytree.aliases import Numbers
from ..pytree.ranges import require
from ..runtime.capacity import check_size
from .task import Task

FINITE, POSITIVE, NONNEGATIVE = "(-inf, inf)", "(0, inf)", "[0, inf)"
ARRAYS = 32  # of the length of a reference, that making it and one trial of it take


def sample_times(function: str, duration: float, dt: float, arrays: int = ARRAYS) -> Numbers:
    """(N+1,) sample times [s], N = round(duration / dt).

    arrays: how many arrays of that length will be needed

    Raises ValueError for a value outside its range, more samples than fit into memory, or a
    duration that is not a whole number of samples.
    """
    require(function, "dt", dt, POSITIVE, " s")
    require(function, "duration", duration, POSITIVE, " s")
    samples = float(duration) / float(dt)
    check_size(f"{function}: duration = {duration:g} s", 8 * arrays, samples=samples)
    N = round(samples)
    if N < 1 or abs(samples - N) > 1e-6:
        raise ValueError(
            f"{function}: duration = {duration:g} s is not a whole number >= 1 of samples of dt = "
            f"{dt:g} s"
        )
    return np.arange(N + 1) * dt


def samples_within(name: str, window: tuple[float, float], task: Task) -> slice:
    """The samples of a window (start, stop) [s] of a task, both ends included.

    Raises ValueError, with the name, for a window that is not within the task, or has no sample
    that an input can reach.
    """
    start, stop = window
    if not 0 <= start <= stop <= task.duration * (1 + 1e-9) or round(stop / task.dt) < 1:
        raise ValueError(
            f"{name} = ({start:g}, {stop:g}) s is not a window within [0, {task.duration:g}] s "
            "with a sample that an input can reach"
        )
    return slice(round(start / task.dt), round(stop / task.dt) + 1)
