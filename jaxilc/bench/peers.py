"""The problem that the opponents in `jaxilc bench` solve, and two opponents in NumPy.

The problem is MFAILC on a difference equation of third order. Every opponent computes what `learn`
does, trial by trial: the laws CFDL (Cao 2019, eq. 12 and 13) and FFDL with L_y = L_u = 2 (eq. 25
and 27), the reset `sign`, the plant, and four metrics of each trial: max |e|, RMS of e, settled
|e|, RMS of u. The compiled opponents are in `compiled_peers`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

METRICS = ("max_error", "rms", "settled_error", "effort")


class Problem(NamedTuple):
    """The problem of S plants that learn in J trials of N samples.

    a: (3,) coefficients of the outputs
    b: (S, 3) coefficients of the inputs for each plant
    r: (N+1,) reference [mm]
    trials: number J of trials
    settled: first sample of the settled window
    weights: (5,) lam, rho, eta, mu, epsilon
    phi0: (1,) for CFDL, (4,) for FFDL
    """

    a: np.ndarray
    b: np.ndarray
    r: np.ndarray
    trials: int
    settled: int
    weights: np.ndarray
    phi0: np.ndarray

    @property
    def steps(self) -> int:
        """The number of sample-steps; each is one sample of one trial of one plant."""
        return len(self.b) * self.trials * (len(self.r) - 1)

    def part(self, plants: int, trials: int) -> Problem:
        """The same problem with the first plants and trials only."""
        return self._replace(b=self.b[:plants], trials=min(self.trials, trials))


Peer = Callable[[Problem], np.ndarray]  # -> (S, J, 4) metrics


def numpy_loop(problem: Problem) -> np.ndarray:
    """The metrics plant by plant: a Python loop over the samples, and learning in whole arrays."""
    return np.stack([_one_by_one(problem, b) for b in problem.b])


def _one_by_one(problem, b):
    a, r, N, phi0 = problem.a, problem.r, len(problem.r) - 1, problem.phi0
    lam, rho, eta, mu, epsilon = problem.weights
    L, c = (0, 0) if len(phi0) == 1 else (2, 2)
    phi = np.tile(phi0[:, None], N)
    u, y, metrics = np.zeros(N), np.zeros(N + 1), np.zeros((problem.trials, 4))
    for j in range(problem.trials):
        u_last, y_last = u, y
        gain = phi[c] / (lam + phi[c] ** 2) * (j > 0)
        u, y = u_last + rho * gain * (r - y_last)[1:], np.zeros(N + 1)
        within = rho * gain * phi
        for k in range(N):
            if L and j:
                u[k] -= within[0, k] * (y[k] - y_last[k])
                if k:
                    u[k] -= within[1, k] * (y[k - 1] - y_last[k - 1]) + within[3, k] * (
                        u[k - 1] - u_last[k - 1]
                    )
            y[k + 1] = a[0] * y[k] + b[0] * u[k]
            if k:
                y[k + 1] += a[1] * y[k - 1] + b[1] * u[k - 1]
            if k > 1:
                y[k + 1] += a[2] * y[k - 2] + b[2] * u[k - 2]
        if j:
            dy, du = y - y_last, u - u_last
            h = (
                np.stack([dy[:-1], np.append(0.0, dy[:-2]), du, np.append(0.0, du[:-1])])
                if L
                else du[None]
            )
            phi = phi + eta * h * (dy[1:] - np.sum(phi * h, axis=0)) / (mu + np.sum(h * h, axis=0))
            phi = np.where(
                (np.abs(phi[c]) <= epsilon) | (np.sign(phi[c]) != np.sign(phi0[c])),
                phi0[:, None],
                phi,
            )
        e = np.abs(r - y)
        metrics[j] = (
            np.max(e[1:]),
            np.sqrt(np.mean(e[1:] ** 2)),
            np.max(e[problem.settled :]),
            np.sqrt(np.mean(u**2)),
        )
    return metrics


def numpy_batch(problem: Problem) -> np.ndarray:
    """The metrics of all plants at once: the same loop, with arrays of S numbers at each sample."""
    a, b, r, phi0 = problem.a, problem.b.T.copy(), problem.r, problem.phi0
    N, S = len(r) - 1, len(problem.b)
    lam, rho, eta, mu, epsilon = problem.weights
    L, c = (0, 0) if len(phi0) == 1 else (2, 2)
    phi = [np.full((N, S), p) for p in phi0]
    u, y, metrics = np.zeros((N, S)), np.zeros((N + 1, S)), np.zeros((S, problem.trials, 4))
    for j in range(problem.trials):
        u_last, y_last, x = u, y, np.zeros((3, S))
        gain = rho * phi[c] / (lam + phi[c] ** 2) * (j > 0)
        u, y = u_last + gain * (r[:, None] - y_last)[1:], np.zeros((N + 1, S))
        within, dy_old, du_old = [gain * p for p in phi], np.zeros(S), np.zeros(S)
        for k in range(N):
            if L:
                dy = y[k] - y_last[k]
                u[k] -= within[0][k] * dy + within[1][k] * dy_old + within[3][k] * du_old
                dy_old, du_old = dy, u[k] - u_last[k]
            x = np.stack(
                [
                    x[1] + a[0] * x[0] + b[0] * u[k],
                    x[2] + a[1] * x[0] + b[1] * u[k],
                    a[2] * x[0] + b[2] * u[k],
                ]
            )
            y[k + 1] = x[0]
        if j:
            dy, du, rest = y - y_last, u - u_last, np.zeros((1, S))
            h = (
                [dy[:-1], np.concatenate([rest, dy[:-2]]), du, np.concatenate([rest, du[:-1]])]
                if L
                else [du]
            )
            miss = (
                eta
                * (dy[1:] - sum(p * i for p, i in zip(phi, h, strict=True)))
                / (mu + sum(i * i for i in h))
            )
            phi = [p + miss * i for p, i in zip(phi, h, strict=True)]
            useless = (np.abs(phi[c]) <= epsilon) | (np.sign(phi[c]) != np.sign(phi0[c]))
            phi = [np.where(useless, start, p) for p, start in zip(phi, phi0, strict=True)]
        e = np.abs(r[:, None] - y)
        rows = (
            np.max(e[1:], 0),
            np.sqrt(np.mean(e[1:] ** 2, 0)),
            np.max(e[problem.settled :], 0),
            np.sqrt(np.mean(u**2, 0)),
        )
        metrics[:, j] = np.stack(rows, axis=1)
    return metrics
