"""Forces on the carriage of a linear motor that depend on its position."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from ..pytree.fields import Leaf, pytree, scalar


@pytree
class Cogging:
    """Force of the magnets on the iron, periodic in the position.

        F(x) = -A sin(2 pi x / pitch + phase)

    amplitude: () A [N]
    pitch:     () period [m]
    phase:     () [rad]; 0 makes x = 0 a stable rest
    """

    amplitude: Leaf = scalar(interval="[0, inf)")
    pitch: Leaf = scalar(interval="(0, inf)")
    phase: Leaf = scalar(default=0.0)

    def force(self, position) -> jax.Array:
        """The force () [N] at a position () [m]."""
        return -self.amplitude * jnp.sin(2 * jnp.pi * position / self.pitch + self.phase)


@pytree
class EndEffect:
    """What happens toward the ends of the stroke, and beyond them.

    The coil leaves the field, and beyond the ends the carriage meets a buffer:

        k_f(x) = k_f (1 - drop (x/x_max)^2) within |x| <= x_max, constant beyond
        F(x) = -k_b (x - clip(x, -x_max, x_max))

    stroke: () x_max, half the stroke [m]
    drop:   () share of the force constant that is lost at the end
    buffer_stiffness: () k_b [N/m]; None is no buffer
    """

    stroke: Leaf = scalar(interval="(0, inf)")
    drop: Leaf = scalar(interval="[0, 1)")
    buffer_stiffness: Leaf | None = scalar(default=None, interval="(0, inf)", optional=True)

    def factor(self, position) -> jax.Array:
        """The share () of the force constant that is left at a position () [m]."""
        return 1.0 - self.drop * (jnp.clip(position, -self.stroke, self.stroke) / self.stroke) ** 2

    def force(self, position) -> jax.Array | float:
        """The force () of the buffer [N] at a position () [m]."""
        beyond = position - jnp.clip(position, -self.stroke, self.stroke)
        return 0.0 if self.buffer_stiffness is None else -self.buffer_stiffness * beyond
