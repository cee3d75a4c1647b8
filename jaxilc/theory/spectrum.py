"""Singular values, eigenvalues and transient growth of given matrices, and conditions on them."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import scipy

from .condition import Condition, Premise, condition, premise
from .iteration import MARGIN

EXACT_ROWS, PROBES = 64, 16  # rows up to which a growth is exact, random vectors beyond
LONGEST = 1024  # powers that are looked at for a growth

MONOTONE = (
    "sigma_max < 1: the 2-norm of the deviation from the limit falls by at least this factor in "
    "every trial (Bristow 2006; Norrlöf, "
    "Gunnarsson 2002)"
)
ASYMPTOTIC = (
    "rho < 1: the deviation goes to zero in the end, whatever it does before (Bristow 2006; "
    "Norrlöf, Gunnarsson 2002)"
)
TRANSIENT = (
    "||M_j ... M_1|| bounds how large the deviation is after j trials, for any start "
    "(sub-multiplicativity; tight for each j)"
)


def sigma_max(M) -> np.ndarray:
    """(...) largest singular value of (..., n, n)."""
    return np.linalg.norm(np.asarray(M), 2, axis=(-2, -1))


def spectral_radius(M) -> np.ndarray:
    """(...) largest |eigenvalue| of (..., n, n).

    It is exact for triangular matrices, also permuted ones, and block by block.
    """
    M = np.asarray(M)
    return np.reshape([radius_with_doubt(m)[0] for m in M.reshape(-1, *M.shape[-2:])], M.shape[:-2])


def transient_growth(M, trials: int | None = None) -> np.ndarray:
    """(J,) ||M_j ... M_1||_2 for j = 1..J, the factor by which a deviation can have grown.

    M: (n, n), the same in each trial, then `trials` is J; or (J, n, n), the map of each trial

    Raises ValueError for anything else.
    """
    M = np.asarray(M)
    if (
        (M.ndim == 2) != (trials is not None)
        or M.ndim not in (2, 3)
        or (trials is not None and trials < 1)
    ):
        raise ValueError(
            f"transient_growth: M {M.shape}, trials = {trials}; allowed are (n, n) with trials in "
            "[1, inf), or (J, n, n)"
        )
    product, norms = np.eye(M.shape[-1]), []
    for m in M if M.ndim == 3 else (M,) * (trials or 0):
        product = m @ product
        norms.append(np.linalg.norm(product, 2))
    return np.array(norms)


def monotone(M, *, premises: Iterable[Premise] = ()) -> Condition:
    """sigma_max(M) < 1 of one (n, n) or several (S, n, n) maps of a deviation of input or error."""
    return condition(sigma_max(M), MONOTONE, premises=premises)


def asymptotic(M, *, premises: Iterable[Premise] = ()) -> Condition:
    """rho(M) < 1 of one (n, n) or several (S, n, n) maps.

    The eigenvalues of a map that is far from normal cannot be computed reliably from its entries in
    floating point. Then rho < 1 is claimed only if a power of M contracts, since rho^k <= ||M^k||;
    otherwise a premise is broken.
    """
    M = np.asarray(M)
    maps = M.reshape(-1, *M.shape[-2:])
    value, doubt = np.array([radius_with_doubt(m) for m in maps]).T
    clear = [
        abs(v - 1) > d or (v < 1 and _power_contracts(m))
        for m, v, d in zip(maps, value, doubt, strict=True)
    ]
    detail = f"to first order rounding may move rho by {np.max(doubt):.1e}"
    resolved = premise(
        "eigenvalues resolved", np.reshape(clear, M.shape[:-2]), detail, plants=M.ndim > 2
    )
    return condition(value.reshape(M.shape[:-2]), ASYMPTOTIC, premises=(*premises, resolved))


def transient(
    M, trials: int | None = None, *, allowed: float = 1.0, premises: Iterable[Premise] = ()
) -> Condition:
    """max_j ||M_j ... M_1||_2 < allowed: no deviation ever grows by this factor.

    M, trials: as for `transient_growth`
    """
    return condition(
        np.max(transient_growth(M, trials)), TRANSIENT, limit=allowed, premises=premises
    )


def radius_with_doubt(M) -> tuple[float, float]:
    """rho of (n, n), and how far rounding may have moved it.

    The doubt is 10 eps ||M|| over the cosine between left and right eigenvector. Both are taken
    over the irreducible diagonal blocks. For a triangular matrix far from normal, such as I - gamma
    G, the QR algorithm finds eigenvalues that are wrong in the first digit, while the true ones are
    simply the diagonal.
    """
    if not np.all(np.isfinite(M)):
        return np.nan, np.nan
    blocks, block_of = scipy.sparse.csgraph.connected_components(M != 0, connection="strong")
    singles = np.bincount(block_of, minlength=blocks)[block_of] == 1
    found = [(np.max(np.abs(np.diag(M)[singles]), initial=0.0), 0.0)]
    for i in np.unique(block_of[~singles]):
        block = M[np.ix_(block_of == i, block_of == i)]
        values, left, right = scipy.linalg.eig(block, left=True)
        top = np.argmax(np.abs(values))
        cosine = np.abs(np.vdot(left[:, top], right[:, top]))  # LAPACK gives unit vectors
        found.append(
            (
                np.abs(values[top]),
                MARGIN * np.finfo(M.dtype).eps * np.linalg.norm(block) / max(cosine, 1e-300),
            )
        )
    radius, doubt = max(found)
    return radius, max(doubt, max(sum(one) for one in found) - radius)


def triangular_radius(M) -> float:
    """rho of (n, n) where M is triangular, or a permuted triangular matrix; else infinite.

    Its eigenvalues are then its diagonal, without any doubt, however far from normal it is. The
    learning map of a causal law has this form, since no sample can act on an earlier one.
    """
    if not np.all(np.isfinite(M)):
        return np.inf
    blocks, _ = scipy.sparse.csgraph.connected_components(M != 0, connection="strong")
    return float(np.max(np.abs(np.diag(M)), initial=0.0)) if blocks == len(M) else np.inf


def growth_about(M) -> tuple[float, int]:
    """About max_i ||M^i|| of (n, n), and the first power that is seen to contract.

    The growth is infinite where the powers overflow before. Where none up to 1024 contracts, it is
    that of the powers so far, and the power is 0. It is taken in the Frobenius norm, which is never
    smaller than ||M^i||: exactly up to 64 rows, and beyond estimated as the mean length of random
    vectors. That tells the order of magnitude of a transient that is far above 1.
    """
    n = len(M)
    random = np.random.default_rng(8).standard_normal((n, PROBES)) / np.sqrt(PROBES)
    vectors, largest = np.eye(n) if n <= EXACT_ROWS else random, 1.0
    with np.errstate(over="ignore", invalid="ignore"):
        for power in range(1, LONGEST + 1):
            vectors = M @ vectors
            size = float(np.linalg.norm(vectors))
            if size < 1:
                return largest, power
            if not np.isfinite(size):
                return np.inf, 0
            largest = max(largest, size)
    return largest, 0


def _power_contracts(M) -> bool:
    """Whether ||M^k|| < 1 for some k = 1, 2, 4, ..., 64, rounding of the powers included."""
    power, size = M, np.linalg.norm(M, 2)
    for k in 2 ** np.arange(7):
        rounding = k * len(M) * np.finfo(M.dtype).eps * max(size, 1.0) ** k
        if not rounding < 1:
            return False
        if np.linalg.norm(power, 2) + rounding < 1:
            return True
        power = power @ power
    return False
