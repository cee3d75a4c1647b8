"""Rate-independent hysteresis, as a function of voltage or of displacement: Bouc-Wen and Dahl.

An operator turns the travel x into its internal variable z by dz = slope(z, s) dx, with
s = sign(dx), whatever the speed. It is used in two ways:

    over(z, dx)   goes along a monotonic travel at once, for an input that is held over each sample
                  and jumps in between, where a rate would be an impulse
    slope(z, s)   gives dz/dt = slope(z, sign(dx/dt)) dx/dt along a trajectory x(t)

The slope jumps where the travel turns, so z has a kink there and its gradient is one-sided: at
dx = 0 it is that of a travel upward. All gradients are finite.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax

from ..pytree.aliases import Array, Leaf, Tree
from ..pytree.fields import child, pytree, scalar, static
from ..pytree.needs import known
from .integration import runge_kutta
from .plant import Around, Plant


@pytree
class BoucWen:
    """Hysteresis of Bouc (1967) and Wen (1976).

        dz = A dx - beta |dx| z |z|^(n-1) - gamma dx |z|^n
        |z| <= z_max = (A / (beta + gamma))^(1/n)

    initial_slope: () A, dz/dx at z = 0 [z/x]
    beta:     () [z/x / z^n], dissipates energy
    gamma:    () [z/x / z^n], bends the loop
    exponent: () n >= 1, how abruptly z saturates; None is n = 1, where `over` is exact and needs no
              power function
    substeps: steps of `over` where n is given: of Runge-Kutta over at most 1.5 substeps
              characteristic lengths, and as many along lines over what is left of the travel, which
              are stable for any jump and end at z_max. With 4 substeps and gamma >= -0.85 beta the
              error of z is within 4 % of z_max for n <= 2.5, and within 12 % for n <= 8

    Raises ValueError for gamma beyond -beta < gamma <= beta, where z is unbounded or the loop
    yields energy.
    """

    initial_slope: Leaf = scalar(interval="(0, inf)")
    beta: Leaf = scalar(interval="(0, inf)")
    gamma: Leaf = scalar(default=0.0)
    exponent: Leaf | None = scalar(default=None, interval="[1, inf)", optional=True)
    substeps: int = static(default=4, interval="[1, 1e4]", whole=True)

    def __post_init__(self) -> None:
        if known(self) and not np.all((-self.beta < self.gamma) & (self.gamma <= self.beta)):
            raise ValueError(
                f"BoucWen: gamma = {self.gamma} is outside its allowed range (-beta, beta], beta = "
                f"{self.beta}"
            )

    @property
    def limit(self) -> Array:
        """() z_max, the largest |z|."""
        ratio = self.initial_slope / (self.beta + self.gamma)
        return ratio if self.exponent is None else ratio ** (1 / self.exponent)

    def slope(self, z: Array, direction: Array | float) -> Array:
        """dz/dx at z on a travel in `direction`, 1 or -1. Both of any shape."""
        size = jnp.abs(z)
        drag = self.beta * direction * z + self.gamma * size
        return self.initial_slope - (
            drag if self.exponent is None else drag * _power(size, self.exponent - 1)
        )

    def over(self, z: Array, dx: Array) -> Array:
        """z after the monotonic travel dx from z. Both of any shape."""
        s = _direction(dx)
        w, way = s * z, s * dx  # mirrored, so that the way leads up
        return s * (
            self._by_rates(w, way, self.beta - self.gamma, self.beta + self.gamma)
            if self.exponent is None
            else self._numerically(w, way, self.exponent)
        )

    def _by_rates(self, w: Array, way: Array, below: Array, above: Array) -> Array:
        """w after a travel on which dw/dx falls at one rate below w = 0 and at another above.

        For n = 1 they are beta - gamma and beta + gamma, and this is exact.
        """
        A = self.initial_slope
        depth = jnp.where(w < 0, -w, 0.0)
        to_zero = depth / A * _log1p_ratio(below * depth / A)
        ends_below = way < to_zero
        rate = jnp.where(ends_below, below, above)
        way = jnp.where(ends_below, way, way - to_zero)
        w = jnp.where(ends_below, w, w + depth)
        return w + self.slope(w, 1.0) * way * _decay_ratio(rate * way)

    def _numerically(self, w: Array, way: Array, n: Array) -> Array:
        stiffest = n * (self.beta + jnp.abs(self.gamma)) * self.limit ** (n - 1)
        h = jnp.minimum(way / self.substeps, 1.5 / stiffest)
        w = lax.fori_loop(
            0, self.substeps, lambda _, w: runge_kutta(lambda w: self.slope(w, 1.0), w, h), w
        )
        return lax.fori_loop(
            0, self.substeps, lambda _, w: self._along_chords(w, way / self.substeps - h, n), w
        )

    def _along_chords(self, w: Array, way: Array, n: Array) -> Array:
        """A step of any length: dw/dx on a line from w to 0, and on one from there to z_max."""
        below = (self.beta - self.gamma) * _power(jnp.where(w < 0, -w, 0.0), n - 1)
        start, limit = jnp.where(w < 0, 0.0, w), self.limit
        near = jnp.abs(limit - start) < 1e-6 * limit
        chord = self.slope(start, 1.0) / jnp.where(near, 1.0, limit - start)
        above = jnp.where(near, n * self.initial_slope / limit, chord)
        return self._by_rates(w, way, below, above)


@pytree
class Dahl:
    """Friction of Dahl (1968): a spring at rest, a constant force in motion, hysteresis between.

        dz = sigma |1 - s z / F_c|^i sign(1 - s z / F_c) dx,    s = sign(dx)

    From rest with i = 1 this is z = F_c (1 - exp(-sigma x / F_c)).

    initial_slope: () sigma, dz/dx at z = 0 [z/x]
    limit:    () F_c, the largest |z|
    exponent: () i >= 1, ductile for large i; None is i = 1, which needs no power function. `over`
              is exact for every i
    """

    initial_slope: Leaf = scalar(interval="(0, inf)")
    limit: Leaf = scalar(interval="(0, inf)")
    exponent: Leaf | None = scalar(default=None, interval="[1, inf)", optional=True)

    def slope(self, z: Array, direction: Array | float) -> Array:
        """dz/dx at z on a travel in `direction`, 1 or -1. Both of any shape."""
        left = 1.0 - direction * z / self.limit
        return self.initial_slope * (
            left if self.exponent is None else left * _power(jnp.abs(left), self.exponent - 1)
        )

    def over(self, z: Array, dx: Array) -> Array:
        """z after the monotonic travel dx from z, |z| <= F_c. Both of any shape."""
        s = _direction(dx)
        left, way = 1.0 - s * z / self.limit, self.initial_slope / self.limit * s * dx
        if self.exponent is not None:
            more = self.exponent - 1.0
            way = way * _power(left, more)
            way = way * _log1p_ratio(more * way)
        return s * self.limit * (1.0 - left * jnp.exp(-way))


class HystereticState(NamedTuple):
    """The state of a plant with hysteresis.

    u, z:  (n_u,) input of the sample before, and its hysteresis
    """

    plant: Tree
    u: Array
    z: Array


@pytree
class InputHysteresis(Around):
    """Any plant with rate-independent hysteresis at its input.

    Channel by channel, the plant is driven by u - z. u is held over a sample and jumps at its
    start, and z with it: this takes one update a sample, exact where `over` is.
    """

    plant: Plant = child()
    hysteresis: BoucWen | Dahl = child()

    def initial_state(self) -> HystereticState:
        rest = jnp.zeros_like(self.hysteresis.initial_slope, shape=(self.n_u,))
        return HystereticState(self.plant.initial_state(), rest, rest)

    def step(self, x: HystereticState, u: Array, dt: float) -> HystereticState:
        z = self.hysteresis.over(x.z, u - x.u)
        return HystereticState(self.plant.step(x.plant, u - z, dt), u, z)

    def output(self, x: HystereticState) -> Array:
        return self.plant.output(x.plant)


def _direction(dx: Array) -> Array:
    """1 or -1, and 1 at rest.

    So a gradient at dx = 0 is the slope of a travel upward and not 0.
    """
    return jnp.where(dx < 0, -1.0, 1.0)


def _power(size: Array, exponent: Leaf) -> Array:
    """size^exponent for size >= 0, with finite derivatives also at size 0.

    There the derivative by the exponent would be 0 log 0.
    """
    positive = size > 0
    return jnp.where(positive, jnp.where(positive, size, 1.0) ** exponent, 0.0)


def _decay_ratio(x: Array) -> Array:
    """(1 - exp(-x)) / x, smooth through x = 0."""
    small = jnp.abs(x) < 1e-5
    safe = jnp.where(small, 1.0, x)
    return jnp.where(small, 1.0 - x / 2 + x * x / 6, -jnp.expm1(-safe) / safe)


def _log1p_ratio(x: Array) -> Array:
    """log(1 + x) / x, smooth through x = 0."""
    small = jnp.abs(x) < 1e-5
    safe = jnp.where(small, 1.0, x)
    return jnp.where(small, 1.0 - x / 2 + x * x / 3, jnp.log1p(safe) / safe)
