"""Zero-phase filters are compared with scipy and numpy."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.fft
import scipy.signal
from cases import ALGEBRA, DT

from jaxilc.filters import ZeroPhaseBandStop, ZeroPhaseButterworth, ZeroPhaseFIR, ZeroPhaseIIR
from jaxilc.schemes import Filtered, PIDType
from jaxilc.signals import Task

N = 90
# The signal neither starts nor ends at zero.
SIGNAL = np.cumsum(np.random.default_rng(2).normal(size=(N, 2)), axis=0) + 5.0


@jax.jit
def filtered(q, signal):
    return q(signal, DT)


def cosines(response):
    """Return the signal with each of its cosines multiplied by |response|^2, by scipy."""
    weighted = np.abs(response[:, None]) ** 2 * scipy.fft.dct(SIGNAL, axis=0)
    return scipy.fft.idct(weighted, axis=0)


LINES = np.arange(N) / (2 * N * DT)  # frequencies of the cosines [Hz]
PADDED = [*((order, 3 * (order + 1)) for order in range(1, 9)), (3, 0), (3, 1), (3, 7), (3, N - 1)]


@pytest.mark.thorough(but=["1-6", "2-9", "3-0", "3-89", "7-24", "8-27"])
@pytest.mark.parametrize(("order", "padding"), PADDED)
def test_butterworth_is_sosfiltfilt(order, padding):
    for cutoff in (4.0, 31.0, 60.0, 120.0, 470.0):
        sections = scipy.signal.butter(order, cutoff, fs=1 / DT, output="sos")
        expected = scipy.signal.sosfiltfilt(sections, SIGNAL, axis=0, padlen=padding)
        q = ZeroPhaseButterworth(cutoff, order, padding)
        q.check(N, DT)
        close = 1e-10 if cutoff == 60.0 and order == 3 else 1e-8
        np.testing.assert_allclose(
            filtered(q, SIGNAL), expected, rtol=close, atol=close, err_msg=cutoff
        )


@pytest.mark.parametrize("order", [1, 2, 7])
def test_mirrored_at_its_ends_a_signal_is_weighted_by_q_cosine_by_cosine(order):
    """By scipy's cosine transform, and by filtering a signal that is mirrored again and again."""
    for cutoff in (9.0, 120.0, 499.0):
        sections = scipy.signal.butter(order, cutoff, fs=1 / DT, output="sos")
        expected = cosines(scipy.signal.sosfreqz(sections, LINES, fs=1 / DT)[1])
        found = filtered(ZeroPhaseButterworth(cutoff, order), SIGNAL)
        np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-8, err_msg=cutoff)
        if cutoff == 499.0:  # its pole is close to -1, so its transient decays too slowly
            continue
        again = np.concatenate([SIGNAL, SIGNAL[::-1]] * 21 + [SIGNAL])
        far = scipy.signal.sosfiltfilt(sections, again, axis=0)[20 * N : 21 * N]
        np.testing.assert_allclose(found, far, rtol=1e-6, atol=1e-6, err_msg=cutoff)


@pytest.mark.parametrize("order", [1, 2, 5, 40])
def test_a_band_stop_weights_each_cosine_by_scipys_response(order):
    for edges in ((20.0, 60.0), (100.0, 101.0), (3.0, 490.0)):
        sections = scipy.signal.butter(order, edges, "bandstop", fs=1 / DT, output="sos")
        expected = cosines(scipy.signal.sosfreqz(sections, LINES, fs=1 / DT)[1])
        found = ZeroPhaseBandStop(*edges, order)(SIGNAL, DT)
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


IIR = {
    "butterworth": scipy.signal.butter(3, 60.0, fs=1 / DT),
    "elliptic": scipy.signal.ellip(4, 0.5, 40.0, 120.0, fs=1 / DT),
    "longer_numerator": (np.array([0.2, 0.3, 0.1, 0.05, 0.02]), np.array([1.0, -0.4])),
    "unscaled": (np.array([1.0]), np.array([2.0, -1.1, 0.3])),
    "moving_average": (np.full(4, 0.25), np.array([1.0])),
}


@pytest.mark.parametrize("name", IIR)
def test_zero_phase_iir_is_filtfilt_or_weights_each_cosine(name):
    b, a = IIR[name]
    mirrored = cosines(scipy.signal.freqz(b, a, LINES, fs=1 / DT)[1])
    for padding in (None, 3 * max(len(b), len(a)), 0):
        q = ZeroPhaseIIR(b, a, padding)
        q.check(N, DT)
        expected = mirrored
        if padding is not None:
            expected = scipy.signal.filtfilt(b, a, SIGNAL, axis=0, padlen=padding)
        np.testing.assert_allclose(filtered(q, SIGNAL), expected, rtol=1e-8, atol=1e-8)


def test_a_gain_is_a_recursive_filter_too():
    by_gain = filtered(ZeroPhaseIIR((3.0,), (2.0,)), SIGNAL)
    np.testing.assert_allclose(by_gain, 2.25 * SIGNAL, **ALGEBRA)


@pytest.mark.parametrize(
    "q", [ZeroPhaseButterworth(40.0), ZeroPhaseIIR(*scipy.signal.butter(3, 200.0, fs=1 / DT))]
)
def test_mirrored_nothing_comes_out_larger_and_a_constant_stays(q):
    """The odd extension can amplify a signal at the ends, so learning can grow there."""
    matrix = np.asarray(filtered(q, jnp.eye(N)))
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-12)
    assert np.linalg.norm(matrix, 2) <= 1 + 1e-12
    np.testing.assert_allclose(matrix.sum(axis=1), 1.0, atol=1e-9)
    extended = filtered(dataclasses.replace(q, padding=9), jnp.eye(N))
    assert np.linalg.norm(np.asarray(extended), 2) > 1.02


@pytest.mark.parametrize("order", [1, 2, 5])
def test_in_single_precision_a_padded_filter_far_below_the_sample_rate_keeps_its_numbers(order):
    for cutoff in (0.01, 1.0):
        q = ZeroPhaseButterworth(cutoff, order, padding=60)
        with jax.enable_x64(False):
            single = [filtered(q, jnp.asarray(x, jnp.float32)) for x in (SIGNAL, 0 * SIGNAL + 7.3)]
        assert {x.dtype for x in single} == {np.dtype("float32")}
        np.testing.assert_allclose(single[0], filtered(q, SIGNAL), rtol=2e-5, atol=2e-5)
        assert np.all(single[1] == np.float32(7.3))


@pytest.mark.parametrize("padding", [None, 12])
def test_derivative_with_respect_to_the_cutoff(padding):
    def level(cutoff):
        return jnp.sum(ZeroPhaseButterworth(cutoff, 3, padding)(SIGNAL, DT) ** 2)

    derivative = jax.jit(jax.grad(level))
    level = jax.jit(level)
    for cutoff in (20.0, 150.0):
        expected = (level(cutoff + 1e-3) - level(cutoff - 1e-3)) / 2e-3
        assert float(derivative(cutoff)) == pytest.approx(float(expected), rel=1e-5)


def test_the_derivatives_of_a_band_stop_are_differences_and_finite_where_it_is_zero():
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
    "taps", [(1.0,), (0.5, 0.25), (0.3, 0.2, 0.1, 0.05), np.full(N, 1 / (2 * N - 1))]
)
def test_fir_is_the_symmetric_sum_with_held_ends(taps):
    expected = np.zeros_like(SIGNAL)
    for k in range(N):
        for i, tap in enumerate(taps):
            for at in {k - i, k + i}:
                expected[k] += tap * SIGNAL[min(max(at, 0), N - 1)]
    q = ZeroPhaseFIR(taps)
    q.check(N, DT)
    np.testing.assert_allclose(filtered(q, SIGNAL), expected, **ALGEBRA)


BUTTERWORTH, FIR, STOP = ZeroPhaseButterworth, ZeroPhaseFIR, ZeroPhaseBandStop
ERRORS = {
    r"Butterworth: cutoff = 500(\.0)? Hz is outside .* \(0, 500\)": lambda: BUTTERWORTH(500.0),
    r"Butterworth: cutoff = -1 is outside .* \(0, inf\)": lambda: BUTTERWORTH(-1.0),
    r"Butterworth: order = 0 is outside .* \[1, 100\]": lambda: BUTTERWORTH(50.0, order=0),
    r"ZeroPhaseButterworth: order = 2.5": lambda: BUTTERWORTH(50.0, order=2.5),
    r"padding = 90 is .* \[0, 89\] for N = 90": lambda: BUTTERWORTH(50.0, padding=90),
    r"padding = -1 is outside its allowed range": lambda: BUTTERWORTH(50.0, padding=-1),
    r"taps has shape \(91,\); allowed is \(m\+1,\) with m < N = 90": lambda: FIR(np.ones(91)),
    r"ZeroPhaseFIR: taps has shape \(2, 2\)": lambda: FIR(np.ones((2, 2))),
    r"ZeroPhaseFIR: taps has shape \(\)": lambda: FIR(1.0),
    r"BandStop: high = 60(\.0)? Hz; allowed is more than low = 60": lambda: STOP(60.0, 60.0),
    r"BandStop: high = 500(\.0)? Hz is outside .* \(0, 500\)": lambda: STOP(60.0, 500.0),
    r"ZeroPhaseBandStop: low = 0": lambda: STOP(0.0, 60.0),
}


@pytest.mark.parametrize("message", ERRORS)
def test_what_a_filter_cannot_do_is_named(message):
    with pytest.raises(ValueError, match=message):
        Filtered(PIDType(), ERRORS[message]()).check(Task(np.zeros(N + 1), dt=DT))


def test_no_rounding_of_the_nyquist_angle_makes_a_filter_nan():
    """Some lengths round pi N / (2 N) to an angle beyond pi / 2, with a negative tangent."""
    N = 13
    assert np.tan(np.pi * N / (2 * N)) < 0
    y = ZeroPhaseButterworth(cutoff=50.0, order=2)(np.ones((N, 1)), 1e-3)
    np.testing.assert_allclose(y, 1.0, rtol=1e-12)
