"""The closed loop as a system of python-control equals the simulator, with random machines."""

import control
import jax
import numpy as np
import pytest
from cases import ARX, DT, PLANTS, SCHEMES

from jaxilc.learning import Actuator, Machine, Sensor, learn
from jaxilc.plants import DifferenceEquation, StateSpace, VoiceCoilMotor, from_control
from jaxilc.schemes import CFDLMFAC, PID, OnOutputs, OnReference, PIDType, WithFeedback
from jaxilc.signals import Task
from jaxilc.theory import to_control
from jaxilc.theory.to_python_control import initial_state
from jaxilc.theory.trials import played

N = 30


def random_machine(rng) -> Machine:
    n = int(rng.integers(1, 4))
    A = rng.normal(size=(n, n))
    A *= rng.uniform(0.3, 0.95) / np.max(np.abs(np.linalg.eigvals(A)))
    return Machine(StateSpace(A, rng.normal(size=(n, 1)), rng.normal(size=(1, n)), dt=DT))


def random_pid(rng) -> PID:
    return PID(
        kp=rng.uniform(-0.2, 0.2),
        ki=rng.uniform(-5.0, 5.0),
        kd=rng.uniform(-1e-4, 1e-4),
        tau=rng.choice([0.0, 2e-3]),
        form=str(rng.choice(["position", "increment"])),
        kv=rng.choice([None, 1e-3]),
        ka=rng.choice([None, 1e-6]),
    )


def by_control(loop, *learned):
    """Return the outputs (N+1, n_y) of the loop (machine, scheme, task) by python-control.

    learned: (N, m) inputs, of each of which there is one output
    """
    system, x0, found = to_control(*loop), initial_state(*loop), []
    r = np.asarray(loop[2].reference)
    named = system.input_labels[-1]
    L = int(named.removeprefix("reference_ahead_").partition("[")[0]) if "ahead" in named else 0
    rows, time = np.minimum(np.arange(len(r)) + L, len(r) - 1), np.arange(len(r)) * DT
    for w in learned:
        inputs = np.hstack([np.vstack([w, w[-1:]]), r[rows]])
        y = control.forced_response(system, time, inputs.T, X0=x0, squeeze=False).outputs
        found.append(np.asarray(y).T)
    return found


@pytest.mark.thorough(but=["2"])
@pytest.mark.parametrize("seed", [0, 2])
def test_a_random_loop_responds_as_in_the_simulator(seed):
    rng = np.random.default_rng(seed)
    machine, feedback = random_machine(rng), random_pid(rng)
    on_reference = seed == 2 and feedback.preview == 1
    scheme = OnReference(PIDType(gamma_p=0.3), feedback) if on_reference else feedback
    task, w = Task(rng.normal(size=(N + 1, 1)), dt=DT), rng.normal(size=(N, 1))
    y = np.asarray(jax.jit(played)(machine, scheme, task, scheme.initial_memory(task), w).y)
    found, of_reference = by_control((machine, scheme, task), w, 0 * w)
    np.testing.assert_allclose(found, y, rtol=1e-8, atol=1e-10 * np.max(np.abs(y)))
    assert np.max(np.abs(of_reference)) > 1e-6, "the reference has an effect"


@pytest.mark.thorough
def test_it_follows_a_learning_process():
    """It gives the last trial of five, from what was learned before it."""
    machine = Machine(PLANTS["motor_and_table"])
    task = Task(np.random.default_rng(3).normal(size=(N + 1, 2)), dt=DT, inputs=1)
    scheme = WithFeedback(
        OnOutputs(PIDType(gamma_p=0.3, lead=1), (1,)), OnOutputs(PID(kp=0.5, kd=1e-4), (0,))
    )
    history = learn(machine, scheme, task, 5)
    trial = history.final
    w = np.asarray(trial.u - trial.signals["feedback"])
    system = to_control(machine, scheme, task)
    assert system.input_labels == ["learned[0]", "reference[0]", "reference[1]"]
    assert system.output_labels == ["y[0]", "y[1]"]
    (found,) = by_control((machine, scheme, task), w)
    np.testing.assert_allclose(found, trial.y, rtol=1e-9, atol=1e-11)
    assert np.max(np.abs(w)) > 0.1


@pytest.mark.thorough(but=["weights1-1"])
@pytest.mark.parametrize(("weights", "ahead"), [({}, 0), ({"kv": 1e-3}, 1), ({"ka": 1e-6}, 2)])
def test_the_name_of_the_reference_says_how_far_the_feedback_looks_ahead(weights, ahead):
    machine, task = Machine(DifferenceEquation(*ARX, dt=DT)), Task(np.zeros(N + 1), dt=DT)
    system = to_control(machine, PID(kp=0.3, **weights), task)
    assert system.input_labels[1] == (f"reference_ahead_{ahead}[0]" if ahead else "reference[0]")


def test_the_loop_of_a_proportional_gain_is_that_of_python_control():
    P = control.tf([0.06, 0.03], [1.0, -1.6, 0.65], DT)
    machine, task = Machine(from_control(P)), Task(np.zeros(N + 1), dt=DT)
    system = to_control(machine, WithFeedback(PIDType(gamma_p=0.3), PID(kp=0.4)), task)
    omega = 2 * np.pi * np.array([1.0, 30.0, 200.0])
    for column, expected in enumerate((P / (1 + 0.4 * P), 0.4 * P / (1 + 0.4 * P))):
        np.testing.assert_allclose(
            system[0, column](np.exp(1j * omega * DT)), expected(np.exp(1j * omega * DT)), rtol=1e-9
        )


@pytest.mark.thorough
def test_a_closed_loop_comes_back_as_a_plant():
    w, r = np.random.default_rng(5).normal(size=(2, N + 1, 1))
    loop = Machine(DifferenceEquation(*ARX, dt=DT)), PID(kp=0.4, ki=4.0), Task(r, dt=DT)
    plant = from_control(to_control(*loop))
    assert (plant.n_u, plant.n_y) == (2, 1)
    x, y = plant.initial_state(), []
    for u in np.hstack([w, r]):
        y.append(plant.output(x))
        x = plant.step(x, u, DT)
    np.testing.assert_allclose(y, *by_control(loop, w[:-1]), rtol=1e-9, atol=1e-12)


def test_limits_are_left_out_and_other_nonlinear_parts_are_refused():
    task = Task(np.zeros(N + 1), dt=DT)
    plant = DifferenceEquation(*ARX, dt=DT)
    free = to_control(Machine(plant), PID(kp=0.4), task)
    limited = to_control(Machine(plant, Actuator(limit=2.0)), PID(kp=0.4, limit=1.0), task)
    np.testing.assert_array_equal(free.A, limited.A)
    with pytest.raises(ValueError, match=r"the loop is not linear: the machine .* by rounding"):
        to_control(Machine(plant, None, Sensor(resolution=0.1)), PID(kp=0.4), task)
    with pytest.raises(ValueError, match=r"the machine \(VoiceCoilMotor\) .* a limit"):
        to_control(Machine(VoiceCoilMotor()), PID(kp=0.4), task)
    with pytest.raises(ValueError, match="not linear: CFDLMFAC acts within the trial by"):
        to_control(Machine(plant), CFDLMFAC(lam=0.3, phi0=0.1), task)
    with pytest.raises(ValueError, match="WithFeedback acts within the trial by"):
        to_control(Machine(plant), SCHEMES["ilc_mfapc"], task)
