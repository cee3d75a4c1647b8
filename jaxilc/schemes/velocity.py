"""The velocity of an encoder signal, which a controller must estimate."""

from __future__ import annotations

import jax


def filtered_difference(slope, x, x_last, tau, dt) -> jax.Array:
    """One step of the backward difference behind a first-order low-pass: d/dt -> s / (tau s + 1) at
    s = (1 - z^-1) / dt.

        slope' = (tau slope + x - x_last) / (tau + dt),    H(z) = (1 - z^-1) / (tau + dt - tau z^-1)

    A ramp comes out exactly, once settled; slow signals come out late by tau + dt / 2; at a
    frequency w the amplitude is
    |H| / w = |sin(w dt / 2)| / (w dt / 2) / |1 + tau (1 - z^-1) / dt|. White noise of standard
    deviation q in x, as rounding to a resolution of sqrt(12) q is, becomes q sqrt(2 / ((tau + dt)
    (2 tau + dt))) in the slope.
    slope: (n,) of the sample before [x/s];  x, x_last: (n,) signal now and a sample before;  tau:
    () or (n,) >= 0 [s];  dt: [s]
    """
    return (tau * slope + x - x_last) / (tau + dt)
