"""How far from its limit learning is held by what a machine rounds, and by its hysteresis.

An encoder of step a shows y + d with |d| <= a / 2 in each sample, and a converter plays u + d
likewise. A machine that rounds is thus the one of `Machine.unrounded`, with a disturbance d in each
trial that may be any within its bounds. Hysteresis at the input of a linear plant is one as well:
u - z drives the plant, and a trial that begins with z within the limit of its law never leaves it
(of one that is integrated in steps, Bouc-Wen's with an exponent, that is not proved). In units of
half a step and of that limit, |d| <= 1 in each of m entries,

    w_{j+1} = M w_j + c + D d_j,    e_j = E w_j + e_0 + F d_j,    what limits act on: T w + t + G d

So what is claimed of M holds up to a ball: with x_j = sum_i M^i D d_{j-i}, the distance from the
limit is at most that of the machine that does not round, and |x_j|. It falls in every trial down to
sqrt(m) ||D|| / (1 - ||M||), where ||M|| < 1. The sum is taken in blocks of 1, 1, 2, 4, ... powers,

    sum over n trials of |R M^n M^i D d_i| <= sqrt(n m ||R M^n W M^n^T R^T||),    R = 1, E or T
    W = sum_{i < n} M^i D D^T M^i^T,    of twice as many: W + M^n W M^n^T

by the inequality of Cauchy and Schwarz, until p = ||M^n|| < 1 is small: what follows adds at most
p / (1 - p) times the sum so far. What the rounding of these numbers themselves may do is added.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from ..learning.machine import Machine
from ..learning.variation import Variation
from ..plants import Dahl, InputHysteresis
from ..pytree.aliases import Leaf
from ..pytree.fields import child, leaf, pytree
from ..pytree.in_short import in_short
from ..runtime.tiles import tiled_with
from ..schemes import Scheme
from ..schemes.scheme import Memory, Schedule, State, Wrapper
from ..signals.task import Limit, Sample, Task, Trial
from .learning_map import View, alone, count_of, learning_of, slopes
from .spectrum import reached
from .trials import disturbed, with_plant_within

OF = {"sensor": "rounding", "converter": "rounding", "hysteresis": "hysteresis"}
BEGINS_OFF = (
    "InputHysteresis bounds what it takes from the input where a trial begins within its limit, "
    "and variation.{} moves its state; give that of the start to the plant within it (x0)"
)
LARGEST = 1024  # inputs up to which rounding is followed
FEW = 32  # powers that are looked at one by one
FULL = 256  # rows up to which eigenvalues are computed, and limits looked at one by one
STEPS = 60  # of Lanczos's method
CHANCE = 1e-9  # with which a bound found by it may be wrong
LEAST = 1e-12  # share of a vector that counts as nothing
DOUBLINGS = 40  # of the number of trials, at most
SMALL = 0.03  # share of the ball that what follows may add, before the sum is ended
WITHIN = 1e-9  # share of D that may lie outside of what learning reaches


class Ball(NamedTuple):
    """How far this may hold S machines from where learning would go; infinite if not known.

    of:      (S,) what does: "rounding", "hysteresis" or "rounding with hysteresis"
    error:   (S,) root mean square error by which it may differ from that at the limit
    learned: (S,) distance of what is learned from its limit
    limits:  (S, K) by how much it may move what limits act on, in units of their bounds
    of_learning: (S,) distance by which one trial may move what is learned
    of_error: (S,) root mean square by which this moves the error of the next trial
    shown:   (S,) root mean square error that is not there, or not learned, in one trial
    """

    of: np.ndarray
    error: np.ndarray
    learned: np.ndarray
    limits: np.ndarray
    of_learning: np.ndarray
    of_error: np.ndarray
    shown: np.ndarray
    __repr__ = in_short

    def until(self, of_error, sigma) -> np.ndarray:
        """(S,) the size down to which the error, or the distance from the limit, surely falls.

        of_error: (S,) whether it is the root mean square error; if not, the distance
        sigma:    (S,) factor by which it would fall in every trial, or below
        """
        falls = np.where(sigma < 1, sigma, np.nan)
        in_error = self.of_error + (1 + falls) * self.shown
        return np.where(of_error, in_error, self.of_learning) / (1 - falls)


def off_linear(machine: Machine) -> tuple[str, ...]:
    """The names of what keeps a machine from being linear, by a bounded disturbance."""
    parts = {"sensor": machine.sensor, "converter": machine.actuator}
    names = [name for name, of in parts.items() if getattr(of, "resolution", None) is not None]
    if _bounded_hysteresis(machine) and not begins_off(machine):
        names.append("hysteresis")
    return tuple(names)


def begins_off(machine: Machine) -> str:
    """Why the hysteresis of a machine is no bounded disturbance; empty where it may be one."""
    given = machine.variation or Variation()
    names = [name for name in ("offset", "scatter") if getattr(given, name) is not None]
    return BEGINS_OFF.format(names[0]) if names and _bounded_hysteresis(machine) else ""


def _bounded_hysteresis(machine: Machine) -> bool:
    plant = machine.plant
    return isinstance(plant, InputHysteresis) and (
        isinstance(plant.hysteresis, Dahl) or plant.hysteresis.exponent is None
    )


def linear_part(machine: Machine) -> Machine:
    """The machine without that."""
    still = machine.unrounded()
    return with_plant_within(still) if "hysteresis" in off_linear(machine) else still


def ball_of(machines: Machine, scheme: Scheme, task: Task, view: View) -> Ball | None:
    """The ball of each machine; None where nothing is rounded. machines: with a leading axis.

    The premises of `linearity` are to hold of the linear part of the machines.
    """
    names, count = off_linear(machines), count_of(machines)
    if not names:
        return None
    of = np.full(count, " with ".join(dict.fromkeys(OF[name] for name in names)), object)
    if len(view.moving) > LARGEST:
        unknown = np.full(count, np.inf)
        return Ball(of, unknown, unknown, np.full((count, 1), np.inf), unknown, unknown, unknown)
    parts_of, found = tiled_with(_parts, lanes=1, view=view, names=names), []
    for i in range(count):  # the matrices of one alone are large
        parts = parts_of((scheme, task), alone(machines, i))
        with np.errstate(over="ignore", invalid="ignore"):
            found.append(_ball(_shapes(names, task), *(np.asarray(part)[0] for part in parts)))
    return Ball(of, *map(np.array, zip(*found, strict=True)))


# Of one machine
# --------------------------------------------------------------------------------------------------


def _ball(shapes: list[tuple[int, int]], moved, M, D, E, F, T, G) -> tuple:
    eps, far, share = np.finfo(M.dtype).eps, len(T) - 1, 1 / np.sqrt(len(E))
    ends = np.cumsum(np.prod(shapes, axis=1))[:-1]
    M, D, E, F, T, G = (np.asarray(part, float) for part in (M, D, E, F, T[1:], G[1:]))
    of_each = [np.split(part, ends, axis=1) for part in (D, E @ D, F)]
    moves, of_error, shown = (sum(map(_furthest, each)) for each in of_each)
    at_once = moves, share * of_error, share * shown
    V = reached(M, moved)
    if V is not None:
        inside = V.T @ D
        if np.linalg.norm(D - V @ inside) > WITHIN * np.linalg.norm(D):
            return np.inf, np.inf, np.full(far, np.inf), *at_once
        M, D, E, T = V.T @ M @ V, inside, E @ V, T @ V
    learned, error, acted = _sums(M, D, E, T, _weights(of_each[0]), eps)
    acted = acted + np.abs(G).sum(axis=1)
    return share * (error + shown), learned, acted, *at_once


def _furthest(matrix) -> float:
    """A bound of the length of matrix @ d."""
    each = np.linalg.norm(np.abs(matrix).sum(axis=1))
    return min(np.sqrt(matrix.shape[1]) * _norm(matrix), float(each))


def _weights(parts) -> np.ndarray:
    """(m,) t with which |[D_1 / t_1, D_2 / t_2, ...]| |t| is at most the sum of |D_i| sqrt(m_i)."""
    norms = np.array([_norm(part) for part in parts])
    norms = np.maximum(norms, LEAST * np.max(norms)) if np.any(norms) else norms + 1.0
    counts = [part.shape[1] for part in parts]
    return np.repeat(np.sqrt(norms / np.sqrt(counts)), counts)


def _sums(M, D, E, T, weights, eps: float) -> tuple[float, float, np.ndarray]:
    """Bounds of |x| and |E x|, and of each |T x|.

    weights: (m,) of the entries of d, whose inverse D is multiplied by
    What limits act on is summed row by row, power by power, as long as there are few.
    """
    X, D = D, D * (np.linalg.norm(weights) / weights)  # so that |d| <= 1
    W, P, trials = D @ D.T, M, 1
    learned, error, acted = _norm(D), _norm(E, D), np.abs(T @ X).sum(axis=1)
    of_E, of_T, size, top = _norm(E), np.linalg.norm(T, axis=1), _norm(M), _norm(D) ** 2
    off, of_W = eps * len(M) * size, eps * len(M) * top  # how wrong P and W may be
    for _ in range(DOUBLINGS):
        later = P @ W @ P.T
        if not np.all(np.isfinite(later)):
            break
        off_twice = 2 * size * off + off**2 + eps * len(M) * size**2
        wrong = off_twice * top + size**2 * of_W
        largest = _top(later) + wrong
        learned += np.sqrt(trials * largest)
        error += np.sqrt(trials * (_top(E, later, E.T) + of_E**2 * wrong))
        if len(T):
            sizes = np.maximum(np.sum((T @ later) * T, axis=1), 0.0)
            rows = np.sqrt(trials * (sizes + of_T**2 * wrong))
            if trials < FEW and len(M) <= FULL:
                one_by_one = 0.0
                for _ in range(trials):
                    X = M @ X
                    one_by_one = one_by_one + np.abs(T @ X).sum(axis=1)
                rows = np.minimum(rows, one_by_one)
            acted = acted + rows
        W, top, of_W, trials = W + later, top + largest, of_W + wrong, 2 * trials
        P, off = P @ P, off_twice
        size = _norm(P)
        p = size + off
        if p < 1 and of_E * learned * p / (1 - p) <= SMALL * error:
            after = learned * p / (1 - p)
            return learned + after, error + of_E * after, acted + of_T * after
    return np.inf, np.inf, np.full(len(T), np.inf)


def _norm(*factors) -> float:
    """A bound of the norm of a product of matrices."""
    back = [factor.T for factor in reversed(factors)]
    rows, columns = len(factors[0]), factors[-1].shape[1]
    return float(np.sqrt(_top(*factors, *back) if rows < columns else _top(*back, *factors)))


def _top(*factors) -> float:
    """A bound of the largest eigenvalue of a product that is symmetric, with none below zero.

    Large ones are bounded by Lanczos's method from a random start, as in `spectrum.largest`.
    """
    n = len(factors[0])
    if not n or not all(np.all(np.isfinite(factor)) for factor in factors):
        return np.inf if n else 0.0
    if n <= FULL:
        whole = np.linalg.multi_dot([*factors, np.eye(n)])
        return (
            max(float(np.linalg.eigvalsh(whole)[-1]), 0.0) if np.isfinite(whole).all() else np.inf
        )
    V, H = np.zeros((STEPS, n)), np.zeros((STEPS, STEPS))
    v = np.random.default_rng(4).standard_normal(n)
    excess = (np.log(1.648 * np.sqrt(n) / CHANCE) / (2 * STEPS - 1)) ** 2
    for k in range(STEPS):
        V[k] = v = v / np.linalg.norm(v)
        for factor in reversed(factors):
            v = factor @ v
        size = np.linalg.norm(v)
        if not np.isfinite(size):
            return np.inf
        for _ in range(2):
            along = V[: k + 1] @ v
            H[: k + 1, k] += along
            v = v - along @ V[: k + 1]
        if np.linalg.norm(v) <= LEAST * size:
            excess = 0.0
            break
    value = np.linalg.eigvalsh(H[: k + 1, : k + 1], UPLO="U")[-1]
    return max(float(value), 0.0) / (1 - excess) * (1 + LEAST)


# By the programs of machine and law
# --------------------------------------------------------------------------------------------------


@pytree
class _Adding(Wrapper):
    """A scheme to whose commands something is added on the way to the machine.

    added: (N, n_u)
    """

    scheme: Scheme = child()
    added: Leaf = leaf()

    @property
    def plays_back(self) -> bool:
        return False

    def schedule(self, memory: Memory, task: Task) -> Schedule:
        return self.scheme.schedule(memory, task), self.added

    def play(self, learned: jax.Array, memory: Memory, task: Task) -> Schedule:
        return self.scheme.play(learned, memory, task), self.added

    def act(self, state: State, sample: Sample) -> tuple[State, jax.Array]:
        row, added = sample.row
        state, u = self.scheme.act(state, sample._replace(row=row))
        return state, u + added

    def limits(self, task: Task, memory: Memory, trial: Trial) -> dict[str, Limit]:
        return self.scheme.limits(task, memory, trial)


def _shapes(names: tuple[str, ...], task: Task) -> list[tuple[int, int]]:
    """Of the disturbance in a trial that stands for what each of these does."""
    of_input, of_output = (task.N, task.inputs), (task.N + 1, task.outputs)
    return [of_output if name == "sensor" else of_input for name in names]


def _parts(common, machine, *, view: View, names: tuple[str, ...]) -> tuple:
    """F(w_1) - w_1 and the matrices M, D, E, F, T, G of a machine, in units of half a step."""
    scheme, task = common
    still = linear_part(machine)
    start = learning_of(still, scheme, task, view).start
    none, unravel = ravel_pytree([*map(jnp.zeros, _shapes(names, task))])

    def at(w, d):
        one, acting = still, scheme
        for name, part in zip(names, unravel(d), strict=True):
            if name == "sensor":
                one = disturbed(one, "output", 0.5 * machine.sensor.resolution * part)
            elif name == "converter":
                acting = _Adding(scheme, 0.5 * machine.actuator.resolution * part)
            else:
                limit = machine.at_trial(task, None)[0].plant.hysteresis.limit
                one = disturbed(one, "input", limit * part)
        following, error, _, limits = learning_of(one, acting, task, view).turn(w)
        limits = [jnp.zeros(1), *limits.values()]  # never empty, as `tiled` needs
        return following, error, jnp.concatenate(limits)

    (following, *_), ((M, E, T), (D, F, G)) = slopes(at, start, none)
    return following - start, M, D, E, F, T, G
