"""What learning can gain: the repeatable part of a motion, and what is new in each trial.

A motion is repeated M times with the same input, and leaves the errors

    e_j = m + d_j,      j = 0 ... M - 1,      d_j new in each trial, with the spectrum S

No law that is causal in the trials knows d_j before trial j, so none leaves less than the rms of d.
The mean of M trials has the power R + S / M, where R is that of the repeatable part m; both
estimates here are unbiased. What is not m and not new either is told apart first:

    start   the first trial often begins elsewhere than the others do, which begin where the last
            one ended; its difference to their mean is tested against their scatter
    drift   a straight line along the trials at each sample, such as of a machine that warms up; it
            is no part of what is new, since a law follows it
    settling  the first of the others differs from those after it by more than they scatter, though
            not by enough to be set apart; it counts as new, which is then overstated

Tests and intervals are those of F and chi-square with equivalent degrees of freedom (Welch and
Satterthwaite): nu = 2 T (sum S df)^2 / sum S^2 df of a trial of length T, fewer where the new part
is strong during a part of the trial only. The interval of the rms of m has the variance of the mean
of 2 m d + d^2 over trial and trials, with S at the frequencies and times of m. Spectra are means
over sine tapers (Riedel and Sidorenko 1995) and over bands.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.stats import chi2
from scipy.stats import f as ratio_of_variances

from ..pytree.in_short import in_short
from ..pytree.ranges import require
from .verdict import WIDE, Estimate

LEVEL = 0.95  # of all intervals
TAILS = (1 + LEVEL) / 2, (1 - LEVEL) / 2
TAPERS = 3
WIDER = 0.12  # width of a band against its frequency
SEGMENTS = 16  # of a trial, over which the new part may change its strength
SHORTEST = 30  # samples
UNLIKE, TIMES = 1e-3, 10.0  # a first trial set apart: chance at most, and ratio of variances
SETTLES = 1e-6  # chance at most, with which it is said that trials settle
DRIFTS = 0.01  # chance at most, with which a drift is said
CLOSE = 1.05  # of the least error: near enough, where trials are averaged


class Spectrum(NamedTuple):
    """Power densities in bands [unit^2/Hz], one-sided.

    frequencies, widths: (B,) centres and widths [Hz]
    new: (B,) of what is new in each trial
    repeatable: (B,) of the repeatable part; it may be negative where there is none
    ratio: (2, B) ends of the 95 % interval of repeatable / new
    freedom: (B,) degrees of freedom of one trial
    even: degrees of freedom of the power of one trial, where what is new is as strong throughout
    """

    frequencies: np.ndarray
    widths: np.ndarray
    new: np.ndarray
    repeatable: np.ndarray
    ratio: np.ndarray
    freedom: np.ndarray
    even: float
    __repr__ = in_short


class Potential(NamedTuple):
    """What M repeats of a motion tell about learning; errors are rms values [unit].

    trials, alike: numbers of trials, and of those that are not set apart
    repeatable: rms of the part that repeats
    new: rms of what is new in each trial, the least error that any law can leave
    start: rms by which the first trial differs from the others; 0 where it is like them
    drift: rms of the change from trial to trial; 0 where none is seen
    settling: rms by which the first alike trial differs from those after it; 0 where it is like
        them, or a drift is seen
    freedom: equivalent degrees of freedom of one trial
    cutoff: up to which learning pays [Hz], 0 where it does nowhere
    left: rms error that a law with this cutoff leaves: what is new, what repeats above it, and the
        drift of a trial
    averages: number of trials whose mean is learned from, so that no more than 5 % is added
    stop: rms error of a trial below which nothing shows that there is more to learn
    """

    trials: int
    alike: int
    repeatable: Estimate
    new: Estimate
    start: float
    drift: float
    settling: float
    freedom: float
    cutoff: Estimate
    left: float
    averages: int
    stop: float
    spectrum: Spectrum
    __repr__ = in_short

    def spread(self, trials: int) -> float:
        """The rms about the mean of so many trials, a first one that is unlike them included."""
        M = float(trials)
        of_start, of_drift = self.start**2 * (M - 1) / M**2, self.drift**2 * (M**2 - 1) / 12
        return float(np.sqrt(self.new.value**2 * (M - 1) / M + of_start + of_drift))


def potential_of(e, dt: float) -> Potential:
    """What repeats of a motion tell about learning.

    e: (M, N) errors of M >= 2 trials with the same input
    dt: sample time [s]
    Raises ValueError for other shapes, values that are not finite, two trials that are equal, and a
    sample time outside its range.
    """
    require("potential", "dt", dt, "(0, inf)")
    e = _checked(e)
    apart = len(e) > 2 and _unlike(e, dt, UNLIKE) > TIMES
    alike = e[1:] if apart else e
    mean, along, new = _parted(alike, dt)
    settling = 0.0
    if len(alike) > 2 and along is None and _unlike(alike, dt, SETTLES):
        settling = float(np.sqrt(np.mean((alike[0] - alike[1:].mean(axis=0)) ** 2)))
    free = len(alike) - 1 - (along is not None)  # contrasts that hold what is new alone
    n, N = alike.shape
    spectrum, power, nu = _told(mean, new, free, n, dt)
    low, high = (chi2.ppf(p, nu * free) / (nu * free) for p in TAILS)
    sigma = Estimate(np.sqrt(power), np.sqrt(power / low), np.sqrt(power / high))
    repeats = max(float(np.mean(mean**2)) - power / n, 0.0)
    met = _met(spectrum, mean, new, N * dt)
    unsure = WIDE * np.sqrt(4 * repeats * met / n + 2 * (power / n) ** 2 * (1 + 1 / free) / nu)
    slope = 0.0
    if along is not None:
        slope = max(float(np.mean(along**2)) - power / (_steps(n) @ _steps(n)), 0.0)
    start = float(np.mean((e[0] - mean) ** 2)) - power * (1 + 1 / n) if apart else 0.0
    repeatable = (spectrum.repeatable, *(spectrum.ratio * spectrum.new))
    cutoff = Estimate(*(_cutoff(spectrum, of) for of in repeatable))
    above = spectrum.frequencies > cutoff.value
    of = np.clip(spectrum.repeatable, 0.0, None) * spectrum.widths
    rest = repeats * float(of[above].sum() / of.sum()) if of.any() else repeats
    share = spectrum.new * spectrum.widths
    within = power * float(share[~above].sum() / share.sum())
    least = power + rest + slope
    averages = _averages(least, within, slope)
    unlucky = float(ratio_of_variances.ppf(LEVEL, nu, nu * free)) - 1
    return Potential(
        len(e), n,
        Estimate(*(float(np.sqrt(max(repeats + d, 0.0))) for d in (0.0, -unsure, unsure))),
        Estimate(*map(float, sigma)), float(np.sqrt(max(start, 0.0))), float(np.sqrt(slope)),
        settling, nu, cutoff, float(np.sqrt(least)), averages,
        float(np.sqrt(least + within / averages + power * unlucky)), spectrum,
    )  # fmt: skip


# How it is done
# --------------------------------------------------------------------------------------------------


def _checked(e) -> np.ndarray:
    e = np.asarray(e, float)
    if e.ndim != 2 or len(e) < 2 or e.shape[1] < SHORTEST:
        raise ValueError(
            f"potential: the errors have the shape {e.shape}; needed are (M, N), M >= 2 trials of "
            f"N >= {SHORTEST} samples. Measure the motion again without learning in between"
        )
    if not np.all(np.isfinite(e)):
        j, k = np.argwhere(~np.isfinite(e))[0]
        raise ValueError(f"potential: sample {k} of trial {j + 1} is not a finite number")
    for i, j in zip(*np.tril_indices(len(e), -1), strict=True):
        if np.array_equal(e[i], e[j]):
            raise ValueError(
                f"potential: trials {j + 1} and {i + 1} are equal in every sample: they are "
                "copies of one trial, or the error is below the resolution"
            )
    return e


def _unlike(e: np.ndarray, dt: float, chance: float) -> float:
    """By how much the first trial differs from the mean of the others, against their scatter.

    A ratio of variances, and 0 where it comes by chance more often than `chance`.
    """
    mean, rest = e[1:].mean(axis=0), e[1:] - e[1:].mean(axis=0)
    n, free = len(rest), len(rest) - 1
    _, power, nu = _told(mean, rest, free, n, dt)
    ratio = np.mean((e[0] - mean) ** 2) / (1 + 1 / n) / power
    return float(ratio) if ratio_of_variances.sf(ratio, nu, nu * free) < chance else 0.0


def _parted(e: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray | None, np.ndarray]:
    """(N,) mean of alike trials, (N,) drift from one to the next or None, (M, N) what is new."""
    mean, new = e.mean(axis=0), e - e.mean(axis=0)
    if len(e) < 3:
        return mean, None, new
    steps, free = _steps(len(e)), len(e) - 2
    along = steps @ e / (steps @ steps)
    rest = new - np.outer(steps, along)
    _, power, nu = _told(mean, rest, free, len(e), dt)
    ratio = np.mean(along**2) * (steps @ steps) / power
    if ratio_of_variances.sf(ratio, nu, nu * free) < DRIFTS:
        return mean, along, rest
    return mean, None, new


def _told(
    mean: np.ndarray, new: np.ndarray, free: int, trials: int, dt: float
) -> tuple[Spectrum, float, float]:
    """What is new tells its spectra, its power, and the degrees of freedom of that in one trial."""
    spectrum = _spectrum(mean, new, free, trials, dt)
    power = float(np.sum(new**2)) / (free * new.shape[1])
    return spectrum, power, _freedom(spectrum, new, free)


def _steps(trials: int) -> np.ndarray:
    return np.arange(trials) - (trials - 1) / 2


def _spectrum(mean: np.ndarray, new: np.ndarray, free: int, trials: int, dt: float) -> Spectrum:
    """The spectra of a mean of trials and of what is new, in bands.

    new: (M, N) what is new, in which `free` contrasts of the trials are left
    """
    N = new.shape[1]
    t = np.pi * np.arange(1, N + 1) / (N + 1)
    tapers = np.sqrt(2 / (N + 1)) * np.sin(np.arange(1, TAPERS + 1)[:, None] * t)
    lines = np.fft.rfftfreq(N, dt)
    of_new = sum(np.sum(np.abs(np.fft.rfft(new * one)) ** 2, axis=0) for one in tapers) / free
    of_mean = sum(np.abs(np.fft.rfft(mean * one)) ** 2 for one in tapers)
    edges, least, end = [0.0], (TAPERS + 1) / (N * dt), 0.5 / dt
    while edges[-1] < end:
        edges.append(edges[-1] + max(least, WIDER * edges[-1]))
    edges[-2:] = [end]  # the last band is the wider one of two
    edges = np.array(edges)
    band = np.clip(np.searchsorted(edges, lines, "right") - 1, 0, len(edges) - 2)
    count = np.bincount(band)
    scale = 2 * dt / TAPERS
    S, P = (scale * np.bincount(band, of) / count for of in (of_new, of_mean))
    widths = np.diff(edges)
    freedom = 2 * widths * N * dt
    of_chance = [ratio_of_variances.ppf(p, freedom, freedom * free) for p in TAILS]
    ratio = np.stack([(trials * P / S / one - 1) / trials for one in of_chance])
    squares = np.sum(of_new**2) / (1 + 1 / (TAPERS * free))
    even = float(2 * np.sum(of_new) ** 2 / squares)
    return Spectrum(edges[:-1] + widths / 2, widths, S, P - S / trials, ratio, freedom, even)


def _freedom(spectrum: Spectrum, new: np.ndarray, free: int) -> float:
    """The equivalent degrees of freedom of the mean square of what is new in one trial."""
    parts = np.array([np.mean(part**2) for part in np.array_split(new, SEGMENTS, axis=1)])
    by_chance = 1 + 2 * SEGMENTS / (spectrum.even * free)
    uneven = np.mean(parts**2) / np.mean(parts) ** 2 / by_chance
    return float(np.clip(spectrum.even / max(uneven, 1.0), 1.0, new.shape[1]))


def _met(spectrum: Spectrum, mean: np.ndarray, new: np.ndarray, duration: float) -> float:
    """The variance of the mean of m d over a trial, of an m of rms 1, at the lines and times of m.

    duration: T of a trial [s], over which m at a frequency meets the power S / (2 T)
    """
    of = np.clip(spectrum.repeatable, 0.0, None) * spectrum.widths
    if not of.any():
        return 0.0
    parts = [np.array_split(np.mean(x**2, axis=0), SEGMENTS) for x in (mean[None], new)]
    sizes = np.array([[np.mean(part) for part in one] for one in parts])
    uneven = np.mean(sizes[0] * sizes[1]) / np.prod(np.mean(sizes, axis=1))
    return float(of @ spectrum.new / of.sum() / (2 * duration) * uneven)


def _cutoff(spectrum: Spectrum, repeatable: np.ndarray) -> float:
    """The cutoff of least error, where learning replaces what repeats by what was new before.

    Below it a law that forgets all but the last trial leaves 2 S, above it R + S: the sum of R - S
    up to the cutoff is the gain.
    """
    gain = np.cumsum((repeatable - spectrum.new) * spectrum.widths)
    best = int(np.argmax(gain))
    found = spectrum.frequencies[best] + spectrum.widths[best] / 2
    return float(found) if gain[best] > 0 else 0.0


def _averages(least: float, within: float, slope: float) -> int:
    """The number of trials to average: few where they drift, else until little noise is learned.

    least: power that is left;  within: of it what is new below the cutoff
    slope: power of the drift from one trial to the next
    """
    needed = int(np.ceil(within / ((CLOSE**2 - 1) * least))) if least > 0 else 1
    if slope == 0:
        return max(needed, 1)
    n = np.arange(1, max(needed, 1) + 1)
    return int(n[np.argmin(within / n + slope * (n + 1) ** 2 / 4)])
