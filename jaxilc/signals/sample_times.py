"""The sample times of a reference, and the ranges that its parameters share."""

from __future__ import annotations

import numpy as np

from ..pytree.ranges import require
from ..runtime.capacity import check_size

FINITE, POSITIVE, NONNEGATIVE = "(-inf, inf)", "(0, inf)", "[0, inf)"
ARRAYS = 32  # of the length of a reference, that making it and one trial of it take


def sample_times(function, duration, dt, arrays=ARRAYS):
    """(N+1,) sample times [s], N = round(duration / dt).

    arrays: how many arrays of that length will be needed

    Raises ValueError for a value outside its range, more samples than fit into memory, or a
    duration that is not a whole number of samples.
    """
    require(function, "dt", dt, POSITIVE, " s")
    require(function, "duration", duration, POSITIVE, " s")
    samples = float(duration) / float(dt)
    said = f"{function}: duration = {duration:g} s"
    check_size(said, lambda samples: 8 * arrays * samples, samples=samples)
    N = round(samples)
    if N < 1 or abs(samples - N) > 1e-6:
        raise ValueError(
            f"{function}: duration = {duration:g} s is not a whole number >= 1 of samples of dt = "
            f"{dt:g} s"
        )
    return np.arange(N + 1) * dt
