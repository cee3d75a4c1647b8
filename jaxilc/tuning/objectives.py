"""Objectives: numbers of a learning process, which tuning minimises and a search maximises.

An objective is a function of one machine's `Run`. Objectives are added with weights:
`Final() + 0.1 * Growth()`. A risk then combines the numbers of many machines into one (`risks`).
Errors enter by their logarithm, so that each order of magnitude has the same weight:

    l(x) = 1/2 log((x / peak)^2 + floor^2) - log floor,     peak = max |r|

It is >= 0, and about log(x / (floor peak)) where x is above floor peak. Objectives accept the
metrics of `learning.known_metrics` that may be tuned, and further quantities by name; what is no
error of one output has the largest of all peaks. Where learning diverges, the numbers grow until no
gradient is finite. `Bounded` keeps them finite.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import ClassVar, NamedTuple, Self

import jax
import jax.numpy as jnp
from jax import lax

from ..learning.divergence import CEILING, of_learned, peak
from ..learning.known_metrics import ERRORS, TUNED
from ..learning.machine import Machine
from ..learning.metrics import Keep, largest
from ..learning.over_trials import History, truncated
from ..pytree.aliases import Leaf, Tree
from ..pytree.closest import not_one_of
from ..pytree.fields import child, leaf, pytree
from ..pytree.ranges import require
from ..schemes import Scheme
from ..schemes.guards import Guard
from ..schemes.scheme import Memory, State, need_second_derivatives, trials_of_step
from ..signals.task import Sample, Task, Trial


class Halted(NamedTuple):
    """The memory of `Bounded`.

    scheme: memory of the scheme that is bounded
    passed: () whether the error of a trial was larger than the level
    trials: () number of trials up to the one that passed the level, else of all trials so far
    """

    scheme: Memory
    passed: jax.Array
    trials: jax.Array


@jax.custom_jvp
def _restarted(passed, fresh: Memory, memory: Memory) -> Memory:
    """The fresh memory where a trial has passed the level, else the memory.

    The slope is that of the memory in both cases. It saves time, and it is right: no trial counts
    that is run from a fresh memory.
    """
    return jax.tree.map(lambda new, old: jnp.where(passed, new, old), fresh, memory)


@_restarted.defjvp
def _restarted_jvp(primals, tangents):
    return _restarted(*primals), tangents[2]


@pytree
class Bounded(Guard):
    """A scheme that sees no error beyond a level, and learns until a trial passes it.

        y seen = min(max(y, r - level), r + level)
        memory = initial memory after a trial in which max |e| > level

    As long as no error exceeds the level, all numbers are those of the scheme itself. After a trial
    that exceeds it, the trials begin without knowledge, so that all numbers stay finite, and they
    do not count: `up_to_level` repeats the numbers of the trial that exceeded it. The gradient is
    that of this trial; the part of an error that is cut off has the gradient zero. A learning
    process that diverges thus has a loss of about log(ceiling / floor), and a slope that leads back
    to weights that converge.

    level: (n_y,) largest error that the scheme sees, > 0 [unit of y]
    fresh: the memory of the scheme before the first trial; `prepared` finds it
    """

    scheme: Scheme = child()
    level: Leaf = leaf(interval="(0, inf)")
    fresh: Tree = child(default=None)

    @classmethod
    def around(cls, scheme: Scheme, task: Task, ceiling: float = CEILING) -> Bounded:
        """The scheme with a level of `ceiling` times the peak of the reference."""
        return cls(scheme, lax.stop_gradient(ceiling * peak(task)))

    @property
    def elementwise(self) -> bool:
        return self.scheme.elementwise

    def prepared(self, task: Task) -> Self:
        scheme = self.scheme.prepared(task)
        return self._with({"scheme": scheme, "fresh": scheme.initial_memory(task)})

    def initial_memory(self, task: Task) -> Halted:
        return Halted(self.scheme.initial_memory(task), jnp.zeros((), bool), jnp.zeros((), int))

    def act(self, state: State, sample: Sample) -> tuple[State, jax.Array]:
        return self.scheme.act(state, sample._replace(y=self._seen(sample.y, sample.r)))

    def learn(self, memory: Halted, trial: Trial) -> Halted:
        seen = trial._replace(y=self._seen(trial.y, trial.r))
        return Halted(
            self.scheme.learn(memory.scheme, seen),
            memory.passed | ~jnp.all(jnp.abs(trial.e) <= self.level),
            memory.trials + ~memory.passed,
        )

    def resumed(self, memory: Halted) -> Halted:
        return memory._replace(scheme=_restarted(memory.passed, self.fresh, memory.scheme))

    def _seen(self, y: jax.Array, r: jax.Array) -> jax.Array:
        """The output with an error within the level; r - level where it is not a number.

        A processor has one instruction for each of the two choices. `jnp.clip` hands on what is
        not a number, and its slope divides where y is at the limit.
        """
        low, high = r - self.level, r + self.level
        y = jnp.where(y > low, y, low)
        return jnp.where(y < high, y, high)


def up_to_level(history: History) -> History:
    """The history of a `Bounded` scheme, in which trials repeat the one that passed the level."""
    j, count = jnp.arange(len(history.diverged)), history.memory.trials

    def repeating(x: jax.Array) -> jax.Array:
        at = j.reshape(-1, *(1 for _ in x.shape[1:]))
        last = jnp.sum(jnp.where(at == count - 1, x, 0), axis=0)  # see `largest`
        return jnp.where(at < count, x, last.astype(x.dtype))

    metrics, saved = jax.tree.map(repeating, (history.metrics, history.saved))
    return history._replace(metrics=metrics, saved=saved)


# Objectives
# --------------------------------------------------------------------------------------------------

FLOOR = 1e-6  # relative to the peak of the reference


class Run(NamedTuple):
    """The learning process of one machine.

    history: the metrics; its `saved` has the further quantities by name
    ceiling: largest error, relative to the peak of the reference, see `Bounded`
    """

    machine: Machine
    scheme: Scheme
    task: Task
    history: History
    ceiling: float = CEILING


def judge(
    machine: Machine,
    scheme: Scheme,
    task: Task,
    trials: int,
    objective: Objective,
    *,
    key=None,
    ceiling: float = CEILING,
    save: Keep | None = None,
    last: int | None = None,
) -> jax.Array:
    """() the objective of one machine's learning process under `Bounded`; a pure function.

    ceiling: largest error, relative to the peak of the reference, see `Bounded`
    save: further quantities, for objectives that use them
    last: number of trials that the gradient includes, see `truncated`; None: all
    """
    history = truncated(
        machine, Bounded.around(scheme, task, ceiling), task, trials, last or trials,
        key=key, save=kept_for(objective, save),
    )  # fmt: skip
    return objective(Run(machine, scheme, task, up_to_level(history), ceiling))


def kept_for(objective: Objective, save: Keep | None = None) -> Keep:
    """What to keep of each trial, besides what `save` keeps, for an objective.

    Raises ValueError where a quantity of `save` has the name of one that the objective needs.
    """
    save = Keep() if save is None else save
    needed = {name: of for _, term in objective.terms for name, of in term.quantities.items()}
    for name, _ in save.quantities:
        if name in needed:
            raise ValueError(
                f"quantity = {name!r} is what the objective keeps; choose another name"
            )
    return dataclasses.replace(save, quantities=(*save.quantities, *needed.items()))


_OF_OUTPUTS = tuple(m.name for m in ERRORS)  # relative to the reference of the same output
_POSITIVE, _COUNT = ("(0, inf)", False), ("[1, inf)", True)
_RANGES = dict.fromkeys(("floor", "tolerance", "width", "scale", "below"), _POSITIVE)
_RANGES |= dict.fromkeys(("trial", "first", "after", "trials", "steps"), _COUNT)


@dataclasses.dataclass(frozen=True)
class Objective:
    """A function from a `Run` to a number.

    nominal: whether it is computed for the nominal machine only, without a risk over machines
    quantities: what it needs of each trial besides the metrics, by name
    """

    nominal: ClassVar[bool] = False
    quantities: ClassVar[Mapping[str, Callable[[Trial], jax.Array]]] = {}

    def __post_init__(self):
        """Raises ValueError, naming the field, for a number that no objective could have."""
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            allowed, whole = _RANGES.get(field.name, ("", False))
            if allowed and not (value is None and field.default is None):
                require(type(self).__name__, field.name, value, allowed, whole=whole)

    def __call__(self, run: Run) -> jax.Array:
        raise NotImplementedError

    @property
    def terms(self) -> tuple[tuple[float, Objective], ...]:
        """(weight, objective) pairs that add up to this one."""
        return ((1.0, self),)

    def __add__(self, other: Objective) -> Objective:
        return Sum((*self.terms, *other.terms))

    def __rmul__(self, weight: float) -> Objective:
        return Sum(tuple((float(weight) * w, term) for w, term in self.terms))


@dataclasses.dataclass(frozen=True)
class Sum(Objective):
    """The sum of weight_i objective_i over all parts.

    parts: (weight, objective) pairs; one of weight 0 does not count, also where it is not finite
    """

    parts: tuple[tuple[float, Objective], ...]

    @property
    def terms(self):
        return self.parts

    def __call__(self, run: Run):
        return sum((w * term(run) for w, term in self.parts if w), jnp.zeros(()))


@dataclasses.dataclass(frozen=True)
class Final(Objective):
    """The value l of a metric at one trial.

    trial: number of the trial, None for the last one
    floor: the floor in l, relative to the peak of the reference; also in the other objectives
    """

    metric: str = "settled_error"
    trial: int | None = None
    floor: float = FLOOR

    def __call__(self, run: Run):
        x = levels(run, self.metric, self.floor)
        require("Final", "trial", self.trial, f"[1, {len(x)}]", optional=True)
        return x[-1 if self.trial is None else self.trial - 1]


@dataclasses.dataclass(frozen=True)
class EveryTrial(Objective):
    """The mean of l over the trials, which is small where learning is fast."""

    metric: str = "settled_error"
    floor: float = FLOOR

    def __call__(self, run: Run):
        return jnp.mean(levels(run, self.metric, self.floor))


@dataclasses.dataclass(frozen=True)
class Holding(Objective):
    """The largest l from one trial on: the level that is reached by this trial and kept."""

    first: int = 1
    metric: str = "settled_error"
    floor: float = FLOOR

    def __call__(self, run: Run):
        x = levels(run, self.metric, self.floor)
        require("Holding", "first", self.first, f"[1, {len(x)}]")
        return largest(x[self.first - 1 :])


@dataclasses.dataclass(frozen=True)
class TrialsTo(Objective):
    """The number of trials above a tolerance, made smooth.

        sum_j 1 / (1 + (tolerance / x_j)^(1 / width))

    tolerance: largest value that counts as reached [unit of the metric]
    width: width of the transition, in units of log x; for width -> 0 the sum is the exact number
    """

    tolerance: float
    metric: str = "settled_error"
    width: float = 0.5

    def __call__(self, run: Run):
        floor = FLOOR * self.tolerance / largest(peak(run.task))  # far below what is asked for
        x = levels(run, self.metric, floor, one_unit=True)
        return jnp.sum(jax.nn.sigmoid((x + jnp.log(FLOOR)) / self.width))


@dataclasses.dataclass(frozen=True)
class Growth(Objective):
    """The sum of all rises of a metric from trial to trial, in logarithms.

        sum_j max(0, l(x_{j+1}) - l(x_j)),     j >= after

    after: number of the first trial that counts; growth up to this trial is allowed
    """

    metric: str = "settled_error"
    after: int = 1
    floor: float = FLOOR

    def __call__(self, run: Run):
        x = levels(run, self.metric, self.floor)
        require("Growth", "after", self.after, f"[1, {len(x)}]")
        return jnp.sum(jax.nn.relu(jnp.diff(x[self.after - 1 :])))


@dataclasses.dataclass(frozen=True)
class Effort(Objective):
    """The mean square of all inputs in the last trial, divided by scale^2.

    scale: input that counts as 1 [unit of u]
    """

    scale: float = 1.0

    def __call__(self, run: Run):
        return jnp.mean((run.history.effort[-1] / self.scale) ** 2)


def input_rate(trial: Trial) -> jax.Array:
    """() the mean square of (u[k+1] - u[k]) / dt of all inputs [(unit of u per s)^2]."""
    return jnp.mean((jnp.diff(trial.u, axis=0) / trial.dt) ** 2)


@dataclasses.dataclass(frozen=True)
class InputRate(Objective):
    """The mean square of (u[k+1] - u[k]) / dt in the last trial, divided by scale^2.

    scale: rate that counts as 1 [unit of u per s]
    """

    scale: float = 1.0
    quantities: ClassVar = {"input rate": input_rate}

    def __call__(self, run: Run):
        return run.history.saved["input rate"][-1] / self.scale**2


@dataclasses.dataclass(frozen=True)
class Contraction(Objective):
    """How far the nominal learning map is from being a contraction; 0 where it is one.

        max(0, log(sigma / below)),     sigma = sup |e_{j+n}| / |e_j|

    The supremum is over all small changes of the error that another disturbance, which then stays,
    brings about (`theory.contraction.error_map`): |I - P Q L| for a linear law with a filter Q.
    Where Q is a low-pass, what lies beyond its cutoff is not learned and stays as it is, so that no
    law brings sigma clearly below 1, though the error of each machine may fall in every trial;
    `filter` and `certify` judge such laws. The slope is that of |J v| at the singular vector v of
    the Lanczos iteration, d sigma = u^T dJ v. There is no second derivative by the weights, since v
    counts as constant. Raises ValueError for a scheme without second derivatives.

    below: upper limit for sigma
    """

    below: float = 1.0
    trials: int = 1
    steps: int = 60
    nominal: ClassVar[bool] = True

    def __call__(self, run: Run):
        from ..theory.contraction import error_map, singular_value

        need_second_derivatives(run.scheme)

        def last_of(scheme):
            map_ = error_map(run.machine, scheme, run.task, trials=self.trials)
            return lambda e: map_.f(e)[-1], map_.at

        f, at = last_of(lax.stop_gradient(run.scheme))
        v = lax.stop_gradient(singular_value(f, at, steps=self.steps).direction)
        f, at = last_of(run.scheme)
        square = jnp.sum((jax.jvp(f, (at,), (v,))[1] / self.below) ** 2)
        return 0.5 * jnp.log(jnp.maximum(square, 1.0))  # with the slope 0 where sigma = 0, too


@dataclasses.dataclass(frozen=True)
class D2(Objective):
    """How far d2 of Cao 2019 is above a limit, on each machine, from its plant; 0 below it.

        max(0, log(d2 / below))

    It needs no trial (`theory.bounds_of`). On a plant where y(k+1) depends on earlier inputs too,
    it limits the spectral radius of the frozen law and not the error; `Contraction` limits that.
    Raises ValueError for a scheme other than CFDL-MFAILC, of which no d2 is proved.

    below: upper limit for d2
    """

    below: float = 1.0

    def __call__(self, run: Run):
        from ..theory.bounds import bounds_of, compact

        if not compact(run.scheme):
            raise ValueError(
                f"D2: {type(run.scheme).__name__} has no d2; allowed is CFDLMFAILC, as Cao 2019 "
                "proves nothing of the error of other schemes"
            )
        found = bounds_of(run.machine, run.scheme, run.task)
        return jnp.log(jnp.maximum(found.d2 / self.below, 1.0))  # with the slope 0 at d2 = 0, too


def levels(run: Run, metric: str, floor: Leaf, *, one_unit: bool = False) -> jax.Array:
    """(J,) values l of a metric, for its largest channel.

    one_unit: whether all channels are relative to the largest of all peaks, so that the largest
        channel is that of the largest value
    An experiment has the value of the trial before it that played what was learned. For a trial
    that exceeded the ceiling at any sample, it is l of max |e| if that is larger.
    Otherwise an error that diverges at the start, outside the settled window, would not count, as
    the bound keeps it from spreading. Raises ValueError naming the metrics that exist.
    """
    history = run.history
    anywhere = largest(history.max_error / peak(run.task), axis=1)
    if metric in TUNED:
        x = getattr(history.metrics, metric)
    elif metric in (history.saved or {}):
        x = history.saved[metric]
    else:
        known = (*TUNED, *(history.saved or {}))
        raise ValueError(not_one_of(f"metric = {metric!r}", metric, known))
    each = metric in _OF_OUTPUTS and not one_unit
    x = x / (peak(run.task) if each else largest(peak(run.task)))
    x = largest(jnp.abs(x.reshape(len(x), -1)), axis=1)
    x = jnp.where(anywhere <= run.ceiling, x, jnp.maximum(x, anywhere))
    level = 0.5 * jnp.log(x**2 + floor**2) - jnp.log(floor)
    every = trials_of_step(run.scheme, run.task)
    return level if every == 1 else of_learned(level, 1, every)
