"""Design under a budget: a front of two objectives, and the best error for a number of trials."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..storage.files import need_free
from .objectives import Objective
from .problem import Tuned, Tuning

SHARES = (0.1, 0.3, 0.5, 0.7, 0.9)
# Called with the name of the tuning, then with the arguments of `progress` of `Tuning.run`.
Progress = Callable[[str, int, np.ndarray, float], None]


class Point(NamedTuple):
    """One point of a trade-off.

    share: weight of the first objective, from 0 to 1
    first, second: risk of each objective over the held-out machines
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
    losses: Callable[[Mapping[str, float]], np.ndarray] | None = None,
) -> tuple[Point, ...]:
    """The points of a trade-off between two objectives, sorted by the first objective.

        minimise  share first / |first_0| + (1 - share) second / |second_0|

    first_0 and second_0 are the objectives on the held-out machines with the weights as given, so
    that with a share of 1/2 a gain of 1 % in either objective counts the same. An objective that is
    zero or not finite there is not divided. Each tuning starts from the weights as given. A point
    is left out where another one, or the weights as given, is no worse in either objective and
    better in one: a risk of the sum may fall where both risks rise. An objective that is no number
    counts as infinite. A weighted sum finds only the convex part of the front (Das and Dennis
    1997), and evenly spaced shares need not give evenly spaced points.

    shares: numbers in [0, 1], all different
    out: folder that gets a folder for the state of each tuning, None to keep them in the RAM only
    resume: continue from the states at `out`, where shares may be added
    losses: the `held_out_losses` of both objectives, where they are compiled already
    Raises ValueError naming shares that are not allowed, and what `Tuning.run` raises.
    """
    shares = [float(share) for share in shares]  # which name the folders of states
    if not shares or len(set(shares)) < len(shares) or not all(0 <= share <= 1 for share in shares):
        raise ValueError(f"pareto: shares = {shares} are not different numbers in [0, 1]")
    if out is not None and not resume:
        need_free(out)
    losses = losses or held_out_losses(problem, first, second)
    given = losses(problem.start).tolist()
    one, other = (abs(of) if 0 < abs(of) < np.inf else 1.0 for of in given)
    sums = {share: share / one * first + (1.0 - share) / other * second for share in shares}
    problems = {
        f"share-{share}": dataclasses.replace(problem, objective=total)
        for share, total in sums.items()
    }
    found = _tuned(problems, out, resume, progress)
    points = [
        Point(
            share, *(np.inf if np.isnan(of) else of for of in losses(tuned.values).tolist()), tuned
        )
        for share, tuned in zip(shares, found.values(), strict=True)
    ]
    rivals = {tuple(given), *(p[1:3] for p in points)}
    best = (
        p
        for p in points
        if not any(q[0] <= p.first and q[1] <= p.second and q != p[1:3] for q in rivals)
    )
    return tuple(sorted(best, key=lambda p: p.first))


def by_trials(
    problem: Tuning,
    budgets: Sequence[int],
    out: str | Path | None = None,
    *,
    resume: bool = False,
    progress: Progress | None = None,
) -> dict[int, Tuned]:
    """Tune the problem separately for each number of trials, to find the error that is reached.

    Each tuning starts from the weights as given.

    budgets: numbers of trials, all different
    out, resume, progress: as for `pareto`
    Raises ValueError naming budgets that are not allowed or too short for the objective, and what
    `Tuning.run` raises.
    """
    budgets = list(budgets)
    if not budgets or len(set(budgets)) < len(budgets) or not all(J >= 1 for J in budgets):
        raise ValueError(
            f"by_trials: budgets = {budgets} are not different numbers of trials in [1, inf)"
        )
    if out is not None and not resume:
        need_free(out)
    problems = {f"trials-{J}": dataclasses.replace(problem, trials=J) for J in budgets}
    return dict(zip(budgets, _tuned(problems, out, resume, progress).values(), strict=True))


def held_out_losses(
    problem: Tuning, *objectives: Objective
) -> Callable[[Mapping[str, float]], np.ndarray]:
    """A compiled function from weights by name to the risks of the objectives.

    Each risk is taken over the held-out machines.
    """
    losses = jax.jit(
        lambda values: jnp.stack(
            [problem.held_out_loss(values, objective) for objective in objectives]
        )
    )
    return lambda values: np.asarray(losses(dict(values)))


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
