"""MFAILC on a difference equation of third order as others write it: NumPy, Numba, C. `jaxilc
bench` compares with them.

All of them compute what `learn` does, trial by trial: the laws CFDL (Cao 2019, eq. 12 and 13) and
FFDL with L_y = L_u = 2 (eq. 25 and 27), the reset `sign`, the plant, and four figures of each
trial: max |e|, RMS of e, settled |e|, RMS of u.
"""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

FIGURES = ("max_error", "rms", "settled_error", "effort")
LANES = 8  # of the C program: doubles in the widest register there is


class Problem(NamedTuple):
    """S plants, J trials of N samples.

    a: (3,), b: (S, 3) coefficients of the plants;  r: (N+1,) reference;  trials: J;  settled: first
    sample of the settled window
    weights: (5,) lam, rho, eta, mu, epsilon;  phi0: (1,) for CFDL, (4,) for FFDL
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
        """Sample-steps: one sample of one trial of one plant each."""
        return len(self.b) * self.trials * (len(self.r) - 1)

    def part(self, plants: int, trials: int) -> Problem:
        """The first plants and trials of it."""
        return self._replace(b=self.b[:plants], trials=min(self.trials, trials))


Peer = Callable[[Problem], np.ndarray]  # -> (S, J, 4) figures


def numpy_loop(problem: Problem) -> np.ndarray:
    """Plant by plant: a Python loop over the samples, learning in whole arrays."""
    return np.stack([_one_by_one(problem, b) for b in problem.b])


def _one_by_one(problem, b):
    a, r, N, phi0 = problem.a, problem.r, len(problem.r) - 1, problem.phi0
    lam, rho, eta, mu, epsilon = problem.weights
    L, c = (0, 0) if len(phi0) == 1 else (2, 2)
    phi = np.tile(phi0[:, None], N)
    u, y, figures = np.zeros(N), np.zeros(N + 1), np.zeros((problem.trials, 4))
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
        figures[j] = (
            np.max(e[1:]),
            np.sqrt(np.mean(e[1:] ** 2)),
            np.max(e[problem.settled :]),
            np.sqrt(np.mean(u**2)),
        )
    return figures


def numpy_batch(problem: Problem) -> np.ndarray:
    """All plants at once: the same loop over samples, each step an operation on arrays of S
    numbers.
    """
    a, b, r, N, S, phi0 = (
        problem.a,
        problem.b.T.copy(),
        problem.r,
        len(problem.r) - 1,
        len(problem.b),
        problem.phi0,
    )
    lam, rho, eta, mu, epsilon = problem.weights
    L, c = (0, 0) if len(phi0) == 1 else (2, 2)
    phi = [np.full((N, S), p) for p in phi0]
    u, y, figures = np.zeros((N, S)), np.zeros((N + 1, S)), np.zeros((S, problem.trials, 4))
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
        figures[:, j] = np.stack(rows, axis=1)
    return figures


def _cfdl_plant(a, b, r, trials, settled, weights, phi0, figures):
    # one pass over the samples of a trial: what the next trial needs is worked out at once, in
    # place
    lam, rho, eta, mu, epsilon = weights
    N, start = len(r) - 1, phi0[0]
    u, u_last, y, phi = np.zeros(N), np.zeros(N), np.zeros(N + 1), np.full(N, start)
    for j in range(trials):
        x0, x1, x2, largest, late, squares, effort = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(N):
            u_k, p = u[k], phi[k]
            x0, x1, x2 = (
                x1 + a[0] * x0 + b[0] * u_k,
                x2 + a[1] * x0 + b[1] * u_k,
                a[2] * x0 + b[2] * u_k,
            )
            e = r[k + 1] - x0
            largest, squares, effort = max(largest, abs(e)), squares + e * e, effort + u_k * u_k
            if k + 1 >= settled:
                late = max(late, abs(e))
            if j > 0:
                du, dy = u_k - u_last[k], x0 - y[k + 1]
                p += eta * du / (mu + du * du) * (dy - p * du)
                if abs(p) <= epsilon or (p > 0) != (start > 0):
                    p = start
                phi[k] = p
            u[k], u_last[k], y[k + 1] = u_k + rho * p / (lam + p * p) * e, u_k, x0
        figures[j, 0], figures[j, 1], figures[j, 2], figures[j, 3] = (
            largest,
            np.sqrt(squares / N),
            late,
            np.sqrt(effort / N),
        )


def _ffdl_plant(a, b, r, trials, settled, weights, phi0, figures):
    lam, rho, eta, mu, epsilon = weights
    N = len(r) - 1
    u, y = np.zeros(N), np.zeros(N + 1)
    phi = np.empty((N, 4))
    phi[:] = phi0
    for j in range(trials):
        x0, x1, x2, largest, late, squares, effort = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        dy, dy_old, du_old = 0.0, 0.0, 0.0
        for k in range(N):
            p0, p1, p2, p3 = phi[k, 0], phi[k, 1], phi[k, 2], phi[k, 3]
            du = 0.0
            if j > 0:
                du = (
                    rho
                    * p2
                    / (lam + p2 * p2)
                    * (r[k + 1] - y[k + 1] - p0 * dy - p1 * dy_old - p3 * du_old)
                )
            u_k = u[k] + du
            x0, x1, x2 = (
                x1 + a[0] * x0 + b[0] * u_k,
                x2 + a[1] * x0 + b[1] * u_k,
                a[2] * x0 + b[2] * u_k,
            )
            e = r[k + 1] - x0
            largest, squares, effort = max(largest, abs(e)), squares + e * e, effort + u_k * u_k
            if k + 1 >= settled:
                late = max(late, abs(e))
            if j > 0:
                dy_new = x0 - y[k + 1]
                step = eta * (dy_new - p0 * dy - p1 * dy_old - p2 * du - p3 * du_old)
                step /= mu + dy * dy + dy_old * dy_old + du * du + du_old * du_old
                p0, p1, p2, p3 = (
                    p0 + step * dy,
                    p1 + step * dy_old,
                    p2 + step * du,
                    p3 + step * du_old,
                )
                if abs(p2) <= epsilon or (p2 > 0) != (phi0[2] > 0):
                    p0, p1, p2, p3 = phi0[0], phi0[1], phi0[2], phi0[3]
                phi[k, 0], phi[k, 1], phi[k, 2], phi[k, 3] = p0, p1, p2, p3
                dy, dy_old, du_old = dy_new, dy, du
            u[k], y[k + 1] = u_k, x0
        figures[j, 0], figures[j, 1], figures[j, 2], figures[j, 3] = (
            largest,
            np.sqrt(squares / N),
            late,
            np.sqrt(effort / N),
        )


def numba_parallel() -> Peer:
    """The loops above compiled by Numba, fast math allowed, plants spread over the threads. Raises
    ImportError without Numba.
    """
    import numba

    def batch(one):
        @numba.njit(parallel=True, fastmath=True)
        def run(a, b, r, trials, settled, weights, phi0):
            figures = np.zeros((len(b), trials, 4))
            for s in numba.prange(len(b)):
                one(a, b[s], r, trials, settled, weights, phi0, figures[s])
            return figures

        return run

    compiled = {
        1: batch(numba.njit(fastmath=True)(_cfdl_plant)),
        4: batch(numba.njit(fastmath=True)(_ffdl_plant)),
    }
    return lambda problem: compiled[len(problem.phi0)](*problem)


def c_program(threads: int) -> Peer:
    """The same in C with explicit SIMD lanes and OpenMP threads: what this processor can do at
    most, near enough.

    Built with the compiler that `cc` is. Raises FileNotFoundError without one, OSError where it
    cannot build the program.
    """
    compiler = shutil.which("cc")
    if compiler is None:
        raise FileNotFoundError("no C compiler: `cc` was not found")
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / "limit.so"
        flags = (
            "-O3",
            "-march=native",
            "-ffast-math",
            "-fopenmp",
            "-shared",
            "-fPIC",
            f"-DLANES={LANES}",
        )
        built = subprocess.run(
            [compiler, *flags, "-o", library, Path(__file__).with_name("limit.c"), "-lm"],
            capture_output=True,
            text=True,
            check=False,
        )
        if built.returncode:
            raise OSError(
                f"{compiler} could not build limit.c: {built.stderr.strip().splitlines()[-1:]}"
            )
        loaded = ctypes.CDLL(str(library))

    def run(problem: Problem) -> np.ndarray:
        law = loaded.cfdl if len(problem.phi0) == 1 else loaded.ffdl
        arrays = [
            np.ascontiguousarray(x, float)
            for x in (problem.a, problem.b, problem.r, problem.weights, problem.phi0)
        ]
        figures = np.empty((len(problem.b), problem.trials, 4))
        pointers = [ctypes.c_void_p(x.ctypes.data) for x in (*arrays, figures)]
        failed = law(
            len(problem.b), problem.trials, len(problem.r) - 1, problem.settled, threads, *pointers
        )
        if failed:
            raise MemoryError("limit.c could not allocate its tiles")
        return figures

    return run
