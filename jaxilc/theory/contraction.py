"""Contraction of any scheme without a matrix: the gain and the growth of its learning maps.

    learning_map   memory -> trial -> next memory, of all that a scheme knows, estimates included,
                   or of the parts of it that are named
    error_map      e_j -> e_{j+1}, ..., e_{j+J}, what becomes of the error of a trial; I - G L for
                   a linear law, and defined for any scheme

Both are differentiated through the simulator, forward (`jvp`) and backward (`vjp`), each at the
cost of a trial, and their gain and growth are found by the methods of Lanczos and Arnoldi
(`spectrum`). The maps are pure functions and may be vmapped over machines; the conditions are not
for use inside compiled code. The scheme may adapt, switch and be nonlinear. What is found is then
true near the memory at which it was found, as far as the simulation has the derivative that JAX
gives it; a rounding has none. It is true everywhere where the map is affine, which is read off its
program (`structure`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from ..learning.machine import Machine
from ..learning.over_trials import check
from ..plants.structure import acting, blind, obstacle
from ..pytree.named_paths import named_leaves
from ..pytree.needs import known
from ..pytree.ranges import require
from ..schemes import Scheme
from ..schemes.scheme import Memory
from ..signals.task import Task
from .condition import Condition, Premise, condition, premise
from .linearity import alike_trials, linear_law
from .spectrum import SingularValue, SpectralRadius, singular_value, spectral_radius_of
from .trials import LEARNED, Prescribed, disturbed, learned_from, learned_memory, step, trial_of

__all__ = [
    "LEARNED",
    "Map",
    "SingularValue",
    "SpectralRadius",
    "attracting",
    "contracting",
    "error_contracting",
    "error_map",
    "learned_memory",
    "learning_map",
    "singular_value",
    "spectral_radius_of",
]

FLAGS = ("seen",)  # leaves of a memory that only tell the first trial from the others
OF_OUTPUT = ("y",)  # leaves of a memory that have the unit of the output
FIXED = 1e-6  # by how much of itself a trial may move a memory that counts as a fixed point

CONTRACTION = (
    "largest singular value of the learning map < 1: it contracts in the 2-norm of the weighted "
    "memory (Banach), {where}"
)
ERROR = (
    "sup |e_(j+{n})| / |e_j| < 1 over all {which}changes of the error: the 2-norm of the error "
    "contracts in {n} trial(s), {where}"
)
ATTRACTION = (
    "spectral radius of the learning map < 1: its fixed point attracts (Ostrowski 1960; linear: "
    "Bristow 2006), {where}"
)
EVERYWHERE, NEARBY = "everywhere, as the map is affine", "near the memory at which it is linearised"
RESOLVED = "iteration converged"
DIFFERENTIABLE = "the derivative is that of the simulation"


# The maps
# --------------------------------------------------------------------------------------------------


class Map(NamedTuple):
    """A map and where to linearise it: f from (n,) to (m,) or (J, m), at a point (n,)."""

    f: Callable[[jax.Array], jax.Array]
    at: jax.Array


def learning_map(
    machine: Machine,
    scheme: Scheme,
    task: Task,
    memory: Memory = None,
    *,
    leaves: tuple[str, ...] | None = None,
    weights: Mapping[str, float] | None = None,
) -> Map:
    """One trial and its learning, as a map on the weighted memory.

    memory:  where to linearise; None for the memory after 3 trials
    leaves:  names of what varies, while all else is held: "u", or "learning.phi", which is all of
             phi[0], phi[1], ...; None for all on which a trial to come depends, but flags. What
             only tells of the past is no state: a counter would be an eigenvalue 1. ("u", "y") of
             MFAILC leaves out its estimates. That matters: at a fixed point without error
             nothing moves phi, so the full map has the eigenvalue 1 there, once for each phi that
             no reset holds. u alone says nothing, as y goes with it
    weights: {name: number} by which leaves are multiplied before they are compared, as u, y and phi
             have different units. Spectral radii do not depend on them, singular values do. A leaf
             without a weight is brought to the size of the output by rms(y) / rms(leaf), or by 1 if
             either is zero; `y` keeps its unit. Of several names that fit a leaf, the longest
             counts

    Raises ValueError for a name that is not in the memory, a weight that is not above 0, or a
    memory without anything that varies.
    """
    _need_weights(weights or {})
    scheme = scheme.prepared(task)
    memory = learned_memory(machine, scheme, task) if memory is None else memory
    found = named_leaves(memory)
    names, values = list(found), [jnp.asarray(v) for v in found.values()]
    for name in (*(leaves or ()), *(weights or ())):
        if not any(_names(name, of) for of in names):
            there = ", ".join(names) or "nothing"
            raise ValueError(f"learning_map: {name!r} is not in this memory; known: {there}")

    def turn(fixed, memory):
        machine, scheme, task = fixed
        trial = trial_of(machine, scheme, task, memory)
        return scheme.learn(memory, trial), trial.y, trial.u

    if leaves is not None:
        varies = [any(_names(name, of) for name in leaves) for of in names]
    else:
        acts = acting(turn, (machine, scheme, task), memory)
        varies = [
            one and of.split(".")[-1] not in FLAGS for of, one in zip(names, acts, strict=True)
        ]
    floating = [jnp.issubdtype(value.dtype, jnp.floating) for value in values]
    varies = [v and floats for v, floats in zip(varies, floating, strict=True)]
    if not any(varies):
        raise ValueError(
            f"learning_map: the memory of {type(scheme).__name__} has no floating leaf that varies"
        )
    size_y = _rms(trial_of(machine, scheme, task, memory).y)
    named = zip(names, values, strict=True)
    scales = [_weight(of, value, weights or {}, size_y) for of, value in named]
    shape = jax.tree.structure(memory)

    def flat(of_memory):
        leaves = zip(jax.tree.leaves(of_memory), scales, varies, strict=True)
        return jnp.concatenate([(w * v).ravel() for v, w, free in leaves if free])

    def unflat(x):
        rest, at = [], 0
        for value, w, free in zip(values, scales, varies, strict=True):
            rest.append(x[at : at + value.size].reshape(value.shape) / w if free else value)
            at += value.size if free else 0
        return shape.unflatten(rest)

    return Map(lambda x: flat(step(machine, scheme, task, unflat(x))), flat(memory))


def error_map(
    machine: Machine, scheme: Scheme, task: Task, memory: Memory = None, *, trials: int = 1
) -> Map:
    """From the error of a trial, (N n_y,), to those of the next `trials` trials, (J, N n_y).

    Another error e[1..N] is brought about by the repetitive disturbance of the output that causes
    it, which then stays. So it is the error that is prescribed, not the input: that trial is run
    with the prescribed output fed back, and nothing has to be inverted. For a linear law under a
    linear loop G the derivative is (I - G L)^j. A scheme that adapts also learns from the change,
    which is part of the derivative.

    memory: with which the trial is entered; None for the memory after 3 trials
    """
    scheme = scheme.prepared(task)
    memory = learned_memory(machine, scheme, task) if memory is None else memory
    first = trial_of(machine, scheme, task, memory)

    def f(e):
        y = jnp.concatenate([first.y[:1], first.r[1:] - e.reshape(task.N, -1)])
        trial = trial_of(machine, Prescribed(scheme), task, (memory, y))
        after = disturbed(machine, "output", y - trial.y)

        def following(memory, _):
            trial = trial_of(after, scheme, task, memory)
            return learned_from(after, scheme, memory, trial), trial.e[1:].ravel()

        known = learned_from(machine, scheme, memory, trial._replace(y=y))
        return lax.scan(following, known, length=trials)[1]

    return Map(f, first.e[1:].ravel())


def _need_weights(weights: Mapping[str, float]) -> None:
    for name, weight in weights.items():
        if known(weight):
            require("learning_map", f"weights[{name!r}]", weight, "(0, inf)")


def _names(name: str, leaf: str) -> bool:
    """Whether a name means this leaf, or an object that this leaf is a part of."""
    return leaf == name or leaf.startswith((f"{name}.", f"{name}["))


def _weight(leaf: str, value, weights: Mapping[str, float], size_y):
    named = [name for name in weights if _names(name, leaf)]
    if named:
        return weights[max(named, key=len)]
    size = _rms(value)
    usable = (size > 0) & (size_y > 0) & (leaf.split(".")[-1] not in OF_OUTPUT)
    return jnp.where(usable, size_y / jnp.where(size > 0, size, 1.0), 1.0)


def _rms(signal):
    return jnp.sqrt(jnp.mean(signal**2))


# Conditions on them
# --------------------------------------------------------------------------------------------------


def contracting(
    machine: Machine, scheme: Scheme, task: Task, memory: Memory = None, *, weights=None, **options
) -> Condition:
    """The learning map contracts in the norm of the weighted memory.

    weights: as for `learning_map`
    options: `leaves` as for `learning_map`; `steps`, `tolerance` as for `spectrum.singular_value`

    Raises ValueError where machine, scheme and task do not fit, for a name that is not in the
    memory, or for a weight that is not above 0.
    """
    check(machine, scheme, task)
    _need_weights(weights or {})
    found, distance = _singular_of_memory(machine, scheme, task, memory, weights, **options)
    premises, where = _where(machine, scheme, task, memory, options.get("leaves"), distance)
    theorem = CONTRACTION.format(where=where)
    return condition(found.value, theorem, premises=(*premises, _bounded(found)))


def attracting(
    machine: Machine, scheme: Scheme, task: Task, memory: Memory = None, **options
) -> Condition:
    """The fixed point of the learning map attracts.

    Where the doubt of the spectral radius leaves open whether it is < 1, it still is if the eighth
    power of the derivative contracts, since rho^8 <= ||J^8||. A radius above 1 is told as open too
    where it was found in fewer steps than the map has rows: the doubt is of first order, and a map
    that is far from normal shows values that are no eigenvalues.

    options: `leaves` of `learning_map`; `steps` of `spectral_radius_of`

    Raises as `contracting` does.
    """
    check(machine, scheme, task)
    found, distance, rows = _radius_of_memory(machine, scheme, task, memory, **options)
    premises, where = _where(machine, scheme, task, memory, options.get("leaves"), distance)
    value, doubt = float(found.value), float(found.doubt)
    clear = abs(value - 1) > doubt and (value < 1 or bool(found.steps == rows))
    resolved = premise(RESOLVED, clear, f"{value:.9g} within {doubt:.1e}")
    if not resolved.held and value < 1:
        power = _singular_of_power(machine, scheme, task, memory, **options)
        resolved = _bounded(power)._replace(detail=f"||J^8|| = {float(power.value):.3g}")
    return condition(found.value, ATTRACTION.format(where=where), premises=(*premises, resolved))


def error_contracting(
    machine: Machine,
    scheme: Scheme,
    task: Task,
    memory: Memory = None,
    *,
    trials: int = 1,
    **options,
) -> Condition:
    """A change of the error, whatever its shape, is smaller `trials` trials later; see `error_map`.

    options: `steps`, `tolerance` of `spectrum.singular_value`

    Raises ValueError where machine, scheme and task do not fit.
    """
    check(machine, scheme, task)
    found = _singular_of_error(machine, scheme, task, memory, trials=trials, **options)
    memory = _like_learned(machine, scheme, task) if memory is None else memory
    fixed, at = (machine, scheme, task, memory), jnp.zeros(task.N * task.outputs)

    def errors(fixed, at):
        return error_map(*fixed, trials=trials).f(at)

    affine = bool(linear_law(scheme, task, memory).held) and not obstacle(errors, fixed, at)
    where, which = (EVERYWHERE, "") if affine else (NEARBY, "small ")
    theorem = ERROR.format(n=trials, which=which, where=where)
    smooth = affine or not blind(errors, fixed, at)
    premises = _differentiable(smooth), alike_trials(machine, scheme, task), _bounded(found)
    return condition(found.value, theorem, premises=premises)


@partial(jax.jit, static_argnames=("leaves", "steps", "tolerance"))
def _singular_of_memory(
    machine, scheme, task, memory, weights, *, leaves=None, steps=300, tolerance=0.0
):
    map_ = learning_map(machine, scheme, task, memory, leaves=leaves, weights=weights)
    return singular_value(*map_, steps=steps, tolerance=tolerance), _distance(map_)


@partial(jax.jit, static_argnames=("leaves", "steps"))
def _radius_of_memory(machine, scheme, task, memory, *, leaves=None, steps=100):
    map_ = learning_map(machine, scheme, task, memory, leaves=leaves)
    return spectral_radius_of(*map_, steps=steps), _distance(map_), map_.at.size


@partial(jax.jit, static_argnames=("leaves", "steps"))
def _singular_of_power(machine, scheme, task, memory, *, leaves=None, steps=100):
    map_ = learning_map(machine, scheme, task, memory, leaves=leaves)
    _, push = jax.linearize(*map_)
    eighth = lambda x: lax.fori_loop(0, 8, lambda _, x: push(x), x)  # noqa: E731
    return singular_value(eighth, jnp.zeros_like(map_.at), steps=steps)


@partial(jax.jit, static_argnames=("trials", "steps", "tolerance"))
def _singular_of_error(machine, scheme, task, memory, *, trials, steps=300, tolerance=0.0):
    at = error_map(machine, scheme, task, memory, trials=trials)
    return singular_value(*at, steps=steps, tolerance=tolerance, row=trials - 1)


def _distance(map_: Map):
    """|f(at) - at| / |at|, zero at a fixed point."""
    moved, size = jnp.linalg.norm(map_.f(map_.at) - map_.at), jnp.linalg.norm(map_.at)
    return jnp.where(moved > 0, moved / size, 0.0)


def _where(machine, scheme, task, memory, leaves, distance) -> tuple[tuple[Premise, ...], str]:
    """The premises of a derivative at one memory, and where what it says is true."""
    memory = _like_learned(machine, scheme, task) if memory is None else memory
    fixed = machine, scheme, task, memory
    at = jax.eval_shape(lambda *fixed: learning_map(*fixed, leaves=leaves).at, *fixed)
    law = linear_law(scheme, task, memory)

    def learned(fixed, at):
        return learning_map(*fixed, leaves=leaves).f(at)

    why = obstacle(learned, fixed, at) or ("" if law.held else law.detail)
    moved = f"another trial moves the memory by {float(distance):.1e} of itself"
    found = f"{why or 'affine, read off its program'}; {moved}"
    local = premise("map affine, or taken at its fixed point", not why or distance <= FIXED, found)
    smooth = not why or not blind(learned, fixed, at)
    premises = local, _differentiable(smooth), alike_trials(machine, scheme, task)
    return premises, NEARBY if why else EVERYWHERE


def _like_learned(machine, scheme, task) -> Memory:
    """The shapes of a memory that was learned, which are all that reading a program needs."""
    return jax.eval_shape(learned_memory, machine, scheme, task)


def _differentiable(smooth: bool) -> Premise:
    found = "read off its program" if smooth else "that of a part is made up, as of rounding"
    return premise(DIFFERENTIABLE, smooth, found)


def _bounded(found: SingularValue) -> Premise:
    """The premise that the iteration came close enough to tell whether the value is below 1."""
    clear = found.bound < 1 or found.value >= 1
    told = f"{float(found.value):.9g}, and at most {float(found.bound):.9g}"
    return premise(RESOLVED, clear, told)
