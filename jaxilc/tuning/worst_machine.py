"""The machine with the largest metric: a search by gradient ascent, and one by random draws.

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
from ..pytree.in_short import in_short
from ..runtime.capacity import check_size
from ..schemes import Scheme
from ..schemes.parts import need_learned_at_last
from ..signals.task import Task, Trial
from ..uncertainty import Population, Uncertainty
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

    case: result of the search
    value: the metric of that machine in the last trial
    needed: number of evaluations until this machine was found
    level_with_chance: number of evaluations until the loss reached that of the random search, None
        if it never did
    course: (n,) the largest metric so far, at even steps up to all evaluations of the search
    """

    case: WorstCase
    value: float
    needed: int
    level_with_chance: int | None
    course: np.ndarray
    __repr__ = in_short


class WorstMachine(NamedTuple):
    """The results of the searches, with metrics multiplied by `scale`.

    nominal: metric of the nominal machine in the last trial
    searches: searches by name: `gradient`, `chance` with as many evaluations, and `more chance` if
        asked for
    by_chance: (n,) metric of each machine of the largest random search
    """

    nominal: float
    searches: dict[str, Search]
    by_chance: np.ndarray
    __repr__ = in_short


def worst_machine(
    machine: Machine | Population,
    scheme: Scheme,
    task: Task,
    trials: int,
    uncertainty: Uncertainty | None = None,
    *,
    metric: str = "settled_error",
    scale: float = 1.0,
    quantities: Mapping[str, Callable[[Trial], jax.Array]] | None = None,
    starts: int = 16,
    steps: int = 30,
    evaluations: int | None = None,
    draws: int | None = None,
    seed: int = 0,
    progress: Callable[[int, int, str], object] | None = None,
) -> WorstMachine:
    """Search for the machine whose metric of the last trial is largest.

    machine, uncertainty: or a `Population`; of its distributions only the corners count
    metric: name of a field of `Metrics`, or of one of the `quantities`
    scale: factor by which metrics are multiplied
    quantities: further metrics of a trial, by name
    starts, steps: numbers of starts and of steps of the ascent
    evaluations: number of evaluations to spend on the ascent, in place of `steps`
    draws: number of draws of a further, larger random search
    progress: called before each search with the evaluations done, those of all, and its name
    Raises ValueError as `worst_case_search` does, and, before the ascent, for what the RAM cannot
    hold, and where the last trial is an experiment.
    """
    need_learned_at_last("worst_machine", scheme, task, trials)
    of_a_step = starts * (1 + GRADIENT_COST)
    steps = steps if evaluations is None else evaluations // of_a_step
    population = Population.of(machine, uncertainty)
    each = bytes_of_a_draw(population.uncertainty)
    check_size("worst-case", 4 * bytes_of_metrics(task), trial=trials, starts=starts)
    if evaluations is None:
        check_size("worst-case", each * (1 + GRADIENT_COST), starts=starts, steps=steps)
    for name, count in (("evaluations", evaluations), ("draws", draws)):
        if count is not None:
            check_size("worst-case", each, **{name: count})
    objective, keep = Final(metric), Keep.of(quantities or {})

    def loss(one: Machine) -> jax.Array:
        return judge(one, scheme, task, trials, objective, save=keep)

    def of_machine(one: Machine) -> float:
        history = learn(one, scheme, task, trials, save=keep)
        values = history.saved[metric] if metric in history.saved else getattr(history, metric)
        return scale * float(jnp.max(values[-1])) if not history.diverged[-1] else float("inf")

    def of_losses(losses: np.ndarray) -> np.ndarray:
        """Metrics from losses; with several outputs the largest peak of the reference is used."""
        unit = scale * float(jnp.max(peak(task))) * objective.floor
        return unit * np.sqrt(np.maximum(np.exp(2.0 * losses) - 1.0, 0.0))

    ascent = of_a_step * steps
    told = progress or (lambda done, whole, name: None)
    whole = 2 * ascent + (draws or 0)
    told(0, whole, "climbing")
    climbed = worst_case_search(loss, population, starts=starts, steps=steps, seed=seed)
    counts = {"chance": climbed.evaluations}
    if draws is not None:
        counts["more chance"] = draws
    found = {"gradient": climbed}
    for name, count in counts.items():
        told(ascent * len(found), whole, name)
        found[name] = monte_carlo_search(loss, population, None, count, seed=seed)
    told(whole, whole, "judging the worst")
    nominal = of_machine(population.machine)
    searches = {
        name: _search(
            case,
            value=of_machine(case.subject),
            each=of_a_step if case is climbed else 1,
            chance=found["chance"].loss,
            course=of_losses(case.best),
        )
        for name, case in found.items()
    }
    return WorstMachine(nominal, searches, of_losses(list(found.values())[-1].found))


def _search(case: WorstCase, *, value: float, each: int, chance: float, course) -> Search:
    """The record of one search.

    each: evaluations between two entries of `case.best`
    chance: loss that the random search found
    course: metrics of `case.best`
    """
    level = each * (1 + int((case.best >= chance).argmax())) if case.loss >= chance else None
    return Search(case, value, each * (1 + int(case.best.argmax())), level, course)
