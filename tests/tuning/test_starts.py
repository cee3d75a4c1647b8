"""Functions of one start give for many what they give for each."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxilc.tuning.descent import over_starts
from jaxilc.tuning.problem import in_rounds, value_and_slope


@pytest.mark.parametrize("starts", [1, 3])
def test_a_function_of_one_start_is_applied_to_each(starts):
    z, state = np.arange(2.0 * starts).reshape(starts, 2), {"count": np.arange(starts)}

    def step(z, state):
        return z * state["count"], {"count": state["count"] + 1, "none": None}, 2

    moved, following, two = over_starts(step)(z, state)
    np.testing.assert_array_equal(moved, z * np.arange(starts)[:, None])
    np.testing.assert_array_equal(following["count"], 1 + np.arange(starts))
    np.testing.assert_array_equal(two, [2] * starts)


@pytest.mark.parametrize("size", [1, 2, 3, 5])
def test_rows_are_evaluated_in_rounds_of_one_size(size):
    rows, sizes = {"a": np.arange(4.0), "b": np.arange(4.0) ** 2}, []

    def f(values):
        sizes.append(len(values["a"]))
        return jnp.asarray(10 * values["a"] + values["b"])

    np.testing.assert_array_equal(in_rounds(f, rows, size), [0, 11, 24, 39])
    assert sizes == [size] * -(-4 // size)


@pytest.mark.parametrize("weights", [1, 2])
@pytest.mark.parametrize("forward", [False, True])
def test_value_and_slope_of_few_weights(weights, forward):
    z = jnp.arange(1.0, 1.0 + weights)
    value, slope = value_and_slope(lambda z: jnp.sum(jnp.sin(z) * z), z, forward=forward)
    np.testing.assert_allclose(value, np.sum(np.sin(z) * z), rtol=1e-12)
    np.testing.assert_allclose(slope, np.cos(z) * z + np.sin(z), rtol=1e-12)
