"""The lifted form equals matrices written by hand, and its predictions equal simulation."""

from fractions import Fraction

import jax
import numpy as np
import pytest
import scipy.linalg
from cases import ARX, DT, PLANTS, task_for
from dense import lifted_difference
from refusals import refused

from jaxilc.filters import ZeroPhaseButterworth, ZeroPhaseFIR
from jaxilc.learning import Actuator, Disturbance, Machine, Sensor, learn
from jaxilc.plants import StateSpace
from jaxilc.schemes import CFDLMFAC, CFDLMFAILC, PID, Filtered, OnReference, PIDType, WithFeedback
from jaxilc.theory import lifted
from jaxilc.theory.condition import condition, premise
from jaxilc.theory.linearity import linear_law, linear_trial
from jaxilc.theory.spectrum import norm_of, radius_with_doubt
from jaxilc.theory.trials import played

N = 40
ARX_MACHINE, TASK = Machine(PLANTS["arx"]), task_for(PLANTS["arx"], N)
LOOP = PID(kp=0.8, ki=20.0, kd=2e-4, tau=1e-3)


def errors(trial):
    return trial.e[1:], trial.u


def learned(trial):
    return trial.u - trial.signals["feedback"] if "feedback" in trial.signals else trial.u


def everything(trial):
    return trial


def run(machine, scheme, task, trials):
    """Return simulated errors (J, N n_y) and inputs (J, N n_u)."""
    return tuple(
        np.asarray(s).reshape(trials, -1)
        for s in learn(machine, scheme, task, trials, save=errors).saved
    )


def test_open_loop_matrix_is_the_toeplitz_matrix_of_the_impulse_response():
    G = lifted.lifted_plant(ARX_MACHINE, None, TASK)
    np.testing.assert_allclose(G, lifted_difference(*ARX, N), rtol=1e-12, atol=1e-15)
    by_columns = lifted.lifted_plant(ARX_MACHINE, None, TASK, time_invariant=False)
    np.testing.assert_allclose(by_columns, G, rtol=1e-12, atol=1e-15)


@pytest.mark.thorough
def test_closed_loop_matrix_is_P_over_1_plus_C_P():
    """u_fb[k] uses e[k], one sample before the row of y[k+1].

    So G = (I + P C S)^-1 P, with S the delay of one sample.
    """
    P, delay = lifted_difference(*ARX, N), np.eye(N, k=-1)
    # the derivative s[k] = (tau s[k-1] + e[k] - e[k-1]) / (tau + dt), in powers of the delay
    slope = np.linalg.solve((LOOP.tau + DT) * np.eye(N) - LOOP.tau * delay, np.eye(N) - delay)
    C = LOOP.kp * np.eye(N) + LOOP.ki * DT * np.tri(N) + LOOP.kd * slope
    G = lifted.lifted_plant(ARX_MACHINE, LOOP, TASK)
    np.testing.assert_allclose(
        G, np.linalg.solve(np.eye(N) + P @ C @ delay, P), rtol=1e-10, atol=1e-13
    )
    np.testing.assert_array_equal(
        lifted.lifted_plant(ARX_MACHINE, WithFeedback(PIDType(gamma_p=1.0), LOOP), TASK), G
    )
    assert linear_trial(ARX_MACHINE, LOOP, TASK).held


def test_the_adjoint_is_the_plant_run_backward_in_time():
    """G^T = J G J, where J reverses time, of a time-invariant plant of one input and output."""
    v = np.random.default_rng(0).normal(size=(N, 1))
    answer = jax.jit(lambda u: played(ARX_MACHINE, None, TASK, None, u).y[1:])
    (pulled,) = jax.vjp(answer, np.zeros((N, 1)))[1](v)
    np.testing.assert_allclose(pulled, answer(v[::-1])[::-1], rtol=1e-12, atol=1e-14)


@pytest.mark.thorough
def test_a_nonlinear_loop_is_linearised_where_it_is_asked_to_be():
    """With adaptive feedback and a limit the matrix is not Toeplitz.

    Its columns are finite differences, and the premise of linearity does not hold.
    """
    machine = Machine(PLANTS["arx"], actuator=Actuator(limit=1.0))
    feedback, about = CFDLMFAC(phi0=0.3, lam=0.5), 0.4 * np.sin(np.arange(N))[:, None]
    G = lifted.lifted_plant(machine, feedback, TASK, about=about)
    limited = np.diag(G) == 0.0
    assert 3 < np.sum(limited) < N - 3, "the limit should act, though not always"
    np.testing.assert_allclose(np.diag(G)[~limited], ARX[1][0], rtol=1e-12)
    play = jax.jit(lambda w: played(machine, feedback, TASK, (), w).y[1:])
    for k in (0, 7, N - 1):
        step = np.zeros((N, 1))
        step[k] = 1e-6
        np.testing.assert_allclose(
            G[:, k], (play(about + step) - play(about - step))[:, 0] / 2e-6, rtol=1e-6, atol=1e-8
        )
    broken = linear_trial(machine, feedback, TASK)
    assert (broken.held, broken.share_broken) == (False, 1.0)


@pytest.mark.thorough
def test_noise_is_left_out_and_what_repeats_is_not():
    d = 0.1 * np.ones((N + 1, 1))
    machine = Machine(
        PLANTS["arx"],
        sensor=Sensor(noise=0.1),
        disturbance=Disturbance(output=d, input_noise=0.2, output_noise=0.3),
    )
    noisy, quiet = (lifted.lifted_plant(one, None, TASK) for one in (machine, ARX_MACHINE))
    np.testing.assert_allclose(noisy, quiet, atol=1e-15)
    at_rest = played(machine, None, TASK, None, np.zeros((N, 1))).y[1:]
    np.testing.assert_allclose(at_rest, d[1:], atol=1e-15)


LAWS = {
    "p": PIDType(gamma_p=0.6),
    "pid_lead": PIDType(gamma_p=0.6, gamma_i=0.02, gamma_d=0.4, lead=3),
    "loop": WithFeedback(PIDType(gamma_p=0.6, gamma_d=0.4, lead=1), LOOP),
    "series": OnReference(PIDType(gamma_p=0.5), PID(kp=0.8, ki=20.0)),
    "mimo": PIDType(gamma_p=(2.0, 1.0), lead=1),
}


@pytest.mark.parametrize("law", LAWS)
def test_the_error_of_the_next_trial_is_predicted(law):
    """e_{j+1} = (I - G L) e_j, to rounding: the law of the scheme, the loop of the simulator."""
    scheme, plant = LAWS[law], PLANTS["mimo" if law == "mimo" else "arx"]
    machine, task = Machine(plant), task_for(plant, N)
    e, _ = run(machine, scheme, task, 4)
    G = lifted.lifted_plant(machine, scheme, task)
    M = lifted.error_map(G, lifted.learning_law(scheme, task).L)
    assert np.max(np.abs(e[1] - e[0])) > 1e-2
    for j in range(3):
        np.testing.assert_allclose(e[j + 1], M @ e[j], atol=1e-12 * np.max(np.abs(e)))
    assert linear_law(scheme, task).held
    assert linear_trial(machine, scheme, task).held


FILTERED = {
    "butterworth": Filtered(
        PIDType(gamma_p=0.6, lead=2, leak=0.1), ZeroPhaseButterworth(70.0, order=3)
    ),
    "two_filters_in_a_loop": WithFeedback(
        Filtered(
            Filtered(PIDType(gamma_p=0.6), ZeroPhaseFIR((0.5, 0.25))),
            ZeroPhaseButterworth(150.0, padding=0),
        ),
        LOOP,
    ),
}


@pytest.mark.thorough
@pytest.mark.parametrize("law", FILTERED)
def test_the_change_of_the_input_is_predicted(law):
    """Of what is learned, u_{j+2} - u_{j+1} = Q (keep - L G)(u_{j+1} - u_j)."""
    scheme = FILTERED[law]
    u = np.asarray(learn(ARX_MACHINE, scheme, TASK, 5, save=learned).saved)[..., 0]
    G, law = lifted.lifted_plant(ARX_MACHINE, scheme, TASK), lifted.learning_law(scheme, TASK)
    steps = np.diff(u, axis=0)
    assert np.max(np.abs(steps[2])) > 1e-2
    for j in range(3):
        np.testing.assert_allclose(
            steps[j + 1], lifted.input_map(G, law.L, keep=law.keep) @ steps[j], atol=1e-12
        )


learn_once = jax.jit(lambda scheme, memory, trial: scheme.learn(memory, trial))


@pytest.mark.parametrize("lead", [0, 2])
def test_the_error_under_mfailc_is_predicted_with_its_gain_of_each_trial(lead):
    scheme = CFDLMFAILC(phi0=0.3, lam=0.2, mu=0.05, rho=0.8, reset="sign", lead=lead)
    trials = 7
    record = learn(ARX_MACHINE, scheme, TASK, trials, save=everything).saved
    e, memory, phi = np.asarray(record.e)[:, 1:, 0], scheme.initial_memory(TASK), []
    record = record._replace(dt=np.full(trials, DT))
    for j in range(trials - 1):
        memory = learn_once(scheme, memory, jax.tree.map(lambda x, j=j: x[j], record))
        phi.append(np.asarray(memory.phi[0]))
    assert np.ptp(phi[-1]) > 0.05, "the estimate should have moved"
    G = lifted.lifted_plant(ARX_MACHINE, None, TASK)
    maps = lifted.mfailc_map(G, np.array(phi), scheme.lam, scheme.rho, lead=lead)
    for j in range(trials - 1):
        np.testing.assert_allclose(e[j + 1], maps[j] @ e[j], atol=1e-12)
    growth = lifted.transient_growth(maps)
    assert np.all(np.linalg.norm(e[1:], axis=1) <= growth * np.linalg.norm(e[0]) * (1 + 1e-12))
    np.testing.assert_allclose(growth[1], np.linalg.norm(maps[1] @ maps[0], 2))


STATIC_GAIN = Machine(StateSpace([[0.0]], [[2.0]], [[1.0]], dt=DT))  # y[k+1] = 2 u[k]


@pytest.mark.parametrize(("gamma", "factor"), [(0.3, 0.4), (0.8, 0.6), (1.2, 1.4)])
def test_a_static_gain_by_hand(gamma, factor):
    """sigma_max, rho and the ratio of errors in every trial are 1 - 2 gamma."""
    task = task_for(STATIC_GAIN.plant, N)
    found = lifted.learning_conditions(STATIC_GAIN, PIDType(gamma_p=gamma), task)
    for name in ("monotone", "asymptotic", "monotone_error"):
        np.testing.assert_allclose(
            [found[name].value, found[name].margin], [factor, 1 - factor], atol=1e-12
        )
        assert found[name].verdict == ("holds" if factor < 1 else "fails")
    e, _ = run(STATIC_GAIN, PIDType(gamma_p=gamma), task, 5)
    np.testing.assert_allclose(
        np.linalg.norm(e[1:], axis=1) / np.linalg.norm(e[:-1], axis=1), factor, rtol=1e-9
    )


def test_convergent_in_the_end_but_not_before():
    """The error grows by orders of magnitude before it falls, as the transient growth says."""
    task, scheme = TASK, PIDType(gamma_p=4.0)
    found = lifted.learning_conditions(ARX_MACHINE, scheme, task)
    assert (found["monotone"].verdict, found["asymptotic"].verdict) == ("fails", "holds")
    M = lifted.error_map(
        lifted.lifted_plant(ARX_MACHINE, None, task), lifted.learning_law(scheme, task).L
    )
    growth = lifted.transient_growth(M, 12)
    e, _ = run(ARX_MACHINE, scheme, task, 13)
    size = np.linalg.norm(e, axis=1)
    assert np.all(size[1:] <= growth * size[0] * (1 + 1e-9))
    assert size[12] > 100 * size[0]
    assert lifted.transient(M, 12).verdict == "fails"
    assert lifted.transient(M, 12, allowed=2 * growth[-1]).verdict == "holds"


def test_a_number_on_the_diagonal_is_known_up_to_its_rounding():
    """1 - gamma C B by fractions, for a gamma with which it is -1 to within rounding."""
    rng = np.random.default_rng(11)
    for _ in range(100):
        B, C = rng.uniform(0.5, 1.0, (2, 4))
        C /= C @ B
        exact = 1 - 2 * sum(Fraction(b) * Fraction(c) for b, c in zip(B, C, strict=True))
        value, doubt = radius_with_doubt(np.diag([0.5, 1 - 2 * (C @ B)]))
        assert abs(Fraction(value) - abs(exact)) <= Fraction(doubt) < Fraction(1, 10**13)


def test_spectral_radius_of_triangular_and_permuted_matrices_is_exact():
    """A general eigenvalue routine has an error in the first digit."""
    task = task_for(PLANTS["arx"], 100)
    M = lifted.error_map(lifted.lifted_plant(ARX_MACHINE, None, task), 8.0 * np.eye(100))
    exact = 1 - 8.0 * ARX[1][0]
    order = np.random.default_rng(0).permutation(100)
    for matrix in (M, M.T, M[np.ix_(order, order)]):
        np.testing.assert_allclose(lifted.spectral_radius(matrix), exact, rtol=1e-12)
    twisted = scipy.linalg.block_diag(M, [[0.6, 0.8], [-0.8, 0.6]]) + np.eye(102, k=-2) * 1e-3
    np.testing.assert_allclose(
        lifted.spectral_radius(np.stack([twisted, 2 * twisted])), [1.0, 2.0], rtol=1e-12
    )
    full = np.linalg.qr(np.random.default_rng(1).normal(size=(100, 100)))[0]
    rotated = full @ M @ full.T
    assert abs(np.max(np.abs(np.linalg.eigvals(rotated))) - exact) > 0.1
    assert lifted.asymptotic(rotated).verdict == "not claimed"
    assert lifted.asymptotic(M).verdict == "holds"
    mild = full @ scipy.linalg.toeplitz([0.5, 0.3, *np.zeros(98)], np.zeros(100)) @ full.T
    assert sum(radius_with_doubt(mild)) > 1, (
        "a Jordan block, whose eigenvalue 0.5 no first-order estimate can tell from 1"
    )
    several = lifted.asymptotic(np.stack([mild, rotated, 2 * np.eye(100)]))
    assert several.verdict.tolist() == ["holds", "not claimed", "fails"]


def test_a_map_of_whole_numbers_is_that_of_numbers():
    shift, growing = np.eye(4, k=1, dtype=int), [[1, 5], [0, -2]]
    assert lifted.spectral_radius(growing) == 2.0
    assert [lifted.asymptotic(M).verdict for M in (shift, growing)] == ["holds", "fails"]


@pytest.mark.thorough
def test_nothing_is_claimed_where_a_premise_is_broken():
    tight = Machine(PLANTS["arx"], actuator=Actuator(limit=0.1))
    for machine, scheme, broken in (
        (tight, PIDType(gamma_p=0.3), "no limit is met in any trial to come"),
        (ARX_MACHINE, PIDType(gamma_p=0.3, limit=0.1), "no limit is met in any trial to come"),
        (
            Machine(PLANTS["arx"], sensor=Sensor(resolution=1e-3)),
            PIDType(gamma_p=0.3),
            "machine and feedback linear",
        ),
        (ARX_MACHINE, CFDLMFAILC(phi0=0.3), "learning law linear and the same in each trial"),
    ):
        found = lifted.learning_conditions(machine, scheme, TASK)["monotone"]
        assert found.verdict == "not claimed"
        assert not found.holds
        assert [p.name for p in found.broken] == [broken]


def test_verdicts_of_a_batch():
    """Each plant has a verdict from its own premises; samples and trials are averaged."""
    held = np.array([[True, True], [True, False], [True, True], [True, True]])
    p = premise("constant sign", held, plants=True)
    np.testing.assert_array_equal(p.share_broken, [0.0, 0.5, 0.0, 0.0])
    found = condition(np.array([0.5, 0.5, 1.0, np.nan]), "a theorem", premises=[p])
    np.testing.assert_array_equal(found.verdict, ["holds", "not claimed", "fails", "not claimed"])
    np.testing.assert_array_equal(found.margin, [0.5, 0.5, 0.0, np.nan])
    whole = premise("constant sign", held)
    assert (whole.held, whole.share_broken) == (False, 0.125)
    assert condition(0.5, "a theorem", premises=[whole]).verdict == "not claimed"
    assert condition(0.5, "a theorem").holds


BAD = {
    "about has shape": lambda: lifted.lifted_plant(ARX_MACHINE, None, TASK, about=np.zeros(3)),
    "learns no feedforward": lambda: lifted.learning_law(LOOP, TASK),
    "phi has shape": lambda: lifted.mfailc_map(np.eye(4), np.zeros(3), 1.0),
    r"lead = 5 is outside its allowed range \[0, 4\]": lambda: lifted.mfailc_map(
        np.eye(4), np.ones(4), 1.0, lead=5
    ),
    "error_map: L has shape": lambda: lifted.error_map(np.eye(4), np.eye(3)),
    "transient_growth: M": lambda: lifted.transient_growth(np.eye(4)),
    "the task has 2 inputs": lambda: lifted.lifted_plant(
        ARX_MACHINE, None, task_for(PLANTS["mimo"], N)
    ),
}
test_what_does_not_fit_is_named = refused(BAD)


@pytest.mark.parametrize("power", [-300, -160, 0, 150, 307])
def test_a_norm_is_the_largest_singular_value_at_any_scale(power):
    rng = np.random.default_rng(power + 400)
    for shape in ((1, 1), (7, 7), (3, 40), (40, 3), (60, 60)):
        M = np.tril(rng.standard_normal(shape)) * 10.0 ** rng.uniform(-8, 0, shape)
        M = M / np.max(np.abs(M)) * 10.0**power
        np.testing.assert_allclose(norm_of(M), np.linalg.svd(M)[1][0], rtol=1e-13)
    assert norm_of(np.zeros((3, 2))) == 0.0
    assert norm_of(np.array([[1.0, np.inf]])) == norm_of(np.array([[np.nan, 1.0]])) == np.inf
