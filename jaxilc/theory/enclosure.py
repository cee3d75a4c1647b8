"""The largest value of a frequency response, enclosed from above.

No frequency is missed between the lines of a grid. On an arc of angles |theta - centre| <= h, where
theta = 2 pi f dt, a response is enclosed by a line and by how far it can depart from that line,

    |X(theta) - X0 - (theta - centre) X1| <= c (theta - centre)^2

with c from the resolvent of a loop or from the taps of a law. |X0 + t X1| is convex in t, so it is
largest at an end of the arc. Arcs whose bound lies above the largest value found so far are split,
until no bound exceeds that value by more than a tolerance (branch and bound).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy

from .law import Taps
from .loop import Loop

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
        curve = (
            a[0] * other.curve
            + self.curve * b[0]
            + a[1] * b[1]
            + h * (a[1] * other.curve + self.curve * b[1])
        )
        slope = self.slope @ other.value + self.value @ other.slope
        return Arc(self.value @ other.value, slope, curve + h**2 * self.curve * other.curve)

    @property
    def adjoint(self) -> Arc:
        """The conjugate transposed response."""
        return Arc(*(np.conj(np.swapaxes(x, -1, -2)) for x in self[:2]), self.curve)

    def inverse(self, h) -> Arc:
        """The inverse of a square response on arcs of half width h (F,).

        It is unbounded where the response may be singular.
        """
        inverse = np.linalg.inv(self.value)
        away = size(inverse) * (h * size(self.slope) + h**2 * self.curve)
        reach = size(inverse) / np.where(away < 1, 1 - away, np.nan)
        steep = size(self.slope) + 2 * h * self.curve
        curve = reach**3 * steep**2 + reach**2 * self.curve
        return Arc(inverse, -inverse @ self.slope @ inverse, np.where(away < 1, curve, np.inf))

    def ends(self, h) -> np.ndarray:
        """(2, F) largest singular value of the line at both ends of the arc."""
        step = h[:, None, None] * self.slope
        return np.stack([size(self.value - step), size(self.value + step)])


class Supremum(NamedTuple):
    """The largest value found, a bound that no value exceeds, and the angle where it was found."""

    value: float
    bound: float
    angle: float


def supremum(bounds: Callable, low: float, high: float, tolerance: float = TOLERANCE) -> Supremum:
    """The largest value of a function of the angle on [low, high], within [0, pi].

    bounds: from the centres (F,) and half widths (F,) of arcs to the values (F,) at the centres and
            the upper bounds (F,) over the arcs
    """
    edges = np.linspace(low, high, ARCS + 1)
    centre, h = (edges[1:] + edges[:-1]) / 2, np.diff(edges) / 2
    best, where, done, looked = -np.inf, low, -np.inf, 0
    while len(centre):
        found = [
            bounds(centre[i : i + CHUNK], h[i : i + CHUNK]) for i in range(0, len(centre), CHUNK)
        ]
        value, upper = (
            np.nan_to_num(np.concatenate(x), nan=np.inf, posinf=np.inf)
            for x in zip(*found, strict=True)
        )
        looked += len(centre)
        top = np.argmax(value)
        if value[top] > best:
            best, where = float(value[top]), float(centre[top])
        left = upper > best * (1 + tolerance)
        done = max(done, np.max(upper[~left], initial=-np.inf))
        if not np.isfinite(best) or looked > MOST:
            return Supremum(best, max(done, float(np.max(upper[left], initial=best))), where)
        h = np.repeat(h[left] / 4, 4)
        centre = (
            centre[left][:, None] + np.array([-3.0, -1.0, 1.0, 3.0]) * h[::4][: np.sum(left), None]
        ).ravel()
    return Supremum(best, max(best, min(done, best * (1 + tolerance))), where)


def arc_of_taps(of: Taps, centre, h) -> Arc:
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
    """(...,) largest singular value of (..., n, m)."""
    X = np.asarray(X)
    if 0 in X.shape[-2:]:
        return np.zeros(X.shape[:-2])
    if X.shape[-2:] == (1, 1):
        return np.abs(X[..., 0, 0])
    if 1 in X.shape[-2:]:
        return np.sqrt(np.sum(np.abs(X) ** 2, axis=(-2, -1)))
    return np.linalg.norm(X, 2, axis=(-2, -1))


def balanced(loop: Loop) -> Loop:
    """A stable loop in coordinates in which each state is as easily reached as it is seen.

    The resolvent is then as small as it can be. States whose weight is lost in rounding are left
    out: what they add to P is less than 1e-13 of its largest value.
    """
    A, B, C = (np.asarray(M, float) for M in loop)
    if not len(A):
        return loop
    reached, seen = (
        scipy.linalg.solve_discrete_lyapunov(A, B @ B.T),
        scipy.linalg.solve_discrete_lyapunov(A.T, C.T @ C),
    )
    roots = [_root(W) for W in (reached, seen)]
    U, s, Vt = np.linalg.svd(roots[1].T @ roots[0])
    kept = s > 1e-13 / max(len(s), 1) * s[0] if s[0] > 0 else np.zeros(len(s), bool)
    scale = 1 / np.sqrt(s[kept])
    into, outof = (roots[1] @ U[:, kept] * scale).T, roots[0] @ Vt[kept].T * scale
    return Loop(into @ A @ outof, into @ B, C @ outof)


def _root(W):
    """R with R R' = W, of a positive semidefinite matrix W."""
    values, vectors = np.linalg.eigh((W + W.T) / 2)
    return vectors * np.sqrt(np.maximum(values, 0.0))
