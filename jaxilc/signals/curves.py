"""Curves to plan a motion along, with a check of their shape.

A curve is any callable that takes (M,) parameter values and returns (M, d) positions [mm].
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
import scipy

from ..pytree.aliases import Numbers, Value
from ..pytree.ranges import require
from .sample_times import POSITIVE

Curve: TypeAlias = Callable[[np.ndarray], np.ndarray]
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
    """Non-uniform rational B-spline over (knots[0], knots[-1]).

        C(s) = sum_i w_i N_i(s) P_i / sum_i w_i N_i(s)

    Its degree is len(knots) - len(points) - 1.

    points:  (n, d) control points [mm]
    knots:   clamped, not falling
    weights: (n,) > 0; None for all one

    Raises ValueError where the shapes do not fit or a weight is not positive.
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
    homogeneous = scipy.interpolate.BSpline(
        knots, np.column_stack([points * weights[:, None], weights]), len(knots) - len(points) - 1
    )

    def curve(s: Numbers) -> Numbers:
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
