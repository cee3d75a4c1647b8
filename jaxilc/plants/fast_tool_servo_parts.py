"""Parts of a fast tool servo: its coefficients, flexible mode, creep, forces on its tool."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..pytree.fields import Leaf, leaf, pytree, scalar


class ServoCoefficients(NamedTuple):
    """y'' = -a1 y - a2 y' + b u + f (Xu 2024, eq. 4): what a model-based scheme is given.

    a1: () [1/s^2]
    a2: () [1/s]
    b:  () [um/(V s^2)]
    """

    a1: jax.Array
    a2: jax.Array
    b: jax.Array


@pytree
class FlexibleMode:
    """A resonance beside the servo's, which the second-order model leaves out (Xu 2024, sec. 5.2).

        G_mode(s) = share G(0) w^2 / (s^2 + 2 zeta w s + w^2), added to G(s)

    frequency: () w / 2 pi [Hz]
    damping:   () zeta
    share:     () of the servo's static deflection. Positive: an antiresonance lies between the two
               resonances (drive and encoder move alike). Negative: there is none, and the phase
               goes on falling

    The mode is excited by the drive, not by forces on the tool.
    """

    frequency: Leaf = scalar(interval="(0, inf)")
    damping: Leaf = scalar(interval="(0, 1)")
    share: Leaf = scalar()


@pytree
class Creep:
    """The piezo goes on extending under a held voltage v.

        tau_i y_i' = share_i G(0) v - y_i, summed and added to the output

    A few operators spaced by decades stand for the logarithmic law y (1 + c log10(t / t_0)), each
    with the share c.

    shares:         (n,) of the servo's static deflection
    time_constants: (n,) tau [s]
    """

    shares: Leaf = leaf()
    time_constants: Leaf = leaf(interval="(0, inf)")

    def __post_init__(self):
        _need_alike(self, "shares", "time_constants")


@pytree
class PeriodicForce:
    """Force on the tool against +y that repeats in each trial.

        F(t) = sum_i a_i sin(2 pi f_i t + phase_i), t from the start of the trial

    amplitudes:  (n,) [N]
    frequencies: (n,) [Hz]
    phases:      (n,) [rad]
    """

    amplitudes: Leaf = leaf()
    frequencies: Leaf = leaf(interval="(0, inf)")
    phases: Leaf = leaf()

    def __post_init__(self):
        _need_alike(self, "amplitudes", "frequencies", "phases")


@pytree
class CuttingForce:
    """Force of the cut against +y, proportional to the depth of cut.

        F(y) = K p(depth + y),    p(d) = (d + sqrt(d^2 + blur^2)) / 2, a smooth max(d, 0)

    It acts while the tool is in the workpiece.

    stiffness: () K, force per depth of cut [N/um]
    depth:     () of cut at y = 0 [um]
    blur:      () width of the transition at the surface [um], not less than the tool moves in a
               step of the integrator
    """

    stiffness: Leaf = scalar(interval="[0, inf)")
    depth: Leaf = scalar()
    blur: Leaf = scalar(default=0.5, interval="(0, inf)")

    def force(self, position) -> jax.Array:
        """The force () [N] at a position () [um]."""
        d = self.depth + position
        return self.stiffness * (d + jnp.sqrt(d * d + self.blur**2)) / 2


def _need_alike(tree, *names):
    """Raises ValueError unless the named fields have one shape (n,)."""
    shapes = {name: np.shape(getattr(tree, name)) for name in names}
    if len(set(shapes.values())) > 1 or not shapes[names[0]]:
        raise ValueError(f"{type(tree).__name__}: {shapes} must have one shape (n,)")
