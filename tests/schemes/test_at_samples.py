"""Point-to-point learning, against lifted matrices in NumPy."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import ALGEBRA, DT, MODEL, first_order, follows
from dense import lifted
from refusals import refused

from jaxilc import Machine, Task, learn
from jaxilc.learning.quantities import counted_metrics
from jaxilc.plants import StateSpace
from jaxilc.scenarios.from_file import read_scenario
from jaxilc.schemes import (
    AtSamples,
    BasisFunctions,
    ConstrainedNormOptimal,
    EstimatedDisturbance,
    GradientILC,
    NormOptimal,
    PIDType,
    PolynomialBasis,
    StopWhen,
    TwoStep,
    with_jerk,
)
from jaxilc.schemes.weights import weighed
from jaxilc.signals.task import Trial
from jaxilc.theory.certificates import CONVERGES, DIVERGES, MONOTONE, certify

N = 24
REAL = dataclasses.replace(MODEL, A=[[0.86, 0.1], [-0.15, 0.82]])
POINTS = (8, 15, 24)
WEIGHT = np.isin(np.arange(N + 1), POINTS).astype(float)
TASK = Task(np.where(WEIGHT > 0, np.arange(N + 1) / N, 0.0), DT)  # zero where nothing is asked
TIME, EFFORT = 2e-3, 1e-5  # the weights of the jerk and of the input
SMOOTH = AtSamples(NormOptimal(with_jerk(MODEL), w_s=EFFORT), weight=WEIGHT, jerk_time=TIME)


@pytest.mark.thorough
def test_norm_optimal_learning_comes_to_the_points_with_the_least_effort():
    scheme = AtSamples(NormOptimal(MODEL, w_r=1e-4), weight=WEIGHT)
    history = learn(Machine(REAL), scheme, TASK, 60)
    G = lifted(REAL, N)[np.array(POINTS) - 1]
    H = lifted(MODEL, N)[np.array(POINTS) - 1]
    r = np.asarray(TASK.reference)[list(POINTS), 0]
    # u = H' a with G u = r: the input of the space in which the law learns
    expected = H.T @ np.linalg.solve(G @ H.T, r)
    np.testing.assert_allclose(history.memory.u[:, 0], expected, rtol=1e-6, atol=1e-9)
    exact = learn(Machine(MODEL), scheme, TASK, 60).memory.u[:, 0]
    np.testing.assert_allclose(exact, np.linalg.pinv(H) @ r, rtol=1e-6, atol=1e-9)


H = lifted(MODEL, N)
JERK = np.eye(N) - 3 * np.eye(N, k=-1) + 3 * np.eye(N, k=-2) - np.eye(N, k=-3)
J = (TIME / DT) ** 3 * JERK @ H


def smooth_input(weight, r, kept):
    """Return the input of the least cost of weighted errors, jerk and effort.

    kept: (N,) what the jerk, times its weight, shall be
    """
    P = np.diag(weight[1:])
    cost = H.T @ P @ H + J.T @ J + EFFORT * np.eye(N)
    return np.linalg.solve(cost, H.T @ P @ r[1:] + J.T @ kept)


@pytest.mark.thorough
def test_the_jerk_of_the_motion_is_part_of_the_cost():
    u = learn(Machine(MODEL), SMOOTH, TASK, 2).memory.u[:, 0]
    expected = smooth_input(WEIGHT, np.asarray(TASK.reference)[:, 0], np.zeros(N))
    np.testing.assert_allclose(u, expected, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(
        lifted(with_jerk(MODEL), N)[1::2], JERK @ H / DT**3, rtol=1e-6, atol=1
    )


@pytest.mark.parametrize(("rule", "of"), [("max_error", np.max), ("rms", np.mean)])
def test_a_rule_within_judges_the_points_and_not_the_jerk(rule, of):
    law = SMOOTH.scheme
    saved = learn(Machine(REAL), SMOOTH, TASK, 5, save=lambda trial: (trial.e, trial.y)).saved
    points = np.square(saved[0])[:, 1:, 0] * WEIGHT[1:]
    jerk = (TIME / DT) ** 3 * np.diff(np.pad(saved[1][-1][:, 0], (3, 0), mode="edge"), 3)[1:]
    third = of(points, axis=1)[2]
    assert third < min(of(points, axis=1)[1], 0.9 * of(jerk**2))
    stop = StopWhen(law, **{rule: np.sqrt(third) * (1 + 1e-9)})
    memory = learn(Machine(REAL), dataclasses.replace(SMOOTH, scheme=stop), TASK, 5).memory
    assert (float(memory.frozen), float(memory.trials)) == (1.0, 3.0)


@pytest.mark.thorough
def test_a_sample_that_was_lost_is_no_jump_of_the_motion():
    """Of its jerk and those of the three samples after it the change counts, from what it is."""
    r, lost, u = 1 + np.arange(N + 1) / N, (5, 15, 16), np.linspace(1, -1, N)
    measured = np.where(np.isin(np.arange(N + 1), lost), 0.0, 1.0)
    y = np.append(0.0, H @ u)

    @jax.jit
    def learned(r, y, u):
        memory = SMOOTH.initial_memory(Task(r, DT))._replace(u=u)
        return SMOOTH.learn(memory, weighed(Trial(r, y, u, DT), measured[:, None])).u[:, 0]

    found = learned(r[:, None], y[:, None], u[:, None])
    kept = J @ u * [bool(set(range(k - 3, k + 1)) & set(lost)) for k in range(1, N + 1)]
    np.testing.assert_allclose(
        found, smooth_input(WEIGHT * measured, r, kept), rtol=1e-6, atol=1e-8
    )


LAWS = {
    "norm_optimal": NormOptimal(MODEL, w_r=0.01),
    "gradient": GradientILC(MODEL),
    "constrained": ConstrainedNormOptimal(MODEL, w_r=0.01, limit=50.0),
    "two_step": TwoStep(MODEL, w_y=1e4, w_alpha=1e-3, w_change=1e-3, w_q=1e4, w_r=1e-3),
    "estimated": EstimatedDisturbance(
        NormOptimal(MODEL, w_r=0.01), process_std=1.0, measurement_std=0.1
    ),
    "basis": BasisFunctions(PolynomialBasis((0, 1)), MODEL),
    "p_type": PIDType(gamma_p=2.0, lead=1),
}


@pytest.mark.thorough
@pytest.mark.parametrize("name", LAWS)
def test_what_is_free_is_not_learned_from(name):
    """The references differ where nothing counts, by far more than at the points."""
    scheme = AtSamples(LAWS[name], weight=WEIGHT)
    free = TASK.reference + np.where(WEIGHT > 0, 0.0, 7.0)[:, None]
    if name == "basis":  # its functions follow the reference
        free = TASK.reference
    y, u = np.linspace(0, 0.7, N + 1)[:, None], np.linspace(1, 0, N)[:, None]

    blank = jax.eval_shape(lambda: scheme.initial_memory(TASK))
    memory = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape), blank)

    @jax.jit
    def learned(r):
        return scheme.feedforward(scheme.learn(memory, Trial(r, y, u, DT)), TASK)

    one, other = (np.asarray(learned(jnp.asarray(r))) for r in (TASK.reference, free))
    np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-6)


@pytest.mark.thorough(but=["estimated"])
@pytest.mark.parametrize("name", [name for name in LAWS if name != "p_type"])
def test_where_all_counts_alike_the_law_is_as_without_a_weight(name):
    of = (LAWS[name], AtSamples(LAWS[name], weight=np.ones(N + 1)))
    one, other = (learn(Machine(REAL), scheme, TASK, 3).final.u for scheme in of)
    assert np.max(np.abs(one)) > 0.1
    np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9)


@pytest.mark.thorough(but=["gradient"])
@pytest.mark.parametrize("name", ["gradient", "constrained", "two_step", "estimated"])
def test_every_law_with_a_model_comes_to_the_points(name):
    history = learn(
        Machine(REAL),
        AtSamples(LAWS[name], weight=WEIGHT),
        TASK,
        12,
        save=counted_metrics(TASK, tuple((k * DT, k * DT) for k in POINTS))["counted_max"],
    )
    assert history.saved[-1] < 0.05 * history.saved[0]


def test_waypoints_are_a_batch():
    heights = np.array([0.5, 1.0, -2.0])
    at = np.array([WEIGHT, np.roll(WEIGHT, -2), np.roll(WEIGHT, -5)])

    def errors(height, weight):
        task = dataclasses.replace(TASK, reference=height * weight)
        scheme = AtSamples(NormOptimal(MODEL, w_r=1e-3), weight=weight)
        e = learn(Machine(MODEL), scheme, task, 10).final.e[:, 0]
        return jnp.max(jnp.abs(e * weight))

    found = jax.jit(jax.vmap(errors))(heights, at)
    assert np.all(np.asarray(found) < 1e-3 * np.abs(heights))


@pytest.mark.thorough
def test_windows_are_the_weights_of_their_samples():
    by_window = AtSamples(
        PIDType(gamma_p=1.0), windows=(8 * DT, (15 * DT, 15 * DT), (0.024, 0.024))
    )
    one, other = (
        learn(Machine(REAL), scheme, TASK, 3).rms
        for scheme in (by_window, AtSamples(PIDType(gamma_p=1.0), weight=WEIGHT))
    )
    np.testing.assert_allclose(one, other, **ALGEBRA)
    metrics = counted_metrics(TASK, ((8 * DT, 9 * DT), (0.024, 0.024)))
    e = np.random.default_rng(1).standard_normal((N + 1, 1))
    trial = Trial(e, np.zeros((N + 1, 1)), np.zeros((N, 1)), DT)
    found = jax.jit(lambda trial: {name: of(trial) for name, of in metrics.items()})(trial)
    np.testing.assert_allclose(found["counted_max"], np.abs(e[[8, 9, 24]]).max())
    rms = np.sqrt(np.mean(e[[8, 9, 24]] ** 2))
    np.testing.assert_allclose(found["counted_rms"], rms, rtol=1e-12)


REFUSED = {
    "allowed is one of them": lambda: AtSamples(PIDType()),
    "start <= stop": lambda: AtSamples(PIDType(), windows=((2, 1),)),
    "not a window within": lambda: AtSamples(PIDType(), windows=(9.0,)).check(TASK),
    "this task needs": lambda: AtSamples(PIDType(), weight=np.ones(5)).check(TASK),
    "zero at all samples": lambda: AtSamples(PIDType(), weight=np.zeros(N + 1)).check(TASK),
    "in discrete time": lambda: with_jerk(StateSpace([[-1.0]], [[1.0]], [[1.0]])),
    "as many inputs as outputs": lambda: AtSamples(PIDType(), weight=WEIGHT, jerk_time=1e-3).check(
        TASK
    ),
}
test_what_does_not_fit_is_named = refused(REFUSED)


@pytest.mark.thorough
def test_without_an_effort_the_limit_is_certified_in_the_inputs_that_learning_reaches():
    w_r = 1e-3
    scheme = AtSamples(NormOptimal(MODEL, w_r=w_r), weight=WEIGHT)
    rows = np.array(POINTS) - 1
    G, H = lifted(REAL, N)[rows], lifted(MODEL, N)[rows]
    # u moves along H' alone, and the errors at the points decide: e+ = (I - G L) e
    L = H.T @ np.linalg.inv(H @ H.T + w_r * np.eye(len(rows)))
    Q, _ = np.linalg.qr(H.T)
    found = certify(Machine(REAL), scheme, TASK, 5, {}, {})
    assert found.claim[0] in (MONOTONE, CONVERGES)
    norm = np.linalg.norm(np.eye(3) - Q.T @ L @ G @ Q, 2)
    np.testing.assert_allclose(found.outlook.decay.norm[0], norm, rtol=1e-8)
    expected = H.T @ np.linalg.solve(G @ H.T, np.asarray(TASK.reference)[list(POINTS), 0])
    np.testing.assert_allclose(found.outlook.limit[0], expected, rtol=1e-7, atol=1e-9)
    assert found.broken_promises().size == 0
    # where the plant has another sign than its model, the points are left further and further
    other = dataclasses.replace(REAL, C=-np.asarray(REAL.C))
    assert certify(Machine(other), scheme, TASK, 5, {}, {}).claim[0] == DIVERGES


def test_a_plant_file_has_points(tmp_path):
    file = tmp_path / "points.toml"
    file.write_text(f"""{first_order()}windows = [0.05, [0.09, 0.1]]
{follows(10.0, 0.1)}[schemes.points]
class = "AtSamples"
windows = [0.05, [0.09, 0.1]]
jerk_time = 0.002
scheme = {{ class = "NormOptimal", model = {{ function = "with_jerk", P = "plant" }}, w_r = 1e-3 }}
""")
    scenario = read_scenario(file)
    assert scenario.judged_by == "counted_max"
    assert set(scenario.quantities) == {"counted_max", "counted_rms"}
    file.write_text(
        file.read_text().replace("windows = [0.05, [0.09, 0.1]]\nref", "windows = [[2, 3]]\nref")
    )
    with pytest.raises(ValueError, match="not a window within"):
        read_scenario(file)
