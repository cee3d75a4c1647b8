"""Least squares through the learning process: from many starts, with exact Jacobians."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..runtime.tiles import tiled


class Fit(NamedTuple):
    """values: by name, at the best minimum found;  residuals: (M,) there;  jacobian: (M, P) of them
    by the values
    costs: (starts,) half the sum of squares at every start, sorted;  refined: the costs of the
    refined ones
    """

    values: dict[str, float]
    residuals: np.ndarray
    jacobian: np.ndarray
    costs: np.ndarray
    refined: np.ndarray


def fit(
    residuals: Callable[[dict[str, jax.Array]], jax.Array],
    ranges: Mapping[str, tuple[float, float]],
    *,
    starts: int = 256,
    refine: int = 8,
    seed: int = 0,
    lanes: int = 8,
) -> Fit:
    """Minimise 1/2 |residuals(values)|^2 within ranges: scattered starts in tiles, the best ones
    refined by trust-region Gauss-Newton.

    residuals: pure, of named scalars;  ranges: (low, high) by name; one that does not contain 0 is
    searched by its logarithm The Jacobian is that of forward-mode differentiation through the whole
    simulation, so the resets and clips inside have their piecewise gradients; many starts are what
    gets across their jumps. Starts that are not finite count as infinitely bad.
    Raises ValueError for an empty range, or if no start is finite.
    """
    from scipy.optimize import least_squares
    from scipy.stats import qmc

    names = list(ranges)
    for name, count in (("starts", starts), ("refine", refine), ("lanes", lanes)):
        if count < 1:
            raise ValueError(f"fit: {name} = {count} is outside its allowed range [1, inf)")
    for name, (low, high) in ranges.items():
        if not low < high:
            raise ValueError(f"fit: the range ({low:g}, {high:g}) of {name} is empty")
    low, high = (np.array([ranges[n][i] for n in names], float) for i in (0, 1))
    sign = np.where(low > 0, 1.0, np.where(high < 0, -1.0, 0.0))

    def natural(unit):
        """Values from the unit cube."""
        near, far = np.where(sign < 0, -high, low), np.where(sign < 0, -low, high)
        logarithmic = (
            sign * near * (np.where(sign == 0, 1.0, far) / np.where(sign == 0, 1.0, near)) ** unit
        )
        return jnp.where(sign == 0, low + unit * (high - low), logarithmic)

    def of_unit(_, unit):
        r = residuals(dict(zip(names, natural(unit), strict=True)))
        # least_squares wants finite residuals everywhere; a start that has none is put last before
        # it gets there
        return jnp.where(jnp.isfinite(r), r, 1e6)

    def cost(common, unit):
        r = residuals(dict(zip(names, natural(unit), strict=True)))
        return jnp.where(jnp.all(jnp.isfinite(r)), 0.5 * jnp.sum(r**2), jnp.inf)

    scattered = qmc.LatinHypercube(len(names), rng=seed).random(starts)
    costs = np.asarray(tiled(cost, lanes=lanes)(0.0, jnp.asarray(scattered)))
    order = np.argsort(costs)
    if not np.isfinite(costs[order[0]]):
        raise ValueError(
            f"fit: none of {starts} starts within {dict(ranges)} gives finite residuals"
        )
    value, slope = jax.jit(of_unit), jax.jit(jax.jacfwd(of_unit, argnums=1))
    found = [
        least_squares(
            lambda u: np.asarray(value(0.0, u)),
            scattered[i],
            lambda u: np.asarray(slope(0.0, u)),
            (0.0, 1.0),
            max_nfev=60,
        )
        for i in order[:refine]
    ]
    best = min(found, key=lambda result: result.cost)
    return Fit(
        dict(zip(names, map(float, natural(best.x)), strict=True)),
        best.fun,
        best.jac @ np.linalg.inv(np.asarray(jax.jacfwd(natural)(jnp.asarray(best.x)))),
        costs[order],
        np.array(sorted(result.cost for result in found)),
    )
