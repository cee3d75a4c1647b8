"""The machine on which a scheme ends worst: a climb beside draws by chance, judged by one metric.

`worst_case` searches for the largest loss of any subject. Here the subject is a machine, and the
loss is that of the last trial's metric (`objectives.Final`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..learning.divergence import peak
from ..learning.known_metrics import bytes_of_metrics
from ..learning.machine import Machine
from ..learning.metrics import Keep
from ..learning.over_trials import learn
from ..runtime.capacity import check_size
from ..schemes import Scheme
from ..signals.task import Task, Trial
from ..uncertainty import Uncertainty
from .objectives import Final, judge
from .worst_case import (
    GRADIENT_COST,
    WorstCase,
    bytes_of_a_draw,
    monte_carlo_search,
    worst_case_search,
)


class Search(NamedTuple):
    """One search for the worst machine.

    case: what it found
    value: the metric of that machine in the last trial
    needed: evaluations until it had found it
    level_with_chance: evaluations until it had found as much as chance did; None if it never did
    """

    case: WorstCase
    value: float
    needed: int
    level_with_chance: int | None


class WorstMachine(NamedTuple):
    """What the searches found; metrics in units of `scale`.

    nominal: the metric of the machine itself in the last trial
    searches: by name: `gradient`, `chance` with as many evaluations, `more chance` if asked for
    by_chance: (n,) the metric of each machine of the largest search by chance
    """

    nominal: float
    searches: dict[str, Search]
    by_chance: np.ndarray


def worst_machine(
    machine: Machine,
    scheme: Scheme,
    task: Task,
    trials: int,
    uncertainty: Uncertainty,
    *,
    metric: str = "settled_error",
    scale: float = 1.0,
    quantities: Mapping[str, Callable[[Trial], jax.Array]] | None = None,
    starts: int = 16,
    steps: int = 30,
    evaluations: int | None = None,
    draws: int | None = None,
    seed: int = 0,
) -> WorstMachine:
    """Search for the machine whose metric of the last trial is largest.

    metric: of `Metrics`, or a name of `quantities`
    scale: metrics are returned as `scale` times
    quantities: further metrics of a trial, by name
    starts, steps: of the climb
    evaluations: to spend on it, in place of `steps`
    draws: of a larger search by chance besides
    Raises ValueError as `worst_case_search` does, and, before the climb, for what memory cannot
    hold.
    """
    of_a_step = starts * (1 + GRADIENT_COST)
    steps = steps if evaluations is None else evaluations // of_a_step
    _need_room(
        task,
        trials,
        uncertainty,
        starts=starts,
        steps=steps,
        evaluations=evaluations,
        draws=draws,
    )
    objective, keep = Final(metric), Keep.of(quantities or {})

    def loss(one: Machine) -> jax.Array:
        return judge(one, scheme, task, trials, objective, save=keep)

    def of_machine(one: Machine) -> float:
        history = learn(one, scheme, task, trials, save=keep)
        values = history.saved[metric] if metric in history.saved else getattr(history, metric)
        return scale * float(jnp.max(values[-1])) if not history.diverged[-1] else float("inf")

    def of_losses(losses: np.ndarray) -> np.ndarray:
        """Metrics from losses; of several outputs the largest peak of the reference counts."""
        unit = scale * float(jnp.max(peak(task))) * objective.floor
        return unit * np.sqrt(np.maximum(np.exp(2.0 * losses) - 1.0, 0.0))

    climbed = worst_case_search(loss, machine, uncertainty, starts=starts, steps=steps, seed=seed)
    counts = {"chance": climbed.evaluations}
    if draws is not None:
        counts["more chance"] = draws
    found = {"gradient": climbed} | {
        name: monte_carlo_search(loss, machine, uncertainty, count, seed=seed)
        for name, count in counts.items()
    }
    nominal = of_machine(machine)
    searches = {
        name: _search(
            case,
            value=of_machine(case.subject),
            each=of_a_step if case is climbed else 1,
            chance=found["chance"].loss,
        )
        for name, case in found.items()
    }
    return WorstMachine(nominal, searches, of_losses(list(found.values())[-1].found))


def _search(case: WorstCase, *, value: float, each: int, chance: float) -> Search:
    """each: evaluations between two entries of `case.best`;  chance: loss that chance found"""
    level = each * (1 + int((case.best >= chance).argmax())) if case.loss >= chance else None
    return Search(case, value, each * (1 + int(case.best.argmax())), level)


def _need_room(
    task: Task,
    trials: int,
    uncertainty: Uncertainty,
    *,
    starts: int,
    steps: int,
    evaluations: int | None,
    draws: int | None,
) -> None:
    """Raises ValueError where the climb or a search by chance does not fit into memory."""
    of_trial, each = bytes_of_metrics(task), bytes_of_a_draw(uncertainty)
    check_size(
        "worst-case",
        lambda trial, starts: 4 * of_trial * trial * starts,
        trial=trials,
        starts=starts,
    )
    if evaluations is None:
        cost = each * (1 + GRADIENT_COST)
        check_size(
            "worst-case", lambda starts, steps: cost * starts * steps, starts=starts, steps=steps
        )
    for name, count in (("evaluations", evaluations), ("draws", draws)):
        if count is not None:
            check_size("worst-case", lambda **counts: each * sum(counts.values()), **{name: count})
