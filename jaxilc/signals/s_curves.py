"""Point-to-point moves within limits of velocity, acceleration and jerk."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..pytree.aliases import Numbers, Value
from ..pytree.ranges import require
from .sample_times import FINITE, NONNEGATIVE, POSITIVE, sample_times


class SCurveMove(NamedTuple):
    """One point-to-point move at piecewise constant jerk, from rest to rest.

    It has seven segments of jerk (+ 0 - 0 - 0 +).

    distance:  signed [mm]
    jerk:      of the first segment, with the sign of the move [mm/s^3]
    durations: of the seven segments [s], symmetric: t_j, t_a, t_j, t_v, t_j, t_a, t_j
    """

    distance: Value
    jerk: Value
    durations: tuple[Value, ...]

    @property
    def duration(self) -> Value:
        """Time from rest to rest [s]."""
        return sum(self.durations)

    def at(self, t: Numbers) -> tuple[np.ndarray, ...]:
        """Position, velocity, acceleration and jerk at the times `t` [s], each shaped like `t`.

        Outside the move it is at rest. At a switching time the jerk is that of one of its two
        segments.
        """
        t = np.asarray(t, float)
        # The second half is the first one reversed, so that rounding cannot keep the end from being
        # met exactly, at rest.
        late = t > self.duration / 2
        s = np.where(late, self.duration - t, t)
        p, v, a, j = np.zeros((4, *t.shape))
        start = 0.0
        for h, jerk in zip(self.durations[:4], (self.jerk, 0.0, -self.jerk, 0.0), strict=True):
            tau = np.clip(s - start, 0.0, h)
            p += tau * (v + tau * (a / 2 + tau * jerk / 6))
            v += tau * (a + tau * jerk / 2)
            a += tau * jerk
            j = np.where((s >= start) & (h > 0), jerk, j)
            start += h
        return np.where(late, self.distance - p, p), v, np.where(late, -a, a), j


def s_curve_move(
    distance: float, *, velocity: float, acceleration: float, jerk: float
) -> SCurveMove:
    """The time-optimal move over `distance` from rest to rest within three limits, in closed form.

        t_j = min(acceleration / jerk, (velocity / jerk)^(1/2), (distance / 2 jerk)^(1/3))
        a   = jerk t_j
        t_a = min(velocity / a - t_j, ((t_j^2 + 4 distance / a)^(1/2) - 3 t_j) / 2)
        v   = a (t_j + t_a)
        t_v = distance / v - 2 t_j - t_a

    `a` and `v` are the peaks; t_a = 0 where the acceleration limit is not reached, t_v = 0 where
    the velocity limit is not.

    distance:     [mm], either sign
    velocity:     > 0 [mm/s]
    acceleration: > 0 [mm/s^2]
    jerk:         > 0 [mm/s^3]

    Raises ValueError for a value outside its range.
    """
    require("s_curve_move", "distance", distance, FINITE, " mm")
    _require_limits("s_curve_move", velocity, acceleration, jerk)
    move = s_curve_moves(*(float(x) for x in (distance, velocity, acceleration, jerk)))
    return SCurveMove(
        move.distance, float(move.jerk), tuple(float(duration) for duration in move.durations)
    )


def s_curve_moves(distance: Value, velocity: Value, acceleration: Value, jerk: Value) -> SCurveMove:
    """Many moves at once, each as `s_curve_move` gives it; nothing is checked.

    distance, velocity, acceleration, jerk: () or (M,), of which one shape follows
    Returns a move whose fields have that shape.
    """
    d = np.abs(distance)
    t_j = np.minimum(
        np.minimum(acceleration / jerk, np.sqrt(velocity / jerk)), np.cbrt(d / (2 * jerk))
    )
    a = jerk * t_j
    with np.errstate(divide="ignore", invalid="ignore"):  # a distance of 0
        t_a = np.minimum(velocity / a - t_j, (np.sqrt(t_j**2 + 4 * d / a) - 3 * t_j) / 2)
        t_a = np.where(d > 0, np.maximum(t_a, 0.0), 0.0)
        t_v = d / (a * (t_j + t_a)) - 2 * t_j - t_a
        t_v = np.where(d > 0, np.maximum(t_v, 0.0), 0.0)
    signed = np.copysign(np.where(d > 0, jerk, 0.0), distance)
    return SCurveMove(distance, signed, (t_j, t_a, t_j, t_v, t_j, t_a, t_j))


def s_curve(
    positions: Value,
    *,
    velocity: float,
    acceleration: float,
    jerk: float,
    dwell: float = 0.0,
    dt: float,
    duration: float | None = None,
) -> np.ndarray:
    """Time-optimal jerk-limited moves from position to position, with a dwell after each.

    The shape is (N+1,).

    positions:    (M,) [mm], the first is the start
    velocity:     [mm/s]
    acceleration: [mm/s^2]
    jerk:         [mm/s^3]
    dwell:        [s]
    dt:           [s]
    duration:     [s], the end is held; None for the first sample at which everything is done

    The moves switch between samples where they must; nothing is stretched onto the sample grid.
    Differences of the sampled reference are means of the derivatives, so they keep the limits as
    well.

    Raises ValueError for a value outside its range, fewer than two positions, or a duration that is
    too short for the moves or not a whole number of samples.
    """
    require("s_curve", "positions", positions, FINITE, " mm", many=True)
    positions = np.asarray(positions, float)
    if positions.ndim != 1 or len(positions) < 2:
        raise ValueError(
            f"s_curve: positions has shape {positions.shape}; allowed is (M,) with M >= 2"
        )
    _require_limits("s_curve", velocity, acceleration, jerk)
    require("s_curve", "dwell", dwell, NONNEGATIVE, " s")
    require("s_curve", "dt", dt, POSITIVE, " s")
    moves = [
        s_curve_move(d, velocity=velocity, acceleration=acceleration, jerk=jerk)
        for d in np.diff(positions)
    ]
    needed = sum(move.duration + dwell for move in moves)
    if duration is None:
        duration = dt * max(np.ceil(needed / dt - 1e-9), 1)
    time = sample_times("s_curve", duration, dt)
    if time[-1] < needed - 1e-9 * dt:
        raise ValueError(
            f"s_curve: duration = {duration:g} s is outside its allowed range [{needed:.9g}, inf), "
            "the time of all moves"
        )
    r, start = np.full(len(time), positions[0]), 0.0
    for move, origin, target in zip(moves, positions[:-1], positions[1:], strict=True):
        under_way = time > start
        r[under_way] = origin + move.at(time[under_way] - start)[0]
        # origin + (target - origin) may round to a neighbour
        r[under_way & (time >= start + move.duration - 1e-9 * dt)] = target
        start += move.duration + dwell
    return r


def _require_limits(function: str, velocity: float, acceleration: float, jerk: float) -> None:
    require(function, "velocity", velocity, POSITIVE, " mm/s")
    require(function, "acceleration", acceleration, POSITIVE, " mm/s^2")
    require(function, "jerk", jerk, POSITIVE, " mm/s^3")
