"""What of the record of a trial reaches the learning law, and how late.

Each function returns one draw, or, with no key, the mean over all draws, for theory. A chance is
compared with a random number, so its slope is zero almost everywhere, and nothing about the mean.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from ..pytree.aliases import Array, Leaf
from ..runtime.jax_internals import once


def there_until(shortest: Array, N: int, key: Array | None) -> Array:
    """(N+1,) 1 up to the end of a trial that is drawn uniformly from [shortest, 1] of N samples."""
    k = np.arange(N + 1) / N
    if key is None:
        room = jnp.where(shortest < 1, 1 - shortest, 1.0)
        return 1 - jnp.clip((k - shortest) / room, 0.0, 1.0)
    shortest = without_slope(shortest)
    share = jax.random.uniform(key)
    last = jnp.floor(N * (shortest + (1 - shortest) * share) + 1e-9)
    return jnp.where(k * N <= last + 0.5, 1.0, 0.0)


def not_lost(dropped: Array, N: int, key: Array | None) -> Array:
    """(N+1,) 1 where a sample arrives, 0 where it is lost, with a chance, after k = 0."""
    if key is None:
        kept = jnp.full(N + 1, 1 - dropped)
    else:
        kept = jnp.where(jax.random.uniform(key, (N + 1,)) >= without_slope(dropped), 1.0, 0.0)
    return kept.at[0].set(1.0)


def shifted(y: Array, late: int, key: Array | None) -> Array:
    """(N+1, n_y) the record y, late as a whole by 0 .. late samples; at its start it is y[0]."""
    held = jnp.pad(y, ((late, 0), (0, 0)), mode="edge")
    if key is None:
        return jnp.stack([held[d : d + len(y)] for d in range(late + 1)]).mean(0)
    return jax.lax.dynamic_slice_in_dim(
        held, late - jax.random.randint(key, (), 0, late + 1), len(y)
    )


def newest(y: Array, delayed: Array, most: int, key: Array | None) -> Array:
    """(N+1, n_y) the newest sample of y that has arrived at each instant, held until the next one.

    Sample k needs delta_k samples to arrive: 0 with the chance 1 - delayed, else 1 .. most, all
    alike. At k the record holds y[m] with the largest m for which m + delta_m <= k; y[0] is known
    at once. With most = 1 that is the random one-step delay (1 - xi_k) y[k] + xi_k y[k-1].
    """
    rows = len(y)
    if key is None:
        held, mean = jnp.pad(y, ((most, 0), (0, 0)), mode="edge"), jnp.zeros_like(y)
        still: Leaf = 1.0
        for age in range(most + 1):  # still: the chance that no sample newer than k - age is there
            missing = delayed * (most - age) / most
            mean = mean + still * (1 - missing) * held[most - age : most - age + rows]
            still = still * missing
        return mean
    of_chance, of_delay = jax.random.split(key)
    slow = jax.random.uniform(of_chance, (rows,)) < without_slope(delayed)
    delay = jnp.where(slow, jax.random.randint(of_delay, (rows,), 1, most + 1), 0).at[0].set(0)
    k = jnp.arange(rows)
    arrives = k + delay
    at = jnp.zeros(rows, int).at[arrives].max(k, mode="drop")
    return jnp.asarray(y)[jax.lax.cummax(at)]


def without_slope(chance: Array) -> Array:
    """The chance itself; raises ValueError where it is differentiated."""
    return once(
        jnp.asarray(chance),
        "Variation: shortest, dropped and delayed are chances, of which a drawn trial has no "
        "gradient; allowed are gradients by all other parameters. Sweep a chance, or take "
        "differences of the mean over many machines with the same keys",
    )
