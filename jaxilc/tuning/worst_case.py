"""The worst machine of an uncertain set, by gradient ascent on a loss, and by random draws.

    maximise over t in [0, 1]^n:   loss(subject with each named leaf at the place t of its range)

The set is the box between the `corners` of the distributions: the ends of a uniform distribution,
and the mean plus and minus two standard deviations of a normal one. The subject may be any pytree:
a machine, or a dictionary of a machine and a phase, an initial state, or a reference.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from ..learning.divergence import CEILING, peak
from ..learning.known_metrics import ERRORS, bytes_of_metrics
from ..learning.machine import Machine
from ..learning.metrics import Keep
from ..learning.over_trials import learn
from ..native.run import fastest, sample_steps
from ..pytree.aliases import Leaf, Tree, Value
from ..pytree.in_short import in_short
from ..pytree.ranges import SEEDS, require
from ..runtime.capacity import check_program, check_size
from ..schemes import Scheme
from ..schemes.scheme import need_learned_at_last
from ..signals.task import Task, Trial
from ..theory.chance import draws as draws_noise
from ..uncertainty import LogUniform, Population, Uncertainty, drawn_machine
from .objectives import Final, judge, levels

GRADIENT_COST = 3  # cost of a gradient beyond that of its loss, in evaluations of the loss
T = TypeVar("T")
COPIES = 8  # in the RAM, of the points of all climbs or draws, and of their losses
DRAWS, ENOUGH = 100, 0.95  # of the noise of a machine that was found, and the quantile told
GROW, SHRINK, FIRST, SMALLEST = 1.5, 0.4, 0.1, 1e-6  # Riedmiller 1993 has 1.2 and 0.5


class WorstCase(NamedTuple):
    """The largest loss that a search found.

    values: drawn numbers by name, as `drawn_machine` takes them
    subject: the subject with these values
    loss: () loss of this subject
    evaluations: evaluations of the loss, where a gradient counts as GRADIENT_COST further ones
    found: (starts,) the largest loss from each start
    best: (steps,) the largest loss so far
    """

    values: dict[str, float]
    subject: Tree
    loss: float
    evaluations: int
    found: np.ndarray
    best: np.ndarray
    __repr__ = in_short


def worst_case_search(
    loss: Callable[[Tree], jax.Array],
    subject: Tree,
    uncertainty: Uncertainty | None = None,
    *,
    starts: int = 16,
    steps: int = 30,
    seed: int = 0,
    lanes: int | None = None,
) -> WorstCase:
    """Search by projected ascent on the loss, from the centre of the box and scattered starts.

        t <- clip(t + step sign(d loss / d t), 0, 1)

    The step of a coordinate grows by 1.5 while its slope keeps its sign, and shrinks by 0.4 when
    the sign changes. Only signs of slopes are used (Rprop, Riedmiller 1993), so the loss may be of
    any size. A coordinate whose slope is not finite stays where it is; a climb whose loss is not
    finite returns to its best point with smaller steps. The result is a local maximum in the box;
    there may be a larger one.

    loss: pure function from a subject to a number; that of `objectives.judge` stays finite where a
    machine diverges
    subject, uncertainty: or a `Population`; of its distributions only the corners count
    lanes: number of subjects vectorised together, None for what suits this backend
    Raises ValueError for an uncertainty that is empty or does not fit the subject, or where no loss
    is finite.
    """
    from scipy.stats import qmc  # imported here, since it takes long

    for name, value in (("starts", starts), ("steps", steps), ("lanes", lanes)):
        require("worst_case_search", name, value, "[1, inf)", whole=True, optional=True)
    require("worst_case_search", "seed", seed, SEEDS, whole=True)
    box = _Box("worst_case_search", subject, uncertainty)
    check_size(
        "worst_case_search",
        lambda starts, steps: 8 * (COPIES * box.n * starts + 2 * steps),
        starts=starts,
        steps=steps,
    )
    t = np.concatenate(
        [np.full((1, box.n), 0.5), qmc.LatinHypercube(box.n, rng=seed).random(starts - 1)]
    )

    def of_one(subject, t):
        return jax.value_and_grad(lambda t: loss(box.at(t, subject)))(t)

    given = of_one, box.subject, jnp.asarray(t)
    climb = jax.jit(fastest(*given, steps=lambda: steps * sample_steps(*given), lanes=lanes)[0])
    start = jax.ShapeDtypeStruct((starts, box.n), jnp.result_type(float))
    check_program(
        "worst_case_search: a step of all starts",
        "take fewer starts or trials, or a shorter one",
        climb.lower(box.subject, start),
    )
    step, last = np.full_like(t, FIRST), np.zeros_like(t)
    found, at, best = np.full(starts, -np.inf), t.copy(), np.zeros(steps)
    for i in range(steps):
        losses, slopes = map(np.asarray, climb(box.subject, jnp.asarray(t)))
        better = np.isfinite(losses) & (losses > found)
        found, at = np.where(better, losses, found), np.where(better[:, None], t, at)
        best[i] = found.max()
        lost = ~np.isfinite(losses)[:, None]
        sign = np.where(lost, 0.0, np.sign(np.where(np.isfinite(slopes), slopes, 0.0)))
        factor = np.where(sign * last > 0, GROW, np.where((sign * last < 0) | lost, SHRINK, 1.0))
        step = np.clip(factor * step, SMALLEST, 0.5)
        t, last = np.clip(np.where(lost, at, t) + step * sign, 0.0, 1.0), sign
    return box.worst(at, found, starts * steps * (1 + GRADIENT_COST), best)


def monte_carlo_search(
    loss: Callable[[Tree], jax.Array],
    subject: Tree,
    uncertainty: Uncertainty | None,
    evaluations: int,
    *,
    seed: int = 0,
    lanes: int | None = None,
) -> WorstCase:
    """The largest loss of `evaluations` subjects drawn uniformly from the same box.

    subject, uncertainty: as for `worst_case_search`; of a `Population` None
    Raises as `worst_case_search` does.
    """
    require("monte_carlo_search", "evaluations", evaluations, "[1, inf)", whole=True)
    require("monte_carlo_search", "seed", seed, SEEDS, whole=True)
    box = _Box("monte_carlo_search", subject, uncertainty)
    check_size("monte_carlo_search", bytes_of_a_draw(box.uncertainty), evaluations=evaluations)
    t = np.random.default_rng(seed).random((evaluations, box.n))
    given = lambda subject, t: loss(box.at(t, subject)), box.subject, jnp.asarray(t)
    look = fastest(*given, steps=lambda: sample_steps(*given), lanes=lanes)[0]
    losses = np.asarray(look(box.subject, jnp.asarray(t)))
    losses = np.where(np.isfinite(losses), losses, -np.inf)
    return box.worst(t, losses, evaluations, np.maximum.accumulate(losses))


def bytes_of_a_draw(uncertainty: Uncertainty) -> float:
    """Bytes that one evaluation of `monte_carlo_search` takes besides the learning itself."""
    return 8 * COPIES * (len(uncertainty) + 1)


class _Box:
    """The set of subjects, in coordinates t from 0 to 1, for a search of this name."""

    def __init__(self, search: str, subject, uncertainty: Uncertainty | None):
        population = Population.of(subject, uncertainty)
        if not population.uncertainty:
            raise ValueError(f"{search}: uncertainty is empty; at least one name is needed")
        self.search = search
        self.subject, self.uncertainty = population.machine, population.uncertainty
        self.n = len(self.uncertainty)
        for end in (0.0, 1.0):
            self.at(np.full(self.n, end), self.subject)  # raises where a leaf does not allow it

    def at(self, t: Leaf, subject: T) -> T:
        """The subject at t (n,)."""
        return drawn_machine(subject, self.uncertainty, self.values(t))

    def values(self, t: Leaf) -> dict[str, Value]:
        """The values by name at t (n,); a log-uniform one is interpolated by its logarithm."""
        values = {}
        for i, (name, distribution) in enumerate(self.uncertainty.items()):
            (low, high), left = distribution.corners(), 1 - t[i]  # exact at both ends
            log = isinstance(distribution, LogUniform)
            values[name] = low**left * high ** t[i] if log else left * low + t[i] * high
        return values

    def worst(self, t, losses, evaluations: int, best) -> WorstCase:
        i = int(np.argmax(losses))
        if not np.isfinite(losses[i]):
            raise ValueError(f"{self.search}: none of {len(losses)} losses is finite")
        values = {name: float(value) for name, value in self.values(t[i]).items()}
        subject = drawn_machine(self.subject, self.uncertainty, values)
        return WorstCase(
            values, subject, float(losses[i]), evaluations, np.asarray(losses), np.asarray(best)
        )


# The machine with the largest metric
# --------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class _Largest(Final):
    """The value of the output in which the metric is largest, and not the largest share of a peak.

    The peaks of outputs may differ.
    """

    def __call__(self, run):
        return levels(run, self.metric, self.floor, one_unit=True)[-1]


class Search(NamedTuple):
    """One search for the worst machine.

    value: the metric of that machine in the last trial, inf if any trial diverged
    needed: number of evaluations until this machine was found
    level_with_chance: number of evaluations until the loss reached that of the random search, None
        if it never did
    course: (n,) the largest metric so far, at even steps up to all evaluations of the search; inf
        for an error that diverged, nan before a quantity is a number
    over_noise: the metric that a share ENOUGH of DRAWS further draws of the noise do not exceed,
        inf for one that diverged; None for a machine without noise
    """

    case: WorstCase
    value: float
    needed: int
    level_with_chance: int | None
    course: np.ndarray
    over_noise: float | None = None
    __repr__ = in_short


class WorstMachine(NamedTuple):
    """The results of the searches, with metrics multiplied by `scale`.

    nominal: metric of the nominal machine in the last trial, inf if any trial diverged
    searches: searches by name: `gradient`, `chance` with as many evaluations, and `more chance` if
        asked for
    by_chance: (n,) metric of each machine of the largest random search; inf for an error that
        diverged, nan for a quantity that is no finite number
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

    All machines of the search have the same draw of the noise, so that their metrics differ by the
    machine alone. Each machine that was found is simulated with further draws.

    machine, uncertainty: or a `Population`; of its distributions only the corners count
    metric: name of a field of `Metrics`, or of one of the `quantities`
    scale: factor by which metrics are multiplied
    starts, steps: numbers of starts and of steps of the ascent
    evaluations: number of evaluations to spend on the ascent, in place of `steps`
    draws: number of draws of a further, larger random search
    seed: of the starts, of the drawn machines and of the noise
    progress: called before each search with the evaluations done, those of all, and its name
    Raises ValueError as `worst_case_search` does, and, before the ascent, for what the RAM cannot
    hold, and where the last trial is an experiment.
    """
    need_learned_at_last("worst_machine", scheme, task, trials)
    require("worst_machine", "starts", starts, "[1, inf)", whole=True)
    of_a_step, population = starts * (1 + GRADIENT_COST), Population.of(machine, uncertainty)
    each = bytes_of_a_draw(population.uncertainty)
    check_size("worst-case", 4 * bytes_of_metrics(task), trial=trials, starts=starts)
    if evaluations is None:
        check_size("worst-case", each * (1 + GRADIENT_COST), starts=starts, steps=steps)
    for name, count, least in (("evaluations", evaluations, of_a_step), ("draws", draws, 1)):
        if count is not None:
            require("worst_machine", name, count, f"[{least}, inf)", whole=True)
            check_size("worst-case", each, **{name: count})
    steps = steps if evaluations is None else evaluations // of_a_step
    objective, keep = _Largest(metric), Keep.of(quantities or {})

    key = jax.random.key(seed)

    def loss(one: Machine) -> jax.Array:
        return judge(one, scheme, task, trials, objective, key=key, save=keep)

    def of_machine(one: Machine, key: jax.Array = key) -> jax.Array:
        history = learn(one, scheme, task, trials, key=key, save=keep)
        values = history.saved[metric] if metric in history.saved else getattr(history, metric)
        return jnp.where(jnp.any(history.diverged), jnp.inf, scale * jnp.max(jnp.abs(values[-1])))

    of_draws = jax.jit(lambda one, keys: jax.lax.map(lambda of: of_machine(one, of), keys))

    def over_noise(one: Machine) -> float | None:
        if not draws_noise(one):
            return None
        values = of_draws(one, jax.random.split(key, DRAWS))
        return float(np.quantile(values, ENOUGH, method="higher"))

    def of_losses(losses: np.ndarray) -> np.ndarray:
        """Metrics from losses; an error beyond the ceiling is that of a trial that diverged."""
        is_error, told = metric in (m.name for m in ERRORS), np.isfinite(losses)
        level = objective.floor * np.exp(losses) * np.sqrt(np.maximum(-np.expm1(-2 * losses), 0.0))
        level = np.where(told, level, np.inf if is_error else np.nan)
        diverged = is_error & (level > CEILING)
        return np.where(diverged, np.inf, scale * float(jnp.max(peak(task))) * level)

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
    nominal = float(of_machine(population.machine))
    searches, chance = {}, found["chance"].loss
    for name, case in found.items():
        each = of_a_step if case is climbed else 1  # evaluations between two entries of its best
        needed, level = (each * (1 + int(x.argmax())) for x in (case.best, case.best >= chance))
        searches[name] = Search(
            case, float(of_machine(case.subject)), needed, level if case.loss >= chance else None,
            of_losses(case.best), over_noise(case.subject),
        )  # fmt: skip
    return WorstMachine(nominal, searches, of_losses(list(found.values())[-1].found))
