"""Where the samples of a batch lie in RAM: those of all its members at one instant side by side.

XLA would keep each member's samples together, as `vmap` numbers them, and transpose every signal on
its way into the loop over time and out of it. On a CPU that took a quarter of the time of
CFDL-MFAILC. Both functions return what they are given, and matter only under `vmap`.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from ..runtime.jax_internals import rows_together


def for_carry(signals):
    """The signals, laid out for their way from trial to trial.

    signals: a tree; its arrays of two or more axes have one row a sample
    """
    return _laid_out(signals, turned=False)


def for_scan(signals):
    """The signals, laid out for their way into a scan over samples, or out of it."""
    return _laid_out(signals, turned=True)


def _laid_out(signals, *, turned: bool):
    return jax.tree.map(
        lambda x: rows_together(x, turned=turned) if jnp.ndim(x) > 1 else x, signals
    )
