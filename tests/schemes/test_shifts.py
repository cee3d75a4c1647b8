"""Shifts of the signals of a trial, against NumPy's indices, also beyond the trial."""

import numpy as np
import pytest

from jaxilc.schemes.shifts import advance, delay

N = 5


@pytest.mark.parametrize("samples", [0, 1, N - 1, N, N + 4])
def test_rows_from_outside_the_trial_are_zero(samples):
    signal = np.random.default_rng(samples).normal(size=(N + 1, 2))
    rows = dict(enumerate(signal))
    zero = np.zeros(2)
    before = [rows.get(k - samples, zero) for k in range(N)]
    np.testing.assert_array_equal(delay(signal[:-1], samples), before)
    after = [rows.get(k + samples, zero) for k in range(N)]
    np.testing.assert_array_equal(advance(signal, samples), after)
