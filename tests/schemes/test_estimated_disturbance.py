"""The Kalman filter over trials is compared with its equations in NumPy and with its statistics."""

import jax
import numpy as np
import pytest
from cases import DT, SIGMAS
from dense import lifted
from refusals import refused

from jaxilc.learning import Machine, learn
from jaxilc.learning.over_trials import measured_trial
from jaxilc.plants import StateSpace
from jaxilc.schemes import ConstrainedNormOptimal, EstimatedDisturbance, NormOptimal, PIDType
from jaxilc.signals import Task, Trial
from jaxilc.theory import linearity, outlook
from jaxilc.theory.certificates import certify_each
from jaxilc.theory.spectrum import radius_with_doubt
from jaxilc.uncertainty import drawn_machines

N = 20
MODEL = StateSpace(
    [[0.8, 0.3], [-0.3, 0.7]], [[0.2, 0.0], [0.1, 0.3]], [[1.0, 0.2], [0.1, 0.5]], dt=DT
)
MACHINE = Machine(StateSpace(0.95 * MODEL.A, 1.2 * MODEL.B, MODEL.C, dt=DT))
TASK = Task(np.cumsum(np.random.default_rng(2).standard_normal((N + 1, 2)), axis=0), dt=DT)
WEIGHTS = {"w_q": (2.0, 0.5), "w_r": 0.05, "w_s": 0.01}
LAG = StateSpace([[0.8]], [[0.2]], [[1.0]], dt=DT)
NEARLY_INVERSE = NormOptimal(LAG, w_s=1e-9)  # r - G u, and so the next error, is all but the news
SINGLE = Task(np.sin(np.arange(41) / 6.0), dt=DT)


@pytest.mark.thorough
@pytest.mark.parametrize("initial", [None, 0.3])
def test_it_is_its_equations(initial):
    q, m = np.array([0.05, 0.2]), np.array([0.1, 0.04])
    law = EstimatedDisturbance(NormOptimal(MODEL, **WEIGHTS), q, m, initial)
    history = learn(MACHINE, law, TASK, 5, save=lambda trial: (trial.y[1:], trial.u))
    y, u = map(np.asarray, history.saved)
    H = lifted(MODEL, N)
    Q = np.kron(np.eye(N), np.diag(WEIGHTS["w_q"]))
    cost = H.T @ Q @ H + (WEIGHTS["w_r"] + WEIGHTS["w_s"]) * np.eye(2 * N)
    r = np.asarray(TASK.reference)[1:].ravel()
    # the variance before a trial that its measurement does not change in the long run:
    # p = p m^2 / (p + m^2) + q^2
    steady = (q**2 + np.sqrt(q**4 + 4 * q**2 * m**2)) / 2
    d, variance = np.zeros((N, 2)), np.full(2, 0.0 if initial is None else initial**2)
    for j in range(5):
        prior = steady if initial is None else variance + q**2
        gain = prior / (prior + m**2)
        d += gain * (y[j] - (H @ u[j].ravel()).reshape(N, 2) - d)
        variance = (1 - gain) * prior
        following = np.linalg.solve(
            cost, H.T @ Q @ (r - d.ravel()) + WEIGHTS["w_r"] * u[j].ravel()
        ).reshape(N, 2)
        found = u[j + 1] if j < 4 else history.memory.scheme.u
        np.testing.assert_allclose(found, following, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(history.memory.d, d, rtol=1e-9, atol=1e-11)
    if initial is not None:
        np.testing.assert_allclose(history.memory.std, np.sqrt(variance), rtol=1e-12)


@pytest.mark.thorough
def test_without_noise_of_measurement_it_is_the_scheme_within():
    within = NormOptimal(MODEL, **WEIGHTS)
    law = EstimatedDisturbance(within, process_std=0.1, measurement_std=0.0)
    alone, found = (learn(MACHINE, one, TASK, 4) for one in (within, law))
    np.testing.assert_array_equal(found.memory.scheme.u, alone.memory.u)
    np.testing.assert_array_equal(found.rms, alone.rms)


@pytest.mark.thorough
def test_the_scheme_within_may_have_bounds():
    laws = [
        EstimatedDisturbance(within(MODEL, **WEIGHTS), 0.1, 0.2)
        for within in (NormOptimal, ConstrainedNormOptimal)
    ]
    inputs = [learn(MACHINE, law, TASK, 3).memory.scheme.u for law in laws]
    np.testing.assert_allclose(*inputs, rtol=1e-9, atol=1e-9)


@pytest.mark.thorough
def test_it_leaves_the_error_of_the_steady_kalman_filter_and_less_than_without():
    """Its next error has the variance q^2 / kappa; norm-optimal learning leaves q^2 + m^2."""
    q, m, samples, trials, first = 0.1, 0.2, 256, 60, 20
    task = Task(np.zeros(samples + 1), dt=DT)
    random = np.random.default_rng(7)
    d = np.cumsum(q * random.standard_normal((trials, samples, 1)), axis=0)
    v = m * random.standard_normal((trials, samples, 1))
    G = lifted(LAG, samples)

    @jax.jit
    def errors(law):
        def turn(memory, now):
            d_j, v_j = now
            u = law.feedforward(memory, task)
            e = -(G @ u + d_j)
            y = jax.numpy.concatenate([jax.numpy.zeros((1, 1)), -e + v_j])
            return law.learn(memory, Trial(jax.numpy.zeros_like(y), y, u, DT)), e

        return jax.lax.scan(turn, law.initial_memory(task), (d, v))[1]

    kappa = 2 / (1 + np.sqrt(1 + 4 * m**2 / q**2))
    left = {}
    for law, expected, pole in (
        (NEARLY_INVERSE, q**2 + m**2, 0.0),
        (EstimatedDisturbance(NEARLY_INVERSE, q, m), q**2 / kappa, 1 - kappa),
        (EstimatedDisturbance(NEARLY_INVERSE, q, m, 10.0), q**2 / kappa, 1 - kappa),
    ):
        squares = np.asarray(errors(law.prepared(task)))[first:] ** 2
        alike = (1 + pole**2) / (1 - pole**2)  # errors of one sample in successive trials
        scatter = np.sqrt(2 * alike / squares.size)
        assert abs(np.mean(squares) / expected - 1) < SIGMAS * scatter + 1e-6
        left[law] = np.mean(squares)
    alone, steady, varying = left.values()
    assert max(steady, varying) < 0.6 * alone


def test_the_law_with_the_gain_of_the_long_run_is_certified():
    q, m = 0.1, 0.2
    kappa = 2 / (1 + np.sqrt(1 + 4 * m**2 / q**2))
    machines = drawn_machines(Machine(LAG), {}, {})
    steady = EstimatedDisturbance(NEARLY_INVERSE, q, m)
    found = certify_each(machines, steady, SINGLE, 10)
    # an estimate that is wrong at first makes the error rise, so learning is not monotone
    assert list(found.claim) == ["converges"]
    np.testing.assert_allclose(found.predicted, found.simulated, rtol=1e-6, atol=1e-12)
    maps = outlook.maps_of(machines, steady, SINGLE)
    radius, doubt = radius_with_doubt(maps.M[0])
    np.testing.assert_allclose(radius, 1 - kappa, atol=max(1e-6, doubt))
    assert maps.radius()[0] < 1e-9  # a model without error never moves the estimate
    # |Q (1 - L P)| is of laws that learn from the last trial alone
    assert not linearity.of_last_trial(steady, SINGLE).held


@pytest.mark.thorough
def test_its_gain_withstands_absurd_sizes():
    y, u = np.ones(41), np.zeros(40)
    for q, m, s, gain in (
        (1e-300, 1e300, None, 0.0),
        (1e-300, 1e300, 1e-300, 0.0),
        (1e300, 1e-300, 1e200, 1.0),
        (1e-6, 1.0, 1e9, 1.0),
    ):
        law = EstimatedDisturbance(NEARLY_INVERSE, q, m, s)
        after = law.learn(law.initial_memory(SINGLE), measured_trial(SINGLE, y, u))
        np.testing.assert_allclose(after.d, gain, atol=1e-15)
        assert np.all(np.isfinite(after.scheme.u))


REFUSED = {
    "scheme is a PIDType": PIDType(gamma_p=1.0),
    "the model has 2 inputs but the task 1": NormOptimal(MODEL, **WEIGHTS),
}
test_a_scheme_that_does_not_fit_is_named = refused(
    REFUSED,
    lambda scheme: EstimatedDisturbance(scheme, process_std=1.0, measurement_std=1.0).check(SINGLE),
)
