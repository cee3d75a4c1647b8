"""The few functions of a basis that matter, chosen by cross-validation over trials."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ..pytree.in_short import in_short
from ..pytree.ranges import require
from .bases import Basis, SelectedBasis

PENALTIES, SMALLEST = 50, 1e-4  # number of penalties, and the smallest in units of the largest
SWEEPS, SETTLED = 10_000, 1e-12  # of the descent, and the relative change at which it ends


class Selection(NamedTuple):
    """What `select_basis` found.

    basis: `SelectedBasis` of the functions that are kept
    theta: (kept,) their parameters, by least squares over all trials
    names: (kept,) the names of these parameters
    penalties: (P,) that were tried, in units of the one at which nothing is left, falling
    errors: (P,) mean square error of the trials left out, as a share of their mean square input
    doubt: (P,) standard error of these over the trials
    counts: (P,) number of functions that all trials together keep
    chosen: number of the penalty that was chosen
    """

    basis: SelectedBasis
    theta: np.ndarray
    names: tuple[str, ...]
    penalties: np.ndarray
    errors: np.ndarray
    doubt: np.ndarray
    counts: np.ndarray
    chosen: int
    __repr__ = in_short


def select_basis(
    basis: Basis, trials: Sequence[tuple[Any, Any]], *, dt: float, penalties: Any = None
) -> Selection:
    """The functions of a basis that predict the input of trials that were left out.

        minimise |Psi theta - u|^2 / (2 K) + penalty sum_i |theta_i| s_i,   s_i: rms of column i

    over all trials but one (Tibshirani 1996), which then tells the error of what was found. Of the
    penalties whose mean error lies within one standard error of the least, the largest is chosen.
    The functions that it keeps are fitted once more, to all trials and without a penalty.

    basis: a basis that is linear in theta
    trials: pairs (r, u) of at least two trials, r (N+1, n_y) and u (N, n_u), of any lengths. r is
        the reference of a learned input u, or the output that was measured under any input u
    dt: sample time [s]
    penalties: falling numbers in (0, 1]; None: 50 from 1 to 1e-4 with equal ratios

    Raises ValueError for fewer trials, for shapes that do not fit, for numbers that are not finite,
    and for inputs that are all zero.
    """
    if not basis.linear:
        name = type(basis).__name__
        raise ValueError(f"select_basis: a {name} is not linear in theta; give its numerator")
    require("select_basis", "dt", dt, "(0, inf)")
    columns, inputs, names = _equations(basis, trials, dt)
    tried = _penalties(penalties)
    grams = np.stack([X.T @ X for X in columns])
    sums = np.stack([X.T @ u for X, u in zip(columns, inputs, strict=True)])
    lengths = np.array([len(u) for u in inputs], float)
    scale = np.sqrt(np.diagonal(grams.sum(0)) / lengths.sum())
    if not np.any(sums):
        raise ValueError("select_basis: the inputs are zero, or no function has a share in them")
    scale = np.where(scale > 0, scale, 1.0)
    grams, sums = grams / np.outer(scale, scale), sums / scale
    squares = np.array([u @ u for u in inputs])

    errors = np.empty((len(columns), len(tried)))
    for left in range(len(columns)):
        others = np.arange(len(columns)) != left
        K = lengths[others].sum()
        path = _path(grams[others].sum(0) / K, sums[others].sum(0) / K, tried)
        for i, theta in enumerate(path):
            off = squares[left] - 2 * theta @ sums[left] + theta @ grams[left] @ theta
            errors[left, i] = off / max(squares[left], np.finfo(float).tiny)
    mean = errors.mean(0)
    doubt = errors.std(0, ddof=1) / np.sqrt(len(columns))
    best = int(np.argmin(mean))
    chosen = int(np.argmax(mean <= mean[best] + doubt[best]))

    K = lengths.sum()
    path = _path(grams.sum(0) / K, sums.sum(0) / K, tried)
    counts = np.count_nonzero(path, axis=1)
    chosen = max(chosen, int(np.argmax(counts > 0)))
    kept = tuple(int(i) for i in np.flatnonzero(path[chosen]))
    X = np.concatenate(columns)[:, kept] / scale[list(kept)]
    theta = np.linalg.lstsq(X, np.concatenate(inputs), rcond=None)[0] / scale[list(kept)]
    return Selection(
        SelectedBasis(basis, kept),
        theta,
        tuple(names[i] for i in kept),
        tried,
        mean,
        doubt,
        counts,
        chosen,
    )


def _equations(basis: Basis, trials: Any, dt: float):
    """The columns (K, m) and the input (K,) of each trial, and the names of the functions."""
    if len(trials) < 2:
        raise ValueError(f"select_basis: {len(trials)} trials; allowed are two or more")
    columns, inputs, names = [], [], ()
    for i, (r, u) in enumerate(trials):
        r, u = (np.asarray(x, float) for x in (r, u))
        r, u = (x[:, None] if x.ndim == 1 else x for x in (r, u))
        if r.ndim != 2 or u.ndim != 2 or len(r) != len(u) + 1:
            raise ValueError(
                f"select_basis: r {r.shape} and u {u.shape} of trial {i + 1} do not fit; allowed "
                "are (N+1, n_y) and (N, n_u)"
            )
        if not (np.all(np.isfinite(r)) and np.all(np.isfinite(u))):
            raise ValueError(f"select_basis: r or u of trial {i + 1} is not finite")
        names = basis.names(r.shape[1], u.shape[1])
        columns.append(np.asarray(basis.columns(r, dt, u.shape[1]), float).reshape(u.size, -1))
        inputs.append(u.ravel())
    return columns, inputs, names


def _penalties(given: Any) -> np.ndarray:
    if given is None:
        return np.geomspace(1.0, SMALLEST, PENALTIES)
    tried = np.atleast_1d(np.asarray(given, float))
    if tried.ndim != 1 or not np.all((tried > 0) & (tried <= 1)) or np.any(np.diff(tried) >= 0):
        raise ValueError(f"select_basis: penalties = {tried}; allowed are falling ones in (0, 1]")
    return tried


def _path(G, g, tried) -> np.ndarray:
    """(P, m) the minimum of theta' G theta / 2 - g' theta + penalty |theta|_1, for each penalty.

    It is found by descent along one parameter after the other (Friedman, Hastie and Tibshirani
    2010), each from the minimum of the penalty before.
    """
    theta, found, largest = np.zeros(len(g)), [], np.max(np.abs(g))
    for penalty in tried * largest:
        for _ in range(SWEEPS):
            before = theta.copy()
            for i in range(len(g)):
                if G[i, i] > 0:
                    rest = g[i] - G[i] @ theta + G[i, i] * theta[i]
                    theta[i] = np.sign(rest) * max(abs(rest) - penalty, 0.0) / G[i, i]
            if np.max(np.abs(theta - before)) <= SETTLED * np.max(np.abs(theta), initial=1e-300):
                break
        found.append(theta.copy())
    return np.array(found)
