"""Two-step learning is compared with SciPy's solvers, closed forms, and numbers of gILC.

The motion of the pendulum is a NumPy loop of its own. Its optima are those of `least_squares`, and
of `SLSQP` where bounds are active.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

from jaxilc import scenarios
from jaxilc.plants import Pendulum, StateSpace
from jaxilc.scenarios.reproduction import _simulated
from jaxilc.schemes import NormOptimal, TwoStep, WithFeedback
from jaxilc.schemes.gauss_newton import optimum
from jaxilc.schemes.scheme import need_second_derivatives
from jaxilc.schemes.two_step import TwoStepMemory
from jaxilc.signals import Task
from jaxilc.signals.task import Trial

N, DT = 12, 0.04
PROBLEMS = 8  # of which the last two cannot be solved
IMPOSSIBLE, NAN = PROBLEMS - 2, PROBLEMS - 1
MODEL = {"mass": 0.45, "damping": 0.12, "inertia": 0.006, "length": 0.3, "gravity": 9.81}
WEIGHTS = {"w_y": 3.0, "w_alpha": 0.02, "w_change": 0.05, "w_q": 2.0, "w_r": 1e-3, "w_s": 1e-3}


def motion(u, mass, damping, inertia, length, gravity):
    x, speed, y = 0.0, 0.0, [0.0]
    for torque in u:
        rate = torque - damping * speed - gravity * mass * length * np.sin(x)
        x, speed = x + DT * speed, speed + DT * rate / (inertia + mass * length**2)
        y.append(x)
    return np.array(y)


def problem(seed):
    """Return a scheme with bounds, a reference to the upright position and back, and a trial."""
    rng = np.random.default_rng(seed)
    model = {name: value * rng.uniform(0.9, 1.1) for name, value in MODEL.items()}
    plant = {name: value * rng.uniform(0.9, 1.1) for name, value in MODEL.items()}
    r = np.pi * rng.uniform(0.7, 1.1) * np.sin(np.pi * np.arange(N + 1) / N) ** 2
    u = rng.uniform(-1, 1, N)
    low = np.where(np.arange(N + 1) == N, rng.uniform(0.1, 0.3), -1.0)
    bounds = {
        "limit": rng.uniform(2.0, 8.0),
        "rate": rng.uniform(60.0, 200.0),
        "y_low": low[:, None],
        "y_high": rng.uniform(0.6, 1.0) * np.max(r),
    }
    if seed == 0:
        bounds = {"limit": 1e3, "rate": 1e6, "y_low": np.full((N + 1, 1), -1e3), "y_high": 1e3}
    if seed == IMPOSSIBLE:  # it gets nowhere near
        bounds |= {"limit": 0.01}
    return TwoStep(Pendulum(**model), **WEIGHTS, **bounds), (r, motion(u, **plant), u), model


@jax.jit
@jax.vmap
def learned(scheme, r, y, u):
    """Return the memory after a trial, where u was that of the memory before."""
    zero = jnp.zeros(())
    rest = TwoStepMemory(u, jnp.zeros((N, 1)), zero + 1, *[zero] * 5)
    return scheme.learn(rest, Trial(r, y, u, DT))


def batch(problems):
    """Return the schemes, and r, y and u (batch, ..., 1)."""
    schemes = jax.tree.map(
        lambda *leaves: jnp.stack(leaves), *(scheme for scheme, _, _ in problems)
    )
    signals = zip(*(trial for _, trial, _ in problems), strict=True)
    return schemes, *(np.stack(each)[..., None] for each in signals)


@pytest.fixture(scope="module")
def solved():
    """Return the problems, and their memories from one batch."""
    problems = [problem(seed) for seed in range(PROBLEMS)]
    problems[NAN][1][1][3:] = np.nan
    return problems, learned(*batch(problems))


def costs(trial, model):
    """Return the residuals of both steps, as functions of alpha, and of u and alpha."""
    r, y, u = trial
    root = {name: np.sqrt(value) for name, value in WEIGHTS.items()}

    def estimation(alpha):
        off = y - motion(u + alpha, **model)
        change = np.diff(alpha, prepend=0.0)
        parts = root["w_y"] * off, root["w_alpha"] * alpha, root["w_change"] * change
        return np.concatenate(parts)

    def control(new, alpha):
        e = r - motion(new + alpha, **model)
        return np.concatenate([root["w_q"] * e, root["w_r"] * (new - u), root["w_s"] * new])

    return estimation, control


@pytest.mark.thorough
def test_the_correction_is_that_of_least_squares(solved):
    problems, memory = solved
    for i, (_, trial, model) in enumerate(problems[:NAN]):
        estimation, _ = costs(trial, model)
        found = scipy.optimize.least_squares(
            estimation, np.zeros(N), xtol=1e-15, ftol=1e-15, gtol=1e-13
        )
        np.testing.assert_allclose(memory.alpha[i, :, 0], found.x, rtol=1e-6, atol=1e-6)


def slacks(scheme, u, alpha, model):
    """Return how far the bounds are away, by name."""
    y, steps = motion(u + alpha, **model), np.diff(u, prepend=0.0)
    return {
        "limit": scheme.limit - np.abs(u),
        "rate": scheme.rate * DT - np.abs(steps),
        "low": (y - scheme.y_low[:, 0])[1:],
        "high": (scheme.y_high - y)[1:],
    }


@pytest.mark.thorough
def test_the_input_is_that_of_another_solver_within_all_bounds(solved):
    problems, memory = solved
    active = set()
    for i, (scheme, trial, model) in enumerate(problems[:IMPOSSIBLE]):
        assert memory.converged[i] == 1
        alpha, ours = np.asarray(memory.alpha[i, :, 0]), np.asarray(memory.u[i, :, 0])
        _, control = costs(trial, model)

        def cost(u, control=control, alpha=alpha):
            return np.sum(control(u, alpha) ** 2) / 2

        def within(u, rest=(alpha, model), scheme=scheme):
            return np.concatenate([*slacks(scheme, u, *rest).values()])

        assert np.min(within(ours)) > -1e-6
        active |= {n for n, row in slacks(scheme, ours, alpha, model).items() if np.min(row) < 1e-6}
        theirs = scipy.optimize.minimize(
            cost,
            ours + 0.02 * np.random.default_rng(i).standard_normal(N),
            method="SLSQP",
            constraints={"type": "ineq", "fun": within},
            options={"ftol": 1e-14, "maxiter": 300},
        )
        assert cost(ours) <= theirs.fun * (1 + 1e-6)
        np.testing.assert_allclose(ours, theirs.x, atol=2e-3 * np.max(np.abs(ours)))
    assert active == {"limit", "rate", "low", "high"}


@pytest.mark.thorough
def test_a_member_that_cannot_be_solved_is_flagged_and_spoils_no_other(solved):
    """Bounds that cannot be met keep the input; a trial that is NaN keeps the correction too."""
    problems, memory = solved
    np.testing.assert_array_equal(memory.converged, np.arange(PROBLEMS) < IMPOSSIBLE)
    np.testing.assert_array_equal(memory.unsolved, 1 - memory.converged)
    for i in (IMPOSSIBLE, NAN):
        np.testing.assert_array_equal(memory.u[i, :, 0], problems[i][1][2])
    assert np.max(np.abs(memory.alpha[IMPOSSIBLE])) > 0.01
    np.testing.assert_array_equal(memory.alpha[NAN], 0.0)
    alone = learned(*batch([problems[1]] * PROBLEMS))
    for ours, theirs in zip(alone, memory, strict=True):
        np.testing.assert_allclose(ours[0], theirs[1], rtol=1e-9, atol=1e-9)


@pytest.mark.thorough
def test_the_optimum_has_the_derivative_of_its_differences():
    """The derivative in all numbers of a problem, where bounds are active, in one direction."""
    scheme, (r, _, u), _ = problem(2)
    alpha = 0.3 * np.sin(np.arange(N))[:, None]

    def best(scheme):
        return optimum(scheme._control(scheme.model, r[:, None], u[:, None], alpha), alpha, DT).w

    rng = np.random.default_rng(5)
    along = jax.tree.map(lambda leaf: 0.2 * leaf * rng.standard_normal(), scheme)
    at = jax.jit(lambda scheme: jax.jvp(best, (scheme,), (along,)))
    h = 1e-4
    move = {s: jax.tree.map(lambda by, s=s: s * by, along) for s in (-h, h)}
    before, after = (at(jax.tree.map(jnp.add, scheme, by))[0] for by in move.values())
    differences = (after - before) / (2 * h)
    assert np.max(np.abs(differences)) > 0.1
    slope = at(scheme)[1]
    np.testing.assert_allclose(slope, differences, atol=1e-4 * np.max(np.abs(differences)))


def test_of_a_linear_model_corrected_at_its_output_it_is_norm_optimal():
    """Then alpha is what was measured less what was predicted, for a w_alpha that is tiny."""
    rng = np.random.default_rng(6)
    model = StateSpace(
        [[0.88, 0.12], [-0.15, 0.8]], [[0.02, 0.1], [0.09, -0.03]], [[1.0, 0.4], [0.2, 1.0]], dt=DT
    )
    weights = {"w_q": ((4.0, 0.5), (0.5, 3.0)), "w_r": (0.02, 0.03), "w_s": 0.01}
    scheme = TwoStep(model, **weights, w_alpha=1e-12, correction="output")
    r, y = rng.standard_normal((2, N + 1, 2))
    u, task = rng.standard_normal((N, 2)), Task(r, dt=DT)
    trial = Trial(jnp.asarray(r), jnp.asarray(y), jnp.asarray(u), DT)
    zero = jnp.zeros(())
    rest = TwoStepMemory(jnp.zeros((N, 2)), jnp.zeros((N, 2)), zero + 1, *[zero] * 5)
    ours = jax.jit(lambda memory: scheme.learn(memory, trial))(rest)
    plain = NormOptimal(model, **weights)
    np.testing.assert_allclose(ours.u, plain.learn(plain.initial_memory(task), trial).u, rtol=1e-8)
    assert ours.converged == 1


@pytest.mark.thorough(but=["two-step-limited"])
@pytest.mark.parametrize("name", ["two-step", "two-step-limited"])
def test_the_pendulum_of_gilc_to_its_printed_digits(name):
    """An unstable model, N = 1999: five errors without, five with a limit of the torque."""
    scenario = scenarios.load("pendulum")
    printed = [row for row in scenario.published if row.scheme == name]
    assert len(printed) == 5
    for row, ours in _simulated(scenario, printed).items():
        assert abs(ours / row.value - 1) <= row.agreement <= 1.3e-5


@pytest.mark.parametrize(
    ("changed", "outputs", "message"),
    [
        ({"model": 3.0}, 1, r"TwoStep: model = 3.0 is a float; allowed is Plant"),
        ({"w_alpha": 0.0, "w_change": 0.0}, 1, r"TwoStep: w_alpha \+ w_change has the eigenvalues"),
        ({"w_r": 0.0, "w_s": 0.0}, 1, r"TwoStep: w_r \+ w_s has the eigenvalues"),
        ({"w_y": -1.0}, 1, r"TwoStep: w_y has the eigenvalues \[-1.\]; allowed are none below 0"),
        ({}, 2, r"TwoStep: the model has 1 inputs but the task 2"),
        ({"y_low": 0.5}, 1, r"TwoStep: y_low are \[0.5, inf\] for output 0 at sample 0, but the m"),
        ({"y_low": 0.0, "y_high": -1.0}, 1, r"TwoStep: y_low and y_high leave nothing of output 0"),
    ],
)
def test_what_does_not_fit_is_named(changed, outputs, message):
    task = Task(np.zeros((N + 1, outputs)), dt=DT)
    with pytest.raises(ValueError, match=message):
        TwoStep(**{"model": Pendulum(), **WEIGHTS, **changed}).check(task)


def test_what_needs_second_derivatives_names_the_scheme():
    inner = TwoStep(Pendulum(), **WEIGHTS)
    with pytest.raises(ValueError, match=r"Contraction: .*and TwoStep has first ones only"):
        need_second_derivatives(WithFeedback(inner, inner))
