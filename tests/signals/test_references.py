"""References are compared with closed forms, with scipy and with linear programming."""

from __future__ import annotations

import re

import numpy as np
import pytest
import scipy.optimize
import scipy.signal
from numpy.testing import assert_allclose, assert_array_equal

from jaxilc.signals.references import (
    SCurveMove,
    chirp,
    m_sequence,
    multisine,
    noncircular,
    s_curve,
    s_curve_move,
    sinusoid,
)

LIMITS = {"velocity": 100.0, "acceleration": 2000.0, "jerk": 1e5}
# Each row has distance [mm], limits, and the closed-form time [s] of one of the four cases.
MOVES = {
    "all limits reached": (30.0, LIMITS, 30 / 100 + 100 / 2000 + 2000 / 1e5),
    "no acceleration limit": (
        30.0,
        LIMITS | {"acceleration": 1e4},
        30 / 100 + 2 * np.sqrt(100 / 1e5),
    ),
    "no velocity limit": (3.0, LIMITS, 0.02 + np.sqrt(0.02**2 + 4 * 3 / 2000)),
    "jerk limit alone": (0.5, LIMITS, 4 * np.cbrt(0.5 / 2e5)),
}
TURNING = {
    "duration": 4.0, "dt": 1e-3, "spindle_speed": 0.25, "feed": 2.0, "ellipticity": (0.4, 1.0),
    "bulge": 0.1, "length": 2.0,
}  # fmt: skip


def turned(**changes):
    return noncircular(**TURNING | changes)


def crest(r):
    return np.max(np.abs(r)) / np.sqrt(np.mean(r**2))


@pytest.fixture(params=MOVES.values(), ids=list(MOVES))
def case(request):
    return request.param


# Periodic references
# --------------------------------------------------------------------------------------------------


def test_sinusoid_is_the_closed_form_with_both_ends():
    r = sinusoid(2.0, 0.5, duration=2.0, dt=0.5, offset=2.0, phase=-np.pi / 2)
    assert_allclose(r, [0, 2, 4, 2, 0], atol=1e-15)
    assert r.dtype == np.float64


def test_a_duration_that_rounds_in_binary_is_whole():
    assert len(sinusoid(1.0, 1.0, duration=0.3, dt=0.1)) == 4


def test_multisine_is_a_sum_of_sinusoids_of_schroeders_phases():
    a, f, phi = [1.0, 0.5, 2.0], [1.0, 3.0, 4.5], [0.3, -1.0, 2.0]
    p = np.square(a) / np.sum(np.square(a))
    default = [np.pi / 2 - 2 * np.pi * sum((n - i) * p[i] for i in range(n)) for n in range(3)]
    for given, phases, atol in ((phi, phi, 1e-14), (None, default, 1e-13)):
        expected = sum(
            sinusoid(*af, phase=phase, duration=1.0, dt=0.01)
            for *af, phase in zip(a, f, phases, strict=True)
        )
        assert_allclose(multisine(a, f, given, duration=1.0, dt=0.01), expected, atol=atol)


def test_default_phases_lower_the_crest_factor():
    a, f = np.ones(31), np.arange(1.0, 32.0)
    assert crest(multisine(a, f, duration=1.0, dt=1e-3)) < 1.8  # 1.78; a single sine has 1.41
    assert crest(multisine(a, f, np.zeros(31), duration=1.0, dt=1e-3)) > 5.0  # 5.80


@pytest.mark.parametrize("method", ["linear", "logarithmic"])
@pytest.mark.parametrize("f_stop", [40.0, 0.5, 2.0])
def test_chirp_is_scipys(method, f_stop):
    r = chirp(1.5, 2.0, f_stop, duration=3.0, dt=1e-3, method=method)
    expected = 1.5 * scipy.signal.chirp(
        np.arange(3001) * 1e-3, 2.0, 3.0, f_stop, method=method, phi=-90
    )
    assert_allclose(r, expected, atol=1e-10)
    assert r[0] == 0


# S-curve
# --------------------------------------------------------------------------------------------------


def test_move_takes_the_closed_form_time(case):
    distance, limits, duration = case
    assert_allclose(s_curve_move(distance, **limits).duration, duration, rtol=1e-13)


def farthest(duration, *, velocity, acceleration, jerk, segments=100):
    """Return the length of the longest rest-to-rest move in `duration`, by linear programming.

    The unknowns are the jerks of equal segments; the limits hold at the ends of the segments.
    """
    h = duration / segments
    # `after` is the number of segments since the start of each segment's jerk, once it has begun.
    after = np.arange(1, segments + 1)[:, None] - np.arange(segments)
    begun = after > 0
    # The matrices act on the unknowns, which are the jerks relative to their limit.
    a, v = (jerk * h * begun, jerk * h**2 * (after - 0.5) * begun)
    p_end = jerk * h**3 * (after[-1] ** 2 / 2 - after[-1] / 2 + 1 / 6)
    within = np.vstack([a / acceleration, -a / acceleration, v / velocity, -v / velocity])
    rest = np.vstack([a[-1] / acceleration, v[-1] / velocity])
    solution = scipy.optimize.linprog(
        -p_end, within, np.ones(len(within)), rest, np.zeros(2), bounds=(-1, 1)
    )
    assert solution.status == 0
    return -solution.fun


def test_move_is_time_optimal(case):
    distance, limits, _ = case
    duration = s_curve_move(distance, **limits).duration
    assert_allclose(farthest(duration, **limits), distance, rtol=5e-3)
    assert farthest(0.98 * duration, **limits) < 0.99 * distance


def test_move_reaches_only_the_limits_of_its_case():
    for name, reached in zip(
        MOVES, [(True, True), (True, False), (False, True), (False, False)], strict=True
    ):
        distance, limits, _ = MOVES[name]
        move = s_curve_move(distance, **limits)
        _, v, a, _ = move.at(np.append(np.cumsum(move.durations), move.duration / 2))
        peaks = np.max(v) / limits["velocity"], np.max(a) / limits["acceleration"]
        assert max(peaks) <= 1 + 1e-12
        assert tuple(peak > 1 - 1e-12 for peak in peaks) == reached, name


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_profile_is_consistent_and_ends_exactly(case, sign):
    distance, limits, _ = case
    move = s_curve_move(sign * distance, **limits)
    t = np.linspace(0, move.duration, 20_001)
    p, v, a, j = move.at(t)
    h = t[1]
    assert (p[0], v[0], a[0]) == (0, 0, 0)
    assert (p[-1], v[-1], a[-1]) == (sign * distance, 0, 0)
    assert np.all(sign * np.diff(p) >= 0)
    assert set(np.abs(j)) <= {0, limits["jerk"]}
    # The trapezoidal rule misses each of the eight switches of the jerk by up to one step, and a
    # and v by the second order of h.
    assert_allclose(np.cumsum((j[1:] + j[:-1]) / 2 * h), a[1:], atol=8 * limits["jerk"] * h)
    assert_allclose(np.cumsum((a[1:] + a[:-1]) / 2 * h), v[1:], atol=1e-6 * limits["velocity"])
    assert_allclose(np.cumsum((v[1:] + v[:-1]) / 2 * h), p[1:], atol=1e-6 * distance)


def test_move_rests_outside():
    move = s_curve_move(5.0, **LIMITS)
    for value, before, after in zip(move.at([-1.0, 9.0]), (0, 0, 0, 0), (5, 0, 0, 0), strict=True):
        assert_array_equal(value, [before, after])
    assert move.at(0.0)[0].shape == ()


def test_jerk_between_the_switching_times():
    move = SCurveMove(6.0, 1.0, (1.0, 0.5, 1.0, 0.0, 1.0, 0.5, 1.0))
    # The middle of the motion is at 2.5 s.
    assert_array_equal(move.at([0.5, 1.25, 2.0, 2.5, 3.0, 3.75, 4.5])[3], [1, 0, -1, -1, -1, 0, 1])


def test_no_distance_takes_no_time():
    move = s_curve_move(0.0, **LIMITS)
    assert move.duration == 0
    assert_array_equal(move.at([-0.1, 0.0, 0.1]), np.zeros((4, 3)))


def test_move_time_is_continuous_where_the_cases_meet():
    v, a, j = LIMITS.values()
    # The velocity limit is just reached at the first distance, the acceleration limit at the
    # second.
    for border in (v**2 / a + v * a / j, 2 * a**3 / j**2):
        below, at, above = (
            s_curve_move(border * (1 + x), **LIMITS).duration for x in (-1e-9, 0, 1e-9)
        )
        assert_allclose([below, above], at, rtol=1e-8)
        assert below < at < above


def test_s_curve_keeps_its_limits_and_ends_exactly():
    dt = 1e-3
    r = s_curve([0.1, 12.3, 11.9, -20.0], **LIMITS, dt=dt)
    assert (r[0], r[-1]) == (0.1, -20.0)
    for order, limit in enumerate(LIMITS.values(), start=1):
        slopes = np.diff(r, order) / dt**order
        assert 0.98 * limit < np.max(np.abs(slopes)) < limit * (1 + 1e-6)


def test_s_curve_dwells_where_its_moves_end():
    dt, dwell = 1e-3, 0.2
    positions = [0.1, 0.3, 0.3, -0.7]
    r = s_curve(positions, **LIMITS, dwell=dwell, dt=dt)
    times = [s_curve_move(d, **LIMITS).duration for d in np.diff(positions)]
    assert len(r) - 1 == np.ceil((sum(times) + 3 * dwell) / dt)
    assert_array_equal(r[int(np.ceil(times[0] / dt)) : int((times[0] + 2 * dwell) / dt)], 0.3)
    assert_array_equal(r[-int(dwell / dt) :], -0.7)


def test_s_curve_ends_exactly_where_the_difference_rounds():
    origin, target = next(
        (a, b) for a in np.arange(1, 20) / 10 for b in np.arange(1, 300) / 10 if a + (b - a) != b
    )
    assert s_curve([origin, target], **LIMITS, dt=1e-3)[-1] == target


def test_s_curve_starts_at_its_first_position_however_fast_it_moves():
    at_once = dict.fromkeys(LIMITS, 1e300)
    assert s_curve([3.0, 4.0, 2.0], dwell=2e-3, dt=1e-3, **at_once).tolist() == [3, 4, 4, 2, 2]


def test_s_curve_takes_a_sample_time_in_single_precision():
    dt = np.float32(1e-3)
    moves = [0.0, 30.0, 10.0]
    assert_array_equal(s_curve(moves, dt=dt, **LIMITS), s_curve(moves, dt=float(dt), **LIMITS))


def test_s_curve_holds_its_end():
    r = s_curve([0.0, 30.0], **LIMITS, dt=1e-3, duration=1.0)
    assert len(r) == 1001
    assert_array_equal(r[370:], 30.0)
    assert r[369] < 30.0
    # Up to rounding, 0.37 s is a whole number of samples.
    assert_array_equal(r[:371], s_curve([0.0, 30.0], **LIMITS, dt=1e-3))


# Identification and turning
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("order", "seed"), [(2, 1), (5, 1), (7, 77)])
def test_m_sequence_has_a_two_valued_autocorrelation(order, seed):
    u = m_sequence(order, amplitude=2.0, seed=seed)
    period = 2**order - 1
    assert u.shape == (period,)
    assert np.sum(u) == 2.0
    correlation = [u @ np.roll(u, shift) / 4.0 for shift in range(period)]
    assert_array_equal(correlation, [period] + [-1] * (period - 1))


def test_m_sequence_takes_short_whole_numbers_of_numpy():
    short = m_sequence(np.uint8(10), hold=np.int8(7), periods=np.int8(3))
    assert_array_equal(short, m_sequence(10, hold=7, periods=3))


def test_m_sequence_holds_and_repeats():
    u = m_sequence(4)
    assert_array_equal(m_sequence(4, hold=3, periods=2), np.concatenate([np.repeat(u, 3)] * 2))
    rotations = [np.roll(u, shift).tolist() for shift in range(15)]
    assert {tuple(m_sequence(4, seed=s)) for s in range(1, 16)} == set(map(tuple, rotations))


def test_a_plain_oval_is_a_cosine():
    r = turned(ellipticity=(0.5, 0.5), bulge=0.0)
    t = np.arange(4001) * 1e-3
    assert_allclose(r, 0.5 * (1 - np.cos(2 * np.pi * 0.5 * t)), atol=1e-15)


def test_noncircular_meets_equation_28_at_the_oval_axes():
    # Z covers the length in one revolution of 4 s; the cosine is 1, -1, ... every second.
    r = turned()
    G = 0.4 + 0.6 * (1 - np.cos(np.pi * np.array([0, 0.25, 0.5, 0.75, 1]))) / 2
    D = 0.1 * np.array([0, 0.75, 1, 0.75, 0])
    y = D / 2 + G / 4 - G * np.array([1, -1, 1, -1, 1])
    assert_allclose(r[::1000], y - y[0], atol=1e-14)


@pytest.mark.parametrize(("feed", "bulge"), [(2.0, 0.0), (4.0, 0.1), (0.5, 0.1)])
def test_noncircular_starts_at_zero_with_the_velocity_of_the_convexity(feed, bulge):
    r = turned(duration=1e-3, dt=1e-6, feed=feed, bulge=bulge)
    assert r[0] == 0
    assert_allclose((-3 * r[0] + 4 * r[1] - r[2]) / 2e-6, 2 * bulge * feed * 0.25 / 2.0, atol=1e-7)


# Errors
# --------------------------------------------------------------------------------------------------

SPAN = {"duration": 1.0, "dt": 1e-3}
STEP = LIMITS | {"dt": 1e-3}


REFUSED = [
    (lambda: sinusoid(1, 1, duration=1, dt=0), "sinusoid: dt = 0 s", "(0, inf)"),
    (lambda: sinusoid(1, 1, duration=-1, dt=0.1), "sinusoid: duration = -1 s", "(0, inf)"),
    (lambda: sinusoid(np.nan, 1, **SPAN), "sinusoid: amplitude = nan mm", "(-inf, inf)"),
    (lambda: sinusoid(1, -1, **SPAN), "sinusoid: frequency = -1 Hz", "(0, 500)"),
    (lambda: sinusoid(1, 500, **SPAN), "sinusoid: frequency = 500 Hz", "(0, 500)"),
    (lambda: sinusoid(1, 1, phase=np.inf, **SPAN), "sinusoid: phase = inf rad", "(-inf, inf)"),
    (lambda: sinusoid(1, 1, offset=np.inf, **SPAN), "sinusoid: offset = inf mm", "(-inf, inf)"),
    (lambda: multisine([1, -1], [1, 2], **SPAN), "multisine: amplitudes[1] = -1 mm", "(0, inf)"),
    (lambda: multisine([1, 1], [1, 600], **SPAN), "multisine: frequencies[1] = 600 Hz", "(0, 500)"),
    (lambda: multisine([1], [1], [np.nan], **SPAN), "multisine: phases[0] = nan rad",
     "(-inf, inf)"),
    (lambda: chirp(np.inf, 1, 2, **SPAN), "chirp: amplitude = inf mm", "(-inf, inf)"),
    (lambda: chirp(1, 0, 2, **SPAN), "chirp: f_start = 0 Hz", "(0, 500)"),
    (lambda: chirp(1, 1, 501, **SPAN), "chirp: f_stop = 501 Hz", "(0, 500)"),
    (lambda: s_curve_move(np.inf, **LIMITS), "s_curve_move: distance = inf mm", "(-inf, inf)"),
    (lambda: s_curve_move(1, **LIMITS | {"jerk": 0}), "s_curve_move: jerk = 0 mm/s^3", "(0, inf)"),
    (lambda: s_curve([0, np.nan], **STEP), "s_curve: positions[1] = nan mm", "(-inf, inf)"),
    (lambda: s_curve([0, 1], **STEP | {"velocity": -1}), "s_curve: velocity = -1 mm/s", "(0, inf)"),
    (lambda: s_curve([0, 1], **STEP | {"acceleration": 0}), "s_curve: acceleration = 0 mm/s^2",
     "(0, inf)"),
    (lambda: s_curve([0, 1], **STEP | {"jerk": np.inf}), "s_curve: jerk = inf mm/s^3", "(0, inf)"),
    (lambda: s_curve([0, 1], dwell=-1, **STEP), "s_curve: dwell = -1 s", "[0, inf)"),
    (lambda: s_curve([0, 1], **STEP | {"dt": 0}), "s_curve: dt = 0 s", "(0, inf)"),
    (lambda: s_curve([0, 30], duration=0.369, **STEP), "s_curve: duration = 0.369 s",
     "[0.37, inf), the time of all moves"),
    (lambda: m_sequence(1), "m_sequence: order = 1", "[2, 32] of whole numbers"),
    (lambda: m_sequence(33), "m_sequence: order = 33", "[2, 32] of whole numbers"),
    (lambda: m_sequence(4.5), "m_sequence: order = 4.5", "[2, 32] of whole numbers"),
    (lambda: m_sequence(4, amplitude=np.nan), "m_sequence: amplitude = nan", "(-inf, inf)"),
    (lambda: m_sequence(4, hold=0), "m_sequence: hold = 0", "[1, inf) of whole numbers"),
    (lambda: m_sequence(4, periods=0), "m_sequence: periods = 0", "[1, inf) of whole numbers"),
    (lambda: m_sequence(4, seed=16), "m_sequence: seed = 16", "[1, 15] of whole numbers"),
    (lambda: turned(spindle_speed=250.0), "noncircular: spindle_speed = 250 rev/s", "(0, 250)"),
    (lambda: turned(feed=0.0), "noncircular: feed = 0 mm/rev", "(0, inf)"),
    (lambda: turned(ellipticity=(0.4, -0.1)), "noncircular: ellipticity[1] = -0.1 mm", "[0, inf)"),
    (lambda: turned(bulge=-1.0), "noncircular: bulge = -1 mm", "[0, inf)"),
    (lambda: turned(length=0.0), "noncircular: length = 0 mm", "(0, inf)"),
    (lambda: turned(length=1.5), "noncircular: duration = 4 s",
     "(0, 3], else Z leaves length"),
]  # fmt: skip


@pytest.mark.parametrize(("call", "value", "allowed"), REFUSED)
def test_errors_name_function_parameter_value_and_range(call, value, allowed):
    message = f"{value} is outside its allowed range {allowed}"
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        call()


WHOLE = "is not a whole number >= 1 of samples of dt ="


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: sinusoid(1, 1, duration=0.25, dt=0.1),
         f"sinusoid: duration = 0.25 s {WHOLE} 0.1 s"),
        (lambda: chirp(1, 1, 2, duration=1e-9, dt=0.1), f"chirp: duration = 1e-09 s {WHOLE} 0.1 s"),
        (lambda: s_curve([0, 30], duration=1.0005, **STEP),
         f"s_curve: duration = 1.0005 s {WHOLE} 0.001 s"),
        (lambda: multisine([1, 1], [1], **SPAN),
         "multisine: amplitudes (2,), frequencies (1,), phases (2,) must have one shape (M,), M "
         ">= 1"),
        (lambda: multisine([], [], **SPAN),
         "multisine: amplitudes (0,), frequencies (0,), phases (0,) must have one shape (M,), M "
         ">= 1"),
        (lambda: chirp(1, 1, 2, method="log", **SPAN),
         "chirp: method = 'log' is not one of 'linear', 'logarithmic'"),
        (lambda: s_curve([1], **STEP),
         "s_curve: positions has shape (1,); allowed is (M,) with M >= 2"),
        (lambda: turned(ellipticity=0.4),
         "noncircular: ellipticity has shape (); allowed is (2,)"),
    ],
)  # fmt: skip
def test_errors_name_shapes_and_lengths(call, message):
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        call()
