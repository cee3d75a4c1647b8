"""The inputs that learning ever reaches.

A law with a model that counts errors at a few samples only, and does not weigh the input, leaves
most of the input as it was at the start: there M has the eigenvalue 1, and no power of it
contracts. What learning adds to the start w_1 lies in

    K = range [I - M, F(w_1) - w_1],    M K within K

so the learning map in K decides whether learning converges. Its limit depends on the start.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse

from .spectrum import triangular_radius

ROUNDING = 1e3  # in units of the last place, of singular values that count as zero


def reachable(M, moves) -> np.ndarray:
    """(p,) the places of w that the first trial moves, or that follow from these in later ones.

    M: (n, n) whose entry i, k is other than 0 where w_i follows from w_k
    moves: (n,) whether the first trial moves a place
    """
    acts = scipy.sparse.csr_array(np.asarray(M) != 0)
    there = np.asarray(moves, bool)
    while True:
        grown = there | (acts @ there.astype(float) > 0)
        if np.all(grown == there):
            return np.flatnonzero(there)
        there = grown


def reached(M, moved) -> np.ndarray | None:
    """An orthonormal basis (n, p) of K; None where learning reaches every input.

    M: (n, n) learning map
    moved: (n,) F(w_1) - w_1

    K is looked for only where I - M is singular and M is not triangular, so that nothing else can
    be claimed. Singular values count as zero below a thousand units of the last place, of the
    largest one.
    """
    if not (M.size and np.all(np.isfinite(M)) and np.all(np.isfinite(moved))):
        return None
    n, least = len(M), ROUNDING * np.finfo(M.dtype).eps
    held = np.eye(n) - M
    values = np.linalg.svd(held, compute_uv=False)
    if values[-1] > least * values[0] or np.isfinite(triangular_radius(M)):
        return None
    length = np.linalg.norm(moved) or 1.0
    both = np.concatenate([held, (values[0] * moved / length)[:, None]], axis=1)
    basis, values, _ = np.linalg.svd(both, full_matrices=False)
    there = values > least * values[0]
    return None if np.all(there) else basis[:, there]
