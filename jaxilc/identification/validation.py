"""A second record judges a plant: how well it predicts what it was not fitted to."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..plants import Plant
from ..pytree.in_short import in_short
from .problem import checked_record, free_elements, problem_of
from .records import Record
from .verdict import fit_of

MUCH = 2.0  # rms error over that of the record that was fitted, from which on a plant is doubted


class Validation(NamedTuple):
    """How well a plant predicts a record.

    simulated: (N+1, n_y) the output of the plant, with the bias that makes the mean residual 0
    fit: (n_y,) 100 (1 - |y - simulated| / |y - mean y|) [%]
    rms: (n_y,) rms error of prediction [unit of y]
    """

    simulated: np.ndarray
    fit: np.ndarray
    rms: np.ndarray
    __repr__ = in_short


def validated(record: Record, plant: Plant, share: float = 0.0) -> Validation:
    """How well a plant predicts a record that begins at rest, or the last part of it.

    share: [0, 1), first part of the record, which is not judged; the bias is then that of it
    Raises ValueError for a record that does not fit the plant.
    """
    record = checked_record(record)
    first = free_elements(plant, None)[:1]
    problem = problem_of(record, plant, first, share or 1.0)
    residual = problem.residual(problem.start(plant))
    late = slice(problem.samples if share else 0, None)
    fit = fit_of(record.y[late], residual[late])
    rms = np.sqrt(np.mean(residual[late] ** 2, axis=0))
    return Validation(record.y - residual, fit, rms)
