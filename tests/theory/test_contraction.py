"""The matrix-free learning map equals dense matrices, the lifted form and simulated learning."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from cases import DT, PLANTS, task_for

from jaxilc.filters import ZeroPhaseFIR
from jaxilc.learning import Disturbance, Machine, learn
from jaxilc.plants import StateSpace
from jaxilc.pytree import named_leaves
from jaxilc.schemes import (
    CFDLMFAILC,
    CFDLMFAPC,
    FFDLMFAILC,
    PID,
    ConstrainedNormOptimal,
    Filtered,
    GradientILC,
    PIDType,
    TwoStep,
    WithFeedback,
)
from jaxilc.signals import Task
from jaxilc.theory import contraction, lifted
from jaxilc.theory.spectrum import largest

MACHINE = Machine(PLANTS["arx"])
SCHEMES = {
    "p_type": PIDType(gamma_p=0.5),
    "filtered": Filtered(PIDType(gamma_p=0.5, lead=3), ZeroPhaseFIR((0.4, 0.2, 0.1))),
    "cfdl": CFDLMFAILC(phi0=0.3, lam=0.3, mu=0.05, rho=0.9, reset="sign"),
    "ffdl": FFDLMFAILC(phi0=(0.5, -0.1, 0.2, 0.05), lam=0.1, mu=0.05, rho=0.9, reset="sign"),
    "ilc_mfapc": WithFeedback(
        PIDType(gamma_p=0.5, lead=1), CFDLMFAPC(P=5, lam=20.0, eta=0.9, mu=1.0, phi0=0.2)
    ),
}


def errors(trial):
    return trial.e[1:, 0]


def top(J):
    """Return the largest singular value of a dense matrix."""
    J = np.asarray(J)
    return np.sqrt(scipy.linalg.eigvalsh(J.T @ J, subset_by_index=[J.shape[1] - 1] * 2)[0])


@jax.jit
def maps(machine, scheme, task):
    """Return both maps, as dense matrices and without a matrix."""
    memory = contraction.learned_memory(machine, scheme, task)
    learning = contraction.learning_map(machine, scheme, task, memory)
    error = contraction.error_map(machine, scheme, task, memory)
    dense = jax.jacfwd(learning.f)(learning.at), jax.jacfwd(error.f)(error.at)[0]
    return dense, (contraction.singular_value(*learning), contraction.singular_value(*error))


@pytest.mark.thorough(but=["p_type"])
@pytest.mark.parametrize("name", ["p_type", "ffdl", "ilc_mfapc"])
def test_singular_values_are_those_of_the_dense_matrix(name):
    """Of the whole memory and of the error, of linear and adaptive schemes, at N = 200."""
    dense, free = maps(MACHINE, SCHEMES[name], task_for(PLANTS["arx"], 200))
    for J, found in zip(dense, free, strict=True):
        np.testing.assert_allclose(found.value, top(J), rtol=1e-6)
        assert found.residual <= 1e-6 * found.value
        assert found.steps < min(J.shape) or name == "ilc_mfapc", (
            "the matrix should not have to be exhausted"
        )
        np.testing.assert_allclose(np.linalg.norm(J @ found.direction), found.value, rtol=1e-6)
        np.testing.assert_allclose(np.linalg.norm(found.direction), 1.0, rtol=1e-9)


@pytest.mark.thorough
def test_the_error_map_of_a_linear_law_is_the_lifted_one():
    """It is I - G L, also in a closed loop, and its powers are those over several trials."""
    for machine, scheme in (
        (Machine(PLANTS["mimo"]), PIDType(gamma_p=(2.0, 1.0), lead=2)),
        (MACHINE, WithFeedback(PIDType(gamma_p=0.5, gamma_d=0.3), PID(kp=0.8, ki=20.0))),
    ):
        task = task_for(machine.plant, 50)
        found = contraction.error_map(machine, scheme, task, trials=3)
        J = jax.jit(jax.jacfwd(found.f))(found.at)
        M = lifted.error_map(
            lifted.lifted_plant(machine, scheme, task), lifted.learning_law(scheme, task).L
        )
        for j in range(3):
            np.testing.assert_allclose(J[j], np.linalg.matrix_power(M, j + 1), atol=1e-12)
    growth = contraction.singular_value(*found, row=2).value
    np.testing.assert_allclose(growth, lifted.transient_growth(M, 3)[2], rtol=1e-6)


@pytest.mark.thorough
def test_an_adaptive_scheme_does_what_its_derivative_says():
    """A small disturbance acts from the fourth trial on, in the direction that grows most.

    The simulated change of the next error is sigma_max times as large. With the estimate frozen,
    the change would be clearly different.
    """
    scheme, task, eps = SCHEMES["cfdl"], task_for(PLANTS["arx"], 60), 1e-6
    before = learn(MACHINE, scheme, task, 3).memory

    def following(v):
        """Return e of trials 4 and 5 with an output disturbance -v from trial 4 on.

        e_4 then changes by v, since the law is not a feedback.
        """
        machine = dataclasses.replace(
            MACHINE, disturbance=Disturbance(output=jnp.pad(-v, (1, 0))[:, None])
        )
        return learn(machine, scheme, task, 2, memory=before, save=errors).saved

    found = contraction.error_map(MACHINE, scheme, task, before)
    sigma = jax.jit(lambda at: contraction.singular_value(found.f, at))(found.at)
    changes = (following(eps * sigma.direction) - following(-eps * sigma.direction)) / (2 * eps)
    np.testing.assert_allclose(changes[0], sigma.direction, atol=1e-8)
    np.testing.assert_allclose(
        np.linalg.norm(changes[1]) / np.linalg.norm(changes[0]), sigma.value, rtol=1e-5
    )
    frozen = lifted.mfailc_map(
        lifted.lifted_plant(MACHINE, None, task), before.phi[0], scheme.lam, scheme.rho
    )
    assert abs(lifted.sigma_max(frozen) / sigma.value - 1) > 1e-3


def test_names_and_weights_of_the_memory():
    """The weight of a leaf scales rows and columns of the Jacobian, and names select its blocks."""
    task, scheme = task_for(PLANTS["arx"], 20), SCHEMES["ffdl"]
    memory = contraction.learned_memory(MACHINE, scheme, task)
    assert set(named_leaves(memory)) == {"u", "y", "phi[0]", "phi[1]", "phi[2]", "phi[3]", "seen"}

    @partial(jax.jit, static_argnames="leaves")
    def jacobian(weights=None, leaves=None):
        found = contraction.learning_map(
            MACHINE, scheme, task, memory, weights=weights, leaves=leaves
        )
        return jax.jacfwd(found.f)(found.at), found.at

    ones = dict.fromkeys(("u", "y", "phi", "phi[1]"), 1.0)
    plain, at = map(np.asarray, jacobian(ones))
    assert plain.shape == (20 + 21 + 80,) * 2
    np.testing.assert_array_equal(at[:20], memory.u[:, 0])
    u, y, phi = np.split(np.arange(121), [20, 41])
    block, _ = jacobian(ones, ("u", "y"))
    np.testing.assert_allclose(block, plain[:41, :41], atol=1e-13)
    weighted, _ = jacobian(ones | {"u": 3.0, "phi[1]": 0.5})
    scale = np.ones(121)
    scale[u], scale[phi[20:40]] = 3.0, 0.5
    np.testing.assert_allclose(weighted, plain * scale[:, None] / scale, atol=1e-13)
    default, at = map(np.asarray, jacobian())
    size = np.sqrt(np.mean(np.square(at[y])))
    np.testing.assert_allclose(
        [np.sqrt(np.mean(np.square(at[i]))) for i in (u, phi[:20])], size, rtol=0.2
    )
    assert abs(top(default) / top(plain) - 1) > 0.01
    for bad, value in (("leaves", ("v",)), ("weights", {"learning.u": 1.0})):
        with pytest.raises(ValueError, match=r"not in this memory; known: u, y, phi\[0\]"):
            contraction.learning_map(MACHINE, scheme, task, memory, **{bad: value})
    for of in (contraction.learning_map, contraction.contracting):
        with pytest.raises(ValueError, match=r"weights\['y'\] = 0 .* allowed range \(0, inf\)"):
            of(MACHINE, scheme, task, memory, weights={"u": 1.0, "y": 0.0})
    with pytest.raises(ValueError, match="PID has no floating leaf"):
        contraction.learning_map(MACHINE, PID(kp=0.1), task)


def normal_matrix(block, n=120):
    """Return a matrix with this block, and small eigenvalues beside it, in some basis."""
    rng = np.random.default_rng(0)
    basis = np.linalg.qr(rng.normal(size=(n, n)))[0]
    D = np.diag(rng.uniform(-0.5, 0.5, n))
    D[: len(block), : len(block)] = block
    return basis @ D @ basis.T


@jax.jit
def both(M):
    def f(x):
        return M @ x + 1.0

    return contraction.singular_value(f, jnp.ones(len(M))), contraction.spectral_radius_of(
        f, jnp.ones(len(M)), steps=60
    )


@pytest.mark.thorough
@pytest.mark.parametrize(
    "block",
    [
        0.95 * np.array([[np.cos(1.0), -np.sin(1.0)], [np.sin(1.0), np.cos(1.0)]]),
        np.diag([-0.95]),
        0.95 * np.eye(3),
        np.diag([0.95, 0.2, *np.zeros(118)]),
        np.diag([0.95, -0.95]),
    ],
    ids=["complex pair", "negative", "repeated", "low rank", "opposite signs"],
)
def test_iterations_on_given_matrices(block):
    singular, radius = both(normal_matrix(block))
    np.testing.assert_allclose([singular.value, radius.value], 0.95, rtol=1e-9)
    assert singular.residual < 1e-6
    assert radius.doubt < 1e-6


@jax.jit
@jax.vmap
def largest_of(values):
    times = lambda v: values * v  # noqa: E731
    return largest(times, times, jnp.zeros(500), 500, steps=60, tolerance=0.0)


def test_singular_values_of_very_different_sizes_have_a_bound():
    """The residual underflows in few steps, which says nothing of a larger one not met yet."""
    rates = np.array([0.02, 1.0, 30.0, 300.0])
    found = largest_of(0.5 * np.exp(-rates[:, None] * np.arange(500.0)))
    assert np.all(found.value <= 0.5 * (1 + 1e-12))
    assert np.all((found.bound >= 0.5) & (found.bound <= 0.5 * 1.1))


@pytest.mark.thorough
def test_the_zero_map_and_a_map_that_is_not_square():
    singular, radius = both(np.zeros((120, 120)))
    assert (float(singular.value), float(radius.value)) == (0.0, 0.0)
    M = np.random.default_rng(0).normal(size=(30, 50))
    for matrix in (M, M.T):
        found = jax.jit(
            lambda at, matrix=matrix: contraction.singular_value(lambda x: matrix @ x, at)
        )(jnp.zeros(matrix.shape[1]))
        np.testing.assert_allclose(found.value, top(matrix), rtol=1e-9)


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["filtered", "ffdl"])
def test_spectral_radius_is_that_of_the_dense_matrix(name):
    task = task_for(PLANTS["arx"], 50)
    leaves = ("u", "y") if name == "ffdl" else None

    @jax.jit
    def found(machine, scheme):
        learning = contraction.learning_map(machine, scheme, task, leaves=leaves)
        return contraction.spectral_radius_of(*learning, steps=200), jax.jacfwd(learning.f)(
            learning.at
        )

    radius, J = found(MACHINE, SCHEMES[name])
    dense = np.max(np.abs(np.linalg.eigvals(J)))
    assert abs(radius.value - dense) < max(1e-6, radius.doubt)


LAG = Machine(StateSpace([[0.3]], [[0.7]], [[1.0]], dt=DT))


def test_designed_to_contract_and_designed_to_diverge():
    """On a lag an adaptive map contracts near its fixed point, to which learning converges.

    A law with too high a gain does neither, and its error grows.
    """
    task = task_for(LAG.plant, 30)
    scheme = CFDLMFAILC(phi0=0.7, lam=0.1, rho=0.9, mu=0.1, reset="book")
    history = learn(LAG, scheme, task, 60)
    assert history.max_error[-1, 0] < 1e-10
    attracted = contraction.attracting(LAG, scheme, task, history.memory, steps=200)
    assert attracted.verdict == "holds"
    assert "near" in attracted.theorem
    error = contraction.error_contracting(LAG, scheme, task, history.memory)
    assert error.verdict == "holds"
    ratios = history.rms[5:20, 0] / history.rms[4:19, 0]
    assert np.all(ratios <= error.value * (1 + 1e-6))
    input_map = contraction.contracting(
        LAG, PIDType(gamma_p=0.8), task, leaves=("u",), weights={"u": 1.0}
    )
    M = lifted.input_map(lifted.lifted_plant(LAG, None, task), 0.8 * np.eye(30))
    np.testing.assert_allclose(input_map.value, lifted.sigma_max(M), rtol=1e-9)
    assert input_map.verdict == "holds"
    assert "everywhere" in input_map.theorem
    wild = PIDType(gamma_p=3.5)
    of_input = {"leaves": ("u",), "weights": {"u": 1.0}}
    assert contraction.contracting(LAG, wild, task, **of_input).verdict == "fails"
    assert contraction.error_contracting(LAG, wild, task).verdict == "fails"
    errors = learn(LAG, wild, task, 30).rms[:, 0]
    assert errors[-1] > 100 * errors[0]


@pytest.mark.thorough
def test_away_from_its_fixed_point_an_adaptive_map_claims_nothing():
    task = task_for(LAG.plant, 30)
    scheme = CFDLMFAILC(phi0=0.7, lam=0.1, rho=0.9, mu=0.1, reset="book")
    found = contraction.contracting(LAG, scheme, task)
    assert found.verdict == "not claimed"
    assert [p.name for p in found.broken] == ["map affine, or taken at its fixed point"]


@pytest.mark.thorough
def test_estimates_that_nothing_resets_are_neutral():
    """At a fixed point without error nothing changes phi, which is an eigenvalue 1."""
    task = task_for(LAG.plant, 20)
    scheme = CFDLMFAILC(phi0=0.7, lam=0.1, rho=0.9, mu=0.1, reset="none")
    memory = learn(LAG, scheme, task, 60).memory
    whole = contraction.attracting(LAG, scheme, task, memory, steps=100)
    np.testing.assert_allclose(whole.value, 1.0, atol=1e-6)
    assert whole.verdict != "holds"
    rest = contraction.attracting(LAG, scheme, task, memory, leaves=("u", "y"), steps=100)
    assert rest.verdict == "holds"


def test_what_only_tells_of_the_past_is_no_state():
    """A counter alone would be an eigenvalue 1, and no such law would ever be seen to attract."""
    plant, tight = PLANTS["discrete"], {"w_r": 0.1, "limit": 3.0}
    pendulum = PLANTS["pendulum"]
    for machine, scheme, known in (
        (plant, GradientILC(plant), 1),
        (plant, ConstrainedNormOptimal(plant, **tight), 1),
        (pendulum, TwoStep(pendulum, w_alpha=0.1, **tight), 2),
    ):
        task = task_for(machine, 6)

        def at(machine=machine, scheme=scheme, task=task):
            memory = scheme.initial_memory(task)
            return contraction.learning_map(Machine(machine), scheme, task, memory).at

        assert jax.eval_shape(at).size == known * task.N


@pytest.mark.thorough
def test_the_map_of_gradient_learning_on_a_nonlinear_machine():
    """Its derivative at the fixed point is that of NumPy's pendulum, by complex and real steps."""
    model, N, step, w_s = PLANTS["pendulum"], 6, 40.0, 1e-3
    machine = dataclasses.replace(model, mass=0.022)
    task = Task(0.15 * np.sin(np.arange(N + 1) / 3)[:, None], dt=DT)

    def motion(of, u):
        x, v, y = 0.0, 0.0, []
        inertia = of.inertia + of.mass * of.length**2
        for torque in u:
            pull = of.gravity * of.mass * of.length * np.sin(x)
            x, v = x + DT * v, v + DT * (torque - of.damping * v - pull) / inertia
            y.append(x)
        return np.array(y)

    def following(u):
        steps = 1e-20j * np.eye(N)
        G = np.stack([motion(model, u + row).imag / 1e-20 for row in steps], axis=1)
        return u + step * (G.T @ (task.reference[1:, 0] - motion(machine, u)) - w_s * u)

    u = np.zeros(N)
    for _ in range(3000):
        u = following(u)
    by_hand = np.stack([following(u + h) - following(u - h) for h in 1e-4 * np.eye(N)]).T / 2e-4
    scheme = GradientILC(model, step=step, w_s=w_s)
    memory = scheme.initial_memory(task)._replace(u=jnp.asarray(u)[:, None])
    found = contraction.learning_map(Machine(machine), scheme, task, memory)
    J, moved = jax.jit(lambda at: (jax.jacfwd(found.f)(at), found.f(at) - at))(found.at)
    assert np.max(np.abs(moved)) < 1e-9 * np.max(np.abs(found.at))
    np.testing.assert_allclose(J, by_hand, atol=1e-8)
    assert 0.5 < np.max(np.abs(np.linalg.eigvals(J))) < 0.99


@pytest.mark.thorough
def test_a_value_above_1_that_is_no_eigenvalue_is_not_told_to_be_one():
    """The one eigenvalue is 1 - 2.5 * 0.3 = 0.25; of a hundred steps the value is above 4."""
    plant = StateSpace([[0.5, 1.0], [0.0, 0.5]], [[0.3], [0.5]], [[1.0, 0.0]], dt=1e-3)
    task = Task(np.sin(np.pi * np.arange(301) / 300) ** 2, dt=1e-3)
    found = contraction.attracting(Machine(plant), PIDType(gamma_p=2.5), task)
    assert found.value > 4
    assert found.verdict == "not claimed"
