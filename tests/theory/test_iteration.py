"""Lanczos's method against singular values that are known."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxilc.theory.spectrum import largest


@pytest.mark.parametrize("rate", [0.02, 1.0, 30.0, 300.0])
def test_singular_values_of_very_different_sizes_have_a_bound(rate):
    # The residual of the largest one underflows to 0 in few steps, which says nothing of a larger
    # one that the process has not met yet.
    values = 0.5 * np.exp(-rate * np.arange(500.0))
    found = largest(lambda v: values * v, lambda v: values * v, jnp.zeros(500), 500, steps=60,
                    tolerance=0.0)  # fmt: skip
    assert found.value <= 0.5 * (1 + 1e-12)
    assert 0.5 <= found.bound <= 0.5 * 1.1
