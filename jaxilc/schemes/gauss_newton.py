"""Following a target by a nonlinear model, with Gauss and Newton's method.

The unknown is w (N, n), an input of the model or what is added to one:

    minimise  |t - y|^2_Wq + |w - c|^2_Wr + |w|^2_Ws + |D w|^2_Wd,    y = f(w + added) + beside

subject to bounds on w, on its rate and on y.

Each iteration takes the linear form of the model along the present motion, and goes to the optimum
of the linear problem: a Riccati recursion, or the interior point where there are bounds. How far it
goes is decided by the true cost of the nonlinear motion.

The motion to the next iterate is not that of an input alone, which an unstable model leaves at
once. It has the feedback of the Riccati recursion on what separates it from the motion that the
linear form predicts (as in differential dynamic programming, Jacobson and Mayne 1970).

The derivative of the optimum is that of the conditions of optimality (implicit function theorem),
with all second derivatives of the model, and not that of the iterations. Where only values are
asked for, it costs nothing.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree
from jax.scipy.linalg import block_diag

from ..plants import linearised, motion
from ..pytree.aliases import Array, Tree
from ..runtime.jax_internals import once, with_slope
from ..runtime.lanes import over_samples
from ..signals.task import Trial, product
from . import interior_point
from .constraints import Rows, kinds, rows_of, side_by_side, stacked, system_of, weight_of
from .interior_point import ONE_DERIVATIVE, stiffness
from .riccati import System, adjoint, answer, factor, newton


class Problem(NamedTuple):
    """The problem that this module states.

    model: plant of n inputs and n_y outputs, prepared for the sample time
    target: (N+1, n_y) t
    near: (N, n) c
    added: (N, n) signal that is added to w at the model's input
    beside: (N+1, n_y) signal that is added to the model's output
    w_q, w_r, w_s, w_d: weights as matrices; w_d may be None
    limit, rate, y_low, y_high, tube: bounds as those of `ConstrainedNormOptimal`, each may be None
    total, contour, feedback: None; this problem never has rows of these kinds
    """

    model: Tree
    target: Array
    near: Array
    added: Array
    beside: Array
    w_q: Array
    w_r: Array
    w_s: Array
    w_d: Array | None = None
    limit: Array | None = None
    rate: Array | None = None
    y_low: Array | None = None
    y_high: Array | None = None
    tube: Array | None = None
    total: Array | None = None
    contour: Array | None = None
    feedback: Array | None = None

    @property
    def bounded(self) -> bool:
        return any(b is not None for b in self[self._fields.index("limit") :])

    @property
    def weights(self) -> tuple[Array, ...]:
        """w_q, w_r, w_s and w_d as `constraints.weight_of` takes them."""
        rest = jnp.zeros_like(self.w_r)
        return self.w_q, self.w_r, self.w_s, rest if self.w_d is None else self.w_d


class Motion(NamedTuple):
    """w (N, n), and the states x[0..N-1] (N, n_x) and the outputs y (N+1, n_y) that it gives."""

    w: Array
    x: Array
    y: Array


class Way(NamedTuple):
    """The way to the optimum of a linear problem: the change of w and of x, and the feedback K."""

    d: Array
    z: Array
    K: Array


def half_cost(problem: Problem, w: Array, y: Array) -> Array:
    """Half the cost of w and of the output y (N+1, n_y)."""
    Q, R, S, rate = problem.weights
    e, off = (problem.target - y)[1:], w - problem.near
    steps = jnp.concatenate([w[:1], w[1:] - w[:-1]])
    terms = ((e, Q), (off, R), (w, S), (steps, rate))
    return jnp.stack([jnp.sum(signal * (signal @ W)) for signal, W in terms]).sum() / 2


def rows_at(problem: Problem, w: Array, y: Array, dt: float) -> Rows:
    """The rows of all kinds side by side, each (N, m)."""
    return side_by_side(rows_of(problem, Trial(problem.target, y, w, dt)))


def slope_at(problem: Problem, w: Array, y: Array, now: Array) -> Array:
    """(N, m) the derivative of half the cost by a change of each row. now: (N, m) the rows."""
    Q, R, S, rate = problem.weights
    of = [(w - problem.near) @ R + w @ S, -(problem.target - y)[1:] @ Q]
    if "rate" in kinds(problem):
        of.append(now[:, -w.shape[1] :] @ rate)
    return jnp.concatenate(of, axis=1)


def beyond(problem: Problem, at: Motion, dt: float) -> tuple[Array, Array]:
    """(N, m) the distances of the rows beyond their bounds, and (m,) the largest bound of each."""
    now, low, high = rows_at(problem, at.w, at.y, dt)
    sizes = (jnp.max(jnp.where(jnp.isfinite(b), jnp.abs(b), 0.0), axis=0) for b in (low, high))
    largest = jnp.maximum(*sizes)
    off = jnp.maximum(jnp.maximum(low - now, now - high), 0.0)
    return off, jnp.where(largest > 0, largest, 1.0)


def linear_form(problem: Problem, w: Array, dt: float) -> System:
    """The system from a change of w to that of the rows, along the motion of w."""
    model = linearised(problem.model, w + problem.added, dt)
    return system_of(problem._replace(model=model), problem.target)


def moved(problem: Problem, at: Motion, way: Way, share: Array | float, dt: float) -> Motion:
    """The nonlinear motion under a share of a way, with its feedback, and w within its bounds."""
    model, states = problem.model, at.x.shape[1]
    w, z = at.w + share * way.d, share * way.z
    limit = jnp.inf if problem.limit is None else problem.limit
    most = jnp.inf if problem.rate is None else problem.rate * dt
    with_rate = z.shape[1] > states

    def step(carry: Tree, now: Tree) -> tuple[Tree, Tree]:
        x, before = carry
        w_k, added, x_k, z_k, K_k = now
        off = ravel_pytree(x)[0] - x_k - z_k[:states]
        if with_rate:
            off = jnp.concatenate([off, before[1] - before[0]])
        real = jnp.clip(w_k - product(K_k, off), -limit, limit)
        real = jnp.clip(real, before[1] - most, before[1] + most)
        after = model.step(x, real + added, dt)
        return (after, (w_k, real)), (real, ravel_pytree(x)[0], model.output(after))

    rest = jnp.zeros_like(w[0])
    first = model.initial_state()
    rows = (w, problem.added, at.x, z, way.K)
    _, (real, x, y) = over_samples(step, (first, (rest, rest)), rows)
    return Motion(real, x, jnp.concatenate([model.output(first)[None], y]) + problem.beside)


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

    w: Array
    converged: Array
    steps: Array
    moved: Array
    violation: Array
    s: Array
    l: Array  # noqa: E741


class _Course(NamedTuple):
    """An iterate; `good` is 1 as long as the linear problems are solved and steps succeed."""

    at: Motion
    penalty: Array
    good: Array
    steps: Array
    moved: Array
    s: Array
    l: Array  # noqa: E741


@partial(jax.jit, static_argnums=2)
def solve(problem: Problem, start: Array, dt: float) -> Found:
    """The optimum that Gauss and Newton's method finds from w = start (N, n)."""
    course = _first(problem, start, dt)
    tolerance = _tolerance(problem)

    def going_on(course: _Course) -> Array:
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


def _first(problem: Problem, start: Array, dt: float) -> _Course:
    """The motion of the start itself, within the bounds of w."""
    m = len(weight_of(problem, problem.weights))
    none, zero = jnp.zeros((2, len(start), m), start.dtype), jnp.zeros((), start.dtype)
    return _Course(
        _motion(problem, start, dt), zero, zero + 1, zero, zero + jnp.inf, none + 1, none
    )


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
        stiff = jnp.sum(stiffness(system, free, s, l), axis=0)
        K = factor(system, W, stiff).K
    else:
        (d, _), K, s, l = newton(system, free, slope), free.K, course.s, course.l  # noqa: E741
        good = jnp.where(jnp.all(jnp.isfinite(d)), 1.0, 0.0)
    z, v = answer(system, d)
    penalty = jnp.maximum(course.penalty, 2 * jnp.max(l))
    over = jnp.sum(beyond(problem, at, dt)[0])
    descent = jnp.sum(slope * v) - penalty * over
    way = Way(d, z, K)
    at, accepted = _searched(problem, at, way, cost + penalty * over, descent, penalty, dt)
    size = _size(problem, course.at, cost)
    share = jnp.sqrt(jnp.sum(v * (v @ W)) / 2 / size)
    return _Course(at, penalty, good * accepted, course.steps + 1, share, s, l)


def _size(problem: Problem, at: Motion, cost: Array) -> Array:
    """The cost that a step is compared with; where it is rounding, a small share of the signals."""
    signals = (problem.target[1:], at.y[1:])
    whole = sum(jnp.sum(signal * (signal @ problem.w_q)) for signal in signals) / 2
    resolved = 1e3 * jnp.finfo(cost.dtype).eps / _tolerance(problem)
    return cost + resolved**2 * whole + jnp.finfo(cost.dtype).tiny * 1e30


def _searched(
    problem: Problem, at: Motion, way: Way, now: Tree, descent: Array, penalty: Array, dt: float
) -> tuple[Tree, Tree]:
    """The motion after the first of the steps 1, 1/2, 1/4, ... that lowers the true cost, and 1.

    Where none does, it is the present motion, and 0.
    """
    rounding = 1e3 * float(jnp.finfo(now.dtype).eps)
    # the optimum of the linear problem is known to the gap of the interior point only
    slack = (interior_point.gap_of(now.dtype) if problem.bounded else rounding) * jnp.abs(now)

    def tried(share: Array) -> tuple[Array, Motion, Array]:
        motion = moved(problem, at, way, share, dt)
        over = jnp.sum(beyond(problem, motion, dt)[0])
        cost = half_cost(problem, motion.w, motion.y) + penalty * over
        # a cost that is not finite is no descent
        return share, motion, cost <= now + DESCENT * share * jnp.minimum(descent, 0.0) + slack

    def going_on(course: tuple[Array, Motion, Array]) -> Array:
        share, _, good = course
        return ~good & (share > 2.0**-HALVINGS)

    before = (2 * jnp.ones_like(now), at, jnp.zeros((), bool))
    _, motion, good = lax.while_loop(going_on, lambda course: tried(course[0] / 2), before)
    motion = jax.tree.map(lambda new, old: jnp.where(good, new, old), motion, at)
    return motion, jnp.where(good, jnp.ones_like(now), 0.0)


def optimum(problem: Problem, start: Array, dt: float) -> Found:
    """The optimum that Gauss and Newton's method finds from w = start (N, n).

    w may be differentiated once, forwards or backwards, in all numbers of the problem; where the
    solver did not converge, its derivative is zero. The other fields have none. A second derivative
    raises ValueError.
    """
    return with_slope(partial(solve, dt=dt), partial(_tangent, dt))(problem, start)


def _tangent(dt: float, at: tuple[Problem, Array], by: tuple[Problem, Array]) -> Found:
    """The slope of `optimum` for `with_slope`."""
    problem, found = once((at[0], optimum(*at, dt)), ONE_DERIVATIVE)
    solved, n = found.converged > 0, found.w.shape[1]

    def of(problem: Problem) -> Array:
        return _slope(_calm(problem, solved), found, held, dt)

    held, *curved = _curvature(_calm(problem, solved), found, dt)
    # a problem that was not solved may be NaN, which times zero would spoil the others of a batch
    system, W, D = jax.tree.map(lambda M: jnp.where(solved, M, 0.0), curved)
    eye = jnp.eye(W.shape[-1])
    system = system._replace(G_d=jnp.where(solved, system.G_d, eye[:, -n:]))
    W = jnp.where(solved, W, eye)
    _, change = jax.jvp(of, (problem,), (by[0],))
    q = jnp.pad(change, ((0, 0), (W.shape[-1] - n, 0)))
    d, _ = newton(system, factor(system, W, D), q)
    rest = jax.tree.map(jnp.zeros_like, found)
    return rest._replace(w=jnp.where(solved, d, 0.0))


def _calm(problem: Problem, solved: Array) -> Problem:
    """The problem, without the signals of a trial that could not be solved."""
    signals = {name: getattr(problem, name) for name in ("target", "near", "added", "beside")}
    return problem._replace(**{name: jnp.where(solved, x, 0.0) for name, x in signals.items()})


@partial(jax.jit, static_argnums=3)
def _slope(problem: Problem, found: Found, held: Array, dt: float) -> Array:
    """(N, n) the derivative of the Lagrange function by w, at w of the optimum.

    The multipliers l follow their rows, l' = -held (row - bound)'.
    """
    w = lax.stop_gradient(found.w)

    def rows(w: Array) -> tuple[Array, Rows]:
        y = motion(problem.model, w + problem.added, dt) + problem.beside
        return half_cost(problem, w, y), rows_at(problem, w, y, dt)

    now, low, high = rows(w)[1]
    pull = found.l[0] - found.l[1]
    for stiff, bound in zip(held, (low, high), strict=True):
        there = jnp.isfinite(bound)
        off = now - jnp.where(there, bound, now)
        pull = pull - stiff * (off - lax.stop_gradient(off))

    def lagrange(w: Array) -> Array:
        cost, (now, _, _) = rows(w)
        return cost - jnp.sum(pull * now)

    return jax.grad(lagrange)(w)


@partial(jax.jit, static_argnums=2)
def _curvature(problem: Problem, found: Found, dt: float) -> tuple[Array, System, Array, Array]:
    """The second derivative of the Lagrange function by w at the optimum, as the cost of rows.

    It is the weights (2, N, m') with which bounds hold the rows of the problem, and system, W and D
    of `riccati.factor`, whose rows are those of the problem, then the state, then w itself. What
    the linear form leaves out is that of the model, weighted with the adjoint p of the state:

        H[k] = d^2/d(x, w)^2 (q[k]' h(f(x, w)) + p[k+1]' f(x, w)),
        p[k] = A[k]' (p[k+1] + C[k]' q[k]),    q[k]: derivative by y[k+1]
    """
    at = _motion(problem._replace(limit=None, rate=None), found.w, dt)
    system, W = linear_form(problem, at.w, dt), weight_of(problem, problem.weights)
    free = factor(system, W, jnp.zeros(found.s.shape[1:]))
    held = stiffness(system, free, found.s, found.l)
    now, _, _ = rows_at(problem, at.w, at.y, dt)
    slope = slope_at(problem, at.w, at.y, now) - (found.l[0] - found.l[1])
    n, states = at.w.shape[1], at.x.shape[1]
    q = slope[:, n : n + at.y.shape[1]]
    p = adjoint(system, slope)[0][:, :states]
    unravel = ravel_pytree(problem.model.initial_state())[1]

    def weighted(xw: Array, added: Array, q: Array, p: Array) -> Array:
        after = problem.model.step(unravel(xw[:states]), xw[states:] + added, dt)
        return q @ problem.model.output(after) + p @ ravel_pytree(after)[0]

    xw = jnp.concatenate([at.x, at.w], axis=1)
    H = jax.vmap(jax.hessian(weighted))(xw, problem.added, q, p)
    width = system.A.shape[-1]
    further = jnp.eye(width + n)
    both = stacked([system.G_z, further[:, :width]]), stacked([system.G_d, further[:, width:]])
    # between the state and w there may be the input of the sample before, which is linear
    place = jnp.delete(further, slice(states, width), axis=1)
    H = place @ H @ place.T
    W = jax.vmap(lambda H: block_diag(W, H))(H)
    D = jnp.pad(jnp.sum(held, axis=0), ((0, 0), (0, width + n)))
    return held, System(system.A, system.B, *both), W, D


def _motion(problem: Problem, w: Array, dt: float) -> Motion:
    """The motion under w, within its bounds."""
    states = ravel_pytree(problem.model.initial_state())[0].size
    still = jnp.zeros((len(w), states), w.dtype)
    way = Way(jnp.zeros_like(w), still, jnp.zeros((*w.shape, states), w.dtype))
    return moved(problem, Motion(w, still, problem.target), way, 1.0, dt)
