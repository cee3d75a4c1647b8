"""Claims on machines that round, against trials that a loop in NumPy runs."""

import dataclasses
from importlib import resources

import jax
import numpy as np
import pytest
from dense import lifted

from jaxilc.learning import Actuator, Machine, Sensor
from jaxilc.learning.variation import Variation
from jaxilc.plants import BoucWen, Dahl, InputHysteresis, StateSpace
from jaxilc.scenarios.from_file import read_scenario
from jaxilc.schemes import HigherOrder, PIDType
from jaxilc.signals import Task
from jaxilc.theory import certificates, rounding
from jaxilc.theory.certificates import certify, certify_each, long_run
from jaxilc.theory.q_filter import need_linear, rounding_of
from jaxilc.uncertainty import drawn_machines

N, DT, TRIALS, FINE, FAR = 24, 1e-3, 300, 1e-13, 1e6


def lag(a):
    return StateSpace([[a]], [[1 - a]], [[1.0]], dt=DT)


def machines(*several):
    """With a leading axis, of (a, step of the sensor, step of the converter, limit).

    The last one fills up to twelve, so that the tests share their programs.
    """
    made = [
        Machine(lag(a), Actuator(limit=limit, resolution=of_u), Sensor(resolution=of_y))
        for a, of_y, of_u, limit in (*several, *several[-1:] * (12 - len(several)))
    ]
    return jax.tree.map(lambda *leaves: np.stack(leaves), *made)


def learned(r, a, of_y, of_u, gain, leak, limit=np.inf):
    """(TRIALS, N) errors and inputs learned, of a machine that rounds if it has steps."""

    def rounded(x, step):
        return np.round(x / step) * step if step else x

    G = lifted(lag(a), N)
    w, errors, inputs = np.zeros(N), [], []
    for _ in range(TRIALS):
        u = np.clip(rounded(np.clip(w, -limit, limit), of_u), -limit, limit)
        e = r[1:] - rounded(G @ u, of_y)
        errors.append(e)
        inputs.append(w)
        w = (1 - leak) * u + gain * e
    return np.array(errors), np.array(inputs)


def task(r):
    return Task(r, dt=DT)


def rms(e):
    return np.sqrt(np.mean(e**2, axis=-1))


def test_the_ball_holds_what_a_loop_in_numpy_does():
    """The error and what is learned stay within the ball, and fall until they are in it."""
    r = np.sin(np.pi * np.arange(N + 1) / N) ** 2
    rng, some = np.random.default_rng(3), []
    for _ in range(12):
        steps = 10 ** rng.uniform(-5, -1, 2)
        some.append((rng.uniform(0.1, 0.6), *steps, FAR))
    law = PIDType(gamma_p=0.6, leak=0.1)
    found = certify_each(machines(*some), law, task(r), TRIALS)
    assert set(found.claim) == {"monotone"}
    assert not len(found.broken_promises())
    until, slack = found.ball.until(found.of_error, found.sigma), []
    for i, (a, of_y, of_u, _) in enumerate(some):
        (e, w), (e_still, w_still) = (
            learned(r, a, *steps, 0.6, 0.1) for steps in ((of_y, of_u), (0.0, 0.0))
        )
        assert np.max(rms(e - e_still)) <= found.ball.error[i]
        assert np.max(np.linalg.norm(w - w_still, axis=1)) <= found.ball.learned[i]
        assert rms(e[-1]) <= found.floor[i] + found.doubt[i] + found.ball.error[i]
        far = np.linalg.norm(w - w_still[-1], axis=1)
        assert np.all(far[1:] <= np.maximum(far[:-1] * (1 + 1e-9), until[i]))
        slack.append(found.ball.error[i] / np.max(rms(e - e_still)))
    assert np.median(slack) < 10


def test_a_ball_that_is_reached_and_the_limits_in_it():
    """Half a step is reached in every trial, and what is learned comes to the edge of its ball.

    The output stays just below half a step of the encoder, which shows 0 throughout. A limit
    between what a machine learns that does not round, and what this one learns, is met.
    """
    half, gain, leak = 0.5, 0.5, 0.3
    r = np.full(N + 1, leak * half * (1 - 1e-6) / gain)
    still = gain * r[0] / (gain + leak)
    far, ball = half - still, 1.1 * gain * half / (gain + leak)
    limits = (FAR, still + 0.9 * far, still + 2 * ball)
    some = [(0.0, 2 * half, FINE, limit) for limit in limits]
    found = long_run(machines(*some), PIDType(gamma_p=gain, leak=leak), task(r))
    assert found.claim[:3].tolist() == ["monotone", "not claimed", "monotone"]
    assert "cannot be excluded" in found.reason[1]
    _, w = learned(r, 0.0, 2 * half, FINE, gain, leak)
    assert limits[1] < np.max(w) < limits[2]
    reached = np.linalg.norm(w[-1] - still)
    assert 0.9 * found.ball.learned[0] < reached <= found.ball.learned[0]
    # as a limit sees it, in each sample; the converter adds next to nothing
    assert np.max(found.ball.limits[0]) * FAR >= far


def test_what_is_not_claimed_of_a_machine_that_rounds():
    """Growth that may hide below a step, and samples lost by chance."""
    r = np.sin(np.pi * np.arange(N + 1) / N) ** 2
    rounds = drawn_machines(Machine(lag(0.0), sensor=Sensor(resolution=0.1)), {}, {})
    lost = dataclasses.replace(rounds, variation=Variation(dropped=np.full(1, 0.2)))
    for of, gain, said in ((rounds, 2.5, "rounding may hide"), (lost, 0.5, "learned from alike")):
        found = long_run(of, PIDType(gamma_p=gain), task(r))
        assert found.claim[0] == "not claimed"
        assert said in found.reason[0]


@pytest.mark.thorough
def test_what_is_claimed_of_a_law_that_remembers_errors_does_not_depend_on_their_unit():
    """The errors that it remembers are in the unit of y, beside inputs in that of u."""
    r, told = np.sin(np.linspace(0.0, 5.0, N + 1)), []
    A, B, C = [[0.7, 0.2], [0.0, 0.5]], [[0.3], [0.5]], np.array([[1.0, 0.2]])
    for unit in (1.0, 10.0, 1e-3):  # of y
        plant, sensor = StateSpace(A, B, C * unit, dt=1e-3), Sensor(resolution=0.003 * unit)
        machines = drawn_machines(Machine(plant, sensor=sensor), {}, {})
        law = HigherOrder((0.7, 0.2, 0.1), np.array([0.42, 0.0, 0.18]) / unit)
        found = long_run(machines, law, Task(r * unit, dt=1e-3))
        ball = f"{found.ball.error[0] / unit:.6g}"
        told.append((found.claim[0], found.reason[0], ball))
    assert {*told} == {told[0]}
    assert told[0][0] == "converges"


def test_hysteresis_at_the_input_holds_learning_within_a_ball():
    """Dahl's law and Bouc-Wen's, sample by sample from their equations in NumPy."""
    r, gain, leak, a = np.sin(np.pi * np.arange(N + 1) / N) ** 2, 0.6, 0.1, 0.3

    def dahl(z, dx):  # dz = slope (1 - s z / most) dx, slope = 0.5 and most = 0.1
        end = np.copysign(0.1, dx)
        return end + (z - end) * np.exp(-5.0 * abs(dx))

    def bouc_wen(z, dx, steps=100):  # dz = 0.5 dx - 4 |dx| z - dx |z|, |z| <= 0.1
        for _ in range(steps):
            z = z + (0.5 * dx - 4.0 * abs(dx) * z - dx * abs(z)) / steps
        return z

    for law, over in ((Dahl(0.5, 0.1), dahl), (BoucWen(0.5, 4.0, 1.0), bouc_wen)):
        plant = InputHysteresis(lag(a), law)
        learning = PIDType(gamma_p=gain, leak=leak)
        found = certify(Machine(plant), learning, task(r), 60, {}, {})
        assert found.claim[0] == "monotone"
        assert "within which hysteresis holds it" in found.reason[0]
        assert not len(found.broken_promises())
        G = lifted(lag(a), N)
        w, still, apart = np.zeros(N), np.zeros(N), []
        for trial in range(60):
            z, u, drive = 0.0, 0.0, []
            for x in w:
                z, u = over(z, x - u), x
                drive.append(u - z)
            e, e_still = r[1:] - G @ np.array(drive), r[1:] - G @ still
            np.testing.assert_allclose(rms(e), found.simulated[0, trial], rtol=1e-2)
            apart.append(rms(e - e_still))
            w, still = (1 - leak) * w + gain * e, (1 - leak) * still + gain * e_still
        assert np.max(apart) <= found.ball.error[0] < 10 * np.max(apart)


def test_of_hysteresis_that_begins_beyond_its_limit_nothing_is_claimed():
    """A ball of 0.0045 was claimed, where an offset of its state moves the error by 0.22."""
    plant = InputHysteresis(lag(0.5), Dahl(1e-4, 1e-3))
    for given in ({"offset": 1.0}, {"scatter": 0.3}, {"offset": np.array([0.1, 0.0, 0.0])}):
        machine = Machine(plant, variation=Variation(**given))
        law = PIDType(gamma_p=0.5, leak=0.3)
        found = long_run(drawn_machines(machine, {}, {}), law, task(np.zeros(9)))
        assert found.claim[0] == "not claimed"
        assert "InputHysteresis bounds what it takes" in found.reason[0]
        assert f"variation.{next(iter(given))} moves its state" in found.reason[0]


def test_hysteresis_that_is_integrated_in_steps_is_named():
    plant = InputHysteresis(lag(0.5), BoucWen(0.5, 4.0, 1.0, 2))
    machines = drawn_machines(Machine(plant), {}, {})
    found = long_run(machines, PIDType(gamma_p=0.5), task(np.ones(N + 1)))
    assert found.claim[0] == "not claimed"
    assert "InputHysteresis" in found.reason[0]


def test_noise_that_is_rounded_adds_up_with_the_ball():
    fine = Machine(lag(0.3), sensor=Sensor(noise=0.05))
    rounds = dataclasses.replace(fine, sensor=Sensor(noise=0.05, resolution=0.02))
    law, r = PIDType(gamma_p=0.6, leak=0.1), np.sin(np.pi * np.arange(N + 1) / N)
    one = long_run(drawn_machines(fine, {}, {}), law, task(r))
    other = certify(rounds, law, task(r), 30, {}, {})
    ball = other.ball.error[0]
    np.testing.assert_allclose(other.left[0], one.left[0] + ball, rtol=1e-9)
    np.testing.assert_allclose(other.most[0], one.most[0] + ball, rtol=1e-9)
    assert np.mean(other.runs[0, :, -1] > other.most[0]) < 0.05
    assert other.reason[0].endswith("by Chernoff's bound")


def test_the_file_of_init_with_an_encoder(tmp_path):
    """The line that `jaxilc init` offers, a step of the encoder, silences neither command."""
    text = (resources.files("jaxilc.scenarios") / "axis.toml").read_text()
    text = text.replace("#[machine.sensor]", "[machine.sensor]")
    text = text.replace("#resolution = 1e-6", "resolution = 0.0005")
    text = text.replace("duration = 1.0", "duration = 0.06").replace(
        "frequency = 2.0", "frequency = 15.0"
    )
    path = tmp_path / "axis.toml"
    path.write_text(text)
    chosen = read_scenario(path)
    assert float(chosen.machine.sensor.resolution) == 0.0005
    scheme = chosen.schemes["ilc"]
    found = long_run(drawn_machines(chosen.machine, {}, {}), scheme, chosen.task)
    assert found.claim[0] == "monotone"
    assert 0.00025 < found.ball.error[0] < 0.05
    need_linear(chosen.machine, scheme, chosen.task)
    left = rounding_of(chosen.machine, scheme, chosen.task, 0.5)
    assert left == pytest.approx(found.ball.error[0], rel=1e-6)


def test_of_more_inputs_than_are_followed_nothing_is_computed(monkeypatch):
    """A minute went by before it was said that nothing is claimed."""
    monkeypatch.setattr(rounding, "LARGEST", N - 1)
    monkeypatch.setattr(certificates, "LARGEST", N - 1)
    monkeypatch.setattr(certificates, "outlook_of", None)
    found = long_run(
        machines((0.5, 1e-3, 1e-3, 1e6)), PIDType(gamma_p=0.5), task(np.arange(N + 1.0))
    )
    assert found.claim[0] == "not claimed"
    assert found.reason[0].startswith("what rounding adds is followed for up to")
