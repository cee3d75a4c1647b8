"""Contraction of any scheme without a matrix: the gain and the growth of its learning maps.

The maps (`maps`) are differentiated through the simulator, and their gain and growth are found by
the methods of Lanczos and Arnoldi (`iteration`). The scheme may adapt, switch and be nonlinear.
What is found is then true near the memory at which it was found, as far as the simulation has the
derivative that JAX gives it; a rounding has none. It is true everywhere where the map is affine,
which is read off its program (`structure`).
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from ..learning.machine import Machine
from ..learning.over_trials import check
from ..schemes import Scheme
from ..signals.task import Task
from .condition import Condition, Premise, condition, premise
from .iteration import SingularValue, SpectralRadius, singular_value, spectral_radius_of
from .linearity import linear_law
from .maps import Map, error_growth, error_map, learning_map, over_plants
from .structure import blind, obstacle
from .trials import LEARNED, learned_memory

__all__ = [
    "LEARNED",
    "Map",
    "SingularValue",
    "SpectralRadius",
    "attracting",
    "contracting",
    "error_contracting",
    "error_growth",
    "error_map",
    "learned_memory",
    "learning_map",
    "over_plants",
    "singular_value",
    "spectral_radius_of",
]

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


# Conditions: not for use inside compiled code
# ------------------------------------------------------------------------------


def contracting(
    machine: Machine, scheme: Scheme, task: Task, memory: Any = None, *, weights=None, **options
) -> Condition:
    """The learning map contracts in the norm of the weighted memory.

    weights: as for `learning_map`
    options: `leaves` as for `learning_map`; `steps`, `tolerance` as for `iteration.singular_value`

    Raises ValueError where machine, scheme and task do not fit, or for a name that is not in the
    memory.
    """
    check(machine, scheme, task)
    found, distance = _singular_of_memory(machine, scheme, task, memory, weights, **options)
    premises, where = _where(machine, scheme, task, memory, options.get("leaves"), distance)
    return condition(
        found.value, CONTRACTION.format(where=where), premises=(*premises, _bounded(found))
    )


def attracting(
    machine: Machine, scheme: Scheme, task: Task, memory: Any = None, **options
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
    machine: Machine, scheme: Scheme, task: Task, memory: Any = None, *, trials: int = 1, **options
) -> Condition:
    """A change of the error, whatever its shape, is smaller `trials` trials later; see `error_map`.

    options: `steps`, `tolerance` of `iteration.singular_value`

    Raises ValueError where machine, scheme and task do not fit.
    """
    check(machine, scheme, task)
    found = _singular_of_error(machine, scheme, task, memory, trials=trials, **options)
    memory = _like_learned(machine, scheme, task) if memory is None else memory
    fixed, at = (machine, scheme, task, memory), jnp.zeros(task.N * task.outputs)
    affine = bool(linear_law(scheme, task, memory).held) and not obstacle(
        partial(_errors, trials=trials), fixed, at
    )
    theorem = ERROR.format(
        n=trials, which="" if affine else "small ", where=EVERYWHERE if affine else NEARBY
    )
    smooth = affine or not blind(partial(_errors, trials=trials), fixed, at)
    return condition(found.value, theorem, premises=(_differentiable(smooth), _bounded(found)))


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
    return singular_value(
        lambda x: lax.fori_loop(0, 8, lambda _, x: push(x), x), jnp.zeros_like(map_.at), steps=steps
    )


@partial(jax.jit, static_argnames=("trials", "steps", "tolerance"))
def _singular_of_error(machine, scheme, task, memory, *, trials, steps=300, tolerance=0.0):
    return singular_value(
        *error_map(machine, scheme, task, memory, trials=trials),
        steps=steps,
        tolerance=tolerance,
        row=trials - 1,
    )


def _distance(map_: Map):
    """|f(at) - at| / |at|, zero at a fixed point."""
    moved, size = jnp.linalg.norm(map_.f(map_.at) - map_.at), jnp.linalg.norm(map_.at)
    return jnp.where(moved > 0, moved / size, 0.0)


def _where(machine, scheme, task, memory, leaves, distance) -> tuple[tuple[Premise, Premise], str]:
    """The premises of a derivative at one memory, and where what it says is true."""
    memory = _like_learned(machine, scheme, task) if memory is None else memory
    fixed = machine, scheme, task, memory
    at = jax.eval_shape(lambda *fixed: learning_map(*fixed, leaves=leaves).at, *fixed)
    law = linear_law(scheme, task, memory)
    why = "" if law.held else law.detail
    why = obstacle(partial(_learned, leaves=leaves), fixed, at) or why
    found = (
        f"{why or 'affine, read off its program'}; another trial moves the memory by "
        f"{float(distance):.1e} of itself"
    )
    local = premise("map affine, or taken at its fixed point", not why or distance <= FIXED, found)
    smooth = not why or not blind(partial(_learned, leaves=leaves), fixed, at)
    return (local, _differentiable(smooth)), NEARBY if why else EVERYWHERE


def _like_learned(machine, scheme, task) -> Any:
    """The shapes of a memory that was learned, which are all that reading a program needs."""
    return jax.eval_shape(learned_memory, machine, scheme, task)


def _differentiable(smooth: bool) -> Premise:
    return premise(
        DIFFERENTIABLE,
        smooth,
        "read off its program" if smooth else "something is rounded, and its derivative made up",
    )


def _learned(fixed, at, *, leaves):
    return learning_map(*fixed, leaves=leaves).f(at)


def _errors(fixed, at, *, trials):
    return error_map(*fixed, trials=trials).f(at)


def _bounded(found: SingularValue) -> Premise:
    """The premise that the iteration came close enough to tell whether the value is below 1."""
    clear = found.bound < 1 or found.value >= 1
    return premise(
        RESOLVED, clear, f"{float(found.value):.9g}, and at most {float(found.bound):.9g}"
    )
