"""Friction of guides and screws, smooth enough to differentiate through."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from ..pytree.aliases import Array, Leaf
from ..pytree.fields import pytree, scalar
from ..pytree.needs import known


@pytree
class StribeckFriction:
    """Friction force that opposes the velocity, the Stribeck curve.

        F(v) = [F_c + (F_s - F_c) exp(-(v/v_s)^2)] tanh(v/v_t) + sigma v

    It is that of Armstrong-Hélouvry, Dupont and Canudas de Wit (1994) with the sign of v smoothed
    to tanh(v/v_t), so that F has a gradient everywhere. The price is that nothing sticks for good:
    under a force F < F_s the body creeps, at v_t artanh(F/F_s) or less. A smaller v_t holds better
    and makes the motion stiffer.

    coulomb_force:       () F_c [N]
    static_force:        () F_s >= F_c, force to break away [N]
    stribeck_velocity:   () v_s, where static has mostly given way to Coulomb friction [m/s]
    viscous:             () sigma [N s/m]
    transition_velocity: () v_t, below which the friction acts as a damper F_s/v_t [m/s]; it must be
                         well below v_s, or F_s is not reached

    For a rotary axis read N m and rad/s. Raises ValueError for a static force below the Coulomb
    force.
    """

    coulomb_force: Leaf = scalar(interval="[0, inf)")
    static_force: Leaf = scalar(interval="[0, inf)")
    stribeck_velocity: Leaf = scalar(default=0.01, interval="(0, inf)")
    viscous: Leaf = scalar(default=0.0, interval="[0, inf)")
    transition_velocity: Leaf = scalar(default=5e-4, interval="(0, inf)")

    def __post_init__(self) -> None:
        if known(self) and np.any(np.asarray(self.static_force) < np.asarray(self.coulomb_force)):
            raise ValueError(
                f"StribeckFriction: static_force = {self.static_force} is below coulomb_force = "
                f"{self.coulomb_force}; "
                "allowed is static_force >= coulomb_force"
            )

    @property
    def damping_at_rest(self) -> Array:
        """() dF/dv at v = 0, where F is steepest [N s/m].

        An explicit integrator must be able to follow it.
        """
        return self.static_force / self.transition_velocity + self.viscous

    def force(self, velocity: Leaf) -> Array:
        """The force to subtract from the driving one [N] at a velocity [m/s], both of any shape."""
        v, F_c, F_s = velocity, self.coulomb_force, self.static_force
        level = F_c + (F_s - F_c) * jnp.exp(-((v / self.stribeck_velocity) ** 2))
        return level * jnp.tanh(v / self.transition_velocity) + self.viscous * v
