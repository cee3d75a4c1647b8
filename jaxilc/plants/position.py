"""What depends on the position: maps over it, and any plant that has them."""

from __future__ import annotations

from math import comb, factorial
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from ..pytree.aliases import Array, Leaf, Tree
from ..pytree.fields import child, leaf, pytree, scalar, static
from ..pytree.needs import known
from .motor import Cogging, EndEffect
from .plant import Around, Plant


@pytree
class Harmonics:
    """Sines and cosines of the position x, such as those of magnets, or of the turns of a screw.

        cos(2 pi i x / pitch), sin(2 pi i x / pitch),   i in orders;   for i = 0 the constant 1

    pitch: () > 0, the period [unit of x], or (P,) of several combs that add up, such as that of the
        screw beside that of the magnets; it has a gradient
    orders: different whole numbers from 0, of each pitch
    """

    pitch: Leaf = leaf(interval="(0, inf)")
    orders: tuple[int, ...] = static(default=(1, 2, 3, 4))

    def __post_init__(self) -> None:
        good = all(type(i) is int and i >= 0 for i in self.orders)
        if not good or not self.orders or len(set(self.orders)) != len(self.orders):
            raise ValueError(
                f"Harmonics: orders = {self.orders}; allowed are different whole numbers from 0"
            )
        if self.pitch.ndim > 1 or not self.pitch.size:
            raise ValueError(
                f"Harmonics: pitch has shape {self.pitch.shape}; allowed are () and (P,), P >= 1"
            )

    @property
    def names(self) -> tuple[str, ...]:
        found = ["constant"] if 0 in self.orders else []
        for n in range(self.pitch.size):
            of = "" if self.pitch.size == 1 else f" of pitch {n + 1}"
            found += [f"{wave} {i}{of}" for i in self.orders if i for wave in ("cos", "sin")]
        return tuple(found)

    def at(self, x: Array) -> Array:
        """(..., m) the functions at positions x of any shape."""
        x = jnp.asarray(x)
        found = [jnp.ones_like(x)] if 0 in self.orders else []
        for pitch in self.pitch if self.pitch.ndim else (self.pitch,):
            angle = 2 * jnp.pi * x / pitch
            found += [wave(i * angle) for i in self.orders if i for wave in (jnp.cos, jnp.sin)]
        return jnp.stack(found, axis=-1)


@pytree
class Splines:
    """Bins over the position x, or B-splines: each of the functions is zero but near its place.

    They add up to 1 everywhere from `low` to `high`. Beyond these the value at the end holds, or,
    with `closed`, `high` is where `low` comes again, as on one turn of a motor.

    low, high: () ends [unit of x], low < high
    count: number of functions, more than `degree`
    degree: 0 bins, 1 straight lines between nodes, 2 and 3 smooth curves. Bins have no slope
    closed: whether the position returns to `low` behind `high`
    """

    low: Leaf = scalar()
    high: Leaf = scalar()
    count: int = static(interval="[2, 1e6]", whole=True)
    degree: int = static(default=3, choices=(0, 1, 2, 3))
    closed: bool = static(default=False)

    def __post_init__(self) -> None:
        if known(self) and not np.all(np.asarray(self.low) < np.asarray(self.high)):
            raise ValueError(
                f"Splines: low = {np.asarray(self.low):g} is not below high = "
                f"{np.asarray(self.high):g}; allowed is low < high"
            )
        if self.count <= self.degree:
            raise ValueError(
                f"Splines: count = {self.count}; allowed is more than degree = {self.degree}"
            )

    @property
    def spacing(self) -> Leaf:
        """() distance of two neighbours [unit of x]."""
        return (self.high - self.low) / (self.count - (0 if self.closed else self.degree))

    @property
    def places(self) -> Leaf:
        """(m,) the middle of each function [unit of x]."""
        first = 0.5 if self.degree == 0 else 0.5 * (1 - self.degree) * (not self.closed)
        return self.low + self.spacing * (np.arange(self.count) + first)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(f"bin {i + 1}" for i in range(self.count))

    def at(self, x: Array) -> Array:
        """(..., m) the functions at positions x of any shape."""
        x = jnp.asarray(x)
        if not self.closed:
            x = jnp.clip(x, self.low, self.high)
        if self.degree == 0:  # by its number, so that a position is never between two bins
            number = jnp.floor((x - self.low) / self.spacing)
            last = self.count - 1
            number = number % self.count if self.closed else jnp.minimum(number, last)
            return jnp.where(number[..., None] == np.arange(self.count), 1.0, 0.0)
        away = (x[..., None] - self.places) / self.spacing
        if self.closed:
            away = away - self.count * jnp.round(away / self.count)
        # of nodes at distance 1, from the near end, where nothing cancels
        half = (self.degree + 1) / 2
        within = half - jnp.minimum(jnp.abs(away), half)
        terms = [
            (-1) ** i * comb(self.degree + 1, i) * jnp.maximum(within - i, 0.0) ** self.degree
            for i in range(self.degree + 1)
        ]
        return jnp.sum(jnp.stack(terms), axis=0) / factorial(self.degree)


def apart(functions: Array, v: Array, turning: Leaf | None) -> Array:
    """(..., m) or (..., 2 m) functions of the position, apart for forward and backward motion.

    functions: (..., m) at the positions;  v: (...) velocities there
    turning: () velocity from which on a direction counts; None: both have the same functions
    """
    if turning is None:
        return functions
    forward = (0.5 + 0.5 * jnp.tanh(v / turning))[..., None]
    return jnp.concatenate([forward * functions, (1 - forward) * functions], axis=-1)


@pytree
class PositionMap:
    """A value over the position, and over the direction of motion where it has one.

        F(x, v) = sum_i w_i f_i(x);   with `turning` the weights are (1 + s) / 2 of those of forward
        motion and (1 - s) / 2 of those of backward motion, s = tanh(v / turning)

    functions: `Harmonics` or `Splines`, m of them
    weights: (m,), or (2 m,) with `turning`, those of forward motion first
    turning: () velocity from which on a direction counts, > 0 [unit of x per s]; None: none
    """

    functions: Harmonics | Splines = child()
    weights: Leaf = leaf()
    turning: Leaf | None = scalar(default=None, interval="(0, inf)", optional=True)

    def __post_init__(self) -> None:
        m = len(self.functions.names) * (1 if self.turning is None else 2)
        if self.weights.shape != (m,):
            raise ValueError(
                f"PositionMap: weights has shape {self.weights.shape}; allowed is ({m},), one for "
                "each function, and twice as many with turning"
            )

    def at(self, x: Leaf, v: Leaf | float = 0.0) -> Array:
        """The value at positions x, where it moves with the velocity v; of any shape."""
        x, v = jnp.broadcast_arrays(jnp.asarray(x), v)
        return apart(self.functions.at(x), v, self.turning) @ jnp.asarray(self.weights)


class Placed(NamedTuple):
    """The state of a plant with maps over its position.

    before: () its position a sample ago [unit of y]
    after: () the position behind the backlash [unit of y]
    """

    plant: Tree
    before: Array
    after: Array


@pytree
class ByPosition(Around):
    """Any plant of one input, with what depends on its position x.

        the plant is driven by  (1 + ripple(x, v)) u + force(x, v)
        y = play(x + error(x, v)),   play[k] = clip(play[k-1], . - backlash / 2, . + backlash / 2)

    So it has cogging, friction by place and direction, and commutation (force, ripple), and the
    pitch error of a screw, and its backlash (error, backlash). Position and velocity of force and
    ripple are those in the middle of a sample, over which both are held: the first step, with the
    velocity of the sample before, tells them, so that forces are right to second order in dt. A map
    that depends on the direction is a damper near rest, so let `turning` of a friction be more than
    half of what it changes the velocity by within a sample. Several forces stand within each other,
    `ByPosition(ByPosition(plant, force=...), force=...)`; several axes side by side, in `TwoAxes`.

    plant: the plant without them
    force: `PositionMap` [unit of u], or a `Cogging` or an `EndEffect` in the units of y and u
    ripple: `PositionMap` [1], or an `EndEffect`
    error: `PositionMap` [unit of y]
    backlash: () width of the play [unit of y]; its gradient is that of the side it lies at
    position: which output of the plant is x; the others have no error
    """

    plant: Plant = child()
    force: PositionMap | Cogging | EndEffect | None = child(default=None)
    ripple: PositionMap | EndEffect | None = child(default=None)
    error: PositionMap | None = child(default=None)
    backlash: Leaf | None = scalar(default=None, interval="[0, inf)", optional=True)
    position: int = static(default=0, interval="[0, inf)", whole=True)

    def __post_init__(self) -> None:
        if self.plant.n_u != 1 or self.position >= self.plant.n_y:
            raise ValueError(
                f"ByPosition: position = {self.position} of a plant with {self.plant.n_u} inputs "
                f"and {self.plant.n_y} outputs; allowed are one input, and one of the outputs"
            )

    def initial_state(self) -> Placed:
        start = self.plant.initial_state()
        x = self._position(start)
        return Placed(start, x, x if self.error is None else x + self.error.at(x))

    def step(self, x: Placed, u: Array, dt: float) -> Placed:
        now = self._position(x.plant)
        seen, v = now, (now - x.before) / dt
        for _ in range(2):  # as if it went on as before, then in the middle of the sample
            plant = self.plant.step(x.plant, self._driven(u, seen, v), dt)
            new = after = self._position(plant)
            seen, v = (now + new) / 2, (new - now) / dt
        if self.error is not None:
            after = new + self.error.at(new, (new - now) / dt)
        if self.backlash is not None:
            low, high = after - self.backlash / 2, after + self.backlash / 2
            held = jnp.where(x.after >= low, x.after, low)  # `clip` halves slopes where low is high
            after = jnp.where(x.after > high, high, held)
        return Placed(plant, now, after)

    def _driven(self, u: Array, x: Array, v: Array) -> Array:
        """The input of the plant, with what the maps make of it at a position."""
        if isinstance(self.ripple, EndEffect):
            u = self.ripple.factor(x) * u
        elif self.ripple is not None:
            u = (1 + self.ripple.at(x, v)) * u
        if isinstance(self.force, PositionMap):
            return u + self.force.at(x, v)
        return u if self.force is None else u + self.force.force(x)

    def output(self, x: Placed) -> Array:
        return self.plant.output(x.plant).at[self.position].set(x.after)

    def _position(self, x: Tree) -> Array:
        return self.plant.output(x)[self.position]
