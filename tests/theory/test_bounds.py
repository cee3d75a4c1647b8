"""The bounds d1 and d2 of Cao 2019 from the plant are tested against dense NumPy and runs.

They are met exactly on a static plant, and never claimed where a premise does not hold.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dense import lifted, lifted_difference

import jaxilc
from jaxilc import Actuator, Disturbance, Machine, Sensor, Task
from jaxilc.plants import DifferenceEquation, StateSpace, TimeVaryingStateSpace
from jaxilc.schemes import (
    CFDLMFAILC,
    CFDLMFAPC,
    FFDLMFAILC,
    PFDLMFAILC,
    PID,
    Ladder,
    PIDType,
    StopWhen,
    WithFeedback,
)
from jaxilc.theory import (
    BoundsWatch,
    bounds_of,
    checked,
    checked_machines,
    frozen_growth,
    ppd_bound,
    pseudo_gradient_of,
)
from jaxilc.uncertainty import Uniform, draw

bounds_of, frozen_growth = jax.jit(bounds_of), jax.jit(frozen_growth)
pseudo_gradient_of = jax.jit(pseudo_gradient_of, static_argnames=("L_y", "L_u"))
DT, N = 1e-3, 50
TASK = Task(reference=0.3 + np.sin(2 * np.pi * np.arange(N + 1) / N), dt=DT)
SCHEME = CFDLMFAILC(lam=0.5, rho=0.8, eta=0.7, mu=0.2, phi0=0.4, reset="sign")
ARX = ((1.2, -0.5), (1.0, -1.3))  # y(k+1) = 1.2 y(k) - 0.5 y(k-1) + u(k) - 1.3 u(k-1)


def static_machine(gain, **parts):
    """Return the machine y(k+1) = gain u(k)."""
    return Machine(DifferenceEquation((0.0,), jnp.stack([gain]), dt=DT), **parts)


def dynamic_machine(a=ARX[0], b=ARX[1]):
    return Machine(DifferenceEquation(jnp.stack(a), jnp.stack(b), dt=DT))


def window_rows(G, k, L_y, L_u):
    """Return the rows that make D H(k) of D u: past outputs, then inputs from u(k) on."""
    rows = [G[k - 1 - i] if k - 1 - i >= 0 else np.zeros(len(G)) for i in range(L_y)]
    rows += [np.eye(len(G))[k - i] if k - i >= 0 else np.zeros(len(G)) for i in range(L_u)]
    return np.array(rows)


def played(trial):
    return trial.y, trial.u


def run(machine, scheme, trials=12, task=TASK):
    """Return what is watched, the outputs and the inputs."""
    history = jaxilc.learn(machine, scheme, task, trials, save=played, watch=BoundsWatch())
    found = {name: np.asarray(value) for name, value in history.watched.items()}
    return found, *(np.asarray(signal)[..., 0] for signal in history.saved)


def watched(machine, scheme, trials=12):
    return run(machine, scheme, trials)[0]


# From the plant
# --------------------------------------------------------------------------------------------------


@pytest.mark.thorough(but=["3-1"])
@pytest.mark.parametrize(("L_y", "L_u"), [(0, 1), (0, 3), (1, 1), (2, 2), (3, 1)])
def test_the_pseudo_gradient_is_the_best_fit_to_the_rows_of_the_trial_map(L_y, L_u):
    found = pseudo_gradient_of(dynamic_machine(), TASK, L_y=L_y, L_u=L_u)
    G = lifted_difference(*ARX, N)
    np.testing.assert_allclose(found.total, np.sum(G**2, axis=1), rtol=1e-10)
    for k in (0, 1, 3, 20, N - 1):
        W = window_rows(G, k, L_y, L_u)
        Phi = np.linalg.lstsq(W.T, G[k], rcond=None)[0]
        rest = np.sum((G[k] - W.T @ Phi) ** 2)
        np.testing.assert_allclose(found.rest[k], rest, atol=1e-9 * found.total[k])
        np.testing.assert_allclose(np.asarray(found.Phi[k]) @ W, Phi @ W, atol=1e-6)
    np.testing.assert_allclose(found.Phi[:, L_y], 1.0, rtol=1e-12)  # dy(k+1)/du(k) is b[0]
    if (L_y, L_u) == (2, 2):
        np.testing.assert_allclose(found.Phi[-1], [*ARX[0], *ARX[1]], rtol=1e-6)
        assert np.max(np.asarray(found.rest / found.total)[3:]) < 1e-12


@pytest.mark.thorough
def test_the_derivative_of_a_plant_that_is_not_linear_is_that_along_the_trial():
    """The rows of the trial map of a saturating lag agree with its Jacobian, column by column."""
    machine, u = Machine(Saturating()), 0.7 * np.sin(np.arange(20) / 3.0)

    def outputs(u):
        x, y = 0.0, []
        for k in range(20):
            x = machine.plant.step(x, u[k], DT)
            y.append(x)
        return jnp.stack(y)

    J = np.asarray(jax.jacrev(outputs)(jnp.asarray(u)))
    task = Task(reference=np.zeros(21), dt=DT)
    found = pseudo_gradient_of(machine, task, u=u[:, None])
    np.testing.assert_allclose(found.Phi[:, 0], np.diag(J), rtol=1e-10)
    np.testing.assert_allclose(found.total, np.sum(J**2, axis=1), rtol=1e-10)
    np.testing.assert_allclose(found.rest, np.sum(np.tril(J, -1) ** 2, axis=1), atol=1e-12)
    bounds = bounds_of(machine, SCHEME, task, u=u[:, None])
    assert (float(bounds.linear), float(bounds.claimed)) == (0.0, 0.0)
    assert bounds.ppd_low < bounds.ppd_high


@jaxilc.pytree.fields.pytree
class Saturating(jaxilc.plants.Plant):
    def initial_state(self):
        return jnp.zeros(1)

    def step(self, x, u, dt):
        return 0.8 * jnp.tanh(x) + (1.0 + 0.5 * jnp.cos(x)) * u

    def output(self, x):
        return x


def by_hand(low, high, scheme):
    """Return M1 and d2 over a fine grid of phi and of the estimates between start and phi."""
    lam, rho, start = float(scheme.lam), float(scheme.rho), float(scheme.phi0)
    phi = np.linspace(low, high, 41)[:, None]
    estimate = np.linspace(min(start, low), max(start, high), 20001)[None]
    product = phi * estimate / (lam + estimate**2)
    return product.min(), np.abs(1 - rho * product).max()


@pytest.mark.parametrize("gain", [1.2, -1.2, 0.3])
@pytest.mark.parametrize("phi0", [0.4, -0.4, 3.0, -3.0])
@pytest.mark.parametrize("lam", [0.5, 0.05])
def test_d2_and_M1_are_those_of_a_fine_grid_of_estimates(gain, phi0, lam):
    scheme = dataclasses.replace(SCHEME, phi0=phi0, lam=lam)
    bounds = bounds_of(static_machine(gain), scheme, TASK)
    np.testing.assert_allclose([bounds.M1, bounds.d2], by_hand(gain, gain, scheme), rtol=1e-6)
    premises = gain * phi0 > 0 and lam > gain**2 / 4
    assert float(bounds.claimed) == premises
    if premises:
        np.testing.assert_allclose(bounds.d2, 1 - 0.8 * bounds.M1, rtol=1e-12)
        assert bounds.d2 < 1


def test_d1_and_the_closed_bound_are_as_printed():
    bounds = bounds_of(static_machine(1.2), dataclasses.replace(SCHEME, epsilon=0.1), TASK)
    d1 = 1 - 0.7 * 0.01 / (0.2 + 0.01)
    np.testing.assert_allclose(bounds.d1, d1, rtol=1e-12)
    closed = [d1 ** (j - 1) * 0.8 + 2 * 1.2 / (1 - d1) for j in range(1, 6)]
    np.testing.assert_allclose(ppd_bound(bounds, 5), closed, rtol=1e-10)


@pytest.mark.thorough
def test_what_no_paper_proves_is_not_a_number():
    machine = static_machine(1.2)
    for scheme in (
        FFDLMFAILC(),
        PFDLMFAILC(),
        CFDLMFAPC(),
        PID(kp=0.1),
        WithFeedback(PIDType(gamma_p=0.2), CFDLMFAPC()),
    ):
        bounds = bounds_of(machine, scheme, TASK)
        assert np.isnan(bounds.d2)
        assert np.isnan(bounds.M1)
        assert float(bounds.claimed) == 0.0
        assert float(bounds.ppd_low) == float(bounds.ppd_high) == pytest.approx(1.2)
        estimates = isinstance(scheme, FFDLMFAILC | CFDLMFAPC)
        assert np.isnan(bounds.d1) != estimates
    # a step of the estimator above 1 overshoots: |1 - eta h^2 / (mu + h^2)| comes up to eta - 1
    wide = bounds_of(machine, FFDLMFAILC(eta=1.9, mu=1e-12), TASK)
    np.testing.assert_allclose(wide.d1, 0.9, rtol=1e-12)


@pytest.mark.thorough
def test_in_single_precision_a_small_reaction_to_earlier_inputs_leaves_nothing_claimed():
    """The second output is 2000, of which the pole leaves 0.2 in a third that should be 0.001."""
    with jax.enable_x64(False):
        machine = Machine(StateSpace([[1e-4]], [[1.0]], [[1.0]], dt=DT))
        task = Task(reference=np.float32([0.0, 2000.0, 0.001, 0.0]), dt=DT)
        found, y, _ = run(machine, SCHEME, 2, task)
    e = np.abs(np.asarray(task.reference)[:, 0] - y)
    assert e[1, 2] > 10 * e[0, 2]
    assert found["claimed"] == 0.0
    np.testing.assert_allclose(found["left_out"], (2 / 3) * 1e-8, rtol=1e-3)


# The frozen law
# --------------------------------------------------------------------------------------------------


@pytest.mark.thorough(but=["a2-b2"])
@pytest.mark.parametrize(("a", "b"), [ARX, ((0.3,), (0.8,)), ((0.3,), (-0.8,))])
def test_d2_is_the_spectral_radius_of_the_frozen_law_and_sigma_its_growth(a, b):
    scheme = dataclasses.replace(SCHEME, phi0=0.5 * b[0])
    phi0 = float(scheme.phi0)
    E = np.eye(N) - lifted_difference(a, b, N) * (0.8 * phi0 / (0.5 + phi0**2))
    machine = dynamic_machine(a, b)
    bounds = bounds_of(machine, scheme, TASK)
    np.testing.assert_allclose(bounds.radius, np.max(np.abs(np.diag(E))), rtol=1e-12)
    sigma = frozen_growth(machine, scheme, TASK).value
    np.testing.assert_allclose(sigma, np.linalg.svd(E)[1][0], rtol=1e-6)
    assert bounds.d2 >= bounds.radius
    assert float(bounds.alone) == 0.0
    assert float(bounds.claimed) == 0.0
    assert sigma > bounds.d2  # what the diagonal does not show


@pytest.mark.thorough
def test_the_radius_of_ffdl_is_read_off_its_diagonal_too():
    scheme = FFDLMFAILC(lam=0.5, rho=0.9, phi0=(0.3, 0.1, 0.8, -0.2), reset="sign", eta=1e-30)
    machine = dynamic_machine()

    def after(e):
        """Return the error of the second trial, of the first one e."""
        task = Task(reference=jnp.concatenate([jnp.zeros(1), e]), dt=DT)
        return jaxilc.learn(machine, scheme, task, 2).final.e[1:, 0]

    E = jax.jit(jax.vmap(after, out_axes=1))(jnp.eye(N))
    found = bounds_of(machine, scheme, TASK).radius
    np.testing.assert_allclose(found, np.max(np.abs(np.linalg.eigvals(np.asarray(E)))), rtol=1e-6)


# What a run shows
# --------------------------------------------------------------------------------------------------


def test_a_static_plant_meets_d2_exactly_from_the_exact_estimate():
    scheme = dataclasses.replace(SCHEME, phi0=1.2)
    found = watched(static_machine(1.2), scheme)
    assert found["claimed"] == 1.0
    d2 = 1 - 0.8 * 1.44 / (0.5 + 1.44)
    np.testing.assert_allclose(found["d2"], d2, rtol=1e-12)
    for name, tolerance in (("worst", 1e-6), ("norm", 1e-9), ("median", 1e-3), ("high", 1e-3)):
        np.testing.assert_allclose(found[f"contraction_{name}"][1:], d2, rtol=tolerance)
    assert np.all(np.isnan(found["contraction_worst"][:1])), "the first trial has none before it"


@pytest.mark.thorough
def test_the_bound_holds_at_every_sample_where_it_is_claimed():
    rng = np.random.default_rng(3)
    claimed = exact = 0
    for _ in range(20):
        gain = rng.choice([-1, 1]) * rng.uniform(0.2, 2)
        scheme = CFDLMFAILC(
            lam=rng.uniform(0.1, 2),
            rho=rng.uniform(0.2, 1),
            eta=rng.uniform(0.2, 1),
            mu=rng.uniform(0.01, 1),
            phi0=np.sign(gain) * rng.uniform(0.1, 3),
            reset=str(rng.choice(["sign", "book", "none"])),
        )
        _, y, _ = run(static_machine(gain), scheme, 8)
        e = np.abs(np.asarray(TASK.reference)[None, 1:, 0] - y[:, 1:])
        bounds = bounds_of(static_machine(gain), scheme, TASK)
        assert float(bounds.claimed) == (float(scheme.lam) > gain**2 / 4)
        # from a product of the whole box, so also without lam > b^2 / 4
        assert np.all(e[1:] <= float(bounds.d2) * e[:-1] + 1e-12)
        claimed += float(bounds.claimed)
        exact += np.max(e[1] / e[0]) > float(bounds.d2) * (1 - 1e-9)
    assert claimed >= 5
    assert exact >= 5, "the bound is met where the start is the least effective estimate"


def test_nothing_is_claimed_of_a_run_that_goes_on_from_the_memory_of_another_machine():
    """The bound was claimed, and an estimate that was not of this machine broke it."""
    scheme = CFDLMFAILC(phi0=0.5, lam=0.2, mu=0.1, epsilon=1e-6)
    small = dataclasses.replace(scheme, phi0=0.05)
    own, near = (jaxilc.learn(static_machine(g), scheme, TASK, 3).memory for g in (0.5, 0.45))
    far = jaxilc.learn(static_machine(0.05), small, TASK, 3).memory
    fresh = scheme.initial_memory(TASK)
    for memory, claimed in ((fresh, 1), (own, 1), (near, 0), (far, 0)):
        on = {"memory": memory, "watch": BoundsWatch()}
        found = jaxilc.learn(static_machine(0.5), scheme, TASK, 3, **on).watched
        assert found["claimed"] == claimed
    assert np.min(found["share_kept"][1:]) < 1


@pytest.mark.thorough
def test_the_error_of_the_estimate_falls_by_d1_and_keeps_its_closed_bound():
    scheme, machine = dataclasses.replace(SCHEME, epsilon=0.02, phi0=0.9), static_machine(1.2)
    bounds, memory, errors, moved = bounds_of(machine, scheme, TASK), None, [], []
    for j in range(1, 5):
        history = jaxilc.learn(machine, scheme, TASK, 1, memory=memory, first=j)
        before, memory = memory, history.memory
        errors.append(np.abs(np.asarray(memory.phi[0])[:, 0] - 1.2))
        if before is not None:
            moved.append(np.abs(np.asarray(memory.u - before.u))[:, 0])
    assert np.all(np.array(errors) <= np.asarray(ppd_bound(bounds, 4))[:, None])
    for last, now, du in zip(errors[:-1], errors[1:], moved, strict=True):
        excited = du >= 0.02
        assert np.any(excited)
        assert np.all(now[excited] <= float(bounds.d1) * last[excited] + 1e-12)


def quantile(x, share):
    return np.sort(x)[int(np.ceil(share * len(x))) - 1]


def test_the_statistics_of_the_run_are_those_of_its_signals():
    machine, trials = dynamic_machine(), 6
    scheme = dataclasses.replace(SCHEME, epsilon=0.05)
    found, y, u = run(machine, scheme, trials)
    e = np.abs(np.asarray(TASK.reference)[None, 1:, 0] - y[:, 1:])
    du, dy = np.abs(np.diff(u, axis=0)), np.diff(y[:, 1:], axis=0)
    ratio = e[1:] / e[:-1]
    by_name = {
        "contraction_norm": np.linalg.norm(e[1:], axis=1) / np.linalg.norm(e[:-1], axis=1),
        "contraction_worst": ratio.max(axis=1),
        "share_lipschitz": np.mean(np.abs(dy) <= du + 1e-12, axis=1),  # b = 1
        "share_sign": np.mean(dy * np.diff(u, axis=0) > 0, axis=1),
        "share_excited": np.mean(du >= 0.05, axis=1),
    }
    for name, expected in by_name.items():
        np.testing.assert_allclose(found[name][1:], expected, rtol=1e-9, err_msg=name)
    for j in range(trials - 1):
        median, high = quantile(ratio[j], 0.5), quantile(ratio[j], 0.95)
        np.testing.assert_allclose(found["contraction_median"][j + 1], median, rtol=5e-4)
        np.testing.assert_allclose(found["contraction_high"][j + 1], high, rtol=5e-4)
    assert 0 < np.min(by_name["share_sign"]) < 1
    assert 0 < np.min(by_name["share_lipschitz"]) < 1
    assert 0 < np.min(by_name["share_excited"]) < 1


@pytest.mark.thorough
def test_the_premise_of_ffdl_is_that_of_its_window():
    scheme = FFDLMFAILC(lam=0.5, mu=0.5, phi0=(0.3, 0.0, 0.8, 0.0), reset="sign")
    whole = watched(dynamic_machine(), scheme, 5)
    assert whole["left_out"] < 1e-12
    np.testing.assert_allclose(whole["b"], np.linalg.norm([*ARX[0], *ARX[1]]), rtol=1e-6)
    assert np.all(whole["share_lipschitz"][1:] == 1.0), "the plant lies within the window"
    assert np.all(np.isnan(whole["share_kept"])), "no bound of the error is known"
    short = dataclasses.replace(scheme, L_y=1, L_u=1, phi0=(0.3, 0.8))
    part = watched(dynamic_machine(), short, 5)
    assert part["left_out"] > 0.01
    assert np.min(part["share_lipschitz"][1:]) < 1.0


def varying(gains, pole):
    """Return the machine x(k+1) = pole x(k) + gains[k] u(k), y = x."""
    B = np.asarray(gains)[:, None, None]
    plant = TimeVaryingStateSpace(np.full_like(B, pole), B, np.ones_like(B), dt=DT)
    return Machine(plant)


@pytest.mark.thorough(but=["1.0", "3.0"])
@pytest.mark.parametrize("phi0", [0.2, 1.0, 3.0])
def test_a_gain_that_varies_along_the_trial_has_an_interval_and_its_bound_holds(phi0):
    gains = 1.0 + 0.4 * np.sin(np.arange(N) / 5.0)
    scheme = dataclasses.replace(SCHEME, phi0=phi0, lam=0.6)
    found = watched(varying(gains, 0.0), scheme)
    np.testing.assert_allclose([found["ppd_low"], found["ppd_high"]], [gains.min(), gains.max()])
    expected = by_hand(gains.min(), gains.max(), scheme)
    np.testing.assert_allclose([found["M1"], found["d2"]], expected, rtol=1e-6)
    assert found["claimed"] == 1.0
    assert np.nanmin(found["share_kept"]) == np.nanmin(found["share_lipschitz"]) == 1.0
    # the start acts least where the plant does, or half as much as it could: not exact, not far
    assert np.nanmax(found["contraction_worst"]) > 0.8 * found["d2"]
    bounds = bounds_of(varying(gains - 1.0, 0.0), scheme, TASK)
    assert float(bounds.signs) == float(bounds.claimed) == 0.0, "its sign changes"


@pytest.mark.thorough
def test_the_rows_of_a_plant_that_varies_are_those_of_its_trial_map():
    gains = 1.0 + 0.4 * np.sin(np.arange(N) / 5.0)
    machine = varying(gains, 0.6)
    found, G = pseudo_gradient_of(machine, TASK), lifted(machine.plant, N)
    np.testing.assert_allclose(found.Phi[:, 0], gains, rtol=1e-12)
    np.testing.assert_allclose(found.rest, np.sum(np.tril(G, -1) ** 2, axis=1), rtol=1e-10)
    one = pseudo_gradient_of(machine, TASK, L_y=1)
    assert np.max(np.asarray(one.rest)) < 1e-10, "y(k+1) = 0.6 y(k) + gain u(k)"


@jaxilc.pytree.fields.pytree
class Twice(CFDLMFAILC):
    """A law of a user's own that plays twice what it learned."""

    def act(self, state, sample):
        return state, 2.0 * sample.row.u


@pytest.mark.parametrize(
    ("premise", "machine", "scheme"),
    [
        ("signs", static_machine(1.2), dataclasses.replace(SCHEME, phi0=-0.4)),
        ("signs", static_machine(1e-6), SCHEME),
        ("damped", static_machine(1.2), dataclasses.replace(SCHEME, lam=0.3)),
        ("alone", dynamic_machine(), SCHEME),
        ("alone", dynamic_machine((1e-12,), (1.2,)), SCHEME),  # more than rounding of an output
        ("printed", static_machine(1.2), dataclasses.replace(SCHEME, limit=0.3)),
        ("printed", static_machine(1.2), dataclasses.replace(SCHEME, lead=2)),
        ("printed", static_machine(1.2), Twice(lam=0.5, phi0=0.4, reset="sign")),
        ("linear", static_machine(1.2, actuator=Actuator(limit=0.3)), SCHEME),
        ("linear", static_machine(1.2, sensor=Sensor(resolution=0.1)), SCHEME),
        ("linear", static_machine(1.2, sensor=Sensor(noise=0.1)), SCHEME),
    ],
)
def test_each_premise_can_break_and_then_nothing_is_claimed(premise, machine, scheme):
    bounds = bounds_of(machine, scheme, TASK)
    assert float(getattr(bounds, premise)) == 0.0
    assert float(bounds.claimed) == 0.0


@pytest.mark.thorough
def test_the_clause_on_small_increments_bursts_by_as_much_as_d2_says():
    """A reset to a start far from phi makes the error grow, where lam < b^2 / 4.

    phi = 1, phi_hat(1) = 0.3, lam = 1e-3: |1 - 0.3 / (0.001 + 0.09)| = 2.30.
    """
    scheme = CFDLMFAILC(lam=1e-3, phi0=0.3, rho=1.0, eta=0.9, mu=1.0, reset="book")
    found = watched(static_machine(1.0), scheme, 40)
    np.testing.assert_allclose(found["d2"], 0.3 / 0.091 - 1, rtol=1e-9)
    worst = np.nanmax(found["contraction_worst"])
    np.testing.assert_allclose(worst, found["d2"], rtol=1e-6)
    assert found["damped"] == 0.0
    assert np.nanmin(found["share_kept"]) == 1.0


@pytest.mark.thorough
def test_a_disturbance_that_repeats_changes_nothing():
    parts = {"disturbance": Disturbance(output=np.linspace(0, 0.2, N + 1)[:, None])}
    found = watched(static_machine(1.2, **parts), SCHEME)
    assert found["claimed"] == 1.0
    assert np.nanmin(found["share_kept"]) == 1.0


@pytest.mark.thorough(but=["3.0"])
@pytest.mark.parametrize("lam", [1.0, 3.0])
def test_lambda_above_b_squared_over_four_guarantees_nothing_on_a_dynamic_plant(lam):
    """On a 60 Hz loop the error falls by a factor of a thousand, and then grows.

    A larger lam only makes the same course take more trials.
    """
    w = 2 * np.pi * 60.0
    servo = StateSpace([[0.0, 1.0], [-w * w, -1.4 * w]], [[0.0], [w * w]], [[1.0, 0.0]])
    task = Task(reference=0.5 - 0.5 * np.cos(2 * np.pi * np.arange(201) / 200), dt=DT)
    scheme = CFDLMFAILC(lam=lam, phi0=0.5, eta=0.01, reset="sign")
    history = jaxilc.learn(Machine(servo), scheme, task, 300, watch=BoundsWatch())
    errors, found = np.asarray(history.rms)[:, 0], history.watched
    best = int(np.argmin(errors))
    assert 15 * lam < best < 25 * lam
    assert errors[best] < 1e-3 * errors[0]
    assert errors[-1] > 10 * errors[best]
    # every premise on weights and signs holds, d2 < 1, and all of it is about the diagonal
    assert float(found["damped"]) == float(found["signs"]) == float(found["linear"]) == 1.0
    assert lam > 1000 * float(found["lam_min"])
    assert found["d2"] < 1
    assert float(found["claimed"]) == 0.0
    assert found["left_out"] > 0.95
    assert np.nanmax(found["contraction_norm"]) > 1


# Batches, derivatives, machines
# --------------------------------------------------------------------------------------------------


@pytest.mark.thorough
def test_gradients_are_those_of_differences():
    @jax.jit
    def values(x):
        lam, phi0, b0, a0 = x
        machine = dynamic_machine((a0, -0.2), (b0, 0.4))
        scheme = dataclasses.replace(SCHEME, lam=lam, phi0=phi0)
        found = bounds_of(machine, scheme, TASK)
        names = ("d2", "M1", "b", "left_out", "radius", "ppd_rest")
        return jnp.stack([getattr(found, name) for name in names])

    at, along = np.array([0.6, 0.5, 0.8, 0.6]), np.array([0.3, -0.7, 0.5, 0.4])
    slopes = jax.jacrev(values)(at) @ along
    step = 1e-5
    expected = (values(at + step * along) - values(at - step * along)) / (2 * step)
    assert np.all(abs(expected) > 1e-6)
    np.testing.assert_allclose(slopes, expected, rtol=1e-6)


@pytest.mark.parametrize(("L_y", "L_u"), [(1, 1), (0, 2)])
def test_the_derivative_of_the_pseudo_gradient_is_that_of_differences(L_y, L_u):
    """Also in the first samples, whose window is empty."""

    def total(b0):
        machine = dynamic_machine(b=(b0, -1.3))
        return jnp.sum(pseudo_gradient_of(machine, TASK, L_y=L_y, L_u=L_u).Phi)

    expected = (total(1 + 1e-5) - total(1 - 1e-5)) / 2e-5
    np.testing.assert_allclose(jax.grad(total)(1.0), expected, rtol=1e-6)


@pytest.mark.thorough
def test_the_watch_changes_no_number_of_the_run_and_nothing_of_its_gradient():
    def last(lam, watch):
        scheme = dataclasses.replace(SCHEME, lam=lam)
        return jaxilc.learn(dynamic_machine(), scheme, TASK, 5, watch=watch).rms[-1, 0]

    plain, beside = (jax.value_and_grad(last)(0.7, watch) for watch in (None, BoundsWatch()))
    np.testing.assert_allclose(plain, beside, rtol=1e-12)


def test_machines_are_counted_and_no_claim_failed():
    machine, uncertainty = static_machine(1.0), {"plant.b[0]": Uniform(0.5, 1.8)}
    drawn = draw(machine, uncertainty, 6)
    gains = np.asarray(drawn["plant.b[0]"])
    found = checked_machines(machine, SCHEME, TASK, 5, uncertainty, drawn)
    damped = int(np.sum(gains**2 / 4 < 0.5))
    assert 0 < damped < 6
    assert found.verdicts == {"holds": damped, "fails": 0, "not claimed": 6 - damped}
    by_name = {p.name: p for p in found.premises}
    assert by_name["lam > b^2 / 4"].held == damped
    assert by_name["y(k+1) depends on u(k) alone"] == ("y(k+1) depends on u(k) alone", 6, 0.0)
    assert 1.0 - 1e-9 <= found.care < 2.0


def test_a_claim_that_fails_is_counted():
    found = watched(static_machine(1.2), SCHEME)
    of_two = {name: np.stack([value, value]) for name, value in found.items()}
    of_two["share_kept"][1, 2] = 0.98
    assert checked(of_two).verdicts == {"holds": 1, "fails": 1, "not claimed": 0}
    of_two["share_kept"][1, 2] = np.nan
    assert checked(of_two).verdicts["fails"] == 1


@pytest.mark.thorough
def test_a_machine_without_an_error_to_compare_is_not_in_the_median():
    still = Task(np.zeros(N + 1), dt=DT)
    moved, rest = (run(static_machine(1.2), SCHEME, 3, of)[0] for of in (TASK, still))
    # phi^2 = lam, in the middle of what is claimed: from trial 2 on the error is 0
    at_once = dataclasses.replace(SCHEME, phi0=0.5, lam=np.nextafter(0.25, 1), rho=1.0, eta=0.5)
    gone = run(static_machine(1.0), at_once, 3, TASK)[0]
    assert gone["contraction_worst"][1] == 0.0
    found = checked({name: value[None] for name, value in gone.items()})
    assert (found.care, found.verdicts["holds"]) == (None, 1)
    both = {name: np.stack([moved[name], rest[name]]) for name in moved}
    alone, mixed, none = (
        checked({name: value[rows] for name, value in both.items()})
        for rows in ([0], [0, 1], [1, 1])
    )
    assert none.care is None
    assert none.verdicts["holds"] == 2
    assert mixed.care == alone.care > 1.0 - 1e-9


@pytest.mark.thorough
def test_a_law_that_does_not_learn_in_every_trial_has_no_claim():
    found = watched(static_machine(1.2), Ladder(SCHEME, repeats=2), 6)
    assert found["claimed"] == 0.0
    np.testing.assert_allclose(found["contraction_worst"][1::2], 1.0, rtol=1e-9)
    stopped = watched(static_machine(1.2), StopWhen(SCHEME, rms=0.4), 10)
    assert stopped["claimed"] == 0.0
    assert np.nanmax(stopped["contraction_norm"]) == pytest.approx(1.0)


def test_on_the_paper_s_motor_weights_with_a_smaller_d2_spoil_learning():
    """The numbers of the page on the papers: d2 and the change of the error in the first step."""
    paper = jaxilc.scenarios.load("cao-2019", frequency=2)
    law = paper.schemes["cfdl-mfailc"]
    phi0, lam = np.array([[law.phi0, law.lam], *((0.0018, x) for x in (1e-3, 3.2e-4, 1e-5))]).T

    @jax.jit
    @jax.vmap
    def first_step(phi0, lam):
        one = dataclasses.replace(law, phi0=phi0, lam=lam)
        rms = jaxilc.learn(paper.machine, one, paper.task, 2).rms[:, 0]
        return bounds_of(paper.machine, one, paper.task).d2, rms[1] / rms[0]

    d2, change = first_step(phi0, lam)
    np.testing.assert_allclose(d2, [1.0001, 0.9968, 0.990, 0.7553], rtol=3e-4)
    digits = [2, 0, 0, -1]  # of the page
    printed = [round(float(x), n) for x, n in zip(change, digits, strict=True)]
    assert printed == [0.92, 7.0, 19.0, 450.0]


@pytest.mark.thorough
def test_channels_are_named():
    task = Task(reference=np.zeros((N + 1, 2)), dt=DT)
    with pytest.raises(ValueError, match="2 inputs and 2 outputs; allowed is one of each"):
        pseudo_gradient_of(static_machine(1.0), task)
