"""The contour error of a trial as a quantity, for sweeps, runs, tables and objectives."""

from __future__ import annotations

import dataclasses
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

from ..pytree.closest import not_one_of
from ..pytree.ranges import require
from ..signals.contour import contour_error
from ..signals.task import Task, Trial
from .metrics import largest, root_mean_square

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

    def __post_init__(self):
        allowed = ("largest", "root mean square")
        if self.of not in allowed:
            raise ValueError(not_one_of(f"ContourMetric: of = {self.of!r}", str(self.of), allowed))
        require("ContourMetric", "window", self.window, "[1, inf)", whole=True)

    def __call__(self, trial: Trial) -> jax.Array:
        distance = contour_error(trial.y, trial.r, window=self.window)[1:]
        if self.of == "largest":
            return largest(jnp.abs(distance))
        return root_mean_square(distance[:, None])[0]


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
