"""The problem that all solve in `make bench`, and the opponents: NumPy, Numba and C.

The problem is MFAILC on a difference equation of third order. Every opponent computes what `learn`
does, trial by trial: the laws CFDL (Cao 2019, eq. 12 and 13) and FFDL with L_y = L_u = 2 (eq. 25
and 27), the reset `sign`, the plant, and four metrics of each trial: max |e|, RMS of e, settled
|e|, RMS of u. What the gradient in C is, adjoint.c says.
"""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
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


# Compiled: loops for Numba, and programs in C
# --------------------------------------------------------------------------------------------------


class Target(NamedTuple):
    """What the programs in C are built by and for.

    compiler: its name and version
    instructions: the widest instruction set of the target that has lanes
    lanes: plants to a register, one for each float64 that it holds
    """

    compiler: str
    instructions: str
    lanes: int


def _cfdl_plant(a, b, r, trials, settled, weights, phi0, metrics):
    # One pass over the samples of a trial; the numbers for the next trial are computed in place.
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
        metrics[j, 0], metrics[j, 1], metrics[j, 2], metrics[j, 3] = (
            largest,
            np.sqrt(squares / N),
            late,
            np.sqrt(effort / N),
        )


def _ffdl_plant(a, b, r, trials, settled, weights, phi0, metrics):
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
        metrics[j, 0], metrics[j, 1], metrics[j, 2], metrics[j, 3] = (
            largest,
            np.sqrt(squares / N),
            late,
            np.sqrt(effort / N),
        )


def numba_parallel() -> Peer:
    """The loops above compiled by Numba, with fast math; each thread runs plant after plant.

    Raises ImportError without Numba.
    """
    import numba

    def batch(one):
        @numba.njit(parallel=True, fastmath=True)
        def run(a, b, r, trials, settled, weights, phi0):
            metrics = np.zeros((len(b), trials, 4))
            for s in numba.prange(len(b)):
                one(a, b[s], r, trials, settled, weights, phi0, metrics[s])
            return metrics

        return run

    compiled = {
        1: batch(numba.njit(fastmath=True)(_cfdl_plant)),
        4: batch(numba.njit(fastmath=True)(_ffdl_plant)),
    }
    return lambda problem: compiled[len(problem.phi0)](*problem)


def c_program(threads: int, target: str = "native") -> Peer:
    """The same in C with explicit SIMD lanes and OpenMP threads, near the limit of a processor.

    It is built with the compiler `cc`, whose option `-march` names the target: this processor, or
    another one, such as `haswell`, that has no instructions which this one lacks.

    Raises FileNotFoundError where there is no compiler, and OSError where it cannot build the
    program.
    """
    return _of_library(
        "limit.c", target, lambda of: (of.settled, threads), lambda of: (len(of.b), of.trials, 4)
    )


def c_adjoint(threads: int, target: str = "native") -> Peer:
    """The gradient by hand in C (adjoint.c), with the same lanes and threads.

    Its result (S, 1+P) is the mean square error of the last trial of each plant, with the slopes
    by lam, rho, eta, mu and the components of phi0. Raises as `c_program` does.
    """
    return _of_library(
        "adjoint.c", target, lambda of: (threads,), lambda of: (len(of.b), 5 + len(of.phi0))
    )


def target_of_c(target: str = "native") -> Target:
    """The target of the programs in C, as the compiler sees it. Raises as `c_program` does."""
    loaded = _library("limit.c", target)
    texts = (ctypes.c_char_p.in_dll(loaded, name).value for name in Target._fields[:2])
    lanes = ctypes.c_int.in_dll(loaded, "lanes").value
    return Target(*(text.decode() for text in texts if text), lanes)


def _of_library(
    name: str,
    target: str,
    more: Callable[[Problem], tuple[int, ...]],
    shape: Callable[[Problem], tuple[int, ...]],
) -> Peer:
    """What a program in C computes, whose functions take `more` numbers after the sizes."""
    loaded = _library(name, target)

    def run(problem: Problem) -> np.ndarray:
        law = loaded.cfdl if len(problem.phi0) == 1 else loaded.ffdl
        found = np.empty(shape(problem))
        arrays = [
            np.ascontiguousarray(x, float)
            for x in (problem.a, problem.b, problem.r, problem.weights, problem.phi0)
        ]
        sizes = len(problem.b), problem.trials, len(problem.r) - 1
        places = (ctypes.c_void_p(x.ctypes.data) for x in (*arrays, found))
        if law(*sizes, *more(problem), *places):
            raise MemoryError(f"{name} could not allocate its tiles")
        return found

    return run


@cache
def _library(name: str, target: str) -> ctypes.CDLL:
    """The program in C of this name, built for a target and loaded.

    It is linked without -ffast-math, with which GCC 12 lets all of a process take denormal numbers
    as zero once the program is loaded.
    """
    compiler = shutil.which("cc")
    if compiler is None:
        raise FileNotFoundError("no C compiler: `cc` was not found")
    with tempfile.TemporaryDirectory() as folder:
        library, compiled = Path(folder) / "library.so", Path(folder) / "library.o"
        flags = ("-O3", f"-march={target}", "-ffast-math", "-fopenmp", "-fPIC")
        for words in (
            (*flags, "-c", Path(__file__).with_name(name), "-o", compiled),
            ("-fopenmp", "-shared", compiled, "-o", library, "-lm"),
        ):
            built = subprocess.run([compiler, *words], capture_output=True, text=True, check=False)
            if built.returncode:
                why = built.stderr.strip().splitlines()[-1:]
                raise OSError(f"{compiler} could not build {name}: {why}")
        return ctypes.CDLL(str(library))
