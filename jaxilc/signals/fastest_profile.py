"""The fastest speed profile along a path within limits, by an interior-point method."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
import scipy

from ..pytree.aliases import Numbers, Value

Spline: TypeAlias = Value  # of SciPy
Groups: TypeAlias = list[tuple[Numbers, Value, Value]]  # axes, acceleration, jerk of vectors
Share: TypeAlias = float | Numbers  # of an interval
_GAUSS = (np.polynomial.legendre.leggauss(4)[0] + 1) / 2, np.polynomial.legendre.leggauss(4)[1] / 2


def fastest(path: Spline, h: float, G: int, feed: Share, groups: Groups, gap: float) -> Numbers:
    """(G+2,) coefficients of the quadratic B-spline beta that minimises the time.

    It is found to a relative gap, by a barrier method: for each of a row of weights of the time,
    Newton's method finds the least cost. The limits are taken at both ends of each of the G
    intervals.
    """
    barrier = _Barrier(path, h, G, feed, groups)
    c = barrier.start()
    reached = 1.0
    while reached > gap:
        weight = barrier.limits / reached / barrier.time(c)
        now = barrier.cost(c, weight)
        for _ in range(30):
            try:
                step, decrease = barrier.newton_step(c, weight)
            except np.linalg.LinAlgError:  # rounding, close to a limit; c keeps them all
                return c
            scale = 1.0
            while (
                not (tried := barrier.cost(c + scale * step, weight))
                <= now - 1e-4 * scale * decrease
                and scale > 1e-9
            ):
                scale /= 2
            if scale <= 1e-9:
                break
            c, now = c + scale * step, tried
            if decrease < 0.1 * np.sqrt(G):
                break
        reached /= 8
    return c


def _stencil(h: float, G: int) -> Numbers:
    """(3, 3, 2, G) beta, beta' and beta'' at both ends of G intervals, from three coefficients."""
    bend = [1 / h**2, -2 / h**2, 1 / h**2]
    stencil = np.array(
        [[[0.5, 0.5, 0], [-1 / h, 1 / h, 0], bend], [[0, 0.5, 0.5], [0, -1 / h, 1 / h], bend]]
    )
    stencil = np.repeat(stencil.transpose(1, 2, 0)[..., None], G, axis=-1)
    # beta' = 0 at both ends, or the motion would start with a jump of acceleration: the outermost
    # coefficient counts to its neighbour
    for outermost, interval in ((0, 0), (2, -1)):
        stencil[:, 1, :, interval] += stencil[:, outermost, :, interval]
        stencil[:, outermost, :, interval] = 0.0
    return stencil


class _Barrier:
    """The time of a motion, and the logarithms of what it leaves of its limits.

    A jerk beta^(1/2) l, with l linear in beta, is within its limit where 1 / beta >= |l|^2. For a
    step, 1 / beta is replaced by the square of the tangent of beta^(-1/2), which lies below it:
    this makes the problem a convex one of the same gradient.

    E: (3, 2, G) beta at both ends of each interval, from its three coefficients
    Q: (2 n, 3, 3, 2, G) Gram matrices of the n accelerations a and the n jerks l, in parts of their
    limits: |a|^2 and |l|^2 = C Q C, of limits 1 and 1 / beta, where C are the three coefficients
    speed: (2, G) the part of the largest feed that is used, squared, for each unit of beta
    limits: number of inequalities
    """

    def __init__(self, path: Spline, h: float, G: int, feed: Share, groups: Groups) -> None:
        x = np.add.outer([0, 1], np.arange(G)) * h
        p1, p2, p3 = (np.moveaxis(path.derivative(i)(x), -1, 0).copy()[:, None] for i in (1, 2, 3))
        self.E, E1, E2 = _stencil(h, G)
        self.speed = (p1[-1, 0] / feed) ** 2
        a = p2 * self.E + p1 / 2 * E1
        ell = p3 * self.E + 1.5 * p2 * E1 + p1 / 2 * E2
        forms = [a[axes] / acceleration for axes, acceleration, _ in groups] + [
            ell[axes] / jerk for axes, _, jerk in groups
        ]
        self.Q = np.stack([np.einsum("aieg,ajeg->ijeg", form, form) for form in forms])
        self.G, self.n = G, len(groups)
        self._rows, self._cols = rows, cols = np.triu_indices(3)  # all a symmetric matrix holds
        self._weights = self.Q[:, rows, cols] * np.where(rows == cols, 1, 2)[:, None, None]
        self.limits = x.size * (1 + 2 * self.n)

    def start(self) -> Numbers:
        """(G+2,) coefficients of a constant speed that is within all limits."""
        n = self.n
        largest = np.max(np.sum(self.Q, axis=(1, 2)), axis=(1, 2))
        largest = largest ** np.repeat([1 / 4, 1 / 6], n)
        return np.full(self.G + 2, 0.9 * max(np.sqrt(self.speed.max()), *largest) ** -2)

    def local(self, c: Numbers) -> tuple[Numbers, Numbers, Numbers, Numbers]:
        """The three coefficients of each interval, beta, and what is left of the limits.

        These are the limit of the speed and the others. All are > 0 within the limits.
        """
        C = np.stack([c[:-2], c[1:-1], c[2:]])
        beta = np.einsum("ieg,ig->eg", self.E, C)
        used = np.einsum("lkeg,kg->leg", self._weights, C[self._rows] * C[self._cols])
        used[self.n :] *= beta
        return C, beta, 1 - self.speed * beta, 1 - used

    def time(self, c: Numbers) -> float:
        """The sum of the times that both ends of the intervals stand for."""
        return np.sum(self.local(c)[1] ** -0.5)

    def cost(self, c: Numbers, weight: float) -> float:
        """The weighted time less the logarithms; infinite outside the limits."""
        _, beta, left, others = self.local(c)
        if not (c.min() > 0 and min(left.min(), others.min()) > 0):
            return np.inf
        return weight * np.sum(beta**-0.5) - sum(np.sum(np.log(part)) for part in (left, *others))

    def newton_step(self, c: Numbers, weight: float) -> tuple[Numbers, float]:
        """(G+2,) step of Newton's method, and the decrease of the cost that it promises, twice."""
        slope, along, inverse, bend = self._derivatives(c, weight)
        G, E = self.G, self.E
        total, banded = np.zeros(G + 2), np.zeros((3, G + 2))
        for i in range(3):
            total[i : i + G] += np.sum(along * E[i], axis=0) + np.einsum("leg->g", slope[:, i])
            for j in range(i, 3):
                outer = np.einsum("leg,leg->g", slope[:, i], slope[:, j]) + 2 * np.einsum(
                    "leg,leg->g", self.Q[:, i, j], inverse
                )
                banded[2 + i - j, j : j + G] += outer + np.sum(bend * E[i] * E[j], axis=0)
        banded[2, [0, -1]] = 1.0  # the outermost coefficients follow their neighbours
        step = scipy.linalg.solveh_banded(banded, -total)
        step[[0, -1]] = step[[1, -2]]
        return step, -np.sum(total * step)  # a dot product would wait for BLAS threads

    def _derivatives(self, c: Numbers, weight: float) -> tuple[Numbers, ...]:
        """What the gradient and the Hessian of the cost are assembled from.

        These are the slopes of the logarithms of accelerations and jerks, (2 n, 3, 2, G), the slope
        along beta of all else, the factors of Q in the Hessian, and the second derivative along
        beta.
        """
        n = self.n
        C, beta, left, others = self.local(c)
        others[n:] /= beta
        inverse = 1 / others
        slope = 2 * np.einsum("lijeg,jg->lieg", self.Q, C)
        slope[n:] += beta**-2 * self.E
        slope *= inverse[:, None]
        along = self.speed / left - 0.5 * weight * beta**-1.5 - n / beta
        bend = (
            (self.speed / left) ** 2
            + 0.75 * weight * beta**-2.5
            + n / beta**2
            - 0.5 * beta**-3 * np.sum(inverse[n:], axis=0)
        )
        return slope, along, inverse, bend


class Profile:
    """The motion x(t) of dx/dt = beta(x)^(1/2)."""

    def __init__(self, coefficients: Numbers, h: float) -> None:
        self.c, self.h = coefficients, h
        self.G = len(coefficients) - 2
        self.times = np.append(0.0, np.cumsum(self._time(np.arange(self.G), 1.0)))

    def beta(self, x: Numbers) -> tuple[Numbers, Numbers, Numbers]:
        """beta and its two derivatives at x, (M,) each."""
        g = np.clip((x / self.h).astype(int), 0, self.G - 1)
        return self._beta(g, x / self.h - g)

    def _beta(self, g: Numbers, f: Share) -> tuple[Numbers, Numbers, Numbers]:
        """The same at the fraction f of interval g."""
        a, b, c = self.c[g], self.c[g + 1], self.c[g + 2]
        value = (a * (1 - f) ** 2 + c * f**2) / 2 + b * (0.75 - (f - 0.5) ** 2)
        return value, (a * (f - 1) + c * f + b * (1 - 2 * f)) / self.h, (a - 2 * b + c) / self.h**2

    def _time(self, g: Numbers, f: Share) -> Numbers:
        """Time from the start of interval g to its fraction f, by Gauss quadrature."""
        return sum(
            weight * f * self.h / np.sqrt(self._beta(g, f * node)[0])
            for node, weight in zip(*_GAUSS, strict=True)
        )

    def at(self, t: Numbers) -> Numbers:
        """x at the times t, (M,), by Newton's method."""
        g = np.clip(np.searchsorted(self.times, t, side="right") - 1, 0, self.G - 1)
        rest = t - self.times[g]
        f = rest / (self.times[g + 1] - self.times[g])
        for _ in range(4):
            f = np.clip(
                f - (self._time(g, f) - rest) * np.sqrt(self._beta(g, f)[0]) / self.h, 0.0, 1.0
            )
        return (g + f) * self.h
