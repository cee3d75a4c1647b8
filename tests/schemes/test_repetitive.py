"""Repetitive control against a recursion in plain Python, and against its own sensitivity."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxilc import Machine, Task, theory
from jaxilc.learning import run_trial
from jaxilc.plants import StateSpace
from jaxilc.schemes import (
    PID,
    LearningFilter,
    RepetitiveControl,
    WithFeedback,
    harmonic_taps,
    learning_filter,
)
from jaxilc.schemes.repetitive import AROUND, lagrange
from jaxilc.theory.on_lines import MeasuredResponse
from jaxilc.uncertainty import Population, Uniform

DT, PERIOD = 1e-3, 0.05
PLANT = StateSpace([[0.9, 0.1], [0.0, 0.7]], [[0.0], [0.3]], [[1.0, 0.0]], dt=DT)
LAW = LearningFilter((0.3, 0.9, 0.3), keep=(0.2, 0.55, 0.2), lead=2)
FEEDBACK = PID(kp=0.4)


def size_of_wave(e, wave):
    """The amplitude of a wave, exp(-i w k), in an error (N,)."""
    return np.linalg.norm(np.linalg.lstsq(np.stack([wave.real, wave.imag], axis=1), e)[0])


def task_of(reference):
    return Task(np.asarray(reference, float), dt=DT)


@jax.jit
def run(scheme, r, plant=PLANT):
    task = Task(r, dt=DT)
    return run_trial(Machine(plant), scheme, task, scheme.initial_memory(task), jax.random.key(0))


@pytest.mark.thorough(but=["0.0504"])
@pytest.mark.parametrize("period", [PERIOD, 0.0504, 0.0621])
def test_what_is_left_at_each_frequency_is_the_sensitivity(period):
    """A sinusoid long after its start, over that under the feedback alone."""
    law = learning_filter((0.0, 0.8, 0.0), (0.1, 0.2, 0.4, 0.2, 0.1), lead=3)
    scheme = WithFeedback(RepetitiveControl(law, period), FEEDBACK)
    task = task_of(np.zeros(101))
    found = theory.repetitive_condition(Machine(PLANT), scheme, task)
    assert found.test.condition.holds, found.test.condition
    for at in (9, 32, 50, 112):
        f = found.frequencies[at]
        k = np.arange(6001)
        r = np.sin(2 * np.pi * f * DT * k)
        late = slice(4000, 6000)
        wave = np.exp(-2j * np.pi * f * DT * k[late])
        sizes = []
        for one in (scheme, FEEDBACK):
            sizes.append(size_of_wave(np.asarray(run(one, r).e)[late, 0], wave))
        assert sizes[0] / sizes[1] == pytest.approx(found.sensitivity[at], rel=2e-3), at


def a_period_later(plant, kp, law, *periods):
    """The map of plant, P feedback and all memories over the first period, dense, for r = 0.

    Several periods are those of as many controls in parallel.
    """
    A, B, C = (np.asarray(M, float) for M in (plant.A, plant.B, plant.C))
    L, keep, size = np.asarray(law.L), np.asarray(law.keep), len(A)
    around = np.arange(-1, 3)  # the value at n is the cubic through those at whole + around
    M = int(max(periods)) + 8  # samples, the newest first, behind the state of the plant
    unit = np.eye(size + (1 + len(periods)) * M)  # e, and v of each
    e_now, v_now = np.concatenate([-C[0], 0 * unit[0, size:]]), []
    for own, n in enumerate(periods, 1):
        whole = int(n)
        weights = np.linalg.solve(np.vander(around, increasing=True).T, (n - whole) ** np.arange(4))
        v = 0 * e_now
        for weight, later in zip(weights, around, strict=True):
            for i, tap in enumerate(keep):
                v += weight * tap * unit[size + own * M + whole + later - i + len(keep) // 2 - 1]
            for i, tap in enumerate(L):
                late = whole + later - 1 - law.lead - i + len(L) // 2
                v += weight * tap * (e_now if late == 0 else unit[size + late - 1])
        v_now.append(v)
    step = 0 * unit
    step[:size, :size] = A
    step[:size] += B @ (sum(v_now) + kp * e_now)[None]
    for i, now in enumerate((e_now, *v_now)):
        first = size + i * M
        step[first], step[first + 1 : first + M] = now, unit[first : first + M - 1]
    return np.linalg.matrix_power(step, int(periods[0]))


def largest_pole(dense):
    return np.max(np.abs(np.linalg.eigvals(dense)))


@pytest.mark.thorough
def test_the_dense_map_of_a_period_never_contradicts_the_condition():
    """Where the condition holds, each state of machine and memory dies out over the periods."""
    rng, task, held, unstable = np.random.default_rng(3), task_of(np.zeros(101)), 0, 0
    for n in (9, 14.4) * 10:
        A = rng.normal(size=(2, 2))
        A *= rng.uniform(0.3, 0.95) / largest_pole(A)
        plant = StateSpace(A, rng.normal(size=(2, 1)), rng.normal(size=(1, 2)), dt=DT)
        L, lead = rng.normal(0, 0.2, 3), int(rng.integers(0, 3))
        law = LearningFilter(L, keep=(0.1, rng.uniform(0.6, 0.8), 0.1), lead=lead)
        kp = rng.normal(0, 0.1)
        scheme = WithFeedback(RepetitiveControl(law, n * DT), PID(kp=kp))
        found = theory.repetitive_condition(Machine(plant), scheme, task)
        radius = largest_pole(a_period_later(plant, kp, law, n))
        held, unstable = held + found.test.condition.holds, unstable + (radius > 1)
        assert not found.test.condition.holds or radius < 1, (radius, found.test.condition)
    assert held > 3, held
    assert unstable > 3, unstable


@pytest.mark.thorough
def test_over_a_long_period_the_dense_map_contracts_as_the_condition_tells():
    """The roots of z^n = (Q - L T)(z) come near the circle, and their z^n as 1 / n to the value."""
    task = task_of(np.zeros(101))
    for gain in (0.8, 9.0):
        law, off = learning_filter((0.0, gain, 0.0), lead=3), []
        for n in (50, 200):
            scheme = WithFeedback(RepetitiveControl(law, n * DT), FEEDBACK)
            value = theory.repetitive_condition(Machine(PLANT), scheme, task).test.condition.value
            off.append(abs(largest_pole(a_period_later(PLANT, 0.4, law, n)) / value - 1))
        assert off[1] < min(0.06, 0.3 * off[0]), off


@pytest.mark.thorough
def test_of_a_family_the_worst_machine_and_the_largest_sensitivity_are_told():
    law = learning_filter((0.0, 0.8, 0.0), (0.1, 0.2, 0.4, 0.2, 0.1), lead=3)
    scheme, task = WithFeedback(RepetitiveControl(law, PERIOD), FEEDBACK), task_of(np.zeros(101))
    spread = {"plant.B": Uniform(0.5, 3.5, relative=True)}
    family = Population(Machine(PLANT), spread, count=3, seed=11)
    assert np.argmin(family.drawn["plant.B"]) == 1  # which is the worst
    found = theory.repetitive_condition(family, scheme, task)
    each = [theory.repetitive_condition(family.machine_of(i), scheme, task) for i in range(3)]
    values = [one.test.condition.value for one in each]
    assert found.test.condition.value == max(values) > values[0]
    assert found.at == {"plant.B": family.drawn["plant.B"][np.argmax(values)]}
    for name in ("sensitivity", "left"):
        most = np.max([getattr(one, name) for one in each], axis=0)
        np.testing.assert_array_equal(getattr(found, name), most)


def test_on_measured_lines_the_condition_holds_all_that_their_doubt_allows():
    """P, C, Q and L by NumPy; responses at the edge of the doubt come near its bound, none beyond.

    C is the PI feedback kp + ki dt / (1 - z^-1) with its sum after the sample.
    """
    kp, ki, f = 0.3, 6.0, np.linspace(4.0, 470.0, 160)
    A, B = np.array([[0.9, 0.1], [0.0, 0.7]]), np.array([0.0, 0.3])

    def at(f):
        z = np.exp(2j * np.pi * DT * f)
        P = np.array([np.linalg.solve(one * np.eye(2) - A, B)[0] for one in z])
        return P, kp + ki * DT * z / (z - 1), 0.5 + 0.4 * np.cos(2 * np.pi * DT * f), 0.6 * z**4

    rng, (P, C, Q, L) = np.random.default_rng(0), at(f)
    law = LearningFilter((0.0, 0.6, 0.0), keep=(0.2, 0.5, 0.2), lead=3)
    scheme = WithFeedback(RepetitiveControl(law, PERIOD), PID(kp=kp, ki=ki))
    task = task_of(np.zeros(101))
    std = 0.03 * np.abs(P)
    exact, found = (
        theory.repetitive_condition(MeasuredResponse(f, P, of), scheme, task) for of in (0 * f, std)
    )
    np.testing.assert_allclose(exact.test.magnitude, np.abs(Q - L * P / (1 + C * P)), rtol=1e-9)
    turned = np.exp(2j * np.pi * rng.random((400, 1)))
    near = P + 3 * std * turned
    share = np.abs(Q - L * near / (1 + C * near)) / found.test.magnitude
    assert share.max() < 1 + 1e-12
    assert np.median(share.max(axis=0)) > 0.99
    assert found.test.condition.verdict == "not claimed"  # lines tell no poles
    beyond = MeasuredResponse(np.append(f, 600.0), np.append(P, 0), np.append(std, 0))
    P, C, Q, L = at(exact.frequencies)
    W = np.exp(-2j * np.pi * PERIOD * exact.frequencies)
    S = (1 - W * Q) / (1 - W * (Q - L * P / (1 + C * P)))
    np.testing.assert_allclose(exact.sensitivity, np.abs(S), rtol=0.02)
    wanted = r"lines go from 4 to 600 Hz; allowed are those up to Nyquist, 500"
    with pytest.raises(ValueError, match=wanted):
        theory.repetitive_condition(beyond, scheme, task)
    up_to = np.fft.rfftfreq(120, DT)[1:]
    assert up_to[-1] > 0.5 / DT, "the last line is the Nyquist frequency, but for rounding"
    there = MeasuredResponse(up_to, at(up_to)[0], 0 * up_to)
    assert len(theory.repetitive_condition(there, scheme, task).test.magnitude) == 60


def test_a_wrong_period_costs_what_is_told():
    law = learning_filter((0.0, 0.8, 0.0), (0.1, 0.2, 0.4, 0.2, 0.1), lead=3)
    scheme = WithFeedback(RepetitiveControl(law, PERIOD), FEEDBACK)
    about = Machine(PLANT), scheme, task_of(np.zeros(101))
    right, wrong = (theory.repetitive_condition(*about, wrong=by) for by in (0.0, 0.02))
    assert wrong.harmonics[0] == pytest.approx(1 / (1.02 * PERIOD))
    assert wrong.left[0] > 3 * right.left[0]
    assert right.worst > 1.0  # the waterbed


@pytest.mark.thorough
def test_two_periods_at_once_are_each_learned_and_what_is_left_is_told():
    """Against the sensitivity at each frequency, with a law that is good enough for both.

    Neither period is a whole number of samples, nor is their sum.
    """
    pair, inverse = (0.0504, 0.0633), np.array([-0.75, 2.5, 0.0])
    law = LearningFilter(0.8 * inverse, keep=(0.0, 0.9, 0.0))
    plant = StateSpace([[0.3]], [[0.4]], [[1.0]], dt=DT)
    model = Machine(plant)
    scheme, alone = RepetitiveControl(law, pair), RepetitiveControl(law, pair[0])
    task = task_of(np.zeros(101))
    found = theory.repetitive_condition(model, scheme, task)
    one = theory.repetitive_condition(model, alone, task)
    assert found.test.condition.value == pytest.approx(3 * one.test.condition.value, rel=1e-6)
    assert found.test.condition.holds
    assert set(np.round(1 / np.array(pair), 6)) <= set(np.round(found.harmonics, 6))
    assert found.worst > 1.5 * one.worst > 1.5  # the waterbed of two
    k = np.arange(4001)
    for at in (5, 50, 116, 200):
        f, late = found.frequencies[at], slice(2000, 4000)
        wave = np.exp(-2j * np.pi * f * DT * k)
        size = size_of_wave(np.asarray(run(scheme, wave.real, plant).e)[late, 0], wave[late])
        assert size == pytest.approx(found.sensitivity[at], rel=3e-3), f
    left = found.left[[np.argmin(np.abs(found.harmonics - 1 / period)) for period in pair]]
    assert np.all(left < 0.35)


@pytest.mark.thorough
def test_of_two_channels_the_largest_singular_values_are_told():
    """Condition and sensitivity by NumPy, of a plant whose channels act on each other."""
    A, B = np.array([[0.8, 0.05], [0.1, 0.7]]), np.array([[0.2, 0.02], [0.0, 0.3]])
    law = LearningFilter((0.1, 0.3, 0.1), keep=(0.1, 0.8, 0.1), lead=1)
    task = Task(np.zeros((101, 2)), dt=DT)
    machine = Machine(StateSpace(A, B, np.eye(2), dt=DT))
    found = theory.repetitive_condition(machine, RepetitiveControl(law, PERIOD), task)
    z = np.exp(2j * np.pi * DT * found.frequencies)[:, None, None]
    T = np.linalg.solve(z * np.eye(2) - A, B + 0 * z)
    Q, L = (0.8 + 0.1 * (z + 1 / z)) * np.eye(2), (0.3 + 0.1 * (z + 1 / z)) * z**2
    factor, W = Q - L * T, z**-50
    S = np.eye(2) - T @ np.linalg.solve(np.eye(2) - W * factor, W * L * np.eye(2))
    np.testing.assert_allclose(found.sensitivity, np.linalg.norm(S, 2, axis=(1, 2)), rtol=1e-8)
    most = np.max(np.linalg.norm(factor, 2, axis=(1, 2)))
    assert most <= found.test.condition.value < 1.01 * most
    assert found.test.condition.holds


def in_parallel(law, periods, kp):
    one, other = (RepetitiveControl(law, n * DT) for n in periods)
    return WithFeedback(one, WithFeedback(other, PID(kp=kp)))


INVERSE = np.array([0.642, -1.6, 1.0]) / 0.03  # of `PLANT` under `FEEDBACK`
HALF = np.array([-1, 0, 9, 16, 9, 0, -1]) / 32


@pytest.mark.thorough
def test_periods_in_parallel_need_what_one_needs_and_grow_less_between_than_in_series():
    task, pair = task_of(np.zeros(101)), (50, 63.3)
    law, both = (learning_filter(INVERSE, HALF, gain=by) for by in (0.4, 0.8))
    parallel = in_parallel(law, pair, 0.4)
    series = WithFeedback(RepetitiveControl(both, tuple(n * DT for n in pair)), FEEDBACK)
    alone = WithFeedback(RepetitiveControl(both, pair[0] * DT), FEEDBACK)
    found, other, one = (
        theory.repetitive_condition(Machine(PLANT), of, task) for of in (parallel, series, alone)
    )
    assert found.test.condition.holds
    assert found.test.condition.value == pytest.approx(one.test.condition.value)
    assert one.worst < found.worst < 0.8 * other.worst
    k, late = np.arange(6001), slice(4000, 6000)
    for at in (5, 50, 116):
        wave, sizes = np.exp(-2j * np.pi * found.frequencies[at] * DT * k), []
        for of in (parallel, FEEDBACK):
            e = np.asarray(run(of, wave.real).e)[late, 0]
            sizes.append(size_of_wave(e, wave[late]))
        assert sizes[0] / sizes[1] == pytest.approx(found.sensitivity[at], rel=1e-3)


def test_the_dense_map_never_contradicts_the_condition_of_periods_in_parallel():
    rng, task, held, unstable = np.random.default_rng(7), task_of(np.zeros(101)), 0, 0
    for _ in range(6):
        plant = StateSpace([[rng.uniform(-0.5, 0.8)]], [[1.0]], [[rng.uniform(0.3, 1)]], dt=DT)
        law = LearningFilter(rng.uniform(-0.1, 0.8, 3), keep=(0.1, 0.75, 0.1))
        kp, periods = rng.normal(0, 0.1), (9, 14.4)
        scheme = in_parallel(law, periods, kp)
        found = theory.repetitive_condition(Machine(plant), scheme, task).test.condition
        radius = largest_pole(a_period_later(plant, kp, law, *periods))
        held, unstable = held + found.holds, unstable + (radius > 1)
        assert not found.holds or radius < 1, (radius, found)
    assert held > 1, held
    assert unstable > 1, unstable


@pytest.mark.thorough
def test_each_harmonic_has_a_gain_of_its_own():
    """The second harmonic of a run is left as it is, and the condition says so at each of them."""
    k, learned = np.arange(3001), np.array([1.0, 1.0, 0.0, 1.0])
    z = np.exp(2j * np.pi / 50 * np.arange(4))
    T = 0.03 / (z**2 - 1.6 * z + 0.642)
    L = harmonic_taps(0.8 * learned / (z * T), PERIOD, dt=DT)  # of e a sample later
    law = LearningFilter(L, keep=harmonic_taps(0.99 * learned, PERIOD, dt=DT))
    scheme = WithFeedback(RepetitiveControl(law, PERIOD), FEEDBACK)
    found = theory.repetitive_condition(Machine(PLANT), scheme, task_of(np.zeros(101)))
    assert found.test.condition.holds
    np.testing.assert_allclose(found.factor[:4], [0.19, 0, 0.19, 0], atol=1e-6)
    np.testing.assert_allclose(found.left[:4], [0.01 / 0.81, 1, 0.01 / 0.81, 1], rtol=1e-6)
    waves = np.exp(2j * np.pi / 50 * np.outer(k[-500:], (1, 2, 3)))
    r = sum(np.sin(2 * np.pi * h * k / 50) for h in (1, 2, 3))
    sizes = [np.abs(np.asarray(run(of, r).e)[-500:, 0] @ waves) for of in (scheme, FEEDBACK)]
    np.testing.assert_allclose(sizes[0] / sizes[1], found.left[:3], rtol=1e-3)


@pytest.mark.thorough(but=["50", "50.4"])
@pytest.mark.parametrize("n", [9, 50, 50.4, 61.37])
def test_taps_of_harmonics_have_their_values_there_and_a_slope(n):
    values = np.array([1.0, 0.8, 0.5 - 0.3j, 0.2j])
    taps = harmonic_taps(values, n * DT, dt=DT)
    p = np.arange(len(taps)) - len(taps) // 2
    found = [np.sum(taps * np.exp(2j * np.pi * h * p / n)) for h in range(int(n / 2) + 1)]
    np.testing.assert_allclose(found[:4], values, atol=1e-12)
    np.testing.assert_allclose(found[4:], 0, atol=1e-12)
    slopes = jax.jit(jax.jacobian(lambda g: harmonic_taps(g, n * DT, dt=DT)))(np.ones(3))
    one = harmonic_taps(np.array([0, 1.0]), n * DT, dt=DT)
    np.testing.assert_allclose(slopes[:, 1], one, atol=1e-12)


def test_a_traced_period_out_of_range_is_no_other_period():
    task = task_of(np.sin(2 * np.pi * np.arange(201) / 50))

    @jax.jit
    def largest(period):
        scheme = WithFeedback(RepetitiveControl(LAW, period, longest=0.0625), FEEDBACK)
        return jnp.max(jnp.abs(run(scheme, task.reference[:, 0]).e))

    for period, fits in ((0.006, True), (0.0625, True), (0.005, False), (0.08, False)):
        assert np.isfinite(largest(period)) == fits, period
    with pytest.raises(ValueError, match="longest = None, and period is traced"):
        jax.eval_shape(lambda p: RepetitiveControl(LAW, p).check(task), 0.05)
    with pytest.raises(ValueError, match=r"longest = 1000000000000 take .*longest = .* would fit"):
        RepetitiveControl(LAW, 0.05, longest=1e12).check(task)  # no such array has room


def test_the_value_between_samples_makes_nothing_larger():
    """|W| <= 1, without which the condition would not suffice for a fractional period."""
    w = np.linspace(0, np.pi, 501)
    for share in np.linspace(0, 1, 41):
        W = np.exp(-1j * np.outer(w, AROUND)) @ np.asarray(lagrange(share))
        assert np.max(np.abs(W)) < 1 + 1e-12


def test_what_does_not_fit_is_said():
    task = task_of(np.zeros(101))
    with pytest.raises(ValueError, match=r"period = 0.004 s is outside its allowed range \[0.006"):
        RepetitiveControl(LAW, 0.004).check(task)
    with pytest.raises(ValueError, match=r"period = 0.09 s is outside .* 0.0625\]"):
        dataclasses.replace(RepetitiveControl(LAW, PERIOD), period=0.09).check(task)
    with pytest.raises(ValueError, match="law is a PID; allowed is LearningFilter"):
        RepetitiveControl(FEEDBACK, PERIOD).check(task)
    with pytest.raises(ValueError, match=r"law has starts = \(40,\); allowed is \(\)"):
        RepetitiveControl(dataclasses.replace(LAW, L=[LAW.L] * 2, starts=(40,)), PERIOD).check(task)
    long = WithFeedback(RepetitiveControl(LAW, 0.4), FEEDBACK)
    with pytest.raises(ValueError, match="make 2,000,000 frequencies of a period of 400 samples"):
        theory.repetitive_condition(Machine(PLANT), long, task, points=10_000)
    with pytest.raises(ValueError, match="scheme is a PID; allowed are a RepetitiveControl"):
        theory.repetitive_condition(Machine(PLANT), FEEDBACK, task)
    other = dataclasses.replace(
        in_parallel(LAW, (50, 60), 0.4), learning=RepetitiveControl(LAW, (0.05, 0.06))
    )
    with pytest.raises(ValueError, match="2 RepetitiveControl in parallel; allowed are"):
        theory.repetitive_condition(Machine(PLANT), other, task)
    with pytest.raises(ValueError, match=r"values has shape \(5,\); allowed is \(H,\) of up to 4"):
        harmonic_taps(np.ones(5), 7 * DT, dt=DT)
    with pytest.raises(ValueError, match=r"reach = 3 samples; allowed is \[25, inf\)"):
        harmonic_taps(np.ones(5), PERIOD, dt=DT, reach=3)
