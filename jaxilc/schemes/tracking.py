"""The problem of following a target by a nonlinear model: its cost, its bounds and its motion.

The unknown is w (N, n), an input of the model or what is added to one:

    minimise  |t - y|^2_Wq + |w - c|^2_Wr + |w|^2_Ws + |D w|^2_Wd,    y = f(w + added) + beside

subject to bounds on w, on its rate and on y.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree

from ..plants import linearised
from ..signals.task import Trial, product
from .constraints import Rows, kinds, rows_of, system_of
from .riccati import System


class Problem(NamedTuple):
    """The problem that this module states.

    model: plant of n inputs and n_y outputs, prepared for the sample time
    target: (N+1, n_y) t
    near: (N, n) c
    added: (N, n) signal that is added to w at the model's input
    beside: (N+1, n_y) signal that is added to the model's output
    w_q, w_r, w_s, w_d: weights as matrices; w_d may be None
    limit, rate, y_low, y_high, tube: bounds as those of `ConstrainedNormOptimal`, each may be None
    """

    model: Any
    target: jax.Array
    near: jax.Array
    added: jax.Array
    beside: jax.Array
    w_q: jax.Array
    w_r: jax.Array
    w_s: jax.Array
    w_d: jax.Array | None = None
    limit: jax.Array | None = None
    rate: jax.Array | None = None
    y_low: jax.Array | None = None
    y_high: jax.Array | None = None
    tube: jax.Array | None = None

    # the kinds of rows that this problem never has
    total = contour = feedback = None

    @property
    def bounded(self) -> bool:
        return any(b is not None for b in self[self._fields.index("limit") :])

    @property
    def weights(self) -> tuple[jax.Array, ...]:
        """w_q, w_r, w_s and w_d as `constraints.weight_of` takes them."""
        rest = jnp.zeros_like(self.w_r)
        return self.w_q, self.w_r, self.w_s, rest if self.w_d is None else self.w_d


class Motion(NamedTuple):
    """w (N, n), and the states x[0..N-1] (N, n_x) and the outputs y (N+1, n_y) that it gives."""

    w: jax.Array
    x: jax.Array
    y: jax.Array


class Way(NamedTuple):
    """The way to the optimum of a linear problem: the change of w and of x, and the feedback K."""

    d: jax.Array
    z: jax.Array
    K: jax.Array


def half_cost(problem: Problem, w, y) -> jax.Array:
    """Half the cost of w and of the output y (N+1, n_y)."""
    Q, R, S, rate = problem.weights
    e, off = (problem.target - y)[1:], w - problem.near
    steps = jnp.concatenate([w[:1], w[1:] - w[:-1]])
    terms = ((e, Q), (off, R), (w, S), (steps, rate))
    return jnp.stack([jnp.sum(signal * (signal @ W)) for signal, W in terms]).sum() / 2


def rows_at(problem: Problem, w, y, dt: float) -> Rows:
    """The rows of all kinds side by side, each (N, m)."""
    rows = rows_of(problem, Trial(problem.target, y, w, dt))
    of = zip(*(rows[kind] for kind in kinds(problem)), strict=True)
    return Rows(*(jnp.concatenate(each, axis=1) for each in of))


def slope_at(problem: Problem, w, y, now) -> jax.Array:
    """(N, m) the derivative of half the cost by a change of each row. now: (N, m) the rows."""
    Q, R, S, rate = problem.weights
    of = [(w - problem.near) @ R + w @ S, -(problem.target - y)[1:] @ Q]
    if "rate" in kinds(problem):
        of.append(now[:, -w.shape[1] :] @ rate)
    return jnp.concatenate(of, axis=1)


def beyond(problem: Problem, at: Motion, dt: float) -> tuple[jax.Array, jax.Array]:
    """(N, m) the distances of the rows beyond their bounds, and (m,) the largest bound of each."""
    now, low, high = rows_at(problem, at.w, at.y, dt)
    sizes = (jnp.max(jnp.where(jnp.isfinite(b), jnp.abs(b), 0.0), axis=0) for b in (low, high))
    largest = jnp.maximum(*sizes)
    off = jnp.maximum(jnp.maximum(low - now, now - high), 0.0)
    return off, jnp.where(largest > 0, largest, 1.0)


def linear_form(problem: Problem, w, dt: float) -> System:
    """The system from a change of w to that of the rows, along the motion of w."""
    model = linearised(problem.model, w + problem.added, dt)
    return system_of(problem._replace(model=model), problem.target)


def moved(problem: Problem, at: Motion, way: Way, share, dt: float) -> Motion:
    """The nonlinear motion under a share of a way, with its feedback, and w within its bounds."""
    model, states = problem.model, at.x.shape[1]
    w, z = at.w + share * way.d, share * way.z
    limit = jnp.inf if problem.limit is None else problem.limit
    most = jnp.inf if problem.rate is None else problem.rate * dt
    with_rate = z.shape[1] > states

    def step(carry, now):
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
    _, (real, x, y) = lax.scan(step, (first, (rest, rest)), rows)
    return Motion(real, x, jnp.concatenate([model.output(first)[None], y]) + problem.beside)
