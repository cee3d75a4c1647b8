"""Learning as a map of what is played: one trial and its learning take w to F(w) = M w + c.

The map takes w_j, what is learned so far, to w_{j+1} = F(w_j). Limits are left out. Where learning
depends on the last trial alone, w is what the scheme plays back, its `feedforward`, as far as
learning ever changes it: under a law with a lead, the last samples are never learned and do not
deviate from anything. A scheme that remembers more, as learning of higher order does, has all that
it knows for w. For a linear law on a linear machine F is affine; see `linearity`.

`learning_of` is this map of one machine. `LearningMaps` says what can be asked of those of many.
`Matrices` answers for trials of a few hundred samples, by LAPACK; `Maps` answers for trials of any
length without a matrix: norms are bounded by Lanczos's method, and the limit of learning is found
by minimal residuals.
"""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Callable
from functools import cached_property
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree

from ..learning.machine import Machine
from ..runtime.lanes import usual_lanes
from ..runtime.tiles import tiled_with
from ..schemes import Scheme
from ..signals.task import Limit, Task
from .condition import ROUNDING
from .law import learning_law, pushed
from .linearity import keeps_all, remembers
from .spectrum import (
    APART,
    drifting,
    growth_about,
    krylov,
    largest,
    norm_of,
    radius_with_doubt,
    reachable,
    reached,
    singular_value,
    spectral_radius_of,
    triangular_radius,
)
from .trials import (
    Key,
    learned_from,
    learned_shape,
    memory_at_last_change,
    next_learned,
    played,
    shown_of,
    starts_off,
    trial_of,
)

T = TypeVar("T")
DENSE = 512  # rows up to which M is taken as a matrix
STEPS = 300  # of the Lanczos process, at most
FEW = 60  # Lanczos steps where a bound need not be sharp
ROUNDS = 4  # of minimal residuals, to the limit of learning
LARGEST = 1024  # rows up to which a matrix is made where it decides
MOST = 4000  # trials over which a limit is looked for
DRIFT = 1e-8  # share of what an error moves, above which a growth in each trial is no rounding
WIDE = 1e-12  # relative width that covers the rounding of a norm, where ROUNDING is less
FARTHEST = 100  # powers of 2 between an input and a parameter, also in single precision
SIGNS = 8  # random signals whose mean tells the length of a column
TILE = 2**28  # bytes of Lanczos vectors in a tile
ROOM = 2**27  # bytes of the dense matrices of the machines that are looked at together


class View(NamedTuple):
    """What the vector w of a scheme consists of.

    whole:  whether w is all that the scheme knows, in place of its feedforward
    moving: (n,) which entries of it learning ever changes; all, where it changes none
    units:  (n,) what w is over what the scheme knows, so that each entry counts as the input that
            it makes, in any unit; None for 1. They are one for each leaf, as of the errors of a
            trial, and powers of 1024 where entries of a leaf are that far apart: a parameter of the
            snap may be 1e-9 of the input, which would be rounding beside it
    """

    whole: bool
    moving: tuple[int, ...]
    units: tuple[float, ...] | None = None

    def of(self, known: jax.Array) -> jax.Array:
        """(n,) w of all that is known, as one vector."""
        w = known[np.array(self.moving)]
        return w if self.units is None else w * jnp.asarray(self.units, w.dtype)

    def put(self, known: jax.Array, w: jax.Array) -> jax.Array:
        """All that is known, with w in its places."""
        w = w if self.units is None else w / jnp.asarray(self.units, w.dtype)
        return known.at[np.array(self.moving)].set(w)


class Turn(NamedTuple):
    """One trial that plays w, and learning from it.

    following: (n,) F(w), the w of the next trial
    error:     (N n_y,) the errors e[1..N]
    output:    ((N+1) n_y,) the output
    limits:    {name: what a limit acts on, in the trial and in learning from it}, in units of its
               bound
    """

    following: jax.Array
    error: jax.Array
    output: jax.Array
    limits: dict[str, jax.Array]


class Learning(NamedTuple):
    """The learning map and what belongs to it, as functions of the flat vector w (n,).

    start:     (n,) the w of the first trial; where limits act, of the first after the last change
    turn:      from w to its `Turn`
    from_record: from w and ((N+1) n_y,), the errors that the record shows, to the w of the next
               trial
    """

    start: jax.Array
    turn: Callable[[jax.Array], Turn]
    from_record: Callable[[jax.Array, jax.Array], jax.Array]

    def following(self, w: jax.Array) -> jax.Array:
        """F(w)."""
        return self.turn(w).following

    def error(self, w: jax.Array) -> jax.Array:
        """(N n_y,) the errors of the trial of w."""
        return self.turn(w).error


def learning_of(
    machine: Machine, scheme: Scheme, task: Task, view: View, key: Key = None
) -> Learning:
    """The learning map F of a machine and a scheme. The function is pure.

    key: of what is drawn of the record of a trial; None for its mean
    """
    bounded = machine, scheme
    machine, scheme = machine.unlimited(), scheme.unlimited().prepared(task)
    first = scheme.initial_memory(task)
    if machine.last_change > 1 and jax.eval_shape(_limits, *bounded, task):
        first = memory_at_last_change(bounded[0], bounded[1].prepared(task), task)
    start, unravel = ravel_pytree(first if view.whole else scheme.feedforward(first, task))

    def trial(w):
        known = unravel(view.put(start, w))
        if view.whole:
            return known, trial_of(machine, scheme, task, known, key)
        return first, played(machine, scheme, task, first, known, key)

    def turn(w):
        known, record = trial(w)
        after = learned_from(machine, scheme, known, record, key)
        found = bounded[0].limits(record) | bounded[1].limits(task, known, record)
        limits = {name: (signal / bound).ravel() for name, (signal, bound) in found.items()}
        return Turn(
            known_as(after, scheme, task, view), record.e[1:].ravel(), record.y.ravel(), limits
        )

    def from_record(w, e):
        known, record = trial(w)
        record = shown_of(machine, record, key)
        shown = record._replace(y=record.r - e.reshape(record.r.shape))
        return known_as(scheme.learn(known, shown), scheme, task, view)

    return Learning(view.of(start), turn, from_record)


def known_as(memory, scheme: Scheme, task: Task, view: View) -> jax.Array:
    """(n,) the vector w of a memory."""
    known = memory if view.whole else scheme.feedforward(memory, task)
    return view.of(ravel_pytree(known)[0])


def view_of(scheme: Scheme, task: Task) -> View:
    """What w is for a linear law."""
    if remembers(scheme, task):
        leaves = jax.tree.leaves(jax.eval_shape(lambda: scheme.initial_memory(task)))
        reach = np.asarray(_reach(scheme, task), float)
        told = (reach > 0) & np.isfinite(reach)
        bits = np.log2(reach, where=told, out=np.zeros(len(reach)))
        for part in np.split(np.arange(len(reach)), np.cumsum([x.size for x in leaves])[:-1]):
            apart = 10 * np.rint(bits[part] / 10)
            there = bits[part][told[part]]
            same = len(there) > 0 and np.ptp(there) < 10  # of one unit, as samples of an input are
            bits[part] = np.max(bits[part], where=told[part], initial=-np.inf) if same else apart
        bits = np.clip(bits, -FARTHEST, FARTHEST)
        units = tuple((2.0**bits).tolist()) if np.any(bits) else None
        return View(True, tuple(range(len(reach))), units)
    moves = _moves(scheme, task)
    return View(False, tuple(np.flatnonzero(moves if np.any(moves) else ~moves).tolist()))


@jax.jit
def _reach(scheme: Scheme, task: Task) -> jax.Array:
    """(n,) about how much input each entry of what a scheme knows makes, rms over signs.

    That is in the next trial, or else in the first one in which it makes any, by learning alone.
    """
    free = scheme.unlimited().prepared(task)
    first = free.initial_memory(task)
    known, unravel = ravel_pytree(first)
    u, pull = jax.vjp(lambda known: free.feedforward(unravel(known), task), known)

    def following(known):
        memory, y = unravel(known), jnp.zeros((task.N + 1, task.outputs), u.dtype)
        trial = free.record(free.feedforward(memory, task), y, task)
        return ravel_pytree(free.learn(memory, trial))[0].astype(known.dtype)

    def later(_, found):
        reach, pulled = found
        pulled = jax.vmap(back)(pulled)[0]
        return jnp.where(reach > 0, reach, jnp.sqrt(jnp.mean(pulled**2, axis=0))), pulled

    back = jax.vjp(following, known)[1]
    signs = jnp.asarray(np.random.default_rng(9).choice([-1.0, 1.0], (SIGNS, *u.shape)), u.dtype)
    pulled = jax.vmap(pull)(signs)[0]
    reach = jnp.sqrt(jnp.mean(pulled**2, axis=0))
    return lax.fori_loop(1, len(jax.tree.leaves(first)), later, (reach, pulled))[0]


def changes_nothing(scheme: Scheme, task: Task) -> bool:
    """Whether a linear law leaves what is played as it is, as one with a gain of 0 does."""
    return not remembers(scheme, task) and not np.any(_moves(scheme, task))


def _moves(scheme: Scheme, task: Task) -> np.ndarray:
    """(N n_w,) which samples learning changes.

    That is seen at a random input, where rounding counts as nothing, and at a random error, where
    nothing does: how much an error moves depends on units. For a linear law one such look at each
    is enough.
    """
    random, free = np.random.default_rng(7), scheme.unlimited()
    w = random.standard_normal(learned_shape(scheme, task))
    e = random.standard_normal((task.N, task.outputs))
    forgotten, learned = pushed(free, task, w, 0 * e) - w, pushed(free, task, 0 * w, e)
    moves = (np.abs(forgotten) > 1e-14 * np.abs(w).max()) | (learned != 0)
    return np.ravel(moves)


def limit_names(machines: Machine, scheme: Scheme, task: Task) -> list[str]:
    """The names of the limits that machines and scheme have. machines: with a leading axis."""
    return list(jax.eval_shape(jax.vmap(_limits, in_axes=(0, None, None)), machines, scheme, task))


def _limits(machine: Machine, scheme: Scheme, task: Task) -> dict[str, Limit]:
    """What the limits of machine and scheme act on in the first trial, by name."""
    first = scheme.initial_memory(task)
    trial = trial_of(machine.unlimited(), scheme.unlimited(), task, first)
    return machine.limits(trial) | scheme.limits(task, first, trial)


def slopes(f: Callable[..., T], *at: jax.Array) -> tuple[T, list[T]]:
    """f at vectors, and how each array (m,) of its result depends on each (n,) there, as (m, n)."""
    whole, unravel = ravel_pytree(at)
    here, push = jax.linearize(lambda x: f(*unravel(x)), whole)
    steep, ends = jax.vmap(push, out_axes=-1)(jnp.eye(whole.size)), np.cumsum([x.size for x in at])
    of_each = [slice(end - x.size, end) for end, x in zip(ends, at, strict=True)]
    return here, [jax.tree.map(lambda part, i=i: part[:, i], steep) for i in of_each]


# The maps of many machines
# --------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True, eq=False)
class LearningMaps(abc.ABC):
    """What is asked of the learning maps F of S machines, whose derivative is M.

    machines: with a leading axis of S
    view: what w is
    """

    machines: Machine
    scheme: Scheme
    task: Task
    view: View

    @abc.abstractmethod
    def norm(self, power: int) -> np.ndarray:
        """(S,) an upper bound of ||M^power||."""

    @abc.abstractmethod
    def late(self, power: int) -> np.ndarray:
        """(S,) a lower bound of ||M^power||."""

    @abc.abstractmethod
    def error_norm(self) -> np.ndarray:
        """(S,) an upper bound of ||I - G L||, of a scheme that keeps all that it has learned."""

    @abc.abstractmethod
    def limit(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Where learning goes: w_inf (S, n), |F(w_inf) - w_inf| (S,), the error there and its gain.

        The error is its root mean square (S,). The gain (S,) is an upper bound of how the error
        changes with w.
        """

    def leaves_nothing(self) -> np.ndarray:
        """(S,) whether a limit of learning surely has no error; False where that is not looked at.

        There L e = 0 of a law that keeps all that it has learned, so e = 0 where L has full rank.
        """
        return np.zeros(count_of(self.machines), bool)

    @abc.abstractmethod
    def radius(self) -> tuple[np.ndarray, np.ndarray]:
        """(S,) spectral radius of M where learning moves w, and its doubt (S,).

        An axis at rest, whose map stands apart from that of the others, does not count.
        """

    def drifts(self) -> list[str]:
        """[S] why learning grows with the number of trials, see `drifting`; empty if unknown."""
        return [""] * count_of(self.machines)

    @abc.abstractmethod
    def by_radius(self, which) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """What is known of M by its spectral radius, each (S,).

        It is this radius, about max_i ||M^i||, the first power that is seen to contract, and
        ||(I - M)^-1||. The radius is exact where M is triangular; otherwise it has its doubt added.
        The power is 0 where none is seen, and the others are infinite where the radius is not below
        1, and where `which` (S,) does not ask for them. The last one is infinite, too, where no
        power contracts, and where the growth is beyond the digits of the numbers, so that nobody
        could see learning converge.
        """

    @abc.abstractmethod
    def first_met(self, reach, room=None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The first trial that meets a limit, whether none ever is met, and which limit it is.

        Each is (S,). The trial is 0 where none was seen to meet a limit. reach: (S,) of `Decay`;
        room: (S, K) of the bounds that counts as all of them; None for all of it
        """


def ends_at_zero(maps: LearningMaps) -> np.ndarray:
    """(S,) of a law that keeps all: whether it does so where a trial begins with an error, too.

    If not, only the machines do whose trials begin without one.
    """
    scheme, task = maps.scheme, maps.task
    off = jax.vmap(starts_off, in_axes=(0, None, None))(maps.machines, scheme, task)
    return keeps_all(scheme, task, off=True) | ~np.asarray(off)


def maps_of(machines: Machine, scheme: Scheme, task: Task, steps: int = STEPS) -> LearningMaps:
    """The learning maps of each machine drawn. steps: of the Lanczos process, at most."""
    view = view_of(scheme, task)
    if len(view.moving) <= DENSE:
        return Matrices.of(machines, scheme, task, view)
    return Maps(machines, scheme, task, view, steps)


def in_groups(ask: Callable[[Machine, Task], T], machines: Machine, task: Task) -> T:
    """What is answered of all machines, asked in groups whose dense matrices fit into `ROOM`.

    The machines of a group have one task, that of the trials after the last change.
    """
    count, rows = count_of(machines), task.N * max(task.inputs, task.outputs)
    chunk = max(1, ROOM // (8 * rows**2)) if rows <= DENSE else count
    references = None if machines.variation is None else machines.variation.references
    lasts = None if references is None else np.asarray(references.values)[:, -1]
    chunk = chunk if lasts is None or np.all(lasts == lasts[0]) else 1
    groups = [slice(at, at + chunk) for at in range(0, count, chunk)]
    parts = []
    for at in groups:
        if lasts is not None:
            task = dataclasses.replace(task, reference=lasts[at.start])
        parts.append(ask(jax.tree.map(lambda leaf, at=at: leaf[at], machines), task))
    return jax.tree.map(lambda *several: np.concatenate(several), *parts) if parts[1:] else parts[0]


def count_of(machines: Machine) -> int:
    """S of machines with a leading axis."""
    return len(jax.tree.leaves(machines)[0])


def first_of(machines: Machine) -> Machine:
    """The first of several machines."""
    return jax.tree.map(lambda leaf: np.asarray(leaf)[0], machines)  # without a program a leaf


def alone(machines: Machine, i: int) -> Machine:
    """The machine i of several, with a leading axis of one."""
    return jax.tree.map(lambda leaf: np.asarray(leaf)[i : i + 1], machines)


# As matrices
# --------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True, eq=False)
class Matrices(LearningMaps):
    """F(w) = M w + c, e(w) = E w + e0, and what limits act on, T w + t, as matrices.

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
    of_all: the maps of every input; else None
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
    of_all: Matrices | None = None

    @classmethod
    def of(cls, machines: Machine, scheme: Scheme, task: Task, view: View) -> Matrices:
        """The matrices, by linearising each trial and its learning at the start."""
        found = tiled_with(_of_one, lanes=1, view=view)((scheme, task), machines)
        start, M, c, E, e0, T, t = jax.tree.map(np.asarray, found)
        both = zip(M, E, strict=True)
        usable = np.array([np.isfinite(M).all() and np.isfinite(E).all() for M, E in both])
        if not usable.all():  # nothing can be claimed of a machine whose numbers overflow
            M = np.where(usable[:, None, None], M, np.sqrt(np.finfo(M.dtype).max))
            E = np.where(usable[:, None, None], E, 0.0)
        c = np.nan_to_num(c)
        return cls(machines, scheme, task, view, start, M, c, E, e0, T, t)._reached()

    def _reached(self) -> Matrices:
        """These maps of the inputs that learning reaches, if some machine does not reach all."""
        moved = _apply(self.M, self.start) + self.c - self.start
        of_each = zip(self.M, moved, self._contracts(), strict=True)
        found = [None if contracts else reached(M, d) for M, d, contracts in of_each]
        if all(V is None for V in found):
            return self
        bases = [np.eye(self.M.shape[1]) if V is None else V for V in found]
        most = max(V.shape[1] for V in bases)
        basis = np.stack([np.pad(V, ((0, 0), (0, most - V.shape[1]))) for V in bases])
        basis = basis.astype(self.M.dtype)
        back = basis.swapaxes(1, 2)
        return dataclasses.replace(
            self,
            start=np.zeros((len(basis), most), self.start.dtype),
            M=back @ self.M @ basis,
            c=_apply(back, moved),
            E=self.E @ basis,
            e0=self.e0 + _apply(self.E, self.start),
            T={name: T @ basis for name, T in self.T.items()},
            t={name: t + _apply(self.T[name], self.start) for name, t in self.t.items()},
            basis=basis,
            origin=self.start,
            of_all=self,
        )

    def norm(self, power: int) -> np.ndarray:
        return self._norm if power == 1 else self._norm_of(power)

    @cached_property
    def _norm(self) -> np.ndarray:
        return self._norm_of(1)

    def _norm_of(self, power: int) -> np.ndarray:
        with np.errstate(over="ignore", invalid="ignore"):
            powers = np.linalg.matrix_power(self.M, power)
            return _norms(powers) * (1 + _wide(powers))

    def _contracts(self) -> np.ndarray:
        """(S,) whether ||M|| < 1: I - M is then regular, as |(I - M) w| >= (1 - ||M||) |w|."""
        return self.norm(1) < 1 - 2 * APART * np.finfo(self.M.dtype).eps

    def late(self, power: int) -> np.ndarray:
        return self.norm(power) * (1 - 2 * _wide(self.M))

    def leaves_nothing(self) -> np.ndarray:
        plain = self.basis is None and self.machines.variation is None
        if not (plain and keeps_all(self.scheme, self.task)):
            return super().leaves_nothing()
        L = self._law()
        if np.linalg.matrix_rank(L) < L.shape[1]:
            return super().leaves_nothing()
        return ends_at_zero(self)

    def _law(self) -> np.ndarray:
        return learning_law(self.scheme.unlimited(), self.task).L[list(self.view.moving)]

    def error_norm(self) -> np.ndarray:
        L = self._law()
        L = L if self.basis is None else self.basis.swapaxes(1, 2) @ L
        return _norms(np.eye(self.E.shape[1], dtype=L.dtype) + self.E @ L) * (1 + _wide(L))

    def limit(self):
        unit, limit = np.eye(self.M.shape[1]), np.zeros_like(self.c)
        of_each = zip(self.M, self.c, self._contracts(), strict=True)
        for i, (M, c, regular) in enumerate(of_each):
            held = unit - M
            limit[i] = np.linalg.solve(held, c) if regular else np.linalg.lstsq(held, c)[0]
        left = np.linalg.norm(_apply(self.M, limit) + self.c - limit, axis=1)
        error = np.sqrt(np.mean((_apply(self.E, limit) + self.e0) ** 2, axis=1))
        if self.basis is not None:
            limit = self.origin + _apply(self.basis, limit)
        return limit, left, error, _norms(self.E)

    def radius(self):
        moved = _apply(self.M, self.start) + self.c != self.start
        at = [reachable(M, moves) for M, moves in zip(self.M, moved, strict=True)]
        found = [radius_with_doubt(M[np.ix_(k, k)]) for M, k in zip(self.M, at, strict=True)]
        radius, doubt = np.array(found).T
        if self.of_all is not None:  # a basis hides which entries are zero, and moves an eigenvalue
            radius = np.fmin(radius, np.add(*self.of_all.radius()))
        return radius, doubt

    def drifts(self):
        if self.view.whole:
            return super().drifts()
        if self.of_all is not None:
            return self.of_all.drifts()
        L, found = self._law(), []
        r = np.linalg.norm(self.task.reference)
        moved = _apply(self.M, self.start) + self.c - self.start
        for M, push, E, e0 in zip(self.M, moved, self.E, self.e0, strict=True):
            at = reachable(M, push != 0)
            least = float(DRIFT * np.linalg.norm(E) * np.linalg.norm(L) * (r + np.linalg.norm(e0)))
            some = M[np.ix_(at, at)], push[at], E[:, at], L[at]
            found.append(drifting(*some, least=least, outputs=self.task.outputs))
        return found

    def by_radius(self, which):
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
        T, t = (np.concatenate(list(of.values()), axis=1) for of in (self.T, self.t))
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
            met[open_[beyond]] = j
            clear[open_] = ~beyond & np.all(later <= 1, axis=1) & np.isfinite(top)
            left = ~beyond & ~clear[open_]
            open_, w = open_[left], following[left]
            if not len(open_):
                break
        return met, clear, which


def _of_one(common, machine, *, view: View):
    scheme, task = common
    found = learning_of(machine, scheme, task, view)
    w = found.start

    def asked(w):
        following, error, _, limits = found.turn(w)
        return following, error, limits

    here, (steep,) = slopes(asked, w)
    offset = jax.tree.map(lambda value, slope: value - slope @ w, here, steep)
    (M, E, T), (c, e0, t) = steep, offset
    return w, M, c, E, e0, T, t


def _apply(matrices, vectors) -> np.ndarray:
    """(S, m) the products of S matrices (S, m, n) and vectors (S, n)."""
    return np.einsum("sij,sj->si", matrices, vectors)


def _norms(matrices) -> np.ndarray:
    """(S,) their norms, of their precision; infinite where a matrix overflows."""
    return np.array([norm_of(M) for M in matrices], matrices.dtype)


def _wide(matrices) -> float:
    return max(WIDE, ROUNDING * float(np.finfo(matrices.dtype).eps))


# Without a matrix
# --------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True, eq=False)
class Maps(LearningMaps):
    """The learning maps by what they do to a vector.

    steps: largest number of steps of the Lanczos process
    """

    steps: int = STEPS

    def norm(self, power: int) -> np.ndarray:
        most = self.steps if power == 1 else FEW
        return self._bounded(_norm_of_power, most, jnp.asarray(power))

    def late(self, power: int) -> np.ndarray:  # the length that a random unit vector gets
        return np.nan_to_num(self._asked(_of_random, jnp.asarray(power)), nan=np.inf)

    def error_norm(self) -> np.ndarray:
        about = self.scheme, self.task
        return self._bounded(_error_norm, self.steps, about, moving=self.view.moving)

    def limit(self):
        return tuple(map(np.asarray, self._asked(_limit)))

    def radius(self):
        # Where it seems to be above 1, a doubt of first order says little of an M far from normal,
        # as that of a causal law is: its matrix decides. The doubt is infinite where that would
        # have more than 1024 rows, and on a backend without `eig`.
        count = count_of(self.machines)
        if jax.default_backend() != "cpu":
            return np.zeros(count), np.full(count, np.inf)
        radius, doubt = map(np.array, self._asked(_radius, lanes=4))
        for i in np.flatnonzero(radius - doubt > 1):
            doubt[i] = np.inf
            if len(self.view.moving) <= LARGEST:
                one = alone(self.machines, i)
                matrix = Matrices.of(one, self.scheme, self.task, self.view)
                radius[i], doubt[i] = (float(x[0]) for x in matrix.radius())
        return radius, doubt

    def by_radius(self, which):  # without the matrix the radius is no proof
        unknown = np.full(len(which), np.inf)
        return unknown, unknown, np.zeros(len(which), int), unknown

    def first_met(self, reach, room=None):
        room = np.ones((count_of(self.machines), 1)) if room is None else room
        each = jnp.asarray(reach), jnp.asarray(room)
        return tuple(map(np.asarray, self._asked(_first_met, None, *each)))

    def _bounded(self, function, most: int, about, **options) -> np.ndarray:
        """(S,) upper bounds of a norm.

        They are computed in few steps, and in more where these do not tell whether the norm is
        below 1.
        """
        bound = np.zeros(0)
        for steps in (FEW, most):
            found = self._asked(function, about, steps=steps, **options)
            value, bound = (np.nan_to_num(x, nan=np.inf) for x in found)
            if most <= FEW or not np.any((value < 1) & (bound >= 1)):
                break
        return bound

    def _asked(self, function, about=None, *of_each, lanes: int | None = None, **options):
        """What a function answers for each machine.

        about: its second argument, the same for all machines, after the `Learning` of one
        of_each: further ones, with a leading axis of S
        """
        size = len(self.view.moving)
        room = max(1, TILE // (16 * min(options.get("steps", FEW), size) * size))
        options |= {"lanes": lanes or min(usual_lanes() or room, room), "function": function}
        run = tiled_with(_answer, view=self.view, **options)
        return run((self.scheme, self.task, about), (self.machines, *of_each))


def _answer(common, one, *, function: Callable, view: View, **options):
    (scheme, task, about), (machine, *of_it) = common, one
    return function(learning_of(machine, scheme, task, view), about, *of_it, **options)


def _norm_of_power(found: Learning, power, *, steps: int):
    _, push = jax.linearize(found.following, found.start)
    pull = jax.linear_transpose(push, found.start)
    forth = lambda v: lax.fori_loop(0, power, lambda _, v: push(v), v)  # noqa: E731
    back = lambda w: lax.fori_loop(0, power, lambda _, w: pull(w)[0], w)  # noqa: E731
    norm = largest(forth, back, found.start, found.start.size, steps=steps, tolerance=0.0)
    return norm.value, norm.bound


def _of_random(found: Learning, power):
    _, push = jax.linearize(found.following, found.start)
    v = jax.random.normal(jax.random.key(2), found.start.shape, found.start.dtype)
    return jnp.linalg.norm(lax.fori_loop(0, power, lambda _, v: push(v), v / jnp.linalg.norm(v)))


def _error_norm(found: Learning, about, *, steps: int, moving: tuple[int, ...]):
    scheme, task = about
    free, at = scheme.unlimited().prepared(task), jnp.zeros((task.N, task.outputs))
    memory = free.initial_memory(task)
    learned = free.feedforward(memory, task)

    def following(e):
        w = next_learned(free, task, memory, learned, e.reshape(at.shape)).ravel()
        return e + found.error(w[np.array(moving)])

    norm = singular_value(following, at.ravel(), steps=steps, tolerance=0.0)
    return norm.value, norm.bound


def _limit(found: Learning, _):
    """Where the map goes: the residual over a Krylov space is minimised a few times in turn."""
    _, push = jax.linearize(found.following, found.start)

    def closer(_, w):
        residual = found.following(w) - w
        V, H = krylov(lambda v: v - push(v), residual, min(FEW, w.size))
        first = jnp.zeros(len(H)).at[0].set(jnp.linalg.norm(residual))
        return w + jnp.linalg.lstsq(H, first)[0] @ V[:-1]

    w = lax.fori_loop(0, ROUNDS, closer, found.start)
    following, error, *_ = found.turn(w)
    left = jnp.linalg.norm(following - w)
    return w, left, jnp.sqrt(jnp.mean(error**2)), _gain(found.error, found.start)


def _radius(found: Learning, _):
    moved = found.following(found.start) - found.start  # what lies apart from it never moves
    radius = spectral_radius_of(found.following, found.start, steps=FEW, begin=moved)
    return radius.value, radius.doubt


def _first_met(found: Learning, _, reach, room):
    sizes = [x.size for x in jax.eval_shape(found.turn, found.start).limits.values()]
    acted = lambda limits: jnp.concatenate([*limits.values()]) / room  # noqa: E731
    gain = _gain(lambda w: acted(found.turn(w).limits), found.start)

    def look(now):
        j, w, met, _, _ = now
        following, _, _, limits = found.turn(w)
        of_each = jnp.split(jnp.abs(acted(limits)), np.cumsum(sizes)[:-1])
        top = jnp.stack([jnp.max(one) for one in of_each])
        moved = jnp.linalg.norm(following - w)
        later = jnp.max(top) + gain * jnp.where(moved > 0, reach * moved, 0.0)
        met = jnp.where(~(jnp.max(top) <= 1), j, met)
        return j + 1, following, met, later <= 1, jnp.argmax(top)

    def going_on(now):
        j, _, met, clear, _ = now
        return (met == 0) & ~clear & (j <= MOST)

    start = (jnp.asarray(1), found.start, jnp.asarray(0), jnp.asarray(False), jnp.asarray(0))
    _, _, met, clear, which = lax.while_loop(going_on, look, start)
    return met, clear & (met == 0), which


def _gain(f, w):
    """An upper bound of the norm of the derivative of f at w."""
    return singular_value(f, w, steps=FEW, tolerance=0.0).bound
