"""The learning maps of many machines without a matrix, for trials of any length.

Norms are bounded by Lanczos's method; the limit of learning is found by minimal residuals.
"""

from __future__ import annotations

from functools import lru_cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ..learning.machine import Machine
from ..runtime.lanes import usual_lanes
from ..runtime.tiles import tiled
from ..schemes import Scheme
from ..signals.task import Task
from .affine import View, learning_of, limits_as_one
from .as_matrix import Matrices
from .iteration import krylov, largest, spectral_radius_of
from .trials import next_learned

FEW = 60  # Lanczos steps where a bound need not be sharp
LARGEST = 1024  # rows up to which a matrix is made where it decides
MOST = 4000  # trials over which a limit is looked for
TILE = 2**28  # bytes of Lanczos vectors in a tile


class Maps(NamedTuple):
    """The learning maps F of S machines, with the functions that `Matrices` has.

    steps: largest number of steps of the Lanczos process
    """

    machines: Machine
    scheme: Scheme
    task: Task
    view: View
    steps: int

    def norm(self, power: int) -> np.ndarray:
        """(S,) an upper bound of ||M^power||."""
        return self._bounded(_norm_of_power, jnp.asarray(power), self.steps if power == 1 else FEW)

    def late(self, power: int) -> np.ndarray:
        """(S,) a lower bound of ||M^power||: the length that a random unit vector gets."""
        return self._found(_of_random, jnp.asarray(power))

    def error_norm(self, scheme: Scheme, task: Task, view: View) -> np.ndarray:
        """(S,) an upper bound of ||I - G L||, of a scheme that keeps all that it has learned."""
        return self._bounded(_error_norm, None, self.steps)

    def limit(self):
        """Where learning goes: w_inf (S, n), |F(w_inf) - w_inf| (S,), the error there and its gain.

        The error is its root mean square (S,). The gain (S,) is an upper bound of how the error
        changes with w.
        """
        return tuple(
            map(np.asarray, self._run(_limit)((self.scheme, self.task, None), self.machines))
        )

    def radius(self):
        """(S,) spectral radius of M, and its doubt.

        Where it seems to be above 1, a doubt of first order says little of an M far from normal, as
        that of a causal law is: its matrix decides. The doubt is infinite where that would have
        more than 1024 rows, and on a backend without `eig`.
        """
        if jax.default_backend() != "cpu":
            return np.zeros(self._count), np.full(self._count, np.inf)
        found = self._run(_radius, lanes=4)((self.scheme, self.task, None), self.machines)
        radius, doubt = map(np.array, found)
        for i in np.flatnonzero(radius - doubt > 1):
            doubt[i] = np.inf
            if len(self.view.moving) <= LARGEST:
                one = jax.tree.map(lambda leaf, i=i: np.asarray(leaf)[i : i + 1], self.machines)
                alone = Matrices.of(one, self.scheme, self.task, self.view)
                radius[i], doubt[i] = (float(x[0]) for x in alone.radius())
        return radius, doubt

    def by_radius(self, which):
        """Infinite, and 0 for the power: without the matrix the radius is no proof."""
        unknown = np.full(len(which), np.inf)
        return unknown, unknown, np.zeros(len(which), int), unknown

    def first_met(self, reach, room=None):
        """The first trial that meets a limit, whether none ever is met, and which limit it is.

        Each is (S,). The trial is 0 where none was seen to meet a limit. reach, room: as for
        `Matrices`
        """
        room = np.ones((self._count, 1)) if room is None else room
        found = self._run(_first_met)(
            (self.scheme, self.task, None),
            (self.machines, jnp.asarray(reach), jnp.asarray(room)),
        )
        return tuple(map(np.asarray, found))

    @property
    def _count(self) -> int:
        return len(jax.tree.leaves(self.machines)[0])

    def _bounded(self, function, extra, most: int) -> np.ndarray:
        """(S,) upper bounds of a norm.

        They are computed in few steps, and in more where these do not tell whether the norm is
        below 1.
        """
        for steps in (FEW, most):
            value, bound = (
                np.nan_to_num(x, nan=np.inf)
                for x in self._run(function, steps=steps)(
                    (self.scheme, self.task, extra), self.machines
                )
            )
            if most <= FEW or not np.any((value < 1) & (bound >= 1)):
                break
        return bound

    def _found(self, function, extra=None, **options) -> np.ndarray:
        found = np.asarray(
            self._run(function, **options)((self.scheme, self.task, extra), self.machines)
        )
        return np.nan_to_num(found, nan=np.inf)

    def _run(self, function, lanes: int | None = None, **options):
        size = len(self.view.moving)
        room = max(1, TILE // (16 * min(options.get("steps", FEW), size) * size))
        return _compiled(
            function, self.view, lanes or min(usual_lanes() or room, room), tuple(options.items())
        )


@lru_cache(maxsize=32)  # what `tiled` returns compiles anew each time it is made
def _compiled(function, view, lanes, options):
    return tiled(partial(function, view=view, **dict(options)), lanes=lanes)


# One machine at a time
# --------------------------------------------------------------------------------------------------


def _norm_of_power(common, machine, *, view, steps):
    scheme, task, power = common
    found = learning_of(machine, scheme, task, view)
    _, push = jax.linearize(found.following, found.start)
    pull = jax.linear_transpose(push, found.start)
    forth = lambda v: lax.fori_loop(0, power, lambda _, v: push(v), v)  # noqa: E731
    back = lambda w: lax.fori_loop(0, power, lambda _, w: pull(w)[0], w)  # noqa: E731
    return _value_and_bound(
        largest(forth, back, found.start, found.start.size, steps=steps, tolerance=0.0)
    )


def _of_random(common, machine, *, view):
    scheme, task, power = common
    found = learning_of(machine, scheme, task, view)
    _, push = jax.linearize(found.following, found.start)
    v = jax.random.normal(jax.random.key(2), found.start.shape, found.start.dtype)
    return jnp.linalg.norm(lax.fori_loop(0, power, lambda _, v: push(v), v / jnp.linalg.norm(v)))


def _error_norm(common, machine, *, view, steps):
    scheme, task, _ = common
    found, free = learning_of(machine, scheme, task, view), scheme.unlimited().prepared(task)
    at = jnp.zeros((task.N, task.outputs))
    memory, learned = free.initial_memory(task), free.feedforward(free.initial_memory(task), task)
    _, of_error = jax.linearize(
        lambda e: next_learned(free, task, memory, learned, e).ravel()[np.array(view.moving)], at
    )
    _, to_error = jax.linearize(found.error, found.start)
    forth = lambda e: e + to_error(of_error(e.reshape(at.shape)))  # noqa: E731
    flat = at.ravel()
    back = jax.linear_transpose(forth, flat)
    return _value_and_bound(
        largest(forth, lambda w: back(w)[0], flat, flat.size, steps=steps, tolerance=0.0)
    )


def _value_and_bound(found):
    return found.value, found.bound


def _limit(common, machine, *, view, rounds: int = 4):
    """Where the map goes: the residual over a Krylov space is minimised a few times in turn."""
    scheme, task, _ = common
    found = learning_of(machine, scheme, task, view)
    _, push = jax.linearize(found.following, found.start)

    def closer(_, w):
        residual = found.following(w) - w
        V, H = krylov(lambda v: v - push(v), residual, min(FEW, w.size))
        first = jnp.zeros(len(H)).at[0].set(jnp.linalg.norm(residual))
        return w + jnp.linalg.lstsq(H, first)[0] @ V[:-1]

    w = lax.fori_loop(0, rounds, closer, found.start)
    left = jnp.linalg.norm(found.following(w) - w)
    return w, left, jnp.sqrt(jnp.mean(found.error(w) ** 2)), _gain(found.error, found.start)


def _radius(common, machine, *, view):
    scheme, task, _ = common
    found = learning_of(machine, scheme, task, view)
    moved = found.following(found.start) - found.start  # what lies apart from it never moves
    radius = spectral_radius_of(found.following, found.start, steps=FEW, begin=moved)
    return radius.value, radius.doubt


def _first_met(common, one, *, view):
    (scheme, task, _), (machine, reach, room) = common, one
    found = learning_of(machine, scheme, task, view)
    sizes = [signal.size for signal in jax.eval_shape(found.limits, found.start).values()]
    acted = lambda w: limits_as_one(found.limits(w)) / room  # noqa: E731
    gain = _gain(acted, found.start)

    def look(now):
        j, w, met, _, _ = now
        following = found.following(w)
        of_each = jnp.split(jnp.abs(acted(w)), np.cumsum(sizes)[:-1])
        top = jnp.stack([jnp.max(one) for one in of_each])
        moved = jnp.linalg.norm(following - w)
        later = jnp.max(top) + gain * jnp.where(moved > 0, reach * moved, 0.0)
        return (
            j + 1,
            following,
            jnp.where(~(jnp.max(top) <= 1), j, met),
            later <= 1,
            jnp.argmax(top),
        )

    def going_on(now):
        j, _, met, clear, _ = now
        return (met == 0) & ~clear & (j <= MOST)

    start = (jnp.asarray(1), found.start, jnp.asarray(0), jnp.asarray(False), jnp.asarray(0))
    _, _, met, clear, which = lax.while_loop(going_on, look, start)
    return met, clear & (met == 0), which


def _gain(f, w):
    """An upper bound of the norm of the derivative of f at w."""
    here, push = jax.linearize(f, w)
    pull = jax.linear_transpose(push, w)
    return largest(push, lambda v: pull(v)[0], w, here.size, steps=FEW, tolerance=0.0).bound
