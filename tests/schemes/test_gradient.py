"""Gradient learning by a model, against lifted matrices and central differences in NumPy."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import ALGEBRA, DIFFERENCES, DT, MODEL
from dense import lifted
from refusals import refused

from jaxilc import Machine, Task
from jaxilc.plants import DifferenceEquation, StateSpace, TimeVaryingStateSpace
from jaxilc.plants.from_python_control import NonlinearSystem
from jaxilc.schemes import GradientILC
from jaxilc.theory.certificates import DIVERGES, MONOTONE, long_run
from jaxilc.theory.law import law_of, learning_law

N = 12
BUMP = Task(0.5 - 0.5 * np.cos(2 * np.pi * np.arange(N + 1) / N), dt=DT)
RANDOM = np.random.default_rng(4)
WIDE = StateSpace(
    RANDOM.uniform(-0.5, 0.5, (3, 3)),
    RANDOM.standard_normal((3, 3)),
    RANDOM.standard_normal((2, 3)),
    dt=DT,
)


def _swung(t, x, u, parameters):
    force = 0.1 * u[0] - parameters["gravity"] * jnp.sin(x[0])
    return 0.9 * x[0] + 0.1 * x[1], 0.8 * x[1] + force


def _angle(t, x, parameters):
    return (x[0] + 0.5 * x[1],)


PENDULUM = NonlinearSystem({"gravity": 0.17}, (0.05, -0.1), _swung, _angle, n_in=1, n_out=1, dt=DT)
Q, S = np.array([[4.0, 0.5], [0.5, 3.0]]), np.array([0.1, 0.2, 0.3])


@jax.jit
def after(scheme, u, e):
    """Return the memory after a trial that played u (N, n_u) with the errors e (N, n_y)."""
    task = Task(np.zeros((N + 1, e.shape[1])), dt=DT, inputs=u.shape[1])
    trial = scheme.record(u, jnp.concatenate([jnp.zeros_like(e[:1]), e]), task)
    return scheme.learn(scheme.initial_memory(task), trial)


@pytest.mark.thorough
def test_it_goes_down_the_gradient_of_the_cost_of_many_channels():
    G = lifted(WIDE, N)
    u, e = RANDOM.standard_normal((N, 3)), RANDOM.standard_normal((N, 2))
    found = after(GradientILC(WIDE, step=0.01, w_q=Q, w_s=S), u, e)
    slope = G.T @ np.kron(np.eye(N), Q) @ e.ravel() - np.kron(np.eye(N), np.diag(S)) @ u.ravel()
    np.testing.assert_allclose(found.u, u + 0.01 * slope.reshape(N, 3), **ALGEBRA)
    curvature = G.T @ np.kron(np.eye(N), Q) @ G + np.kron(np.eye(N), np.diag(S))
    exact = 0.01 * np.linalg.norm(curvature, 2) / 2
    assert 0.99 * exact < found.share <= exact * (1 + 1e-12)


@pytest.mark.thorough
def test_of_a_model_that_varies_over_the_trial():
    wave = 1 + 0.3 * np.sin(np.arange(N))[:, None, None]
    model = TimeVaryingStateSpace(*(np.asarray(M) * wave for M in (MODEL.A, MODEL.B, MODEL.C)), DT)
    G = lifted(model, N)
    u, e = RANDOM.standard_normal((2, N, 1))
    expected = u[:, 0] + 2.0 * G.T @ e[:, 0]
    np.testing.assert_allclose(after(GradientILC(model, step=2.0), u, e).u[:, 0], expected)


def pendulum(u):
    """Return the outputs y[1..N] of the pendulum in NumPy."""
    x, y = np.array([0.05, -0.1]), []
    for force in u[:, 0]:
        x = np.array([0.9 * x[0] + 0.1 * x[1], 0.8 * x[1] + 0.1 * force - 0.17 * np.sin(x[0])])
        y.append(x[0] + 0.5 * x[1])
    return np.array(y)


@pytest.mark.thorough
def test_a_nonlinear_model_is_linearised_at_the_input_of_the_trial():
    u, e = 20 * RANDOM.standard_normal((N, 1)), RANDOM.standard_normal((N, 1))
    slope, h = np.zeros((N, 1)), 1e-5
    for k in range(N):
        d = np.zeros((N, 1))
        d[k] = h
        slope[k] = e[:, 0] @ (pendulum(u + d) - pendulum(u - d)) / (2 * h)
    found = after(GradientILC(PENDULUM, step=1.5), u, e)
    np.testing.assert_allclose(found.u, u + 1.5 * slope, **DIFFERENCES)
    at_rest = after(GradientILC(PENDULUM, step=1.5), 0 * u, e).u
    assert np.max(np.abs(at_rest - 1.5 * slope)) > 1e-3, "the motion should matter"


@pytest.mark.thorough
def test_a_step_of_learning_has_derivatives_in_the_model_and_the_weights():
    u, e = 20 * RANDOM.standard_normal((N, 1)), RANDOM.standard_normal((N, 1))
    scheme = GradientILC(PENDULUM, w_q=0.9, w_s=0.01)
    along = jax.jit(lambda x: after(jax.tree.map(lambda leaf: leaf * (1 + x), scheme), u, e).u)
    h = 1e-5
    expected = (along(h) - along(-h)) / (2 * h)
    np.testing.assert_allclose(jax.jacrev(along)(0.0), expected, **DIFFERENCES)
    assert np.max(np.abs(expected)) > 0.1


def _cubed(t, x, u, parameters):
    return u + parameters["cubic"] * u**3


def _state(t, x, parameters):
    return x


@pytest.mark.thorough
def test_where_the_gain_grows_with_the_motion_the_memory_says_so():
    """The static model y = u + u^3 has the gain 1 + 3 u^2, largest at the largest |u|."""
    cubic = NonlinearSystem({"cubic": 1.0}, (0.0,), _cubed, _state, n_in=1, n_out=1, dt=DT)
    scheme = GradientILC(cubic, step=1.9)
    scheme.check(BUMP)
    u, e = np.zeros((N, 1)), np.ones((N, 1))
    u[3:] = np.linspace(0, 0.4, N - 3)[:, None]
    found = after(scheme, u, e)
    assert np.isclose(found.share, 1.9 * (1 + 3 * 0.4**2) ** 2 / 2, rtol=1e-3)
    assert found.beyond == 1
    assert after(scheme, 0 * u, e).beyond == 0
    # without a step of its own it takes the inverse of the curvature that it finds
    free = after(GradientILC(cubic), u, e)
    assert np.isclose(free.step * (1 + 3 * 0.4**2) ** 2, 1, rtol=1e-3)
    assert free.share == 0.5


def test_a_step_is_refused_from_its_bound_on():
    bound = 2 / np.linalg.norm(lifted(MODEL, N), 2) ** 2
    GradientILC(MODEL, step=0.999 * bound).check(BUMP)
    with pytest.raises(ValueError, match=rf"step = .* below 2 / \|G\|\^2 = {bound:.5g}"):
        GradientILC(MODEL, step=1.001 * bound).check(BUMP)


@pytest.mark.thorough
def test_certificates_are_as_sharp_as_the_bound():
    """On a machine of k times the gain the bound is 1 / k of that of the model."""
    step = 1 / np.linalg.norm(lifted(MODEL, N), 2) ** 2
    machines = jax.vmap(lambda k: Machine(dataclasses.replace(MODEL, C=k * MODEL.C)))(
        jnp.array([0.5, 1.999, 2.001])
    )
    found = long_run(machines, GradientILC(MODEL, step=step), BUMP)
    assert list(found.claim) == [MONOTONE, MONOTONE, DIVERGES]


def test_a_law_whose_step_follows_from_the_trial_is_read_at_its_length():
    scheme = GradientILC(MODEL)
    law, rows = law_of(scheme, BUMP), learning_law(scheme, BUMP).L.reshape(N, N)
    middle = rows[:, N // 2]
    expected = {N // 2 - k + 1: middle[k] for k in range(N // 2 + 1)}
    for power, tap in zip(law.L.powers, law.L.taps[:, 0, 0], strict=True):
        assert np.isclose(tap, expected[int(power)])
    assert not law.invariant.held, "in twelve samples its taps do not die out"


def test_a_machine_that_diverged_spoils_no_other():
    scheme = GradientILC(PENDULUM)
    u, e = RANDOM.standard_normal((2, 3, N, 1))

    @jax.jit
    @jax.vmap
    def of(u, e):
        e = jnp.concatenate([jnp.zeros((1, 1)), e])
        return scheme.learn(scheme.initial_memory(BUMP), scheme.record(u, e, BUMP))

    alone, together = of(u, e), of(u, np.where(np.arange(3)[:, None, None] == 1, np.nan, e))
    for one, other in zip(jax.tree.leaves(alone), jax.tree.leaves(together), strict=True):
        np.testing.assert_array_equal(np.asarray(one)[::2], np.asarray(other)[::2])
    assert np.all(np.isnan(together.u[1]))


REFUSED = {
    "the model has 3 inputs but the task 1": lambda: GradientILC(WIDE),
    "w_q has the eigenvalues": lambda: GradientILC(MODEL, w_q=-1.0),
    "is sampled at 1 s": lambda: GradientILC(DifferenceEquation((0.5,), (1.0,), dt=1.0)),
    "answers with numbers that are not finite within N = 12": lambda: GradientILC(
        StateSpace([[1e40]], [[1.0]], [[1.0]], dt=DT)
    ),
    "does not answer": lambda: GradientILC(StateSpace([[0.5]], [[0.0]], [[1.0]], dt=DT)),
}
test_what_does_not_fit_is_named = refused(REFUSED, lambda make: make().check(BUMP))
