"""Stop rule and ladder are compared with their rules, applied by hand to trials without them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import ALGEBRA, ARX, DIFFERENCES, DT, PRINTED
from refusals import refused

from jaxilc.filters import ZeroPhaseFIR
from jaxilc.learning import Machine, Sensor, learn, next_memory, repeatability
from jaxilc.plants import DifferenceEquation, StateSpace
from jaxilc.schemes import (
    CFDLMFAILC,
    FFDLMFAILC,
    PID,
    AtSamples,
    ConstrainedNormOptimal,
    ErrorFiltered,
    Filtered,
    Ladder,
    OnReference,
    PIDType,
    StopWhen,
    WithFeedback,
)
from jaxilc.schemes.weights import weighed
from jaxilc.signals import Task, Trial

N = 40
R = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(N + 1) / N) + 0.05 * np.sin(1.3 * np.arange(N + 1))
TASK = Task(R, dt=DT)
COIL, SERVO = (Machine(DifferenceEquation(*c, dt=DT)) for c in (PRINTED, ARX))
TWO = Machine(StateSpace([[0.7, 0.1], [0.0, 0.5]], [[0.3, 0.0], [0.1, 0.5]], np.eye(2), dt=DT))
TASK_2 = Task(np.stack([R, R[::-1]], axis=1), dt=DT)
LAW = PIDType(gamma_p=-0.4)  # on the voice coil its error falls for four trials, then grows


def everything(trial):
    return trial.y, trial.u


def run(machine, scheme, trials):
    """Return outputs (J, N+1, n), inputs (J, N, n) and the history."""
    history = learn(machine, scheme, TASK, trials, save=everything)
    return (*map(np.asarray, history.saved), history)


def rms_of(y):
    return np.sqrt(np.mean((TASK.reference - y)[1:] ** 2))


def replayed(y, *, max_error=np.inf, rms=np.inf, growth=np.inf, trials):
    """Return which unguarded trials the stop rule, exactly as it is stated, runs."""
    shown, best, j = [], 0, 0
    for _ in range(trials):
        shown.append(j)
        e = np.abs(TASK.reference - y[j])[1:]
        tolerances = [(np.max(e), max_error), (np.sqrt(np.mean(e**2)), rms)]
        if any(np.isfinite(limit) for _, limit in tolerances) and all(
            found <= limit for found, limit in tolerances
        ):
            break
        if rms_of(y[j]) > (1 + growth) * rms_of(y[best]):
            j = best
            break
        best = j if rms_of(y[j]) < rms_of(y[best]) else best
        j += 1
    stopped = len(shown)
    return shown + [j] * (trials - stopped), stopped


RULES = {
    "max_error": {"max_error": 0.9},
    "rms": {"rms": 0.53},
    "both": {"max_error": 0.86, "rms": 0.53},
    "one_is_not_met": {"max_error": 0.1, "rms": 0.6},
    "growth": {"growth": 0.1},
    "at_once": {"growth": 0.0},
    "tolerance_first": {"max_error": 0.9, "growth": 0.0},
    "growth_first": {"max_error": 0.1, "growth": 0.01},
}


@pytest.fixture(scope="module")
def unguarded():
    return run(COIL, LAW, 9)


@pytest.mark.thorough
@pytest.mark.parametrize("rule", RULES.values(), ids=RULES)
def test_stop_rule(unguarded, rule):
    shown, stopped = replayed(unguarded[0], **rule, trials=9)
    y, u, history = run(COIL, StopWhen(LAW, **rule), 9)
    np.testing.assert_allclose(y, unguarded[0][shown], **ALGEBRA)
    np.testing.assert_allclose(u, unguarded[1][shown], **ALGEBRA)
    fires = rule != RULES["one_is_not_met"]
    assert (stopped < 9) == fires
    assert (float(history.memory.frozen), float(history.memory.trials)) == (float(fires), stopped)
    assert not fires or shown[-1] == {"rms": 2}.get(" ".join(rule), 3)


@pytest.mark.thorough
def test_every_output_must_meet_its_own_tolerance():
    law = PIDType(gamma_p=(0.8, 0.5))
    errors = np.asarray(learn(TWO, law, TASK_2, 8).max_error)
    assert np.all(errors[-1] < errors[0])
    tolerance = errors[[2, 4], [0, 1]] * (1 + 1e-9)
    first = int(np.argmax(np.all(errors <= tolerance, axis=1)))
    assert first == 4
    history = learn(TWO, StopWhen(law, max_error=tolerance), TASK_2, 8)
    np.testing.assert_allclose(history.max_error, errors[[0, 1, 2, 3, 4, 4, 4, 4]], **ALGEBRA)


@pytest.mark.thorough
def test_a_trial_that_is_not_finite_is_gone_back_from():
    # The plant is y[k+1] = u[k], so e_j = (1 - gamma)^(j-1) r.
    machine = Machine(StateSpace([[0.0]], [[1.0]], [[1.0]], dt=DT))
    history = learn(machine, StopWhen(PIDType(gamma_p=1e200), growth=1e300), TASK, 5)
    np.testing.assert_array_equal(history.finite, [True, False, True, True, True])
    np.testing.assert_array_equal(history.rms[2:], np.tile(history.rms[0], (3, 1)))


@pytest.mark.thorough
def test_gradient_of_a_frozen_trial_is_that_of_what_it_is_frozen_with():
    """After the fifth trial the rule returns to the memory that gave the fourth."""

    def last(law, trials):
        return jnp.sum(learn(COIL, law, TASK, trials).rms[-1])

    guarded = StopWhen(LAW, growth=0.0)
    slope = jax.jit(jax.grad(last), static_argnums=1)
    found, fourth = slope(guarded, 7), slope(LAW, 4)
    np.testing.assert_allclose(found.scheme.gamma_p, fourth.gamma_p, **ALGEBRA)
    ends = [
        float(last(StopWhen(PIDType(gamma_p=-0.4 + step), growth=0.0), 7)) for step in (1e-6, -1e-6)
    ]
    np.testing.assert_allclose(found.scheme.gamma_p, (ends[0] - ends[1]) / 2e-6, **DIFFERENCES)
    assert found.growth == 0


FEEDBACK = PID(kp=0.5, ki=5.0)
LIMITED, SHARP = PIDType(gamma_p=0.6, lead=1, limit=0.7), ZeroPhaseFIR((1.4, -0.2))
FFDL = FFDLMFAILC(phi0=ARX[0] + ARX[1], lam=0.02)
NESTS = {
    "filter_outside": lambda guard: Filtered(guard(LIMITED), SHARP),
    "filter_inside": lambda guard: guard(Filtered(LIMITED, SHARP)),
    "over_feedback": lambda guard: WithFeedback(guard(LIMITED), FEEDBACK),
    "around_feedback": lambda guard: guard(WithFeedback(LIMITED, FEEDBACK)),
    "on_reference": lambda guard: OnReference(guard(LIMITED), FEEDBACK),
    "around_reference": lambda guard: guard(OnReference(LIMITED, FEEDBACK)),
    "mfailc": lambda guard: guard(FFDL),
    "preview": lambda guard: guard(PID(kp=0.5, ka=1e-4)),
}


@pytest.mark.thorough(but=["filter_inside", "around_feedback"])
@pytest.mark.parametrize("nest", NESTS)
def test_guards_with_nothing_to_do_change_nothing(nest):
    plain = NESTS[nest](lambda scheme: scheme)
    guarded = NESTS[nest](lambda scheme: StopWhen(Ladder(scheme, 1), max_error=1e-9, growth=10.0))
    y, u, history = run(SERVO, guarded, 4)
    expected_y, expected_u, expected = run(SERVO, plain, 4)
    np.testing.assert_allclose(y, expected_y, **ALGEBRA)
    np.testing.assert_allclose(u, expected_u, **ALGEBRA)
    assert history.final.signals.keys() == expected.final.signals.keys()
    assert (guarded.learns, guarded.plays_back, guarded.preview) == (
        plain.learns,
        plain.plays_back,
        plain.preview,
    )
    if nest.startswith("filter"):
        assert np.max(np.abs(u)) == 0.7, (
            "the filter overshoots, but the limit of the scheme inside holds"
        )
    if plain.learns:
        feedforward = guarded.feedforward(history.memory, TASK)
        np.testing.assert_allclose(feedforward, plain.feedforward(expected.memory, TASK), **ALGEBRA)


@pytest.mark.thorough
def test_guards_fire_within_each_other():
    """The rule inside judges the mean trial; around the ladder it judges each repeat."""
    y, _, _ = run(SERVO, PIDType(gamma_p=0.6, lead=1), 6)
    errors = [np.max(np.abs(TASK.reference - one)) for one in y]
    tolerance = 1.0001 * errors[2]
    assert errors[1] > tolerance
    law = PIDType(gamma_p=0.6, lead=1)
    inside, _, _ = run(SERVO, StopWhen(Ladder(law, 2), max_error=tolerance), 8)
    np.testing.assert_allclose(inside, y[[0, 0, 1, 1, 2, 2, 2, 2]], **ALGEBRA)
    outside, _, history = run(SERVO, Ladder(StopWhen(law, max_error=tolerance), 2), 8)
    np.testing.assert_allclose(outside, y[[0, 0, 1, 1, 2, 2, 2, 2]], **ALGEBRA)
    assert float(history.memory.scheme.frozen) == 1


NOISY = Machine(SERVO.plant, sensor=Sensor(noise=0.02))


@pytest.mark.thorough
@pytest.mark.parametrize("feedback", [None, FEEDBACK], ids=["alone", "around_feedback"])
def test_ladder_learns_from_the_mean_of_its_repeats(feedback):
    gamma, repeats = 0.4, 3
    law = PIDType(gamma_p=gamma)
    scheme = Ladder(law if feedback is None else WithFeedback(law, feedback), repeats)
    history = learn(
        NOISY, scheme, TASK, 4 * repeats, save=lambda trial: (trial.y, trial.u, trial.signals)
    )
    y, u, signals = jax.tree.map(np.asarray, history.saved)
    w = u - signals["feedback"] if feedback else u
    expected = np.zeros_like(w[0])
    for block in range(4):
        now = slice(block * repeats, (block + 1) * repeats)
        np.testing.assert_allclose(w[now], np.broadcast_to(expected, w[now].shape), **ALGEBRA)
        assert np.all(y[now][0] != y[now][1]), "noise should tell the repeats apart"
        expected = expected + gamma * np.mean(TASK.reference[1:] - y[now][:, 1:], axis=0)
    np.testing.assert_allclose(scheme.feedforward(history.memory, TASK), expected, **ALGEBRA)


@pytest.mark.thorough
@pytest.mark.parametrize("law", ["p_type", "cfdl"])
def test_gain_of_the_ladder(law):
    """By hand, the scheme gets r - gain (r - mean y)."""
    scheme = (
        PIDType(gamma_p=0.3, lead=1)
        if law == "p_type"
        else CFDLMFAILC(phi0=0.5, lam=0.6, reset="sign")
    )
    ladder = Ladder(scheme, 2, growth_of_gain=1.5, largest=3.0, slow=0.6)
    trials = 24
    y, u, history = run(NOISY, ladder, trials)
    memory, gain, last, gains = scheme.initial_memory(TASK), 1.0, np.inf, []
    for block in range(trials // 2):
        now = slice(2 * block, 2 * block + 2)
        np.testing.assert_allclose(
            u[now],
            np.broadcast_to(scheme.feedforward(memory, TASK), u[now].shape),
            rtol=1e-9,
            atol=1e-10,
        )
        mean = np.mean(y[now], axis=0)
        rms = rms_of(mean)
        if 0.6 * last < rms <= last:
            gain = min(1.5 * gain, 3.0)
        memory = next_memory(
            scheme, TASK, memory, TASK.reference - gain * (TASK.reference - mean), u[2 * block]
        )
        last, gains = rms, [*gains, gain]
    assert float(history.memory.gain) == pytest.approx(gain)
    assert {1.0, 1.5, 2.25, 3.0} <= set(gains), "all of the ladder should be seen"


def test_ladder_by_hand_needs_the_signals_of_what_it_is_around():
    scheme = Ladder(WithFeedback(PIDType(gamma_p=0.5), FEEDBACK), 2)
    with pytest.raises(ValueError, match="WithFeedback: the trial has no signal 'feedback'"):
        next_memory(scheme, TASK, scheme.initial_memory(TASK), np.zeros(N + 1), np.zeros(N))
    share = np.linspace(0.0, 1.0, N)
    memory = scheme.initial_memory(TASK)
    for factor in (1.0, 3.0):
        memory = next_memory(
            scheme, TASK, memory, factor * np.ones(N + 1), factor * share, feedback=factor * share
        )
    np.testing.assert_allclose(
        scheme.feedforward(memory, TASK)[:, 0], 0.5 * (R[1:] - 2.0), **ALGEBRA
    )


def test_a_ladder_beside_a_feedback_shows_its_law_what_that_contributes():
    plant = StateSpace([[0.6]], [[0.4]], [[1.0]], dt=DT)
    law = ConstrainedNormOptimal(plant, w_r=0.1, total=0.8, feedback=[[-0.3]])
    machine, feedback = Machine(plant), PID(kp=0.3)
    plain, once = (
        learn(machine, WithFeedback(one, feedback), TASK, 3) for one in (law, Ladder(law, 1))
    )
    np.testing.assert_allclose(once.rms, plain.rms, **ALGEBRA)


def test_a_sample_that_repeats_lost_is_learned_from_with_a_smaller_gain():
    ladder, lost = Ladder(PIDType(gamma_p=0.6), 3), np.ones((N + 1, 1))
    lost[7] = 0.0
    trial = Trial(jnp.asarray(TASK.reference), jnp.zeros((N + 1, 1)), jnp.zeros((N, 1)), DT)
    whole, other = (weighed(trial, jnp.asarray(W)) for W in (np.ones_like(lost), lost))
    memory = ladder.initial_memory(TASK)
    for one in (whole, other, whole):
        memory = ladder.learn(memory, one)
    share = np.where(np.arange(1, N + 1) == 7, 2 / 3, 1.0)
    np.testing.assert_allclose(memory.scheme.u[:, 0], 0.6 * share * R[1:], **ALGEBRA)


def test_repeatability():
    """The RMS of N samples of noise has the standard deviation sigma / sqrt(2 N)."""
    rms = np.array([[0.031, 0.5], [0.033, 0.4], [0.032, 0.6]])
    found = repeatability(rms)
    np.testing.assert_allclose(found.mean, [0.032, 0.5], **ALGEBRA)
    np.testing.assert_allclose(found.spread, [0.002, 0.2], **ALGEBRA)
    np.testing.assert_allclose(found.share, [0.0625, 0.4], **ALGEBRA)
    still = learn(NOISY, PID(), Task(np.zeros(2001), dt=DT), 10).rms
    assert (
        0.5 * 0.02 / np.sqrt(4000)
        < float(repeatability(still).spread[0])
        < 6 * 0.02 / np.sqrt(4000)
    )


BOUNDED = ConstrainedNormOptimal(StateSpace([[0.6]], [[0.4]], [[1.0]], dt=DT), w_r=0.1, y_high=0.5)
REFUSED = {
    "StopWhen: max_error, rms and growth are all None": lambda: StopWhen(LAW),
    f"PIDType: lead = {N} is outside": lambda: StopWhen(PIDType(lead=N), rms=1.0),
    "StopWhen learns no feedforward signal u": lambda: Filtered(
        StopWhen(PID(), rms=1.0), ZeroPhaseFIR()
    ),
    "L_y = 2 of FFDLMFAILC": lambda: Ladder(WithFeedback(FFDLMFAILC(), PID()), 2, slow=0.9),
    "ErrorFiltered: L_y = 2 of FFDLMFAILC": lambda: ErrorFiltered(
        WithFeedback(FFDLMFAILC(), PID()), ZeroPhaseFIR()
    ),
    "slow = 0.9 with y_high of ConstrainedNormOptimal bounds the output, which would hold for": (
        lambda: Ladder(BOUNDED, 2, slow=0.9)
    ),
    "ErrorFiltered: y_high of ConstrainedNormOptimal bounds the output, which would hold for": (
        lambda: ErrorFiltered(StopWhen(BOUNDED, rms=1.0), ZeroPhaseFIR())
    ),
    "slow = 0.9 with jerk_time = 0.001 of AtSamples weighs the jerk of the outputs": lambda: Ladder(
        AtSamples(PIDType(), windows=(0.01,), jerk_time=1e-3), 2, slow=0.9
    ),
    r"repeatability: rms has shape \(1, 2\)": lambda: repeatability(np.ones((1, 2))),
}
test_what_cannot_be_done_is_named = refused(REFUSED, lambda build: build().check(TASK))
