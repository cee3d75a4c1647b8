"""A candidate, tuned by gradient over uncertain machines and kept safe by its frequency test."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ..pytree.named_paths import get_at, replaced
from ..schemes import Scheme
from ..signals.task import Task
from ..theory.law import law_of
from ..tuning import Tuning
from ..tuning.objectives import EveryTrial, Holding, Objective
from ..tuning.over_family import OverFamily
from ..tuning.risks import CVaR
from .candidates import Candidate
from .responses import Family

LATE = 0.25  # share of the trials, the last ones, of which the largest error counts
EARLY = 0.02  # weight of the errors of all trials, beside that
WORST = 0.75  # level of the conditional value at risk: the mean of the worst quarter of machines
UNSAFE = 20.0  # weight of the logarithm of |keep - L P| beyond what is allowed
SHARPNESS = 4000.0  # with 400, it would ask for 2.5 % less than a law that just keeps the bound
STEPS_BACK = (1.0, 0.8, 0.6, 0.4, 0.2)  # ways from the safe weights to the tuned ones, in logarithm


def tuned(
    candidate: Candidate,
    family: Family,
    task: Task,
    trials: int,
    *,
    metric: str,
    margin: float,
    out: Path,
    resume: bool = False,
    progress: Callable[[int, np.ndarray, float], None] | None = None,
    **settings: Any,
) -> Candidate:
    """The candidate with tuned weights, or as near to them as |Q (1 - L P)| <= 1 - margin allows.

    The tuning minimises the largest error of the last trials and, with a smaller weight, the errors
    of all trials, in the mean of the worst quarter of the machines. As it sees a few trials only,
    it may end at weights that diverge later. So the weights are then moved back towards the safe
    ones of the candidate, until the frequency test holds with its margin over the family.

    out: folder of the tuning's state;  resume: go on with what is there
    settings: of `Tuning`, such as the number of machines, which are drawn as those of the family

    A candidate without weights is returned as it is.
    """
    if not candidate.bounds:
        return candidate
    first = max(1, round((1 - LATE) * trials))
    problem = Tuning(
        family.population,
        candidate.scheme,
        task,
        trials,
        weights=candidate.bounds,
        objective=Holding(first, metric) + EARLY * EveryTrial(metric) + penalty(family, 1 - margin),
        risk=CVaR(WORST),
        **settings,
    )
    found = problem.run(out, resume=resume, progress=progress)
    for way in STEPS_BACK:
        weights = {
            name: _between(float(get_at(candidate.scheme, name)), value, way)
            for name, value in found.values.items()
        }
        scheme = replaced(candidate.scheme, weights)
        largest = contraction(family, scheme, task)
        if largest <= 1 - margin:
            return candidate._replace(scheme=scheme, largest=largest)
    return candidate


def penalty(family: Family, below: float) -> Objective:
    """The monotone condition as a term of a tuning.

    It is what a law costs whose |keep - L P| is above a bound on a machine of the family.
    """
    return UNSAFE * OverFamily(family.frequencies, family.P, below, SHARPNESS)


def contraction(family: Family, scheme: Scheme, task: Task) -> float:
    """The largest |Q (keep - L P)| of a scheme on the machines and lines of a family."""
    return float(np.max(family.sizes_of_law(law_of(scheme, task), task.dt)))


def _between(start: float, end: float, way: float) -> float:
    """A weight on the way from one value to another of the same sign, even in its logarithm."""
    if start * end <= 0:
        return start + way * (end - start)
    return float(start * (end / start) ** way)
