"""These tests check the switchable filter, recursive filters and the choice of segments.

They are compared with scipy, closed forms and scalar loops.
"""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal
from cases import ALGEBRA, DT

from jaxilc.filters import (
    SwitchableFilter,
    ZeroPhaseButterworth,
    ZeroPhaseIIR,
    cutoffs_below,
    instantaneous_frequency,
    segments,
)
from jaxilc.filters.zero_phase import PRINTED_LI_2020
from jaxilc.learning import Machine, Sensor, learn
from jaxilc.plants import StateSpace
from jaxilc.schemes import Filtered, PIDType
from jaxilc.signals import Task
from jaxilc.signals.references import chirp
from jaxilc.theory.frequency import learning_condition

N = 90
# The signal neither starts nor ends at zero.
SIGNAL = np.cumsum(np.random.default_rng(2).normal(size=(N, 2)), axis=0) + 5.0
CUTOFFS, TIMES = (20.0, 110.0, 45.0), (0.025, 0.0612)


@jax.jit
def filtered(q, signal):
    return q(signal, DT)


def butterworth(cutoff, order=2, signal=SIGNAL):
    return scipy.signal.sosfiltfilt(
        scipy.signal.butter(order, cutoff, fs=1 / DT, output="sos"), signal, axis=0
    )


def share_after(t, time, width):
    """Return how far the change at `time` has progressed, from 0 to 1."""
    if width == 0:
        return float(t >= time)
    if t <= time - width / 2:
        return 0.0
    return (
        1.0 if t >= time + width / 2 else 0.5 * (1 - np.cos(np.pi * (t - time + width / 2) / width))
    )


@pytest.mark.thorough
@pytest.mark.parametrize("order", [2, 3])
@pytest.mark.parametrize("width", [0.0, 0.0117])
def test_each_segment_has_its_own_butterworth(order, width):
    parts = [butterworth(cutoff, order) for cutoff in CUTOFFS]
    expected = np.empty_like(SIGNAL)
    for k in range(N):
        first, second = (share_after(np.round(k * DT, 9), time, width) for time in TIMES)
        expected[k] = (
            (1 - first) * parts[0][k] + (first - second) * parts[1][k] + second * parts[2][k]
        )
    q = SwitchableFilter(CUTOFFS, TIMES, width, order, padding=3 * (order + 1))
    q.check(N, DT)
    np.testing.assert_allclose(filtered(q, SIGNAL), expected, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("double", [False, True])
def test_a_sample_on_a_switching_time_is_after_it(double):
    with jax.enable_x64(double):
        for k in range(1, 300, 13):
            share = SwitchableFilter([20.0, 40.0], [k * 7e-4]).weights(300, 7e-4)[1]
            assert np.flatnonzero(share)[0] == k


@pytest.mark.thorough
def test_one_segment_is_a_butterworth():
    for options in ({"order": 4, "padding": 15}, {"padding": 5}, {}):
        one = filtered(SwitchableFilter((31.0,), **options), SIGNAL)
        other = filtered(ZeroPhaseButterworth(31.0, **options), SIGNAL)
        np.testing.assert_allclose(one, other, **ALGEBRA)


def test_a_change_makes_no_step_in_what_every_segment_passes():
    """A slow sine passes unchanged.

    For white noise, the largest step is that of the signal itself only if the change has some
    width.
    """
    slow = np.sin(2 * np.pi * 3.0 * np.arange(200) * DT)[:, None]
    for width in (0.0, 0.02):
        inner = filtered(SwitchableFilter((80.0, 200.0), (0.1,), width), slow)[20:-20]
        np.testing.assert_allclose(inner, slow[20:-20], atol=1e-4)
    noise = np.random.default_rng(0).normal(size=(200, 1))

    def step(passed):
        return np.max(np.abs(np.diff(passed[97:103, 0])))

    hard, soft = (
        step(filtered(SwitchableFilter((5.0, 60.0), (0.1,), width), noise)) for width in (0.0, 0.05)
    )
    assert hard > 1.5 * soft
    assert soft < step(butterworth(60.0, signal=noise))


@pytest.mark.thorough
def test_derivatives_of_the_filter():
    def level(q):
        return jnp.sum(q(SIGNAL, DT) ** 2 * (1 + jnp.arange(N))[:, None])

    slope, level = jax.jit(jax.grad(level)), jax.jit(level)
    q = SwitchableFilter(CUTOFFS, TIMES, 0.0117)
    for name, step in (("cutoff", 1e-3), ("times", 1e-7), ("width", 1e-7)):
        found, value = getattr(slope(q), name), np.asarray(getattr(q, name))
        for i in np.ndindex(value.shape):
            moved = []
            for sign in (1, -1):
                other = value.copy()
                other[i] += sign * step
                moved.append(float(level(dataclasses.replace(q, **{name: other}))))
            expected = (moved[0] - moved[1]) / (2 * step)
            assert float(found[i]) == pytest.approx(expected, rel=1e-4), (name, i)
            assert abs(found[i]) > 1e-3
    hard = slope(dataclasses.replace(q, width=0.0))
    assert np.all(np.asarray(hard.times) == 0)
    assert float(hard.width) == 0
    assert np.all(np.abs(hard.cutoff) > 1e-3)


def test_printed_filter_of_li_2020_is_a_third_order_butterworth_with_its_gain_lost_to_rounding():
    q = ZeroPhaseIIR(**PRINTED_LI_2020, padding=12)
    np.testing.assert_allclose(
        filtered(q, SIGNAL), scipy.signal.filtfilt(q.b, q.a, SIGNAL, axis=0), rtol=1e-8, atol=1e-8
    )
    # impulse invariance: the poles are exp(s), the numerator comes from the residues of the analog
    # filter
    w = 2 * np.pi * 0.0117
    s = w * np.exp(1j * np.pi * np.array([2 / 3, 1.0, 4 / 3]))
    residues = [w**3 / np.prod([p - other for other in s if other != p]) for p in s]
    b = sum(
        r * np.poly([np.exp(other) for other in s if other != p])
        for r, p in zip(residues, s, strict=True)
    ).real
    np.testing.assert_allclose(q.a, np.poly(np.exp(s)).real, atol=2e-4)
    np.testing.assert_allclose(q.b, b, rtol=1e-2, atol=1e-9)
    assert np.sum(b) / np.sum(np.poly(np.exp(s)).real) == pytest.approx(1.0, abs=1e-6)
    assert np.sum(q.b) / np.sum(q.a) == pytest.approx(1.23, abs=5e-3)
    np.testing.assert_allclose(filtered(q, np.ones((N, 1))), 1.23**2, rtol=5e-3)


SWEEP = {"duration": 4.0, "dt": 2e-3}


@pytest.mark.parametrize("of", ["velocity", "position"])
@pytest.mark.parametrize("method", ["linear", "logarithmic"])
def test_instantaneous_frequency_of_a_chirp(of, method):
    """Li 2020, Fig. 22, without the ends, where the periodic Hilbert transform sees a jump."""
    t = np.arange(2001) * 2e-3
    true = 3 + 17 * t / 4 if method == "linear" else 3 * (20 / 3) ** (t / 4)
    inner = (t > 0.5) & (t < 3.5)
    for window, tolerance in ((0.0, 0.2), (0.1, 0.05)):
        f = instantaneous_frequency(
            chirp(1.5, 3.0, 20.0, **SWEEP, method=method), 2e-3, of=of, window=window
        )
        assert f.shape == t.shape
        np.testing.assert_allclose(f[inner], true[inner], rtol=tolerance)
    assert np.median(np.abs(f / true - 1)[inner]) < 0.01


def test_velocity_knows_no_offset_or_ramp_and_columns_are_told_apart():
    t, a, b = np.arange(2001) * 2e-3, chirp(1.0, 3.0, 20.0, **SWEEP), chirp(1.0, 12.0, 5.0, **SWEEP)
    both = instantaneous_frequency(np.stack([a, b], axis=1), 2e-3, window=0.1)
    np.testing.assert_allclose(both[:, 0], instantaneous_frequency(a, 2e-3, window=0.1), rtol=1e-9)
    np.testing.assert_allclose(both[:, 1], instantaneous_frequency(b, 2e-3, window=0.1), rtol=1e-9)
    offset = instantaneous_frequency(a + 70.0, 2e-3, window=0.1)
    np.testing.assert_allclose(offset, both[:, 0], rtol=1e-9, atol=1e-9)
    # a ramp is an offset of the velocity, which has little effect where it is small
    ramp = instantaneous_frequency(a + 0.1 * t, 2e-3, window=0.1)
    np.testing.assert_allclose(ramp[250:-250], both[250:-250, 0], rtol=0.02)


def test_where_nothing_moves_there_is_no_frequency():
    """While the axis rests, the last digit of the encoder has a high frequency."""
    t = np.arange(2001) * 2e-3
    r = np.where((t > 1.0) & (t < 2.0), 5.0 * np.sin(2 * np.pi * 8.0 * (t - 1.0)), 0.0)
    noisy = r + 1e-5 * np.random.default_rng(1).standard_normal(len(t))
    for floor, quiet in ((0.01, True), (0.0, False)):
        f = instantaneous_frequency(noisy, 2e-3, window=0.05, floor=floor)
        np.testing.assert_allclose(f[(t > 1.2) & (t < 1.8)], 8.0, rtol=0.05)
        assert np.all(f[t > 2.5] == 0) == quiet
    np.testing.assert_array_equal(instantaneous_frequency(np.full(50, 3.0), DT), 0.0)


@pytest.mark.parametrize("samples", [4, 7, 8, 31])
def test_a_window_as_long_as_the_reference_has_a_frequency_at_each_sample(samples):
    dt = 1 / 3e3
    r = np.sin(0.9 * np.arange(samples))
    assert instantaneous_frequency(r, dt, window=(samples - 1) * dt).shape == (samples,)


def burst(*spans, N=2000, dt=2e-3, slow=2.0, fast=16.0):
    """Return a reference of 2 Hz, and of 16 Hz within the spans [s].

    Its phase is continuous, and the amplitude of its speed is constant.
    """
    t = np.arange(N + 1) * dt
    f = np.full(N + 1, slow)
    for start, stop in spans:
        f[(t >= start) & (t < stop)] = fast
    return np.sin(2 * np.pi * np.concatenate([[0.0], np.cumsum(f[:-1]) * dt])) / f


OPTIONS = {"cutoffs": (10.0, 50.0), "threshold": 6.0, "window": 0.1}


def test_segments_follow_the_reference():
    q = segments(burst((1.0, 1.6), (2.5, 3.0)), 2e-3, shortest=0.2, width=0.05, **OPTIONS)
    np.testing.assert_array_equal(q.cutoff, [10.0, 50.0, 10.0, 50.0, 10.0])
    np.testing.assert_allclose(q.times, [1.0, 1.6, 2.5, 3.0], atol=0.06)
    assert (float(q.width), q.order) == (0.05, 2)
    # the frequency of the chirp reaches 11 Hz in the middle
    rises = chirp(1.0, 2.0, 20.0, **SWEEP)
    q = segments(rises, 2e-3, shortest=0.3, **OPTIONS | {"threshold": 11.0})
    np.testing.assert_array_equal(q.cutoff, [10.0, 50.0])
    np.testing.assert_allclose(q.times, [2.0], atol=0.03)
    # the faster of the two axes decides
    both = np.stack([burst((1.0, 1.6)), burst((2.5, 3.0))], axis=1)
    q = segments(both, 2e-3, shortest=0.2, **OPTIONS)
    np.testing.assert_allclose(q.times, [1.0, 1.6, 2.5, 3.0], atol=0.06)


def test_short_segments_are_merged_shortest_first():
    r = burst((1.0, 1.6), (1.8, 2.4), (3.1, 3.4))
    q = segments(r, 2e-3, shortest=0.25, **OPTIONS)  # the pause of 0.2 s is removed
    np.testing.assert_allclose(q.times, [1.0, 2.4, 3.1, 3.4], atol=0.06)
    q = segments(r, 2e-3, shortest=0.5, **OPTIONS)  # then the burst of 0.3 s is removed
    np.testing.assert_array_equal(q.cutoff, [10.0, 50.0, 10.0])
    np.testing.assert_allclose(q.times, [1.0, 2.4], atol=0.06)
    # Then the lead-in of 1 s is removed, and the burst of 1.4 s has become one of 2.4 s.
    q = segments(r, 2e-3, shortest=1.5, **OPTIONS)
    np.testing.assert_array_equal(q.cutoff, [50.0, 10.0])
    np.testing.assert_allclose(q.times, [2.4], atol=0.06)
    q = segments(r, 2e-3, shortest=3.0, **OPTIONS)
    assert (q.times.shape, q.cutoff.shape) == ((0,), (1,))
    assert segments(burst(), 2e-3, shortest=0.1, **OPTIONS).cutoff.tolist() == [10.0]


@pytest.mark.thorough
def test_switchable_filter_learns_the_fast_part_but_not_the_noise_of_the_slow_one():
    """It has the small error of a high cutoff with the smooth input of a low one.

    The machine is a noisy lag of 22 Hz at 1 kHz (Li 2020, Fig. 27 and 42).
    """
    plant = StateSpace([[0.0, 1.0], [-2e4, -200.0]], [[0.0], [2e4]], [[1.0, 0.0]])
    law, noisy = PIDType(gamma_p=0.6, lead=6), Machine(plant, sensor=Sensor(noise=0.01))
    task = Task(burst((0.3, 0.5), N=800, dt=DT, slow=3.0, fast=30.0), dt=DT)
    low, high = cutoffs_below(
        learning_condition(Machine(plant), law, task).critical, shares=(0.1, 0.7)
    )
    fast = {"threshold": 10.0, "shortest": 0.05, "width": 0.02, "window": 0.04}
    switchable = segments(task.reference, DT, cutoffs=(low, high), **fast)
    np.testing.assert_array_equal(switchable.cutoff, [low, high, low])
    rms, roughness = {}, {}
    for name, q in {
        "low": ZeroPhaseButterworth(low),
        "high": ZeroPhaseButterworth(high),
        "switchable": switchable,
    }.items():
        history = learn(noisy, Filtered(law, q), task, 16)
        rms[name] = float(history.rms[-1, 0])
        # This part is far from the end, and the differences remove the motion.
        roughness[name] = np.std(np.diff(history.final.u[550:760, 0], 3))
    assert rms["switchable"] < 0.7 * rms["low"]
    assert roughness["switchable"] < 0.5 * roughness["high"]


def test_cutoffs_below_the_critical_frequency():
    assert cutoffs_below(50.0) == (10.0, 40.0)
    assert cutoffs_below(50.0, shares=(0.5, 0.5)) == (25.0, 25.0)


SINE = np.sin(np.arange(200.0))
GOOD = {"cutoffs": (10.0, 50.0), "threshold": 5.0, "shortest": 0.01}


def switched(*fields, **options):
    SwitchableFilter(*fields, **options).check(N, DT)


def recursive(*fields):
    ZeroPhaseIIR(*fields).check(N, DT)


def moved(reference=SINE, dt=DT, **options):
    instantaneous_frequency(reference, dt, **options)


def cut(**changed):
    segments(SINE, DT, **GOOD | changed)


ERRORS = {
    r"cutoff \(2,\), times \(2,\), width \(\) do not fit": partial(switched, (1, 2), (0.1, 0.2)),
    r"cutoff \(0,\), .* with S >= 1": partial(switched, (), ()),
    r"width \(1,\) do not fit": partial(switched, (10.0, 20.0), (0.1,), (0.1,)),
    r"Filter: cutoff = \[ 10. -20.\] is outside": partial(switched, (10.0, -20.0), (0.1,)),
    r"times = \[0.\] is outside its .* \(0, inf\)": partial(switched, (10.0, 20.0), (0.0,)),
    r"SwitchableFilter: order = 0 is outside": partial(switched, (10.0,), order=0),
    r"times\[1\] = 0.2 s is .* \(0.2, inf\)": partial(switched, (9.0, 8.0, 7.0), (0.2, 0.2)),
    r"times\[1\] = 0.1 s is .* \(0.2, inf\)": partial(switched, (9.0, 8.0, 7.0), (0.2, 0.1)),
    r"= 0.11 s .* \[0, 0.1\], .* segment 1": partial(switched, (9.0, 8.0, 7.0), (0.2, 0.3), 0.11),
    r"cutoff\[1\] = 600 Hz is .* \(0, 500\), Nyquist": partial(switched, (9.0, 600.0), (0.04,)),
    r"times\[0\] = 0.09 s is .* \(0, 0.09\), the trial": partial(switched, (9.0, 8.0), (0.09,)),
    r"= 0.02 s .* 1 of a trial of 0.09 s": partial(switched, (9.0, 8.0), (0.08,), 0.02),
    r"Filter: padding = 90 is outside .* \[0, 89\]": partial(switched, (9.0,), padding=90),
    r"ZeroPhaseIIR: b has shape \(0,\)": partial(recursive, (), (1.0,)),
    r"ZeroPhaseIIR: a has shape \(\)": partial(recursive, (1.0,), 1.0),
    r"ZeroPhaseIIR: a\[0\] = 0": partial(recursive, (1.0,), (0.0, 1.0)),
    r"pole of magnitude 1; allowed is below 1": partial(recursive, (1.0,), (1.0, -1.0)),
    r"ZeroPhaseIIR: padding = 90": partial(recursive, (1.0,), (1.0, -0.5), 90),
    r"reference of shape \(3,\) must be finite": partial(moved, np.zeros(3)),
    r"must be finite": partial(moved, np.full(9, np.nan)),
    r"shape \(9, 1, 1\)": partial(moved, np.zeros((9, 1, 1))),
    r"dt = 0 s is outside its allowed range \(0, inf\)": partial(moved, dt=0.0),
    r"window = 0.5 s is outside its allowed range \[0, 0.199\]": partial(moved, window=0.5),
    r"floor = 1 is outside its allowed range \[0, 1\)": partial(moved, floor=1.0),
    r"of = 'jerk' is not one of": partial(moved, of="jerk"),
    r"segments: cutoffs = \(50.0, 10.0\) Hz": partial(cut, cutoffs=(50.0, 10.0)),
    r"segments: cutoffs = 50.0 Hz": partial(cut, cutoffs=50.0),
    r"segments: threshold = 0 Hz is outside": partial(cut, threshold=0.0),
    r"segments: shortest = 0.199 s is outside .* \[0, 0.199\)": partial(cut, shortest=0.199),
    r"cutoff\[0\] = 500 Hz is outside": partial(cut, cutoffs=(10.0, 500.0)),
    r"cutoffs_below: critical = inf Hz is .* \(0, inf\)": partial(cutoffs_below, np.inf),
    r"cutoffs_below: shares = \(0.9, 0.2\)": partial(cutoffs_below, 50.0, shares=(0.9, 0.2)),
}


@pytest.mark.parametrize("message", ERRORS)
def test_what_cannot_be_done_is_named(message):
    with pytest.raises(ValueError, match=message):
        ERRORS[message]()
