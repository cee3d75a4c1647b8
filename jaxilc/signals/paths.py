"""Velocity planning along a tool path in the plane or in space.

A curve is any callable that takes (M,) parameter values and returns (M, d) positions [mm]; some are
in `curves`, and named here. Planning runs once, on the host, in float64; what comes out is a
reference for `Task`.
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np
import scipy

from ..pytree.aliases import Function, Numbers
from ..pytree.ranges import require
from .curves import Curve, butterfly, circle, line, nurbs, tabulated
from .fastest_profile import Groups, Profile, Spline, fastest
from .sample_times import POSITIVE

__all__ = ["Plan", "butterfly", "circle", "line", "nurbs", "plan"]

Limits: TypeAlias = float | Numbers  # of the length of a vector, or of each axis
LONGEST = 1_000_000  # samples of a plan
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
    jerk:         () or (d,) likewise [mm/s^3]; where both are (), they also limit the derivatives
                  of the path speed
    dt:           sample time [s]
    points:       of the table of the curve, spaced evenly in its parameter; splines of fifth order
                  run through them

    A jump of the curvature, as between line and arc, counts as a rise over one step h of the
    planning grid (2000 to 20000 steps): it is passed at about (jerk h / jump)^(1/2), so blend such
    paths where time matters.

    Raises ValueError for a value outside its range, for a curve that is not finite, stands still,
    has a corner or cusp (there the tool would have to stop: split the path, plan the parts) or
    bends too sharply for its table, and for more than a million samples.
    """
    u, q, arc = tabulated(curve, interval, points)
    _require_limits(q.shape[1], feed, acceleration, jerk, dt)
    limits = f"feed = {feed:g} mm/s, acceleration = {acceleration} mm/s^2, jerk = {jerk} mm/s^3"
    feed = np.minimum(feed, BEYOND * arc[-1] / dt)
    acceleration = np.minimum(acceleration, BEYOND * feed / dt)
    jerk = np.minimum(jerk, BEYOND * acceleration / dt)
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
    # turned out to be slow.
    for gap in (1e-1, 1e-2, 3e-4):
        x, path = _over_time(on_curve, arc_at, arc[-1], T, np.clip(dt, ramp / 100, ramp / 8))
        profile = Profile(fastest(path, x[1], len(x) - 1, feed, groups, gap), x[1])
        T, arc_at = (
            profile.times[-1],
            lambda t, path=path, profile=profile: path(profile.at(t))[:, -1],
        )
    return _sampled(on_curve, path, profile, arc[-1], dt, feed, groups)


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
        x = profile.at(np.arange(N + 1) / N * T)
        s = np.clip(path(x)[:, -1], 0.0, length)
        s[0], s[-1] = 0.0, length
        reference, parameter = on_curve(s)
        excess = _excess(reference, dt, feed, groups)
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
    if np.ndim(acceleration) == 0 and np.ndim(jerk) == 0:
        return [(np.arange(d), acceleration, jerk), (np.array([d]), acceleration, jerk)]
    accelerations, jerks = np.broadcast_to(acceleration, d), np.broadcast_to(jerk, d)
    return [(np.array([i]), accelerations[i], jerks[i]) for i in range(d)]


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


def _excess(reference: Numbers, dt: float, feed: float, groups: Groups) -> float:
    """The factor by which time must be stretched for the sampled reference to keep every limit.

    It is its differences that must keep them.
    """
    held = np.pad(reference, ((3, 3), (0, 0)), mode="edge")
    # Positions are rounded, and at a short dt their differences are mostly that, which no
    # stretching would cure.
    rounding = 32 * np.finfo(float).eps * np.max(np.abs(reference))
    v, a, j = (
        np.maximum(np.abs(np.diff(held, i, axis=0)) - rounding, 0.0) / dt**i for i in (1, 2, 3)
    )
    excess = [np.max(v[:, -1]) / feed]
    for axes, acceleration, jerk in groups:
        excess += [np.max(np.linalg.norm(a[:, axes], axis=1) / acceleration) ** (1 / 2)]
        excess += [np.max(np.linalg.norm(j[:, axes], axis=1) / jerk) ** (1 / 3)]
    return max(excess)
