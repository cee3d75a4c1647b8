"""Least squares through the learning process, from many starts and with exact Jacobians."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..pytree.in_short import in_short
from ..pytree.ranges import require
from ..runtime.tiles import tiled


class Fit(NamedTuple):
    """The best minimum found.

    residuals: (M,) residuals at these values
    jacobian: (M, P) derivatives of the residuals with respect to the values
    costs: (starts,) half the sum of squares at every start, sorted
    refined: (refine,) half the sum of squares of the refined starts, sorted
    """

    values: dict[str, float]
    residuals: np.ndarray
    jacobian: np.ndarray
    costs: np.ndarray
    refined: np.ndarray
    __repr__ = in_short


def fit(
    residuals: Callable[[dict[str, jax.Array]], jax.Array],
    ranges: Mapping[str, tuple[float, float]],
    *,
    starts: int = 256,
    refine: int = 8,
    seed: int = 0,
    lanes: int = 8,
) -> Fit:
    """Minimise 1/2 |residuals(values)|^2 within ranges, from many starts.

    The starts are spread over the ranges, and the best ones are refined by Gauss-Newton steps
    within a trust region. The Jacobian comes from forward-mode differentiation through the whole
    simulation. Resets and limits within it have piecewise gradients; many starts are needed because
    of their jumps. A start whose residuals are not finite has an infinite cost.

    residuals: pure function from scalars by name to (M,) residuals
    ranges: (low, high) by name; a range that does not contain 0 is searched by its logarithm
    starts, refine: number of starts, and of those that are refined
    lanes: number of starts that are computed at a time, see `tiled`
    Raises ValueError for an empty range, for counts below 1, or if no start is finite.
    """
    from scipy.optimize import least_squares
    from scipy.stats import qmc

    names = list(ranges)
    for name, count in (("starts", starts), ("refine", refine), ("lanes", lanes)):
        require("fit", name, count, "[1, inf)")
    for name, (low, high) in ranges.items():
        if not low < high:
            raise ValueError(f"fit: the range ({low:g}, {high:g}) of {name} is empty")
    natural = _from_unit_cube(*(np.array([ranges[n][i] for n in names], float) for i in (0, 1)))

    def at(unit):
        return residuals(dict(zip(names, natural(unit), strict=True)))

    @jax.jit
    def value(unit):
        r = at(unit)
        return jnp.where(jnp.isfinite(r), r, 1e6)  # `least_squares` needs finite ones everywhere

    def cost(_, unit):
        r = at(unit)
        return jnp.where(jnp.all(jnp.isfinite(r)), 0.5 * jnp.sum(r**2), jnp.inf)

    scattered = qmc.LatinHypercube(len(names), rng=seed).random(starts)
    costs = np.asarray(tiled(cost, lanes=lanes)(0.0, jnp.asarray(scattered)))
    order = np.argsort(costs)
    if not np.isfinite(costs[order[0]]):
        raise ValueError(
            f"fit: none of {starts} starts within {dict(ranges)} gives finite residuals"
        )
    slope = jax.jit(jax.jacfwd(value))
    found = [
        least_squares(value, scattered[i], slope, (0.0, 1.0), max_nfev=60) for i in order[:refine]
    ]
    best = min(found, key=lambda result: result.cost)
    return Fit(
        dict(zip(names, map(float, natural(best.x)), strict=True)),
        best.fun,
        best.jac @ np.linalg.inv(np.asarray(jax.jacfwd(natural)(jnp.asarray(best.x)))),
        costs[order],
        np.array(sorted(result.cost for result in found)),
    )


def _from_unit_cube(low, high):
    """The map from the unit cube to the ranges, by logarithm where a range does not contain 0."""
    sign = np.where(low > 0, 1.0, np.where(high < 0, -1.0, 0.0))

    def natural(unit):
        near, far = np.where(sign < 0, -high, low), np.where(sign < 0, -low, high)
        logarithmic = (
            sign * near * (np.where(sign == 0, 1.0, far) / np.where(sign == 0, 1.0, near)) ** unit
        )
        return jnp.where(sign == 0, low + unit * (high - low), logarithmic)

    return natural
