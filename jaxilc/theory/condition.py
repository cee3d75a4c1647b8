"""One shape for every condition of convergence: a number, how far it is from its limit, and what the claim rests on.

A condition claims nothing where a premise of its theorem is broken. The numbers come from compiled code, the verdict is given here,
outside of it, where they are known. Premises are looked at, not assumed: that a map is linear is tried on a random step.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..schemes import Filtered, Ladder, MultivariableILC, OnReference, Scheme, StopWhen, WithFeedback
from ..signals import Task, Trial

HOLDS, FAILS, NOT_CLAIMED = "holds", "fails", "not claimed"
ROUNDING = 1000.0  # in units of the last place


class Premise(NamedTuple):
    """What a theorem presumes.

    name: as in "plant stable";  detail: what was looked at, and what was found
    held: () or (S,) whether it holds throughout, for each of S plants;  share_broken: the share of samples, trials or plants without it
    """

    name: str
    held: bool | np.ndarray
    share_broken: float | np.ndarray
    detail: str = ""


class Condition(NamedTuple):
    """A condition `value < limit`.

    value: () or (S,) what was computed;  margin: limit - value, positive where the condition holds
    premises: of the theorem;  theorem: what follows from the condition, and its source
    verdict: 'holds', 'fails' or 'not claimed', of each plant where there are several ((S,) array of text)
    """

    value: float | np.ndarray
    margin: float | np.ndarray
    premises: tuple[Premise, ...]
    theorem: str
    verdict: str | np.ndarray

    @property
    def holds(self) -> bool:
        """Whether it is claimed to hold, for every plant."""
        return bool(np.all(np.asarray(self.verdict) == HOLDS))

    @property
    def broken(self) -> tuple[Premise, ...]:
        """The premises that are broken for some plant."""
        return tuple(p for p in self.premises if not np.all(p.held))


def premise(name: str, holds, detail: str = "", *, plants: bool = False) -> Premise:
    """A premise from what was looked at.

    holds: booleans of any shape, such as (J, N) of trials and samples;  plants: whether the first axis counts plants
    """
    holds = np.asarray(holds, dtype=bool)
    within = tuple(range(1 if plants else 0, holds.ndim))
    return Premise(name, _plain(np.all(holds, axis=within)), _plain(np.mean(~holds, axis=within)), detail)


def condition(value, theorem: str, *, limit: float = 1.0, premises: Iterable[Premise] = ()) -> Condition:
    """The condition `value < limit` with its verdict.

        broken premise, or value not a number  ->  'not claimed';  value < limit  ->  'holds';  else  ->  'fails'

    value: () or (S,);  premises: their `held` is () or (S,). What lies below the limit by rounding only does not hold: a singular value
    that is 1 in theory, as of a law that leaves a sample alone, may come out as 1 - 1e-15.
    """
    value, premises = np.asarray(value), tuple(premises)
    rounding = ROUNDING * np.finfo(value.dtype if value.dtype.kind == "f" else float).eps * abs(limit)
    value = value.astype(float)
    claimed = ~np.isnan(value)
    for p in premises:
        claimed = claimed & p.held
    verdict = np.where(claimed, np.where(value < limit - rounding, HOLDS, FAILS), NOT_CLAIMED)
    return Condition(_plain(value), _plain(limit - value), premises, theorem, _plain(verdict))


def departure(f: Callable, at, seed: int = 0) -> jax.Array:
    """How far f is from its linearisation: |f(at + d) - f(at) - Df(at) d| / |f(at + d) - f(at)| for a random step d.

    f: from one pytree of arrays to another;  at: where it is linearised
    d is as large as `at` itself (root mean square of each leaf), or 1 where that is 0, so that a limit within this reach shows.
    Zero up to rounding for an affine map, and for a randomly drawn d only then. Pure.
    """
    leaves, shape = jax.tree.flatten(at)
    random, steps = np.random.default_rng(seed), []
    for leaf in leaves:
        size = jnp.sqrt(jnp.mean(leaf**2))
        steps.append(jnp.where(size > 0, size, 1.0) * jnp.asarray(random.standard_normal(jnp.shape(leaf)), leaf.dtype))
    d = shape.unflatten(steps)
    here, predicted = jax.jvp(f, (at,), (d,))
    moved = jax.tree.map(lambda a, b: a - b, f(jax.tree.map(lambda a, b: a + b, at, d)), here)
    return ratio(_size(jax.tree.map(lambda a, b: a - b, moved, predicted)), _size(moved))


def linear(name: str, departed, detail: str, *, plants: bool = False) -> Premise:
    """The premise that a map is linear, from its `departure`."""
    detail = f"{detail}; departs from its linearisation by {float(np.max(departed)):.1e}"
    return premise(name, is_linear(departed), detail, plants=plants)


def is_linear(departed) -> np.ndarray:
    """Whether rounding explains a departure, also in a badly conditioned loop: half of the digits agree."""
    departed = np.asarray(departed)
    return departed <= np.sqrt(np.finfo(departed.dtype).eps)


def ratio(a, b) -> jax.Array:
    """a / b of two sizes, 0 where both are 0."""
    return jnp.where(a > 0, a / b, 0.0)


def linear_law(scheme: Scheme, task: Task, memory: Any = None) -> Premise:
    """The premise that a scheme learns by one linear law in every trial, looked at over two trials of random input and error."""
    _, *law = learner(scheme, task, memory)
    return linear("learning law linear and the same in each trial", _law_departure(*law), f"{type(law[0]).__name__} over two trials")


def learner(scheme: Scheme, task: Task, memory: Any = None) -> tuple:
    """(filters, scheme, task, memory): the filters of a scheme, outermost first, and its part that learns, with its task and memory."""
    memory = scheme.memory(task) if memory is None else memory
    match scheme:
        case WithFeedback():
            return learner(scheme.learning, task, memory.learning)
        case OnReference():
            return learner(scheme.learning, dataclasses.replace(task, inputs=task.outputs), memory.learning)
        case MultivariableILC():
            return learner(scheme.learning, scheme.learning_task(task), memory.learning)
        case StopWhen() | Ladder():
            return learner(scheme.scheme, task, memory.scheme)
        case Filtered():
            filters, *law = learner(scheme.scheme, task, memory)
            return (scheme.filter, *filters), *law
    return (), scheme, task, memory


def next_input(scheme: Scheme, task: Task, memory: Any) -> Callable:
    """The function (u (N, n_u), e[1..N] (N, n_y)) -> (N, n_u) that gives the next feedforward; e[0], out of reach of u, is zero."""
    return lambda u, e: scheme.feedforward(_learned(scheme, task, memory, u, e), task)


def _learned(scheme, task, memory, u, e):
    r = jnp.asarray(task.reference)
    return scheme.learn(memory, Trial(r, r - jnp.pad(e, ((1, 0), (0, 0))), u, task.dt))


def _still(task):
    return jnp.zeros((task.N, task.inputs)), jnp.zeros((task.N, task.outputs))


@jax.jit
def _law_departure(scheme, task, memory):
    """Departure of two successive random trials from the law linearised before the first."""
    law, still, departed, random = next_input(scheme, task, memory), _still(task), 0.0, np.random.default_rng(0)
    for _ in range(2):
        trial = tuple(jnp.asarray(random.standard_normal(signal.shape), signal.dtype) for signal in still)
        const, predicted = jax.jvp(law, still, trial)
        found = next_input(scheme, task, memory)(*trial) - const
        departed = jnp.maximum(departed, ratio(jnp.linalg.norm(found - predicted), jnp.linalg.norm(found)))
        memory = _learned(scheme, task, memory, *trial)
    return departed


def _size(tree):
    return jnp.sqrt(sum(jnp.sum(leaf**2) for leaf in jax.tree.leaves(tree)))


def _plain(array):
    """A Python value for an array without dimensions."""
    array = np.asarray(array)
    return array.item() if array.ndim == 0 else array
