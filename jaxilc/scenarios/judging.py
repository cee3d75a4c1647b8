"""The metric by which a scenario is judged, chosen by name."""

from __future__ import annotations

import dataclasses

from ..learning.known_metrics import TUNED
from ..pytree.closest import not_one_of
from . import Scenario


def judged(scenario: Scenario, metric: str | None) -> Scenario:
    """The scenario judged by another metric; None for the one it has.

    Its tolerance belongs to the metric that it had, so another metric has none.
    Raises ValueError naming the metrics that exist.
    """
    if metric is None:
        return scenario
    known = (*TUNED, *scenario.quantities)
    if metric not in known:
        raise ValueError(not_one_of(f"metric = {metric!r}", metric, known))
    tolerance = scenario.tolerance if metric == scenario.judged_by else None
    return dataclasses.replace(scenario, judged_by=metric, tolerance=tolerance)
