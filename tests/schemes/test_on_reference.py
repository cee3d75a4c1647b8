"""Learning on the reference is the series structure of Li 2020, Fig. 1.

It is compared with loops by hand, with dense matrices and with the parallel structure.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import ALGEBRA, ARX, DIFFERENCES, DT

from jaxilc.filters import ZeroPhaseFIR
from jaxilc.learning import Machine, feedforward, learn, measured_trial, next_memory
from jaxilc.plants import DifferenceEquation, StateSpace
from jaxilc.schemes import (
    CFDLMFAC,
    CFDLMFAILC,
    CFDLMFAPC,
    FFDLMFAILC,
    PID,
    Filtered,
    OnOutputs,
    OnReference,
    PIDType,
    WithFeedback,
)
from jaxilc.signals import Task

N, TRIALS = 40, 5
K = np.arange(N + 1)
R = 0.5 - 0.5 * np.cos(2 * np.pi * K / N) + 0.05 * np.sin(1.3 * K)
REST = np.where(K >= 2, R - R[1], 0.0)  # still at rest at sample 1
A, B = ARX
PLANT = Machine(DifferenceEquation(A, B, dt=DT))
GAINS = {"kp": 0.8, "ki": 20.0, "kd": 2e-4}


def everything(trial):
    return {"y": trial.y, "u": trial.u, **trial.signals}


def run(scheme, r=R, trials=TRIALS, machine=PLANT):
    """Return the signals (J, ...) of the package by name, for one channel."""
    saved = learn(machine, scheme, Task(r, dt=DT), trials, save=everything).saved
    return {name: np.asarray(signal)[..., 0] for name, signal in saved.items()}


def plant_step(y, u, k):
    """Return y[k+1] from y[..k] and u[..k]."""
    return sum(A[i] * y[k - i] + B[i] * u[k - i] for i in range(min(k + 1, len(A))))


class PIDLoop:
    """The loop of a PID in position form, which follows seen[k]."""

    preview = 1

    def __init__(self, kp, ki, kd):
        self.gains = kp, ki, kd

    def trial(self, seen):
        kp, ki, kd = self.gains
        y, u, e = np.zeros(N + 1), np.zeros(N), np.zeros(N)
        for k in range(N):
            e[k] = seen(k, k) - y[k]
            u[k] = (
                kp * e[k] + ki * DT * sum(e[: k + 1]) + kd * (e[k] - (e[k - 1] if k else 0.0)) / DT
            )
            y[k + 1] = plant_step(y, u, k)
        return y, u


class MFAPCLoop:
    """The loop of MFAPC by Dai 2014, eq. 10 to 12, with reset mode `book`.

    It uses the reference P samples ahead.
    """

    def __init__(self, P, lam, eta, mu, phi0, epsilon=1e-5):
        self.weights, self.preview = (P, lam, eta, mu, phi0, epsilon), P

    def trial(self, seen):
        P, lam, eta, mu, phi0, epsilon = self.weights
        y, u, phi = np.zeros(N + 1), np.zeros(N), phi0
        for k in range(N):
            du = (u[k - 1] if k >= 1 else 0.0) - (u[k - 2] if k >= 2 else 0.0)
            dy = y[k] - y[k - 1] if k else 0.0
            phi += eta * du / (mu + du**2) * (dy - phi * du)
            if abs(phi) <= epsilon or abs(du) <= epsilon or np.sign(phi) != np.sign(phi0):
                phi = phi0
            total = sum(seen(k, k + i) - y[k] for i in range(1, P + 1))
            u[k] = (u[k - 1] if k else 0.0) + phi * total / P / (phi**2 + lam / P)
            y[k + 1] = plant_step(y, u, k)
        return y, u


def series(feedback, gamma_p, gamma_d=0.0, lead=0, r=R, trials=TRIALS, q=lambda w: w):
    """Run the series structure by hand.

    seen(k, i) is what the feedback gets at sample k about sample i >= k.
    """
    w, results = np.zeros(N), {"y": [], "u": [], "correction": []}
    for _ in range(trials):

        def seen(k, i, w=w):
            assert k <= i <= k + feedback.preview
            i = min(i, N)  # held at its end value
            return r[i] + (w[i - 1] if i >= 1 else 0.0)

        y, u = feedback.trial(seen)
        for name, signal in zip(results, (y, u, w), strict=True):
            results[name].append(signal)
        e, w = r - y, np.copy(w)
        for k in range(N - lead):  # beyond the end of the trial there is no error and no difference
            w[k] += gamma_p * e[k + 1 + lead] + gamma_d * (e[k + 1 + lead] - e[k + lead])
        w = q(w)
    return {name: np.array(signal) for name, signal in results.items()}


def assert_same(one, other, names):
    for name in names:
        scale = max(1.0, np.max(np.abs(other[name])))
        np.testing.assert_allclose(
            one[name], other[name], rtol=ALGEBRA["rtol"], atol=ALGEBRA["atol"] * scale, err_msg=name
        )
    assert np.max(np.abs(other["u"][-1] - other["u"][0])) > 1e-2, (
        "something should have been learned"
    )


def fir(w):
    """Return 0.5 w(k) + 0.25 (w(k-1) + w(k+1)), with the end values held."""
    held = np.pad(w, 1, mode="edge")
    return 0.5 * w + 0.25 * (held[:-2] + held[2:])


LAWS = {"p": {"gamma_p": 0.5}, "pd_lead": {"gamma_p": 0.5, "gamma_d": 0.8, "lead": 2}}
PREDICTIVE = {"P": 6, "lam": 1.0, "eta": 0.9, "mu": 0.1, "phi0": 0.3}
FEEDBACKS = {
    "pid": (PID(**GAINS), PIDLoop(**GAINS)),
    "mfapc": (CFDLMFAPC(**PREDICTIVE), MFAPCLoop(**PREDICTIVE)),
    "mfapc_beyond_the_end": (
        CFDLMFAPC(**PREDICTIVE | {"P": N + 5}),
        MFAPCLoop(**PREDICTIVE | {"P": N + 5}),
    ),
}


@pytest.mark.parametrize("feedback", FEEDBACKS)
@pytest.mark.parametrize("law", LAWS)
def test_on_reference(feedback, law):
    """The feedback gets the corrected reference.

    It gets r[k] + w[k-1] for now and r[k+i] + w[k+i-1] for later samples. Both are held at the end,
    and w[-1] = 0.
    """
    of_package, by_hand = FEEDBACKS[feedback]
    expected = series(by_hand, **LAWS[law])
    assert_same(
        run(OnReference(PIDType(**LAWS[law]), of_package)), expected, ["y", "u", "correction"]
    )


def test_filtered_learning():
    expected = series(PIDLoop(**GAINS), gamma_p=0.5, lead=1, q=fir)
    scheme = OnReference(
        Filtered(PIDType(gamma_p=0.5, lead=1), ZeroPhaseFIR((0.5, 0.25))), PID(**GAINS)
    )
    assert_same(run(scheme), expected, ["y", "u", "correction"])


def test_nothing_learned_is_the_feedback_alone():
    for feedback in (PID(**GAINS), CFDLMFAPC(**PREDICTIVE)):
        alone, within = (
            run(feedback, trials=2),
            run(OnReference(PIDType(gamma_p=0.0), feedback), trials=2),
        )
        for name in ("y", "u"):
            np.testing.assert_allclose(within[name], alone[name], **ALGEBRA)
        assert not np.any(within["correction"])


def closed_loop():
    """Return T (N, N), the response of y[1..N] to w[0..N-1].

    The loop over samples runs once for each unit impulse; w[k] acts as part of r[k+1].
    """

    def response(w):
        return PIDLoop(**GAINS).trial(lambda k, i: w[i - 1] if i >= 1 else 0.0)[0][1:]

    return np.stack([response(impulse) for impulse in np.eye(N)], axis=1)


def shift(m):
    """Return the matrix (N, N) from e[1..N] to e[k+1+m], zero beyond the end."""
    return np.eye(N, k=m)


def learning_operator(gamma_p=0.0, gamma_i=0.0, gamma_d=0.0, lead=0):
    """Return L (N, N) of the PID-type law on e[1..N], for e[0] = 0.

    No difference extends beyond the end of the trial.
    """
    difference = shift(lead) - shift(lead - 1)
    difference[N - lead :] = 0.0
    return gamma_p * shift(lead) + gamma_i * np.tril(np.ones((N, N))) + gamma_d * difference


LIFTED = LAWS | {
    "integral": {"gamma_p": 0.3, "gamma_i": 0.05, "lead": 1},
    "derivative": {"gamma_d": 0.4},
}


@pytest.mark.parametrize("law", LIFTED)
def test_lifted(law):
    """The errors obey e_{j+1} = (I - T L) e_j, with T of the closed loop.

    T is the response of the plant under feedback to the reference.
    """
    T, L = closed_loop(), learning_operator(**LIFTED[law])
    assert not np.any(np.triu(T)), "a position loop cannot answer r[k+1] before k+2"
    assert T[1, 0] > 0.05
    y = run(OnReference(PIDType(**LIFTED[law]), PID(**GAINS)))["y"]
    e = (R - y)[:, 1:]
    np.testing.assert_allclose(y[0, 1:], T @ R[1:], **ALGEBRA)
    for j in range(1, TRIALS):
        np.testing.assert_allclose(e[j], e[j - 1] - T @ (L @ e[j - 1]), atol=1e-12)
    assert np.max(np.abs(e[-1] - e[0])) > 1e-2


def test_the_inverse_of_the_closed_loop_is_deadbeat():
    """Learning with the inverse of the closed loop is deadbeat.

    y[k+1] = 2 u[k] under u = 0.5 (seen - y) gives y[k+2] + y[k+1] = r[k+1] + w[k]. Learning from
    e[k+2] + e[k+1] makes y equal to r at once.
    """
    machine = Machine(StateSpace([[0.0]], [[2.0]], [[1.0]], dt=DT))
    sum_of_two = PIDType(gamma_p=2.0, gamma_d=-1.0, lead=1)  # 2 e[k+2] - (e[k+2] - e[k+1])
    y = run(OnReference(sum_of_two, PID(kp=0.5)), r=REST, trials=3, machine=machine)["y"]
    assert np.max(np.abs(REST - y[0])) > 0.1
    np.testing.assert_allclose(y[1:], np.stack([REST, REST]), atol=1e-12)


def test_the_dense_matrix_foretells_convergence_and_growth():
    """The dense matrix predicts convergence and growth over 60 trials.

    A lead of two samples converges. With a lead of one the error first falls and then grows, as the
    matrix says.
    """
    T, falls = closed_loop(), {}
    for lead, gamma in ((2, 1.0), (1, 1.5)):
        e = (
            REST
            - run(OnReference(PIDType(gamma_p=gamma, lead=lead), PID(**GAINS)), r=REST, trials=60)[
                "y"
            ]
        )[:, 1:]
        foretold = [
            np.linalg.matrix_power(np.eye(N) - gamma * T @ shift(lead), j) @ e[0] for j in range(60)
        ]
        np.testing.assert_allclose(e, foretold, rtol=1e-8, atol=1e-10)
        falls[lead] = np.linalg.norm(e, axis=1) / np.linalg.norm(e[0])
    assert falls[2][-1] < 0.02
    assert np.min(falls[1]) < 0.3
    assert falls[1][-1] > 10 * np.min(falls[1])


def test_series_and_parallel_are_one_for_a_linear_feedback():
    """Series and parallel structure are equivalent for a linear feedback.

    A correction w through the PID C is an input C z^-1 w. So learning w += gamma e[k+2] on the
    reference is PID-type learning on the input, whose gains are gamma times those of C per sample.
    The first sample, which the reference reaches too late, is at rest.
    """
    gamma = 0.7
    on_reference = run(OnReference(PIDType(gamma_p=gamma, lead=1), PID(**GAINS)), r=REST)
    per_sample = {
        "gamma_p": gamma * GAINS["kp"],
        "gamma_i": gamma * GAINS["ki"] * DT,
        "gamma_d": gamma * GAINS["kd"] / DT,
    }
    on_input = run(WithFeedback(PIDType(**per_sample), PID(**GAINS)), r=REST)
    assert_same(on_reference, on_input, ["y", "u"])


def test_series_and_parallel_differ_for_an_adaptive_feedback():
    """Series and parallel structure differ for an adaptive feedback.

    There is no such equivalence where the feedback adapts to the input that it gives.
    """
    feedback = CFDLMFAC(phi0=0.3, lam=0.3, mu=0.1)
    one, other = (
        run(kind(PIDType(gamma_p=0.3, lead=1), feedback)) for kind in (OnReference, WithFeedback)
    )
    np.testing.assert_allclose(one["y"][0], other["y"][0], **ALGEBRA)
    assert np.max(np.abs(one["y"][1] - other["y"][1])) > 1e-3


NESTED = {
    "pid": (OnReference(PIDType(gamma_p=0.4), PID(**GAINS)), {"correction"}),
    "mfac": (OnReference(PIDType(gamma_p=0.4), CFDLMFAC(phi0=0.3)), {"correction", "feedback.phi"}),
    "learning_feedback": (
        OnReference(PIDType(gamma_p=0.4), WithFeedback(PIDType(gamma_p=0.2), CFDLMFAPC(phi0=0.3))),
        {"correction", "feedback.feedback", "feedback.feedback.phi"},
    ),
    "twice": (
        OnReference(PIDType(gamma_p=0.2), OnReference(PIDType(gamma_p=0.3), CFDLMFAPC(phi0=0.3))),
        {"correction", "feedback.correction", "feedback.feedback.phi"},
    ),
    "learned_over_feedback": (
        WithFeedback(OnReference(PIDType(gamma_p=0.4), CFDLMFAC(phi0=0.3)), PID(kp=0.2)),
        {"feedback", "learning.correction", "learning.feedback.phi"},
    ),
    "as_feedback": (
        WithFeedback(PIDType(gamma_p=0.2), OnReference(PIDType(gamma_p=0.4), CFDLMFAC(phi0=0.3))),
        {"feedback", "feedback.correction", "feedback.feedback.phi"},
    ),
    "on_outputs": (
        OnOutputs(OnReference(PIDType(gamma_p=0.4), CFDLMFAC(phi0=0.3)), (0,)),
        {"correction", "feedback.phi"},
    ),
}


@pytest.mark.parametrize("name", NESTED)
def test_signals_of_the_parts_carry_their_names(name):
    scheme, names = NESTED[name]
    trial = learn(PLANT, scheme, Task(R, dt=DT), 1).final
    assert set(trial.signals) == names
    assert all(signal.shape == (N, 1) for signal in trial.signals.values())


def test_two_corrections_add_up():
    """Two corrections of the reference add up.

    The inner correction could be learned from the error against the reference of the outer one, or
    against r itself. The docstring says r.
    """
    r, gammas = R, (0.2, 0.3)
    scheme = OnReference(
        PIDType(gamma_p=gammas[0]), OnReference(PIDType(gamma_p=gammas[1]), PID(**GAINS))
    )
    together = run(scheme, r=r)
    expected = series(PIDLoop(**GAINS), gamma_p=sum(gammas))
    np.testing.assert_allclose(together["y"], expected["y"], **ALGEBRA)
    for name, gamma in zip(("correction", "feedback.correction"), gammas, strict=True):
        np.testing.assert_allclose(
            together[name], gamma / sum(gammas) * expected["correction"], **ALGEBRA
        )


def test_both_parts_learn():
    """Both parts of a scheme can learn.

    A feedback that learns on the input acts under a correction of the reference. Both learn from
    the same error.
    """
    scheme = OnReference(PIDType(gamma_p=0.3), WithFeedback(PIDType(gamma_p=0.2), PID(**GAINS)))
    saved = run(scheme, trials=3)
    e, own = R - saved["y"], saved["u"] - saved["feedback.feedback"]
    for j in (1, 2):
        np.testing.assert_allclose(
            saved["correction"][j], saved["correction"][j - 1] + 0.3 * e[j - 1, 1:], **ALGEBRA
        )
        np.testing.assert_allclose(own[j], own[j - 1] + 0.2 * e[j - 1, 1:], **ALGEBRA)


def test_learning_from_some_of_the_outputs():
    """A scheme can learn from some of the outputs.

    There are one input and two outputs, and the second output is followed. The correction has as
    many channels as the scheme has outputs.
    """
    plant = StateSpace([[0.9, 0.1], [0.3, 0.6]], [[0.2], [0.0]], np.eye(2), dt=DT)
    scheme = OnOutputs(OnReference(PIDType(gamma_p=0.5, lead=1), PID(kp=0.5)), (1,))
    saved = learn(
        Machine(plant),
        scheme,
        Task(np.stack([0 * R, R], axis=1), dt=DT, inputs=1),
        3,
        save=everything,
    ).saved
    x, w = np.zeros((N + 1, 2)), np.zeros(N)
    for j in range(3):
        for k in range(N):
            u = 0.5 * (R[k] + (w[k - 1] if k else 0.0) - x[k, 1])
            x[k + 1] = [0.9 * x[k, 0] + 0.1 * x[k, 1] + 0.2 * u, 0.3 * x[k, 0] + 0.6 * x[k, 1]]
        np.testing.assert_allclose(saved["y"][j], x, **ALGEBRA)
        np.testing.assert_allclose(saved["correction"][j, :, 0], w, **ALGEBRA)
        w = w + 0.5 * np.append((R - x[:, 1])[2:], 0.0)
    assert np.max(np.abs(w)) > 0.1


def test_more_outputs_than_inputs():
    """A machine can have more outputs than inputs.

    The correction has the channels of the outputs, and the feedback gives the inputs. The feedback
    here is a scheme on one of two outputs.
    """
    plant = StateSpace([[0.9, 0.1], [0.3, 0.6]], [[0.2], [0.0]], np.eye(2), dt=DT)
    scheme = OnReference(PIDType(gamma_p=0.4), OnOutputs(PID(kp=0.5), (0,)))
    task = Task(np.stack([R, R[::-1]], axis=1), dt=DT, inputs=1)
    history = learn(Machine(plant), scheme, task, 2, save=everything)
    assert history.saved["correction"].shape == (2, N, 2)
    e = np.asarray(task.reference - history.saved["y"][0])
    np.testing.assert_allclose(history.saved["correction"][1], 0.4 * e[1:], **ALGEBRA)
    assert feedforward(scheme, task, history.memory).shape == (N, 2)


def test_the_table_by_hand():
    """The schedule is the same by hand.

    `feedforward` is the correction of the next trial. A measured trial must contain the correction.
    """
    scheme, task = OnReference(PIDType(gamma_p=0.5), PID(**GAINS)), Task(R, dt=DT)
    history = learn(PLANT, scheme, task, 2, save=everything)
    expected = series(PIDLoop(**GAINS), gamma_p=0.5, trials=3)
    np.testing.assert_allclose(
        feedforward(scheme, task, history.memory)[:, 0], expected["correction"][2], **ALGEBRA
    )

    y, u, w = (history.saved[name][1] for name in ("y", "u", "correction"))
    memory = learn(PLANT, scheme, task, 1).memory
    with pytest.raises(ValueError, match="OnReference: the trial has no signal 'correction'"):
        next_memory(scheme, task, memory, y, u)
    measured = measured_trial(task, y, u)._replace(signals={"correction": w})
    np.testing.assert_allclose(
        feedforward(scheme, task, scheme.learn(memory, measured))[:, 0],
        expected["correction"][2],
        **ALGEBRA,
    )


@pytest.mark.thorough
def test_gradient_of_every_gain_equals_central_differences():
    task = Task(R[:21], dt=DT)

    def loss(gains):
        scheme = OnReference(
            PIDType(gamma_p=gains[0], gamma_d=gains[1], lead=1),
            CFDLMFAPC(P=5, lam=gains[2], phi0=gains[3], reset="none"),
        )
        return learn(PLANT, scheme, task, 3).rms[-1, 0]

    at, step = np.array([0.5, 0.3, 1.0, 0.4]), 1e-6
    sides = np.concatenate([at + step * np.eye(4), at - step * np.eye(4)])
    values = jax.jit(jax.vmap(loss))(sides)
    gradient = jax.jit(jax.grad(loss))(jnp.asarray(at))
    assert np.all(np.abs(gradient) > 1e-4)
    np.testing.assert_allclose(gradient, (values[:4] - values[4:]) / (2 * step), **DIFFERENCES)


def test_adaptive_learning_on_the_reference():
    """Adaptive learning works on the reference.

    CFDL-MFAILC has everything in its schedule, so it learns the correction as it would learn an
    input of the closed loop.
    """
    weights = {"lam": 0.05, "rho": 0.9, "eta": 0.9, "mu": 0.02, "phi0": 0.4, "reset": "none"}
    on_reference = run(OnReference(CFDLMFAILC(**weights, lead=1), PID(**GAINS)), r=REST, trials=6)
    e, w, y = REST - on_reference["y"], on_reference["correction"], on_reference["y"]
    phi = np.full(N, 0.4)
    for j in range(1, 6):
        for k in range(N - 1):
            if j >= 2:  # Cao 2019, eq. 13, from the second trial on
                dw = w[j - 1, k] - w[j - 2, k]
                phi[k] += (
                    0.9 * dw / (0.02 + dw**2) * (y[j - 1, k + 2] - y[j - 2, k + 2] - phi[k] * dw)
                )
            expected = w[j - 1, k] + 0.9 * phi[k] / (0.05 + phi[k] ** 2) * e[j - 1, k + 2]  # eq. 12
            np.testing.assert_allclose(w[j, k], expected, rtol=1e-9, atol=1e-12)
    assert np.max(np.abs(w[-1])) > 0.1


def test_learning_with_terms_of_the_running_trial_is_refused_or_complete():
    """Learning with terms of the running trial is refused or complete.

    FFDL-MFAILC corrects its schedule by increments of the running trial (Cao 2019, eq. 25), which
    OnReference must not omit silently.
    """
    learning = FFDLMFAILC(phi0=(0.5, 0.3, 0.4, 0.2), lam=0.05, mu=0.02, rho=1.0, reset="none")
    try:
        saved = run(OnReference(learning, PID(**GAINS)), trials=2)
    except ValueError:
        return
    dy, w, expected = saved["y"][1] - saved["y"][0], saved["correction"][1], np.zeros(N)
    gain = 0.4 / (0.05 + 0.4**2)  # in the second trial Phi is still phi0, and w was zero before it
    for k in range(N):
        terms = 0.5 * dy[k] + (0.3 * dy[k - 1] + 0.2 * expected[k - 1] if k else 0.0)
        expected[k] = gain * (R[k + 1] - saved["y"][0, k + 1] - terms)
    np.testing.assert_allclose(w, expected, rtol=1e-9, atol=1e-12)


REFUSED = {
    "feedback_as_learning": (
        OnReference(PID(kp=1.0), PID(kp=1.0)),
        ("OnReference", "PID", "no feedforward"),
    ),
    "pair_as_learning": (
        OnReference(WithFeedback(PIDType(), PID()), PID()),
        ("OnReference", "WithFeedback", "no feedforward"),
    ),
    "lead": (OnReference(PIDType(lead=N), PID()), ("PIDType", f"lead = {N}", f"[0, {N - 1}]")),
    "gain_of_learning": (
        OnReference(PIDType(gamma_p=(0.1, 0.2)), PID()),
        ("PIDType", "gamma_p", "(2,)", "() and (1,)"),
    ),
    "gain_of_feedback": (
        OnReference(PIDType(), PID(kp=(0.1, 0.2))),
        ("PID", "kp", "(2,)", "() and (1,)"),
    ),
    "filter_of_feedback": (
        OnReference(Filtered(PID(), ZeroPhaseFIR((1.0,))), PID()),
        ("PID", "no feedforward"),
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_does_not_fit_is_named(name):
    scheme, parts = REFUSED[name]
    with pytest.raises(ValueError, match=r"\w") as caught:
        learn(PLANT, scheme, Task(R, dt=DT), 1)
    for part in parts:
        assert part in str(caught.value), f"{part!r} is missing in: {caught.value}"


def test_a_feedback_that_is_not_square_is_refused():
    """A feedback that is not square is refused.

    OnReference itself works with any number of inputs, but its feedback does not.
    """
    plant = StateSpace(np.eye(2), [[1.0], [0.0]], np.eye(2), dt=DT)
    with pytest.raises(ValueError, match="PID works channel by channel"):
        learn(
            Machine(plant),
            OnReference(PIDType(), PID()),
            Task(np.zeros((9, 2)), dt=DT, inputs=1),
            1,
        )
