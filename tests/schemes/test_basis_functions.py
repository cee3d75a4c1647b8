"""Basis functions, against closed forms and dense matrices in NumPy."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import ALGEBRA, DT, MODEL, SCHEMES, case
from dense import lifted
from numpy.polynomial import Polynomial
from refusals import refused

from jaxilc import Machine, Task, learn
from jaxilc.plants import DifferenceEquation, Splines, StateSpace
from jaxilc.pytree import pytree
from jaxilc.schemes import (
    PID,
    Basis,
    BasisFunctions,
    ConstrainedNormOptimal,
    GivenBasis,
    JoinedBasis,
    OnBasis,
    OnOutputs,
    PIDType,
    PolynomialBasis,
    PositionBasis,
    RationalBasis,
    SelectedBasis,
    WarmStart,
    WithFeedback,
    fitted,
    select_basis,
    started,
)
from jaxilc.schemes.bases import _path
from jaxilc.schemes.scheme import with_all_parts
from jaxilc.theory.learning_map import view_of
from jaxilc.theory.outlook import outlooks
from jaxilc.uncertainty import drawn_machines

STEP = Polynomial([0] * 5 + [126, -420, 540, -315, 70])  # from 0 to 1, four derivatives at rest


def moved(samples, height=1.0, dt=DT):
    """Return a reference that moves within the middle 70 % of a trial."""
    s = np.clip((np.arange(samples + 1) / samples - 0.15) / 0.7, 0, 1)
    return Task(height * STEP(s), dt)


@partial(jax.jit, static_argnames=("dt", "inputs"))
def columns(basis, r, dt=DT, inputs=1):
    return basis.columns(r, dt, inputs)


def test_derivatives_are_those_of_a_polynomial_to_second_order():
    errors = []
    for samples in (100, 200):
        dt = 0.4 / samples
        task = moved(samples, dt=dt)
        found = columns(PolynomialBasis((0, 1, 2, 3, 4)), task.reference, dt)[:, 0]
        s = np.clip(((np.arange(samples) + 0.5) / samples - 0.15) / 0.7, 0, 1)
        exact = [(STEP.deriv(i) if i else STEP)(s) / 0.28**i for i in range(5)]
        off = np.abs(np.asarray(found).T - exact).max(axis=1) / np.abs(exact).max(axis=1)
        errors.append(off[:4])  # the snap bends at its ends
    assert np.all(errors[1] < 0.3 * errors[0])
    assert np.all(errors[1] < 2e-3)


def test_a_lead_is_a_shift_and_friction_has_the_sign_of_the_velocity():
    task = moved(60)
    shifted = np.concatenate([task.reference[3:], np.repeat(task.reference[-1:], 3, axis=0)])
    basis = PolynomialBasis((0, 1, 2), coulomb=1e-9)
    of_shifted = columns(basis, shifted)
    ahead = columns(dataclasses.replace(basis, lead=3 * DT), task.reference)
    np.testing.assert_allclose(ahead[:-3], of_shifted[:-3], rtol=1e-9, atol=1e-9)
    velocity = np.diff(np.asarray(task.reference), axis=0)
    np.testing.assert_array_equal(columns(basis, task.reference)[:, :, 3], np.sign(velocity))


@pytest.mark.thorough
@pytest.mark.parametrize("update", ["norm_optimal", "gradient"])
def test_updates_are_those_of_dense_matrices(update):
    N, plant = 30, StateSpace([[0.85, 0.1], [-0.1, 0.8]], MODEL.B, MODEL.C, dt=DT)
    task, basis = moved(N), PolynomialBasis((0, 1, 2))
    scheme = BasisFunctions(
        basis, MODEL, w_q=2.0, w_r=0.3, w_s=0.05, step=0.8, update=update, start=(0.1, 0.0, 0.0)
    )
    history = learn(Machine(plant), scheme, task, 3, save=lambda trial: trial.e)
    P = np.asarray(columns(basis, task.reference))[:, 0]
    H, G = lifted(MODEL, N), lifted(plant, N)
    r, theta = np.asarray(task.reference)[1:, 0], np.array([0.1, 0.0, 0.0])
    for j in range(3):
        u = P @ theta
        e = r - G @ u
        np.testing.assert_allclose(history.saved[j, 1:, 0], e, rtol=1e-8, atol=1e-9)
        X = np.vstack([np.sqrt(2.0) * H @ P, np.sqrt(0.3) * P, np.sqrt(0.05) * P])
        if update == "norm_optimal":
            t = np.concatenate([np.sqrt(2.0) * (e + H @ u), np.sqrt(0.3) * u, 0 * u])
            theta = theta + 0.8 * (np.linalg.lstsq(X, t, rcond=None)[0] - theta)
        else:
            C = X.T @ X
            scale = 1 / np.sqrt(np.diag(C))
            h = np.linalg.eigvalsh(C * np.outer(scale, scale))[-1]
            down = P.T @ (2.0 * H.T @ e - 0.05 * u)
            theta = theta + 0.8 * scale**2 * down / h
    np.testing.assert_allclose(history.memory.theta, theta, rtol=1e-7)


def test_two_axes_have_parameters_of_their_own_or_coupled_ones():
    r = np.stack([moved(20).reference[:, 0], np.sin(np.arange(21) / 5)], axis=1)
    own = PolynomialBasis((1, 2))
    single = [columns(own, r[:, [i]])[:, 0] for i in range(2)]
    theta = np.array([1.0, 2.0, 3.0, 4.0])
    u = jax.jit(own.signal, static_argnums=3)(theta, r, DT, 2)
    np.testing.assert_allclose(u[:, 0], single[0] @ theta[:2], **ALGEBRA)
    np.testing.assert_allclose(u[:, 1], single[1] @ theta[2:], **ALGEBRA)
    coupled = PolynomialBasis((1, 2), coupled=True)
    assert coupled.names(2, 1) == (
        "velocity[0<-0]",
        "acceleration[0<-0]",
        "velocity[0<-1]",
        "acceleration[0<-1]",
    )
    u = jax.jit(coupled.signal, static_argnums=3)(theta, r, DT, 1)[:, 0]
    np.testing.assert_allclose(u, single[0] @ theta[:2] + single[1] @ theta[2:], **ALGEBRA)


@pytest.mark.thorough(but=["unstable"])
@pytest.mark.parametrize("poles", [(0.02, 1e-4), (-0.03, 1e-4)], ids=["stable", "unstable"])
def test_a_rational_basis_solves_its_difference_equation_and_is_found_again(poles):
    task = moved(300)
    r = np.asarray(task.reference)
    basis = RationalBasis(PolynomialBasis((0, 1, 2)), order=2)
    theta = np.array([1.0, 0.01, 0.001, *poles])
    u = np.asarray(jax.jit(lambda theta: basis.signal(theta, r, DT, 1))(theta))[:, 0]
    B = np.asarray(columns(basis.numerator, r))[:, 0] @ theta[:3]
    first, second = (u[2:] - u[:-2]) / (2 * DT), (u[2:] - 2 * u[1:-1] + u[:-2]) / DT**2
    left = u[1:-1] + poles[0] * first + poles[1] * second
    np.testing.assert_allclose(left, B[1:-1], atol=2e-7)
    assert np.max(np.abs(u)) < 20  # bounded, also where A has roots on the right
    once = jax.jit(lambda found: fitted(basis, u, r, DT, theta=found, iterations=1))
    found = np.zeros(5)
    for _ in range(10):
        found = once(found)
    np.testing.assert_allclose(found, theta, rtol=2e-2)


@pytest.mark.thorough
def test_a_rational_law_meets_a_plant_whose_inverse_has_a_pole():
    """The plant has a slow zero, so its inverse is B / A, which no polynomial of r can be."""
    tau = 0.02
    zero = StateSpace([[0, 1], [-1e4, -2e2]], [[0], [1e4]], [[1.0, tau]])
    task = moved(300)
    errors = {}
    for name, basis in {
        "polynomial": PolynomialBasis((0, 1, 2)),
        "rational": RationalBasis(PolynomialBasis((0, 1, 2)), order=1),
    }.items():
        model = zero.sampled(DT)
        history = learn(Machine(zero), BasisFunctions(basis, model), task, 4)
        errors[name] = float(history.rms[-1, 0])
    assert errors["rational"] < 0.1 * errors["polynomial"]


@pytest.mark.thorough
def test_on_a_basis_any_law_is_projected_after_each_trial():
    task, basis = moved(25), PolynomialBasis((0, 1, 2))
    plant, law = DifferenceEquation((0.7,), (0.3,), dt=DT), PIDType(gamma_p=0.5)
    history = learn(Machine(plant), OnBasis(law, basis), task, 3, save=lambda trial: trial.u)
    P = np.asarray(columns(basis, task.reference))[:, 0]
    r, u = np.asarray(task.reference)[:, 0], np.zeros(25)
    for j in range(3):
        np.testing.assert_allclose(history.saved[j, :, 0], u, rtol=1e-7, atol=1e-9)
        y = np.zeros(26)
        for k in range(25):
            y[k + 1] = 0.7 * y[k] + 0.3 * u[k]
        u = P @ np.linalg.lstsq(P, u + 0.5 * (r - y)[1:], rcond=None)[0]


def test_the_limit_of_a_law_on_a_basis_is_also_that_of_what_the_functions_make():
    F = np.vander(np.linspace(0, 1, 12), 3)
    P = F @ np.linalg.pinv(F)
    at = int(np.argmax(np.abs(P).sum(axis=1)))  # there the fit of a signal of size 1 is largest
    task = Task(np.concatenate([[0.0], np.sign(P[at])]), DT)
    scheme = OnBasis(PIDType(gamma_p=1.0, limit=1.05), GivenBasis(F))
    known = scheme.initial_memory(task)
    trial = scheme.record(np.zeros((12, 1)), task.reference, task)
    limits = jax.jit(lambda: scheme.limits(task, known, trial))()
    fit = P @ np.sign(P[at])
    assert np.max(np.abs(limits["scheme.limit"].signal)) < 1.05 < np.max(np.abs(fit))
    np.testing.assert_allclose(limits["fitted.limit"].signal[:, 0], fit, rtol=1e-7)


@pytest.mark.thorough
def test_columns_that_make_each_other_leave_no_rounding_in_what_is_fitted():
    """Along a circle the velocity of an axis is the position of the other one."""
    angle, random = 0.2 * np.arange(25), np.random.default_rng(3)
    circle = np.stack([np.cos(angle) - 1, np.sin(angle)], axis=1)
    basis = PolynomialBasis((0, 1), coupled=True)
    X = np.asarray(columns(basis, circle, inputs=2)).reshape(48, 8)
    X = X / np.linalg.norm(X, axis=0)
    assert np.linalg.matrix_rank(X) == 6
    u, start = random.standard_normal((24, 2)), random.standard_normal(8)
    expected = X @ np.linalg.lstsq(X, u.ravel(), rcond=1e-9)[0]

    @jax.jit
    def made(u, circle, start):
        return basis.signal(fitted(basis, u, circle, DT, theta=start), circle, DT, 2).ravel()

    np.testing.assert_allclose(made(u, circle, start), expected, atol=1e-11)
    with jax.enable_x64(False):
        np.testing.assert_allclose(made(u, circle, start), expected, atol=1e-5)


@pytest.mark.thorough
@pytest.mark.parametrize("places", [0, 3])
def test_a_certificate_of_a_law_on_a_basis_does_not_depend_on_the_units_of_its_parameters(places):
    """Those of jerk and snap are so small that they counted as nothing beside the input."""
    basis = PolynomialBasis()
    if places:  # which keep what was learned, so that the law remembers
        map_ = PositionBasis(Splines(low=0.0, high=1.0, count=places, degree=1))
        basis = JoinedBasis((basis, map_))
    task, law = moved(16), OnBasis(PIDType(gamma_p=1.5), basis)
    X = np.asarray(columns(law.basis, task.reference))[:, 0]
    Q, _ = np.linalg.qr(X / np.linalg.norm(X, axis=0))
    H, r, u = lifted(MODEL, 16), np.asarray(task.reference)[1:, 0], np.zeros(16)
    for _ in range(2000):
        u = Q @ (Q.T @ (u + 1.5 * (r - H @ u)))
    found = outlooks(drawn_machines(Machine(MODEL), {}, {}), law, task)
    rms = np.sqrt(np.mean((r - H @ u) ** 2))
    np.testing.assert_allclose(found.floor, rms, rtol=1e-6)
    units = view_of(law, task).units
    assert bool(places) == (units is not None)
    units = view_of(SCHEMES["higher_order_leaky_limited"], task).units
    np.testing.assert_allclose(units, np.repeat((1.0, 0.2, 0.1, 0.4, 0.2), task.N), rtol=1e-12)


def test_what_was_learned_serves_a_reference_of_another_length_and_size():
    scheme = BasisFunctions(PolynomialBasis((0, 1, 2)), MODEL)
    learned = learn(Machine(MODEL), scheme, moved(120), 3).memory
    other = moved(200, height=-2.0)
    first, anew = (
        learn(Machine(MODEL), scheme, other, 1, memory=known)
        for known in (learned, jax.jit(lambda: scheme.initial_memory(other))())
    )
    assert float(first.rms[0, 0]) < 0.01 * float(anew.rms[0, 0])
    again = jax.eval_shape(lambda: scheme.started(learned, np.zeros((200, 1)), other))
    assert again.theta.shape == (3,)


STARTABLE = [name for name, scheme in SCHEMES.items() if scheme.learns]


@pytest.mark.thorough(
    but=[
        "ffdl_sign",
        "norm_optimal",
        "milc",
        "p_type_over_pid",
        "two_step",
        "basis_functions",
        "at_samples",
    ]
)
@pytest.mark.parametrize("name", STARTABLE)
def test_any_law_starts_from_an_input(name):
    _, scheme, task = case(name)
    try:
        blank = jax.eval_shape(lambda: scheme.feedforward(scheme.initial_memory(task), task))
    except ValueError:
        return  # it learns no input
    u = np.random.default_rng(1).standard_normal(blank.shape)

    @jax.jit
    def of(scheme):
        memory = started(scheme, scheme.initial_memory(task), u, task)
        return scheme.unlimited().feedforward(memory, task)

    played = np.asarray(of(scheme))
    filtered = any(hasattr(part.scheme, "filter") for part in with_all_parts(scheme, task))
    if not isinstance(scheme, OnBasis | BasisFunctions) and not filtered:
        np.testing.assert_allclose(played, u, **ALGEBRA)
    assert np.all(np.isfinite(played))
    assert np.max(np.abs(played)) > 0


def test_a_law_of_higher_order_stays_where_it_was_started():
    scheme, task = SCHEMES["higher_order_leaky_limited"], moved(10)
    scheme = dataclasses.replace(scheme, alpha=(0.7, 0.2, 0.1), limit=None)
    u = np.ones((10, 1))
    known = started(scheme, scheme.initial_memory(task), u, task)
    kept = scheme.learn(known, scheme.record(u, np.zeros((11, 1)), task))
    np.testing.assert_allclose(kept.u, u, **ALGEBRA)
    within = OnOutputs(scheme, (0,))
    jax.tree.map(np.testing.assert_array_equal, started(within, known, u, task), known)
    blank = started(within, within.initial_memory(task), u, task)
    jax.tree.map(np.testing.assert_array_equal, blank, known)


def test_the_first_trial_of_a_warm_start_is_within_the_limit_of_the_law():
    laws = PIDType(limit=0.3), ConstrainedNormOptimal(MODEL, w_r=1.0, limit=0.3)
    for law in (*laws, WithFeedback(laws[0], PID())):
        scheme, task = WarmStart(law, PolynomialBasis((0,)), theta=[5.0]), moved(40)
        memory = scheme.initial_memory(task)
        assert np.max(np.abs(scheme.feedforward(memory, task))) == 0.3
        free = scheme.unlimited()
        assert np.max(np.abs(free.feedforward(free.initial_memory(task), task))) > 4


def test_the_descent_meets_the_conditions_of_the_optimum():
    rng = np.random.default_rng(3)
    X, y = rng.standard_normal((40, 6)), rng.standard_normal(40)
    G, g = X.T @ X / 40, X.T @ y / 40
    tried = np.array([1.0, 0.3, 0.01])
    for theta, penalty in zip(_path(G, g, tried), tried * np.max(np.abs(g)), strict=True):
        slope = g - G @ theta
        active = theta != 0
        np.testing.assert_allclose(slope[active], penalty * np.sign(theta[active]), atol=1e-9)
        assert np.all(np.abs(slope) <= penalty + 1e-9)


def test_a_sparse_basis_keeps_what_the_trials_have_in_common():
    rng, basis = np.random.default_rng(5), PolynomialBasis((0, 1, 2, 3, 4), coulomb=1.0)
    trials = []
    for height, samples in ((1.0, 200), (0.4, 150), (-0.7, 200), (1.5, 150), (0.8, 200)):
        r = np.asarray(moved(samples, height).reference)
        u = np.asarray(columns(basis, r)) @ np.array([0.0, 0.05, 2e-4, 0.0, 0.0, 0.1])
        trials.append((r, u + 0.01 * rng.standard_normal(u.shape)))
    found = select_basis(basis, trials, dt=DT, penalties=np.geomspace(1, 1e-3, 16))
    assert found.names == ("velocity", "acceleration", "friction")
    np.testing.assert_allclose(found.theta, [0.05, 2e-4, 0.1], rtol=0.03)
    assert found.counts[0] <= 1
    assert found.counts[-1] >= 3
    assert found.errors[found.chosen] <= found.errors.min() + found.doubt[np.argmin(found.errors)]


SELECTED = {"basis": PolynomialBasis((1, 2)), "trials": [(np.arange(6.0) ** 2, np.ones(5))] * 3}
NOT_SELECTED = {
    "allowed are two or more": {"trials": []},
    "do not fit": {"trials": [(np.zeros(5), np.zeros(5))] * 2},
    "the inputs are zero": {"trials": [(np.arange(6.0), np.zeros(5))] * 2},
    "not finite": {"trials": [(np.arange(6.0), np.full(5, np.nan))] * 2},
    "falling": {"penalties": [0.1, 0.2]},
    "not linear": {"basis": RationalBasis(PolynomialBasis())},
}
test_a_selection_that_cannot_be_is_refused = refused(
    NOT_SELECTED, lambda given: select_basis(**SELECTED | given, dt=DT)
)
REFUSED = {
    "allowed are different ones of 0": lambda: PolynomialBasis((1, 5)),
    "leaves no function": lambda: PolynomialBasis(()),
    "of the 1 functions": lambda: SelectedBasis(PolynomialBasis((1,)), (1,)).check(moved(9)),
    r"needs \(9, 1, m\)": lambda: GivenBasis(np.ones((4, 2))).check(moved(9)),
    "for velocity": lambda: BasisFunctions(PolynomialBasis((1,)), MODEL, start=(1, 2)).check(
        moved(9)
    ),
    r"theta has shape \(\)": lambda: WarmStart(PIDType(), PolynomialBasis((1,)), 1.0).check(
        moved(9)
    ),
}
test_what_does_not_fit_is_named = refused(REFUSED)


@pytree
class Saw(Basis):
    """A user's own basis: the reference, and its square."""

    def names(self, outputs, inputs):
        return ("r", "r^2")

    def columns(self, r, dt, inputs):
        return jnp.stack([r[:-1], r[:-1] ** 2], axis=-1)


@pytest.mark.thorough
def test_a_users_own_basis_and_given_functions_are_the_same():
    task = moved(20)
    given, e = GivenBasis(np.asarray(Saw().columns(task.reference, DT, 1))), np.ones((21, 1))
    found = []
    for basis in (Saw(), given):
        scheme = BasisFunctions(basis, MODEL)
        scheme.check(task)
        trial = scheme.record(np.zeros((20, 1)), e, task)
        memory = jax.jit(lambda one: one.learn(one.initial_memory(task), trial))(scheme)  # noqa: B023
        found.append(scheme.feedforward(memory, task))
    np.testing.assert_allclose(*found, **ALGEBRA)
    assert np.max(np.abs(found[0])) > 0.1
