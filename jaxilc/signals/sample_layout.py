"""The layout of the samples of a batch in RAM: those of all machines at one instant are adjacent.

XLA would keep the samples of each machine together, as `vmap` numbers them, and would transpose
every signal before the loop over time and after it. On a CPU that took a quarter of the time of
CFDL-MFAILC. Both functions return their argument, and have an effect only under `vmap`.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from ..runtime.jax_internals import rows_together


def for_carry(signals):
    """The signals with the layout for the carry of the loop over trials.

    signals: a tree; its arrays of two or more axes have one row for each sample
    """
    return _laid_out(signals, turned=False)


def for_scan(signals):
    """The signals with the layout for the rows of a scan over samples, before or after the scan."""
    return _laid_out(signals, turned=True)


def _laid_out(signals, *, turned: bool):
    return jax.tree.map(
        lambda x: rows_together(x, turned=turned) if jnp.ndim(x) > 1 else x, signals
    )
