"""The error that frequency responses predict of a learning law with several channels.

    u_{j+1} = keep u_j + L e_j,    e_j = e_1 - P u_j,    M = keep - L P

    e_j = (1 - P (1 + M + ... + M^(j-2)) L) e_1

frequency by frequency, with matrices. What does not repeat adds |P L n|^2 / (1 - |M|^2) at most.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp

from .responses import Family

DOUBLINGS = 5
SHARPNESS = 2.0 ** (DOUBLINGS + 1)


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
    M = keep - _times(L, P)
    size = _size(M)
    M = M * jnp.minimum(1.0, near / (size + 1e-12))[..., None, None]
    PL = _times(P, L)
    learned = _square(units[:, None] * PL * family.noise[:, None, :]).sum((-2, -1))
    learned = jnp.sum(learned / (1 - jnp.minimum(size, near) ** 2), axis=1)
    found = []
    for trial in trials:
        whole = _sum_of_powers(M, trial - 1)
        share = jnp.eye(P.shape[-2]) - _times(_times(P, whole), L)
        left = units[:, None] * _times(share, family.error)
        found.append(jnp.sum(_square(left), axis=(1, 2, 3)) + learned)
    return size, found


def _size(M):
    """The norm (sum of the singular values to the power SHARPNESS)^(1 / SHARPNESS), by products."""
    A = _times(jnp.swapaxes(M.conj(), -1, -2), M)
    total = jnp.trace(A, axis1=-2, axis2=-1).real + 1e-24
    A = A / total[..., None, None]
    for _ in range(DOUBLINGS):
        A = _times(A, A)
    share = jnp.trace(A, axis1=-2, axis2=-1).real
    return jnp.sqrt(total) * share ** (1 / SHARPNESS)


def _sum_of_powers(M, count: int):
    """1 + M + ... + M^(count - 1)"""
    if count <= 1:
        return jnp.broadcast_to(count * jnp.eye(M.shape[-1]), M.shape).astype(M.dtype)
    if count % 2:
        return jnp.eye(M.shape[-1]) + _times(M, _sum_of_powers(M, count - 1))
    half = _sum_of_powers(M, count // 2)
    return half + _times(_power(M, count // 2), half)


def _power(M, count: int):
    """M^count, count >= 1"""
    if count == 1:
        return M
    half = _power(M, count // 2)
    whole = _times(half, half)
    return _times(M, whole) if count % 2 else whole


def _times(A, B):
    """A B of many small matrices, six times as fast on a CPU as a batch of matrix products."""
    return jnp.sum(A[..., :, :, None] * B[..., None, :, :], axis=-2)


def _square(z):
    return z.real**2 + z.imag**2
