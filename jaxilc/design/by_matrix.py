"""The error that frequency responses predict of a learning law with several channels.

    u_{j+1} = keep u_j + L e_j,    e_j = e_1 - P u_j,    M = keep - L P

    e_j = (1 - P (1 - M)^-1 (1 - M^(j-1)) L) e_1

frequency by frequency, with matrices. What does not repeat adds |P L n|^2 / (1 - |M|^2) at most.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp

from .responses import Family

SHARPNESS = 64.0


def of_matrices(family: Family, keep, L, trials: Sequence[int], near: float):
    """(S, F) sizes of M, and for some trials (S,) the predicted mean square error.

    The size is a norm of the singular values that has a slope where two of them are equal, as they
    are where nothing is learned yet; it exceeds the largest one by n_u^(1 / SHARPNESS) at most.

    Each channel counts in units of its own largest error in the first trial.

    keep: (F, n_u, n_u), L: (F, n_u, n_y) responses of the law
    near: largest size of M with which an error is predicted; M is made smaller to it
    """
    P = jnp.asarray(family.P)
    units = 1 / jnp.maximum(jnp.max(jnp.abs(family.first_error), axis=0), 1e-300)
    M = keep - jnp.einsum("fij,sfjk->sfik", L, P)
    values = jnp.linalg.svd(M, compute_uv=False)
    powers = SHARPNESS * jnp.log(jnp.maximum(values, jnp.finfo(values.dtype).tiny))
    size = jnp.exp(jax.nn.logsumexp(powers, axis=-1) / SHARPNESS)
    M = M * jnp.minimum(1.0, near / (size + 1e-12))[..., None, None]
    one = jnp.eye(M.shape[-1])
    PL = jnp.einsum("sfij,fjk->sfik", P, L)
    learned = _square(units[:, None] * PL * family.noise[:, None, :]).sum((-2, -1))
    learned = jnp.sum(learned / (1 - jnp.minimum(size, near) ** 2), axis=1)
    found = []
    for trial in trials:
        whole = jnp.linalg.solve(one - M, one - jnp.linalg.matrix_power(M, trial - 1))
        share = jnp.eye(P.shape[-2]) - jnp.einsum("sfij,sfjk,fkl->sfil", P, whole, L)
        left = units[:, None] * jnp.einsum("sfij,fjk->sfik", share, family.error)
        found.append(jnp.sum(_square(left), axis=(1, 2, 3)) + learned)
    return size, found


def _square(z):
    return z.real**2 + z.imag**2
