"""A quadratic programme over the samples of a trial, by an interior point with Riccati steps.

The unknowns are the inputs d of a `riccati.System`, and each of its rows v may have a cost and
bounds:

    minimise  sum_k b[k]' v[k] + v[k]' W v[k] / 2   subject to  low[k] <= v[k] <= high[k]

The method is Mehrotra's predictor and corrector (SIAM J. Optim. 2, 1992). The Newton step of each
iteration is a Riccati recursion, in time and memory linear in N (Rao, Wright, Rawlings, JOTA 99,
1998). It ends at the point of the central path where the duality gap is `GAP` of the cost.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from ..pytree.aliases import Array, Tree, Value
from ..runtime.jax_internals import once, with_slope
from .riccati import Factor, System, adjoint, answer, factor, newton

GAP = 1e-9  # share of the cost, in double precision
RESIDUAL = 1e-8  # of the other two conditions of optimality, each in its own unit
CENTRED = 1e-4  # relative difference of a product s l from the one that is aimed at
STEPS = 60  # iterations at most; most problems that can be solved take 8 to 25
HOPELESS = 1e9  # growth of the gap that says that no input is within all bounds
STIFF = 3e7  # weight of an active bound in the derivative, in units of the cost of the input
TO_BOUND = 0.995  # the largest share of the way to the nearest bound that a step goes
ONE_DERIVATIVE = (
    "the optimum within bounds (ConstrainedNormOptimal, TwoStep) has first derivatives only, and a "
    "second one is asked for; allowed are gradients, and differences of them"
)


class Problem(NamedTuple):
    """The programme above.

    W: (m, m) positive semidefinite, b: (N, m)
    low, high: (N, m) with low < high, infinite where there is no bound
    cost: () of d = 0
    """

    system: System
    W: Array
    b: Array
    low: Array
    high: Array
    cost: Array


class Solution(NamedTuple):
    """What the solver found.

    d: (N, n_u) zero where it did not converge
    steps: () iterations
    gap: () duality gap, as a share of the cost
    stationarity: () largest derivative of the Lagrange function, in units of that of the cost at
        d = 0, or of the multipliers alone if that is larger
    violation: () largest distance of v beyond a bound, in units of the largest bound of its row
    converged: () 1 where the three are within their tolerances, else 0
    s, l: (2, N, m) slacks and multipliers of the bounds from below, and of those from above; the
        multipliers are 0 where there is no bound
    """

    d: Array
    steps: Array
    gap: Array
    stationarity: Array
    violation: Array
    converged: Array
    s: Array
    l: Array  # noqa: E741


class Point(NamedTuple):
    """An iterate: d, v, and of each bound the slack s and the multiplier l, all (2, N, m).

    missing: what s lacks of sign v + offset. It is carried, and shrinks with each step. Computed
        anew it would never fall below rounding, which the weight l / s of an active bound, up to
        1e12, turns into noise of the multipliers
    """

    d: Array
    v: Array
    s: Array
    l: Array  # noqa: E741
    missing: Array


class _Bounds(NamedTuple):
    """The bounds as sign v + offset >= 0, first those from below, then those from above.

    offset, there: (2, N, m), `there` where there is a bound;  sign: (2, 1, 1)
    unit: (m,) largest bound of each row
    count: () number of bounds, at least 1
    """

    offset: Array
    there: Array
    sign: Array
    unit: Array
    count: Array  # type: ignore[assignment]  # tuples of Python have a method of this name


class _Course(NamedTuple):
    """An iterate, its residuals as in `Solution`, and how far it is off the central path."""

    point: Point
    steps: Array
    gap: Array
    stationarity: Array
    violation: Array
    off: Array


def solve(problem: Problem, free: Factor) -> Solution:
    """The optimum; where no bound matters, it is that of the recursion alone, to all digits.

    free: `factor` of the problem without bounds
    The result may be differentiated once, forwards or backwards: the derivative is that of the
    conditions of optimality (implicit function theorem), not that of the iterations. A second
    derivative raises ValueError.
    """
    still, of_free = lax.stop_gradient((problem, free))
    bounds = _bounds_of(still)
    d, v = newton(still.system, of_free, still.b)
    slack = jnp.where(bounds.there, bounds.sign * v + bounds.offset, 1.0)
    fits = jnp.all(slack >= 0) & jnp.all(jnp.isfinite(d))
    untouched = Point(d, v, slack, jnp.zeros_like(slack), jnp.zeros_like(slack))
    at_stake = jnp.maximum(-jnp.sum(still.b * v) / 2, 0.0)
    # where bounds are broken at d = 0, at least a part of what it costs to go all the way to them
    broken = jnp.any(bounds.there & (bounds.offset < 0))
    way = 1e-3 * len(v) * jnp.sum(jnp.diagonal(still.W) * bounds.unit**2)
    at_stake = jnp.where(broken, jnp.maximum(at_stake, way), at_stake)
    course = _iterate(still, bounds, fits, at_stake)
    small = jnp.maximum(jnp.asarray(RESIDUAL), 1e3 * jnp.finfo(d.dtype).eps)
    solved = (
        (course.gap <= 3 * gap_of(d.dtype))
        & (course.stationarity <= small)
        & (course.violation <= small)
    )
    none = jnp.zeros_like(slack)
    nothing = Point(jnp.zeros_like(d), jnp.zeros_like(v), jnp.ones_like(slack), none, none)
    point = jax.tree.map(
        lambda one, other, none: jnp.where(fits, one, jnp.where(solved, other, none)),
        untouched,
        course.point,
        nothing,
    )
    zero, good = jnp.zeros_like(course.gap), fits | solved
    found = (course.steps, course.gap, course.stationarity, course.violation)
    steps, gap, stationarity, violation = (jnp.where(fits, zero, x) for x in found)
    d = point.d + jnp.where(good, _last_step(problem, of_free, point), 0.0)
    converged = jnp.where(good, 1.0, zero)
    return Solution(d, steps, gap, stationarity, violation, converged, point.s, point.l)


def stiffness(system: System, free: Factor, s: Array, l: Array) -> Array:  # noqa: E741
    """(2, N, m) the weights with which bounds hold their rows at an optimum, where they are active.

    An active bound is held by a weight `STIFF` times that of the cost of the input at most: of
    more, rounding would take more digits of the derivative than the weight gives.

    free: `factor` of the problem without bounds;  s, l: as in `Solution`
    """
    cost = jnp.max(jnp.sum(free.L**2, axis=2), axis=1)[:, None]
    reach = jnp.sum(system.G_d**2, axis=-1)
    most = STIFF * cost / jnp.maximum(reach, jnp.finfo(cost.dtype).tiny * 1e30)
    return jnp.where(l > 0, jnp.minimum(l / jnp.where(l > 0, s, 1.0), most), 0.0)


def gap_of(dtype: Value) -> float:
    """The share of the cost that the duality gap ends at, in the precision of dtype."""
    return max(GAP, 1e3 * float(jnp.finfo(dtype).eps))


def _bounds_of(problem: Problem) -> _Bounds:
    offset = jnp.stack([-problem.low, problem.high])
    there = jnp.isfinite(offset)
    offset = jnp.where(there, offset, 1.0)
    unit = jnp.max(jnp.where(there, jnp.abs(offset), 0.0), axis=(0, 1))
    sign = jnp.asarray([1.0, -1.0], offset.dtype)[:, None, None]
    count = jnp.maximum(jnp.sum(there), 1).astype(offset.dtype)
    return _Bounds(offset, there, sign, jnp.where(unit > 0, unit, 1.0), count)


def _iterate(problem: Problem, bounds: _Bounds, fits: Array, at_stake: Array) -> _Course:
    """The iterations, until the iterate is at its place of the central path, or cannot get there.

    fits: () whether the solution without bounds is the optimum, so that nothing is to do
    at_stake: () by how much the cost falls without bounds
    """
    scale = jnp.max(jnp.abs(adjoint(problem.system, problem.b)[1]))
    scale = jnp.where(scale > 0, scale, 1.0)
    dtype = problem.b.dtype
    small = max(1e-12, 30 * float(jnp.finfo(dtype).eps))

    def going_on(course: _Course) -> Array:
        there = (course.off <= CENTRED) & (course.stationarity <= small * 1e2)
        there = there & (course.violation <= small)
        hopeful = jnp.sum(course.point.s * course.point.l) <= HOPELESS * at_stake
        hopeful = hopeful & jnp.isfinite(course.stationarity)
        return ~fits & ~there & hopeful & (course.steps < STEPS)

    def turn(course: _Course) -> _Course:
        return _judged(problem, bounds, scale, _step(problem, bounds, course.point), course.steps)

    first = _judged(problem, bounds, scale, _start(problem, bounds, at_stake), -jnp.ones((), dtype))
    return lax.while_loop(going_on, turn, first)


def _start(problem: Problem, bounds: _Bounds, at_stake: Array) -> Point:
    """d = 0, with slacks that are positive, and products s l of the size of what is at stake."""
    least = 0.1 * bounds.unit
    s = jnp.where(bounds.there, jnp.maximum(bounds.offset, least), 1.0)
    product = jnp.maximum(at_stake / bounds.count, jnp.finfo(s.dtype).tiny * 1e30)
    zero = jnp.zeros_like(problem.b)
    d = jnp.zeros((len(zero), problem.system.B.shape[-1]), zero.dtype)
    missing = jnp.where(bounds.there, bounds.offset - s, 0.0)
    return Point(d, zero, s, jnp.where(bounds.there, product / s, 0.0), missing)


def _target(problem: Problem, bounds: _Bounds, v: Array) -> Array:
    """The product s l of each bound at the end, with which the gap is its share of the cost."""
    cost = problem.cost + jnp.sum(problem.b * v + v * (v @ problem.W) / 2)
    floor = 1e-12 * problem.cost + jnp.finfo(v.dtype).tiny * 1e30
    return gap_of(v.dtype) * jnp.maximum(cost, floor) / bounds.count


def _judged(problem: Problem, bounds: _Bounds, scale: Array, point: Point, steps: Array) -> _Course:
    """The residuals of an iterate."""
    products = jnp.where(bounds.there, point.s * point.l, 0.0)
    target = _target(problem, bounds, point.v)
    off = jnp.max(jnp.where(bounds.there, jnp.abs(products / target - 1), 0.0))
    missing = jnp.where(bounds.there, bounds.sign * point.v + bounds.offset - point.s, 0.0)
    both = _slope(problem, bounds, point), jnp.sum(bounds.sign * point.l, axis=0)
    of_both = jax.vmap(lambda q: adjoint(problem.system, q)[1])(jnp.stack(both))
    slope, forces = jnp.max(jnp.abs(of_both), axis=(1, 2))
    return _Course(
        point,
        steps + 1,
        jnp.sum(products) / (target * bounds.count / gap_of(target.dtype)),
        slope / jnp.maximum(scale, forces),
        jnp.max(jnp.abs(missing) / bounds.unit),
        off,
    )


def _slope(problem: Problem, bounds: _Bounds, point: Point) -> Array:
    """(N, m) the derivative of the Lagrange function with respect to v."""
    return problem.b + point.v @ problem.W - jnp.sum(bounds.sign * point.l, axis=0)


def _step(problem: Problem, bounds: _Bounds, point: Point) -> Point:
    """One step of the predictor and the corrector."""
    system, (_, v, s, l, missing) = problem.system, point  # noqa: E741
    D = jnp.sum(l / s, axis=0)
    of, slope = factor(system, problem.W, D), _slope(problem, bounds, point)

    def direction(wanted: Array) -> Point:
        """For products s l that change by `wanted`."""
        q = slope + jnp.sum(bounds.sign * (l * missing - wanted) / s, axis=0)
        d, v = newton(system, of, q)
        of_s = jnp.where(bounds.there, bounds.sign * v + missing, 0.0)
        return Point(d, v, of_s, (wanted - l * of_s) / s, -missing)

    # the predictor aims at the end, not at zero: there it then does nothing, nor does the corrector
    last = _target(problem, bounds, v)
    ahead = direction(jnp.where(bounds.there, last - s * l, 0.0))
    share = _share(point, ahead, 1.0)
    now = jnp.sum(s * l * bounds.there) / bounds.count
    then = jnp.sum((s + share * ahead.s) * (l + share * ahead.l) * bounds.there) / bounds.count
    aim = jnp.maximum((then / now) ** 3 * now, last)
    move = direction(jnp.where(bounds.there, aim - s * l - ahead.s * ahead.l, 0.0))
    share = _share(point, move, TO_BOUND)
    return jax.tree.map(lambda at, by: at + share * by, point, move)


def _share(point: Point, move: Point, most: float) -> Array:
    """The share of a move, 1 at most, that leaves slacks and multipliers positive."""
    ways = (
        jnp.where(by < 0, -at / jnp.where(by < 0, by, -1.0), jnp.inf)
        for at, by in ((point.s, move.s), (point.l, move.l))
    )
    return jnp.minimum(1.0, most * jnp.minimum(*map(jnp.min, ways)))


def _last_step(problem: Problem, free: Factor, point: Point) -> Array:
    """A Newton step from a point that does not depend on the problem: it carries the derivative.

    The multipliers follow v as constant products s l demand, l' = -(l / s) v'; see `stiffness`.
    """
    still = lax.stop_gradient(problem)
    weight = stiffness(still.system, free, point.s, point.l)
    of = factor(still.system, still.W, jnp.sum(weight, axis=0))

    def step(problem: Problem, point: Point, weight: Array, of: Factor) -> Array:
        bounds, (_, v) = _bounds_of(problem), answer(problem.system, point.d)
        now = bounds.sign * v + bounds.offset
        l = point.l - weight * (now - lax.stop_gradient(now))  # noqa: E741
        return newton(problem.system, of, _slope(problem, bounds, point._replace(v=v, l=l)))[0]

    def tangent(at: tuple[Tree, ...], by: tuple[Tree, ...]) -> Array:
        problem, *rest = once(at, ONE_DERIVATIVE)
        return jax.jvp(lambda problem: step(problem, *rest), (problem,), by[:1])[1]

    return with_slope(step, tangent)(problem, point, weight, of)
