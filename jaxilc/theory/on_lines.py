"""A law on the lines of a frequency response: its curve, and how far cutoff, gain and lead may go.

A law with a zero-phase low-pass Q in front of a learning law K u + L e learns on a plant P where

    |Q (K - g z^d L P)| + |Q g L| s <= allowed < 1

at each frequency. g scales the gain and d shifts the lead of the law as it is; s is how far P is
from the response that is known, 0 for a model. The plants may be those of a model, which are drawn,
or measured responses. Everything here is arithmetic on lines: between them nothing is looked at.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

BLOCKED = 1e-6  # |Q| below which Q (1 - L P) says nothing of 1 - L P
TENTH = 0.1
LARGEST_SHARE = 0.98  # of the Nyquist frequency, beyond which no cutoff is looked for
FINENESS = 1e-4  # relative, of the largest gain
SCAN = 0.8  # factor from gain to gain, in the search for one that is allowed
SCANNED = 60
MOST_EXPONENT = 100.0  # of a quantile, beyond which a line tells nothing


class MeasuredResponse(NamedTuple):
    """The response of one output to one input, measured at some frequencies.

    frequencies: (F,) ascending, above 0 [Hz]
    response:    (F,) complex P(j w) [unit of the output per unit of the input]
    std:         (F,) sqrt(E |measured - true|^2) of each line [the same unit]; 0 where not known
    coherence:   (F,) squared coherence from which std follows; None where there is none
    averages_known: whether the number of averages of the coherence is known; if not, std is that of
        one average, and only its course over the lines is known
    averages: number n >= 2 of averages from whose scatter std is estimated; inf: std is exact
    """

    frequencies: np.ndarray
    response: np.ndarray
    std: np.ndarray
    coherence: np.ndarray | None = None
    averages_known: bool = True
    averages: float = np.inf

    @property
    def std_known(self) -> bool:
        """Whether std is that of the lines, and not only their course over them."""
        return bool(np.any(self.std)) and self.averages_known

    def scatter(self, sigmas: float) -> np.ndarray:
        """(F,) distance from the true response that a line exceeds with probability exp(-sigmas^2).

        It is sigmas std where std is exact. Where n averages tell it, |measured - true|^2 / std^2
        has the F distribution with 2 and 2 n - 2 degrees of freedom (Pintelon, Schoukens 2012).
        """
        of = self.averages - 1
        exponent = min(sigmas**2 / of, MOST_EXPONENT)
        return self.std * (np.sqrt(of * np.expm1(exponent)) if np.isfinite(of) else sigmas)


class Lines(NamedTuple):
    """Responses of S plants and of a learning law without its filter, at F frequencies.

    f:       (F,) [Hz]
    P:       (S, F) complex, from what is learned to y
    scatter: (S, F) largest |P - true P| that is allowed for [unit of P]
    keep, L: (F,) complex K and L, the lead included
    dt:      sample time [s]
    """

    f: np.ndarray
    P: np.ndarray
    scatter: np.ndarray
    keep: np.ndarray
    L: np.ndarray
    dt: float


class Change(NamedTuple):
    """A change of the law: gain times `gain`, lead plus `lead`, and a low-pass of its own.

    gain:   factor
    lead:   samples
    cutoff: [Hz] of the zero-phase Butterworth filter Q; inf for Q = 1
    order:  of one pass
    """

    gain: float
    lead: int
    cutoff: float
    order: int


class Curves(NamedTuple):
    """What a figure shows of a law on the nominal plant and on a family, at F frequencies [Hz].

    P, Q, LP: (F,) complex, of the nominal plant
    nominal:  (F,) |Q (1 - L P)|
    low, high: (F,) least and largest of the family, the scatter of a record included
    without:  (F,) largest |1 - L P| of the family, without the filter
    """

    f: np.ndarray
    P: np.ndarray
    Q: np.ndarray
    LP: np.ndarray
    nominal: np.ndarray
    low: np.ndarray
    high: np.ndarray
    without: np.ndarray

    @property
    def first_above(self) -> float:
        """The first frequency at which |1 - L P| exceeds 1 without Q [Hz]; inf if it never does."""
        above = np.flatnonzero(self.without > 1)
        return float(self.f[above[0]]) if len(above) else np.inf

    @property
    def left(self) -> np.ndarray:
        """(F,) |1 - Q| / |1 - Q (1 - L P)|: the share of a repeated error that is never learned."""
        with np.errstate(divide="ignore", invalid="ignore"):
            share = np.abs(1 - self.Q) / np.abs(1 - self.Q + self.Q * self.LP)
        return np.where(np.isnan(share), 1.0, share)  # where nothing is learned, all of it

    @property
    def learned_up_to(self) -> float:
        """The frequency up to which a repeated error falls to a tenth or less [Hz]."""
        worse = np.flatnonzero(self.left > TENTH)
        if not len(worse):
            return float(self.f[-1])
        return float(self.f[worse[0] - 1]) if worse[0] else 0.0


def curves_of(whole: Lines) -> Curves:
    """The curves of a law, its filter included: Q is what it keeps, and L P the rest by Q."""
    Q = whole.keep
    seen = np.abs(Q) > BLOCKED
    L = whole.L / np.where(seen, Q, 1.0)
    sizes = np.abs(whole.keep - whole.L * whole.P)
    spread = np.abs(whole.L) * whole.scatter
    without = np.max(np.abs(1 - L * whole.P) + np.abs(L) * whole.scatter, axis=0)
    return Curves(
        whole.f,
        whole.P[0],
        Q,
        L * whole.P[0],
        sizes[0],
        np.min(np.maximum(sizes - spread, 0), axis=0),
        np.max(sizes + spread, axis=0),
        np.where(seen, without, np.nan),
    )


def low_pass(f, cutoff, dt: float, order: int) -> np.ndarray:
    """Q as `ZeroPhaseButterworth` has it; 1 for an infinite cutoff."""
    if np.ndim(cutoff) == 0 and np.isinf(cutoff):
        return np.ones(np.shape(f))
    with np.errstate(over="ignore", divide="ignore"):
        ratio = np.tan(np.pi * np.minimum(np.asarray(f) * dt, 0.5)) / np.tan(np.pi * cutoff * dt)
        return 1 / (1 + np.abs(ratio) ** (2 * order))


def rounded(value: float, digits: int = 3) -> float:
    """The value rounded towards 0 to so many significant digits."""
    if not value or not np.isfinite(value):
        return value
    unit = 10.0 ** (np.floor(np.log10(abs(value))) - digits + 1)
    return float(f"{np.trunc(value / unit * (1 + 1e-12)) * unit:.{digits}g}")


def unfiltered(lines: Lines, gain: float = 1.0, lead: int = 0) -> np.ndarray:
    """(F,) the largest |K - g z^d L P| + |g L| s of the plants, without the filter."""
    L = gain * np.exp(2j * np.pi * lines.f * lines.dt * lead) * lines.L
    return np.max(np.abs(lines.keep - L * lines.P) + np.abs(L) * lines.scatter, axis=0)


def peak(several: Sequence[Lines], change: Change) -> float:
    """The largest |Q (K - L P)| + |Q L| s of all lines and plants under a changed law."""

    def of_one(lines: Lines) -> float:
        Q = low_pass(lines.f, change.cutoff, lines.dt, change.order)
        return float(np.max(Q * unfiltered(lines, change.gain, change.lead)))

    return max(map(of_one, several))


def largest_cutoff(
    several: Sequence[Lines], change: Change, allowed: float, lowest: float
) -> float | None:
    """The largest cutoff with which the peak is at most `allowed`, in closed form.

        Q kept <= allowed    <=>    tan(pi fc dt) <= tan(pi f dt) (kept / allowed - 1)^(-1 / 2n)

    lowest: [Hz] cutoff below which no law is worth having; the result is then None
    """
    dt, found = several[0].dt, LARGEST_SHARE * 0.5 / several[0].dt
    for lines in several:
        over = unfiltered(lines, change.gain, change.lead) / allowed - 1
        at = over > 0
        ends = np.tan(np.pi * np.minimum(lines.f[at] * dt, 0.5)) * over[at] ** (-0.5 / change.order)
        found = min(found, np.arctan(np.min(ends, initial=np.inf)) / (np.pi * dt))
    return float(found) if found >= lowest else None


def largest_gain(several: Sequence[Lines], change: Change, allowed: float) -> float | None:
    """The largest factor of the gain with which the peak is at most `allowed`.

    The peak is convex in the factor, so the factors that are allowed are one interval. Where the
    factor of `change` is not in it, smaller ones are tried first. None where none is allowed.
    """
    factors = change.gain * SCAN ** np.arange(SCANNED)
    low = next((g for g in factors if peak(several, change._replace(gain=g)) <= allowed), None)
    if low is None:
        return None
    high = low / SCAN
    while peak(several, change._replace(gain=high)) <= allowed:
        low, high = high, 2 * high
        if high > 1e9 * change.gain:
            return None
    while high - low > FINENESS * low:
        middle = (low + high) / 2
        inside = peak(several, change._replace(gain=middle)) <= allowed
        low, high = (middle, high) if inside else (low, middle)
    return float(low)


def best_lead(
    several: Sequence[Lines], change: Change, allowed: float, leads, lowest: float
) -> tuple[int, float] | None:
    """The lead with which the cutoff can be largest, and that cutoff; None where none is allowed.

    leads: changes of the lead to try [samples]
    """
    found = [
        (cutoff, -abs(int(lead)), int(lead))
        for lead in leads
        if (cutoff := largest_cutoff(several, change._replace(lead=int(lead)), allowed, lowest))
    ]
    return (max(found)[2], max(found)[0]) if found else None


def widest(
    several: Sequence[Lines], order: int, gains, leads, allowed: float, lowest: float
) -> Change | None:
    """Of all gains and leads the law that learns slow errors fastest and hardly filters more.

    Its cutoff is at least 0.7 of the largest one that any of them allows. None where none is
    allowed.
    """
    found = []
    for lead, gain in itertools.product(leads, gains):
        change = Change(float(gain), int(lead), np.inf, order)
        cutoff = largest_cutoff(several, change, allowed, lowest)
        if cutoff is None:
            continue
        kept = [unfiltered(one, change.gain, change.lead)[one.f <= cutoff / 5] for one in several]
        slow = max(float(np.max(one, initial=0.0)) for one in kept)
        found.append((cutoff, slow, change._replace(cutoff=cutoff)))
    if not found:
        return None
    most = max(cutoff for cutoff, _, _ in found)
    return min((one for one in found if one[0] >= 0.7 * most), key=lambda one: one[1])[2]
