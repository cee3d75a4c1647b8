"""A law that keeps what it knows of samples that were not measured."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from ..pytree.fields import child, pytree
from ..signals.task import Trial
from .scheme import Scheme
from .wrapper import Wrapper


@pytree
class KeepUnmeasured(Wrapper):
    """A scheme whose memory of a sample stays as it was where this sample was not measured.

    In a record of a machine whose trials differ, samples that were not measured have the error and
    the weight zero. A law that adds to its input then leaves it alone. A law that also compares
    trials, such as `CFDLMFAILC`, that forgets, or that filters, would still take the zero for
    data. Here each row of its memory that belongs to sample k of the input stays, unless y[k+1] was
    measured; then increments are those from the last trial that was.

    scheme: any scheme that learns from the error
    """

    weighs = True  # another law for each set of samples that are measured

    scheme: Scheme = child()

    def learn(self, memory, trial: Trial) -> Any:
        following = super().learn(memory, trial)
        if trial.weight is None:
            return following
        there, N = jnp.any(trial.weight != 0, axis=(1, 2)), len(trial.u)

        def kept(old, new):
            rows = jnp.shape(new)[0] if jnp.ndim(new) else 0
            if rows not in (N, N + 1):
                return new
            measured = there[1:] if rows == N else there
            return jnp.where(measured.reshape(-1, *(1,) * (jnp.ndim(new) - 1)), new, old)

        return jax.tree.map(kept, memory, following)
