"""A pendulum under a torque: a short nonlinear plant, unstable where it stands upright."""

from __future__ import annotations

import jax.numpy as jnp

from ..pytree.aliases import Array, Leaf, Tree
from ..pytree.fields import pytree, scalar
from .plant import Plant


@pytree
class Pendulum(Plant):
    """A mass on an arm, from torque [N m] to angle [rad], which is 0 where it hangs at rest.

        angle[k+1] = angle[k] + dt speed[k]
        speed[k+1] = speed[k] + dt / (inertia + mass length^2)
                     (u[k] - damping speed[k] - gravity mass length sin(angle[k]))

    This is one explicit Euler step a sample, as the examples of gILC (Volckaert, Diehl, Swevers
    2013) state it. The sample time is thus a part of the plant: at another one it is another
    difference equation. It is of relative degree two, so u[k] acts on y[k+2] first.

    mass:    () [kg]
    damping: () of the joint [N m s/rad]
    inertia: () about the centre of mass [kg m^2]
    length:  () from the joint to the centre of mass [m]
    gravity: () [m/s^2]; a negative one makes the upright position that at rest
    """

    input_names = ("torque",)
    output_names = ("angle",)

    mass: Leaf = scalar(default=0.5, interval="(0, inf)")
    damping: Leaf = scalar(default=0.1, interval="[0, inf)")
    inertia: Leaf = scalar(default=0.006, interval="[0, inf)")
    length: Leaf = scalar(default=0.3, interval="(0, inf)")
    gravity: Leaf = scalar(default=9.81)

    def initial_state(self) -> Array:
        """(2,) angle and speed, at rest."""
        return jnp.zeros(2)

    def step(self, x: Tree, u: Array, dt: float) -> Array:
        angle, speed = x
        weight = self.gravity * self.mass * self.length * jnp.sin(angle)
        inertia = self.inertia + self.mass * self.length**2
        rate = (u[0] - self.damping * speed - weight) / inertia
        return jnp.stack([angle + dt * speed, speed + dt * rate])

    def output(self, x: Tree) -> Array:
        return x[:1]
