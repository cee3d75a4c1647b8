"""What tuning minimises and a worst-case search maximises: figures of a learning process, as
numbers with useful slopes.

An objective is a function of one plant's `Run`; objectives add up, with weights: `Final() + 0.1 *
Growth()`. A risk then makes one number of those of many plants (`risks`). Errors enter by their
logarithm, so that orders of magnitude count alike:

    l(x) = 1/2 log((x / peak)^2 + floor^2) - log floor     >= 0;  about log(x / (floor peak)) above
    the floor, peak = max |r|

A learning process that diverges leaves numbers that no gradient survives. `Bounded` keeps them
finite; see there.
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from ..learning.divergence import CEILING, peak
from ..learning.machine import Machine
from ..learning.metrics import Keep, Metrics, largest
from ..learning.over_trials import History, learn
from ..pytree.fields import Leaf, child, leaf, pytree
from ..pytree.ranges import require
from ..schemes import Scheme
from ..schemes.guards import Guard
from ..signals.task import Sample, Task, Trial

FLOOR = 1e-6


class Run(NamedTuple):
    """One plant's learning process. history: its `saved` holds the further quantities by name;
    ceiling: relative, see `Bounded`
    """

    machine: Machine
    scheme: Scheme
    task: Task
    history: History
    ceiling: float = CEILING


class Held(NamedTuple):
    """scheme: memory of the scheme that is bounded"""

    scheme: Any


@pytree
class Bounded(Guard):
    """A scheme that sees no error beyond a level, and stops learning for good in a trial that
    passes it.

        y seen = clip(y, r - level, r + level),    memory' = memory if max |e| > level, else what
        the scheme makes of it

    Below the level it is the scheme, number for number. Past it every later trial repeats that
    trial, so its error stays finite, and so does its gradient, which says how that trial came to
    pass the level; what the level cuts off has the gradient zero. A diverging learning process so
    has a loss of about log(ceiling / floor), and a slope that leads out of there.
    level: (n_y,) > 0 [unit of y]
    """

    scheme: Scheme = child()
    level: Leaf = leaf(interval="(0, inf)")

    @classmethod
    def around(cls, scheme: Scheme, task: Task, ceiling: float = CEILING) -> Bounded:
        """level: `ceiling` times the peak of the reference."""
        return cls(scheme, lax.stop_gradient(ceiling * peak(task)))

    def initial_memory(self, task: Task) -> Held:
        return Held(self.scheme.initial_memory(task))

    def act(self, state, sample: Sample) -> tuple[Any, jax.Array]:
        return self.scheme.act(
            state,
            sample._replace(y=jnp.clip(sample.y, sample.r - self.level, sample.r + self.level)),
        )

    def learn(self, memory: Held, trial: Trial) -> Held:
        passed = ~jnp.all(jnp.abs(trial.e) <= self.level)
        seen = trial._replace(y=jnp.clip(trial.y, trial.r - self.level, trial.r + self.level))
        learned = self.scheme.learn(memory.scheme, seen)
        return Held(
            jax.tree.map(lambda old, new: jnp.where(passed, old, new), memory.scheme, learned)
        )


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
) -> jax.Array:
    """() the objective of one plant's learning process, bounded. Pure. save: further quantities,
    for objectives of these
    """
    history = learn(
        machine, Bounded.around(scheme, task, ceiling), task, trials, key=key, save=save
    )
    return objective(Run(machine, scheme, task, history, ceiling))


_POSITIVE, _COUNT = ("(0, inf)", False), ("[1, inf)", True)
_RANGES = dict.fromkeys(("floor", "tolerance", "width", "scale", "below"), _POSITIVE)
_RANGES |= dict.fromkeys(("trial", "first", "after", "trials", "steps"), _COUNT)

# Objectives
# --------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Objective:
    """A function of a `Run` to a number. `nominal`: it is asked of the nominal plant only, and no
    risk is taken of it.
    """

    nominal: ClassVar[bool] = False

    def __post_init__(self):
        """Raises ValueError, naming the field, for a number that no objective could have."""
        for field in dataclasses.fields(self):
            value, (allowed, whole) = (
                getattr(self, field.name),
                _RANGES.get(field.name, ("", False)),
            )
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
    """sum_i weight_i objective_i. parts: (weight, objective) pairs"""

    parts: tuple[tuple[float, Objective], ...]

    @property
    def terms(self):
        return self.parts

    def __call__(self, run: Run):
        return sum((w * term(run) for w, term in self.parts), jnp.zeros(()))


@dataclasses.dataclass(frozen=True)
class Final(Objective):
    """l of the figure at one trial. trial: number of it, None for the last;  floor: relative to the
    peak of the reference
    """

    figure: str = "settled_error"
    trial: int | None = None
    floor: float = FLOOR

    def __call__(self, run: Run):
        x = levels(run, self.figure, self.floor)
        if self.trial is not None and not 1 <= self.trial <= len(x):
            raise ValueError(
                f"Final: trial = {self.trial} is outside its allowed range [1, {len(x)}]"
            )
        return x[-1 if self.trial is None else self.trial - 1]


@dataclasses.dataclass(frozen=True)
class EveryTrial(Objective):
    """Mean of l over the trials: learn fast. floor: relative"""

    figure: str = "settled_error"
    floor: float = FLOOR

    def __call__(self, run: Run):
        return jnp.mean(levels(run, self.figure, self.floor))


@dataclasses.dataclass(frozen=True)
class Holding(Objective):
    """Largest l from a trial on: the level that is reached by then and kept. first: number of that
    trial;  floor: relative
    """

    first: int = 1
    figure: str = "settled_error"
    floor: float = FLOOR

    def __call__(self, run: Run):
        x = levels(run, self.figure, self.floor)
        if not 1 <= self.first <= len(x):
            raise ValueError(
                f"Holding: first = {self.first} is outside its allowed range [1, {len(x)}]"
            )
        return largest(x[self.first - 1 :])


@dataclasses.dataclass(frozen=True)
class TrialsTo(Objective):
    """Number of trials above a tolerance, made smooth: sum_j 1 / (1 + (tolerance / x_j)^(1/width)).

    tolerance: [unit of the figure];  width: of the transition in units of log x; towards 0 it is
    the count
    """

    tolerance: float
    figure: str = "settled_error"
    width: float = 0.5

    def __call__(self, run: Run):
        x = levels(run, self.figure, FLOOR)
        limit = jnp.log(self.tolerance / largest(peak(run.task)) / FLOOR)
        return jnp.sum(jax.nn.sigmoid((x - limit) / self.width))


@dataclasses.dataclass(frozen=True)
class Growth(Objective):
    """All growth from trial to trial: sum_j max(0, l(x_{j+1}) - l(x_j)), the logarithm of the
    factor by which the figure rose altogether.

    after: trials that may still grow;  floor: relative, what happens below it counts little
    """

    figure: str = "settled_error"
    after: int = 1
    floor: float = FLOOR

    def __call__(self, run: Run):
        x = levels(run, self.figure, self.floor)[self.after - 1 :]
        return jnp.sum(jax.nn.relu(jnp.diff(x)))


@dataclasses.dataclass(frozen=True)
class Effort(Objective):
    """Mean square input of the last trial over scale^2, all inputs together. scale: [unit of u]"""

    scale: float = 1.0

    def __call__(self, run: Run):
        return jnp.mean((run.history.effort[-1] / self.scale) ** 2)


@dataclasses.dataclass(frozen=True)
class InputRate(Objective):
    """Mean square of (u[k+1] - u[k]) / dt in the last trial over scale^2. scale: [unit of u per s]"""

    scale: float = 1.0

    def __call__(self, run: Run):
        return jnp.mean((jnp.diff(run.history.final.u, axis=0) / run.task.dt / self.scale) ** 2)


@dataclasses.dataclass(frozen=True)
class Contraction(Objective):
    """How far the learning map of the nominal plant misses a certified contraction: max(0,
    log(sigma / below)), 0 if it has it.

    sigma = sup |e_{j+n}| / |e_j| over all small changes of the error
    (`theory.contraction.error_map`). Its slope is that of |J v| at
    the singular vector v that Lanczos found: d sigma = u^T dJ v, so the iteration itself need not
    be differentiated.
    below: what sigma shall stay below;  trials: n;  steps: of Lanczos
    """

    below: float = 1.0
    trials: int = 1
    steps: int = 60
    nominal: ClassVar[bool] = True

    def __call__(self, run: Run):
        from ..theory.contraction import error_map, singular_value

        def last_of(scheme):
            map_ = error_map(run.machine, scheme, run.task, trials=self.trials)
            return lambda e: map_.f(e)[-1], map_.at

        f, at = last_of(lax.stop_gradient(run.scheme))
        v = lax.stop_gradient(singular_value(f, at, steps=self.steps).direction)
        f, at = last_of(run.scheme)
        sigma = jnp.linalg.norm(jax.jvp(f, (at,), (v,))[1])
        return jax.nn.relu(jnp.log(sigma / self.below))


def levels(run: Run, figure: str, floor: float) -> jax.Array:
    """(J,) l of a figure, the largest of its channels; of a trial that passed the ceiling anywhere,
    l of max |e| if that is larger.

    Otherwise a start of the trial that diverges, outside the settled window, would go unseen, as
    the bound stops it from spreading.
    Raises ValueError naming the figures there are.
    """
    history = run.history
    anywhere = largest(history.max_error / peak(run.task), axis=1)
    if figure in Metrics._fields[:3]:
        x = getattr(history.metrics, figure) / peak(run.task)
    elif figure in (history.saved or {}):
        x = history.saved[figure] / largest(peak(run.task))
    else:
        raise ValueError(
            f"figure = {figure!r} is not one of {', '.join((*Metrics._fields[:3], *(history.saved or {})))}"
        )
    x = largest(jnp.abs(x.reshape(len(x), -1)), axis=1)
    x = jnp.where(anywhere <= run.ceiling, x, jnp.maximum(x, anywhere))
    return 0.5 * jnp.log(x**2 + floor**2) - jnp.log(floor)
