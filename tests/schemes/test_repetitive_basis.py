"""Weights of functions of the period, learned within one trial, against what they are equal to."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal
from refusals import refused

from jaxilc import Machine, Task
from jaxilc.learning import Actuator, Disturbance, learn, run_trial
from jaxilc.plants import Harmonics, Splines, StateSpace
from jaxilc.schemes import PID, LearningFilter, RepetitiveBasis, RepetitiveControl, WithFeedback
from jaxilc.signals.task import Sample
from jaxilc.theory import basis_condition
from jaxilc.uncertainty import Population, Uniform

DT, n = 1e-3, 25
PLANT = StateSpace([[0.9, 0.1], [0.0, 0.7]], [[0.0], [0.3]], [[1.0, 0.0]], dt=DT)
HARMONICS = Harmonics(n * DT, (1, 2, 3))
WAVE = np.random.default_rng(1).normal(size=(3, 2))


def repeating(samples):
    """Three harmonics of the period."""
    angle = 2 * np.pi * np.arange(samples) / n
    return sum(
        a * np.cos(h * angle) + b * np.sin(h * angle) for h, (a, b) in enumerate(WAVE, start=1)
    )


@jax.jit
def run(scheme, r):
    task = Task(r, dt=DT)
    beside = WithFeedback(scheme, PID(kp=0.4))
    memory = beside.initial_memory(task)
    return run_trial(Machine(PLANT), beside, task, memory, jax.random.key(0)).e[:, 0]


@jax.jit
def answer(scheme, e):
    """u of the law alone, to an error that is given."""
    task = Task(jnp.zeros(len(e)), dt=DT)

    def tick(state, now):
        return scheme.act(state, Sample(now, None, jnp.zeros(1), None, DT))

    return jax.lax.scan(tick, scheme.initial_state(task), e[:, None])[1][:, 0]


def test_harmonics_are_resonators():
    """By `lfilter` of the transfer function that is printed, each with gain and lead of its own."""
    e = np.random.default_rng(0).normal(size=300)
    gains, leads, keep = np.array([0.3, 0.2, 0.1]), np.array([0.003, 0.004, 0.001]), 0.995
    scheme = RepetitiveBasis(
        HARMONICS, gain=np.repeat(gains, 2), lead=np.repeat(leads, 2), keep=keep
    )
    expected = 0
    for h, (gain, lead) in enumerate(zip(gains, leads, strict=True), start=1):
        a, b = 2 * np.pi * h / n, 2 * np.pi * h * lead / (n * DT)
        top = gain * np.array([0, np.cos(a + b), -keep * np.cos(b)])
        expected = expected + scipy.signal.lfilter(top, [1, -2 * keep * np.cos(a), keep**2], e)
    np.testing.assert_allclose(answer(scheme, e), expected, atol=1e-10)


@pytest.mark.thorough
def test_all_harmonics_of_a_period_are_repetitive_control():
    e, g, lead = np.random.default_rng(0).normal(size=200), 0.6, 3
    orders = tuple(range((n + 1) // 2))
    gain = g / n * np.array([1.0, *([2.0] * (n - 1))])
    basis = RepetitiveBasis(Harmonics(n * DT, orders), gain=gain, lead=lead * DT)
    law = LearningFilter((g,), lead=lead - 1)
    np.testing.assert_allclose(
        answer(basis, e), answer(RepetitiveControl(law, n * DT), e), atol=1e-10
    )


@pytest.mark.parametrize("by_period", [False, True])
def test_splines_are_the_dense_sums_over_the_samples_before(by_period):
    e = np.random.default_rng(0).normal(size=120)
    splines = Splines(0.0, n * DT, 6, degree=1, closed=True)
    scheme = RepetitiveBasis(splines, gain=0.2, lead=2 * DT, keep=0.9, by_period=by_period)
    at = DT * np.arange(120)
    f, seen = np.asarray(splines.at(at)), np.asarray(splines.at(at - 2 * DT))
    u = np.zeros(120)
    for k in range(120):
        for i in range(k):
            steps = k // n - i // n if by_period else k - i
            if steps:
                u[k] += 0.2 * 0.9 ** (steps - 1) * f[k] @ seen[i] * e[i]
    np.testing.assert_allclose(answer(scheme, e), u, atol=1e-12)


@pytest.mark.thorough
def test_it_learns_what_its_functions_can_make_beside_a_feedback():
    r, h = repeating(3001), np.arange(1, 4)
    z = np.exp(2j * np.pi * h / n)
    T = 0.03 / (z**2 - 1.6 * z + 0.642)  # of plant and feedback
    leads = np.repeat(-np.angle(T) / (2 * np.pi * h) * n * DT, 2)
    gains = np.repeat(0.03 / np.abs(T), 2)
    before = np.max(np.abs(run(PID(kp=0.0), r)[-n:]))
    for by_period in (False, True):
        scheme = RepetitiveBasis(HARMONICS, gain=gains, lead=leads, by_period=by_period)
        assert np.max(np.abs(run(scheme, r)[-n:])) < 1e-3 * before, by_period
    two = RepetitiveBasis(
        dataclasses.replace(HARMONICS, orders=(1, 2)), gain=gains[:4], lead=leads[:4]
    )
    assert 0.1 * before < np.max(np.abs(run(two, r)[-n:])) < before  # the third


def test_an_angle_takes_the_place_of_time():
    """At any speed the weights are those of the angle; the second output is the angle."""
    turns = np.cumsum(1 / (n * (1 + 0.3 * np.sin(np.arange(3001) / 400))))
    scheme = RepetitiveBasis(Harmonics(1.0, (1,)), gain=0.1, lead=0.0, angle=1)

    @jax.jit
    def closed(turns):
        def tick(carry, angle):
            state, y = carry
            d = jnp.cos(2 * jnp.pi * angle)
            sample = Sample(jnp.zeros(2), None, jnp.stack([y, angle]), None, DT)
            state, u = scheme.act(state, sample)
            return (state, u[0] + d), y

        task = Task(jnp.zeros((3001, 2)), dt=DT, inputs=1)
        return jax.lax.scan(tick, (scheme.initial_state(task), 0.0), turns)[1]

    y = np.abs(closed(turns))
    assert y[-100:].max() < 0.1 * y[:30].max()


def test_what_does_not_fit_is_said():
    task = Task(np.zeros(101), dt=DT)
    with pytest.raises(ValueError, match=r"angle = 1 is none of the task's outputs 0..0"):
        RepetitiveBasis(HARMONICS, gain=1.0, angle=1).check(task)
    with pytest.raises(ValueError, match="angle = 0 is the only output of the task; allowed is"):
        RepetitiveBasis(HARMONICS, gain=1.0, angle=0).check(task)
    with pytest.raises(ValueError, match=r"functions.pitch has shape \(2,\); allowed is \(\), one"):
        RepetitiveBasis(Harmonics((0.05, 0.06)), gain=1.0).check(task)
    with pytest.raises(ValueError, match="RepetitiveBasis works channel by channel"):
        RepetitiveBasis(HARMONICS, gain=1.0).check(Task(np.zeros((101, 2)), dt=DT, inputs=1))


@pytest.mark.thorough
def test_the_map_of_a_period_tells_how_fast_the_error_falls_or_grows():
    """Random gains, functions and lengths of a period, by the simulator's own long run."""
    rng, verdicts, last = np.random.default_rng(6), [], n * 400
    for functions in (
        HARMONICS,
        Harmonics(24.5 * DT, (0, 2)),
        Splines(0.0, n * DT, 5, degree=1, closed=True),
    ):
        for by_period, gain in ((False, 0.05), (False, 0.4), (True, 0.02), (True, 0.2)):
            gains = gain * rng.uniform(0.7, 1.3, len(functions.names))
            scheme = RepetitiveBasis(functions, gains, lead=5 * DT, keep=1.0, by_period=by_period)
            found = basis_condition(
                Machine(PLANT), WithFeedback(scheme, PID(kp=0.4)), Task(np.zeros(60), dt=DT)
            )
            e = np.abs(run(scheme, jnp.zeros(last).at[1:3].set(1.0)))
            early, late = (np.max(e[k * 49 : (k + 10) * 49]) for k in (100, 190))
            rate = (late / early) ** (found.period / DT / (90 * 49))
            np.testing.assert_allclose(found.condition.value, rate, rtol=0.01)
            verdicts.append(found.condition.verdict)
    assert {*verdicts} == {"holds", "fails"}


REFUSED = {
    "scheme is a PID; allowed are a RepetitiveBasis of the time": PID(kp=0.4),
    "scheme is a RepetitiveBasis of an angle": RepetitiveBasis(HARMONICS, 0.1, angle=0),
    "the period is 31.4159265 samples": RepetitiveBasis(Harmonics(np.pi * 1e-2, (1,)), 0.1),
    "one of which up to 64 make a": RepetitiveBasis(Harmonics(2e-2 + 1e-3 / 65, (1,)), 0.1),
    "take 3,000,000; allowed are 131,072": RepetitiveBasis(Harmonics(3e3, (1,)), 0.1),
    "functions.closed = False, of splines that end": RepetitiveBasis(Splines(0.0, n * DT, 5), 0.1),
}
test_what_has_no_map_of_a_period_is_refused = refused(
    REFUSED, lambda scheme: basis_condition(Machine(PLANT), scheme, Task(np.zeros(60), dt=DT))
)


def test_splines_that_begin_later_have_the_map_of_a_period_of_those_from_0():
    """All of the loop is 3 samples later, the end of the period at which weights change, too."""
    early, late = (
        basis_condition(
            Machine(PLANT),
            RepetitiveBasis(
                Splines(low, low + n * DT, 5, degree=1, closed=True), 0.05, by_period=True
            ),
            Task(np.zeros(60), dt=DT),
        ).condition.value
        for low in (0.0, 3 * DT)
    )
    np.testing.assert_allclose(late, early, rtol=1e-9)


@pytest.mark.thorough
def test_a_limit_and_a_family_are_told():
    task, basis = Task(np.zeros(60), dt=DT), RepetitiveBasis(HARMONICS, 0.1, lead=5 * DT)
    found = basis_condition(Machine(PLANT, actuator=Actuator(limit=1.0)), basis, task).condition
    assert (found.verdict, len(found.broken)) == ("not claimed", 1)
    drawn = Population(Machine(PLANT), {"plant.B": Uniform(0.8, 1.2, relative=True)}, count=5)
    worst = basis_condition(drawn, basis, task)
    each = [
        basis_condition(drawn.machine_of(i), basis, task).condition.value for i in range(drawn.size)
    ]
    assert worst.condition.value == max(each) > min(each)
    assert worst.at == {"plant.B": drawn.drawn["plant.B"][np.argmax(each)]}


@pytest.mark.parametrize("by_period", [False, True])
def test_what_splines_hold_is_removed_at_the_input_and_what_harmonics_hold_anywhere(by_period):
    """A loop makes of a harmonic another size and phase of it, and of a spline no spline."""
    splines, last = Splines(0.0, n * DT, 5, degree=1, closed=True), 24_000
    force = np.asarray(splines.at(DT * np.arange(last))) @ [0.5, -1.0, 0.3, 0.8, -0.6]
    moved = Machine(PLANT, disturbance=Disturbance(input=force[:, None]))
    of_splines, of_harmonics = (
        RepetitiveBasis(functions, gain, lead=5 * DT, by_period=by_period)
        for functions, gain in ((splines, 0.05), (HARMONICS, 0.1 if by_period else 0.05))
    )
    beside = WithFeedback(of_splines, PID(kp=0.4))
    task = Task(np.zeros(last + 1), dt=DT)
    assert basis_condition(moved, beside, task).condition.holds
    e = np.abs(learn(moved, beside, task, 1).final.e[:, 0])
    assert e[-n:].max() < 1e-4 * e[: 4 * n].max()
    left = np.abs(run(of_splines, jnp.asarray(np.resize(force, last + 1))))
    assert left[-n:].max() > 0.05 * left[: 4 * n].max()
    left = np.abs(run(of_harmonics, jnp.asarray(repeating(last + 1))))
    assert left[-n:].max() < 1e-4 * left[: 4 * n].max()
