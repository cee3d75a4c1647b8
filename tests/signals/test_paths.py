"""Paths and contour errors against closed forms, phase-plane integration and a full search."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import ALGEBRA, DIFFERENCES
from dense import derivatives, distances
from numpy.testing import assert_allclose, assert_array_equal

from jaxilc.signals import Task, contour_error
from jaxilc.signals.paths import butterfly, circle, line, nurbs, plan
from jaxilc.signals.references import s_curve_move

LIMITS = {"feed": 100.0, "acceleration": 2000.0, "jerk": 1e5}
LIMITS_OF_AXES = {"feed": 100.0, "acceleration": (2000.0, 500.0), "jerk": (1e5, 1e4)}
GENTLE = {"feed": 30.0, "acceleration": 300.0, "jerk": 8e3}
SLACK = 1e-6  # relative to the limits on the sampled reference: rounding of its differences


def ellipse(s):
    return np.stack([20 * np.cos(s), 8 * np.sin(s)], axis=-1)


def helix(s):
    return np.stack([10 * np.cos(s), 10 * np.sin(s), 2 * s], axis=-1)


def parabola(s):
    return np.stack([s, s**2 / 8], axis=-1)


# Limits
# --------------------------------------------------------------------------------------------------

PLANS = {
    "line": (line((1.0, -2.0), (4.0, 2.0)), (0, 1), LIMITS, 1e-3),
    "ellipse": (ellipse, (0, 2 * np.pi), LIMITS, 1e-3),
    "coarse": (ellipse, (0, 2 * np.pi), LIMITS, 2e-2),
    "helix": (helix, (0, 5), LIMITS, 1e-3),
    "axes": (ellipse, (0, 2 * np.pi), LIMITS_OF_AXES, 1e-3),
    "jerk of axes": (circle(5.0), (0, 5), LIMITS | {"jerk": (2e5, 9e4)}, 2e-3),
    "acceleration of axes": (ellipse, (0, 5), LIMITS | {"acceleration": (900.0, 500.0)}, 2e-3),
}


@pytest.mark.thorough
@pytest.mark.parametrize("name", PLANS)
def test_the_sampled_reference_keeps_its_limits_and_uses_them(name):
    curve, interval, limits, dt = PLANS[name]
    planned = plan(curve, interval, dt=dt, **limits)
    velocity, *others = derivatives(planned.reference, dt)
    along = derivatives(planned.arc[:, None], dt)
    use = [np.max(np.linalg.norm(velocity, axis=1)) / limits["feed"]]
    for values, path, limit in zip(
        others, along[1:], (limits["acceleration"], limits["jerk"]), strict=True
    ):
        if np.ndim(limit):
            use += list(np.max(np.abs(values), axis=0) / limit)
        else:
            use += [np.max(np.linalg.norm(values, axis=1)) / limit, np.max(np.abs(path)) / limit]
    assert max(use) <= 1 + SLACK
    assert max(use) > 0.98 or name == "coarse"  # with few samples the peaks between them are missed
    assert_array_equal(planned.reference[[0, -1]], curve(np.array(interval, float)))


def test_positions_lie_on_the_curve_and_the_profile_belongs_to_them():
    dt = 1e-3
    planned = plan(ellipse, (0, 2 * np.pi), dt=dt, **LIMITS)
    x, y = planned.reference.T
    assert_allclose((x / 20) ** 2 + (y / 8) ** 2, 1, **ALGEBRA)
    fine = ellipse(np.linspace(0, 2 * np.pi, 200_001))
    assert_allclose(
        planned.arc[-1], np.sum(np.linalg.norm(np.diff(fine, axis=0), axis=1)), rtol=1e-8
    )
    assert_allclose(
        np.cumsum(planned.speed)[:-1] * dt, planned.arc[1:] - planned.speed[1:] * dt / 2, atol=1e-3
    )
    assert_allclose(np.gradient(planned.arc, dt), planned.speed, atol=LIMITS["jerk"] * dt**2)
    assert_allclose(
        np.gradient(planned.speed, dt)[1:-1], planned.acceleration[1:-1], atol=LIMITS["jerk"] * dt
    )
    assert np.max(np.abs(planned.jerk)) <= 1.001 * LIMITS["jerk"]
    # The speed is the slope of a cubic spline over 2000 steps. At its ends this is three times the
    # difference of two coefficients over a step, each rounded to a few parts of the position.
    rounding = 3 * 4 * np.finfo(float).eps * planned.arc[-1] / (planned.duration / 2000)
    assert_allclose(planned.speed[[0, -1]], 0, atol=rounding)
    assert planned.duration == planned.time[-1] == (len(planned.reference) - 1) * dt


# Time
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("distance", "acceleration"), [(30.0, 2000.0), (30.0, 1e4), (3.0, 2000.0), (0.5, 2000.0)]
)
def test_a_straight_line_takes_the_time_of_the_closed_form(distance, acceleration):
    limits, dt = LIMITS | {"acceleration": acceleration}, 1e-4
    planned = plan(
        line((1.0, 2.0), (1 + 0.6 * distance, 2 + 0.8 * distance)), (0, 1), dt=dt, **limits
    )
    best = s_curve_move(distance, velocity=100.0, acceleration=acceleration, jerk=1e5)
    assert 0.999 * best.duration <= planned.duration <= 1.005 * best.duration + dt
    assert_allclose(
        planned.arc,
        best.at(planned.time * best.duration / planned.duration)[0],
        atol=2e-3 * distance,
    )


def test_a_sample_time_too_short_for_differences_is_no_endless_task():
    """The rounding of positions alone, 1e-13 mm / dt^3, exceeds the jerk limit at 3 us."""
    planned = plan(line((1000.0, 0.0), (1003.0, 0.0)), (0, 1), dt=3e-6, **GENTLE)
    best = s_curve_move(3.0, velocity=30.0, acceleration=300.0, jerk=8e3)
    assert np.max(np.abs(derivatives(planned.reference, 3e-6)[2])) > 1.2 * GENTLE["jerk"]
    assert_allclose(planned.duration, best.duration, rtol=0.05)


def test_limits_of_each_axis_are_those_of_the_axis_that_binds():
    limits = {"feed": 100.0, "acceleration": (3000.0, 1600.0), "jerk": (6e4, 1e5)}
    planned = plan(line((0, 0), (18.0, 24.0)), (0, 1), dt=1e-4, **limits)
    best = s_curve_move(30.0, velocity=100.0, acceleration=1600 / 0.8, jerk=6e4 / 0.6)
    assert_allclose(planned.duration, best.duration, rtol=5e-3)


@pytest.mark.parametrize(
    ("jerk", "speed"),
    [(1e5, np.sqrt(1000 * 20)), (5e3, np.cbrt(5e3 * 20**2))],
    ids=["acceleration", "jerk"],
)
def test_a_circle_is_driven_at_the_speed_of_the_closed_form(jerk, speed):
    """It is that of a = v^2 / r, or of v^3 / r^2 = jerk where that speed is lower."""
    limits = {"feed": 500.0, "acceleration": 1000.0, "jerk": jerk}
    planned = plan(circle(20.0, centre=(3.0, 4.0)), (0, 12 * np.pi), dt=2e-3, **limits)
    assert_allclose(np.median(planned.speed), speed, rtol=5e-3)


@pytest.mark.thorough
@pytest.mark.parametrize("beyond", ["feed", "jerk"])
def test_a_limit_far_beyond_what_samples_show_is_none(beyond):
    """A quarter of a circle of 1 mm takes as many samples as with a limit that is merely large."""
    large = {"feed": 50.0, "acceleration": 1e3, "jerk": 1e4} | {beyond: 1e6}
    quarter = (circle(1.0), (0, np.pi / 2))
    known, found = (plan(*quarter, dt=0.05, **large | {beyond: of}) for of in (1e6, 1e300))
    assert_allclose(found.reference, known.reference, atol=1e-2)


def test_with_much_jerk_a_curve_takes_the_time_of_phase_plane_integration():
    """The classical optimum without a jerk limit: |(kappa v^2, v dv/ds)| <= a, both ways."""
    s = np.linspace(0, 2 * np.pi, 40_001)
    d1, d2 = np.stack([-20 * np.sin(s), 8 * np.cos(s)]), -ellipse(s).T
    rate = np.linalg.norm(d1, axis=0)
    kappa = np.abs(d1[0] * d2[1] - d1[1] * d2[0]) / rate**3
    ds = (rate[1:] + rate[:-1]) / 2 * (s[1] - s[0])
    square = np.minimum(200.0**2, 2000.0 / kappa)
    square[[0, -1]] = 0
    square, kappa, steps = square.tolist(), kappa.tolist(), ds.tolist()
    for order in (range(1, len(s)), range(len(s) - 2, -1, -1)):
        for i in order:
            before, step = (i - 1, steps[i - 1]) if order.step > 0 else (i + 1, steps[i])
            pull = math.sqrt(max(2000.0**2 - (kappa[before] * square[before]) ** 2, 0))
            square[i] = min(square[i], square[before] + 2 * step * pull)
    v = np.sqrt(square)
    best = np.sum(2 * ds / (v[1:] + v[:-1]))
    planned = plan(ellipse, (0, 2 * np.pi), feed=200.0, acceleration=2000.0, jerk=2e6, dt=5e-4)
    assert best <= planned.duration <= 1.01 * best


def test_the_time_does_not_depend_on_the_parametrisation():
    one = plan(parabola, (-10, 10), dt=1e-3, **GENTLE)
    other = plan(lambda s: parabola(10 * np.sinh(s) / np.sinh(1)), (-1, 1), dt=1e-3, **GENTLE)
    assert_allclose(other.duration, one.duration, rtol=2e-3)


@pytest.mark.parametrize("dt", [2e-3, 1e-4])
def test_a_jump_of_curvature_is_passed_slowly_and_all_else_is_not(dt):
    """With fine samples, too, the path takes less time than with a stop there, in closed form."""

    def line_then_arc(s):
        flat, bent = (
            np.stack([s, 0 * s], axis=-1),
            np.stack([10 + 5 * np.sin((s - 10) / 5), 5 - 5 * np.cos((s - 10) / 5)], axis=-1),
        )
        return np.where(s[:, None] < 10, flat, bent)

    planned = plan(line_then_arc, (0, 20), dt=dt, **GENTLE)
    near = np.abs(planned.arc - 10) < 0.2
    assert np.min(planned.speed[near]) < 0.3 * np.max(planned.speed)
    assert np.max(np.linalg.norm(derivatives(planned.reference, dt)[2], axis=1)) <= GENTLE[
        "jerk"
    ] * (1 + SLACK)
    # On the arc, 240 and 180 mm/s^2 along and across make 300, and most jerk is left for the ramp.
    feed, ramps = GENTLE["feed"], ((300.0, 8e3), (240.0, 6e3))
    stopping = sum(10 / feed + feed / a + a / jerk for a, jerk in ramps)
    assert planned.duration < stopping
    assert np.max(planned.speed) > 0.97 * feed


# The butterfly
# --------------------------------------------------------------------------------------------------


def test_nurbs_is_the_rational_sum():
    """A quarter circle of weights 1, 2^(-1/2), 1 is exact."""
    s = np.linspace(0, 1, 11)
    points = nurbs([[1, 0], [1, 1], [0, 1]], [0, 0, 0, 1, 1, 1], [1, np.sqrt(0.5), 1])(s)
    assert_allclose(np.hypot(*points.T), 1, **ALGEBRA)


def test_butterfly_has_two_equal_wings():
    s = np.linspace(0, 1, 2001)
    p = butterfly(80.0)(s)
    assert_allclose(p[::-1] * [-1, 1], p, atol=0.11)
    assert_allclose(np.ptp(p, axis=0), [80.0, 48.5], atol=0.05)


@pytest.mark.thorough
def test_butterfly_of_ten_thousand_samples():
    """Two numbers are fitted to a picture, and three of four sharp points are met.

    A feed of 20.27 mm/s, after 497 samples of rest, puts the notches and the tail at three of the
    four sharp points that Li 2020 names: samples 2915, 5249 and 7576 of 2 ms. The fourth, 6093, is
    385 samples past the nearest sharp point of this curve.
    """
    dt = 2e-3
    limits = {"feed": 20.27, "acceleration": 1000.0, "jerk": 1e5}
    planned = plan(butterfly(), (0, 1), dt=dt, **limits)
    notch, spike, tail, _, other = (
        int(np.argmin(np.abs(planned.parameter - s))) for s in (0.2564, 0.4497, 0.5, 0.5502, 0.7436)
    )
    assert_allclose(np.array([notch, tail, other]) + 497, [2915, 5249, 7576], atol=8)
    assert 9000 < len(planned.reference) < 10_500
    for k in (notch, spike, other):
        # The motion is slow at the sharp points.
        assert np.min(planned.speed[k - 5 : k + 6]) < 0.5 * limits["feed"]
    assert np.mean(planned.speed > 0.99 * limits["feed"]) > 0.9  # and slow at no other point
    _, acceleration, jerk = derivatives(planned.reference, dt)
    assert np.max(np.linalg.norm(acceleration, axis=1)) <= limits["acceleration"] * (1 + SLACK)
    assert np.max(np.linalg.norm(jerk, axis=1)) <= limits["jerk"] * (1 + SLACK)
    assert planned.duration == Task(planned.reference, dt=dt).duration


# What is refused
# --------------------------------------------------------------------------------------------------


def cycloid(s):
    return np.stack([s - np.sin(s), 1 - np.cos(s)], axis=-1)


def bent(s):
    return np.stack([s, np.maximum(s - 0.7, 0.0)], axis=-1)


def waiting(s):
    return np.stack([np.maximum(s - 0.5, 0.0), np.zeros_like(s)], axis=-1)


def pole(s):
    return np.stack([s, np.where(s > 0.4, np.nan, 0.0)], axis=-1)


REFUSED = {
    "cusp": (cycloid, (1.0, 9.0), {},
             r"corner or cusp of 180 deg at parameter 6\.2831\d*, position \[6\.28.*"
             "split the path there"),
    "corner": (bent, (0.0, 1.0), {},
               r"corner or cusp of 45 deg at parameter 0\.7\d*, position \[0\.7 +0\. *\] mm; "
               "split the path there"),
    "standing still": (waiting, (0.0, 1.0), {}, r"stands still from parameter 0 to 5e-05"),
    "not finite": (pole, (0.0, 1.0), {}, r"not finite at parameter 0\.40005"),
    "unresolved": (lambda s: circle(1.0)(2e4 * s), (0.0, 1.0), {},
                   r"turns by 57\.3 deg between two points.*raise points"),
    "flat": (lambda s: s, (0.0, 1.0), {}, r"the curve gives shape \(20001,\)"),
    "reversed": (ellipse, (1.0, 0.0), {}, r"interval = \(1\.0, 0\.0\) is not"),
    "dt": (ellipse, (0.0, 1.0), {"dt": 0.0}, r"dt = 0 s is outside"),
    "feed": (ellipse, (0.0, 1.0), {"feed": -1.0}, r"feed = -1 mm/s is outside"),
    "acceleration": (ellipse, (0.0, 1.0), {"acceleration": (100.0, 0.0)},
                     r"acceleration\[1\] = 0 mm/s\^2 is outside"),
    "jerk": (ellipse, (0.0, 1.0), {"jerk": np.nan}, r"jerk = nan mm/s\^3 is outside"),
    "axes": (ellipse, (0.0, 1.0), {"jerk": (1.0, 2.0, 3.0)},
             r"jerk has shape \(3,\); allowed are \(\) and \(2,\)"),
    "points": (ellipse, (0.0, 1.0), {"points": 5}, r"points = 5 is outside"),
    "endless": (ellipse, (0.0, 1.0), {"jerk": 1e-12},
                r"jerk = 1e-12 mm/s\^3 need .* samples of dt = 0\.001 s; allowed are up to"),
    "a standstill": (ellipse, (0.0, 1.0), {"feed": 1e-9},
                     r"feed = 1e-09 mm/s, .* need inf s, inf samples of dt = 0\.001 s; allowed are "
                     "up to"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_planned_is_refused(name):
    curve, interval, changes, message = REFUSED[name]
    with pytest.raises(ValueError, match=message):
        plan(curve, interval, **{"dt": 1e-3, **LIMITS, **changes})


def test_factories_refuse_what_is_no_curve():
    with pytest.raises(ValueError, match=r"circle: radius = 0 mm"):
        circle(0.0)
    with pytest.raises(ValueError, match=r"butterfly: width = -1 mm"):
        butterfly(-1.0)
    with pytest.raises(ValueError, match=r"nurbs: points \(3, 2\), knots \(4,\)"):
        nurbs(np.ones((3, 2)), [0, 0, 1, 1])
    with pytest.raises(ValueError, match=r"nurbs: weights\[1\] = 0"):
        nurbs(np.eye(2), [0, 0, 1, 1], [1, 0])
    for knots in ([0, 1, 1, 0], [1, 1, 1, 1], [0, 0, np.nan, 1]):
        with pytest.raises(ValueError, match=r"nurbs: knots = \[.* must not fall, and must rise"):
            nurbs(np.eye(2), knots)


def test_knots_that_are_not_clamped_end_the_curve_where_they_no_longer_define_it():
    """Beyond it they do not sum to 1, and the polynomials leave the hull of the points."""
    spread = nurbs([[0, 0], [10, 0], [10, 10]], [0, 1, 2, 3, 4, 5])
    np.testing.assert_allclose(spread([2.0, 2.5, 3.0]), [[5, 0], [8.75, 1.25], [10, 5]])
    for s in (1.9, [2.5, 3.1], np.nan):
        with pytest.raises(ValueError, match=r"nurbs: s = .* allowed range \[2, 3\]"):
            spread(s)


# Contour error
# --------------------------------------------------------------------------------------------------

ANGLES = np.linspace(0, 2 * np.pi, 401)


@pytest.mark.thorough
def test_on_a_circle_it_is_the_error_of_the_radius():
    """The inside is on the left; chords lie inside by r (1 - cos(half a step)) at most."""
    radius = 10 + 0.05 * np.cos(3 * ANGLES)
    lagging = ANGLES - 0.02  # a lag along the path is not a contour error
    y = radius[:, None] * circle(1.0)(lagging)
    error = contour_error(y, circle(10.0)(ANGLES), window=5)
    assert_allclose(error, 10 - radius, atol=10 * (1 - np.cos(np.pi / 400)) * 1.01)
    assert np.max(np.abs(y - circle(10.0)(ANGLES))) > 0.15


@pytest.mark.thorough
def test_on_a_line_it_is_the_signed_offset():
    k = np.arange(41)
    path = np.outer(k, [0.6, 0.8])
    offset = np.sin(k)
    y = path - 2.3 * np.array([0.6, 0.8]) + offset[:, None] * [-0.8, 0.6]
    assert_allclose(contour_error(y, path, window=4)[3:], offset[3:], **ALGEBRA)
    # Before the start of the path it is the distance from the start, with the sign of its side.
    assert_allclose(contour_error(y, path, window=4)[0], np.hypot(2.3, offset[0]), **ALGEBRA)
    assert_allclose(contour_error(y[1:2], path, window=40)[0], np.hypot(1.3, offset[1]), **ALGEBRA)


@pytest.fixture(scope="module")
def measured():
    """Return a wing of the butterfly with its notch, and a motion that lags and oscillates."""
    path = butterfly()(np.linspace(0.22, 0.3, 121))
    rng = np.random.default_rng(3)
    y = path[np.maximum(np.arange(121) - 4, 0)] + 0.05 * rng.standard_normal((121, 2))
    return jnp.asarray(y), jnp.asarray(path)


def test_with_a_wide_window_it_is_the_distance_from_the_whole_path(measured):
    y, path = measured
    expected = distances(np.asarray(y), np.asarray(path))
    assert_allclose(np.abs(contour_error(y, path, window=120)), expected, **ALGEBRA)
    with_line_in_space = [np.column_stack([a, np.full(121, b)]) for a, b in ((y, 0.3), (path, 0.0))]
    assert_allclose(
        contour_error(*with_line_in_space, window=120), np.hypot(expected, 0.3), **ALGEBRA
    )


@pytest.mark.thorough
def test_a_lag_beyond_the_window_is_overstated_never_understated(measured):
    y, path = measured
    narrow, wide = (np.abs(contour_error(y, path, window=w)) for w in (2, 8))
    assert np.all(narrow >= wide - 1e-12)
    assert np.max(narrow - wide) > 0.1


def test_a_denser_path_is_found_in_proportion(measured):
    y, path = measured
    dense = butterfly()(np.linspace(0.22, 0.3, 481))
    assert_allclose(
        contour_error(y, dense, window=40), contour_error(y, path, window=10), atol=5e-3
    )


def test_a_closed_path_has_no_start():
    """A tool that lags on an ellipse is first measured from the last part of the path."""
    path = np.stack([4.0 * np.cos(ANGLES), 1.5 * np.sin(ANGLES)], axis=-1)
    lagging = ANGLES - 0.07 + 0.03 * np.sin(5 * ANGLES)
    y = (
        np.stack([4.0 * np.cos(lagging), 1.5 * np.sin(lagging)], axis=-1)
        + 0.01 * np.cos(7 * ANGLES)[:, None]
    )
    expected = distances(y, path)
    ahead = y[np.minimum(np.arange(401) + 14, 400)]
    for one in (y, ahead):
        found = np.abs(contour_error(one, path, window=12))
        assert_allclose(found, distances(one, path), **ALGEBRA)
    as_if_open = np.abs(contour_error(y, path, window=12, closed=False))
    assert_allclose(as_if_open[12:], expected[12:], **ALGEBRA)
    assert np.max(as_if_open) > 0.08 > 5 * np.max(expected)
    # The ends of the path do not meet, but an option says that it is closed.
    nearly = path + 1e-4 * np.linspace(0, 1, 401)[:, None]
    assert np.max(np.abs(contour_error(y, nearly, window=12))) > 0.08
    assert_allclose(np.abs(contour_error(y, nearly, window=12, closed=True)), expected, atol=2e-4)
    with pytest.raises(
        ValueError, match="contour_error: closed = 1 is not one of True, False, None"
    ):
        contour_error(y, path, window=12, closed=1)


@pytest.mark.parametrize("kind", ["float32", "int64", "uint8"])
def test_measured_numbers_may_be_of_another_type_than_the_path(kind):
    y = np.random.default_rng(5).integers(0, 9, (20, 2)).astype(kind)
    path = np.stack([np.arange(20), 4 + np.arange(20) % 2], axis=1)[::-1]
    expected = contour_error(y.astype(float), path.astype(float), window=3)
    for one in (path, path.astype(float), path.astype(kind)):
        found = contour_error(y, one, window=3)
        assert_allclose(found, expected, rtol=1e-6 if found.dtype == "float32" else 1e-12)


@pytest.mark.thorough
def test_a_path_that_dwells_is_no_obstacle():
    path = np.array([[0.0, 0.0]] * 4 + [[1.0, 0.0], [2.0, 0.0]] + [[2.0, 0.0]] * 3)
    y = path + np.array([0.1, -0.2])
    error = contour_error(y, path, window=3)
    assert_allclose(error[:5], -0.2, **ALGEBRA)
    assert_allclose(
        contour_error(y, np.zeros((5, 2)), window=2), np.linalg.norm(y, axis=1), **ALGEBRA
    )


def test_its_gradient_is_that_of_differences_and_finite_on_the_path(measured):
    y, path = measured

    def total(y):
        return jnp.sum(contour_error(y, path, window=6) ** 2)

    slope = jax.jit(jax.grad(total))
    way = np.random.default_rng(4).normal(size=y.shape)
    differences = (total(y + 1e-6 * way) - total(y - 1e-6 * way)) / 2e-6
    assert_allclose(jnp.vdot(slope(y), way), differences, **DIFFERENCES)
    assert np.all(np.isfinite(slope(path)))


def test_vmapped_it_equals_a_loop(measured):
    y, path = measured
    batch = jnp.stack([y, y + 0.01, path])
    looped = [contour_error(b, path, window=6) for b in batch]
    assert_allclose(
        jax.jit(jax.vmap(lambda b: contour_error(b, path, window=6)))(batch), looped, **ALGEBRA
    )


@pytest.mark.parametrize(("y", "path", "window", "message"), [
    (np.zeros((3, 2)), np.zeros((3, 3)), 1, r"y \(3, 2\) and path \(3, 3\)"),
    (np.zeros(3), np.zeros((3, 2)), 1, r"y \(3,\)"),
    (np.zeros((3, 2)), np.zeros((1, 2)), 1, r"path \(1, 2\)"),
    (np.zeros((3, 2)), np.zeros((3, 2)), 0, r"window = 0 is outside"),
    (np.zeros((3, 2)), np.zeros((3, 2)), 1.5, r"window = 1\.5 is outside"),
])  # fmt: skip
def test_what_has_no_contour_error_is_refused(y, path, window, message):
    with pytest.raises(ValueError, match=message):
        contour_error(y, path, window=window)
