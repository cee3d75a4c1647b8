"""Responses that are enclosed on arcs of frequency, and the largest value of one, from above.

No frequency is missed between the lines of a grid. On an arc of angles |theta - centre| <= h, where
theta = 2 pi f dt, a response is enclosed by a line and by how far it can depart from that line,

    |X(theta) - X0 - (theta - centre) X1| <= c (theta - centre)^2

with c from the resolvent of a loop or from the taps of a law. |X0 + t X1| is convex in t, so it is
largest at an end of the arc. Arcs whose bound lies above the largest value found so far are split,
until no bound exceeds that value by more than a tolerance (branch and bound).

`Arc` is that enclosure. `Disc` knows a number by a centre and a radius alone, whatever it depends
on: each operation gives a disc that contains every result for operands within their discs; rounding
is not counted, and what may divide by 0 has an infinite radius.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy

from .law import Taps
from .loop import Loop, radius_of, stable

TOLERANCE = 1e-6  # relative width within which a supremum is enclosed
ARCS = 256  # at the start
MOST = 400_000  # arcs that are looked at before the enclosure is left as wide as it is
CHUNK = 4096  # arcs at a time


class Arc(NamedTuple):
    """Responses on F arcs: (F, n, m) value X0 and slope X1 at the centre, and (F,) curve c."""

    value: np.ndarray
    slope: np.ndarray
    curve: np.ndarray

    def minus(self, other: Arc) -> Arc:
        return Arc(self.value - other.value, self.slope - other.slope, self.curve + other.curve)

    def plus(self, other: Arc) -> Arc:
        return Arc(self.value + other.value, self.slope + other.slope, self.curve + other.curve)

    def times(self, other: Arc, h) -> Arc:
        """The product of two responses on arcs of half width h (F,)."""
        a, b = (np.stack([size(part.value), size(part.slope)]) for part in (self, other))
        with np.errstate(invalid="ignore"):  # of an infinite curve times 0
            curve = a[0] * other.curve + self.curve * b[0] + a[1] * b[1]
            curve = curve + h * (a[1] * other.curve + self.curve * b[1])
            curve = curve + h**2 * self.curve * other.curve
        slope = self.slope @ other.value + self.value @ other.slope
        return Arc(self.value @ other.value, slope, curve)

    @property
    def adjoint(self) -> Arc:
        """The conjugate transposed response."""
        return Arc(*(np.conj(np.swapaxes(x, -1, -2)) for x in self[:2]), self.curve)

    def inverse(self, h) -> Arc:
        """The inverse of a square response on arcs of half width h (F,).

        It is unbounded where the response may be singular, and NaN where it is at the centre.
        """
        none = (np.linalg.slogdet(self.value)[0] == 0)[:, None, None]
        inverse = np.linalg.inv(np.where(none, np.eye(self.value.shape[-1]), self.value))
        inverse = np.where(none, np.nan, inverse)
        away = size(inverse) * (h * size(self.slope) + h**2 * self.curve)
        reach = size(inverse) / np.where(away < 1, 1 - away, np.nan)
        steep = size(self.slope) + 2 * h * self.curve
        curve = reach**3 * steep**2 + reach**2 * self.curve
        return Arc(inverse, -inverse @ self.slope @ inverse, np.where(away >= 1, np.inf, curve))

    def scaled(self, factor) -> Arc:
        """The response times a number (F,) on each arc."""
        by = factor[:, None, None]
        return Arc(self.value * by, self.slope * by, self.curve * factor)

    def bounds(self, h) -> tuple[np.ndarray, np.ndarray]:
        """(F,) sizes at the centres and (F,) upper bounds on the arcs, as `supremum` asks for."""
        return size(self.value), np.max(self.ends(h), axis=0) + h**2 * self.curve

    def disc(self, h) -> Disc:
        """What a response of one channel can be on each arc."""
        return Disc(self.value[:, 0, 0], h * size(self.slope) + h**2 * self.curve)

    def ends(self, h) -> np.ndarray:
        """(2, F) largest singular value of the line at both ends of the arc."""
        step = h[:, None, None] * self.slope
        return np.stack([size(self.value - step), size(self.value + step)])


class Disc(NamedTuple):
    """All complex numbers within `radius` (...,) of `centre` (...,)."""

    centre: np.ndarray
    radius: np.ndarray

    def plus(self, other: Disc) -> Disc:
        return Disc(self.centre + other.centre, self.radius + other.radius)

    def minus(self, other: Disc) -> Disc:
        return Disc(self.centre - other.centre, self.radius + other.radius)

    def times(self, other: Disc) -> Disc:
        a, b = np.abs(self.centre), np.abs(other.centre)
        with np.errstate(invalid="ignore"):
            radius = a * other.radius + b * self.radius + self.radius * other.radius
        return Disc(self.centre * other.centre, np.where(np.isnan(radius), np.inf, radius))

    def inverse(self) -> Disc:
        """1 / x; the image of a disc without 0 is a disc, here about the inverse of its centre."""
        a = np.abs(self.centre)
        away = a > self.radius
        safe = np.where(away, self.centre, 1.0)
        gap = np.where(away, a * (a - self.radius), 1.0)
        return Disc(1 / safe, np.where(away, self.radius / gap, np.inf))

    def exponential(self) -> Disc:
        """exp(x); |exp(c + d) - exp(c)| <= |exp(c)| (exp(|d|) - 1)"""
        centre = np.exp(self.centre)
        with np.errstate(over="ignore"):
            return Disc(centre, np.abs(centre) * np.expm1(self.radius))

    @property
    def largest(self) -> np.ndarray:
        """(...,) the largest magnitude in the disc."""
        return np.abs(self.centre) + self.radius


def exactly(value) -> Disc:
    """Numbers that are known."""
    value = np.asarray(value, complex)
    return Disc(value, np.zeros(value.shape))


class Supremum(NamedTuple):
    """The largest value found, a bound that no value exceeds, and the angle where it was found."""

    value: float
    bound: float
    angle: float


def supremum(bounds: Callable) -> Supremum:
    """The largest value of a function of the angle on [0, pi].

    bounds: from the centres (F,) and half widths (F,) of arcs to the values (F,) at the centres and
            the upper bounds (F,) over the arcs
    """
    edges = np.linspace(0.0, np.pi, ARCS + 1)
    centre, h = (edges[1:] + edges[:-1]) / 2, np.diff(edges) / 2
    parts = np.array([-3.0, -1.0, 1.0, 3.0])  # where a quarter of an arc lies in it
    best, where, done, looked = -np.inf, 0.0, -np.inf, 0
    while len(centre):
        chunks = [slice(i, i + CHUNK) for i in range(0, len(centre), CHUNK)]
        found = zip(*(bounds(centre[some], h[some]) for some in chunks), strict=True)
        value, upper = (np.nan_to_num(np.concatenate(x), nan=np.inf, posinf=np.inf) for x in found)
        looked += len(centre)
        top = np.argmax(value)
        if value[top] > best:
            best, where = float(value[top]), float(centre[top])
        left = upper > best * (1 + TOLERANCE)
        done = max(done, np.max(upper[~left], initial=-np.inf))
        if not np.isfinite(best) or looked > MOST:
            return Supremum(best, max(done, float(np.max(upper[left], initial=best))), where)
        h = h[left] / 4
        centre, h = (centre[left][:, None] + parts * h[:, None]).ravel(), np.repeat(h, 4)
    return Supremum(best, max(best, min(done, best * (1 + TOLERANCE))), where)


def arc_of_taps(of: Taps, centre) -> Arc:
    """The response of a law, or of a filter, on arcs."""
    turned = np.exp(1j * np.multiply.outer(centre, of.powers))
    slope = np.tensordot(1j * turned * of.powers, of.taps, axes=1)
    curve = np.sum(of.powers**2 * size(of.taps)) / 2 if len(of.powers) else 0.0
    return Arc(np.tensordot(turned, of.taps, axes=1), slope, np.full(len(centre), curve))


def arc_of_loop(loop: Loop, centre, h) -> Arc:
    """The response of a stable loop on arcs, P = C R B with the resolvent R = (z I - A)^-1.

        d/dtheta P = -i z C R R B,      |d^2/dtheta^2 P| <= |C R| |R B| (1 + 2 |R|)

    |R| is bounded over each arc. The bound is sharp for a loop that is `balanced`.
    """
    z, unit = np.exp(1j * np.asarray(centre))[:, None, None], np.eye(len(loop.A))
    R = np.linalg.inv(z * unit - loop.A) if len(unit) else np.zeros((len(z), 0, 0))
    B, C = np.asarray(loop.B), np.asarray(loop.C)
    CR, RB = C @ R, R @ B
    away = h * size(R)
    grown = 1 / np.where(away < 1, 1 - away, np.nan)
    curve = 0.5 * grown**2 * size(CR) * size(RB) * (1 + 2 * grown * size(R))
    return Arc(CR @ B, -1j * z * (CR @ RB), np.where(away < 1, curve, np.inf))


def size(X) -> np.ndarray:
    """(...,) largest singular value of (..., n, m); NaN of what is not finite."""
    X = np.asarray(X)
    if 0 in X.shape[-2:]:
        return np.zeros(X.shape[:-2])
    if X.shape[-2:] == (1, 1):
        return np.abs(X[..., 0, 0])
    if 1 in X.shape[-2:]:
        return np.sqrt(np.sum(np.abs(X) ** 2, axis=(-2, -1)))
    finite = np.all(np.isfinite(X), axis=(-2, -1))
    X = np.where(finite[..., None, None], X, 0.0)
    return np.where(finite, np.linalg.norm(X, 2, axis=(-2, -1)), np.nan)


def balanced(loop: Loop) -> Loop:
    """A stable loop in coordinates in which each state is as easily reached as it is seen.

    The resolvent is then as small as it can be. States whose weight is lost in rounding are left
    out: what they add to P is less than 1e-13 of its largest value. An unstable loop stays as it
    is.
    """
    if not len(loop.A) or not stable(radius_of(loop)):
        return loop
    A, B, C = (np.asarray(M, float) for M in loop)
    grams = (A, B @ B.T), (A.T, C.T @ C)  # of what is reached, and of what is seen
    roots = [_root(scipy.linalg.solve_discrete_lyapunov(*of)) for of in grams]
    U, s, Vt = np.linalg.svd(roots[1].T @ roots[0])
    kept = s > 1e-13 / max(len(s), 1) * s[0] if s[0] > 0 else np.zeros(len(s), bool)
    scale = 1 / np.sqrt(s[kept])
    into, outof = (roots[1] @ U[:, kept] * scale).T, roots[0] @ Vt[kept].T * scale
    return Loop(into @ A @ outof, into @ B, C @ outof)


def _root(W):
    """R with R R' = W, of a positive semidefinite matrix W."""
    values, vectors = np.linalg.eigh((W + W.T) / 2)
    return vectors * np.sqrt(np.maximum(values, 0.0))
