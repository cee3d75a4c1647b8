"""Zero-phase filters are compared with scipy and numpy."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.fft
import scipy.signal
from cases import ALGEBRA, DT

from jaxilc.filters import ZeroPhaseButterworth, ZeroPhaseFIR, ZeroPhaseIIR
from jaxilc.filters.zero_phase import butterworth_sections
from jaxilc.schemes import Filtered, PIDType
from jaxilc.signals import Task

N = 90
# The signal neither starts nor ends at zero.
SIGNAL = np.cumsum(np.random.default_rng(2).normal(size=(N, 2)), axis=0) + 5.0


@jax.jit
def filtered(q, signal):
    return q(signal, DT)


@pytest.mark.parametrize("order", range(1, 9))
def test_butterworth_is_sosfiltfilt(order):
    for cutoff in (4.0, 31.0, 120.0, 470.0):
        sections = scipy.signal.butter(order, cutoff, fs=1 / DT, output="sos")
        expected = scipy.signal.sosfiltfilt(sections, SIGNAL, axis=0)
        np.testing.assert_allclose(
            filtered(ZeroPhaseButterworth(cutoff, order, 3 * (order + 1)), SIGNAL),
            expected,
            rtol=1e-8,
            atol=1e-8,
            err_msg=cutoff,
        )


@pytest.mark.parametrize("order", [1, 2, 7])
def test_mirrored_at_its_ends_a_signal_is_weighted_by_q_cosine_by_cosine(order):
    """A filter that mirrors a signal at its ends multiplies each of its cosines by Q.

    This is compared with scipy's cosine transform, and with filtering, forward and backward, a
    signal that is mirrored again and again.
    """
    for cutoff in (9.0, 120.0, 499.0):
        sections = scipy.signal.butter(order, cutoff, fs=1 / DT, output="sos")
        _, response = scipy.signal.sosfreqz(sections, np.arange(N) / (2 * N * DT), fs=1 / DT)
        expected = scipy.fft.idct(
            np.abs(response[:, None]) ** 2 * scipy.fft.dct(SIGNAL, axis=0), axis=0
        )
        found = filtered(ZeroPhaseButterworth(cutoff, order), SIGNAL)
        np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-8, err_msg=cutoff)
        if cutoff == 499.0:  # its pole is close to -1, so its transient decays too slowly
            continue
        again = np.concatenate([SIGNAL, SIGNAL[::-1]] * 21 + [SIGNAL])
        far = scipy.signal.sosfiltfilt(sections, again, axis=0)[20 * N : 21 * N]
        np.testing.assert_allclose(found, far, rtol=1e-6, atol=1e-6, err_msg=cutoff)


@pytest.mark.parametrize(
    "q", [ZeroPhaseButterworth(40.0), ZeroPhaseIIR(*scipy.signal.butter(3, 200.0, fs=1 / DT))]
)
def test_mirrored_nothing_comes_out_larger_and_a_constant_stays(q):
    """With mirrored ends nothing becomes larger, and a constant stays as it is.

    The odd extension can amplify a signal at the ends, so learning can grow there.
    """
    matrix = np.asarray(filtered(q, jnp.eye(N)))
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-12)
    assert np.linalg.norm(matrix, 2) <= 1 + 1e-12
    np.testing.assert_allclose(matrix.sum(axis=1), 1.0, atol=1e-9)
    assert (
        np.linalg.norm(np.asarray(filtered(dataclasses.replace(q, padding=9), jnp.eye(N))), 2)
        > 1.02
    )


@pytest.mark.parametrize("padding", [0, 1, 7, N - 1])
def test_butterworth_takes_scipys_padding(padding):
    sections = scipy.signal.butter(3, 60.0, fs=1 / DT, output="sos")
    expected = scipy.signal.sosfiltfilt(
        sections, SIGNAL, axis=0, padtype="odd" if padding else None, padlen=padding
    )
    q = ZeroPhaseButterworth(60.0, order=3, padding=padding)
    q.check(N, DT)
    np.testing.assert_allclose(filtered(q, SIGNAL), expected, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("order", [1, 2, 5])
def test_sections_have_unit_dc_gain_and_half_power_at_the_cutoff(order):
    for cutoff in (10.0, 240.0):
        sections = np.asarray(butterworth_sections(jnp.asarray(cutoff, float), DT, order))
        b, a = sections[:, :3], np.column_stack([np.ones(len(sections)), sections[:, 3:]])
        _, response = scipy.signal.sosfreqz(np.hstack([b, a]), [0.0, cutoff, 499.9], fs=1 / DT)
        np.testing.assert_allclose(np.abs(response[:2]), [1.0, np.sqrt(0.5)], rtol=1e-10)
        assert abs(response[2]) < 1e-2
        np.testing.assert_allclose(b.sum(axis=1), a.sum(axis=1), rtol=1e-12)


@pytest.mark.parametrize("padding", [None, 12])
def test_derivative_with_respect_to_the_cutoff(padding):
    def level(cutoff):
        return jnp.sum(ZeroPhaseButterworth(cutoff, 3, padding)(SIGNAL, DT) ** 2)

    derivative = jax.jit(jax.grad(level))
    level = jax.jit(level)
    for cutoff in (20.0, 150.0):
        expected = (level(cutoff + 1e-3) - level(cutoff - 1e-3)) / 2e-3
        assert float(derivative(cutoff)) == pytest.approx(float(expected), rel=1e-5)


def test_butterworth_keeps_a_straight_line_and_is_symmetric_in_time():
    """A zero-phase Butterworth filter keeps a straight line, and is symmetric in time.

    Reversing the signal reverses the result, except for the transients at the ends.
    """
    line = np.linspace(-1.0, 3.0, N)[:, None]
    q = ZeroPhaseButterworth(100.0, padding=9)
    np.testing.assert_allclose(filtered(q, line), line, atol=1e-3)
    bump = np.exp(-(((np.arange(N) - 30) / 4.0) ** 2))[:, None]
    np.testing.assert_allclose(filtered(q, bump[::-1])[::-1], filtered(q, bump), atol=1e-6)
    assert np.argmax(filtered(q, bump)) == 30


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


BUTTERWORTH, FIR = ZeroPhaseButterworth, ZeroPhaseFIR
ERRORS = {
    "nyquist": (
        lambda: BUTTERWORTH(500.0),
        r"ZeroPhaseButterworth: cutoff = 500(\.0)? Hz is outside its allowed range \(0, 500\)",
    ),
    "negative": (
        lambda: BUTTERWORTH(-1.0),
        r"ZeroPhaseButterworth: cutoff = -1 is outside its allowed range \(0, inf\)",
    ),
    "order": (
        lambda: BUTTERWORTH(50.0, order=0),
        r"ZeroPhaseButterworth: order = 0 is outside its allowed range \[1, 100\]",
    ),
    "order_half": (lambda: BUTTERWORTH(50.0, order=2.5), r"ZeroPhaseButterworth: order = 2.5"),
    "padding": (
        lambda: BUTTERWORTH(50.0, padding=90),
        r"padding = 90 is outside its allowed range \[0, 89\] for N = 90",
    ),
    "negative_padding": (
        lambda: BUTTERWORTH(50.0, padding=-1),
        r"padding = -1 is outside its allowed range",
    ),
    "taps": (
        lambda: FIR(np.ones(91)),
        r"ZeroPhaseFIR: taps has shape \(91,\); allowed is \(m\+1,\) with m < N = 90",
    ),
    "taps_matrix": (lambda: FIR(np.ones((2, 2))), r"ZeroPhaseFIR: taps has shape \(2, 2\)"),
    "taps_scalar": (lambda: FIR(1.0), r"ZeroPhaseFIR: taps has shape \(\)"),
}


@pytest.mark.parametrize(("build", "message"), ERRORS.values(), ids=ERRORS)
def test_what_a_filter_cannot_do_is_named(build, message):
    with pytest.raises(ValueError, match=message):
        Filtered(PIDType(), build()).check(Task(np.zeros(N + 1), dt=DT))


def test_no_rounding_of_the_nyquist_angle_makes_a_filter_nan():
    """Some lengths round pi N / (2 N) to an angle beyond pi / 2, with a negative tangent."""
    N = 13
    assert np.tan(np.pi * N / (2 * N)) < 0
    y = ZeroPhaseButterworth(cutoff=50.0, order=2)(np.ones((N, 1)), 1e-3)
    np.testing.assert_allclose(y, 1.0, rtol=1e-12)
