"""Parts of a ball-screw drive: the error of its lead, and the table that compensates friction."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from ..pytree.fields import Leaf, leaf, pytree, scalar
from ..pytree.needs import known
from .friction import StribeckFriction


@pytree
class LeadError:
    """The screw's deviation from its nominal lead, periodic in the motor's position.

        l(x) = A sin(2 pi x / period + phase)

    amplitude: () A [m]
    period:    () [m], the pitch or a part of it
    phase:     () [rad]
    """

    amplitude: Leaf = scalar(interval="[0, inf)")
    period: Leaf = scalar(interval="(0, inf)")
    phase: Leaf = scalar(default=0.0)

    def at(self, position) -> tuple[jax.Array, jax.Array]:
        """l () [m] and dl/dx () at a position () [m]."""
        k = 2 * jnp.pi / self.period
        angle = k * position + self.phase
        return self.amplitude * jnp.sin(angle), self.amplitude * k * jnp.cos(angle)


@pytree
class FrictionTable:
    """Look-up table of the drive that compensates friction.

    It gives the force to add at a commanded velocity, interpolated.

    velocity: (M,) increasing [m/s]
    force:    (M,) [N]; beyond the ends the end values hold

    Raises ValueError for a velocity that does not increase, or shapes that differ.
    """

    velocity: Leaf = leaf()
    force: Leaf = leaf()

    def __post_init__(self):
        if (
            self.velocity.ndim != 1
            or self.velocity.shape != self.force.shape
            or len(self.velocity) < 2
        ):
            raise ValueError(
                f"FrictionTable: velocity {self.velocity.shape} and force {self.force.shape} must "
                "both have shape (M,), M >= 2"
            )
        if known(self) and np.any(np.diff(self.velocity) <= 0):
            raise ValueError(f"FrictionTable: velocity = {np.asarray(self.velocity)} must increase")

    def at(self, velocity) -> jax.Array:
        """The force () [N] at a velocity () [m/s]."""
        return jnp.interp(velocity, self.velocity, self.force)

    @classmethod
    def of(cls, friction: StribeckFriction, velocity) -> FrictionTable:
        """The table that an identification experiment at given velocities (M,) [m/s] leaves."""
        velocity = np.asarray(velocity, float)
        return cls(velocity, np.asarray(friction.force(velocity)))
