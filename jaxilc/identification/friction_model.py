"""Mass and friction of an axis from its force and its position: the inverse dynamic model.

    force = mass a + viscous v + coulomb sign(v) + offset        (Janot and others, of EMPS)

Speed and acceleration are central differences of the position, filtered forth and back; the force
is filtered alike, so that the filter cancels. The model is linear in its numbers. Samples at which
the axis hardly moves say nothing of the sign of its speed and are left out.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.signal import butter, filtfilt

from ..pytree.in_short import in_short
from ..pytree.ranges import require
from .verdict import Estimate, inverse_of_normal, widened

ORDER, LEAST = 4, 50  # of the filter; samples at which the axis moves
SLOW = 0.02  # of the largest speed, below which the sign of a speed is not taken
RINGS = 1.5  # periods of the cutoff, during which the filter answers a jump
WIDE = 1.96
ABOVE = 30.0  # times the highest frequency of the motion: the cutoff of the filter


class FrictionModel(NamedTuple):
    """Mass and friction with their 95 % intervals.

    mass: [unit of force per unit of acceleration]
    viscous: [unit of force per unit of speed]
    coulomb, offset: [unit of force]
    fit: 100 (1 - |residual| / |force - mean force|) [%]
    """

    mass: Estimate
    viscous: Estimate
    coulomb: Estimate
    offset: Estimate
    fit: float
    __repr__ = in_short


def friction_of(force, position, dt: float, *, cutoff: float | None = None) -> FrictionModel:
    """Mass, viscous and Coulomb friction and offset of an axis that moves both ways.

    force: (N,) force or torque that acts on the axis;  position: (N,) of the same samples
    dt: sample time [s]
    cutoff: of the filter [Hz]: above the motion, below the noise of the encoder and resonances;
        None: 30 times the frequency below which 99 % of the power of the position lie
    Raises ValueError for signals of different lengths or that are not finite, a cutoff outside its
    range, and a motion that goes one way only or rests.
    """
    force, position = (np.asarray(x, float).ravel() for x in (force, position))
    require("friction_of", "dt", dt, "(0, inf)")
    if cutoff is not None:
        require("friction_of", "cutoff", cutoff, f"(0, {0.4 / dt:g}]")
    if len(force) != len(position) or not np.all(np.isfinite([force, position])):
        raise ValueError(
            f"friction_of: force has {len(force)} samples and position {len(position)}; allowed "
            "are as many, all finite"
        )
    if len(force) < LEAST:
        raise ValueError(f"friction_of: {len(force)} samples; allowed are at least {LEAST}")
    if cutoff is None:
        power = np.cumsum(np.abs(np.fft.rfft(position - np.mean(position))) ** 2)
        highest = np.fft.rfftfreq(len(position), dt)[np.searchsorted(power, 0.99 * power[-1])]
        cutoff = float(min(ABOVE * max(highest, 1 / (dt * len(position))), 0.1 / dt))
    b, a = butter(ORDER, 2 * dt * cutoff)
    smooth = filtfilt(b, a, position)
    speed = np.gradient(smooth, dt)
    columns = np.stack([np.gradient(speed, dt), speed, np.sign(speed), np.ones(len(speed))], axis=1)
    moving = np.abs(speed) > SLOW * np.max(np.abs(speed))
    if min(np.sum(moving & (speed > 0)), np.sum(moving & (speed < 0))) < LEAST:
        raise ValueError(
            "friction_of: the axis does not move both ways; record a motion forth and back"
        )
    columns[:, 2] = filtfilt(b, a, np.where(moving, columns[:, 2], 0.0))
    held = (force + np.r_[force[:1], force[:-1]]) / 2  # of the hold before and after a sample
    wanted = filtfilt(b, a, held)
    # One sample in so many: what passes the filter has no more independent values.
    every = max(1, int(0.25 / (cutoff * dt)))
    still, rings = ~moving, round(RINGS / (cutoff * dt))
    still[[0, -1]] = True  # the filter begins and ends there
    away = ~_near(still, rings)
    which = np.flatnonzero(away)[::every]
    if len(which) < LEAST:
        raise ValueError(
            f"friction_of: {len(which)} samples in motion and apart from its reversals, a filter's "
            f"length each; allowed are at least {LEAST}; record longer or raise the cutoff"
        )
    J, y = columns[which], wanted[which]
    found, *_ = np.linalg.lstsq(J, y, rcond=None)
    residual = y - J @ found
    covariance = inverse_of_normal(J) * float(residual @ residual) / max(len(y) - 4, 1)
    covariance = widened(covariance, J[:, None], residual[:, None])
    half = WIDE * np.sqrt(np.diag(covariance))
    fit = 100 * (1 - np.linalg.norm(residual) / np.linalg.norm(y - y.mean()))
    of = [Estimate(float(v), float(v - h), float(v + h)) for v, h in zip(found, half, strict=True)]
    return FrictionModel(*of, float(fit))


def _near(which: np.ndarray, samples: int) -> np.ndarray:
    """The samples within so many of one that is chosen."""
    return np.convolve(which, np.ones(2 * samples + 1), "same") > 0.5
