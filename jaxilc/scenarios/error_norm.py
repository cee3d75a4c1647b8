"""The 2-norm of the error, by which other software judges a trial."""

from __future__ import annotations

import jax

from ..learning.metrics import root_mean_square
from ..signals.task import Trial


def error_norm(trial: Trial) -> jax.Array:
    """||e||_2 of a trial: the root of the sum of the squared errors, over all samples and outputs.

    It grows with the number of samples; the metric `rms` does not.
    """
    e = trial.e.reshape(-1, 1)
    return root_mean_square(e)[0] * e.size**0.5
