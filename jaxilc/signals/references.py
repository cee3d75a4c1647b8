"""Reference trajectories, and the M-sequence as an identification input.

References are data: built once, on the host, in float64. Each is an array of shape (N+1,) holding
both ends, sample `k` at the time k dt, ready for `Task`. Lengths are in the user's unit, mm in this
package.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy

from ..pytree.aliases import Numbers, Value
from ..pytree.ranges import need_one_of, require
from ..runtime.capacity import check_size

__all__ = [
    "SCurveMove",
    "chirp",
    "m_sequence",
    "multisine",
    "noncircular",
    "s_curve",
    "s_curve_move",
    "sinusoid",
]

FINITE, POSITIVE, NONNEGATIVE = "(-inf, inf)", "(0, inf)", "[0, inf)"
ARRAYS = 32  # of the length of a reference, that making it and one trial of it take


def sample_times(function: str, duration: float, dt: float, arrays: int = ARRAYS) -> Numbers:
    """(N+1,) sample times [s], N = round(duration / dt).

    arrays: how many arrays of that length will be needed

    Raises ValueError for a value outside its range, more samples than fit into memory, or a
    duration that is not a whole number of samples.
    """
    require(function, "dt", dt, POSITIVE, " s")
    require(function, "duration", duration, POSITIVE, " s")
    samples = float(duration) / float(dt)
    check_size(f"{function}: duration = {duration:g} s", 8 * arrays, samples=samples)
    N = round(samples)
    if N < 1 or abs(samples - N) > 1e-6:
        raise ValueError(
            f"{function}: duration = {duration:g} s is not a whole number >= 1 of samples of dt = "
            f"{dt:g} s"
        )
    return np.arange(N + 1) * dt


def sinusoid(
    amplitude: float,
    frequency: float,
    *,
    duration: float,
    dt: float,
    phase: float = 0.0,
    offset: float = 0.0,
) -> np.ndarray:
    """r = offset + amplitude sin(2 pi frequency t + phase), shape (N+1,).

    amplitude, offset: [mm]
    frequency:    [Hz], below Nyquist
    phase:        [rad]
    duration, dt: [s]

    From a plant at rest the sine starts with a jump of velocity; offset = amplitude with phase =
    -pi/2 starts without one. Raises ValueError for a value outside its range, or a duration that is
    not a whole number of samples.
    """
    time = sample_times("sinusoid", duration, dt)
    require("sinusoid", "amplitude", amplitude, FINITE, " mm")
    require("sinusoid", "frequency", frequency, f"(0, {0.5 / dt})", " Hz")
    require("sinusoid", "phase", phase, FINITE, " rad")
    require("sinusoid", "offset", offset, FINITE, " mm")
    return offset + amplitude * np.sin(2 * np.pi * frequency * time + phase)


def multisine(
    amplitudes: Numbers,
    frequencies: Numbers,
    phases: Numbers | None = None,
    *,
    duration: float,
    dt: float,
) -> np.ndarray:
    """r = sum_i amplitudes_i sin(2 pi frequencies_i t + phases_i), shape (N+1,).

    amplitudes:   (M,) > 0 [mm]
    frequencies:  (M,) [Hz], below Nyquist
    phases:       (M,) [rad]
    duration, dt: [s]

    By default it is Schroeder's (1970) sum of cosines, whose crest factor is low for equally
    spaced, ascending frequencies:

        phases_n = pi / 2 - 2 pi sum_{l<n} (n - l) p_l,    p_l = amplitudes_l^2 / sum amplitudes^2

    The signal then starts away from zero, at sum_i amplitudes_i sin(phases_i); zero phases start at
    zero but peak higher.

    Raises ValueError for a value outside its range, shapes that differ, or a duration that is not a
    whole number of samples.
    """
    require("multisine", "amplitudes", amplitudes, POSITIVE, " mm", many=True)
    time = sample_times("multisine", duration, dt, ARRAYS + 3 * np.size(amplitudes))
    require("multisine", "frequencies", frequencies, f"(0, {0.5 / dt})", " Hz", many=True)
    a, f = np.asarray(amplitudes, float), np.asarray(frequencies, float)
    if phases is None:
        steps = np.cumsum(a**2) / np.sum(a**2)
        phases = np.pi / 2 - 2 * np.pi * (np.cumsum(steps) - steps)
    require("multisine", "phases", phases, FINITE, " rad", many=True)
    phi = np.asarray(phases, float)
    if a.ndim != 1 or not a.size or not a.shape == f.shape == phi.shape:
        raise ValueError(
            f"multisine: amplitudes {a.shape}, frequencies {f.shape}, phases {phi.shape} must have "
            "one shape (M,), M >= 1"
        )
    return np.sin(2 * np.pi * np.outer(time, f) + phi) @ a


def chirp(
    amplitude: float,
    f_start: float,
    f_stop: float,
    *,
    duration: float,
    dt: float,
    method: str = "linear",
) -> np.ndarray:
    """r = amplitude sin(2 pi int_0^t f), shape (N+1,), with r[0] = 0.

    f sweeps from f_start at t = 0 to f_stop at t = duration:

        linear:       f = f_start + (f_stop - f_start) t / duration
        logarithmic:  f = f_start (f_stop / f_start)^(t / duration)

    amplitude:       [mm]
    f_start, f_stop: [Hz], below Nyquist, rising or falling
    duration, dt:    [s]

    Raises ValueError for a value outside its range, an unknown method, or a duration that is not a
    whole number of samples.
    """
    time = sample_times("chirp", duration, dt)
    require("chirp", "amplitude", amplitude, FINITE, " mm")
    require("chirp", "f_start", f_start, f"(0, {0.5 / dt})", " Hz")
    require("chirp", "f_stop", f_stop, f"(0, {0.5 / dt})", " Hz")
    need_one_of("chirp", "method", method, ("linear", "logarithmic"))
    growth = np.log(f_stop / f_start)
    if method == "linear" or growth == 0:
        cycles = f_start * time + (f_stop - f_start) * time**2 / (2 * duration)
    else:
        cycles = f_start * duration * np.expm1(growth * time / duration) / growth
    return amplitude * np.sin(2 * np.pi * cycles)


def m_sequence(
    order: int, *, amplitude: float = 1.0, hold: int = 1, periods: int = 1, seed: int = 1
) -> np.ndarray:
    """Maximum-length binary sequence of +-amplitude, an identification *input*.

    The shape is (N,), with N = periods hold (2^order - 1).

    order:     of the shift register, 2..32
    amplitude: in the input's unit
    hold:      samples for which a bit is held; at a sample time dt one bit lasts hold dt, and the
               spectrum has its first zero at 1 / (hold dt)
    periods:   repetitions
    seed:      initial register in binary, 1..2^order - 1; it only rotates the period

    An input acts on y[1] .. y[N], so it has no sample N, unlike the references. Its sum over a
    period is hold amplitude, not 0. Raises ValueError for a value outside its range.
    """
    require("m_sequence", "order", order, "[2, 32]", whole=True)
    require("m_sequence", "amplitude", amplitude, FINITE)
    require("m_sequence", "hold", hold, "[1, inf)", whole=True)
    require("m_sequence", "periods", periods, "[1, inf)", whole=True)
    order, hold, periods = int(order), int(hold), int(periods)  # NumPy's short ones overflow
    require("m_sequence", "seed", seed, f"[1, {2**order - 1}]", whole=True)
    samples = periods * hold * 2**order
    check_size(f"m_sequence: order = {order}", 8 * 4, samples=samples)
    bits, _ = scipy.signal.max_len_seq(order, state=[seed >> i & 1 for i in range(order)])
    return np.tile(np.repeat(amplitude * (2.0 * bits - 1.0), hold), periods)


def noncircular(
    *,
    duration: float,
    dt: float,
    spindle_speed: float,
    feed: float,
    ellipticity: Sequence[float],
    bulge: float,
    length: float,
) -> np.ndarray:
    """Tool path that turns a middle-convex piston of varying oval section (Cao 2019, eq. 28).

        y = f(Z) - G(Z) cos(2 omega t),    f(Z) = D(Z) / 2 + G(Z) / 4
        omega = 2 pi spindle_speed,    Z = feed spindle_speed t

    It is measured from its start, r = y - y(0). D (printed Delta D) varies the long axis: a
    parabola, 0 at both ends of the length and `bulge` in the middle. G, the ellipticity, runs from
    ellipticity[0] to ellipticity[1] as half a cosine period, level at both ends.

    It is read as printed: G is the amplitude of the oscillation, two periods a revolution. (An oval
    whose diameters differ by G would need the amplitude G / 4, the same as its share in f; the
    print has G.) The shapes of D and G are not printed, they are chosen here. The tool starts at
    its first point, r[0] = 0, and the oval starts it without velocity; the convexity leaves the
    small 2 bulge feed spindle_speed / length [mm/s], so the velocity at t = 0 is exactly zero for
    bulge = 0.

    spindle_speed: [rev/s], the oval's 2 spindle_speed below Nyquist
    feed:          [mm/rev]
    duration, dt:  [s]
    ellipticity:   (2,) >= 0 [mm], at Z = 0 and Z = length
    bulge:         >= 0 [mm]
    length:        [mm]

    Raises ValueError for a value outside its range, or a duration in which Z leaves the length or
    that is not a whole number of samples.
    """
    time = sample_times("noncircular", duration, dt)
    require("noncircular", "spindle_speed", spindle_speed, f"(0, {0.25 / dt})", " rev/s")
    require("noncircular", "feed", feed, POSITIVE, " mm/rev")
    require("noncircular", "ellipticity", ellipticity, NONNEGATIVE, " mm", many=True)
    if np.shape(ellipticity) != (2,):
        raise ValueError(
            f"noncircular: ellipticity has shape {np.shape(ellipticity)}; allowed is (2,)"
        )
    require("noncircular", "bulge", bulge, NONNEGATIVE, " mm")
    require("noncircular", "length", length, POSITIVE, " mm")
    longest = length / (feed * spindle_speed)
    if duration > longest * (1 + 1e-9):
        raise ValueError(
            f"noncircular: duration = {duration:g} s is outside its allowed range (0, "
            f"{longest:.9g}], else Z leaves length"
        )
    z = time / longest  # Z / length
    D = 4 * bulge * z * (1 - z)
    G = ellipticity[0] + (ellipticity[1] - ellipticity[0]) * np.sin(np.pi * z / 2) ** 2
    y = D / 2 + G / 4 - G * np.cos(4 * np.pi * spindle_speed * time)
    return y - y[0]


# Moves from point to point within limits of velocity, acceleration and jerk
# --------------------------------------------------------------------------------------------------


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
    dt = float(dt)
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
