"""Models of a drive are compared with python-control, and DILC and MILC with MILC 2024.

The equations of the paper are written in lifted NumPy matrices.
"""

import dataclasses
from typing import Any, NamedTuple

import control
import dense
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.signal
from cases import ALGEBRA, DRIVE, DT
from dense import relative
from refusals import refused

from jaxilc.filters import inverse, output_ratio
from jaxilc.learning import Actuator, Keep, Machine, learn, measured_trial
from jaxilc.plants import BallScrewDrive, StateSpace, cascade, direct_model, multivariable_model
from jaxilc.schemes import PID, MultivariableILC, NormOptimal, OnOutputs, PIDType, WithFeedback
from jaxilc.schemes.weights import weighed
from jaxilc.signals import Task, Trial
from jaxilc.theory import frequency, lifted
from jaxilc.theory.certificates import printed_conditions

N, TRIALS = 100, 35  # 5 blocks of 7 trials; of an even number each would be compiled twice
GAIN = 6.0  # C_P [V/mm]
KEEP = Keep(("y", "u", "signals"))

# Models of the drive
# --------------------------------------------------------------------------------------------------

P_M = control.tf([0.05, 0.03], [1.0, -1.6, 0.65], DT)
P_Z = control.tf([0.3, 0.1, 0.05], [1.0, -0.9, 0.35], DT)  # biproper
DRIVE_OF_BLOCKS = cascade(P_M, P_Z, DT)
C_P = {"gain": 0.4, "pi": control.tf([0.5, -0.45], [1.0, -1.0], DT)}


def impulse(system):
    """Return the impulse response (n_y, n_u, N) of a system, from its feedthrough on."""
    u = np.zeros((system.ninputs, system.ninputs, N))
    u[range(system.ninputs), range(system.ninputs), 0] = 1.0
    answers = [
        control.forced_response(control.ss(system), DT * np.arange(N), one, squeeze=False).outputs
        for one in u
    ]
    return np.stack(answers, axis=1)


def system_of(model):
    return control.ss(*(np.asarray(M) for M in (model.A, model.B, model.C)), 0.0, DT)


def of_model(model):
    return impulse(system_of(model))


def blocks(controller):
    """Return the impulse responses of P_M S, S, P_M P_Z S and C P_M P_Z S."""
    m, z = control.ss(P_M), control.ss(P_Z)
    c = (
        control.ss([], [], [], controller, DT)
        if np.isscalar(controller)
        else control.ss(controller)
    )
    motor, left = control.feedback(m, c), control.feedback(1, control.series(c, m))
    return [
        impulse(s)[0, 0]
        for s in (motor, left, control.series(motor, z), control.series(c, motor, z))
    ]


def test_a_cascade_is_the_series_of_its_blocks():
    found = of_model(cascade(P_M, P_Z, DT))
    np.testing.assert_allclose(found[0], impulse(P_M)[0], **ALGEBRA)
    np.testing.assert_allclose(found[1], impulse(control.series(P_M, P_Z))[0], **ALGEBRA)
    slow = control.tf([40.0], [1.0, 8.0, 400.0]), control.tf([1.0, 300.0], [1.0, 20.0, 300.0])
    sampled = [control.sample_system(control.ss(s), DT, "zoh") for s in slow]
    found = of_model(
        cascade(slow[0], StateSpace(*(getattr(control.ss(slow[1]), n) for n in "ABC")), DT)
    )
    np.testing.assert_allclose(found[1], impulse(control.series(*sampled))[0], **ALGEBRA)


@pytest.mark.parametrize("controller", C_P)
def test_models_are_those_of_python_control(controller):
    C = C_P[controller]
    motor, left, table, follow = blocks(C)
    np.testing.assert_allclose(of_model(direct_model(C, DRIVE_OF_BLOCKS))[0, 0], table, **ALGEBRA)
    found = of_model(multivariable_model(C, DRIVE_OF_BLOCKS))
    np.testing.assert_allclose(found[:, 0], [motor, table], **ALGEBRA)
    # Row k of the learned reference is r[k+1], which is one sample later than in the paper.
    np.testing.assert_allclose(found[:, 1, 1:], [-left[:-1], follow[:-1]], **ALGEBRA)
    np.testing.assert_array_equal(found[:, 1, 0], 0.0)
    assert np.max(np.abs(follow)) > 0.01


OTHER_DT = control.tf([1.0], [1.0, 0.5], 2e-3)
BROKEN = {
    r"cascade: P_M has the feedthrough \[\[0.3\]\]; allowed is none": lambda: cascade(P_Z, P_M, DT),
    "^P_Z is not a system of one input and one output": lambda: cascade(P_M, 3.0, DT),
    "^P_M is not a system of one input and one output": lambda: cascade(
        control.ss(P_M).append(control.ss(P_M)), P_Z, DT
    ),
    r"P_Z has the sample time 0.002; allowed are 0 \(continuous\) and 0.001 s": lambda: cascade(
        P_M, OTHER_DT, DT
    ),
    "P_M has the sample time True": lambda: cascade(control.tf([1.0], [1.0, 0.5], True), P_Z, DT),
    "C_P has the sample time 0.002": lambda: direct_model(OTHER_DT, DRIVE_OF_BLOCKS),
    "C_P is not a number, nor a system of one input and one output": lambda: direct_model(
        "fast", DRIVE_OF_BLOCKS
    ),
    "direct_model: P is 1 -> 1 with dt = 0.001; allowed is a discrete drive 1 -> 2": lambda: (
        direct_model(1.0, StateSpace([[0.5]], [[1.0]], [[1.0]], dt=DT))
    ),
    "multivariable_model: P is 1 -> 2 with dt = 0;": lambda: multivariable_model(
        1.0, StateSpace([[-5.0]], [[1.0]], [[1.0], [2.0]])
    ),
    r"direct_model: C_P makes the position loop unstable \(spectral radius 1\.\d+\); allowed is at most 1": lambda: (  # noqa: E501
        direct_model(40.0, DRIVE_OF_BLOCKS)
    ),
    "multivariable_model: C_P makes the position loop unstable": lambda: multivariable_model(
        -5.0, DRIVE_OF_BLOCKS
    ),
}
test_blocks_that_do_not_fit_are_refused = refused(BROKEN)


def test_the_gain_of_a_controller_may_be_its_field():
    kp = PID(kp=jnp.asarray(0.5)).kp
    for same in (kp, np.float32(0.5)):
        np.testing.assert_array_equal(
            direct_model(same, DRIVE_OF_BLOCKS).A, direct_model(0.5, DRIVE_OF_BLOCKS).A
        )


# The drive under its position loop, in lifted matrices
# ----------------------------------------------------------------------------

NOMINAL = BallScrewDrive(**DRIVE)
linear = jax.jit(lambda drive: drive.linear(DT))
linear_loop = jax.jit(frequency.linear_loop)
MODEL, REAL = linear(NOMINAL), linear(dataclasses.replace(NOMINAL, table_mass=1.1, stiffness=3.8e4))
DRIVES = {"nominal": (Machine(NOMINAL), MODEL), "real": (Machine(REAL), REAL)}

rise = np.clip((np.arange(N + 1) - 15) / 50, 0.0, 1.0)
DESIRED = 3.0 * (10 * rise**3 - 15 * rise**4 + 6 * rise**5)  # [mm], at rest at both ends
TASK = Task(np.stack([DESIRED, DESIRED], axis=1), dt=DT, inputs=1)
AFTER = DESIRED[1:]
DELAY, UNIT = np.eye(N, k=-1), np.eye(N)
WEIGHTS = {"w_q": 1e3, "w_r": 1e-2, "w_s": 1e-3}
INVERSE = inverse(output_ratio(MODEL))


def plant_of(model):
    """Return lifted P_M and P_T."""
    H = dense.lifted(model, N)
    return H[0::2], H[1::2]


def loop_of(model):
    """Return P_M, P_T and S of v = S (u + C_P r[0..N-1]).

    The feedback gets y one sample after the input that caused it.
    """
    motor, table = plant_of(model)
    return motor, table, np.linalg.inv(UNIT + GAIN * DELAY @ motor)


def direct_matrix(model):
    _, table, S = loop_of(model)
    return table @ S


def multivariable_matrix(model):
    """Return H_M, from rows (u[k], r[k+1]) to rows (y_M - r, y_T)[k+1] (MILC 2024, eq. 27)."""
    motor, table, S = loop_of(model)
    H = np.array(
        [[motor @ S, GAIN * motor @ S @ DELAY - UNIT], [table @ S, GAIN * table @ S @ DELAY]]
    )
    return H.transpose(2, 0, 3, 1).reshape(2 * N, 2 * N)


def gains(H, w_q, w_r, w_s):
    """Return L_u and L_e (MILC 2024, eq. 7 and 8)."""
    unit = np.eye(H.shape[1])
    inverted = np.linalg.inv(w_q * H.T @ H + (w_s + w_r) * unit)
    return inverted @ (w_q * H.T @ H + w_r * unit), w_q * inverted @ H.T


def updated(H, u, e, w_q, w_r, w_s):
    """Return L_u u + L_e e, of which the two gains by themselves would lose digits."""
    normal = w_q * H.T @ H
    return np.linalg.solve(
        normal + (w_s + w_r) * np.eye(len(u)), normal @ u + w_r * u + w_q * H.T @ e
    )


def direct(model=MODEL, **weights):
    learning = NormOptimal(direct_model(GAIN, model), **WEIGHTS | weights)
    return WithFeedback(OnOutputs(learning, (1,)), OnOutputs(PID(kp=GAIN), (0,)))


def multivariable(**weights):
    learning = NormOptimal(multivariable_model(GAIN, MODEL), **WEIGHTS | weights)
    return MultivariableILC(learning, PID(kp=GAIN), prefilter=INVERSE)


class Played(NamedTuple):
    """The signals of a learning run on the drive.

    u, feedback: (J, N) learned input and the part of the feedback
    r: (J, N) reference r[k+1] that the feedback followed
    e_c, e_z: (J, N) r - y_M and r_d - y_T, one sample later
    history: of the learning
    """

    u: np.ndarray
    feedback: np.ndarray
    r: np.ndarray
    e_c: np.ndarray
    e_z: np.ndarray
    history: Any


def played(machine, scheme, trials=TRIALS):
    """Learn over TRIALS trials, so that a program is compiled once for each kind of scheme."""
    history = learn(machine, scheme, TASK, trials, save=KEEP)
    u, signals, y = (history.saved[name] for name in ("u", "signals", "y"))
    motor, table = np.moveaxis(np.asarray(y)[:, 1:], -1, 0)
    feedback = np.asarray(signals["feedback"])[..., 0]
    r = (
        np.asarray(signals["reference"])[..., 0]
        if "reference" in signals
        else np.broadcast_to(AFTER, feedback.shape)
    )
    return Played(np.asarray(u)[..., 0] - feedback, feedback, r, r - motor, AFTER - table, history)


def rms(signal):
    return np.sqrt(np.mean(signal**2, axis=-1))


@pytest.mark.thorough
@pytest.mark.parametrize("name", DRIVES)
def test_models_and_simulator_have_the_same_loop(name):
    machine, model = DRIVES[name]
    H_D, H_M = direct_matrix(model), multivariable_matrix(model)
    G = lifted.lifted_plant(machine, direct(), TASK).reshape(N, 2, N)
    assert relative(G[:, 1], H_D) < 1e-10
    of_outputs = H_M.copy()  # the model is of r - y_M, on which a learned r also acts directly
    of_outputs[0::2, 1::2] += np.eye(N)
    assert relative(lifted.lifted_plant(machine, multivariable(), TASK), of_outputs) < 1e-10
    f = np.geomspace(1.0, 499.0, 40)
    loop = linear_loop(machine, OnOutputs(PID(kp=GAIN), (0,)), TASK)
    expected = system_of(direct_model(GAIN, model))(np.exp(2j * np.pi * f * DT))
    assert relative(frequency.response(loop, f, DT)[:, 1, 0], expected) < 1e-10


# MILC and DILC
# --------------------------------------------------------------------------------------------------


@pytest.mark.thorough
def test_milc_starts_from_the_filtered_reference():
    """P_Z r_0 = r_d and u_0 = 0: a motor that follows r_0 moves the table along the path."""
    memory = multivariable().initial_memory(TASK)
    motor, table = plant_of(MODEL)
    start = np.asarray(memory.learning.u)
    np.testing.assert_array_equal(start[:, 0], 0.0)
    np.testing.assert_allclose(table @ np.linalg.solve(motor, start[:, 1]), AFTER, atol=1e-9)
    assert np.max(np.abs(start[:, 1] - AFTER)) > 0.1
    plain = dataclasses.replace(multivariable(), prefilter=None).initial_memory(TASK)
    np.testing.assert_array_equal(np.asarray(plain.learning.u)[:, 1], AFTER)


@pytest.mark.thorough
@pytest.mark.parametrize("name", DRIVES)
def test_a_trial_of_milc_is_the_equation(name):
    """e = (0, r_d) - H (u, r), then [u; r] <- L_u [u; r] + L_e e (MILC 2024, eq. 28 and 29)."""
    machine, model = DRIVES[name]
    run, H = played(machine, multivariable()), multivariable_matrix(model)
    known = multivariable_matrix(MODEL)
    learned, errors = (
        np.stack(pair, axis=-1).reshape(TRIALS, -1) for pair in ((run.u, run.r), (run.e_c, run.e_z))
    )
    wanted = np.stack([0 * AFTER, AFTER], axis=-1).ravel()
    after = [*learned[1:], np.asarray(run.history.memory.learning.u).ravel()]
    for j in range(TRIALS):
        np.testing.assert_allclose(errors[j], wanted - H @ learned[j], atol=1e-10)
        assert relative(after[j], updated(known, learned[j], errors[j], **WEIGHTS)) < 1e-9
    np.testing.assert_allclose(run.feedback[:, 1:], GAIN * run.e_c[:, :-1], atol=1e-10)


def test_milc_learns_nothing_from_what_was_not_measured_and_its_feedback_from_its_own_share():
    rng = np.random.default_rng(4)
    within = WithFeedback(PIDType(gamma_p=0.1), PID(kp=GAIN))
    scheme = MultivariableILC(PIDType(gamma_p=0.5), within)
    signals = {
        name: rng.standard_normal((N, 1)) for name in ("feedback", "reference", "feedback.feedback")
    }
    r, y, u = (
        jnp.asarray(TASK.reference),
        rng.standard_normal((N + 1, 2)),
        rng.standard_normal((N, 1)),
    )
    trial, W = Trial(r, y, u, DT, signals), np.ones((N + 1, 2))
    W[5:9] = 0.0
    whole, some = (scheme.shown(one) for one in (trial, weighed(trial, jnp.asarray(W))))
    np.testing.assert_allclose(some["learning"].e, W * whole["learning"].e, **ALGEBRA)
    np.testing.assert_allclose(some["feedback"].e, W[:, :1] * whole["feedback"].e, **ALGEBRA)
    assert some["feedback"].weight.shape == (N + 1, 1, 1)
    np.testing.assert_array_equal(whole["feedback"].u, signals["feedback"])


def test_milc_learns_from_the_input_as_it_was_applied():
    """Under saturation u_j is the input of the drive minus the part of the feedback."""
    run = played(Machine(NOMINAL, Actuator(limit=6.0)), multivariable(), trials=3)
    assert np.mean(np.abs(run.u + run.feedback)[0] == 6.0) > 0.1
    own, e = (
        np.stack([a[0], b[0]], axis=-1).ravel() for a, b in ((run.u, run.r), (run.e_c, run.e_z))
    )
    assert relative(run.r[1], updated(multivariable_matrix(MODEL), own, e, **WEIGHTS)[1::2]) < 1e-9


@pytest.mark.thorough(but=["multivariable_model"])
@pytest.mark.parametrize("model", [direct_model, multivariable_model])
def test_a_nominal_model_has_gradients_by_its_controller_and_its_drive(model):
    """The model of traced numbers is that of known ones, and its derivative that of differences."""

    def answer(C_P, gain):
        found = model(C_P, dataclasses.replace(MODEL, C=gain * jnp.asarray(MODEL.C)))
        return jnp.sum(found.C @ found.A @ found.A @ found.B)

    at, traced = (GAIN, 1.1), jax.jit(jax.value_and_grad(answer, argnums=(0, 1)))
    value, slopes = traced(*at)
    np.testing.assert_allclose(value, answer(*at), rtol=1e-12)
    step = 1e-5
    for i, slope in enumerate(slopes):
        ends = [traced(*(x + d * step * (i == k) for k, x in enumerate(at)))[0] for d in (1, -1)]
        np.testing.assert_allclose(slope, (ends[0] - ends[1]) / (2 * step), rtol=1e-6)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("scheme", "matrix"), [(direct, direct_matrix), (multivariable, multivariable_matrix)]
)
def test_theorem_2_the_nominal_plant_is_learned_monotonically(scheme, matrix):
    """M = L_u - L_e H = (H' W_q H + W_s + W_r)^-1 W_r, and |M| < 1."""
    machine, H = Machine(NOMINAL), matrix(MODEL)
    found = lifted.learning_conditions(machine, scheme(), TASK)
    law = lifted.learning_law(scheme(), TASK)
    M = lifted.input_map(lifted.lifted_plant(machine, scheme(), TASK), law.L, keep=law.keep)
    expected = np.linalg.inv(1e3 * H.T @ H + 0.011 * np.eye(len(M))) * 0.01
    np.testing.assert_allclose(M, expected, atol=1e-10)
    np.testing.assert_allclose(
        found["monotone"].value, 0.01 / (1e3 * np.linalg.svd(H)[1][-1] ** 2 + 0.011), rtol=1e-8
    )
    assert found["monotone"].holds
    assert found["monotone"].value > 0.1, "else a wrong model could not do better either"


@pytest.mark.parametrize("w_s", [1e-3, 0.5, np.diag([0.2, 0.4])])
def test_theorem_2_claims_by_the_weights_alone(w_s):
    """|M| of the lifted model is at most w_r / (w_r + min eig W_s), and reached where H is zero."""
    model = multivariable_model(GAIN, MODEL)
    learning = NormOptimal(model, w_q=1e3, w_r=0.3, w_s=w_s)
    found = lifted.weights_condition(learning)
    W_s = np.kron(np.eye(N), w_s * np.eye(2) if np.ndim(w_s) == 0 else w_s)
    H = multivariable_matrix(MODEL)
    for size in (1.0, 0.0):
        M = 0.3 * np.linalg.inv(1e3 * size * H.T @ H + W_s + 0.3 * np.eye(2 * N))
        assert np.linalg.norm(M, 2) <= found.value * (1 + 1e-12)
    np.testing.assert_allclose(found.value, np.linalg.norm(M, 2), rtol=1e-12)
    assert found.holds
    whole = MultivariableILC(learning, PID(kp=GAIN))
    assert printed_conditions(whole, TASK) == {"MILC 2024, Theorem 2": found}
    assert printed_conditions(PID(kp=GAIN), TASK) == {}
    bent = dataclasses.replace(learning, w_r=np.diag([0.3, 0.4]))
    assert lifted.weights_condition(bent).verdict == "not claimed"
    still = dataclasses.replace(learning, w_s=0.0)
    assert [p.name for p in lifted.weights_condition(still).broken] == ["W_s is positive definite"]


@pytest.mark.thorough
def test_a_model_of_the_wrong_sign_doubles_the_error_every_trial():
    """M = (H' W_q H + W_s + W_r)^-1 (2 H' W_q H + W_r) is close to 2 where w_q is large."""
    model = direct_model(GAIN, MODEL)
    model = dataclasses.replace(model, C=-np.asarray(model.C))
    scheme = WithFeedback(
        OnOutputs(NormOptimal(model, **WEIGHTS), (1,)), OnOutputs(PID(kp=GAIN), (0,))
    )
    found, H = lifted.learning_conditions(Machine(NOMINAL), scheme, TASK), direct_matrix(MODEL)
    M = np.linalg.solve(1e3 * H.T @ H + 0.011 * UNIT, 2e3 * H.T @ H + 0.01 * UNIT)
    np.testing.assert_allclose(found["asymptotic"].value, np.max(np.linalg.eigvalsh(M)), rtol=1e-6)
    assert (found["monotone"].verdict, found["asymptotic"].verdict) == ("fails", "fails")
    errors = rms(played(Machine(NOMINAL), scheme).e_z)
    np.testing.assert_allclose(errors[1:] / errors[:-1], 2.0, rtol=0.01)


@pytest.mark.thorough
@pytest.mark.parametrize("name", DRIVES)
def test_proposition_1a_the_errors_of_dilc_bound_each_other(name):
    """e_z = P_Z e_c + (1 - P_Z) r_d, so |(1 - P_Z) r_d| <= |e_z| + |P_Z| |e_c| (eq. 19)."""
    machine, model = DRIVES[name]
    motor, table = plant_of(model)
    ratio = np.linalg.solve(motor.T, table.T).T
    rest = (UNIT - ratio) @ AFTER
    run = played(machine, direct())
    e_c, e_z = run.e_c, run.e_z
    np.testing.assert_allclose(e_z, e_c @ ratio.T + rest, atol=1e-9)
    bound = np.linalg.norm(e_z, axis=1) + np.linalg.norm(ratio, 2) * np.linalg.norm(e_c, axis=1)
    assert np.all(np.linalg.norm(rest) <= bound)
    assert bound[-1] < 5 * np.linalg.norm(rest), "a bound far above says nothing"


def test_proposition_1b_the_feedback_of_dilc_cancels_what_was_learned():
    """In the steady state of DILC (MILC 2024, Proposition 1 (b)),

        u_c = S (I - L_u + L_e H_D)^-1 [(I - L_u) C_P r_d[0..N-1] + L_e r_d[1..N]] - u.

    It has the factors in another order: lifted L_u and L_e do not commute.
    """
    weights = {"w_q": 1e3, "w_r": 0.1, "w_s": 0.5}
    L_u, L_e = gains(direct_matrix(MODEL), **weights)
    _, _, S = loop_of(REAL)
    learned = np.linalg.solve(
        UNIT - L_u + L_e @ direct_matrix(REAL), (UNIT - L_u) @ (GAIN * DESIRED[:-1]) + L_e @ AFTER
    )
    run = played(Machine(REAL), direct(**weights))
    u, feedback, e_z = run.u, run.feedback, run.e_z
    np.testing.assert_allclose(u[-1], u[-2], atol=1e-9)
    assert relative(feedback[-1], S @ learned - u[-1]) < 1e-8
    assert relative(u[-1], np.linalg.solve(UNIT - L_u, L_e @ e_z[-1])) < 1e-8
    assert np.corrcoef(u[-1], feedback[-1])[0, 1] < -0.3, "they should pull against each other"


@pytest.mark.thorough
def test_milc_brings_both_errors_down_where_dilc_cannot():
    """DILC leaves the motor at (1 - 1/P_Z) r_d, while the table is on r. There

    c_s y_M' + k_s y_M = m_T r'' + (c_s + c_T) r' + k_s r.
    """
    t = np.arange(N + 1) * DT
    path = [np.gradient(DESIRED, DT, edge_order=2)]
    path = [DESIRED, *path, np.gradient(path[0], DT, edge_order=2)]
    force = 1.1 * path[2] + (DRIVE["damping"] + DRIVE["table_damping"]) * path[1] + 3.8e4 * path[0]
    stalled = DESIRED - scipy.signal.lsim(([1.0], [DRIVE["damping"], 3.8e4]), force, t)[1]
    weights = {"w_r": 1e-3, "w_s": 1e-6}
    dilc, milc = (played(Machine(REAL), scheme(**weights)) for scheme in (direct, multivariable))
    for e in (dilc.e_z, milc.e_z, milc.e_c):
        assert rms(e[-1]) < 1e-3 * rms(e[0])
    np.testing.assert_allclose(dilc.e_c[-1], stalled[1:], atol=0.05 * np.max(np.abs(stalled)))
    assert rms(dilc.e_c[-1]) > 1e3 * rms(milc.e_c[-1])
    assert rms(dilc.feedback[-1]) > 1e3 * rms(milc.feedback[-1])


# Robustness
# --------------------------------------------------------------------------------------------------

LONG = 300
pulse = np.zeros(LONG + 1)
pulse[60:241] = np.hanning(181) * np.sin(0.3 * np.arange(181))
SISO = Task(pulse, dt=DT)
ROBUST = {"w_q": 1e3, "w_r": 1e-2, "w_s": 1.0}


def certified(stiffness):
    """Return the condition of DILC on a drive of another stiffness, and how its input changes."""
    true = Machine(
        direct_model(GAIN, linear(dataclasses.replace(NOMINAL, stiffness=stiffness * 4e4)))
    )
    model = direct_model(GAIN, MODEL)
    found = frequency.norm_optimal_condition(
        Machine(model),
        true,
        None,
        SISO,
        w_e=ROBUST["w_q"],
        w_u=ROBUST["w_s"],
        w_delta=ROBUST["w_r"],
    )
    u = np.asarray(
        learn(true, NormOptimal(model, **ROBUST), SISO, 15, save=Keep(("u",))).saved["u"]
    )[..., 0]
    return found.condition, np.linalg.norm(np.diff(u, axis=0)[:, LONG // 4 : -LONG // 4], axis=1)


@pytest.mark.thorough(but=["0.85", "1.15", "1.3"])
@pytest.mark.parametrize("stiffness", [0.7, 0.85, 1.15, 1.3])
def test_what_is_certified_against_a_wrong_stiffness_converges_monotonically(stiffness):
    condition, changes = certified(stiffness)
    assert condition.verdict == "holds"
    assert 0.2 < condition.value < 0.95
    falling = changes[changes > 1e-7 * changes[0]]
    assert len(falling) >= 5
    assert np.all(falling[1:] < condition.value * falling[:-1])


def test_what_is_not_certified_may_diverge():
    condition, changes = certified(2.5)
    assert (condition.verdict, condition.broken) == ("fails", ())
    assert condition.value > 1.2
    assert changes[-1] > changes[4]


# Errors
# --------------------------------------------------------------------------------------------------


MILC = multivariable()
UNFIT = {
    "motor_output = 0 and table_output = 2 must be two of the task's 2 outputs, and its inputs one, not 1": (  # noqa: E501
        dataclasses.replace(MILC, table_output=2),
        TASK,
    ),
    "motor_output = 1 and table_output = 1 must be two": (
        dataclasses.replace(MILC, motor_output=1),
        TASK,
    ),
    "its inputs one, not 2": (MILC, dataclasses.replace(TASK, inputs=2)),
    "NormOptimal: the model has 1 inputs but the task 2": (
        dataclasses.replace(MILC, learning=NormOptimal(direct_model(GAIN, MODEL), w_r=1.0)),
        TASK,
    ),
    "MultivariableILC: WithFeedback acts within the trial; allowed are schemes that play back": (
        dataclasses.replace(MILC, learning=WithFeedback(PIDType(gamma_p=1.0), PID(kp=1.0))),
        TASK,
    ),
    "StateSpace is sampled at 0.001 s but the task at 0.002 s": (
        MILC,
        dataclasses.replace(TASK, dt=2e-3),
    ),
}
test_the_task_must_have_a_motor_and_a_table = refused(UNFIT, lambda given: given[0].check(given[1]))


def test_a_measured_trial_must_tell_what_was_learned():
    scheme = multivariable()
    trial = measured_trial(TASK, np.zeros((N + 1, 2)), np.zeros(N), feedback=np.zeros(N))
    with pytest.raises(ValueError, match="MultivariableILC: the trial has no signal 'reference'"):
        scheme.learn(scheme.initial_memory(TASK), trial)


def test_the_loop_by_hand_is_the_simulated_one():
    """A measured trial whose signals are given by name teaches what the simulated one does.

    This also holds for a prepared scheme within jit.
    """
    scheme = multivariable()
    history = played(Machine(NOMINAL), scheme).history
    trial = history.final
    measured = measured_trial(TASK, trial.y, trial.u, **trial.signals)
    ready = scheme.prepared(TASK)
    for learned in (ready.learn, jax.jit(ready.learn)):
        assert (
            relative(
                learned(scheme.initial_memory(TASK), measured).learning.u,
                np.asarray(history.memory.learning.u),
            )
            < 1e-10
        )
