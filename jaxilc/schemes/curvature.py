"""The largest eigenvalue of a symmetric map, with derivatives in what the map depends on."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax

STEPS = 10  # of the Lanczos process
ROUNDING = 100.0  # in units of the last place


def largest_eigenvalue(f: Callable, like, steps: int = STEPS) -> jax.Array:
    """() the largest eigenvalue of a positive semidefinite map f, from below.

        f V = V T + beta v e'

    V is orthonormal (Lanczos, reorthogonalised in full, twice) and starts from a fixed random
    direction. The largest eigenvalue of the tridiagonal T is never above that of f, except for
    rounding, and is equal to it where the process comes to its end before the steps do.

    f: from the shape of `like` to the same
    steps: at most so many, and at most the number of elements
    Unlike `theory.spectrum`, which looks at the residual to decide when to stop, this has a fixed
    number of steps, and so derivatives, backward and of any order.
    """
    n = like.size
    start = jax.random.normal(jax.random.key(0), (n,), like.dtype)
    small = ROUNDING * jnp.finfo(like.dtype).eps

    def advance(now, i):
        basis, v = now
        basis = basis.at[i].set(v)
        image = f(v.reshape(like.shape)).ravel()
        rest = image
        for _ in range(2):
            rest = rest - (basis @ rest) @ basis
        square = rest @ rest
        # What rounding alone leaves over is no direction.
        goes_on = square > small**2 * (image @ image)
        beta = jnp.sqrt(jnp.where(goes_on, square, 1.0))
        following = jnp.where(goes_on, rest / beta, 0.0)
        return (basis, following), (v @ image, jnp.where(goes_on, beta, 0.0))

    steps = min(steps, n)
    before = jnp.zeros((steps, n), like.dtype), start / jnp.linalg.norm(start)
    _, (alpha, beta) = lax.scan(advance, before, jnp.arange(steps))
    # After the end of the process the diagonal is negative, each element by another amount: an
    # eigenvalue that occurs twice has no derivative.
    ended = jnp.cumsum(beta[:-1] == 0) > 0
    after = -alpha[0] * jnp.arange(1, steps)
    diagonal = alpha.at[1:].set(jnp.where(ended, after, alpha[1:]))
    T = jnp.diag(diagonal) + jnp.diag(beta[:-1], 1) + jnp.diag(beta[:-1], -1)
    return jnp.linalg.eigvalsh(T)[-1]
