"""Feedforward inversion is compared with forward simulation and with a two-sided convolution.

The simulations are by scipy and python-control.
"""

import control
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal
from cases import ALGEBRA, DIFFERENCES, DT

from jaxilc.filters import (
    ZPETC,
    StableInverse,
    factors,
    inverse,
    output_ratio,
    stable_inverse,
    zpetc,
)
from jaxilc.filters.inversion import Factors
from jaxilc.plants import StateSpace
from jaxilc.signals.references import s_curve

N = 120
PAIR = 0.95 * np.exp(0.9j)

# Each entry has zeros, poles and gain; the relative degree is the difference of their numbers.
MINIMUM_PHASE = {
    "static": ((), (), -4.0),
    "delay": ((), (0.0, 0.0, 0.0), 2.0),
    "biproper": ((0.5, -0.7), (0.8, 0.3), 3.0),
    "pairs": ((PAIR, PAIR.conjugate(), 0.2), (0.9 + 0.2j, 0.9 - 0.2j, 0.6, 0.1, -0.3), 1e-3),
    "repeated": ((0.4, 0.4, 0.4), (0.7, 0.7, 0.7, 0.7), 0.5),
    "improper": ((0.5, -0.7, 0.1), (0.8,), 3.0),
}
NON_MINIMUM_PHASE = {
    "real": ((1.5, 0.4), (0.9, 0.7, 0.2), 0.1),
    "negative": ((-2.2,), (0.9, 0.7), -0.1),
    "pair": ((1.2j, -1.2j, -0.6), (0.9 + 0.2j, 0.9 - 0.2j, 0.5, 0.1), 0.2),
    "slow": ((0.9, 1.2), (0.5, 0.1, 0.2), 1.0),
    "unstable": ((1.3, 0.2), (1.1, -1.4, 0.3), 2.0),
}
PLANTS = {
    name: Factors(np.array(z, complex), np.array(p, complex), k, DT)
    for name, (z, p, k) in (MINIMUM_PHASE | NON_MINIMUM_PHASE).items()
}


def polynomials(P):
    """Return numerator and denominator of P, with the highest order first."""
    return P.gain * np.real(np.atleast_1d(np.poly(P.zeros))), np.real(
        np.atleast_1d(np.poly(P.poles))
    )


def moving(rest, N=N, level=5.0, seed=3):
    """Return a rough signal (N, 1) that is `level` for the first `rest` samples, and then moves."""
    steps = np.random.default_rng(seed).normal(size=N)
    steps[:rest] = 0.0
    return level + np.cumsum(steps)[:, None]


def simulated(P, r_0):
    """Return the output y of P for r_0 by scipy, from the steady state of its first sample."""
    b, a = polynomials(P)
    if len(b) > len(a):  # an improper P needs input from after the end of the trial
        ahead = len(b) - len(a)
        y = simulated(P._replace(poles=np.append(P.poles, [0.0] * ahead)), r_0)
        return np.append(y[ahead:], [np.nan] * ahead)
    b = np.append(np.zeros(len(a) - len(b)), b)
    state = scipy.signal.lfilter_zi(b, a) * r_0[0] if len(a) > 1 else np.zeros(0)
    return scipy.signal.lfilter(b, a, r_0, zi=state)[0]


def two_sided(P, r, half=3000):
    """Return the only inverse whose impulse response is bounded in both directions of time.

    It is sampled from its frequency response, and the signal keeps its end values for all time.
    """
    b, a = polynomials(P)
    z = np.exp(2j * np.pi * np.fft.fftfreq(2 * half))
    h = np.fft.fftshift(np.fft.ifft(np.polyval(a, z) / np.polyval(b, z)).real)
    held = np.pad(r, (half - 1, half), mode="edge")
    return scipy.signal.fftconvolve(held, h, mode="valid")


@jax.jit
def applied(q, signal):
    return q(signal, q.dt)


@pytest.mark.thorough
@pytest.mark.parametrize("name", MINIMUM_PHASE)
def test_minimum_phase_is_inverted_exactly(name):
    P = PLANTS[name]
    q = stable_inverse(P)
    assert q.advance == len(P.poles) - len(P.zeros)
    assert q.pre_actuation() == max(q.advance, 0)
    r = moving(rest=max(q.advance, 0) + 1)
    y = simulated(P, np.asarray(applied(q, r))[:, 0])
    known = slice(None, N - max(-q.advance, 0))
    np.testing.assert_allclose(y[known], r[known, 0], rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("name", PLANTS)
def test_stable_inversion_is_the_bounded_two_sided_inverse(name):
    """The reference moves at both ends, beyond which it keeps its end values."""
    P, r = PLANTS[name], moving(rest=1)
    expected = two_sided(P, r[:, 0])
    np.testing.assert_allclose(
        applied(stable_inverse(P), r)[:, 0], expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max()
    )


@pytest.mark.parametrize("name", ["real", "negative", "pair", "slow"])
def test_error_of_missing_pre_actuation_falls_with_the_rest_before_the_motion(name):
    P = PLANTS[name]
    q = stable_inverse(P)
    slowest = min(abs(P.zeros[abs(P.zeros) > 1]))
    rests, errors, motion = np.arange(4, 24, 4), [], moving(rest=1, N=30)
    for rest in rests:
        r = np.pad(motion, ((rest - 1, 80 - rest), (0, 0)), mode="edge")
        errors.append(np.max(np.abs(simulated(P, np.asarray(applied(q, r))[:, 0]) - r[:, 0])))
    np.testing.assert_allclose(np.polyfit(rests, np.log(errors), 1)[0], -np.log(slowest), rtol=1e-3)
    r = moving(rest=q.pre_actuation(1e-11) + 1, N=N + 150)
    y = simulated(P, np.asarray(applied(q, r))[:, 0])
    np.testing.assert_allclose(y, r[:, 0], atol=1e-9 * np.abs(r).max())
    assert errors[-1] > 1e-9, "the tolerance of the long rest should be out of reach of a short one"


@pytest.mark.thorough
def test_extension_leaves_the_ratio_of_the_slowest_zeros_to_its_power():
    P, r = PLANTS["slow"], moving(rest=1)
    exact, extensions = two_sided(P, r[:, 0]), np.arange(10, 61, 10)
    errors = [
        np.max(np.abs(applied(stable_inverse(P, extension=int(n)), r)[:, 0] - exact))
        for n in extensions
    ]
    np.testing.assert_allclose(
        np.polyfit(extensions, np.log(errors), 1)[0], np.log(0.9 / 1.2), rtol=1e-2
    )
    assert stable_inverse(P).extension == 3 + int(
        np.ceil(np.log(np.finfo(float).eps) / np.log(0.9 / 1.2))
    )


def response(q, omega, samples=2400):
    """Return the frequency response of a filter at omega [rad/sample].

    It is computed from the pulse response in both directions of time.
    """
    at = samples // 2
    pulse = np.zeros((samples, 1))
    pulse[at] = 1.0
    h = np.asarray(applied(q, pulse))[:, 0]
    return np.exp(-1j * np.outer(omega, np.arange(samples) - at)) @ h


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("zeros", "radius", "mirrored"),
    [
        ((0.5, -0.3), 1.0, ()),
        ((1.5, 0.4), 1.0, (1.5,)),
        ((-1.0, 0.4), 1.0, (-1.0,)),
        ((0.97j, -0.97j, -1.8), 0.95, (0.97j, -0.97j, -1.8)),
        ((0.97j, -0.97j, 1.3), 1.0, (1.3,)),
        ((1j, -1j, 1.02), 1.0, (1j, -1j, 1.02)),
    ],
)
def test_zpetc_has_no_phase_error_and_the_size_of_the_mirrored_zeros(zeros, radius, mirrored):
    P = Factors(np.array(zeros, complex), np.array([0.9, 0.8, 0.3, -0.2], complex), 0.7, DT)
    omega = np.linspace(0, np.pi, 201)
    plant = control.zpk(P.zeros, P.poles, P.gain, dt=DT)
    y_over_r = response(zpetc(P, radius=radius), omega) * plant(np.exp(1j * omega))
    B_u = np.atleast_1d(np.poly(mirrored))
    size = np.abs(np.polyval(B_u, np.exp(1j * omega))) ** 2 / np.polyval(B_u, 1.0).real ** 2
    np.testing.assert_allclose(y_over_r.real, size, rtol=1e-10, atol=1e-12 * size.max())
    np.testing.assert_allclose(y_over_r.imag, 0.0, atol=1e-10 * size.max())
    seen = size > 1e-3 * size.max()
    np.testing.assert_allclose(np.angle(y_over_r[seen]), 0.0, atol=1e-10)
    assert y_over_r[0].real == pytest.approx(1.0, rel=1e-10)


def test_zpetc_keeps_the_ends_held():
    """The output y is |B_u|^2 / B_u(1)^2 r, a symmetric sum, at every sample."""
    P, r = PLANTS["real"], moving(rest=10)
    r[90:] = r[90]
    taps = np.convolve([1.0, -1.5], [-1.5, 1.0]) / (1 - 1.5) ** 2
    expected = np.convolve(np.pad(r[:, 0], 1, mode="edge"), taps, mode="valid")
    np.testing.assert_allclose(
        simulated(P, np.asarray(applied(zpetc(P), r))[:, 0]), expected, **ALGEBRA
    )


@pytest.mark.parametrize(
    ("degree", "expected"),
    [
        (1, ()),
        (2, (-1.0,)),
        (3, (-2 - np.sqrt(3), -2 + np.sqrt(3))),
        (4, (-5 - 2 * np.sqrt(6), -1.0, -5 + 2 * np.sqrt(6))),
    ],
)
def test_sampling_zeros_of_integrators(degree, expected):
    """The sampling zeros of s^-n have the published values (Åström, Hagander, Sternby 1984).

    The gain is the first sample of the step response, dt^n / n!.
    """
    chain = StateSpace(np.eye(degree, k=1), np.eye(degree)[:, -1:], np.eye(degree)[:1])
    P = factors(chain, DT)
    np.testing.assert_allclose(sorted(P.zeros.real), sorted(expected), rtol=1e-10)
    assert P.gain == pytest.approx(DT**degree / np.prod(np.arange(1, degree + 1)), rel=1e-10)


def test_every_kind_of_system_has_the_same_factors():
    tf = control.tf([4.0, 5000.0], [1.0, 30.0, 2000.0])
    ss = control.ss(tf)
    continuous, discrete = StateSpace(ss.A, ss.B, ss.C), control.sample_system(ss, DT)
    (zero,), poles = discrete.zeros(), np.sort_complex(discrete.poles())
    for system in (
        tf,
        ss,
        continuous,
        discrete,
        continuous.sampled(DT),
        control.ss2tf(discrete),
        factors(discrete),
    ):
        P = factors(system, DT)
        np.testing.assert_allclose(P.zeros, [zero], rtol=1e-9)
        np.testing.assert_allclose(np.sort_complex(P.poles), poles, rtol=1e-9)
        assert P.gain == pytest.approx((discrete.C @ discrete.B).item(), rel=1e-9)
    through = control.ss(discrete.A, discrete.B, discrete.C, 0.5, DT)
    z = np.exp(0.3j)
    P = factors(through)
    assert P.gain * np.prod(z - P.zeros) / np.prod(z - P.poles) == pytest.approx(
        through(z), rel=1e-10
    )
    # There are two more samples of dead time.
    delayed = control.ss(control.tf([1.0], [1.0, 0.0, 0.0], DT)) * discrete
    # After this transformation C B is 1e-17 instead of 0.
    T = np.linalg.qr(np.random.default_rng(7).normal(size=(delayed.nstates,) * 2))[0]
    for system in (delayed, control.ss(T.T @ delayed.A @ T, T.T @ delayed.B, delayed.C @ T, 0, DT)):
        P = factors(system)
        assert len(P.poles) - len(P.zeros) == 3
        np.testing.assert_allclose(P.zeros, [zero], rtol=1e-9)


# A two-mass drive from force to positions: 30 kg each, an antiresonance at 70 Hz with damping ratio
# 0.02, a current loop of 1 kHz, sampled at 4 kHz.
FAST = 1 / 4000
m, c_T, c_M, lag = 30.0, 50.0, 100.0, 2 * np.pi * 1000.0
k_s = m * (2 * np.pi * 70.0) ** 2
c_s = 2 * 0.02 * np.sqrt(m * k_s) - c_T
P_Z = control.tf([c_s, k_s], [m, c_s + c_T, k_s])
DRIVE = StateSpace(
    [
        [0.0, 1.0, 0.0, 0.0, 0.0],
        [-k_s / m, -(c_s + c_M) / m, k_s / m, c_s / m, 1 / m],
        [0.0, 0.0, 0.0, 1.0, 0.0],
        [k_s / m, c_s / m, -k_s / m, -(c_s + c_T) / m, 0.0],
        [0.0, 0.0, 0.0, 0.0, -lag],
    ],
    [[0.0], [0.0], [0.0], [0.0], [lag]],
    np.eye(5)[[0, 2]],
)
MOVE = np.pad(
    s_curve([0.0, 10.0], velocity=200.0, acceleration=4000.0, jerk=2e5, dwell=0.02, dt=FAST),
    (200, 0),
)[:, None]


def positions(force):
    """Return motor and table position (N, 2) of the drive for a held force (N,).

    python-control samples and simulates the drive.
    """
    drive = control.sample_system(control.ss(DRIVE.A, DRIVE.B, DRIVE.C, 0), FAST)
    return control.forced_response(drive, np.arange(len(force)) * FAST, force).outputs.T


@pytest.mark.parametrize("method", ["stable", "zpetc"])
def test_table_follows_an_s_curve_through_the_inverse_of_the_transmission(method):
    """Sampled as it is, P_Z has a single zero at -0.21, so both inverses are exact.

    The tolerance, 1e-12 of the 10 mm, is some thousand rounding errors.
    """
    r_0 = np.asarray(applied(inverse(P_Z, FAST, method), MOVE))[:, 0]
    held = control.sample_system(control.ss(P_Z), FAST)
    y = control.forced_response(held, np.arange(len(r_0)) * FAST, r_0).outputs
    np.testing.assert_allclose(y, MOVE[:, 0], atol=1e-11)
    assert np.max(np.abs(r_0 - MOVE[:, 0])) > 0.01, (
        "the motor must lead the table by the spring's deflection"
    )


def test_ratio_of_two_outputs_recovers_one_from_the_other():
    """The table has zeros at -1.2 and -11.4, the motor one at -2.7: the ratio is unstable."""
    ratio = output_ratio(DRIVE, FAST)
    assert np.sum(np.abs(ratio.zeros) > 1) == 2
    assert np.sum(np.abs(ratio.poles) > 1) == 1
    q = stable_inverse(ratio)
    force = np.pad(np.cumsum(np.random.default_rng(5).normal(size=500)), (100, 0))
    y = positions(1e3 * force)
    # After its end the signal of the table is taken as constant, which affects the last samples.
    y_M = np.asarray(applied(q, y[:, 1:]))[:, 0]
    inside = slice(0, len(y) - q.pre_actuation(1e-13))
    np.testing.assert_allclose(y_M[inside], y[inside, 0], rtol=1e-9, atol=1e-9 * np.abs(y).max())
    assert np.max(np.abs(y[inside, 0] - y[inside, 1])) > 1e-3 * np.abs(y).max()


@pytest.mark.thorough
def test_held_motor_position_puts_the_table_half_a_sample_ahead():
    """The force comes from the inverse of the motor, which follows r_0 exactly.

    The table then follows r only if r_0 comes from the ratio.
    """
    motor = stable_inverse(StateSpace(DRIVE.A, DRIVE.B, DRIVE.C[:1]), FAST)
    error = {}
    for name, design in (
        ("ratio", stable_inverse(output_ratio(DRIVE, FAST))),
        ("held", stable_inverse(P_Z, FAST)),
    ):
        r_0 = applied(design, MOVE)
        y = positions(np.asarray(applied(motor, r_0))[:, 0])
        np.testing.assert_allclose(y[:, 0], r_0[:, 0], atol=1e-10)
        error[name] = y[:, 1] - MOVE[:, 0]
    velocity = np.gradient(MOVE[:, 0], FAST)
    np.testing.assert_allclose(error["ratio"], 0.0, atol=1e-10)
    np.testing.assert_allclose(
        error["held"], velocity * FAST / 2, atol=0.01 * velocity.max() * FAST / 2
    )
    assert error["held"].max() > 0.02  # [mm]


BOTH = {"stable": stable_inverse(PLANTS["pair"], extension=6), "zpetc": zpetc(PLANTS["pair"])}


@pytest.mark.parametrize("name", BOTH)
def test_gradient_with_respect_to_the_reference_equals_finite_differences(name):
    q, r = BOTH[name], moving(rest=5, N=40)

    @jax.jit
    def level(r):
        # It is not linear in r, so that the gradient depends on r.
        return jnp.mean(jnp.sin(q(r, DT)) ** 2)

    gradient = jax.jit(jax.grad(level))(r)
    assert np.all(np.isfinite(gradient))
    way = 1e-6 * np.random.default_rng(2).normal(size=r.shape)
    expected = (level(r + way) - level(r - way)) / 2
    np.testing.assert_allclose(jnp.vdot(gradient, way), expected, rtol=DIFFERENCES["rtol"])


def tf(numerator, denominator=(1.0, -0.5, 0.0), dt=DT):
    return control.tf(list(numerator), list(denominator), dt)


TWO = StateSpace([[0.9]], [[1.0]], [[1.0], [2.0]], dt=DT)
TWO_BY_TWO = control.ss(0.9 * np.eye(2), np.eye(2), np.eye(2), 0, DT)
UNREACHED = StateSpace(0.9 * np.eye(2), [[1.0], [0.0]], [[0.0, 1.0]], dt=DT)
ERRORS = {
    r"stable_inverse: the zero z = -1.* lies on the unit circle.*ZPETC": lambda: stable_inverse(
        tf([1.0, 1.0])
    ),
    r"stable_inverse: the zero z = 1.* lies on the unit": lambda: stable_inverse(tf([1.0, -1.0])),
    r"allowed is a distance of 1e-06": lambda: stable_inverse(tf([1.0, 1.0 + 5e-7])),
    r"zpetc: the system has a zero at z = 1; .* other than 0": lambda: zpetc(tf([1.0, -1.0])),
    r"zpetc: radius = 1.2 is outside .* \(0, 1\]": lambda: zpetc(tf([1.0]), radius=1.2),
    r"StableInverse: extension = -1 is outside": lambda: stable_inverse(tf([1.0]), extension=-1),
    r"method = 'exact' is not one of 'stable', 'z": lambda: inverse(tf([1.0]), method="exact"),
    r"factors: the system has 1 inputs and 2 outputs; allowed is one of each": lambda: inverse(TWO),
    r"has 2 inputs and 2 outputs": lambda: inverse(TWO_BY_TWO),
    r"factors: the system is zero": lambda: inverse(tf([0.0])),
    r"the system is zero": lambda: inverse(UNREACHED),
    r"factors: dt = None is outside .* \(0, inf\)": lambda: inverse(tf([1.0], dt=0)),
    r"factors: dt = -1.0 is outside .* \(0, inf\)": lambda: inverse(tf([1.0], dt=0), -1.0),
    r"sampled at 0.001 s but dt = 0.002 s; .* 0.001": lambda: inverse(tf([1.0]), 2e-3),
    r"dt = True of the system leaves the .* open": lambda: inverse(tf([1.0], dt=True), DT),
    r"factors: float is not a jaxilc StateSpace": lambda: inverse(3.0, DT),
    r"output_ratio: the system has 2 inputs": lambda: output_ratio(
        StateSpace([[0.9]], [[1.0, 1.0]], [[1.0]], dt=DT)
    ),
    r"above = 2, below = 0 are not .* 0..1": lambda: output_ratio(TWO, above=2),
    r"StableInverse: dt = 0.002 s .* allowed is dt = 0.001": lambda: BOTH["stable"].check(N, 2e-3),
    r"ZPETC: dt = 0.002 s is not that of the design": lambda: BOTH["zpetc"](moving(1), 2e-3),
}


@pytest.mark.parametrize("message", ERRORS)
def test_what_an_inverse_cannot_do_is_named(message):
    with pytest.raises(ValueError, match=message):
        ERRORS[message]()


def test_no_sections_of_a_file_are_rows_of_none():
    assert np.shape(ZPETC([], 1.0, 0, DT).forward) == (0, 5)
    empty = StableInverse([], [], 1.0, 0, DT)
    assert np.shape(empty.forward) == np.shape(empty.backward) == (0, 5)


def test_options_go_to_their_method():
    assert inverse(PLANTS["slow"], extension=7).extension == 7
    assert isinstance(inverse(PLANTS["slow"]), StableInverse)
    assert isinstance(inverse(PLANTS["slow"], method="zpetc", radius=0.5), ZPETC)
    with pytest.raises(TypeError, match="radius"):
        inverse(PLANTS["slow"], radius=0.9)
