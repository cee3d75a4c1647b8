"""Tuning: slopes against finite differences, optima against closed forms, divergence, risks, resuming, and what is refused."""

import dataclasses
import json
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import scipy.integrate
import scipy.linalg
import scipy.optimize
from cases import ALGEBRA, CASES, DIFFERENCES, SCHEMES, case

from jaxilc import objectives, schemes
from jaxilc.descent import Bijection, Evaluation, by_gradient, by_least_squares, for_starts, repaired, value_and_slope
from jaxilc.filters import ZeroPhaseButterworth, ZeroPhaseFIR
from jaxilc.learning import learn
from jaxilc.machine import Machine, Sensor
from jaxilc.objectives import (
    Bounded,
    Contraction,
    Effort,
    EveryTrial,
    Final,
    Growth,
    Holding,
    InputRate,
    Objective,
    Run,
    TrialsTo,
    judge,
)
from jaxilc.plants import StateSpace
from jaxilc.pytree import get_at
from jaxilc.recipe import describe
from jaxilc.risks import CVaR, Mean, SmoothMax, Worst
from jaxilc.schemes import CFDLMFAILC, FFDLMFAILC, PID, Filtered, PIDType
from jaxilc.schemes.pseudo_gradient import reset_estimate
from jaxilc.signals import Task
from jaxilc.tuning import Tuning
from jaxilc.uncertainty import Uniform

N = 20
TASK = Task(np.sin(2 * np.pi * np.arange(N + 1) / N), dt=1e-3)
STATIC = Machine(StateSpace([[0.0]], [[1.0]], [[1.0]], dt=1e-3))  # y[k+1] = u[k], so e_j = (1 - gamma g)^(j-1) r with the gain g
GAINS = {"plant.B": Uniform(0.6, 1.2, relative=True)}
EVERYTHING = (
    Final()
    + 0.7 * Final("rms", trial=2)
    + 0.5 * EveryTrial("max_error")
    + 0.2 * TrialsTo(0.6)
    + 0.3 * Growth("rms")
    + 0.1 * Effort(2.0)
    + 0.4 * Holding(2)
    + 0.2 * InputRate(50.0)
)
LEARNING = {name: scheme for name, scheme in SCHEMES.items() if scheme.learns}
# each kind of scheme once; a StopWhen that has stopped learns nothing, so that its map is the same at any weights
CONTRACTING = ("ffdl_book", "p_type_on_reference", "p_type_butterworth", "error_filtered", "higher_order", "p_type_ladder")
CONTRACTING += ("p_type_on_table", "norm_optimal", "milc", "ilc_asmc")
PROBLEM = Tuning(
    STATIC,
    PIDType(gamma_p=0.4),
    TASK,
    3,
    ["gamma_p"],
    GAINS,
    Final("rms", floor=0.1),
    samples=4,
    held_out=3,
    steps=8,
    validate_every=3,
    lanes=2,
)


# Slopes ----------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", LEARNING)
def test_slope_of_every_objective_equals_finite_differences(name):
    machine, scheme, task = case(name)
    leaves, shape = jax.tree.flatten(scheme)
    rng = np.random.default_rng(2)
    direction = [0.1 * rng.standard_normal(np.shape(leaf)) * np.maximum(np.abs(leaf), 0.1) for leaf in leaves]

    @jax.jit
    def along(x):
        def losses(x):
            moved = shape.unflatten([leaf + x * d for leaf, d in zip(leaves, direction, strict=True)])
            of = Run(machine, moved, task, learn(machine, Bounded.around(moved, task), task, 4))
            return jnp.stack([weight * term(of) for weight, term in EVERYTHING.terms])

        return jax.jvp(losses, (x,), (1.0,))

    at, h = -0.003, 1e-6  # off the place where some schemes of the list sit on a switch
    expected = (along(at + h)[0] - along(at - h)[0]) / (2 * h)
    assert np.count_nonzero(expected) >= len(expected) - 1, "only Growth may be at rest"
    np.testing.assert_allclose(along(at)[1], expected, **DIFFERENCES)


@pytest.mark.slow
@pytest.mark.parametrize("name", CONTRACTING)
def test_slope_of_contraction_equals_finite_differences(name):
    machine, scheme, task = case(name)
    leaves, shape = jax.tree.flatten(scheme)
    rng = np.random.default_rng(2)
    direction = [0.1 * rng.standard_normal(np.shape(leaf)) * np.maximum(np.abs(leaf), 0.1) for leaf in leaves]
    objective = Contraction(below=1e-3, steps=task.N * task.outputs)  # all Lanczos steps there are

    @jax.jit
    def along(x):
        def loss(x):
            moved = shape.unflatten([leaf + x * d for leaf, d in zip(leaves, direction, strict=True)])
            return judge(machine, moved, task, 1, objective)

        return jax.jvp(loss, (x,), (1.0,))

    at, h = -0.003, 1e-5
    expected = (along(at + h)[0] - along(at - h)[0]) / (2 * h)
    assert expected != 0
    np.testing.assert_allclose(along(at)[1], expected, rtol=2e-5, atol=DIFFERENCES["atol"])


def test_every_objective_and_every_learning_scheme_is_among_them():
    kinds = {kind for kind in vars(objectives).values() if isinstance(kind, type) and issubclass(kind, Objective)}
    assert kinds - {type(term) for _, term in EVERYTHING.terms} == {Objective, type(EVERYTHING), Contraction}
    listed = {type(part) for scheme in LEARNING.values() for part in parts_of(scheme)}
    learning = {kind for kind in vars(schemes).values() if isinstance(kind, type) and issubclass(kind, schemes.Scheme)}
    of_feedback = {schemes.FFDLMFAC, schemes.PFDLMFAC, schemes.CFDLMFAC, schemes.SMC}
    assert learning - listed == {schemes.Scheme} | of_feedback
    contracting = tuple({type(part) for name in CONTRACTING for part in parts_of(LEARNING[name])})
    assert {kind for kind in listed if not issubclass(kind, contracting)} == {schemes.StopWhen}


def parts_of(scheme):
    """The scheme and those within."""
    inner = [getattr(scheme, field.name) for field in dataclasses.fields(scheme)]
    return [scheme, *(part for one in inner if isinstance(one, schemes.Scheme) for part in parts_of(one))]


RESETS = {"phi0": -0.065, "lam": 0.02, "mu": 0.05, "epsilon": 0.01}


def test_a_smooth_reset_has_the_slope_that_the_switch_hides():
    # through both clauses: the integral of a slope is the change of the value, but for what a jump hides
    epsilon, phi0 = 0.01, -0.065
    path = np.linspace(-1.0, 1.0, 20001)

    def estimate(x, mode):
        (kept,) = reset_estimate([phi0 / 2 * x], 3 * epsilon * x, [phi0], component=0, epsilon=epsilon, mode=mode)
        return kept

    # `book` is phi0 up to x = 1/3, where |du| passes epsilon, and phi0 x / 2 from there: what its slope misses is the jump
    for mode, hidden in (("smooth", 0.0), ("book", phi0 / 6 - phi0)):
        value, slope = jax.vmap(jax.value_and_grad(partial(estimate, mode=mode)))(path)
        missed = value[-1] - value[0] - scipy.integrate.trapezoid(slope, path)
        np.testing.assert_allclose(missed, hidden, atol=2e-5)


def test_a_smooth_reset_is_that_of_the_book_far_from_its_thresholds():
    phi, du = jnp.array([-0.5, 0.4, -0.4, -0.5]), jnp.array([0.6, 0.6, -0.7, 0.6])
    smooth, book = (reset_estimate([phi], du, [jnp.array(-0.3)], component=0, epsilon=0.01, mode=mode)[0] for mode in ("smooth", "book"))
    np.testing.assert_array_equal(book, [-0.5, -0.3, -0.4, -0.5])
    np.testing.assert_allclose(smooth, book, rtol=1e-12)


def test_slopes_through_the_last_trials_alone_are_those_of_the_closed_form():
    # e_J = (1 - gamma g)^(K-1) e_(J-K+1), the latter held: K - 1 of J - 1 factors have a slope
    problem = dataclasses.replace(PROBLEM, uncertainty={}, trials=6, objective=Final("rms", floor=1e-9) + EveryTrial("rms", floor=1e-9))
    for K in (1, 4, 9):
        value, slope = jax.value_and_grad(lambda gamma: dataclasses.replace(problem, truncate=K).loss_of(STATIC, {"gamma_p": gamma}))(0.4)  # noqa: B023
        factors = np.array([max(0, j - 1 - max(0, 6 - K)) for j in range(1, 7)])
        np.testing.assert_allclose(slope, -(factors[-1] + np.mean(factors)) / 0.6, rtol=1e-9)
        np.testing.assert_allclose(value, problem.loss_of(STATIC, {"gamma_p": 0.4}), rtol=1e-12)


def test_truncation_changes_the_slope_and_nothing_else():
    machine = dataclasses.replace(STATIC, sensor=Sensor(noise=1e-2))
    scheme, objective = FFDLMFAILC(**RESETS | {"phi0": (0.1, 0.8)}, L_y=1, L_u=1), Final("rms") + TrialsTo(0.3)
    whole = dataclasses.replace(PROBLEM, machine=machine, scheme=scheme, weights=["lam"], trials=5, objective=objective, quantities=LARGEST)
    cut = dataclasses.replace(whole, truncate=3)
    key = jax.random.key(3)
    one, other = (jax.value_and_grad(lambda lam: p.loss_of(machine, {"lam": lam}, key=key))(0.02) for p in (whole, cut))  # noqa: B023
    np.testing.assert_allclose(one[0], other[0], rtol=1e-12)
    assert one[1] != other[1] != 0


def test_forward_and_backward_slopes_agree():
    def loss(z):
        return judge(STATIC, PIDType(gamma_p=z[0], gamma_d=z[1], leak=z[2]), TASK, 4, EVERYTHING)

    z = jnp.array([0.4, 0.1, 0.02])
    (one, forward), (other, backward) = (value_and_slope(loss, z, forward=mode) for mode in (True, False))
    np.testing.assert_allclose(one, other, **ALGEBRA)
    np.testing.assert_allclose(forward, backward, rtol=1e-9, atol=1e-12)


def test_contraction_and_its_slope_equal_those_of_the_dense_matrix():
    A, B, C = np.array([[0.9, 0.1], [-0.2, 0.8]]), np.array([[0.01], [0.1]]), np.array([[1.0, 0.5]])
    machine = Machine(StateSpace(A, B, C, dt=1e-3))
    markov = [(C @ np.linalg.matrix_power(A, k) @ B)[0, 0] for k in range(N)]

    def dense(gamma):
        return np.log(np.linalg.svd(np.eye(N) - gamma * scipy.linalg.toeplitz(markov, np.zeros(N)))[1][0] / 0.5)

    def margin(gamma):
        return judge(machine, PIDType(gamma_p=gamma), TASK, 1, Contraction(below=0.5, steps=N))

    value, slope = jax.jit(jax.value_and_grad(margin))(0.7)
    np.testing.assert_allclose(value, dense(0.7), rtol=1e-8)
    np.testing.assert_allclose(slope, (dense(0.7 + 1e-5) - dense(0.7 - 1e-5)) / 2e-5, rtol=1e-5)


def test_terms_are_what_they_say():
    errors = np.array([1.0, 0.3, 0.45, 0.45, 0.1])

    def run(trial_errors):
        # a scheme cannot be told to make these errors, so the figures are put into a real history
        history = learn(STATIC, PIDType(gamma_p=0.5), TASK, len(trial_errors))
        metrics = history.metrics._replace(settled_error=jnp.asarray(trial_errors)[:, None])
        return Run(STATIC, PIDType(gamma_p=0.5), TASK, history._replace(metrics=metrics))

    of = run(errors)
    np.testing.assert_allclose(Final(floor=1e-9)(of), np.log(0.1 / 1e-9), rtol=1e-12)
    np.testing.assert_allclose(EveryTrial(floor=1e-9)(of), np.mean(np.log(errors / 1e-9)), rtol=1e-12)
    np.testing.assert_allclose(Holding(2, floor=1e-9)(of), np.log(0.45 / 1e-9), rtol=1e-12)
    np.testing.assert_allclose(Growth()(of), np.log(0.45 / 0.3), rtol=1e-10)
    np.testing.assert_allclose(Growth(after=3)(of), 0.0, atol=1e-10)
    np.testing.assert_allclose(TrialsTo(0.4, width=1e-3)(of), 3.0, atol=1e-9)
    np.testing.assert_allclose(TrialsTo(0.3)(of), np.sum(1 / (1 + (0.3 / errors) ** 2)), rtol=1e-9)
    u = np.asarray(of.history.final.u)
    np.testing.assert_allclose(Effort(2.0)(of), np.mean((u / 2.0) ** 2), rtol=1e-12)
    np.testing.assert_allclose(InputRate(3.0)(of), np.mean((np.diff(u, axis=0) / 1e-3 / 3.0) ** 2), rtol=1e-12)
    np.testing.assert_allclose((2.0 * (Final() + Growth()))(of), 2 * Final()(of) + 2 * Growth()(of), rtol=1e-12)
    assert Final(floor=1e-3)(run(np.zeros(2))) == 0.0


# Divergence ------------------------------------------------------------------------------------------------------------------


def test_a_scheme_within_bounds_is_the_scheme():
    for name in ("ffdl_book", "p_type_on_reference"):
        machine, scheme, task = case(name)
        bare, bounded = (learn(machine, s, task, 4) for s in (scheme, Bounded.around(scheme, task)))
        np.testing.assert_array_equal(bare.rms, bounded.rms)


def test_divergence_has_the_loss_of_the_trial_that_passed_the_ceiling_and_its_slope():
    # gamma g = 3: |e_j| = 2^(j-1), above 1000 in the 11th trial, which all later ones repeat
    def loss(gamma):
        return judge(STATIC, PIDType(gamma_p=gamma), TASK, 200, Final("max_error"))

    value, slope = jax.value_and_grad(loss)(3.0)
    np.testing.assert_allclose(value, np.log(2.0**10 / 1e-6), rtol=1e-9)
    np.testing.assert_allclose(slope, 10 / 2.0, rtol=1e-9)


def test_divergence_outside_the_settled_window_is_seen():
    # a reference that rests in its second half: nothing to learn there, while the first half diverges as before
    task = Task(np.where(np.arange(N + 1) < N // 2, np.sin(2 * np.pi * np.arange(N + 1) / N), 0.0), dt=1e-3)
    value = judge(STATIC, PIDType(gamma_p=3.0), task, 20, Final())
    history = learn(STATIC, PIDType(gamma_p=3.0), task, 20)
    assert history.settled_error[-1, 0] == 0.0
    np.testing.assert_allclose(value, np.log(2.0**10 / 1e-6), rtol=1e-9)
    assert judge(STATIC, PIDType(gamma_p=1.5), task, 20, Final()) == 0.0


@pytest.mark.parametrize("strength", [3.0, 1e6, 1e30, 1e100])
def test_no_divergence_gives_a_slope_that_is_not_finite(strength):
    static, task = STATIC, TASK
    lightly_damped, _, other = case("p_type")
    for machine, scheme, of in (
        (static, lambda x: PIDType(gamma_p=x), task),
        (static, lambda x: PID(kp=x), task),  # blows up within the trial
        (lightly_damped, lambda x: PIDType(gamma_p=-x), other),
        (lightly_damped, lambda x: CFDLMFAILC(phi0=-0.06, lam=1e-3 / x), other),
    ):
        value, slope = jax.value_and_grad(lambda x: judge(machine, scheme(x), of, 40, Final() + EveryTrial()))(strength)  # noqa: B023
        assert np.isfinite(value)
        assert np.isfinite(slope)


def test_a_plant_without_a_finite_slope_is_counted_and_left_out():
    # of the two corners of the pole one overflows within the trial, whatever is done about it
    machine = dataclasses.replace(STATIC, plant=StateSpace([[0.1]], [[1.0]], [[1.0]], dt=1e-3, x0=(0.1,)))
    problem = dataclasses.replace(
        PROBLEM, machine=machine, uncertainty={"plant.A[0][0]": Uniform(0.05, 1e60)}, sampling="corners", held_out=0, steps=2
    )
    tuned = problem.run()
    np.testing.assert_array_equal(tuned.dropped, [[1], [1]])
    assert np.all(np.isfinite(tuned.loss))
    assert np.all(np.isfinite(tuned.slope) & (tuned.slope > 0))
    assert tuned.values["gamma_p"] > 0.4


def test_repaired_losses_and_slopes():
    losses = jnp.array([1.0, jnp.nan, 2.0, 3.0, 0.5])
    slopes = jnp.array([[3.0, 4.0], [1.0, 1.0], [jnp.inf, 0.0], [6e200, 8e200], [0.0, 0.5]])
    losses, slopes, good = repaired(losses, slopes, clip=2.0)  # lengths 0.5, 5, 1e201
    np.testing.assert_array_equal(good, [True, False, False, True, True])
    np.testing.assert_array_equal(losses, [1, 3, 2, 3, 0.5])
    np.testing.assert_allclose(slopes, [[3, 4], [0, 0], [0, 0], [6, 8], [0, 0.5]], rtol=1e-12)


def test_a_plant_above_the_floor_is_heard_among_those_below_it():
    slopes = np.array([[0.0], [0.0], [0.0], [2.0], [-50.0]])
    np.testing.assert_allclose(repaired(jnp.zeros(5), slopes, clip=3.0)[1], [[0], [0], [0], [2], [-3]])
    np.testing.assert_array_equal(repaired(jnp.full(2, jnp.nan), jnp.ones((2, 1)), clip=3.0)[1], 0.0)


@pytest.mark.parametrize(("clip", "found"), [(3.0, True), (np.inf, False)])
def test_chaotic_slopes_do_not_drown_the_others(clip, found):
    # nine plants want z = 1; the slope of a tenth is huge and of either sign, as that of a chattering loop is
    def evaluate(z):
        slopes = jnp.append(jnp.full(9, 2.0 * (z[0] - 1.0)), 1e30 * jnp.sign(jnp.sin(1e4 * z[0])))[:, None]
        losses, slopes, _ = repaired(jnp.append(jnp.full(9, (z[0] - 1.0) ** 2), 0.0), slopes, clip)
        return Evaluation(jnp.mean(losses), jnp.mean(slopes, axis=0), losses, slopes, jnp.zeros(()))

    method = for_starts(by_gradient(evaluate, optax.adam(optax.cosine_decay_schedule(0.1, 100))))
    z = np.array([[-2.0]])
    state = method.init(z)
    for _ in range(100):
        z, state, _ = method.step(z, state)
    assert (abs(z[0, 0] - 1.0) < 0.1) == found


# Risks -----------------------------------------------------------------------------------------------------------------------

LOSSES = np.array([0.3, -1.0, 2.5, 0.9, 4.0, 0.1, 0.2])
DEFINED = {
    Mean(): np.mean(LOSSES),
    Worst(): 4.0,
    CVaR(0.0): np.mean(LOSSES),
    CVaR(5 / 7): np.mean([4.0, 2.5]),
    CVaR(0.5): (4.0 + 2.5 + 0.9 + 0.5 * 0.3) / 3.5,
    CVaR(0.99): 4.0,
    SmoothMax(0.5): 0.5 * np.log(np.mean(np.exp(LOSSES / 0.5))),
    SmoothMax(1e-3): 4.0 - 1e-3 * np.log(7),
    SmoothMax(1e5): np.mean(LOSSES),
}


@pytest.mark.parametrize("risk", DEFINED, ids=str)
def test_risks_are_what_they_say_and_their_weights_are_their_derivatives(risk):
    np.testing.assert_allclose(risk(jnp.asarray(LOSSES)), DEFINED[risk], rtol=1e-4)
    weights = np.asarray(risk.weights(jnp.asarray(LOSSES)))
    np.testing.assert_allclose(weights.sum(), 1.0, rtol=1e-12)
    assert np.all(weights >= 0)
    h = 1e-6
    moved = [(risk(jnp.asarray(LOSSES + h * d)) - risk(jnp.asarray(LOSSES - h * d))) / (2 * h) for d in np.eye(len(LOSSES))]
    np.testing.assert_allclose(weights, moved, atol=1e-5)


# Coordinates -----------------------------------------------------------------------------------------------------------------

INTERVALS = [(-np.inf, np.inf), (0, np.inf), (2, np.inf), (-np.inf, -3), (0, 1), (-2, 5), (0.01, 100), (-50, -0.5)]


@pytest.mark.parametrize("interval", INTERVALS, ids=str)
def test_bijections_are_one_to_one_and_stay_inside(interval):
    bijection = Bijection(*map(float, interval), scale=3.0)
    z = np.linspace(-8.0, 8.0, 33)
    values = np.asarray(bijection(z))
    np.testing.assert_allclose([bijection.inverse(v) for v in values], z, atol=1e-5)
    assert np.all(np.diff(values) * np.sign(values[-1] - values[0]) > 0)
    far = np.asarray(bijection(np.array([-1e3, 1e3])))
    assert np.all((far > interval[0]) & (far < interval[1]))
    for end in interval:
        assert interval[0] < bijection.inside(end) < interval[1] or np.isinf(end)
    if np.isfinite(interval).all() and np.prod(interval) > 0:  # orders of magnitude count alike
        np.testing.assert_allclose(abs(bijection(0.0)), np.sqrt(np.prod(interval)), rtol=1e-9)


LARGEST = {"largest": lambda trial: jnp.max(jnp.abs(trial.u))}
TRACED = []


@dataclasses.dataclass(frozen=True)
class Traced(Objective):
    """Notes when it is traced."""

    def __call__(self, run):
        TRACED.append(1)
        return Final("rms", floor=0.1)(run)


# Optima ----------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("optimiser", ["adam", "lbfgs", "least-squares", optax.rmsprop(0.1)], ids=["adam", "lbfgs", "least-squares", "own"])
def test_the_best_gain_of_p_type_learning_is_found_by_one_program(optimiser):
    # smooth and convex in gamma near it: log sqrt((1 - gamma g)^4 + floor^2) with its minimum at gamma = 1 / g
    machine = dataclasses.replace(STATIC, plant=StateSpace([[0.0]], [[0.8]], [[1.0]], dt=1e-3))
    options = {"samples": 1, "held_out": 0, "optimiser": optimiser, "steps": 60, "patience": 60, "validate_every": 1}
    problem = dataclasses.replace(PROBLEM, machine=machine, uncertainty={}, trials=2, objective=Traced(), **options)
    traced = []
    tuned = problem.run(progress=lambda *_: traced.append(len(TRACED)))
    np.testing.assert_allclose(tuned.values["gamma_p"], 1 / 0.8, rtol=0.02)
    assert len(traced) == 60
    assert len(set(traced)) == 1
    assert tuned.after < 0.01 < tuned.before


def test_the_gain_for_the_worst_of_two_plants_is_the_minimax_one():
    # max over g of |1 - gamma g| is least where both ends are equal, at gamma = 2 / (g_low + g_high)
    options = {"sampling": "corners", "risk": Worst(), "steps": 80, "held_out": 0, "patience": 80, "validate_every": 1, "rate": 0.05}
    tuned = dataclasses.replace(PROBLEM, trials=2, **options).run()
    np.testing.assert_allclose(tuned.values["gamma_p"], 2 / 1.8, rtol=2e-3)


def test_least_squares_agrees_with_scipy():
    A, b = np.array([[1.0, 2.0], [0.5, -1.0], [3.0, 0.2]]), np.array([1.0, 0.3, -0.7])

    def residuals(z):
        return jnp.asarray(A) @ jnp.sinh(z) - b

    def evaluate(z):
        r, J = residuals(z), jax.jacfwd(residuals)(z)
        return Evaluation(0.5 * jnp.sum(r**2), J.T @ r, r, J, jnp.zeros(()))

    method = for_starts(by_least_squares(evaluate))
    z = np.array([[2.0, -1.5]])
    state = method.init(z)
    for _ in range(30):
        z, state, _ = method.step(z, state)
    np.testing.assert_allclose(z[0], scipy.optimize.least_squares(lambda z: np.asarray(residuals(z)), [0.1, 0.1]).x, atol=1e-6)


def test_the_line_search_of_lbfgs_uses_the_given_gradient():
    def evaluate(z):
        value = (1 - z[0]) ** 2 + 100 * (z[1] - z[0] ** 2) ** 2
        gradient = jnp.array([-2 * (1 - z[0]) - 400 * z[0] * (z[1] - z[0] ** 2), 200 * (z[1] - z[0] ** 2)])
        return Evaluation(value, gradient, z, jnp.eye(2), jnp.zeros(()))

    method = for_starts(by_gradient(evaluate, optax.lbfgs()))
    z = np.array([[-1.2, 1.0], [2.0, -1.0]])
    state = method.init(z)
    for _ in range(60):
        z, state, record = method.step(z, state)
    np.testing.assert_allclose(z, 1.0, atol=1e-4)
    assert record.loss.shape == (2,)


@pytest.fixture(scope="module")
def tuned():
    return dataclasses.replace(PROBLEM, starts=3, scatter=0.8).run()


def test_many_starts_take_the_best_by_held_out_plants(tuned):
    assert tuned.loss.shape == tuned.dropped.shape == tuned.weights["gamma_p"].shape == (8, 3)
    assert len(np.unique(tuned.weights["gamma_p"][0])) == 3
    looked = np.isfinite(tuned.held_out).all(axis=1)
    np.testing.assert_array_equal(np.flatnonzero(looked), [0, 3, 6, 8])
    np.testing.assert_allclose(tuned.after, np.nanmin(tuned.held_out), rtol=1e-12)
    assert np.nanmin(tuned.held_out[tuned.step]) == np.nanmin(tuned.held_out)
    # the held-out loss, from the closed form and plants rebuilt outside
    gains = np.asarray(PROBLEM._plants(PROBLEM.seed + 1, 3, nominal=False)[1]["plant.B"])
    error = (1 - tuned.values["gamma_p"] * gains) ** 2 * np.sqrt(0.5)
    np.testing.assert_allclose(tuned.after, np.mean(0.5 * np.log(error**2 + 0.01) - np.log(0.1)), rtol=1e-10)
    assert get_at(tuned.scheme, "gamma_p") == tuned.values["gamma_p"]


def test_patience_ends_it():
    still = dataclasses.replace(PROBLEM, optimiser=optax.set_to_zero(), steps=30, validate_every=1, patience=2).run()
    assert still.reason == "patience"
    assert len(still.loss) == 3


# Runs ------------------------------------------------------------------------------------------------------------------------


class Killed(Exception):
    pass


def kill_after(step):
    def progress(done, losses, best):
        if done == step:
            raise Killed

    return progress


OWN = optax.chain(optax.scale_by_adam(), optax.scale_by_schedule(optax.linear_schedule(-0.2, 0.0, 6)))


@pytest.mark.parametrize("optimiser", ["adam", "lbfgs", "least-squares", OWN], ids=["adam", "lbfgs", "least-squares", "own"])
def test_an_interrupted_tuning_resumes_to_the_same_numbers(optimiser, tmp_path):
    noisy = dataclasses.replace(STATIC, sensor=Sensor(noise=1e-2))
    problem = dataclasses.replace(PROBLEM, machine=noisy, starts=2, steps=6, optimiser=optimiser)
    whole = problem.run()
    with pytest.raises(Killed):
        problem.run(tmp_path / "state", progress=kill_after(4))
    steps = []
    resumed = problem.run(tmp_path / "state", resume=True, progress=lambda step, losses, best: steps.append(step))
    assert steps == [5, 6]
    for field in dataclasses.fields(whole):
        one, other = getattr(whole, field.name), getattr(resumed, field.name)
        if field.name != "scheme":
            jax.tree.map(np.testing.assert_array_equal, one, other)


def test_a_folder_of_another_tuning_is_refused(tmp_path):
    problem = dataclasses.replace(PROBLEM, steps=1, uncertainty={}, held_out=0)
    problem.run(tmp_path / "state")
    with pytest.raises(FileExistsError, match="exists already"):
        problem.run(tmp_path / "state")
    with pytest.raises(ValueError, match="another configuration; it differs in: seed: 0 there, 5 here"):
        dataclasses.replace(problem, seed=5).run(tmp_path / "state", resume=True)
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="not a tuning that can be resumed"):
        problem.run(tmp_path / "empty", resume=True)


def own_rule(rate):
    return optax.GradientTransformation(lambda z: (), lambda slope, state, z=None: (-rate * slope, state))


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (optax.rmsprop(0.1), optax.rmsprop(0.2)),
        (optax.adam(optax.cosine_decay_schedule(0.1, 20)), optax.adam(optax.cosine_decay_schedule(0.1, 30))),
        (optax.chain(optax.clip(1.0), optax.sgd(0.1)), optax.chain(optax.clip(2.0), optax.sgd(0.1))),
        (optax.inject_hyperparams(optax.sgd)(learning_rate=0.1), optax.inject_hyperparams(optax.sgd)(learning_rate=0.2)),
        (own_rule(0.1), own_rule(0.2)),
        (
            optax.GradientTransformation(lambda z: (), lambda slope, state, z=None: (-0.1 * slope, state)),
            optax.GradientTransformation(lambda z: (), lambda slope, state, z=None: (-0.2 * slope, state)),
        ),
    ],
    ids=["rate", "schedule", "chain", "injected", "closure", "constant"],
)
def test_a_configuration_tells_own_optimisers_apart(one, other):
    first, second, again = (json.dumps(describe(optimiser)) for optimiser in (one, other, one))
    assert first == again != second
    assert " at 0x" not in first, "an address would make every resumption a change"


class Nominal(Final):
    """The same, asked of the nominal plant."""

    nominal = True


def test_a_nominal_term_is_asked_once_and_counts():
    # two trials with the start gain of 0.4: e_3 = 0.36 r on the nominal plant
    problem = dataclasses.replace(PROBLEM, objective=2.0 * Nominal("rms", floor=0.1), steps=1)
    tuned = problem.run()
    expected = 2.0 * (0.5 * np.log(0.5 * 0.36**2 + 0.01) - np.log(0.1))
    np.testing.assert_allclose([tuned.loss[0, 0], tuned.before], expected, rtol=1e-9)
    assert tuned.slope[0, 0] > 0


def test_the_comparison_is_on_plants_nobody_has_seen(tuned):
    dataset = PROBLEM.compare(tuned, samples=9)
    seen = np.concatenate([np.asarray(PROBLEM._plants(seed, 4, nominal=False)[1]["plant.B"]) for seed in (0, 1)])
    assert not np.isin(dataset["plant.B"].values[1:], seen).any()
    gain = dataset["plant.B"].values
    expected = np.abs(1 - tuned.values["gamma_p"] * gain) ** 2 * np.sqrt(0.5)
    np.testing.assert_allclose(dataset["rms"].sel(scheme="tuned", trial=3), expected, rtol=1e-10)
    others = PROBLEM.compare(tuned, samples=9, seed=7)["plant.B"].values[1:]
    assert not np.isin(others, [*seen, *gain]).any()
    for seen_by in (0, 1):
        with pytest.raises(ValueError, match=f"compare: seed = {seen_by} is one of 0 and 1"):
            PROBLEM.compare(tuned, seed=seen_by)


def test_elements_and_arrays_are_tuned_by_name_and_ends_are_left():
    scheme = Filtered(PIDType(gamma_p=0.5, leak=0.0), ZeroPhaseFIR((0.5, 0.25)))
    weights = {"filter.taps[1]": None, "filter.taps": None, "scheme.leak": None, "scheme.gamma_p": (0.1, 2)}
    problem = dataclasses.replace(PROBLEM, scheme=scheme, steps=2, weights=weights)
    assert sorted(problem.bijections) == ["filter.taps[0]", "filter.taps[1]", "scheme.gamma_p", "scheme.leak"]
    tuned = problem.run()
    assert tuned.nudged == {"scheme.leak": 1e-3}
    assert tuned.start["scheme.leak"] == 0.0
    assert all(tuned.weights[name][1, 0] != tuned.weights[name][0, 0] for name in problem.bijections)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"weights": ["gain"]}, "weights: 'gain' is not a parameter here; known: gamma_p"),
        ({"weights": ["lead"]}, "weights: lead = 0 is not a float leaf"),
        ({"weights": ["limit"]}, "weights: limit = None is not a float leaf"),
        ({"weights": []}, "weights is empty"),
        ({"weights": {"gamma_p": (1.0, 1.0)}}, r"weights: the bounds \(1, 1\) of gamma_p are empty"),
        ({"weights": {"gamma_p": (0.5, 1.0)}}, r"weights: the start gamma_p = 0.4 is outside its bounds \(0.5, 1\)"),
        ({"weights": {"leak": (0.0, 2.0)}}, r"weights: the bounds \(0, 2\) of leak leave its allowed range \[0, 1\)"),
        ({"weights": ["scheme"], "scheme": CASES["p_type_fir"][1]}, "weights: scheme = .* is not a float leaf"),
        (
            {"weights": ["filter.cutoff"], "scheme": Filtered(PIDType(gamma_p=0.5), ZeroPhaseButterworth(80.0, padding=3))},
            r"filter.cutoff may become .*Nyquist.*Give narrower bounds",
        ),
        ({"optimiser": "newton"}, "optimiser = 'newton' is not one of adam, lbfgs, least-squares"),
        ({"mode": "sideways"}, "mode = 'sideways' is not one of auto, forward, reverse"),
        ({"steps": 0}, r"steps = 0 is outside its allowed range \[1, inf\)"),
        ({"truncate": 0}, r"truncate = 0 is outside its allowed range \[1, inf\)"),
        ({"clip": 0.0}, r"clip = 0.0 is outside its allowed range \(0, inf\)"),
        ({"objective": Final("speed")}, "figure = 'speed' is not one of max_error, rms, settled_error"),
        ({"objective": Holding(9)}, r"first = 9 is outside its allowed range \[1, 3\]"),
        ({"objective": Final(trial=9)}, r"trial = 9 is outside its allowed range \[1, 3\]"),
        ({"uncertainty": {"plant.mass": Uniform(1, 2)}}, "plant.mass"),
    ],
)
def test_bad_input_is_named_before_anything_runs(change, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(PROBLEM, **change)


def test_risks_name_what_is_wrong():
    with pytest.raises(ValueError, match=r"alpha = 1 is outside its allowed range \[0, 1\)"):
        CVaR(1.0)
    with pytest.raises(ValueError, match=r"temperature = 0 is outside"):
        SmoothMax(0.0)
