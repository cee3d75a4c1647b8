"""Velocity planning along a tool path in the plane or in space.

A curve is any callable that takes (M,) parameter values and returns (M, d) positions [mm]; some are
here. Planning runs once, on the host, in float64; what comes out is a reference for `Task`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import numpy as np
import scipy

from ..pytree.aliases import Function, Numbers, Value
from ..pytree.ranges import brief, require
from .fastest_profile import Groups, Profile, Spline, fastest
from .references import POSITIVE

__all__ = ["Plan", "butterfly", "circle", "line", "nurbs", "plan"]

Curve: TypeAlias = Callable[[np.ndarray], np.ndarray]
Cap: TypeAlias = tuple[Numbers, Numbers]  # arc lengths, rising, and the largest speed at each
Limits: TypeAlias = float | Numbers  # of the length of a vector, or of each axis
LONGEST = 1_000_000  # samples of a plan
ROUNDS = 5  # of planning, at most, each with more places that are made slower
LEFT = 0.01  # of the time, which is stretched instead
BEYOND = 1e4  # times what samples can show, at which a limit is none; larger numbers cost digits


class Plan(NamedTuple):
    """A path planned in time, sampled at k dt, k = 0..N.

    reference:    (N+1, d) positions, each on the curve [mm]
    parameter:    (N+1,) of the curve
    arc:          (N+1,) length covered [mm]
    speed:        (N+1,) first derivative of `arc` [mm/s]
    acceleration: (N+1,) second derivative of `arc` [mm/s^2]
    jerk:         (N+1,) third derivative of `arc` [mm/s^3]
    dt:           [s]
    """

    reference: np.ndarray
    parameter: np.ndarray
    arc: np.ndarray
    speed: np.ndarray
    acceleration: np.ndarray
    jerk: np.ndarray
    dt: float

    @property
    def duration(self) -> float:
        """N dt [s]."""
        return (len(self.reference) - 1) * self.dt

    @property
    def time(self) -> np.ndarray:
        """(N+1,) [s]."""
        return np.arange(len(self.reference)) * self.dt


def plan(
    curve: Curve,
    interval: tuple[float, float],
    *,
    feed: float,
    acceleration: Limits,
    jerk: Limits,
    dt: float,
    points: int = 20001,
) -> Plan:
    """Nearly time-optimal motion along the curve from rest to rest, within limits.

    Look-ahead planning, forward and backward, gives a first profile. An interior-point method then
    shortens its time (`fastest_profile`):

        minimise T = int beta^(-1/2) dx    over beta(x) = (dx/dt)^2

    where p(x) is the path over the profile's own time x, ' = d/dx, and the limited quantities are

        velocity      p' beta^(1/2)
        acceleration  p'' beta + p' beta' / 2
        jerk          beta^(1/2) (p''' beta + 3/2 p'' beta' + p' beta'' / 2)

    Every iterate keeps the limits at all grid points (Newton steps on a logarithmic barrier, of a
    banded Hessian), so it may stop anywhere. Last, time is stretched to whole samples, and further
    until the *sampled* reference keeps the limits. Its differences up to the third are looked at,
    the rest before and after included, as vectors or axis by axis, and those of the length covered;
    all of it up to the rounding of positions, 32 eps max |p| / dt^3 in the jerk.

    curve:        any callable from (M,) parameter values to (M, d) positions [mm]
    interval:     (first, last) parameter, first < last
    feed:         largest path speed [mm/s]
    acceleration: () largest length of the acceleration vector, centripetal part included, or (d,)
                  of each axis [mm/s^2]
    jerk:         () or (d,) likewise [mm/s^3]; where it is (), it also limits the second
                  derivative of the path speed
    dt:           sample time [s]
    points:       of the table of the curve, spaced evenly in its parameter; splines of fifth order
                  run through them

    A jump of the curvature, as between line and arc, counts as a rise over a step h of the planning
    grid (2000 to 20000 steps), or over a sample where that is shorter: it is passed at about (jerk
    h / jump)^(1/2), so blend such paths where time matters. Up to four further plans are slower
    where the samples of the one before exceed a limit, and the shortest is taken.

    Raises ValueError for a value outside its range, for a curve that is not finite, stands still,
    has a corner or cusp (there the tool would have to stop: split the path, plan the parts) or
    bends too sharply for its table, and for more than a million samples.
    """
    u, q, arc = tabulated(curve, interval, points)
    _require_limits(q.shape[1], feed, acceleration, jerk, dt)
    limits = f"feed = {feed:g} mm/s, acceleration = {acceleration} mm/s^2, jerk = {jerk} mm/s^3"
    feed = np.minimum(feed, BEYOND * arc[-1] / dt)
    acceleration = np.minimum(acceleration, BEYOND * feed / dt)
    jerk = np.minimum(jerk, BEYOND * np.max(acceleration) / dt)  # keeps its shape
    groups = _groups(q.shape[1], acceleration, jerk)
    ramp, T, arc_at = _look_ahead(arc, q, feed, np.min(acceleration), np.min(jerk))
    if not T / dt <= LONGEST:
        raise ValueError(
            f"plan: {limits} need {T:.3g} s, {T / dt:.3g} samples of dt = {dt:g} s; allowed are up "
            f"to {LONGEST}"
        )
    parameter_at = scipy.interpolate.make_interp_spline(arc, u, 5)

    def on_curve(s: Numbers) -> tuple[Numbers, Numbers]:
        """(M, d+1) positions, and the arc length as one more axis."""
        parameter = np.clip(parameter_at(s), u[0], u[-1])
        parameter[s <= 0], parameter[s >= arc[-1]] = u[0], u[-1]
        return np.column_stack([curve(parameter), s]), parameter

    # The first solution becomes the time base of the second: then the grid is fine where the motion
    # turned out to be slow. Where samples show more than the grid, as at a jump of the curvature,
    # further solutions are slower, with less jerk beside that of the jump.
    caps, shortest = list[Cap](), np.inf
    for gap in (1e-1, 1e-2, *[3e-4] * ROUNDS):
        x, path = _over_time(on_curve, arc_at, arc[-1], T, np.clip(dt, ramp / 100, ramp / 8))
        speeds = _allowed(path(x)[:, -1], feed, caps)
        share = np.where(speeds < feed, 0.5, 1.0)
        local = [(axes, a, share * j) for axes, a, j in groups]
        profile = Profile(fastest(path, x[1], len(x) - 1, speeds, local, gap), x[1])
        T, arc_at = (
            profile.times[-1],
            lambda t, path=path, profile=profile: path(profile.at(t))[:, -1],
        )
        if gap > 3e-4:
            continue
        s = _in_samples(path, profile, arc[-1], int(np.ceil(T / dt - 1e-9)))[1]
        excess = _excess(on_curve(s)[0], dt, feed, groups)
        if T * np.max(excess) < shortest:
            shortest, chosen = T * np.max(excess), (path, profile)
        if np.max(excess) <= 1 + LEFT:
            break
        caps.append(_cap(s, excess, dt, int(np.ceil(x[1] / dt))))
    return _sampled(on_curve, *chosen, arc[-1], dt, feed, groups)


def _over_time(
    on_curve: Function, arc_at: Function, length: float, T: float, step: float
) -> tuple[Numbers, Spline]:
    """(G+1,) times of a profile, and the spline of the path and its arc length over them.

    on_curve: positions and arc length, and parameter, at an arc length
    arc_at: arc length at a time of the profile, which lasts T
    step: of the grid; 2000 to 20000 steps are taken
    """
    # Finer than the ramps need only costs digits: the Hessian's condition grows with the fourth
    # power of the number of steps.
    G = int(np.clip(np.ceil(T / step), 2000, 20_000))
    x = np.linspace(0.0, T, G + 1)
    s = np.append(np.clip(arc_at(x[:-1]), 0.0, length), length)
    positions = on_curve(s)[0]
    at_rest = [(1, np.zeros(positions.shape[1]))]
    # Cubic: its third derivative and that of beta jump together, between intervals, so that the
    # limits hold within each.
    return x, scipy.interpolate.make_interp_spline(x, positions, 3, bc_type=(at_rest, at_rest))


def _sampled(
    on_curve: Function,
    path: Spline,
    profile: Profile,
    length: float,
    dt: float,
    feed: float,
    groups: Groups,
) -> Plan:
    """The plan of a profile in whole samples, slowed down until they keep the limits."""
    T, stretch = profile.times[-1], 1.0
    while True:
        N = int(np.ceil(T * stretch / dt - 1e-9))
        stretch = N * dt / T
        x, s = _in_samples(path, profile, length, N)
        reference, parameter = on_curve(s)
        excess = np.max(_excess(reference, dt, feed, groups))
        if excess <= 1.0:
            break
        stretch *= max(excess, 1.0 + dt / T)
    beta, slope, bend = profile.beta(x)
    s1, s2, s3 = (path.derivative(i)(x)[:, -1] for i in (1, 2, 3))
    motion = (
        np.sqrt(beta) * s1 / stretch,
        (s2 * beta + s1 * slope / 2) / stretch**2,
        np.sqrt(beta) * (s3 * beta + 1.5 * s2 * slope + s1 * bend / 2) / stretch**3,
    )
    return Plan(reference[:, :-1], parameter, s, *motion, float(dt))


def _in_samples(path: Spline, profile: Profile, length: float, N: int) -> tuple[Numbers, Numbers]:
    """(N+1,) times of the grid of a profile, and arc lengths, at N equal steps of its time."""
    x = profile.at(np.arange(N + 1) / N * profile.times[-1])
    s = np.clip(path(x)[:, -1], 0.0, length)
    s[0], s[-1] = 0.0, length
    return x, s


def _cap(s: Numbers, excess: Numbers, dt: float, reach: int) -> Cap:
    """(N+1,) arc lengths of samples, and the path speeds there at which they keep the limits.

    excess: (N+4,) of the differences of the samples
    reach: the number of samples beside those of a difference that are slower, too
    """
    # The jerk grows with the square of the speed where the curvature jumps, and depends by a third
    # on where the samples lie beside the jump.
    excess = _widest(excess, 4, reach)
    speed = np.diff(s, append=s[-1]) / dt
    speed = np.maximum(_widest(speed, 1, reach + 3), 1e-3 * np.max(speed))  # 0 would be a stop
    return s, np.where(excess > 1 + LEFT, 0.9 * speed / excess ** (3 / 2), np.inf)


def _widest(values: Numbers, width: int, reach: int) -> Numbers:
    """The largest of each `width` neighbouring values and of as many as `reach` on both sides."""
    padded = np.pad(values, reach, mode="edge")
    return np.max(np.lib.stride_tricks.sliding_window_view(padded, width + 2 * reach), axis=1)


def _allowed(s: Numbers, feed: float, caps: list[Cap]) -> Numbers:
    """(G,) largest path speeds on the intervals between (G+1,) arc lengths."""
    speeds = np.full(len(s) - 1, float(feed))
    for places, cap in caps:
        first = np.clip(np.searchsorted(places, s, side="right") - 1, 0, len(places) - 1)
        within = np.minimum.reduceat(cap, first)[:-1]
        speeds = np.minimum(speeds, np.minimum(within, cap[first[1:]]))
    return speeds


def _require_limits(d: int, feed: float, acceleration: Limits, jerk: Limits, dt: float) -> None:
    """Raises ValueError for a limit or a sample time outside its range."""
    require("plan", "feed", feed, POSITIVE, " mm/s")
    require("plan", "dt", dt, "[1e-12, 1e9]", " s")
    for name, value, unit in (("acceleration", acceleration, " mm/s^2"), ("jerk", jerk, " mm/s^3")):
        if np.shape(value) not in ((), (d,)):
            raise ValueError(f"plan: {name} has shape {np.shape(value)}; allowed are () and ({d},)")
        require("plan", name, value, POSITIVE, unit, many=True)


def _groups(d: int, acceleration: Limits, jerk: Limits) -> Groups:
    """(axes, acceleration, jerk) for each vector that is limited; axis d is the arc length."""
    none = np.full(d, np.inf)
    (a, each_a), (j, each_j) = (
        (limit, none) if np.ndim(limit) == 0 else (np.inf, np.asarray(limit))
        for limit in (acceleration, jerk)
    )
    groups: Groups = [(np.arange(d), a, j), (np.array([d]), a, j)]
    groups += [(np.array([i]), each_a[i], each_j[i]) for i in range(d)]
    return [group for group in groups if min(group[1:]) < np.inf]


def _look_ahead(
    arc: Numbers, q: Numbers, feed: float, acceleration: float, jerk: float
) -> tuple[float, float, Function]:
    """A first profile: ramp time [s], duration [s] and arc length at a time, a function.

    The speed is at most feed, (acceleration / |q''|)^(1/2) and (jerk / |q'''|)^(1/3) over the arc
    length; v dv/ds is within the acceleration, forward and backward. Then the speed is averaged
    over the ramp time, which bounds its jerk. The profile need not keep the limits, only come near.
    """
    L = arc[-1]
    # a short move reaches no more
    acceleration = min(acceleration, np.sqrt(jerk * feed), np.cbrt(jerk**2 * L / 2))
    curve = scipy.interpolate.make_interp_spline(arc, q, 5)
    second, third = (
        np.maximum(np.linalg.norm(curve.derivative(i)(arc), axis=1), 1e-300) for i in (2, 3)
    )
    square = np.minimum(feed**2, np.minimum(acceleration / second, np.cbrt(jerk / third) ** 2))
    square[[0, -1]] = 0.0
    rise = 2 * acceleration * arc
    square = np.minimum.accumulate(square - rise) + rise
    square = np.minimum.accumulate((square + rise)[::-1])[::-1] - rise
    v = np.sqrt(np.maximum(square, 0.0))
    with np.errstate(divide="ignore"):  # a feed so slow that rounding leaves none
        t = np.append(0.0, np.cumsum(2 * np.diff(arc) / (v[1:] + v[:-1])))
    ramp, T = acceleration / jerk, t[-1] + acceleration / jerk
    if not np.isfinite(T):
        return ramp, T, np.zeros_like
    # the integral is exact at constant acceleration, as in the start from rest
    integral = scipy.interpolate.make_interp_spline(t, v, 1).antiderivative(2)

    def integral_at(x: Numbers) -> Numbers:
        inside = np.clip(x, 0.0, t[-1])
        return integral(inside) + (x > t[-1]) * L * (x - inside)

    return ramp, T, lambda x: (integral_at(x) - integral_at(x - ramp)) / ramp


def _excess(reference: Numbers, dt: float, feed: float, groups: Groups) -> Numbers:
    """(N+4,) factors by which time must be stretched for the sampled reference to keep its limits.

    It is its differences that must keep them; number i is that of the samples i - 3 to i.
    """
    held = np.pad(reference, ((3, 3), (0, 0)), mode="edge")
    # Positions are rounded, and at a short dt their differences are mostly that, which no
    # stretching would cure.
    rounding = 32 * np.finfo(float).eps * np.max(np.abs(reference))
    v, a, j = (
        np.maximum(np.abs(np.diff(held, i, axis=0)) - rounding, 0.0)[: len(held) - 3] / dt**i
        for i in (1, 2, 3)
    )
    excess = v[:, -1] / feed
    for axes, acceleration, jerk in groups:
        of_a = np.linalg.norm(a[:, axes], axis=1) / acceleration
        of_j = np.linalg.norm(j[:, axes], axis=1) / jerk
        excess = np.maximum(excess, np.maximum(np.sqrt(of_a), np.cbrt(of_j)))
    return excess


# Curves
# --------------------------------------------------------------------------------------------------

_BUTTERFLY_POINTS = """
54.493 52.139 55.507 52.139 56.082 49.615 56.780 44.971 69.575 51.358 77.786 58.573 90.526 67.081
105.973 63.801 100.400 47.326 94.567 39.913 92.369 30.485 83.440 33.757 91.892 28.509 89.444 20.393
83.218 15.446 87.621 4.830 80.945 9.267 79.834 14.535 76.074 8.522 70.183 12.550 64.171 16.865
59.993 22.122 55.680 36.359 56.925 24.995 59.765 19.828 54.493 14.940 49.220 19.828 52.060 24.994
53.305 36.359 48.992 22.122 44.814 16.865 38.802 12.551 32.911 8.521 29.152 14.535 28.040 9.267
21.364 4.830 25.768 15.447 19.539 20.391 17.097 28.512 25.537 33.750 16.602 30.496 14.199 39.803
8.668 47.408 3.000 63.794 18.465 67.084 31.197 58.572 39.411 51.358 52.204 44.971 52.904 49.614
53.478 52.139 54.492 52.139"""
_BUTTERFLY_WEIGHTS = {  # the others are 1
    3: 1.2, 11: 2.0, 14: 5.0, 15: 3.0, 17: 1.1, 33: 1.1, 35: 3.0, 36: 5.0, 39: 2.0, 47: 1.2,
}  # fmt: skip
_BUTTERFLY_KNOTS = """
0 0 0 0 .0083 .0150 .0361 .0855 .1293 .1509 .1931 .2273 .2435 .2561 .2692 .2889 .3170 .3316 .3482
.3553 .3649 .3837 .4005 .4269 .4510 .4660 .4891 .5000 .5109 .5340 .5489 .5731 .5994 .6163 .6351
.6447 .6518 .6683 .6830 .7111 .7307 .7439 .7565 .7729 .8069 .8491 .8707 .9145 .9639 .9850 .9917 1 1
1 1"""
_BUTTERFLY_WIDTH = 97.1619  # of the curve with the table's numbers [mm]


def line(start: Value, end: Value) -> Curve:
    """The straight line from `start` to `end`, (d,) each [mm], over the interval (0, 1)."""
    start, end = np.asarray(start, float), np.asarray(end, float)
    return lambda s: start + np.multiply.outer(s, end - start)


def circle(radius: float, *, centre: Value = (0.0, 0.0)) -> Curve:
    """Anticlockwise circle over the angle s [rad], from the point at s = 0 on the positive x-axis.

    radius: [mm]
    centre: (2,) [mm]
    """
    require("circle", "radius", radius, POSITIVE, " mm")
    return lambda s: np.asarray(centre) + radius * np.stack([np.cos(s), np.sin(s)], axis=-1)


def nurbs(points: Value, knots: Value, weights: Value = None) -> Curve:
    """Non-uniform rational B-spline over (knots[degree], knots[-degree - 1]).

        C(s) = sum_i w_i N_i(s) P_i / sum_i w_i N_i(s)

    Its degree is len(knots) - len(points) - 1.

    points:  (n, d) control points [mm]
    knots:   not falling; where they are clamped, the interval goes from the first to the last
    weights: (n,) > 0; None for all one

    Raises ValueError where the shapes do not fit, the knots fall or do not rise, or a weight is not
    positive, and the curve for a parameter outside the interval.
    """
    points, knots = np.asarray(points, float), np.asarray(knots, float)
    weights = np.ones(len(points)) if weights is None else np.asarray(weights, float)
    if (
        points.ndim != 2
        or weights.shape != points.shape[:1]
        or knots.ndim != 1
        or len(knots) < len(points) + 2
    ):
        shapes = f"points {points.shape}, knots {knots.shape}, weights {weights.shape}"
        raise ValueError(
            f"nurbs: {shapes}; allowed are (n, d), (n + degree + 1,), (n,) with degree >= 1"
        )
    require("nurbs", "weights", weights, POSITIVE, many=True)
    degree = len(knots) - len(points) - 1
    low, high = knots[[degree, -degree - 1]]
    if not (np.all(np.diff(knots) >= 0) and low < high):
        raise ValueError(f"nurbs: knots = {brief(knots.tolist())} must not fall, and must rise")
    homogeneous = scipy.interpolate.BSpline(
        knots, np.column_stack([points * weights[:, None], weights]), degree
    )

    def curve(s: Numbers) -> Numbers:
        for end in (np.min(s, initial=high), np.max(s, initial=low)):
            require("nurbs", "s", end, f"[{low}, {high}]")
        h = homogeneous(s)
        return h[..., :-1] / h[..., -1:]

    return curve


def butterfly(width: float = _BUTTERFLY_WIDTH) -> Curve:
    """The cubic NURBS butterfly that the papers on CNC interpolators use, over (0, 1).

    It has 51 control points, runs clockwise from the head, (0, 0), and ends 0.001 mm beside it. It
    is symmetric about x = 0, except for roundings and for the two control points of 0.2 mm that the
    table holds differently for the wings. Curvature is continuous; it peaks at the notches of the
    wings, s = 0.256 and 0.744 (radius 0.023 mm at the default width), and beside the tail, s =
    0.450 and 0.550 (0.054 mm). Li 2020 shows its path only as a picture (Fig. 4) and prints no
    data: that it is this butterfly, and its size, are chosen here.

    width: over the wings [mm]; the default keeps the table's numbers, for a path of 383 mm, 58.9 mm
           high
    """
    require("butterfly", "width", width, POSITIVE, " mm")
    points = np.array(_BUTTERFLY_POINTS.split(), float).reshape(-1, 2)
    weights = [_BUTTERFLY_WEIGHTS.get(i, 1.0) for i in range(len(points))]
    return nurbs(
        (points - points[0]) * (width / _BUTTERFLY_WIDTH),
        np.array(_BUTTERFLY_KNOTS.split(), float),
        weights,
    )


def tabulated(
    curve: Curve, interval: tuple[float, float], points: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Parameter (M,), position (M, d) and arc length (M,) along the curve.

    Raises ValueError, which says what is wrong with the curve.
    """
    if len(interval) != 2 or not -np.inf < interval[0] < interval[1] < np.inf:
        raise ValueError(f"plan: interval = {interval} is not (first, last) with first < last")
    require("plan", "points", points, "[100, 1000000]", whole=True)
    u = np.linspace(*interval, points)
    q = np.asarray(curve(u), float)
    if q.ndim != 2 or len(q) != points or not q.shape[1]:
        raise ValueError(
            f"plan: the curve gives shape {q.shape} for ({points},) parameters; allowed is "
            f"({points}, d)"
        )
    finite = np.isfinite(q).all(axis=1)
    if not finite.all():
        raise ValueError(f"plan: the curve is not finite at parameter {u[np.argmin(finite)]:g}")
    chords = np.linalg.norm(np.diff(q, axis=0), axis=1)
    shortest = np.argmin(chords)
    if not chords[shortest] > 1e-9 * np.mean(chords):
        raise ValueError(
            f"plan: the curve stands still from parameter {u[shortest]:.9g} to "
            f"{u[shortest + 1]:.9g}, at {q[shortest]} mm"
        )
    _require_smooth(curve, u, q)
    speed = np.linalg.norm(scipy.interpolate.make_interp_spline(u, q, 5).derivative()(u), axis=1)
    arc = scipy.interpolate.make_interp_spline(u, speed, 5).antiderivative()(u)
    return u, q, arc - arc[0]


def _turns(q: Numbers) -> Numbers:
    """(..., M-2) angle between successive chords of (..., M, d) points [rad]."""
    chords = np.diff(q, axis=-2)
    chords = chords / np.maximum(np.linalg.norm(chords, axis=-1, keepdims=True), 1e-300)
    return 2 * np.arcsin(np.clip(np.linalg.norm(np.diff(chords, axis=-2), axis=-1) / 2, 0, 1))


def _require_smooth(curve: Curve, u: Numbers, q: Numbers) -> None:
    """Look closer at every local maximum of turning.

    On a smooth curve the angle shrinks with the step; at a corner it stays.
    """
    turn = _turns(q)
    wide = np.pad(turn, 1)
    i = np.flatnonzero((turn >= wide[:-2]) & (turn >= wide[2:]) & (turn > 1e-3))
    centre, step, closer = u[1:-1][i], np.full(len(i), u[1] - u[0]), turn[i]
    for _ in range(14):
        step = step / 2
        trial = centre[:, None] + step[:, None] * np.arange(-2, 3)
        angles = _turns(np.asarray(curve(trial.ravel()), float).reshape(*trial.shape, q.shape[1]))
        best = np.argmax(angles, axis=1)
        centre, closer = trial[np.arange(len(i)), best + 1], angles[np.arange(len(i)), best]
    wrong = (closer > turn[i] / 2) | (turn[i] > 0.5)
    for where, angle, seen in zip(centre[wrong], closer[wrong], turn[i][wrong], strict=True):
        at = (
            f"at parameter {where:.9g}, position "
            f"{np.round(np.asarray(curve(np.array([where])))[0], 6)} mm"
        )
        if angle > seen / 2:
            raise ValueError(
                f"plan: the path has a corner or cusp of {np.degrees(angle):.3g} deg {at}; split "
                "the path there"
            )
        if seen > 0.5:
            raise ValueError(
                f"plan: the path turns by {np.degrees(seen):.3g} deg between two points of its "
                f"table {at}; raise points"
            )
