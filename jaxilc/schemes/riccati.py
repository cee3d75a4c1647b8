"""Recursions over the samples of a trial: a linear system forth, its adjoint back, and Riccati.

A system of inputs d[k] (n_u,) carries a state and shows rows v (m,), each with a cost or a bound:

    z[k+1] = A z[k] + B d[k],   z[0] = 0,   v[k] = G_z z[k] + G_d d[k]

All functions take time and memory linear in the number N of samples.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax.scipy.linalg import cho_solve

from ..pytree.aliases import Array, Tree
from ..runtime.lanes import over_samples
from ..signals.task import product

UNROLLED = 4  # inputs up to which a solution is written out, since LAPACK would take longer


class System(NamedTuple):
    """The system above. Each matrix is constant, or has a leading axis of N.

    A (n, n), B (n, n_u), G_z (m, n), G_d (m, n_u)
    """

    A: Array
    B: Array
    G_z: Array
    G_d: Array


class Factor(NamedTuple):
    """K (N, n_u, n), and the Cholesky factor L of the cost M of the input (N, n_u, n_u)."""

    K: Array
    L: Array


def factor(system: System, W: Array, D: Array) -> Factor:
    """The Riccati recursion of the cost sum_k v[k]' (W + diag D[k]) v[k] / 2.

        M = [B; G_d]' S [B; G_d],   K = M^-1 [B; G_d]' S [A; G_z],   S = diag(P', W + diag D)
        P = T' S T,   T = [A - B K; G_z - G_d K]

    W: (m, m) or (N, m, m), D: (N, m)
    P is computed as this sum of squares (the Joseph form). The shorter form A' P' (A - B K) + ...
    subtracts large numbers where entries of D are large, and loses their digits.
    """

    def back(P: Array, now: Tree) -> tuple[Tree, Tree]:
        (A, B, G_z, G_d), D_k, *W_k = now
        V = (W_k[0] if W_k else W) + jnp.diag(D_k)
        PB, VG = times(P, B), times(V, G_d)
        L = cholesky(times(B.T, PB) + times(G_d.T, VG))
        K = cholesky_solve(L, times(PB.T, A) + times(VG.T, G_z))
        T, U = A - times(B, K), G_z - times(G_d, K)
        P = times(T.T, times(P, T)) + times(U.T, times(V, U))
        return (P + P.T) / 2, (K, L)

    start = jnp.zeros((system.A.shape[-1],) * 2, W.dtype)
    rows = (D, W) if W.ndim == 3 else (D,)
    return Factor(*scan(back, start, system, len(D), *rows, reverse=True)[1])


def newton(system: System, of: Factor, q: Array) -> tuple[Array, Array]:
    """(d, v) that minimise sum_k q[k]' v[k] + v[k]' (W + diag D[k]) v[k] / 2.

    of: `factor` of these W and D;  q: (N, m)
    """

    def back(p: Array, now: Tree) -> tuple[Tree, Tree]:
        (A, B, G_z, G_d), K, L, q_k = now
        h = product(G_d.T, q_k) + product(B.T, p)
        return product(G_z.T, q_k) + product(A.T, p) - product(K.T, h), cholesky_solve(L, h)

    def forth(z: Array, now: Tree) -> tuple[Tree, Tree]:
        (A, B, G_z, G_d), K, g = now
        d = -g - product(K, z)
        return product(A, z) + product(B, d), (d, product(G_z, z) + product(G_d, d))

    rest = jnp.zeros(system.A.shape[-1], q.dtype)
    g = scan(back, rest, system, len(q), *of, q, reverse=True)[1]
    return scan(forth, rest, system, len(q), of.K, g)[1]


def answer(system: System, d: Array) -> tuple[Array, Array]:
    """(N, n) the states z[0..N-1] and (N, m) the rows v of inputs d (N, n_u)."""

    def forth(z: Array, now: Tree) -> tuple[Tree, Tree]:
        (A, B, G_z, G_d), d_k = now
        return product(A, z) + product(B, d_k), (z, product(G_z, z) + product(G_d, d_k))

    return scan(forth, jnp.zeros(system.A.shape[-1], d.dtype), system, len(d), d)[1]


def adjoint(system: System, q: Array) -> tuple[Array, Array]:
    """The derivatives of sum_k q[k]' v[k], for constant q (N, m), by z[k+1] (N, n) and d (N, n_u).

    That by z[k+1] is of what follows it.
    """

    def back(p: Array, now: Tree) -> tuple[Tree, Tree]:
        (A, B, G_z, G_d), q_k = now
        return product(G_z.T, q_k) + product(A.T, p), (p, product(G_d.T, q_k) + product(B.T, p))

    rest = jnp.zeros(system.A.shape[-1], q.dtype)
    return scan(back, rest, system, len(q), q, reverse=True)[1]


def times(X: Array, Y: Array) -> Array:
    """X @ Y for small matrices; up to 8 terms as their sum, which vectorises over a batch."""
    terms = len(Y)
    if not 0 < terms <= 8:
        return X @ Y
    total: Tree = sum(X[:, j, None] * Y[j] for j in range(terms))
    return total


def cholesky(M: Array) -> Array:
    """L with L L' = M, for a small symmetric positive definite M.

    A pivot that rounding has taken all digits of, beside the weights of active bounds, is what
    rounding leaves of its diagonal: the solution stays finite. Others are not touched.
    """
    size = len(M)
    if size > UNROLLED:
        return jnp.linalg.cholesky(M)
    zero, eps = jnp.zeros_like(M[0, 0]), float(jnp.finfo(M.dtype).eps)
    L: list[list[Array]] = [[zero] * size for _ in range(size)]
    for i in range(size):
        for j in range(i + 1):
            rest = M[i, j] - sum(L[i][k] * L[j][k] for k in range(j))
            if i == j:
                lost = (rest < eps * M[i, i]) & (rest > -(eps**0.5) * M[i, i])
                L[i][j] = jnp.sqrt(jnp.where(lost, eps * M[i, i], rest))
            else:
                L[i][j] = rest / L[j][j]
    return jnp.stack([jnp.stack(row) for row in L])


def cholesky_solve(L: Array, b: Array) -> Array:
    """x with L L' x = b, for b (n_u,) or (n_u, n), by substitution.

    The product with an explicit inverse would not do: where a weight is huge, x in the direction of
    that weight must be exact to rounding, and only substitution is.
    """
    size = len(L)
    if size > UNROLLED:
        return cho_solve((L, True), b)
    x: list[Array] = []
    for i in range(size):
        x.append((b[i] - sum(L[i, k] * x[k] for k in range(i))) / L[i, i])
    for i in reversed(range(size)):
        x[i] = (x[i] - sum(L[k, i] * x[k] for k in range(i + 1, size))) / L[i, i]
    return jnp.stack(x)


def scan(
    f: Callable[[Tree, Tree], tuple[Tree, Tree]],
    start: Tree,
    matrices: tuple[Array, ...],
    length: int,
    *rows: Array,
    reverse: bool = False,
) -> Tree:
    """Scan f over the rows, with the matrices of each sample, which may be constant."""

    def turn(carry: Tree, now: Tree) -> tuple[Tree, Tree]:
        varying = iter(now[0])
        at = tuple(next(varying) if M.ndim == 3 else M for M in matrices)
        return f(carry, (at, *now[1]))

    varying = tuple(M for M in matrices if M.ndim == 3)
    return over_samples(turn, start, (varying, rows), length=length, reverse=reverse)
