"""The learning maps of many machines as matrices, for trials of a few hundred samples.

Norms, limits and eigenvalues are computed by LAPACK.
"""

from __future__ import annotations

from functools import lru_cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..learning.machine import Machine
from ..runtime.tiles import tiled
from ..schemes import Scheme
from ..signals.task import Task
from .affine import View, learning_of
from .law import learning_law
from .reached import reachable, reached
from .spectrum import growth_about, radius_with_doubt, triangular_radius

MOST = 4000  # trials over which a limit is looked for
WIDE = 1e-12  # relative width that covers the rounding of a norm


class Matrices(NamedTuple):
    """F(w) = M w + c, e(w) = E w + e0, and what limits act on, T w + t, of S machines.

    start: (S, n) the w of the first trial
    M:     (S, n, n)
    c:     (S, n)
    E:     (S, N n_y, n)
    e0:    (S, N n_y)
    T:     {name: (S, K, n)} of each limit, in units of its bound
    t:     {name: (S, K)} likewise
    basis: (S, n', n) where learning does not reach every input, see `reached`: the w above is then
           z of w_1 + basis z, for the w (n',) that is played; columns of zeros fill up; else None
    origin: (S, n') this w_1; else None
    """

    start: np.ndarray
    M: np.ndarray
    c: np.ndarray
    E: np.ndarray
    e0: np.ndarray
    T: dict[str, np.ndarray]
    t: dict[str, np.ndarray]
    basis: np.ndarray | None = None
    origin: np.ndarray | None = None

    @classmethod
    def of(cls, machines: Machine, scheme: Scheme, task: Task, view: View) -> Matrices:
        """The matrices, by linearising each trial and its learning at the start."""
        found = cls(*jax.tree.map(np.asarray, _matrices(view)((scheme, task), machines)))
        usable = np.array(
            [
                np.isfinite(M).all() and np.isfinite(E).all()
                for M, E in zip(found.M, found.E, strict=True)
            ]
        )
        # nothing can be claimed of a machine whose numbers overflow
        huge = np.sqrt(np.finfo(found.M.dtype).max)
        M = np.where(usable[:, None, None], found.M, huge)
        E, c = np.where(usable[:, None, None], found.E, 0.0), np.nan_to_num(found.c)
        return found._replace(M=M, E=E, c=c)._reached()

    def _reached(self) -> Matrices:
        """These maps of the inputs that learning reaches, if some machine does not reach all."""
        moved = _apply(self.M, self.start) + self.c - self.start
        found = [reached(M, d) for M, d in zip(self.M, moved, strict=True)]
        if all(V is None for V in found):
            return self
        bases = [np.eye(self.M.shape[1]) if V is None else V for V in found]
        most = max(V.shape[1] for V in bases)
        basis = np.stack([np.pad(V, ((0, 0), (0, most - V.shape[1]))) for V in bases])
        back = basis.swapaxes(1, 2)
        return Matrices(
            start=np.zeros((len(basis), most), self.start.dtype),
            M=back @ self.M @ basis,
            c=_apply(back, moved),
            E=self.E @ basis,
            e0=self.e0 + _apply(self.E, self.start),
            T={name: T @ basis for name, T in self.T.items()},
            t={name: t + _apply(self.T[name], self.start) for name, t in self.t.items()},
            basis=basis,
            origin=self.start,
        )

    def norm(self, power: int) -> np.ndarray:
        """(S,) an upper bound of ||M^power||."""
        with np.errstate(over="ignore", invalid="ignore"):
            powers = np.linalg.matrix_power(self.M, power)
        return _norms(powers) * (1 + WIDE)

    def late(self, power: int) -> np.ndarray:
        """(S,) a lower bound of ||M^power||."""
        return self.norm(power) * (1 - 2 * WIDE)

    def error_norm(self, scheme: Scheme, task: Task, view: View) -> np.ndarray:
        """(S,) an upper bound of ||I - G L||, G = -E, of a scheme that keeps all it has learned."""
        L = learning_law(scheme.unlimited(), task).L[list(view.moving)]
        L = L if self.basis is None else self.basis.swapaxes(1, 2) @ L
        return _norms(np.eye(self.E.shape[1]) + self.E @ L) * (1 + WIDE)

    def limit(self):
        """Where learning goes: w_inf (S, n), |F(w_inf) - w_inf| (S,), the error and ||E|| (S,).

        The error is its root mean square (S,) at w_inf.
        """
        unit, limit = np.eye(self.M.shape[1]), np.zeros_like(self.c)
        for i, (M, c) in enumerate(zip(self.M, self.c, strict=True)):
            limit[i] = np.linalg.lstsq(unit - M, c)[0]
        left = np.linalg.norm(_apply(self.M, limit) + self.c - limit, axis=1)
        error = np.sqrt(np.mean((_apply(self.E, limit) + self.e0) ** 2, axis=1))
        if self.basis is not None:
            limit = self.origin + _apply(self.basis, limit)
        return limit, left, error, _norms(self.E)

    def radius(self):
        """(S,) spectral radius of M where learning moves w, and how far rounding may have moved it.

        An axis at rest, whose map stands apart from that of the others, does not count.
        """
        moved = _apply(self.M, self.start) + self.c != self.start
        at = [reachable(M, moves) for M, moves in zip(self.M, moved, strict=True)]
        return np.array(
            [radius_with_doubt(M[np.ix_(k, k)]) for M, k in zip(self.M, at, strict=True)]
        ).T

    def by_radius(self, which):
        """What is known of M by its spectral radius, each (S,).

        It is this radius, about max_i ||M^i||, the first power that is seen to contract, and
        ||(I - M)^-1||. The radius is exact where M is triangular; otherwise it has its doubt added.
        The power is 0 where none is seen, and the others are infinite where the radius is not below
        1, and where `which` (S,) does not ask for them. The last one is infinite, too, where no
        power contracts, and where the growth is beyond the digits of the numbers, so that nobody
        could see learning converge.
        """
        eps = np.finfo(self.M.dtype).eps
        radius, growth, inverse = np.full((3, len(self.M)), np.inf)
        fallen = np.zeros(len(self.M), int)
        for i in np.flatnonzero(which):
            radius[i] = triangular_radius(self.M[i])
            if not np.isfinite(radius[i]):
                above = sum(radius_with_doubt(self.M[i]))
                radius[i] = above if above < 1 else np.inf
            if radius[i] < 1:
                growth[i], fallen[i] = growth_about(self.M[i])
            if fallen[i] and growth[i] * eps < 1:
                with np.errstate(divide="ignore"):
                    inverse[i] = 1 / np.linalg.norm(np.eye(len(self.M[i])) - self.M[i], -2)
        return radius, growth, fallen, inverse

    def first_met(self, reach, room=None):
        """The first trial that meets a limit, whether none ever is met, and which limit it is.

        Each is (S,). The trial is 0 where none was seen to meet a limit. reach: (S,) of `Decay`;
        room: (S, K) of the bounds that counts as all of them; None for all of it
        """
        T, t = (
            np.concatenate(list(self.T.values()), axis=1),
            np.concatenate(list(self.t.values()), axis=1),
        )
        if room is not None:
            T, t = T / room[:, :, None], t / room
        owner = np.repeat(np.arange(len(self.t)), [one.shape[1] for one in self.t.values()])
        rows, size = np.linalg.norm(T, axis=2), len(self.start)
        met, clear, which = np.zeros(size, int), np.zeros(size, bool), np.zeros(size, int)
        w, open_ = self.start, np.arange(size)
        for j in range(1, MOST + 1):
            with np.errstate(over="ignore", invalid="ignore"):
                following = _apply(self.M[open_], w) + self.c[open_]
                now = np.abs(_apply(T[open_], w) + t[open_])
                moved = np.linalg.norm(following - w, axis=1)
                later = now + np.where(moved > 0, reach[open_] * moved, 0.0)[:, None] * rows[open_]
            top, beyond = np.max(now, axis=1), ~(np.max(now, axis=1) <= 1)
            which[open_] = owner[np.argmax(np.nan_to_num(now, nan=np.inf), axis=1)]
            met[open_[beyond]], clear[open_] = (
                j,
                ~beyond & np.all(later <= 1, axis=1) & np.isfinite(top),
            )
            left = ~beyond & ~clear[open_]
            open_, w = open_[left], following[left]
            if not len(open_):
                break
        return met, clear, which


@lru_cache(maxsize=4)  # what `tiled` returns compiles anew each time it is made
def _matrices(view):
    return tiled(partial(_of_one, view=view), lanes=1)


def _of_one(common, machine, *, view):
    found = learning_of(machine, *common, view)
    outputs, push = jax.linearize(
        lambda w: (found.following(w), found.error(w), found.limits(w)), found.start
    )
    slopes = jax.vmap(push, out_axes=-1)(jnp.eye(found.start.size))
    offset = jax.tree.map(lambda value, slope: value - slope @ found.start, outputs, slopes)
    (M, E, T), (c, e0, t) = slopes, offset
    return found.start, M, c, E, e0, T, t


def _apply(matrices, vectors) -> np.ndarray:
    """(S, m) the products of S matrices (S, m, n) and vectors (S, n)."""
    return np.einsum("sij,sj->si", matrices, vectors)


def _norms(matrices) -> np.ndarray:
    """(S,) largest singular values; infinite where a matrix overflows."""
    found = np.full(len(matrices), np.inf)
    for i, M in enumerate(matrices):
        if np.all(np.isfinite(M)) and M.size:
            found[i] = np.linalg.norm(M, 2)
    return found
