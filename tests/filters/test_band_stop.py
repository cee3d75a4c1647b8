"""The band-stop filter is compared with scipy's, also near its edges and for steep orders."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.fft
import scipy.signal
from cases import DT

from jaxilc.filters import ZeroPhaseBandStop

N = 90
SIGNAL = np.cumsum(np.random.default_rng(2).normal(size=(N, 2)), axis=0) + 5.0


@pytest.mark.parametrize("order", [1, 2, 5, 40])
def test_each_cosine_is_weighted_by_scipys_response(order):
    for edges in ((20.0, 60.0), (100.0, 101.0), (3.0, 490.0)):
        sections = scipy.signal.butter(order, edges, "bandstop", fs=1 / DT, output="sos")
        _, response = scipy.signal.sosfreqz(sections, np.arange(N) / (2 * N * DT), fs=1 / DT)
        weighted = np.abs(response[:, None]) ** 2 * scipy.fft.dct(SIGNAL, axis=0)
        found = ZeroPhaseBandStop(*edges, order)(SIGNAL, DT)
        np.testing.assert_allclose(found, scipy.fft.idct(weighted, axis=0), rtol=1e-9, atol=1e-9)


def test_its_derivatives_are_differences_and_finite_where_it_is_zero():
    @jax.jit
    def level(low, high):
        return jnp.sum(ZeroPhaseBandStop(low, high)(SIGNAL, DT) ** 2)

    slopes = jax.jit(jax.grad(level, (0, 1)))(30.0, 80.0)
    for slope, low, high in zip(slopes, (1e-4, 0.0), (0.0, 1e-4), strict=True):
        expected = (level(30.0 + low, 80.0 + high) - level(30.0 - low, 80.0 - high)) / 2e-4
        assert float(slope) == pytest.approx(float(expected), rel=1e-6)
    # x_l x_h = 1 at a quarter of the sample rate, which is a line of an even number of samples
    edges = np.arctan([0.8, 1 / 0.8]) / (np.pi * DT)
    assert np.all(np.isfinite(jax.grad(level, (0, 1))(*edges)))


@pytest.mark.parametrize(
    ("edges", "said"),
    [
        ((60.0, 60.0), r"high = 60(\.0)? Hz; allowed is more than low = 60"),
        ((60.0, 500.0), r"high = 500(\.0)? Hz is outside its allowed range \(low, 500\)"),
        ((0.0, 60.0), "low = 0"),
    ],
)
def test_edges_that_are_not_allowed_are_named(edges, said):
    with pytest.raises(ValueError, match=f"ZeroPhaseBandStop: {said}"):
        ZeroPhaseBandStop(*edges).check(N, DT)
