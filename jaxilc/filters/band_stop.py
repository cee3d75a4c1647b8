"""A zero-phase filter that stops a band, such as that of a resonance which nobody knows exactly."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from ..pytree.aliases import Leaf
from ..pytree.fields import leaf, pytree, static
from ..pytree.needs import known
from .zero_phase import Filter, half_angles, mirrored


@pytree
class ZeroPhaseBandStop(Filter):
    """Butterworth band-stop filter, run forward and backward on a signal mirrored at its ends.

        F = 1 / (1 + (B x / (x^2 - x_l x_h))^(2 order)),   x = tan(pi f dt),   B = x_h - x_l

    with x_l and x_h at the edges `low` and `high`. F is 0 at one frequency between the edges, 1 at
    rest and at the Nyquist frequency, and 1/2 (-6 dB) at both edges. As `ErrorFiltered` it keeps a
    law from learning around a resonance.

    low, high: () edges [Hz], 0 < low < high < 1 / (2 dt); differentiable
    order:     of one pass

    Raises ValueError for edges that do not rise; `check` raises it for edges from the Nyquist
    frequency on.
    """

    low: Leaf = leaf(interval="(0, inf)")
    high: Leaf = leaf(interval="(0, inf)")
    order: int = static(default=2, interval="[1, 100]", whole=True)

    def __post_init__(self):
        if known(self) and not np.all(np.asarray(self.low) < np.asarray(self.high)):
            raise ValueError(
                f"ZeroPhaseBandStop: high = {self.high} Hz; allowed is more than low = "
                f"{self.low} Hz"
            )

    def check(self, samples: int, dt: float) -> None:
        if known(self) and np.any(np.asarray(self.high) >= 0.5 / dt):
            raise ValueError(
                f"ZeroPhaseBandStop: high = {self.high} Hz is outside its allowed range (low, "
                f"{0.5 / dt:g}), Nyquist at dt = {dt:g} s"
            )

    def __call__(self, signal, dt):
        return mirrored(signal, self.response(half_angles(len(signal)), dt))

    def response(self, angles, dt) -> jax.Array:
        """F at pi f dt = angles (F,).

        Sine and cosine stand in place of the tangent, which is infinite at the Nyquist frequency,
        and logarithms in place of the power, which could overflow.
        """
        low, high = (jnp.tan(jnp.pi * edge * dt) for edge in (self.low, self.high))
        sin, cos = jnp.sin(angles), jnp.maximum(jnp.cos(angles), 0.0)
        band = jnp.log(sin * cos)  # -inf at rest
        distance = jnp.abs(sin**2 - low * high * cos**2)
        distance = jnp.maximum(distance, jnp.finfo(distance.dtype).tiny)
        return jax.nn.sigmoid(2 * self.order * (jnp.log(distance) - jnp.log(high - low) - band))
