"""The contour error, and the error where it counts, as quantities of a trial.

They are for sweeps, runs, tables and objectives.
"""

from __future__ import annotations

import dataclasses
from typing import Literal

import jax.numpy as jnp
import numpy as np

from ..pytree.aliases import Array, Value
from ..pytree.closest import need_known
from ..pytree.ranges import require
from ..signals.contour import contour_error
from ..signals.task import Task, Trial, samples_within
from .machine import Machine
from .metrics import largest, root_mean_square

WAYS = ("largest", "root mean square")  # in which one number follows from the errors
LAG = 0.05  # [s], up to which the contour error does not depend on a lag along the path
LEAST = 64  # samples of the window at least


@dataclasses.dataclass(frozen=True)
class ContourMetric:
    """The distance of the outputs from the path of the reference, in one number for a trial.

        max |eps_k|    or    sqrt(mean eps_k^2),    k = 1 .. N

    eps_k is the distance of y_k from the path (`signals.contour_error`), where the path is the
    reference as a curve, without its time. It is the metric of a trial of two or more axes which
    the workpiece shows. Two equal objects share a compiled program.

    of:     "largest" or "root mean square"
    window: half width of the part of the path that is searched around sample k, in samples

    Raises ValueError for another `of`, or a window below 1.
    """

    of: Literal["largest", "root mean square"]
    window: int

    def __post_init__(self) -> None:
        need_known(f"ContourMetric: of = {self.of!r}", self.of, WAYS)
        require("ContourMetric", "window", self.window, "[1, inf)", whole=True)

    def __call__(self, trial: Trial) -> Array:
        distance = contour_error(trial.y, trial.r, window=self.window)
        return _in_one_number(self.of, distance[:, None], trial, slice(1, None))


def contour_metrics(task: Task) -> dict[str, ContourMetric]:
    """`contour_max` and `contour_rms`, for a task of two or more outputs that are a path.

    The window is 0.05 s, but 64 samples at least: a larger lag along the path makes the contour
    error too large, never too small.
    """
    window = int(np.clip(np.ceil(LAG / task.dt), LEAST, max(task.N, 1)))
    return {
        "contour_max": ContourMetric("largest", window),
        "contour_rms": ContourMetric("root mean square", window),
    }


@dataclasses.dataclass(frozen=True)
class CountedMetric:
    """The error of all outputs at some samples of a trial, in one number.

        max |e_k|    or    sqrt(mean e_k^2),    k within the windows

    It is the metric of a point-to-point motion, see `schemes.AtSamples`. Two equal objects share a
    compiled program.

    of: "largest" or "root mean square"
    samples: pairs of the first sample of a window and that after its last one
    """

    of: Literal["largest", "root mean square"]
    samples: tuple[tuple[int, int], ...]

    def __post_init__(self) -> None:
        need_known(f"CountedMetric: of = {self.of!r}", self.of, WAYS)

    def __call__(self, trial: Trial) -> Array:
        rows = np.unique(np.concatenate([np.arange(*pair) for pair in self.samples]))
        return _in_one_number(self.of, trial.e, trial, rows)

    def check(self, machine: Machine, task: Task) -> None:
        """Raises ValueError where a trial of the machine may end before one of the windows."""
        if machine.variation is not None:
            last = max(start for start, _ in self.samples)
            machine.variation.need_measured("the last window of `windows`", last, task)


def counted_metrics(task: Task, windows: tuple[tuple[float, float], ...]) -> dict[str, Value]:
    """`counted_max` and `counted_rms`, the error of a task within windows (start, stop) [s].

    Raises ValueError for a window that is not within the task.
    """
    within = [samples_within("windows", window, task) for window in windows]
    samples = tuple((max(s.start, 1), s.stop) for s in within)
    return {
        "counted_max": CountedMetric("largest", samples),
        "counted_rms": CountedMetric("root mean square", samples),
    }


def _in_one_number(of: str, e: Array, trial: Trial, rows: Value) -> Array:
    """() the largest |e| or the root mean square of what was measured at these rows of a trial.

    It is NaN where nothing was.
    """
    x = e[rows].reshape(-1, 1)
    found = largest(jnp.abs(x)) if of == "largest" else root_mean_square(x)[0]
    if trial.weight is None:
        return found
    share = jnp.mean(jnp.diagonal(trial.weight[rows], axis1=1, axis2=2))
    return found / (share > 0 if of == "largest" else jnp.sqrt(share))
