"""The optimum of a problem of `tracking`, with its derivative.

The derivative is that of the conditions of optimality (implicit function theorem), with all second
derivatives of the model, and not that of the iterations. Where only values are asked for, it costs
nothing.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree
from jax.scipy.linalg import block_diag

from ..plants import motion
from ..runtime.jax_internals import once, with_slope
from . import gauss_newton
from .constraints import weight_of
from .gauss_newton import Found
from .interior_point import ONE_DERIVATIVE, stiffness
from .riccati import System, factor, newton
from .tracking import Motion, Problem, Way, half_cost, linear_form, moved, rows_at, slope_at


def optimum(problem: Problem, start, dt: float) -> Found:
    """The optimum that Gauss and Newton's method finds from w = start (N, n).

    w may be differentiated once, forwards or backwards, in all numbers of the problem; where the
    solver did not converge, its derivative is zero. The other fields have none. A second derivative
    raises ValueError.
    """
    return with_slope(partial(gauss_newton.solve, dt=dt), partial(_tangent, dt))(problem, start)


class _Curved(NamedTuple):
    """The second derivative of the Lagrange function by w, as the cost of rows of a system.

    The rows are those of the problem, then the state, then w itself.

    W: (N, m, m), D: (N, m) as for `riccati.factor`
    held: (2, N, m') the weights with which bounds hold the rows of the problem
    """

    system: System
    W: jax.Array
    D: jax.Array
    held: jax.Array


def _tangent(dt: float, at: tuple, by: tuple) -> Found:
    """The slope of `optimum` for `with_slope`."""
    problem, found = once((at[0], optimum(*at, dt)), ONE_DERIVATIVE)
    solved, n = found.converged > 0, found.w.shape[1]

    def of(problem: Problem) -> jax.Array:
        return _slope(_calm(problem, solved), found, curved.held, dt)

    curved = _curvature(_calm(problem, solved), found, dt)
    # a problem that was not solved may be NaN, which times zero would spoil the others of a batch
    system, W, D = jax.tree.map(lambda M: jnp.where(solved, M, 0.0), curved[:3])
    eye = jnp.eye(W.shape[-1])
    system = system._replace(G_d=jnp.where(solved, system.G_d, eye[:, -n:]))
    W = jnp.where(solved, W, eye)
    _, change = jax.jvp(of, (problem,), (by[0],))
    q = jnp.pad(change, ((0, 0), (W.shape[-1] - n, 0)))
    d, _ = newton(system, factor(system, W, D), q)
    rest = jax.tree.map(jnp.zeros_like, found)
    return rest._replace(w=jnp.where(solved, d, 0.0))


def _calm(problem: Problem, solved) -> Problem:
    """The problem, without the signals of a trial that could not be solved."""
    signals = {name: getattr(problem, name) for name in ("target", "near", "added", "beside")}
    return problem._replace(**{name: jnp.where(solved, x, 0.0) for name, x in signals.items()})


@partial(jax.jit, static_argnums=3)
def _slope(problem: Problem, found: Found, held, dt: float) -> jax.Array:
    """(N, n) the derivative of the Lagrange function by w, at w of the optimum.

    The multipliers l follow their rows, l' = -held (row - bound)'.
    """
    w = lax.stop_gradient(found.w)

    def rows(w):
        y = motion(problem.model, w + problem.added, dt) + problem.beside
        return half_cost(problem, w, y), rows_at(problem, w, y, dt)

    now, low, high = rows(w)[1]
    pull = found.l[0] - found.l[1]
    for stiff, bound in zip(held, (low, high), strict=True):
        there = jnp.isfinite(bound)
        off = now - jnp.where(there, bound, now)
        pull = pull - stiff * (off - lax.stop_gradient(off))

    def lagrange(w):
        cost, (now, _, _) = rows(w)
        return cost - jnp.sum(pull * now)

    return jax.grad(lagrange)(w)


@partial(jax.jit, static_argnums=2)
def _curvature(problem: Problem, found: Found, dt: float) -> _Curved:
    """The second derivative at the optimum.

    What the linear form leaves out is that of the model, weighted with the adjoint p of the state:

        H[k] = d^2/d(x, w)^2 (q[k]' h(f(x, w)) + p[k+1]' f(x, w)),
        p[k] = A[k]' (p[k+1] + C[k]' q[k]),    q[k]: derivative by y[k+1]
    """
    at = _motion(problem, found.w, dt)
    system, W = linear_form(problem, at.w, dt), weight_of(problem, problem.weights)
    free = factor(system, W, jnp.zeros(found.s.shape[1:]))
    held = stiffness(system, free, found.s, found.l)
    now, _, _ = rows_at(problem, at.w, at.y, dt)
    slope = slope_at(problem, at.w, at.y, now) - (found.l[0] - found.l[1])
    n, states = at.w.shape[1], at.x.shape[1]
    q = slope[:, n : n + at.y.shape[1]]
    p = _adjoint(system, slope, n, at.y.shape[1], states)
    unravel = ravel_pytree(problem.model.initial_state())[1]

    def weighted(xw, added, q, p):
        after = problem.model.step(unravel(xw[:states]), xw[states:] + added, dt)
        return q @ problem.model.output(after) + p @ ravel_pytree(after)[0]

    xw = jnp.concatenate([at.x, at.w], axis=1)
    H = jax.vmap(jax.hessian(weighted))(xw, problem.added, q, p)
    N, width = len(xw), system.A.shape[-1]
    further = jnp.eye(width + n)
    both = (
        jnp.concatenate([M, jnp.broadcast_to(part, (N, *part.shape))], axis=1)
        for M, part in (
            (jnp.broadcast_to(system.G_z, (N, *system.G_z.shape[-2:])), further[:, :width]),
            (jnp.broadcast_to(system.G_d, (N, *system.G_d.shape[-2:])), further[:, width:]),
        )
    )
    # between the state and w there may be the input of the sample before, which is linear
    place = jnp.delete(further, slice(states, width), axis=1)
    H = place @ H @ place.T
    W = jax.vmap(lambda H: block_diag(W, H))(H)
    D = jnp.pad(jnp.sum(held, axis=0), ((0, 0), (0, width + n)))
    return _Curved(System(system.A, system.B, *both), W, D, held)


def _motion(problem: Problem, w, dt: float) -> Motion:
    """The motion under w."""
    states = ravel_pytree(problem.model.initial_state())[0].size
    still = jnp.zeros((len(w), states), w.dtype)
    way = Way(jnp.zeros_like(w), still, jnp.zeros((*w.shape, states), w.dtype))
    free = problem._replace(limit=None, rate=None)
    return moved(free, Motion(w, still, problem.target), way, 1.0, dt)


def _adjoint(system: System, slope, n: int, outputs: int, states: int) -> jax.Array:
    """(N, n_x) the derivative p[k+1] of what follows the output y[k+1] by the state x[k+1]."""
    G = jnp.broadcast_to(system.G_z, (len(slope), *system.G_z.shape[-2:]))
    A = jnp.broadcast_to(system.A, (len(slope), *system.A.shape[-2:]))
    q = slope[:, n : n + outputs]

    def back(p, now):
        A, G, q = now
        return A.T @ p + G.T @ q, p

    # the row of the output at k is C[k] A[k], with the matrix C of the sample after
    rest = jnp.zeros(states, slope.dtype)
    return lax.scan(
        back, rest, (A[:, :states, :states], G[:, n : n + outputs, :states], q), reverse=True
    )[1]
