"""Signals of a whole trial, shifted by samples or summed over them."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax

from ..signals.sample_layout import for_scan


def advance(signal, samples: int) -> jax.Array:
    """The rows signal[k + samples], k = 0..N-1, of a (N+1, n) signal; zero after the trial."""
    if samples == 0:
        return signal[:-1]
    rows = signal[samples:]
    return jnp.pad(rows, ((0, len(signal) - 1 - len(rows)), (0, 0)))


def delay(signal, samples: int) -> jax.Array:
    """The rows signal[k - samples], k = 0..N-1, of a (N, n) signal; zero before the trial."""
    if samples == 0:
        return signal
    # XLA writes a padded signal, `jnp.pad`, in a loop over the machines that is not vectorised
    return jnp.concatenate([jnp.zeros_like(signal[:samples]), signal[:-samples]])


def running_sum(signal) -> jax.Array:
    """The sums over i <= k of the rows signal[i], as (N, n).

    `jnp.cumsum` adds in several passes over the signal, and takes longer than the trial itself.
    """

    def add(total, row):
        return total + row, total + row

    return for_scan(lax.scan(add, jnp.zeros_like(signal[0]), for_scan(signal))[1])
