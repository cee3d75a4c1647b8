"""These tests check the machine around a plant: actuator, sensors and disturbances."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import ALGEBRA, ARX, DT, PLANTS, SIGMAS

from jaxilc.filters import ZeroPhaseFIR
from jaxilc.learning import Actuator, Disturbance, Machine, Sensor, learn
from jaxilc.learning.machine import quantise
from jaxilc.plants import DifferenceEquation, StateSpace
from jaxilc.schemes import CFDLMFAILC, PID, Filtered, PIDType
from jaxilc.signals import Task

DELAY = DifferenceEquation((0.0,), (1.0,), dt=DT)  # y[k+1] = u[k]
ZERO = PID()
PLANT = PLANTS["arx"]


def y_and_u(trial):
    return trial.y, trial.u


def signals(machine, scheme, task, trials=1, **options):
    """Return the measured outputs (J, N+1) and the applied inputs (J, N)."""
    return tuple(
        np.asarray(s)[..., 0]
        for s in learn(machine, scheme, task, trials, save=y_and_u, **options).saved
    )


def clip(x, low, high):
    return min(max(x, low), high)


@pytest.mark.parametrize("part", ["limit", "rate", "resolution", "all"])
def test_machine_equals_a_loop_by_hand(part):
    """The loop has everything between scheme and plant: limit, rate limit, converter, disturbances
    at input and output, and encoder.
    """
    chosen = {"limit": 0.5, "rate": 250.0, "resolution": 0.07}
    chosen = chosen if part == "all" else {part: chosen[part]}
    rng, N = np.random.default_rng(5), 50
    d_u, d_y = 0.2 * rng.normal(size=N), 0.05 * rng.normal(size=N + 1)
    r, step, kp = np.sin(0.3 * np.arange(N + 1)), 0.02, 0.9
    machine = Machine(
        PLANT,
        Actuator(**chosen),
        Sensor(resolution=step),
        Disturbance(input=d_u[:, None], output=d_y[:, None]),
    )
    of_package = signals(machine, PID(kp=kp), Task(r, dt=DT))

    (a1, a2), (b1, b2) = ARX
    (true, y), (u, v), reached = np.zeros((2, N + 1)), np.zeros((2, N)), dict.fromkeys(chosen, 0)
    for k in range(N + 1):
        y[k] = step * np.round((true[k] + d_y[k]) / step)
        if k == N:
            break
        v[k] = wanted = kp * (r[k] - y[k])
        limit = chosen.get("limit", np.inf)
        if "rate" in chosen:  # it limits how fast the value before the converter changes
            last = v[k - 1] if k else 0.0
            v[k] = clip(v[k], last - chosen["rate"] * DT, last + chosen["rate"] * DT)
            reached["rate"] += v[k] != wanted
        if "limit" in chosen:
            reached["limit"] += abs(v[k]) > limit
            v[k] = clip(v[k], -limit, limit)
        u[k] = v[k]
        if "resolution" in chosen:
            reached["resolution"] += 1
            u[k] = clip(chosen["resolution"] * np.round(v[k] / chosen["resolution"]), -limit, limit)
        past = a2 * true[k - 1] + b2 * (u[k - 1] + d_u[k - 1]) if k else 0.0
        true[k + 1] = a1 * true[k] + b1 * (u[k] + d_u[k]) + past
    np.testing.assert_allclose(of_package[0][0], y, **ALGEBRA)
    np.testing.assert_allclose(of_package[1][0], u, **ALGEBRA)
    assert all(3 < count <= N for count in reached.values()), reached


@pytest.mark.thorough
def test_learning_sees_the_input_as_applied():
    """The law starts from the saturated input, so it does not wind up: u_{j+1} = clip(u_j) + gamma
    e_j.
    """
    r = np.array([0.0, 1.0, 1.0, 0.1, -1.0])
    y, u = signals(Machine(DELAY, Actuator(limit=0.4)), PIDType(gamma_p=0.5), Task(r, dt=DT), 8)
    np.testing.assert_allclose(u[-1], [0.4, 0.4, 0.1 * (1 - 0.5**7), -0.4], rtol=1e-12)
    np.testing.assert_allclose(y[-1, 1:], u[-1], rtol=1e-12)


def noisy(sensor=0.0, output=0.0, input=0.0):
    """Return a delay with noise; one program serves all that have some of it."""
    disturbance = Disturbance(output_noise=output, input_noise=input)
    return Machine(DELAY, None, Sensor(noise=sensor), disturbance)


@pytest.mark.thorough
@pytest.mark.parametrize("source", ["sensor", "output", "input"])
def test_noise_is_white_of_the_given_deviation_and_new_in_each_trial(source):
    """With u = 0 and y[k+1] = u[k] + d_u[k] the output is the noise.

    The standard errors are s/sqrt(n), s^2 sqrt(2/n), and 1/sqrt(n) for a correlation.
    """
    sigma, N = 0.3, 3000
    y, u = signals(
        noisy(**{source: sigma}), ZERO, Task(np.zeros(N + 1), dt=DT), 2, key=jax.random.key(11)
    )
    assert np.all(u == 0)
    assert (y[0, 0] == 0) == (source == "input"), (
        "the first sample is measured too, before any input"
    )
    first, second = y[:, 1:]
    for noise in (first, second):
        assert abs(np.mean(noise)) < SIGMAS * sigma / np.sqrt(N)
        assert abs(np.var(noise) - sigma**2) < SIGMAS * sigma**2 * np.sqrt(2 / N)
        assert abs(np.mean(noise[1:] * noise[:-1])) < SIGMAS * sigma**2 / np.sqrt(N)
        assert 0.6 < np.mean(np.abs(noise) < sigma) < 0.76, "Gaussian: 68 % within one deviation"
    assert abs(np.mean(first * second)) < SIGMAS * sigma**2 / np.sqrt(N)


def test_noise_sources_are_independent_and_add_up():
    N, deviations = 3000, (0.1, 0.2, 0.3)
    y, _ = signals(noisy(*deviations), ZERO, Task(np.zeros(N + 1), dt=DT), 2)
    variance = sum(s**2 for s in deviations)
    assert abs(np.var(y[0, 1:]) - variance) < SIGMAS * variance * np.sqrt(2 / N)


@pytest.mark.thorough
def test_repetitive_part_repeats_and_the_rest_follows_the_key():
    N = 20
    task, wave = Task(np.zeros(N + 1), dt=DT), np.sin(np.arange(N + 1.0))[:, None]
    repetitive = {"input": wave[:-1], "output": 0.5 * wave}
    y, _ = signals(Machine(DELAY, disturbance=Disturbance(**repetitive)), ZERO, task, 3)
    expected = 0.5 * wave[:, 0] + np.concatenate([[0.0], wave[:-1, 0]])
    np.testing.assert_allclose(y, np.tile(expected, (3, 1)), **ALGEBRA)

    both = Machine(DELAY, None, Sensor(noise=0.1), Disturbance(**repetitive, output_noise=0.2))
    y, _ = signals(both, ZERO, task, 3, key=jax.random.key(1))
    assert np.all(np.abs(y[1:] - y[:-1]).max(axis=1) > 0.1)
    assert abs(np.mean(y - expected)) < SIGMAS * np.hypot(0.1, 0.2) / np.sqrt(y.size)
    np.testing.assert_array_equal(y, signals(both, ZERO, task, 3, key=jax.random.key(1))[0])
    assert np.all(y != signals(both, ZERO, task, 3, key=jax.random.key(2))[0])
    unkeyed = signals(both, ZERO, task, 3)[0]
    np.testing.assert_array_equal(unkeyed, signals(both, ZERO, task, 3)[0])


@pytest.mark.thorough
def test_noise_of_each_channel_is_its_own():
    N, deviations = 3000, np.array([0.1, 0.4])
    plant = StateSpace(np.zeros((2, 2)), np.eye(2), np.eye(2), dt=DT)
    y = learn(
        Machine(plant, sensor=Sensor(noise=deviations)), ZERO, Task(np.zeros((N + 1, 2)), dt=DT), 1
    ).final.y
    assert np.all(
        np.abs(np.var(y, axis=0) - deviations**2) < SIGMAS * deviations**2 * np.sqrt(2 / N)
    )
    assert abs(np.mean(y[:, 0] * y[:, 1])) < SIGMAS * np.prod(deviations) / np.sqrt(N)


def test_gradients_of_the_discontinuous_parts():
    """Quantisers pass the gradient unchanged.

    Limits and rate limits pass it inside their range and block it outside.
    """
    of_each = jax.jit(jax.vmap(jax.value_and_grad(lambda x: quantise(x, 0.1))))
    values, slopes = of_each(np.array([-0.31, 0.0, 0.04, 7.26]))
    np.testing.assert_allclose(values, [-0.3, 0.0, 0.0, 7.3], atol=1e-12)
    np.testing.assert_array_equal(slopes, 1.0)

    @jax.jit
    @partial(jax.vmap, in_axes=(None, 0))
    def through(actuator, u):
        return jax.grad(lambda u: actuator.apply(u[None], jnp.array([0.2]), DT)[1][0])(u)

    of_limit = through(Actuator(limit=1.0), np.array([-1.5, 0.5, 1.5]))
    assert of_limit.tolist() == [0.0, 1.0, 0.0]
    assert through(Actuator(rate=100.0), np.array([0.05, 0.25, 0.35])).tolist() == [0.0, 1.0, 0.0]
    of_both = through(Actuator(limit=1.0, resolution=0.3), np.array([0.5, 1.5]))
    assert of_both.tolist() == [1.0, 0.0]
    assert jax.jit(jax.grad(lambda y: Sensor(resolution=0.3).measure(y, None)))(0.4) == 1.0


@pytest.mark.thorough
def test_gradient_through_learning_on_quantised_signals_is_straight_through():
    """For y[k+1] = Q(u[k]) the derivative of the law is that of the smooth loop, evaluated at the
    quantised values.
    """
    r, step = np.array([0.0, 0.73, -0.41, 0.22]), 0.05
    task = Task(r, dt=DT)

    def loss(gamma):
        machine = Machine(DELAY, sensor=Sensor(resolution=step))
        return jnp.sum(learn(machine, PIDType(gamma_p=gamma), task, 3).final.y)

    e1 = r[1:]
    y2 = step * np.round(0.3 * e1 / step)
    # u_3 = gamma e_1 + gamma (r - y_2) and y_2' = e_1, so the derivative is e_1 + (r - y_2) - gamma
    # e_1.
    assert jax.grad(loss)(0.3) == pytest.approx(np.sum(e1 + (r[1:] - y2) - 0.3 * e1), rel=1e-12)


TASK = Task(np.zeros(21), dt=DT)
TABLE, TWO = PLANTS["motor_and_table"], (0.1, 0.2)
MISFITS = [
    (Machine(PLANTS["mimo"]), ZERO, "the task has 1 inputs but the plant StateSpace has 2"),
    (Machine(TABLE), ZERO, "the task has 1 outputs but the plant StateSpace has 2"),
    (
        Machine(PLANT, disturbance=Disturbance(input=np.zeros((19, 1)))),
        ZERO,
        r"input has shape \(19, 1\).*needs \(20, 1\)",
    ),
    (
        Machine(PLANT, disturbance=Disturbance(output=np.zeros((20, 1)))),
        ZERO,
        r"output has shape \(20, 1\).*needs \(21, 1\)",
    ),
    (Machine(PLANT), PIDType(lead=20), r"PIDType: lead = 20 is .* range \[0, 19\] for N = 20"),
    (Machine(PLANT), CFDLMFAILC(lead=20), r"CFDLMFAILC: lead = 20 is .* range \[0, 19\]"),
    (
        Machine(PLANT),
        Filtered(PIDType(), ZeroPhaseFIR(np.ones(21) / 21)),
        r"ZeroPhaseFIR: taps has shape \(21,\).*N = 20",
    ),
    (Machine(PLANT), Filtered(ZERO, ZeroPhaseFIR()), "Filtered: PID learns no feedforward"),
    (Machine(PLANT, sensor=Sensor(noise=TWO)), ZERO, "Sensor: noise has shape"),
    (Machine(PLANT, Actuator(limit=TWO)), ZERO, r"limit has shape \(2,\); allowed are \(\) and"),
]


@pytest.mark.parametrize(("machine", "scheme", "message"), MISFITS)
def test_what_does_not_fit_is_named(machine, scheme, message):
    with pytest.raises(ValueError, match=message):
        learn(machine, scheme, TASK, 1)


def test_a_feedback_of_other_outputs_than_inputs_is_named():
    task = Task(np.zeros((21, 2)), dt=DT, inputs=1)
    with pytest.raises(ValueError, match=r"PID .*1 and 2; .*OnOutputs"):
        learn(Machine(TABLE), ZERO, task, 1)
