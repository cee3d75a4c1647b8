"""Plants are compared with python-control and with printed values."""

import dataclasses
from functools import partial

import control
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.signal
from cases import ALGEBRA, ARX, DT, PLANTS, task_for
from refusals import refused

from jaxilc.learning import Machine, learn
from jaxilc.plants import (
    ByPosition,
    DifferenceEquation,
    ProcessModel,
    StateSpace,
    StribeckFriction,
    TwoAxes,
    VoiceCoil,
    cnc_axis,
    fast_tool_servo,
    motion,
    voice_coil,
    voice_coil_motor,
)
from jaxilc.plants.linear import exponential
from jaxilc.schemes import PID, PIDType
from jaxilc.signals import Task

N = 60
U = np.random.default_rng(3).normal(size=N)


@partial(jax.jit, static_argnames="dt")
def response(plant, u, dt=DT):
    """Return the output (N+1, n_y) of the package for the input u (N, n_u)."""
    return motion(plant, jnp.asarray(u).reshape(-1, plant.n_u), dt)


def voice_coil_tf(gain=7437.7769, zero=928.2, poles=(474.0, 474.0, 6.404), lead=0.0):
    zeros = float(gain) * np.polymul([float(lead), 1.0], [1.0, -float(zero)])
    return control.tf(np.trim_zeros(zeros, "f"), np.poly([-float(p) for p in poles]))


sampled = jax.jit(lambda plant, dt: plant.sampled(dt), static_argnums=1)


def test_voice_coil_has_the_coefficients_of_the_paper():
    d = sampled(voice_coil("exact"), DT)
    np.testing.assert_allclose(d.a, (2.23863097, -1.62458219, 0.38504156), atol=5e-9)
    np.testing.assert_allclose(d.b, (0.00181091, -0.00363007, -0.00254555), atol=5e-9)
    assert d.b[0] > 0
    assert np.sum(d.b) / (1 - np.sum(d.a)) == pytest.approx(-4.798, abs=5e-4)


@pytest.mark.parametrize("first", [2.2386, 2.236])
def test_a_printed_difference_equation_is_what_its_motor_is_when_held(first):
    """The coefficients of Cao 2019, eq. 29, and Dai 2014, eq. 24, as they stand in print.

    They sum to b = -0.0043, and 1 - a = 0.0010, or 0.0036 with 2.236: another DC gain.
    """
    d = sampled(voice_coil("printed" if first == 2.2386 else "dai_2014_printed"), DT)
    np.testing.assert_allclose(d.a, (first, -1.6246, 0.385), rtol=1e-13)
    np.testing.assert_allclose(d.b, (0.0018, -0.0036, -0.0025), rtol=1e-12)


COILS = {
    "double_pole": {},
    "distinct": {"poles": (300.0, 600.0, 20.0)},
    "triple": {"poles": (50.0, 50.0, 50.0), "gain": 100.0},
    "minimum_phase": {"zero": -900.0, "gain": -5000.0},
    "lead": {"lead": 2e-4},
}


@pytest.mark.parametrize("weights", COILS.values(), ids=COILS)
@pytest.mark.parametrize("dt", [1e-3, 2.5e-4])
def test_voice_coil_is_the_zero_order_hold_of_its_transfer_function(weights, dt):
    plant = sampled(VoiceCoil(**weights), dt)
    system = voice_coil_tf(
        **{k: getattr(VoiceCoil(**weights), k) for k in ("gain", "zero", "poles", "lead")}
    )
    discrete = control.c2d(control.ss(system), dt, method="zoh")
    exact = control.ss2tf(discrete)
    np.testing.assert_allclose(plant.a, -exact.den[0][0][1:], rtol=1e-7)
    np.testing.assert_allclose(
        plant.b, exact.num[0][0][-3:], rtol=1e-6, atol=1e-9 * np.max(np.abs(plant.b))
    )
    y = control.forced_response(discrete, np.arange(N + 1) * dt, np.append(U, 0.0)).outputs
    np.testing.assert_allclose(response(plant, U, dt)[:, 0], y, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("size", [1e-3, 1.0, 30.0, 1e3])
def test_the_matrix_exponential_is_scipy_s(size):
    rng = np.random.default_rng(6)
    for n in (1, 2, 5):
        Q = np.linalg.qr(rng.normal(size=(n, n)))[0]
        M = size * (-Q * rng.uniform(0, 1, n) @ Q.T + 0.3 * np.triu(rng.normal(size=(n, n)), 1))
        np.testing.assert_allclose(exponential(M), scipy.linalg.expm(M), rtol=1e-11, atol=1e-12)
    assert np.all(np.isfinite(exponential(np.array([[-1e9, 1.0], [0.0, -1.0]]))))


def test_single_precision_samples_a_companion_form_to_its_digits():
    system = scipy.signal.tf2ss([1.0], np.poly(-2 * np.pi * np.array([20.0, 30.0, 40.0, 50.0])))[:3]
    single, double = (
        StateSpace(*(np.asarray(M, kind) for M in system)).sampled(1e-3)
        for kind in (np.float32, np.float64)
    )
    assert single.A.dtype == single.B.dtype == np.float32
    impulses = []
    for plant in (single, double):
        A, x, C = (np.asarray(M, float) for M in (plant.A, plant.B, plant.C))
        impulses.append([(C @ np.linalg.matrix_power(A, k) @ x).item() for k in range(40)])
    np.testing.assert_allclose(*impulses, rtol=0, atol=1e-5 * np.max(np.abs(impulses[1])))


@pytest.mark.parametrize("gain", [1e-20, 1.0, 1e16])
def test_an_integrator_alone_is_held_whatever_its_gain(gain):
    held = StateSpace([[0.0]], [[gain]], [[1.0]]).sampled(1e-3)
    np.testing.assert_allclose([held.A[0, 0], held.B[0, 0]], [1.0, 1e-3 * gain], rtol=1e-12)


@pytest.mark.parametrize("hertz", [5.0, 500.0])
def test_a_companion_form_is_sampled_to_all_digits(hertz):
    """Its numbers are powers of the frequencies: 1e14 for a fourth order at 500 Hz.

    By partial fractions the same plant is four scalar ones, whose exponentials are numbers.
    """
    w, dt = 2 * np.pi * hertz, 0.2 / hertz
    poles = w * np.array([-0.1 + 0.995j, -0.1 - 0.995j, -0.7 + 0.71j, -0.7 - 0.71j])
    plant = StateSpace(*scipy.signal.tf2ss([w**4], np.poly(poles).real)[:3])
    residues = [w**4 / np.prod(p - np.delete(poles, i)) for i, p in enumerate(poles)]
    x, y = np.zeros(4, complex), []
    for u in U:
        x = np.exp(poles * dt) * x + (np.exp(poles * dt) - 1) / poles * u
        y.append((residues @ x).real)
    found = response(plant, U, dt)[1:, 0]
    np.testing.assert_allclose(found, y, rtol=0, atol=1e-11 * np.max(np.abs(y)))

    def last(scale):
        return jnp.sum(dataclasses.replace(plant, A=scale * plant.A).sampled(dt).A[0])

    slope = (last(1 + 1e-6) - last(1 - 1e-6)) / 2e-6
    np.testing.assert_allclose(jax.grad(last)(1.0), slope, rtol=1e-5)


FORMS = {
    "^voice_coil: form = 'x' is not one of 'exact', 'printed', 'dai_2014_printed'$": voice_coil,
    "^voice_coil_motor: form = 'x' is not one of 'identified', 'printed'$": voice_coil_motor,
    "^fast_tool_servo: form = 'x' is not one of 'identified', 'full'$": fast_tool_servo,
    "^cnc_axis: form = 'x' is not one of 'printed', 'double_integrator'$": cnc_axis,
}
test_unknown_form_is_named = refused(FORMS, lambda make: make("x"))


def test_difference_equation_steps_as_written():
    (a1, a2), (b1, b2) = ARX
    u, y = U, np.zeros(N + 1)
    for k in range(N):
        y[k + 1] = a1 * y[k] + b1 * u[k] + (a2 * y[k - 1] + b2 * u[k - 1] if k else 0.0)
    np.testing.assert_allclose(response(PLANTS["arx"], u)[:, 0], y, **ALGEBRA)


def test_state_space_starts_from_x0():
    plant = PLANTS["continuous"]
    free = control.initial_response(
        control.ss(plant.A, plant.B, plant.C, 0), np.arange(N + 1) * DT, plant.x0
    ).outputs
    np.testing.assert_allclose(response(plant, np.zeros((N, 1)))[:, 0], free, rtol=1e-8, atol=1e-12)
    assert np.max(np.abs(free)) > 0.01


@pytest.mark.parametrize(
    "plant", [voice_coil("printed").sampled(DT), PLANTS["discrete"], PLANTS["arx"]]
)
def test_another_sample_time_is_refused(plant):
    with pytest.raises(
        ValueError,
        match=f"{type(plant).__name__} is sampled at 0.001 s but the task at 0.002 s; "
        "allowed is dt = 0.001",
    ):
        learn(Machine(plant), PID(), Task(np.zeros(9), dt=2e-3), 1)


REFUSED = {
    r"StateSpace: A \(2, 2\), B \(3, 1\), C \(1, 2\) do not fit": lambda: StateSpace(
        np.eye(2), np.ones((3, 1)), np.ones((1, 2))
    ),
    r"StateSpace: .*B \(2,\).* do not fit": lambda: StateSpace(
        np.eye(2), np.ones(2), np.ones((1, 2))
    ),
    r"StateSpace: .*C \(2,\).* do not fit": lambda: StateSpace(
        np.eye(2), np.ones((2, 1)), np.ones(2)
    ),
    r"StateSpace: .*do not fit": lambda: StateSpace(0.5, 1.0, 1.0),
    r"StateSpace: .*x0": lambda: StateSpace(
        np.eye(2), np.ones((2, 1)), np.ones((1, 2)), x0=np.ones(3)
    ),
    "a and b have n = 501 coefficients; allowed are at most 500": lambda: DifferenceEquation(
        np.zeros(501), np.zeros(501), dt=DT
    ),
    "poles and frequencies give 1001 poles; allowed are at most 1000": lambda: ProcessModel(
        1.0, (), np.ones(1001), (), ()
    ),
    r"DifferenceEquation: a \(2,\) and b \(1,\) must both": lambda: DifferenceEquation(
        (1.0, 0.5), (1.0,), dt=DT
    ),
    r"a \(0,\) and b .* shape \(n,\), n >= 1": lambda: DifferenceEquation((), (), dt=DT),
    r"a \(1, 1\) and b \(1, 1\) must": lambda: DifferenceEquation([[0.5]], [[1.0]], dt=DT),
    r"VoiceCoil: .*poles": lambda: VoiceCoil(poles=(474.0, 6.404)),
    "StribeckFriction: static_force = 8.0 is below coulomb_force = 10.0": lambda: StribeckFriction(
        10.0, 8.0
    ),
}
test_misshapen_plants_are_refused_at_construction = refused(REFUSED)


@pytest.mark.parametrize("around", [lambda plant: plant, ByPosition, lambda p: TwoAxes(p, p)])
def test_a_time_varying_plant_belongs_to_trials_of_its_length_also_within_another(around):
    N, plant = PLANTS["time_varying"].N, around(PLANTS["time_varying"])
    with pytest.raises(ValueError, match=f"given for N = {N} samples but the task has N = {N + 4}"):
        learn(Machine(plant), PIDType(gamma_p=0.1), task_for(plant, N + 4), 1)
