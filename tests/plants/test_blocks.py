"""Trials in blocks, against SciPy's, python-control's and the plant's own, and where it steps."""

import control
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal
from cases import ALGEBRA, ARX, DT, PLANTS, PRINTED, task_for

from jaxilc.learning import Actuator, Disturbance, Machine, Sensor, learn, run_trial
from jaxilc.plants import DifferenceEquation, InBlocks, StateSpace, TwoAxes, VoiceCoil, blocks
from jaxilc.pytree import replaced
from jaxilc.schemes import CFDLMFAILC, PID, GradientILC, NormOptimal, PIDType, Scheme, WithFeedback
from jaxilc.schemes.scheme import Feedforward
from jaxilc.signals import Task

RNG = np.random.default_rng(0)
POLES = (0.99, 0.95, 0.8, 0.97 * np.exp(0.2j), 0.97 * np.exp(-0.2j), 0.5)
# It loses nine digits in blocks.
CLOSE = DifferenceEquation(-np.poly(POLES).real[1:], (1e-3, -4e-4, 0.0, 0.0, 2e-4, 1e-4), dt=DT)
OVERFLOWING = DifferenceEquation((1e8,), (1.0,), dt=DT)


@pytest.fixture
def no_steps(monkeypatch):
    """Make every step of a plant return NaN, so that a finite number must come from the blocks."""
    monkeypatch.setattr(
        blocks, "stepped", lambda plant, u, dt: jnp.full((len(u) + 1, plant.n_y), jnp.nan)
    )


def responses(plant, inputs):
    """Return the response to each u of the pairs (u, length of a block), by one program."""

    def each(plant, inputs):
        return [
            InBlocks(plant, length).sampled(DT).response(u, DT)
            for u, length in zip(inputs, lengths, strict=True)
        ]

    inputs, lengths = zip(*inputs, strict=True)
    return jax.jit(each)(plant, inputs)


def response(plant, u, length):
    return responses(plant, [(u, length)])[0]


LENGTHS = ((64, 8), (61, 8), (57, 8), (5, 8), (1, 2))  # samples of the trial and of a block


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("a", "b"), [ARX, PRINTED, ((1.0,), (0.3,))], ids=["arx", "voice_coil", "integrator"]
)
def test_a_difference_equation_is_scipys(no_steps, a, b):
    inputs = [(RNG.normal(size=(N, 1)), length) for N, length in LENGTHS]
    found = responses(DifferenceEquation(a, b, dt=DT), inputs)
    for (u, _), y in zip(inputs, found, strict=True):
        expected = scipy.signal.lfilter((0.0, *b), (1.0, *(-x for x in a)), np.append(u[:, 0], 0.0))
        np.testing.assert_allclose(y[:, 0], expected, **ALGEBRA, err_msg=f"N = {len(u)}")


@pytest.mark.parametrize("x0", [None, (0.3, -2.0)])
def test_two_inputs_and_outputs_are_python_controls(no_steps, x0):
    A, B, C = (np.asarray(getattr(PLANTS["mimo"], name)) for name in "ABC")
    u, time = RNG.normal(size=(45, 2)), DT * np.arange(46)
    system = control.c2d(control.ss(A, B, C, np.zeros((2, 2))), DT)
    expected = control.forced_response(
        system, time, np.vstack([u, [[0.0, 0.0]]]).T, 0.0 if x0 is None else x0
    ).outputs.T
    plant = StateSpace(system.A, system.B, C, x0, dt=DT)
    np.testing.assert_allclose(response(plant, u, 8), expected, **ALGEBRA)


@pytest.mark.thorough
def test_two_axes_are_each_on_its_own(no_steps):
    x, y, u = DifferenceEquation(*ARX, dt=DT), PLANTS["discrete"], RNG.normal(size=(30, 2))
    alone = np.hstack([response(x, u[:, :1], 4), response(y, u[:, 1:], 16)])
    np.testing.assert_allclose(response(TwoAxes(x, y), u, 8), alone, **ALGEBRA)


@jax.jit
def outputs(plant, task, u):
    return run_trial(Machine(plant), Scheme(), task, Feedforward(u), jax.random.key(0)).y


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["continuous", "motor_and_table"])
def test_a_linear_plant_moves_in_blocks_as_in_steps(no_steps, name):
    plant = PLANTS[name]
    task, u = task_for(plant, 40), RNG.normal(size=(40, plant.n_u))
    plain, wrapped = (outputs(p, task, u) for p in (plant, InBlocks(plant, 8)))
    np.testing.assert_allclose(wrapped, plain, rtol=1e-9, atol=1e-11 * np.max(np.abs(plain)))


TASK = task_for(PLANTS["arx"], 50)
PARTS = {
    "bare": {},
    "limit": {"actuator": Actuator(limit=0.6)},
    "converters": {
        "actuator": Actuator(limit=0.6, resolution=0.013),
        "sensor": Sensor(resolution=0.007),
    },
    "disturbed": {
        "sensor": Sensor(noise=0.02),
        "disturbance": Disturbance(
            RNG.normal(size=(50, 1)), RNG.normal(size=(51, 1)), input_noise=0.1, output_noise=0.1
        ),
    },
}


def assert_same_learning(one, other):
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-11)


# The window acts in `measure`, which gets the record of a trial and knows none of the parts.
@pytest.mark.thorough(but=["bare-settle1", "limit-settle2"])
@pytest.mark.parametrize(
    ("part", "settle"), [("bare", None), *((part, (0.0, 0.02)) for part in PARTS)]
)
def test_learning_in_blocks_is_that_in_steps(no_steps, part, settle):
    # There is an error at k = 0, which counts only where the window contains it.
    task, scheme = Task(TASK.reference + 0.1, dt=DT, settle=settle), PIDType(0.8, gamma_d=2.0)
    plain, in_blocks = (
        learn(Machine(plant, **PARTS[part]), scheme, task, 5)
        for plant in (PLANTS["arx"], InBlocks(PLANTS["arx"], 8))
    )
    assert_same_learning(in_blocks, plain)
    assert plain.rms[-1, 0] != plain.rms[0, 0]


@pytest.mark.thorough
def test_an_adaptive_law_learns_the_same_in_blocks(no_steps):
    scheme = CFDLMFAILC(phi0=-0.065, lam=0.02, mu=0.05, rho=0.9, limit=0.9)
    coil = jax.jit(lambda plant: plant.sampled(DT))(VoiceCoil())
    plain, in_blocks = (
        learn(Machine(plant), scheme, TASK, 5) for plant in (coil, InBlocks(coil, 16))
    )
    assert_same_learning(in_blocks, plain)
    assert np.max(np.abs(plain.final.u)) == 0.9


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("scheme", "parts"),
    [
        (PID(kp=2.0), {}),
        (WithFeedback(PIDType(gamma_p=0.5), PID(kp=2.0)), {}),
        (PIDType(gamma_p=0.5), {"actuator": Actuator(rate=20.0)}),
    ],
    ids=["feedback", "learning over feedback", "rate limit"],
)
def test_what_blocks_cannot_do_is_done_in_steps(scheme, parts):
    plain, wrapped = (
        learn(Machine(p, **parts), scheme, TASK, 3)
        for p in (PLANTS["arx"], InBlocks(PLANTS["arx"]))
    )
    jax.tree.map(np.testing.assert_array_equal, wrapped, plain)


@pytest.mark.thorough
def test_digits_that_blocks_would_lose_are_kept(monkeypatch):
    """The poles are close together, and rounding accumulates over the long reference."""
    u = RNG.normal(size=(4000, 1))
    expected = scipy.signal.lfilter((0.0, *CLOSE.b), np.poly(POLES).real, np.append(u, 0.0))[
        :, None
    ]
    largest = np.max(np.abs(expected))
    np.testing.assert_allclose(response(CLOSE, u, 32), expected, rtol=0, atol=1e-9 * largest)
    monkeypatch.setattr(blocks, "LOST", dict.fromkeys(blocks.LOST, np.inf))
    assert np.max(np.abs(response(CLOSE, u, 32) - expected)) > 1e-9 * largest


def test_growth_is_kept_as_long_as_it_is_finite(no_steps):
    """A unit impulse grows to 1e21, y[k] = 1.05^(k-1), and the estimate accepts it."""
    u = np.eye(1000, 1)
    y = response(DifferenceEquation((1.05,), (1.0,), dt=DT), u, 32)[:, 0]
    np.testing.assert_allclose(y[1:], 1.05 ** np.arange(1000), rtol=1e-11)


@pytest.mark.thorough
def test_a_plant_that_overflows_diverges_where_its_steps_do():
    task = Task(np.ones(61), dt=DT)
    plain, wrapped = (
        learn(Machine(p), PIDType(gamma_p=1.0), task, 3, save=lambda trial: trial.y)
        for p in (OVERFLOWING, InBlocks(OVERFLOWING))
    )
    assert plain.diverged_at == wrapped.diverged_at == 2
    np.testing.assert_array_equal(np.isfinite(wrapped.saved[1]), np.isfinite(plain.saved[1]))
    assert 30 < np.sum(np.isfinite(plain.saved[1])) < 60


@pytest.mark.thorough
def test_single_precision_stays_single_and_close():
    with jax.enable_x64(False):
        plant = jax.tree.map(np.array, PLANTS["voice_coil_printed"])  # nobody else's arrays
        single = [
            learn(Machine(p), PIDType(gamma_p=-1.0), TASK, 3).final.y
            for p in (plant, InBlocks(plant, 8))
        ]
    assert single[1].dtype == jnp.float32
    np.testing.assert_allclose(*single, atol=1e-3 * np.max(np.abs(single[0])))


def test_parameters_in_single_precision_serve_in_double_precision():
    wide = StateSpace([[0.5]], [[0.25]], [[1.0]], dt=DT)
    narrow = jax.tree.map(np.float32, wide)
    for plant in (narrow, InBlocks(narrow, 8)):
        found, expected = (learn(Machine(p), PIDType(0.5), TASK, 2).rms for p in (plant, wide))
        np.testing.assert_allclose(found, expected, rtol=1e-12)
    found, expected = (learn(Machine(wide), GradientILC(of), TASK, 2).rms for of in (narrow, wide))
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    with pytest.raises(ValueError, match=r"NormOptimal: model.A, model.B, .* allowed is float64"):
        learn(Machine(wide), NormOptimal(narrow, w_r=1.0), TASK, 2)


def test_its_parameters_have_names():
    machine = replaced(Machine(InBlocks(VoiceCoil())), {"plant.plant.gain": 5.0})
    assert machine.plant.plant.gain == 5.0


@pytest.mark.parametrize("name", ["motor", "time_varying", "fast_tool_servo_nonlinear"])
def test_a_plant_that_is_not_linear_and_time_invariant_is_refused(name):
    plant = PLANTS[name]
    with pytest.raises(
        ValueError,
        match=rf"InBlocks: plant = {type(plant).__name__} is not linear and time-invariant; "
        "allowed are",
    ):
        learn(Machine(InBlocks(plant)), PIDType(), task_for(plant, 12), 1)
