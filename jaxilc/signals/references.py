"""Reference trajectories, and the M-sequence as an identification input.

References are data: built once, on the host, in float64. Each is an array of shape (N+1,) holding
both ends, sample `k` at the time k dt, ready for `Task`. Lengths are in the user's unit, mm in this
package.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy

from ..pytree.aliases import Numbers
from ..pytree.ranges import require
from ..runtime.capacity import check_size
from .s_curves import SCurveMove, s_curve, s_curve_move
from .sample_times import ARRAYS, FINITE, NONNEGATIVE, POSITIVE, sample_times

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
    if method not in ("linear", "logarithmic"):
        raise ValueError(f"chirp: method = {method!r} is not one of 'linear', 'logarithmic'")
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
