"""Signals of a whole trial, shifted by samples."""

from __future__ import annotations

import jax
import jax.numpy as jnp


def advance(signal, samples: int) -> jax.Array:
    """The rows signal[k + samples], k = 0..N-1, of a (N+1, n) signal; zero after the trial."""
    return jnp.pad(signal[samples:], ((0, samples - 1), (0, 0))) if samples else signal[:-1]


def delay(signal, samples: int) -> jax.Array:
    """The rows signal[k - samples], k = 0..N-1, of a (N, n) signal; zero before the trial."""
    return signal if samples == 0 else jnp.pad(signal, ((samples, 0), (0, 0)))[:-samples]
