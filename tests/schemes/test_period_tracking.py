"""A period that is tracked: against a recursion in plain NumPy, and where it locks."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxilc import Machine, Task, theory
from jaxilc.learning import run_trial
from jaxilc.learning.machine import Actuator, Disturbance, Sensor
from jaxilc.plants import StateSpace
from jaxilc.schemes import (
    PID,
    LearningFilter,
    OnOutputs,
    PeriodTracking,
    RepetitiveControl,
    WithFeedback,
    learning_filter,
)
from jaxilc.theory.repetitive import SLOPE, largest_gain

DT, PERIOD, N = 1e-3, 0.05, 4000
PLANT = StateSpace([[0.9, 0.1], [0.0, 0.7]], [[0.0], [0.3]], [[1.0, 0.0]], dt=DT)
TWO = StateSpace(PLANT.A, PLANT.B, [[1.0, 0.0], [0.0, 0.0]], dt=DT)  # with the angle beside
ODD = LearningFilter((0.3, 0.9, 0.3), keep=(0.2, 0.55, 0.2), lead=2)
INVERSE = np.array([0.642, -1.6, 1.0]) / 0.03  # of plant and feedback
LAW = learning_filter(INVERSE, np.array([-1, 0, 9, 16, 9, 0, -1]) / 32, gain=0.8)
TRACKING = PeriodTracking(within=0.08, fastest=2e-3)


def drifting(by, samples=N + 1):
    """The phase [periods] and the period [s], which drifts by a share over the run."""
    period = PERIOD * (1 + by * np.arange(samples) / samples)
    return np.concatenate([[0], np.cumsum(DT / period)[:-1]]), period


def scheme_of(tracking, law=LAW, period=PERIOD):
    return WithFeedback(RepetitiveControl(law, period, tracking=tracking), PID(kp=0.4))


@jax.jit
def run(scheme, r, noise=0.0, limit=1e6):
    machine = Machine(PLANT, sensor=Sensor(noise=noise), actuator=Actuator(limit=limit))
    task = Task(r, dt=DT)
    trial = run_trial(machine, scheme, task, scheme.initial_memory(task), jax.random.key(0))
    return trial.e[:, 0], trial.signals.get("learning.period", jnp.zeros((1, 1)))[:, 0]


@jax.jit
def run_with_angle(scheme, r, angle):
    """The machine has a second output: the angle."""
    beside = Disturbance(output=jnp.stack([jnp.zeros_like(angle), angle], axis=1))
    machine = Machine(TWO, disturbance=beside)
    task = Task(jnp.stack([r, jnp.zeros_like(r)], axis=1), dt=DT, inputs=1)
    trial = run_trial(machine, scheme, task, scheme.initial_memory(task), jax.random.key(0))
    return trial.e[:, 0], trial.signals["learning.period"][:, 0]


def with_angle(tracking, law=LAW):
    learning = RepetitiveControl(law, PERIOD, tracking=dataclasses.replace(tracking, angle=1))
    return WithFeedback(learning, OnOutputs(PID(kp=0.4), (0,)))


def last(e):
    return float(np.sqrt(np.mean(np.square(np.asarray(e)[-N // 2 :]))))


def between(x, at):
    """x at a place between samples, by the cubic through four of them; zero before the start."""
    first = int(np.floor(at)) - 1
    return cubic([x[i] if 0 <= i < len(x) else 0.0 for i in range(first, first + 4)], at - first)


def cubic(four, at):
    """The cubic through four numbers or rows, at a place from 0 to 3."""
    return np.polyval(np.polyfit(np.arange(4.0), four, 3), at)


def by_hand(r, angle, tracking):
    """(e, period) of plant, P feedback and the law `ODD`, sample by sample."""
    A, B, C = np.array([[0.9, 0.1], [0.0, 0.7]]), np.array([0.0, 0.3]), np.array([1.0, 0.0])
    names = "within", "fastest", "rate"
    within, fastest, rate = (float(getattr(tracking, x, 0.0)) for x in names)
    x, e, v, told = np.zeros(2), np.zeros(len(r)), np.zeros(len(r) - 1), np.zeros(len(r) - 1)
    n, drift, of_correction, of_slope = PERIOD / DT, 0.0, 0.0, 0.0  # in samples
    for k in range(len(r) - 1):
        e[k] = r[k] - C @ x
        i, found = k - 4, 0.0  # where correction and slope are known
        if tracking and angle is None:
            here = np.dot((0.3, 0.9, 0.3), [e[j] if j >= 0 else 0.0 for j in (i + 2, i + 3, i + 4)])
            slope = ((v[i + 1] if i >= -1 else 0) - (v[i - 1] if i >= 1 else 0)) / 2
            of_correction = (1 - 1 / n) * of_correction + here**2
            of_slope = (1 - 1 / n) * of_slope + slope**2
            size = of_slope + of_correction / (within * PERIOD / DT) ** 2
            found = -here * slope / size * n if size else 0.0
        elif tracking and angle[k] >= angle[0] + 1:
            found = k - np.interp(angle[k] - 1, angle[: k + 1], np.arange(k + 1)) - n
        drift = np.clip(drift + rate**2 / 4 * found / n**2, -fastest, fastest)
        new = n + np.clip(rate * found / n + drift, -fastest, fastest)
        n = np.clip(new, (1 - within) * PERIOD / DT, (1 + within) * PERIOD / DT)
        drift = drift if n == new else 0.0
        told[k] = n * DT
        for m, (L, keep) in zip((-1, 0, 1), ((0.3, 0.2), (0.9, 0.55), (0.3, 0.2)), strict=True):
            v[k] += keep * between(v[:k], k - n + m) + L * between(e[: k + 1], k - n + 3 + m)
        x = A @ x + B * (v[k] + 0.4 * e[k])
    e[-1] = r[-1] - C @ x
    return e, told


@pytest.mark.parametrize("how", ["fixed", "tracked", "measured"])
def test_it_is_the_recursion_by_hand(how):
    tracking = None if how == "fixed" else PeriodTracking(within=0.04, fastest=0.01)
    phase, _ = drifting(0.1, 601)  # beyond the range
    r = np.sin(2 * np.pi * phase) + 0.01 * np.random.default_rng(0).normal(size=601)
    if how == "measured":
        found = run_with_angle(with_angle(tracking, ODD), r, phase)
    else:
        found = run(scheme_of(tracking, ODD), r)
    e, period = by_hand(r, phase if how == "measured" else None, tracking)
    np.testing.assert_allclose(found[0], e, atol=1e-8 if tracking else 1e-10)
    if tracking:
        assert np.max(period) > 1.03 * PERIOD
        np.testing.assert_allclose(found[1], period, rtol=1e-8)


@pytest.mark.thorough(but=["0.04"])
@pytest.mark.parametrize("by", [0.04, -0.04])
def test_a_drifting_period_costs_no_more_than_if_it_were_known(by):
    """Against a period that stays, the best of those, and the angle that is measured exactly."""
    phase, period = drifting(by)
    r = np.sin(2 * np.pi * phase) + 0.3 * np.sin(6 * np.pi * phase)
    fixed = min(
        last(run(scheme_of(None, period=p), r)[0])
        for p in PERIOD * (1 + by * np.arange(0, 1.1, 0.25))
    )
    e, found = run(scheme_of(TRACKING), r)
    known = last(run_with_angle(with_angle(TRACKING), r, phase)[0])
    assert last(e) < 1.2 * known < 0.05 * fixed
    np.testing.assert_allclose(found[1500:], period[1500:-1], rtol=1e-3)


@pytest.mark.thorough
def test_it_locks_from_a_wrong_guess_up_to_half_of_the_shortest_wave():
    k = np.arange(N + 1)
    for harmonics, off, locks in (
        ((1, 3), -0.15, True),
        ((1, 3), 0.15, True),
        ((5,), 0.09, True),
        ((5,), 0.12, False),
        ((5,), -0.12, False),
    ):
        r = sum(np.sin(2 * np.pi * i * k * DT / PERIOD) / i for i in harmonics)
        tracking = PeriodTracking(within=0.2, fastest=5e-3)
        period = PERIOD * (1 + off)
        learning = RepetitiveControl(LAW, period, longest=0.08, tracking=tracking)
        found = run(WithFeedback(learning, PID(kp=0.4)), r)[1]
        assert (abs(found[-1] / PERIOD - 1) < 1e-3) == locks, (harmonics, off, found[-1])


@pytest.mark.thorough
def test_noise_limits_and_nothing_to_track_keep_it_near():
    phase, period = drifting(0.04)
    r = np.sin(2 * np.pi * phase)
    plain = last(run(scheme_of(None), r)[0])
    for noise, limit in ((0.03, 1e6), (0.0, 1.2)):
        e, found = run(scheme_of(TRACKING), r, noise, limit)
        assert last(e) < 0.8 * plain, (noise, limit)
        assert np.max(np.abs(found[2000:] / period[2000:-1] - 1)) < 0.01, (noise, limit)
    _, found = run(scheme_of(TRACKING), np.zeros(N + 1))
    np.testing.assert_array_equal(found, PERIOD)
    _, found = run(scheme_of(TRACKING), np.zeros(N + 1), 0.05)  # noise alone has no period
    assert np.all((found >= 0.92 * PERIOD) & (found <= 1.08 * PERIOD))


def test_a_delay_that_changes_makes_nothing_larger_than_is_claimed():
    """The norm of dense delays, for periods that change as fast as they may in any direction."""
    rng, k = np.random.default_rng(0), np.arange(160)
    for fastest in (1e-3, 0.02, 0.3):
        most = largest_gain(fastest)
        for moved in (k, -k, rng.choice([-1, 1], 160).cumsum(), abs(k % 40 - 20)):
            n = 70.4 + fastest * moved
            W = np.zeros((160, 300))
            for i in k:
                row = np.eye(300)[i + 100 - int(n[i]) - 2 : i + 100 - int(n[i]) + 2]
                W[i] = cubic(row, 2 - n[i] % 1)
            assert np.linalg.norm(W, 2) < most, fastest
        h = np.arange(1, 2001)
        seen, slope = ((2 * h + 4) / (1 - fastest) + 1) / (2 * h + 1), SLOPE * fastest * h
        bound = np.sqrt(seen) + slope * np.sqrt(6 / (1 - fastest) + 1)
        np.testing.assert_allclose(most, np.min(bound), rtol=1e-4)
    assert largest_gain(0.0) == 1.0
    steep = np.gradient(cubic(np.eye(4), np.linspace(1, 2, 2001)[:, None]), 5e-4, axis=0)
    assert 0.98 * SLOPE < np.max(np.linalg.norm(steep, axis=1)) < SLOPE


def test_the_condition_of_a_tracked_period_holds_whatever_is_tracked():
    """An angle that makes no sense moves the period as fast as it may: all stays bounded."""
    task = Task(np.zeros((101, 2)), dt=DT, inputs=1)
    tracking = PeriodTracking(within=0.2, fastest=2e-3, angle=1)
    scheme = with_angle(tracking)
    found = theory.repetitive_condition(Machine(TWO), scheme, task)
    alone = theory.repetitive_condition(Machine(PLANT), scheme_of(None), Task(np.zeros(101), dt=DT))
    value = largest_gain(2e-3) * alone.test.condition.value
    assert found.test.condition.value == pytest.approx(value, rel=1e-6)
    assert found.test.condition.holds
    np.testing.assert_allclose(found.sensitivity, alone.sensitivity, rtol=1e-9)
    angle = np.cumsum(np.random.default_rng(0).uniform(0, 0.05, N + 1))
    e, period = run_with_angle(scheme, np.sin(2 * np.pi * DT / PERIOD * np.arange(N + 1)), angle)
    assert np.ptp(period) > 0.1 * PERIOD
    assert np.max(np.abs(e)) < 4.0


def test_a_period_that_is_tracked_wrong_stays_bounded_and_converges_once_it_stays():
    """An angle that counts wrong in the first half, of what repeats in the period of the scheme."""
    scheme = with_angle(PeriodTracking(within=0.2, fastest=2e-3, angle=1))
    t, half = DT * np.arange(N + 1), N // 2
    rate = 1 + 0.25 * np.sin(2 * np.pi * t) * (t < DT * half)
    e, _ = run_with_angle(scheme, np.sin(2 * np.pi * t / PERIOD), np.cumsum(DT / PERIOD * rate))
    wrong, rest = (np.abs(part).max() for part in (e[half - 500 : half], e[-500:]))
    assert 100 * rest < wrong < 4.0, (wrong, rest)


def test_what_does_not_fit_is_said():
    task = Task(np.zeros(101), dt=DT)
    with pytest.raises(ValueError, match=r"period has shape \(2,\); allowed is \(\), one period, "):
        RepetitiveControl(LAW, (0.05, 0.06), tracking=TRACKING).check(task)
    with pytest.raises(ValueError, match=r"tracking.angle = 1 is none of the task's outputs 0..0"):
        RepetitiveControl(LAW, PERIOD, tracking=PeriodTracking(angle=1)).check(task)
    with pytest.raises(ValueError, match=r"tracking.angle = 0 is the only output of the task"):
        RepetitiveControl(LAW, PERIOD, tracking=PeriodTracking(angle=0)).check(task)
    wide = PeriodTracking(within=0.3)
    with pytest.raises(ValueError, match=r"period = 0.05 s -\+ 30 % is outside .* 0.0625\]"):
        RepetitiveControl(LAW, PERIOD, tracking=wide).check(task)
