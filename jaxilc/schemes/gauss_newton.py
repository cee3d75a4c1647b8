"""Following a target by a nonlinear model (`tracking`), with Gauss and Newton's method.

Each iteration takes the linear form of the model along the present motion, and goes to the optimum
of the linear problem: a Riccati recursion, or the interior point where there are bounds. How far it
goes is decided by the true cost of the nonlinear motion.

The motion to the next iterate is not that of an input alone, which an unstable model leaves at
once. It has the feedback of the Riccati recursion on what separates it from the motion that the
linear form predicts (as in differential dynamic programming, Jacobson and Mayne 1970).
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree

from . import interior_point
from .constraints import kinds, weight_of
from .riccati import carried, factor, newton, shown
from .tracking import (
    Motion,
    Problem,
    Way,
    beyond,
    half_cost,
    linear_form,
    moved,
    rows_at,
    slope_at,
)

STEPS = 60  # iterations at most; most problems that can be solved take 3 to 15
HALVINGS = 25  # of a step, at most
MOVED = 1e-9  # the last step, as a share of the root of the cost, in double precision
MOVED_IN_BOUNDS = 1e-6  # the same with bounds: the interior point leaves its gap
VIOLATION = 1e-6  # of a bound, as a share of the largest bound of its row
DESCENT = 1e-4  # share of the predicted decrease that a step must reach (Armijo)


class Found(NamedTuple):
    """What the solver found.

    w: (N, n) zero where it did not converge
    converged: () 1 where the last step and the violation are within their tolerances, else 0
    steps: () iterations
    moved: () the last step, as a share of the root of the cost
    violation: () largest distance beyond a bound, in units of the largest bound of its row
    s, l: (2, N, m) slacks and multipliers, as in `interior_point.Solution`
    """

    w: jax.Array
    converged: jax.Array
    steps: jax.Array
    moved: jax.Array
    violation: jax.Array
    s: jax.Array
    l: jax.Array  # noqa: E741


class _Course(NamedTuple):
    """An iterate; `good` is 1 as long as the linear problems are solved and steps succeed."""

    at: Motion
    penalty: jax.Array
    good: jax.Array
    steps: jax.Array
    moved: jax.Array
    s: jax.Array
    l: jax.Array  # noqa: E741


@partial(jax.jit, static_argnums=2)
def solve(problem: Problem, start, dt: float) -> Found:
    """The optimum that Gauss and Newton's method finds from w = start (N, n)."""
    course = _first(problem, start, dt)
    tolerance = _tolerance(problem)

    def going_on(course: _Course):
        return (course.good > 0) & (course.moved > tolerance) & (course.steps < STEPS)

    course = lax.while_loop(going_on, lambda course: _turn(problem, course, dt), course)
    off, unit = beyond(problem, course.at, dt)
    violation = jnp.max(off / unit)
    solved = (course.good > 0) & (course.moved <= tolerance) & (violation <= VIOLATION)
    return Found(
        jnp.where(solved, course.at.w, 0.0),
        jnp.where(solved, jnp.ones_like(violation), 0.0),
        course.steps,
        course.moved,
        violation,
        course.s,
        course.l,
    )


def _tolerance(problem: Problem) -> float:
    rounding = float(jnp.finfo(problem.target.dtype).eps)
    if problem.bounded:
        return max(MOVED_IN_BOUNDS, 1e4 * rounding)
    return max(MOVED, 1e3 * rounding)


def _first(problem: Problem, start, dt: float) -> _Course:
    """The motion of the start itself, within the bounds of w."""
    m = len(weight_of(problem, problem.weights))
    states = ravel_pytree(problem.model.initial_state())[0].size
    further = start.shape[1] if "rate" in kinds(problem) else 0
    N, n = start.shape
    still = jnp.zeros((N, states + further), start.dtype)
    way = Way(jnp.zeros_like(start), still, jnp.zeros((N, n, states + further), start.dtype))
    at = moved(problem, Motion(start, still[:, :states], problem.target), way, 1.0, dt)
    none, zero = jnp.zeros((2, N, m), start.dtype), jnp.zeros((), start.dtype)
    return _Course(at, zero, zero + 1, zero, zero + jnp.inf, none + 1, none)


def _turn(problem: Problem, course: _Course, dt: float) -> _Course:
    """One iteration: the optimum of the linear problem, and a step towards it."""
    at = course.at
    system, W = linear_form(problem, at.w, dt), weight_of(problem, problem.weights)
    now, low, high = rows_at(problem, at.w, at.y, dt)
    slope, cost = slope_at(problem, at.w, at.y, now), half_cost(problem, at.w, at.y)
    free = factor(system, W, jnp.zeros_like(now))
    if problem.bounded:
        linear = interior_point.Problem(system, W, slope, low - now, high - now, cost)
        found = interior_point.solve(linear, free)
        d, good, s, l = found.d, found.converged, found.s, found.l  # noqa: E741
        stiff = jnp.sum(interior_point.stiffness(system, free, s, l), axis=0)
        K = factor(system, W, stiff).K
    else:
        (d, _), K, s, l = newton(system, free, slope), free.K, course.s, course.l  # noqa: E741
        good = jnp.where(jnp.all(jnp.isfinite(d)), 1.0, 0.0)
    v = shown(system, d)
    penalty = jnp.maximum(course.penalty, 2 * jnp.max(l))
    over = jnp.sum(beyond(problem, at, dt)[0])
    descent = jnp.sum(slope * v) - penalty * over
    way = Way(d, carried(system, d), K)
    at, accepted = _searched(problem, at, way, cost + penalty * over, descent, penalty, dt)
    size = _size(problem, course.at, cost)
    share = jnp.sqrt(jnp.sum(v * (v @ W)) / 2 / size)
    return _Course(at, penalty, good * accepted, course.steps + 1, share, s, l)


def _size(problem: Problem, at: Motion, cost):
    """The cost that a step is compared with; where it is rounding, a small share of the signals."""
    signals = (problem.target[1:], at.y[1:])
    whole = sum(jnp.sum(signal * (signal @ problem.w_q)) for signal in signals) / 2
    resolved = 1e3 * jnp.finfo(cost.dtype).eps / _tolerance(problem)
    return cost + resolved**2 * whole + jnp.finfo(cost.dtype).tiny * 1e30


def _searched(problem: Problem, at: Motion, way: Way, now, descent, penalty, dt: float):
    """The motion after the first of the steps 1, 1/2, 1/4, ... that lowers the true cost, and 1.

    Where none does, it is the present motion, and 0.
    """
    rounding = 1e3 * float(jnp.finfo(now.dtype).eps)
    # the optimum of the linear problem is known to the gap of the interior point only
    slack = (interior_point.gap_of(now.dtype) if problem.bounded else rounding) * jnp.abs(now)

    def tried(share):
        motion = moved(problem, at, way, share, dt)
        over = jnp.sum(beyond(problem, motion, dt)[0])
        cost = half_cost(problem, motion.w, motion.y) + penalty * over
        # a cost that is not finite is no descent
        return share, motion, cost <= now + DESCENT * share * jnp.minimum(descent, 0.0) + slack

    def going_on(course):
        share, _, good = course
        return ~good & (share > 2.0**-HALVINGS)

    before = (2 * jnp.ones_like(now), at, jnp.zeros((), bool))
    _, motion, good = lax.while_loop(going_on, lambda course: tried(course[0] / 2), before)
    motion = jax.tree.map(lambda new, old: jnp.where(good, new, old), motion, at)
    return motion, jnp.where(good, jnp.ones_like(now), 0.0)
