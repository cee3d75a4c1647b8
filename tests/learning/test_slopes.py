"""Slopes through learning are compared with finite differences and closed forms.

The tests also check what divergence does to slopes.
"""

import dataclasses
from functools import partial
from types import SimpleNamespace

import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import scipy.integrate
from cases import DIFFERENCES, PLANTS, case
from dense import lifted
from gain_case import PROBLEM, STATIC, TASK, N
from jax.flatten_util import ravel_pytree

from jaxilc import schemes
from jaxilc.learning import Machine, learn
from jaxilc.learning.known_metrics import GATHERED
from jaxilc.learning.metrics import Keep, measure
from jaxilc.plants import DifferenceEquation, StateSpace
from jaxilc.schemes import CFDLMFAILC, PID, PIDType
from jaxilc.schemes.mfac import reset_estimate
from jaxilc.signals import Task
from jaxilc.signals.task import Trial
from jaxilc.tuning import objectives
from jaxilc.tuning.descent import Evaluation, by_gradient, for_starts, repaired
from jaxilc.tuning.objectives import (
    D2,
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
    Sum,
    TrialsTo,
    judge,
    kept_for,
)
from jaxilc.tuning.problem import value_and_slope
from jaxilc.tuning.risks import Worst
from jaxilc.uncertainty import Uniform

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
TRIALS = 3  # one block of the scan; four are two, in which each trial is compiled twice
# Objectives see a scheme through its history alone, and test_conformance.py compares the gradient
# of each weight of each case. So one scheme of each kind of loop and of memory is enough here.
JUDGED = (
    "pid_type_leaky_limited", "ffdl_none", "p_type_on_reference", "p_type_stop", "two_step",
    "ilc_asmc",
)  # fmt: skip
CONTRACTING = ("ffdl_book", "p_type_butterworth", "basis_functions")


# Slopes
# --------------------------------------------------------------------------------------------------


def line_through(scheme):
    """Return the function x -> the scheme with its leaves moved along a line.

    The line has one random direction. At x = 1 each leaf has moved by a tenth of its size.
    """
    at, unravel = ravel_pytree(scheme)
    direction = np.random.default_rng(2).standard_normal(at.size)
    return lambda x: unravel(at + x * 0.1 * direction * np.maximum(np.abs(at), 0.1))


class Each(Sum):
    """The terms of a sum, of one run, in place of their sum."""

    def __call__(self, run):
        return jnp.stack([weight * term(run) for weight, term in self.parts])


def along(loss):
    """Return the compiled function x -> (loss, slope) by a forward derivative."""
    return jax.jit(lambda x: jax.jvp(loss, (x,), (1.0,)))


@pytest.mark.thorough(but=["ffdl_none"])
@pytest.mark.parametrize("name", JUDGED)
def test_slope_of_every_objective_equals_finite_differences(name):
    machine, scheme, task = case(name)
    moved, each = line_through(scheme), Each(EVERYTHING.terms)
    found = along(lambda x: judge(machine, moved(x), task, TRIALS, each))
    at, h = -0.003, 1e-6  # at x = 0 some schemes of the list are exactly at a switch
    expected = (found(at + h)[0] - found(at - h)[0]) / (2 * h)
    assert np.count_nonzero(expected) >= len(expected) - 1, "only Growth may be at rest"
    np.testing.assert_allclose(found(at)[1], expected, **DIFFERENCES)


NESTINGS = {  # the inner derivative, then the outer one
    "forward, forward": (jax.jacfwd, jax.jacfwd),
    "forward, reverse": (jax.jacfwd, jax.grad),
    "reverse, forward": (jax.grad, jax.jacfwd),
    "reverse, reverse": (jax.grad, jax.grad),
}
# One scheme for each rule of ours for a derivative.
CURVED = dict.fromkeys(("ffdl_book", "constrained", "two_step"), ("reverse, reverse",))
CURVED |= {"p_type": ("forward, reverse", "reverse, reverse")}
CURVED |= {"pd_type": ("forward, forward", "reverse, forward")}


@pytest.mark.thorough(but=["p_type"])
@pytest.mark.parametrize("name", CURVED)
def test_second_derivatives_of_all_metrics_equal_finite_differences(name):
    """The second derivative is wrong by a part that no first derivative shows.

    A rule for the derivative of a metric was lost in the parts of a loop that JAX computes before
    it goes back through it, and the error was then a constant to the second derivative.
    """
    machine, scheme, task = case(name)
    moved, trials = line_through(scheme), 1 if scheme.first_derivatives_only else 2

    def of(x):
        metrics = learn(machine, moved(x), task, trials).metrics
        return sum(jnp.sum(getattr(metrics, metric)) for metric, _ in GATHERED)

    ways = [NESTINGS[way] for way in CURVED[name]]
    if scheme.first_derivatives_only:
        for inner, outer in ways:
            with pytest.raises(ValueError, match="first derivatives only"):
                jax.eval_shape(outer(inner(of)), 0.0)
        return
    found = jax.jit(lambda x: (jax.grad(of)(x), [outer(inner(of))(x) for inner, outer in ways]))
    at, h = -0.003, 1e-5
    expected = (found(at + h)[0] - found(at - h)[0]) / (2 * h)
    assert abs(expected) > 1e-6
    np.testing.assert_allclose(found(at)[1], expected, **DIFFERENCES)


@pytest.mark.thorough(but=["p_type_butterworth"])
@pytest.mark.slow
@pytest.mark.parametrize("name", CONTRACTING)
def test_slope_of_contraction_equals_finite_differences(name):
    machine, scheme, task = case(name)
    moved = line_through(scheme)
    objective = Contraction(below=1e-3, steps=task.N * task.outputs)  # all possible Lanczos steps
    found = along(lambda x: judge(machine, moved(x), task, 1, objective))
    at, h = -0.003, 1e-5
    expected = (found(at + h)[0] - found(at - h)[0]) / (2 * h)
    assert abs(expected) > 1e-8
    np.testing.assert_allclose(found(at)[1], expected, rtol=2e-5, atol=DIFFERENCES["atol"])


def test_every_objective_is_among_them():
    kinds = {
        kind
        for kind in vars(objectives).values()
        if isinstance(kind, type) and issubclass(kind, Objective)
    }
    assert kinds - {type(term) for _, term in EVERYTHING.terms} == {Objective, Sum, Contraction, D2}


@pytest.mark.thorough
def test_contraction_needs_second_derivatives():
    machine, scheme, task = case("constrained")
    with pytest.raises(ValueError, match="ConstrainedNormOptimal has first ones only"):
        judge(machine, scheme, task, 2, Contraction())


@pytest.mark.parametrize("below", [0.5, 0.99])
def test_the_slope_of_d2_is_that_of_differences_and_zero_below_the_limit(below):
    machine = Machine(DifferenceEquation((0.0,), (0.8,), dt=1e-3))
    task = Task(reference=np.sin(np.arange(11) / 3.0), dt=1e-3)

    @jax.jit
    @jax.value_and_grad
    def loss(phi0):
        scheme = schemes.CFDLMFAILC(phi0=phi0, rho=0.7, reset="sign")
        return judge(machine, scheme, task, 1, D2(below))

    at, h = 0.4, 1e-6  # the start is the estimate that acts least: phi phi0 / (lam + phi0^2)
    d2 = 1 - 0.7 * 0.8 * at / (1 + at**2)
    value, slope = loss(at)
    np.testing.assert_allclose(value, max(0.0, np.log(d2 / below)), rtol=1e-12)
    expected = (loss(at + h)[0] - loss(at - h)[0]) / (2 * h)
    assert (expected == 0) == (below == 0.99)
    np.testing.assert_allclose(slope, expected, rtol=1e-6)


def test_d2_is_that_of_the_compact_form_alone():
    machine, scheme, task = case("ffdl_sign")
    with pytest.raises(ValueError, match="D2: FFDLMFAILC has no d2; allowed is CFDLMFAILC"):
        jax.eval_shape(partial(judge, machine, scheme, task, 2, D2()))


def test_a_smooth_reset_has_the_slope_that_the_switch_hides():
    # Over a range in which both clauses switch, the integral of a slope is the change of the value,
    # except for jumps, which the slope does not see.
    epsilon, phi0 = 0.01, -0.065
    path = np.linspace(-1.0, 1.0, 20001)

    def estimate(x, mode):
        (kept,) = reset_estimate(
            [phi0 / 2 * x], 3 * epsilon * x, [phi0], component=0, epsilon=epsilon, mode=mode
        )
        return kept

    # `book` gives phi0 up to x = 1/3, where |du| exceeds epsilon, and phi0 x / 2 from there. The
    # jump is the part that its slope misses.
    for mode, hidden in (("smooth", 0.0), ("book", phi0 / 6 - phi0)):
        value, slope = jax.jit(jax.vmap(jax.value_and_grad(partial(estimate, mode=mode))))(path)
        missed = value[-1] - value[0] - scipy.integrate.trapezoid(slope, path)
        np.testing.assert_allclose(missed, hidden, atol=2e-5)


def test_a_smooth_reset_is_that_of_the_book_far_from_its_thresholds():
    phi, du = np.array([-0.5, 0.4, -0.4, -0.5]), np.array([0.6, 0.6, -0.7, 0.6])
    reset = partial(reset_estimate, phi0=[jnp.array(-0.3)], component=0, epsilon=0.01)
    (smooth,), (book,) = jax.jit(lambda: [reset([phi], du, mode=m) for m in ("smooth", "book")])()
    np.testing.assert_array_equal(book, [-0.5, -0.3, -0.4, -0.5])
    np.testing.assert_allclose(smooth, book, rtol=1e-12)


def loss_of_gain(problem, gamma):
    return problem.loss_of(STATIC, {"gamma_p": gamma})


@pytest.mark.thorough
def test_slopes_through_the_last_trials_alone_are_those_of_the_closed_form():
    # e_J = (1 - gamma g)^(K-1) e_(J-K+1), where the last factor is held constant: K - 1 of J - 1
    # factors have a slope.
    problem = dataclasses.replace(
        PROBLEM,
        uncertainty={},
        trials=6,
        objective=Final("rms", floor=1e-9) + EveryTrial("rms", floor=1e-9),
    )
    whole = loss_of_gain(problem, 0.4)
    for K in (1, 3):
        short = dataclasses.replace(problem, truncate=K)
        value, slope = jax.jit(jax.value_and_grad(partial(loss_of_gain, short)))(0.4)
        factors = np.array([max(0, j - 1 - max(0, 6 - K)) for j in range(1, 7)])
        np.testing.assert_allclose(slope, -(factors[-1] + np.mean(factors)) / 0.6, rtol=1e-9)
        np.testing.assert_allclose(value, whole, rtol=1e-12)


def test_forward_slopes_of_a_batch_are_those_of_its_members():
    def of_each(z, *given):
        return value_and_slope(
            lambda z, a, b: jnp.sin(z[0] * a["x"]) + z[1] * b, z, *given, forward=True
        )

    z, a, b = np.array([0.4, 0.1]), {"x": np.arange(1.0, 4.0)}, 2.0
    starts = np.stack([z, -z])
    expected = (
        np.sin(z[0] * a["x"]) + z[1] * b,
        np.stack([a["x"] * np.cos(z[0] * a["x"]), np.full(3, b)], 1),
    )
    for_z = jax.vmap(of_each, (None, {"x": 0}, None))

    @jax.jit
    def found(starts):
        with_z = jax.vmap(of_each, (0, {"x": None}, 0))(starts, {"x": 2.0}, np.array([1.0, 3.0]))
        return for_z(z, a, b), jax.vmap(for_z, (0, None, None))(starts, a, b), with_z

    of_members, of_starts, with_z = found(starts)
    chex.assert_trees_all_close(of_members, expected, rtol=1e-14)
    chex.assert_trees_all_close(jax.tree.map(lambda x: x[0], of_starts), expected, rtol=1e-14)
    np.testing.assert_allclose(with_z[1][:, 1], [1.0, 3.0])


@pytest.mark.thorough
def test_contraction_and_its_slope_equal_those_of_the_dense_matrix():
    machine = Machine(PLANTS["discrete"])
    G = lifted(machine.plant, N)

    def dense(gamma):
        return np.log(np.linalg.norm(np.eye(N) - gamma * G, 2) / 0.5)

    def margin(gamma):
        return judge(machine, PIDType(gamma_p=gamma), TASK, 1, Contraction(below=0.5, steps=N))

    value, slope = jax.jit(jax.value_and_grad(margin))(0.7)
    np.testing.assert_allclose(value, dense(0.7), rtol=1e-8)
    np.testing.assert_allclose(slope, (dense(0.7 + 1e-5) - dense(0.7 - 1e-5)) / 2e-5, rtol=1e-5)


@pytest.mark.parametrize(
    ("objective", "law"),
    [
        (Contraction(steps=4), lambda one: PIDType(gamma_p=one)),
        (D2(), lambda one: CFDLMFAILC(phi0=one, lam=1e-20)),
    ],
)
def test_a_factor_of_0_has_the_slope_0(objective, law):
    """Of y[k+1] = u[k] one trial removes all of an error; the logarithm of 0 has no slope."""
    run = lambda one: objectives.Run(STATIC, law(one), TASK, None)  # noqa: E731
    value, slope = jax.value_and_grad(lambda one: objective(run(one)))(1.0)
    assert (value, slope) == (0, 0)


@pytest.mark.thorough
def test_terms_are_what_they_say():
    errors = np.array([1.0, 0.3, 0.45, 0.45, 0.1])
    law = PIDType(gamma_p=0.5)
    history = learn(STATIC, law, TASK, len(errors), save=kept_for(InputRate()))
    u = np.asarray(history.final.u)
    rate = np.diff(u, axis=0) / 1e-3 / 3.0
    expected = (
        (Final(floor=1e-9), np.log(0.1 / 1e-9), {"rtol": 1e-12}),
        (EveryTrial(floor=1e-9), np.mean(np.log(errors / 1e-9)), {"rtol": 1e-12}),
        (Holding(2, floor=1e-9), np.log(0.45 / 1e-9), {"rtol": 1e-12}),
        (Growth(), np.log(0.45 / 0.3), {"rtol": 1e-10}),
        (Growth(after=3), 0.0, {"atol": 1e-10}),
        (TrialsTo(0.4, width=1e-3), 3.0, {"atol": 1e-9}),
        (TrialsTo(0.3), np.sum(1 / (1 + (0.3 / errors) ** 2)), {"rtol": 1e-9}),
        (Effort(2.0), np.mean((u / 2.0) ** 2), {"rtol": 1e-12}),
        (InputRate(3.0), np.mean(rate**2), {"rtol": 1e-12}),
    )

    @jax.jit
    def found(trial_errors):
        # No scheme makes exactly these errors, so the metrics are put into a real history.
        metrics = history.metrics._replace(settled_error=trial_errors[:, None])
        of = Run(STATIC, law, TASK, history._replace(metrics=metrics))
        several = 2.0 * (Final() + Growth())
        parts = 2 * Final()(of) + 2 * Growth()(of)
        return [term(of) for term, *_ in expected], several(of), parts, Final(floor=1e-3)(of)

    values, several, parts, _ = found(errors)
    for value, (_, number, tolerance) in zip(values, expected, strict=True):
        np.testing.assert_allclose(value, number, **{"rtol": 1e-7} | tolerance)
    np.testing.assert_allclose(several, parts, rtol=1e-12)
    assert found(np.zeros(5))[-1] == 0.0


@pytest.mark.thorough
@pytest.mark.parametrize("tolerance", [2e-2, 1e-6, 1e-9])
def test_a_tolerance_is_one_number_for_all_outputs_however_small(tolerance):
    errors = tolerance * np.array([[4.0, 0.5], [0.5, 3.0], [0.2, 0.1], [0.0, 0.0]])
    metrics = SimpleNamespace(settled_error=errors)
    history = SimpleNamespace(metrics=metrics, saved={}, max_error=errors)
    task = Task(np.outer(np.sin(np.arange(9.0)), [1.0, 0.01]), dt=1e-3)
    run = Run(STATIC, PIDType(), task, history)
    trials = jax.jit(lambda: TrialsTo(tolerance, width=0.1)(run))()
    np.testing.assert_allclose(trials, 2.0, rtol=1e-3)


# Divergence
# --------------------------------------------------------------------------------------------------


@pytest.mark.thorough
def test_a_scheme_within_bounds_is_the_scheme():
    for name in ("ffdl_book", "p_type_on_reference"):
        machine, scheme, task = case(name)
        bare, bounded = (
            learn(machine, s, task, TRIALS) for s in (scheme, Bounded.around(scheme, task))
        )
        np.testing.assert_array_equal(bare.rms, bounded.rms)


def test_what_a_scheme_sees_is_within_the_level_and_finite():
    bounded, r = Bounded(PIDType(), level=jnp.array([2.0])), jnp.array([1.0])
    y = np.array([np.nan, np.inf, -np.inf, 0.5, 9.0, -1.0 - 1e-9])[:, None]
    of_all = jax.vmap(bounded._seen, (0, None))
    seen, slope = jax.jit(lambda y: jax.jvp(lambda y: of_all(y, r), (y,), (jnp.ones_like(y),)))(y)
    np.testing.assert_array_equal(seen[:, 0], [-1.0, 3.0, -1.0, 0.5, 3.0, -1.0])
    np.testing.assert_array_equal(slope[:, 0], [0.0, 0.0, 0.0, 1.0, 0.0, 0.0])


def test_the_largest_of_errors_that_are_all_zero_has_no_slope():
    r, v, u = np.ones((5, 1)), np.array([7.0, 1.0, -3.0, 2.0, -3.0])[:, None], np.zeros((4, 1))
    task = Task(r, dt=1e-3, settle=(0.0, 4e-3))

    def sizes(z):
        found = measure(Trial(r, r + z * v, u, task.dt, {}, None), task)
        return jnp.concatenate([found.max_error, found.settled_error])  # from sample 1 and 0 on

    slopes = jax.jit(jax.vmap(jax.jacrev(sizes)))(np.array([0.0, 1.0, -2.0]))
    assert slopes.tolist() == [[0.0, 0.0], [3.0, 7.0], [-3.0, -7.0]]


def test_divergence_has_the_loss_of_the_trial_that_passed_the_ceiling_and_its_slope():
    # With gamma g = 3, |e_j| = 2^(j-1) exceeds 1000 in the 11th trial, which all later trials
    # repeat; d log |e_j| / d gamma = (j - 1) / (gamma - 1).
    last, others = Final("max_error"), Effort(2.0) + InputRate(50.0)
    each = Each((EveryTrial("max_error") + others + last).terms)

    def found(trials):
        return along(lambda gamma: judge(STATIC, PIDType(gamma_p=gamma), TASK, trials, each))(3.0)

    late, at_once = found(30), found(11)
    before = np.minimum(np.arange(30), 10)
    np.testing.assert_allclose(late[0][0], np.mean(np.log(2.0**before / 1e-6)), rtol=1e-9)
    np.testing.assert_allclose(late[1][0], np.mean(before / 2.0), rtol=1e-9)
    assert late[0][1] > 1e3
    np.testing.assert_allclose(late[0][3], np.log(2.0**10 / 1e-6), rtol=1e-9)
    np.testing.assert_allclose(late[1][3], 10 / 2.0, rtol=1e-9)
    for one, other in zip(late, at_once, strict=True):
        np.testing.assert_allclose(one[1:], other[1:], rtol=1e-12)
    with pytest.raises(ValueError, match="quantity = 'input rate' is what the objective keeps"):
        kept_for(each, Keep.of({"input rate": jnp.mean}))


@pytest.mark.thorough
def test_divergence_outside_the_settled_window_is_seen():
    # The reference is constant in its second half. There is nothing to learn there, while the first
    # half diverges as before.
    task = Task(
        np.where(np.arange(N + 1) < N // 2, np.sin(2 * np.pi * np.arange(N + 1) / N), 0.0), dt=1e-3
    )
    value = jax.jit(lambda gamma: judge(STATIC, PIDType(gamma_p=gamma), task, 20, Final()))
    history = learn(STATIC, PIDType(gamma_p=3.0), task, 20)
    assert history.settled_error[-1, 0] == 0.0
    np.testing.assert_allclose(value(3.0), np.log(2.0**10 / 1e-6), rtol=1e-9)
    assert value(1.5) == 0.0


LIGHTLY_DAMPED, _, BUMP = case("p_type")
DIVERGING = {
    "learning": (STATIC, lambda x: PIDType(gamma_p=x), TASK),
    "feedback": (STATIC, lambda x: PID(kp=x), TASK),  # diverges within the trial
    "lightly damped": (LIGHTLY_DAMPED, lambda x: PIDType(gamma_p=-x), BUMP),
    "adaptive": (LIGHTLY_DAMPED, lambda x: CFDLMFAILC(phi0=-0.06, lam=1e-3 / x), BUMP),
}


@pytest.mark.thorough
@pytest.mark.parametrize("name", DIVERGING)
def test_no_divergence_gives_a_slope_that_is_not_finite(name):
    machine, scheme, task = DIVERGING[name]

    @jax.jit
    @jax.value_and_grad
    def loss(x):
        return judge(machine, scheme(x), task, 45, Final() + EveryTrial())

    for strength in (3.0, 1e6, 1e30, 1e100):
        assert np.all(np.isfinite(loss(strength)))


@pytest.mark.thorough
def test_a_plant_without_a_finite_slope_is_counted_and_left_out():
    # At one of the two corners of the pole the trial overflows, whatever is done about it.
    machine = dataclasses.replace(
        STATIC, plant=StateSpace([[0.1]], [[1.0]], [[1.0]], dt=1e-3, x0=(0.1,))
    )
    problem = dataclasses.replace(
        PROBLEM,
        machine=machine,
        uncertainty={"plant.A[0][0]": Uniform(0.05, 1e60)},
        sampling="corners",
        held_out=0,
        steps=2,
    )
    tuned = problem.run()
    np.testing.assert_array_equal(tuned.dropped, [[1], [1]])
    assert np.all(np.isfinite(tuned.loss))
    assert np.all(np.isfinite(tuned.slope) & (tuned.slope > 0))
    assert tuned.values["gamma_p"] > 0.4


def test_repaired_losses_and_slopes():
    losses = np.array([1.0, np.nan, 2.0, 3.0, 0.5])
    slopes = np.array([[3.0, 4.0], [1.0, 1.0], [np.inf, 0.0], [6e200, 8e200], [0.0, 0.5]])
    # their lengths are 0.5, 5 and 1e201
    losses, slopes, good = jax.jit(repaired)(losses, slopes, clip=2.0)
    np.testing.assert_array_equal(good, [True, False, False, True, True])
    np.testing.assert_array_equal(losses, [1, 3, 2, 3, 0.5])
    np.testing.assert_allclose(slopes, [[3, 4], [0, 0], [0, 0], [6, 8], [0, 0.5]], rtol=1e-12)


def test_a_plant_above_the_floor_is_heard_among_those_below_it():
    slopes = jax.jit(lambda losses, slopes: repaired(losses, slopes, clip=3.0)[1])
    found = slopes(np.zeros(5), np.array([[0.0], [0.0], [0.0], [2.0], [-50.0]]))
    np.testing.assert_allclose(found, [[0], [0], [0], [2], [-3]])
    np.testing.assert_array_equal(slopes(np.full(5, np.nan), np.ones((5, 1))), 0.0)


@dataclasses.dataclass(frozen=True)
class NotOfTheNominal(Objective):
    """The square of gamma - g, and no number on the machine of the nominal gain g = 1."""

    def __call__(self, run):
        gain = run.machine.plant.B[0, 0]
        return jnp.where(gain == 1.0, jnp.nan, (run.scheme.gamma_p - gain) ** 2)


@pytest.mark.thorough
def test_the_worst_machine_that_has_a_slope_is_followed_where_the_first_has_none():
    problem = dataclasses.replace(PROBLEM, trials=1, objective=NotOfTheNominal(), risk=Worst())
    gains = problem.population.drawn["plant.B"][1:]
    found = jax.jit(problem.evaluation[0])(jnp.array([1.25]))  # gamma = 0.4 z
    np.testing.assert_allclose(found.value, max((0.5 - gains) ** 2))
    np.testing.assert_allclose(found.gradient, [min(0.8 * (0.5 - gains))])


@pytest.mark.thorough
@pytest.mark.parametrize(("clip", "found"), [(3.0, True), (np.inf, False)])
def test_chaotic_slopes_do_not_drown_the_others(clip, found):
    # Nine plants have their optimum at z = 1. The slope of the tenth is very large, with either
    # sign, as for a loop that chatters.
    def evaluate(z):
        slopes = jnp.append(jnp.full(9, 2.0 * (z[0] - 1.0)), 1e30 * jnp.sign(jnp.sin(1e4 * z[0])))[
            :, None
        ]
        losses, slopes, _ = repaired(jnp.append(jnp.full(9, (z[0] - 1.0) ** 2), 0.0), slopes, clip)
        return Evaluation(jnp.mean(losses), jnp.mean(slopes, axis=0), losses, slopes, jnp.zeros(()))

    optimiser = optax.adam(optax.cosine_decay_schedule(0.1, 100))
    init, step = for_starts(by_gradient(evaluate, optimiser))
    z = np.array([[-2.0]])
    state = init(z)
    for _ in range(100):
        z, state, _ = step(z, state)
    assert (abs(z[0, 0] - 1.0) < 0.1) == found
