"""Smooth maps of the real line, on which an optimiser moves, onto the range of a weight."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

MARGIN = 1e-6  # smallest distance of a value from an end of its range, on the unit interval
FAR = 60.0  # largest |z| on the real line; beyond it exponentials are held constant
NUDGE = 1e-3  # share of the range by which a start on its end is moved inside


@dataclasses.dataclass(frozen=True)
class Bijection:
    """A smooth map of the real line onto an open interval, with s(z) = 1 / (1 + e^-z).

        (-inf, inf)    scale z
        (a, inf)       a + e^z
        (-inf, b)      b - e^z
        (a, b)         a + (b - a) s(z)
        (a, b), a and b of one sign    a (b / a)^s(z): each order of magnitude has the same weight

    low, high: () ends of the interval
    scale: () factor of the map onto the whole real line
    """

    low: float
    high: float
    scale: float = 1.0

    def __call__(self, z):
        low, high = self.low, self.high
        if np.isinf(low) and np.isinf(high):
            return self.scale * z
        if np.isinf(high) or np.isinf(low):
            end, sign = (low, 1.0) if np.isinf(high) else (high, -1.0)
            nearest = np.log(MARGIN * abs(end)) if end else -FAR
            return end + sign * jnp.exp(jnp.clip(z, nearest, FAR))
        share = MARGIN + (1.0 - 2.0 * MARGIN) * jax.nn.sigmoid(z)
        return low * (high / low) ** share if low * high > 0 else low + (high - low) * share

    def inverse(self, value: float) -> float:
        """The number z that is mapped to this value inside the interval."""
        low, high = self.low, self.high
        if np.isinf(low) and np.isinf(high):
            return value / self.scale
        if np.isinf(high):
            return float(np.log(value - low))
        if np.isinf(low):
            return float(np.log(high - value))
        share = (
            np.log(value / low) / np.log(high / low)
            if low * high > 0
            else (value - low) / (high - low)
        )
        share = (share - MARGIN) / (1.0 - 2.0 * MARGIN)
        return float(np.log(share / (1.0 - share)))

    def inside(self, value: float) -> float:
        """The value, moved inside the interval if it lies on an end of it."""
        width = self.high - self.low if np.isfinite(self.high - self.low) else 1.0
        if value <= self.low + 10 * MARGIN * width:
            # If the range has only the end 0, the value approaches it exponentially and needs no
            # distance from it.
            return value if value > self.low and np.isinf(self.high) else self.low + NUDGE * width
        return self.high - NUDGE * width if value >= self.high - 10 * MARGIN * width else value
