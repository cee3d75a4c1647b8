"""The error where it counts, as a quantity, for sweeps, runs, tables and objectives."""

from __future__ import annotations

import dataclasses
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

from ..pytree.closest import not_one_of
from ..signals.sample_times import samples_within
from ..signals.task import Task, Trial
from .metrics import largest, root_mean_square


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

    def __post_init__(self):
        allowed = ("largest", "root mean square")
        if self.of not in allowed:
            raise ValueError(not_one_of(f"CountedMetric: of = {self.of!r}", str(self.of), allowed))

    def __call__(self, trial: Trial) -> jax.Array:
        rows = np.unique(np.concatenate([np.arange(*pair) for pair in self.samples]))
        e = trial.e[rows].reshape(-1, 1)
        return largest(jnp.abs(e)) if self.of == "largest" else root_mean_square(e)[0]


def counted_metrics(task: Task, windows: tuple[tuple[float, float], ...]) -> dict:
    """`counted_max` and `counted_rms`, the error of a task within windows (start, stop) [s].

    Raises ValueError for a window that is not within the task.
    """
    within = [samples_within("windows", window, task) for window in windows]
    samples = tuple((max(s.start, 1), s.stop) for s in within)
    return {
        "counted_max": CountedMetric("largest", samples),
        "counted_rms": CountedMetric("root mean square", samples),
    }
