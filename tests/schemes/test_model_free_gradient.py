"""Gradient learning by time-reversed experiments, against the transpose of the lifted matrix."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import ALGEBRA, DT, SIGMAS
from dense import lifted
from refusals import refused

from jaxilc.filters import ZeroPhaseFIR
from jaxilc.hardware import Campaign, Measured
from jaxilc.learning import Machine, learn, run_trial
from jaxilc.outcomes.exporting import _seen
from jaxilc.plants import StateSpace
from jaxilc.schemes import (
    PID,
    Filtered,
    GradientILC,
    Ladder,
    ModelFreeGradient,
    PIDType,
    StopWhen,
    WithFeedback,
)
from jaxilc.signals import Task
from jaxilc.theory.certificates import predict

N, GAIN = 10, 0.7
TASK = Task(0.5 - 0.5 * np.cos(2 * np.pi * np.arange(N + 1) / N), dt=DT)
A, B, C = np.array([[0.9, 0.1], [-0.2, 0.8]]), np.array([[0.1], [0.4]]), np.array([[1.0, 0.5]])
MACHINE = Machine(StateSpace(A, B, C, x0=(0.02, -0.1), dt=DT))
RANDOM = np.random.default_rng(5)
WIDE = StateSpace(
    RANDOM.uniform(-0.4, 0.4, (3, 3)),
    RANDOM.standard_normal((3, 2)),
    RANDOM.standard_normal((3, 3)),
    dt=DT,
)
MIMO = Task(RANDOM.standard_normal((N + 1, 3)), dt=DT, inputs=2)
Q = np.diag([1.0, 2.0, 0.5]) + 0.1

one_trial = jax.jit(run_trial)


@jax.jit
def learned(scheme, memory, trial):
    return scheme.learn(memory, trial)


@pytest.mark.thorough(but=["feedback1-mean"])
@pytest.mark.parametrize("about", ["trial", "mean"])
@pytest.mark.parametrize("feedback", [None, PID(kp=GAIN)])
def test_it_is_gradient_learning_by_the_exact_model(about, feedback):
    """Under the feedback the model is the closed loop, x' = (A - B k C) x + B u."""
    closed = StateSpace(A - (feedback is not None) * GAIN * B @ C, B, C, dt=DT)
    free, by_model = ModelFreeGradient(0.8, 0.3, about=about), GradientILC(closed, step=0.8)
    if feedback is not None:
        free, by_model = (WithFeedback(one, feedback) for one in (free, by_model))
    found = learn(MACHINE, free, TASK, 2 * free.trials_a_step + 1)
    expected = learn(MACHINE, by_model, TASK, 3)
    assert free.trials_a_step == {"trial": 2, "mean": 3}[about]
    np.testing.assert_allclose(
        found.rms[:: free.trials_a_step], expected.rms, rtol=1e-10, atol=1e-12
    )
    np.testing.assert_allclose(found.final.u, expected.final.u, rtol=1e-10, atol=1e-12)


@pytest.mark.thorough
@pytest.mark.parametrize("about", ["trial", "mean"])
def test_with_an_experiment_for_each_pair_it_is_exact_for_many_channels(about):
    scheme = ModelFreeGradient(0.02, 5.0, Q, about=about, inputs=2, outputs=3)
    assert scheme.trials_a_step == {"trial": 7, "mean": 8}[about]
    found = learn(Machine(WIDE), scheme, MIMO, 2 * scheme.trials_a_step).memory
    G, u, r = lifted(WIDE, N), np.zeros(2 * N), np.asarray(MIMO.reference)[1:].ravel()
    for _ in range(2):
        u = u + 0.02 * G.T @ np.kron(np.eye(N), Q) @ (r - G @ u)
    np.testing.assert_allclose(found.u.ravel(), u, **ALGEBRA)
    assert found.steps == 2
    assert found.experiment == 0


def test_random_signs_give_the_gradient_in_the_mean():
    """The steps that are complete choose the signs, so many first steps are run, each with some."""
    draws = 400
    scheme = ModelFreeGradient(1.0, 2.0, method="stochastic", inputs=2, outputs=3, seed=3)
    assert scheme.trials_a_step == 2

    def one(steps):
        start = scheme.initial_memory(MIMO)._replace(steps=steps)
        return learn(Machine(WIDE), scheme, MIMO, 2, memory=start).memory.u.ravel()

    found = np.asarray(jax.jit(jax.vmap(one))(jnp.arange(float(draws))))
    expected = lifted(WIDE, N).T @ np.asarray(MIMO.reference)[1:].ravel()
    error = np.std(found, axis=0) / np.sqrt(draws)
    assert np.all(np.abs(np.mean(found, axis=0) - expected) < SIGMAS * error)
    assert np.max(error) < 0.2 * np.max(np.abs(expected)), "the mean should be known well"


@pytest.mark.thorough
def test_what_each_experiment_plays():
    scheme = ModelFreeGradient(0.5, 0.3, about="mean", limit=0.2, filter=ZeroPhaseFIR((0.6, 0.2)))
    memory, key = scheme.initial_memory(TASK), jax.random.key(0)
    memory = memory._replace(u=0.1 * jnp.sin(jnp.arange(1.0, N + 1))[:, None])
    first = one_trial(MACHINE, scheme, TASK, memory, key)
    memory = learned(scheme, memory, first)
    mean, e = np.mean(first.u), np.asarray(first.e)[1:, 0]
    assert np.max(np.abs(mean + 0.3 * e)) > 0.2, "the limit should matter"
    np.testing.assert_allclose(memory.u[:, 0], np.clip(mean + 0.3 * e[::-1], -0.2, 0.2), **ALGEBRA)
    second = one_trial(MACHINE, scheme, TASK, memory, key)
    memory = learned(scheme, memory, second)
    np.testing.assert_allclose(memory.u[:, 0], np.full(N, mean), **ALGEBRA)
    third = one_trial(MACHINE, scheme, TASK, memory, key)
    slope = (np.asarray(second.y) - np.asarray(third.y))[:0:-1, 0] / 0.3
    new = scheme.filter(np.asarray(first.u) + 0.5 * slope[:, None], DT)
    np.testing.assert_allclose(learned(scheme, memory, third).u, np.clip(new, -0.2, 0.2), **ALGEBRA)


@pytest.mark.thorough
def test_repeated_experiments_are_averaged():
    scheme = ModelFreeGradient(0.8)
    ladder = Ladder(scheme, repeats=2)
    found, expected = learn(MACHINE, ladder, TASK, 9), learn(MACHINE, scheme, TASK, 5)
    np.testing.assert_allclose(found.rms[::2], expected.rms, **ALGEBRA)


P_TYPE = PIDType(gamma_p=0.1)


@pytest.mark.thorough(but=["beside a law", "of two laws"])
@pytest.mark.parametrize(
    "scheme",
    [
        ModelFreeGradient(0.8, about="mean"),
        WithFeedback(P_TYPE, ModelFreeGradient(0.3)),
        WithFeedback(P_TYPE, Ladder(P_TYPE, 3)),
    ],
    ids=["alone", "beside a law", "of two laws"],
)
def test_the_forecast_is_of_each_trial_of_a_step(scheme):
    """A step is over when both parts have learned a whole number of times."""
    machines = jax.tree.map(lambda x: jnp.stack([x, x]), MACHINE)
    simulated = learn(MACHINE, scheme, TASK, 10).rms[:, 0]
    np.testing.assert_allclose(
        predict(machines, scheme, TASK, 10), [simulated, simulated], rtol=1e-9
    )


@pytest.mark.thorough
def test_a_machine_plays_the_experiments_and_their_errors_are_no_growth(tmp_path):
    scheme = ModelFreeGradient(0.8, 3.0)
    campaign = Campaign.start(tmp_path / "machine", scheme, TASK)
    memory, found = scheme.initial_memory(TASK), []
    for trial in range(5):
        np.testing.assert_allclose(campaign.schedules()["u"], memory.u, **ALGEBRA)
        record = one_trial(MACHINE, scheme, TASK, memory, jax.random.key(trial))
        turn = campaign.turn(Measured(np.asarray(record.y), np.asarray(record.u), {}, (), "a file"))
        campaign.keep(turn)
        memory = learned(scheme, memory, record)
        found.append(turn)
        played = [turn.metrics["error"] for turn in found[::2]]
        assert _seen(campaign).best == min(played), "also before an experiment"
    errors = [turn.metrics["error"] for turn in found]
    assert errors[1] > 1.1 * errors[0], "an experiment should have the larger error"
    assert errors[4] < errors[2] < errors[0]
    assert not [finding for turn in found for finding in turn.findings if "grew" in finding.text]


REFUSED = {
    "inputs = 2 but the task has 1": lambda: ModelFreeGradient(1.0, inputs=2, outputs=1),
    "outputs = 3 but the task has 1": lambda: ModelFreeGradient(1.0, outputs=3),
    "Filtered: ModelFreeGradient makes experiments .* give it the filter": lambda: Filtered(
        ModelFreeGradient(1.0), ZeroPhaseFIR()
    ),
    "StopWhen: ModelFreeGradient makes experiments": lambda: StopWhen(
        Ladder(ModelFreeGradient(1.0), 2), growth=0.5
    ),
}
test_what_does_not_fit_is_named = refused(REFUSED, lambda make: make().check(TASK))
