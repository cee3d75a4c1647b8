"""Learning on the reference is the series structure of Li 2020, Fig. 1.

Each trial is that of the feedback alone under the corrected reference; the laws are in NumPy.
"""

import dataclasses

import jax
import numpy as np
import pytest
from cases import ALGEBRA, ARX, DT, assert_close
from refusals import refused

from jaxilc.filters import ZeroPhaseFIR
from jaxilc.learning import Machine, feedforward, learn, measured_trial, next_memory
from jaxilc.learning.playback import schedules
from jaxilc.plants import DifferenceEquation, StateSpace
from jaxilc.schemes import (
    CFDLMFAC,
    CFDLMFAPC,
    FFDLMFAILC,
    PID,
    Filtered,
    OnBasis,
    OnOutputs,
    OnReference,
    PIDType,
    PolynomialBasis,
    WithFeedback,
)
from jaxilc.signals import Task

N, TRIALS = 40, 5
K = np.arange(N + 1)
R = 0.5 - 0.5 * np.cos(2 * np.pi * K / N) + 0.05 * np.sin(1.3 * K)
REST = np.where(K >= 2, R - R[1], 0.0)  # still at rest at sample 1
PLANT = Machine(DifferenceEquation(*ARX, dt=DT))
GAINS = {"kp": 0.8, "ki": 20.0, "kd": 2e-4}
# a machine with more outputs than inputs
TWO = Machine(StateSpace([[0.9, 0.1], [0.3, 0.6]], [[0.2], [0.0]], np.eye(2), dt=DT))


def everything(trial):
    return {"y": trial.y, "u": trial.u, **trial.signals}


def run(scheme, r=R, trials=TRIALS, machine=PLANT):
    """Return the signals (J, ...) of the package by name, for one channel."""
    saved = learn(machine, scheme, Task(r, dt=DT), trials, save=everything).saved
    return {name: np.asarray(signal)[..., 0] for name, signal in saved.items()}


def series(feedback, gamma_p, gamma_d=0.0, lead=0, trials=TRIALS, q=lambda w: w):
    """Return what the feedback alone makes of r[k] + w[k-1], with w learned by hand."""
    w, results = np.zeros(N), {"y": [], "u": [], "correction": []}
    for _ in range(trials):
        trial = run(feedback, R + np.append(0.0, w), 1)
        for name, signal in zip(results, (trial["y"][0], trial["u"][0], w), strict=True):
            results[name].append(signal)
        e, w = R - trial["y"][0], np.copy(w)
        for k in range(N - lead):  # beyond the end of the trial there is no error and no difference
            w[k] += gamma_p * e[k + 1 + lead] + gamma_d * (e[k + 1 + lead] - e[k + lead])
        w = q(w)
    return {name: np.array(signal) for name, signal in results.items()}


def assert_same(one, other, names):
    for name in names:
        assert_close(one[name], other[name], name)


def fir(w):
    """Return 0.5 w(k) + 0.25 (w(k-1) + w(k+1)), with the end values held."""
    held = np.pad(w, 1, mode="edge")
    return 0.5 * w + 0.25 * (held[:-2] + held[2:])


LAWS = {
    "p": {"gamma_p": 0.5},
    "pd_lead": {"gamma_p": 0.5, "gamma_d": 0.8, "lead": 2},
    "nothing": {"gamma_p": 0.0},
    "filtered": {"gamma_p": 0.5, "lead": 1},
}
PREDICTIVE = {"P": 6, "lam": 1.0, "eta": 0.9, "mu": 0.1, "phi0": 0.3}
FEEDBACKS = {
    "pid": PID(**GAINS),
    "mfapc": CFDLMFAPC(**PREDICTIVE),
    "mfapc_beyond_the_end": CFDLMFAPC(**PREDICTIVE | {"P": N + 5}),
}


@pytest.mark.thorough(but=["p-pid", "pd_lead-mfapc", "filtered-mfapc_beyond_the_end"])
@pytest.mark.parametrize("feedback", FEEDBACKS.values(), ids=FEEDBACKS)
@pytest.mark.parametrize("law", LAWS)
def test_on_reference(feedback, law):
    learning, q = PIDType(**LAWS[law]), fir if law == "filtered" else np.copy
    if law == "filtered":
        learning = Filtered(learning, ZeroPhaseFIR((0.5, 0.25)))
    expected = series(feedback, **LAWS[law], q=q)
    assert_same(run(OnReference(learning, feedback)), expected, ["y", "u", "correction"])
    assert (np.ptp(expected["u"], axis=0).max() > 1e-2) == (law != "nothing")


@pytest.mark.thorough
def test_the_inverse_of_the_closed_loop_is_deadbeat():
    """Learning from e[k+2] + e[k+1] makes y equal to r at once.

    y[k+1] = 2 u[k] under u = 0.5 (seen - y) gives y[k+2] + y[k+1] = r[k+1] + w[k].
    """
    machine = Machine(StateSpace([[0.0]], [[2.0]], [[1.0]], dt=DT))
    sum_of_two = PIDType(gamma_p=2.0, gamma_d=-1.0, lead=1)  # 2 e[k+2] - (e[k+2] - e[k+1])
    y = run(OnReference(sum_of_two, PID(kp=0.5)), r=REST, trials=3, machine=machine)["y"]
    assert np.max(np.abs(REST - y[0])) > 0.1
    np.testing.assert_allclose(y[1:], np.stack([REST, REST]), atol=1e-12)


def test_the_dense_matrix_foretells_convergence_and_growth():
    """The errors obey e_{j+1} = (I - T L) e_j over 60 trials, with T of the closed loop.

    A lead of two samples converges. With a lead of one the error first falls and then grows.
    """
    impulses = np.eye(N + 1)[1:]  # of r[1..N], and so of w
    T = np.stack([run(PID(**GAINS), r, 1)["y"][0, 1:] for r in impulses], axis=1)
    assert not np.any(np.triu(T)), "a position loop cannot answer r[k+1] before k+2"
    falls = {}
    for lead, gamma in ((2, 1.0), (1, 1.5)):
        scheme = OnReference(PIDType(gamma_p=gamma, lead=lead), PID(**GAINS))
        e = (REST - run(scheme, r=REST, trials=60)["y"])[:, 1:]
        M = np.eye(N) - gamma * T @ np.eye(N, k=lead)
        foretold = [np.linalg.matrix_power(M, j) @ e[0] for j in range(60)]
        np.testing.assert_allclose(e, foretold, rtol=1e-8, atol=1e-10)
        falls[lead] = np.linalg.norm(e, axis=1) / np.linalg.norm(e[0])
    assert falls[2][-1] < 0.02
    assert np.min(falls[1]) < 0.3
    assert falls[1][-1] > 10 * np.min(falls[1])


@pytest.mark.thorough
def test_series_and_parallel_are_one_for_a_linear_feedback():
    """A correction w through the PID C is an input C z^-1 w.

    So learning w += gamma e[k+2] on the reference is PID-type learning on the input, whose gains
    are gamma times those of C per sample. The first sample, which the reference reaches too late,
    is at rest.
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


@pytest.mark.thorough
@pytest.mark.parametrize("name", NESTED)
def test_signals_of_the_parts_carry_their_names(name):
    scheme, names = NESTED[name]
    trial = jax.eval_shape(lambda: learn(PLANT, scheme, Task(R, dt=DT), 1)).final
    assert set(trial.signals) == names
    assert all(signal.shape == (N, 1) for signal in trial.signals.values())


@pytest.mark.thorough
@pytest.mark.parametrize(
    "around",
    [
        lambda law: Filtered(law, ZeroPhaseFIR((0.5, 0.25))),
        lambda law: OnBasis(law, PolynomialBasis((1, 2))),
    ],
)
def test_what_is_around_it_is_as_around_its_learning(around):
    law, feedback = PIDType(gamma_p=0.5), PID(**GAINS)
    within = run(OnReference(around(law), feedback))
    assert_same(run(around(OnReference(law, feedback))), within, ["y", "u", "correction"])
    assert np.ptp(within["u"], axis=0).max() > 1e-2


def test_a_filter_around_it_knows_the_limit_of_its_learning():
    law, sharp, task = PIDType(gamma_p=0.9, limit=0.5), ZeroPhaseFIR((1.4, -0.2)), Task(R, dt=DT)
    around, within = (
        feedforward(scheme, task, learn(PLANT, scheme, task, 4).memory)
        for scheme in (
            Filtered(OnReference(law, PID(**GAINS)), sharp),
            OnReference(Filtered(law, sharp), PID(**GAINS)),
        )
    )
    assert np.max(np.abs(within)) == 0.5
    np.testing.assert_allclose(around, within, **ALGEBRA)


@pytest.mark.thorough
def test_two_corrections_add_up():
    """The inner correction, too, is learned from the error against r, not r + w."""
    gammas = (0.2, 0.3)
    together = run(
        OnReference(
            PIDType(gamma_p=gammas[0]), OnReference(PIDType(gamma_p=gammas[1]), PID(**GAINS))
        )
    )
    expected = series(PID(**GAINS), gamma_p=sum(gammas))
    np.testing.assert_allclose(together["y"], expected["y"], **ALGEBRA)
    for name, gamma in zip(("correction", "feedback.correction"), gammas, strict=True):
        share = gamma / sum(gammas) * expected["correction"]
        np.testing.assert_allclose(together[name], share, **ALGEBRA)


@pytest.mark.thorough
def test_two_inputs_that_are_learned_add_up():
    """A feedback that learns, too, is shown what it contributed, and not what is added to it."""
    feedback, gammas = PID(**GAINS), (0.2, 0.3)
    one, other, both = (PIDType(gamma_p=gamma) for gamma in (*gammas, sum(gammas)))
    expected = run(WithFeedback(both, feedback))
    assert_same(run(WithFeedback(one, WithFeedback(other, feedback))), expected, ["y", "u"])


def test_a_machine_is_told_all_that_parts_of_parts_have_learned():
    """One of two references lacked the other's correction, and one of three inputs was lost."""
    task, laws = Task(R, dt=DT), [PIDType(gamma_p=gamma) for gamma in (0.1, 0.2, 0.3)]
    inner = WithFeedback(laws[2], PID(**GAINS))
    two = OnReference(laws[0], OnReference(laws[1], PID(**GAINS)))
    memory = learn(PLANT, two, task, 2).memory
    both = memory.learning.u + memory.feedback.learning.u
    found = schedules(two, memory, task)["feedback.reference"]
    np.testing.assert_allclose(found[1:, 0], R[1:] + np.ravel(both), **ALGEBRA)
    three = WithFeedback(WithFeedback(laws[0], WithFeedback(laws[1], PID(**GAINS))), inner)
    assert set(schedules(three, three.initial_memory(task), task)) == {
        "learning.feedforward", "learning.feedback.feedforward", "feedback.feedforward",
    }  # fmt: skip


@pytest.mark.thorough
def test_a_feedback_that_learns_on_the_input_and_the_reference_learn_from_the_same_error():
    scheme = OnReference(PIDType(gamma_p=0.3), WithFeedback(PIDType(gamma_p=0.2), PID(**GAINS)))
    saved = run(scheme, trials=3)
    e, own = R - saved["y"], saved["u"] - saved["feedback.feedback"]
    for signal, gamma in ((saved["correction"], 0.3), (own, 0.2)):
        np.testing.assert_allclose(np.diff(signal, axis=0), gamma * e[:-1, 1:], **ALGEBRA)


def test_learning_from_some_of_the_outputs():
    """There are one input and two outputs, of which the second is followed and corrected."""
    scheme = OnOutputs(OnReference(PIDType(gamma_p=0.5, lead=1), PID(kp=0.5)), (1,))
    task = Task(np.stack([0 * R, R], axis=1), dt=DT, inputs=1)
    saved = learn(TWO, scheme, task, 3, save=everything).saved
    x, w = np.zeros((N + 1, 2)), np.zeros(N)
    for j in range(3):
        for k in range(N):
            u = 0.5 * (R[k] + (w[k - 1] if k else 0.0) - x[k, 1])
            x[k + 1] = [0.9 * x[k, 0] + 0.1 * x[k, 1] + 0.2 * u, 0.3 * x[k, 0] + 0.6 * x[k, 1]]
        np.testing.assert_allclose(saved["y"][j], x, **ALGEBRA)
        np.testing.assert_allclose(saved["correction"][j, :, 0], w, **ALGEBRA)
        w = w + 0.5 * np.append((R - x[:, 1])[2:], 0.0)
    assert np.max(np.abs(w)) > 0.1


@pytest.mark.thorough
def test_the_correction_has_the_channels_of_the_outputs():
    scheme = OnReference(PIDType(gamma_p=0.4), OnOutputs(PID(kp=0.5), (0,)))
    task = Task(np.stack([R, R[::-1]], axis=1), dt=DT, inputs=1)
    history = learn(TWO, scheme, task, 2, save=everything)
    e = np.asarray(task.reference - history.saved["y"][0])
    np.testing.assert_allclose(history.saved["correction"][1], 0.4 * e[1:], **ALGEBRA)
    assert feedforward(scheme, task, history.memory).shape == (N, 2)
    y, u, signals = history.final.y, history.final.u, history.final.signals
    before = learn(TWO, scheme, task, 1).memory
    found = feedforward(scheme, task, next_memory(scheme, task, before, y, u, **signals))
    np.testing.assert_allclose(found, feedforward(scheme, task, history.memory), **ALGEBRA)
    with pytest.raises(ValueError, match="PID works channel by channel"):
        dataclasses.replace(scheme, feedback=PID()).check(task)


def test_the_loop_by_hand_needs_the_correction_of_a_measured_trial():
    scheme, task = OnReference(PIDType(gamma_p=0.5), PID(**GAINS)), Task(R, dt=DT)
    history, memory = (learn(PLANT, scheme, task, trials) for trials in (2, 1))
    expected, memory = feedforward(scheme, task, history.memory), memory.memory
    y, u, signals = history.final.y, history.final.u, history.final.signals
    with pytest.raises(ValueError, match="OnReference: the trial has no signal 'correction'"):
        next_memory(scheme, task, memory, y, u)
    measured = measured_trial(task, y, u)._replace(signals=signals)
    found = feedforward(scheme, task, scheme.learn(memory, measured))
    np.testing.assert_allclose(found, expected, **ALGEBRA)


REFUSED = {
    "PID learns no feedforward": OnReference(PID(kp=1.0), PID(kp=1.0)),
    "OnReference: WithFeedback learns no feedforward": OnReference(
        WithFeedback(PIDType(), PID()), PID()
    ),
    rf"PIDType: lead = {N} .*\[0, {N - 1}\]": OnReference(PIDType(lead=N), PID()),
    # it corrects its schedule by increments of the running trial (Cao 2019, eq. 25)
    "OnReference: FFDLMFAILC acts within the trial": OnReference(
        FFDLMFAILC(phi0=(0.5, 0.3, 0.4, 0.2)), PID()
    ),
}
test_what_does_not_fit_is_named = refused(
    REFUSED, lambda scheme: learn(PLANT, scheme, Task(R, dt=DT), 1)
)
