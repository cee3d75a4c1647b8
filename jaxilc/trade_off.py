"""Design under a budget: the trade-off between two objectives, by tuning their weighted sums."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

from .objectives import Objective
from .tuning import Tuned, Tuning


class Point(NamedTuple):
    """One point of a trade-off: share of the first objective, both objectives on held-out plants under the risk, and how it was had."""

    share: float
    first: float
    second: float
    tuned: Tuned


def pareto(problem: Tuning, first: Objective, second: Objective, shares: Sequence[float] = (0.1, 0.3, 0.5, 0.7, 0.9)) -> tuple[Point, ...]:
    """Tunings of share * first + (1 - share) * second, by rising first, without those that another one beats in both.

    Each starts from the weights of the problem. A weighted sum finds the convex part of the front only.
    """
    points = []
    for share in shares:
        tuned = dataclasses.replace(problem, objective=share * first + (1.0 - share) * second).run()
        both = (float(problem.held_out_loss(tuned.values, objective)) for objective in (first, second))
        points.append(Point(share, *both, tuned))
    best = [p for p in points if not any(q.first <= p.first and q.second <= p.second and (q[1:3] != p[1:3]) for q in points)]
    return tuple(sorted(best, key=lambda p: p.first))
