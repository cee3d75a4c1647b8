"""Design under a budget: what two objectives cost each other, and what can be had in how many
trials.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from .objectives import Objective
from .problem import Tuned, Tuning

SHARES = (0.1, 0.3, 0.5, 0.7, 0.9)
Progress = Callable[
    [str, int, np.ndarray, float], None
]  # name of the tuning, then what `Tuning.run` tells


class Point(NamedTuple):
    """One point of a trade-off: share of the first objective, both objectives on held-out plants
    under the risk, and how it was had.
    """

    share: float
    first: float
    second: float
    tuned: Tuned


def pareto(
    problem: Tuning,
    first: Objective,
    second: Objective,
    shares: Sequence[float] = SHARES,
    out: str | Path | None = None,
    *,
    resume: bool = False,
    progress: Progress | None = None,
) -> tuple[Point, ...]:
    """Tunings of a weighted sum, by rising first objective, without those that another one beats in
    both.

        minimise  share first / |first_0| + (1 - share) second / |second_0|

    first_0, second_0: on the held-out plants with the weights as given, so that a share of 1/2
    weighs a gain of 1 % in either alike; an objective that is zero or not finite there is not
    divided. Each tuning starts from the weights as given. A weighted sum finds the convex part of
    the front only (Das and Dennis 1997), and evenly spaced shares need not give evenly spaced
    points.
    shares: in [0, 1], each once;  out: a folder with the state of each tuning in a folder of its
    own, None for memory only
    resume: go on with those at `out`, where shares may be added;  progress: called after each step
    of each tuning
    Raises ValueError naming shares that are not allowed, and what `Tuning.run` raises.
    """
    if not shares or len(set(shares)) < len(shares) or not all(0 <= share <= 1 for share in shares):
        raise ValueError(f"pareto: shares = {list(shares)} are not different numbers in [0, 1]")
    _need_place(out, resume)
    losses = held_out_losses(problem, first, second)
    one, other = (
        scale if np.isfinite(scale) and scale > 0 else 1.0
        for scale in np.abs(losses(problem.start)).tolist()
    )
    sums = {share: share / one * first + (1.0 - share) / other * second for share in shares}
    problems = {
        f"share-{share}": dataclasses.replace(problem, objective=total)
        for share, total in sums.items()
    }
    found = _tuned(problems, out, resume, progress)
    points = [
        Point(share, *losses(tuned.values).tolist(), tuned)
        for share, tuned in zip(shares, found.values(), strict=True)
    ]
    best = [
        p
        for p in points
        if not any(
            q.first <= p.first and q.second <= p.second and (q[1:3] != p[1:3]) for q in points
        )
    ]
    return tuple(sorted(best, key=lambda p: p.first))


def by_trials(
    problem: Tuning,
    budgets: Sequence[int],
    out: str | Path | None = None,
    *,
    resume: bool = False,
    progress: Progress | None = None,
) -> dict[int, Tuned]:
    """The problem tuned anew for each number of trials: what can be had by then. Each tuning starts
    from the weights as given.

    budgets: numbers of trials, each once;  out, resume, progress: as for `pareto`
    Raises ValueError naming budgets that are not allowed or too short for the objective, and what
    `Tuning.run` raises.
    """
    if not budgets or len(set(budgets)) < len(budgets) or not all(J >= 1 for J in budgets):
        raise ValueError(
            f"by_trials: budgets = {list(budgets)} are not different numbers of trials in [1, inf)"
        )
    _need_place(out, resume)
    problems = {f"trials-{J}": dataclasses.replace(problem, trials=J) for J in budgets}
    return dict(zip(budgets, _tuned(problems, out, resume, progress).values(), strict=True))


def held_out_losses(
    problem: Tuning, *objectives: Objective
) -> Callable[[Mapping[str, float]], np.ndarray]:
    """A compiled function of the weights by name: the risk of each objective over the held-out
    plants.
    """
    losses = jax.jit(
        lambda values: jnp.stack(
            [problem.held_out_loss(values, objective) for objective in objectives]
        )
    )
    return lambda values: np.asarray(losses(dict(values)))


def _need_place(out: str | Path | None, resume: bool) -> None:
    if out is not None and Path(out).exists() and not resume:
        raise FileExistsError(f"{out} exists already; resume it or choose another place")


def _tuned(
    problems: Mapping[str, Tuning], out: str | Path | None, resume: bool, progress: Progress | None
) -> dict[str, Tuned]:
    return {
        name: problem.run(
            None if out is None else Path(out) / name,
            resume=resume,
            progress=None if progress is None else partial(progress, name),
        )
        for name, problem in problems.items()
    }
