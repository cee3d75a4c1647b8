"""Contraction of any scheme without a matrix: one trial and its learning as a map, its gain and growth by Lanczos and Arnoldi.

    memory -> trial -> next memory          `learning_map`: all a scheme knows, estimates included, or the parts of it that are named
    e_j -> e_{j+1}, ..., e_{j+J}            `error_map`: what becomes of the error of a trial; I - G L for a linear law, in any scheme

Both are differentiated through the simulator, forward (`jvp`) and backward (`vjp`), at the cost of a trial each. Nothing is assumed of
the scheme: it may adapt, switch and be nonlinear. What is found is then true near the memory it was found at. All functions down to
`over_plants` are pure and may be vmapped over machines.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from ..batch import tiled
from ..learning import check
from ..machine import Disturbance, Machine
from ..pytree import named_leaves, part, pytree
from ..schemes import Scheme
from ..signals import Task
from ..trial import run_trial
from ..uncertainty import Uncertainty, drawn_machine
from .condition import Condition, Premise, condition, departure, is_linear, premise, ratio
from .lifted import MARGIN, noiseless

LEARNED = 3  # trials before the map is taken: by then an adaptive scheme of two-trial increments has seen data
BLOCK = 10  # Lanczos steps to the first look at the residual; later looks are further apart
FIXED = 1e-6  # by how much of itself a trial may move a memory that counts as a fixed point
ROUNDING = 100.0  # in units of the last place
FLAGS = ("seen",)  # leaves of a memory that are no state: they only tell the first trial from the others
OF_OUTPUT = ("y",)  # leaves of a memory that have the unit of the output

CONTRACTION = "largest singular value of the learning map < 1: it contracts in the 2-norm of the weighted memory (Banach), {where}"
ERROR = "sup |e_(j+{n})| / |e_j| < 1 over all small changes of the error: the 2-norm of the error contracts in {n} trial(s), {where}"
ATTRACTION = "spectral radius of the learning map < 1: its fixed point attracts (Ostrowski 1960; linear: Bristow 2006), {where}"
EVERYWHERE, NEARBY = "everywhere, as the map is affine", "near the memory at which it is linearised"


class Map(NamedTuple):
    """A map and where to linearise it. f: (n,) -> (m,) or (J, m);  at: (n,)"""

    f: Callable[[jax.Array], jax.Array]
    at: jax.Array


@jax.jit
def _trial(machine, scheme, task, memory):
    """A trial without noise."""
    return run_trial(noiseless(machine), scheme, task, memory, jax.random.key(0))


def step(machine: Machine, scheme: Scheme, task: Task, memory):
    """The memory after one more trial, without noise."""
    return scheme.learn(memory, _trial(machine, scheme, task, memory))


@partial(jax.jit, static_argnames="trials")
def learned_memory(machine: Machine, scheme: Scheme, task: Task, trials: int = LEARNED):
    """The memory after so many trials from the start, without noise."""
    scheme = scheme.prepared(task)
    return lax.fori_loop(0, trials, lambda _, memory: step(machine, scheme, task, memory), scheme.memory(task))


def learning_map(
    machine: Machine,
    scheme: Scheme,
    task: Task,
    memory: Any = None,
    *,
    leaves: tuple[str, ...] | None = None,
    weights: Mapping[str, Any] | None = None,
) -> Map:
    """One trial and its learning, as a map on the weighted memory.

    memory: where to linearise, None for that after 3 trials
    leaves: names of what varies, all else held ("u"; "learning.phi", which is all of phi[0], phi[1], ...); None for all but flags.
            ("u", "y") of MFAILC leaves out its estimates. It matters: at a fixed point without error nothing moves phi, so the
            full map has the eigenvalue 1 there, once for each phi that no reset holds. Its u alone says nothing, as y goes with it.
    weights: {name: number} by which leaves are multiplied before they are compared, as u, y and phi have different units. Spectral
            radii do not depend on them, singular values do. Without one, a leaf is brought to the size of the output by
            rms(y) / rms(leaf), or by 1 if either is zero; `y` keeps its unit. The longest name that fits a leaf counts.
    Raises ValueError for a name that the memory has not, or a memory without anything that varies.
    """
    scheme = scheme.prepared(task)
    memory = learned_memory(machine, scheme, task) if memory is None else memory
    found = named_leaves(memory)
    names, values = list(found), [jnp.asarray(v) for v in found.values()]
    for name in (*(leaves or ()), *(weights or ())):
        if not any(_names(name, of) for of in names):
            raise ValueError(f"learning_map: {name!r} is not in this memory; known: {', '.join(names) or 'nothing'}")
    varies = [any(_names(name, of) for name in leaves) if leaves is not None else of.split(".")[-1] not in FLAGS for of in names]
    varies = [v and jnp.issubdtype(value.dtype, jnp.floating) for v, value in zip(varies, values, strict=True)]
    if not any(varies):
        raise ValueError(f"learning_map: the memory of {type(scheme).__name__} has no floating leaf that varies")
    size_y = _rms(_trial(machine, scheme, task, memory).y)
    scales = [_weight(of, value, weights or {}, size_y) for of, value in zip(names, values, strict=True)]
    shape = jax.tree.structure(memory)

    def flat(of_memory):
        return jnp.concatenate([(w * v).ravel() for v, w, free in zip(jax.tree.leaves(of_memory), scales, varies, strict=True) if free])

    def unflat(x):
        rest, at = [], 0
        for value, w, free in zip(values, scales, varies, strict=True):
            rest.append(x[at : at + value.size].reshape(value.shape) / w if free else value)
            at += value.size if free else 0
        return shape.unflatten(rest)

    return Map(lambda x: flat(step(machine, scheme, task, unflat(x))), flat(memory))


def error_map(machine: Machine, scheme: Scheme, task: Task, memory: Any = None, *, trials: int = 1) -> Map:
    """From the error e[1..N] of a trial, (N n_y,), to that of each of the next `trials` trials, (J, N n_y).

    Another error comes with the repetitive disturbance of the output that causes it, which then stays: it is the error, not the
    input, that is prescribed. That trial is run with the prescribed output fed back, so nothing has to be inverted. For a linear law
    under a linear loop G the derivative is (I - G L)^j; a scheme that adapts learns from the change as well, and that counts.
    memory: with which the trial is entered, None for that after 3 trials
    """
    scheme = scheme.prepared(task)
    memory = learned_memory(machine, scheme, task) if memory is None else memory
    r, first = jnp.asarray(task.reference), _trial(machine, scheme, task, memory)

    def f(e):
        y = jnp.concatenate([first.y[:1], r[1:] - e.reshape(task.N, -1)])
        trial = _trial(machine, _Prescribed(scheme), task, (memory, y))
        disturbed = _with_output(machine, y - trial.y)

        def following(memory, _):
            trial = _trial(disturbed, scheme, task, memory)
            return scheme.learn(memory, trial), trial.e[1:].ravel()

        return lax.scan(following, scheme.learn(memory, trial._replace(y=y)), length=trials)[1]

    return Map(f, first.e[1:].ravel())


class SingularValue(NamedTuple):
    """value: () largest singular value, never above the true one;  residual: () |J^T u - value v|, within which a singular value lies
    steps: () of the Lanczos process;  direction: (n,) v, the unit change that grows most"""

    value: jax.Array
    residual: jax.Array
    steps: jax.Array
    direction: jax.Array


def singular_value(f: Callable, at, *, steps: int = 300, tolerance: float = 1e-6, row=None) -> SingularValue:
    """The largest singular value of the derivative J of f at a point, by Golub-Kahan-Lanczos bidiagonalisation.

        J V = U B,  J^T U = V B^T + beta v e^T     with U, V orthonormal (reorthogonalised in full, twice) and B bidiagonal

    f, at: a `Map`;  steps: at most, and at most n;  tolerance: on residual / value, looked at now and then
    row: of an f with values (J, m), the trial to look at, counted from 0; None for all of the values
    J is linearised once; a step costs one `jvp` and one `vjp`. Storage: two (steps, n) arrays. Residuals overstate the error of the
    value where singular values lie apart; where they cluster (long trials), the value is found long before the vector.
    """
    here, push = jax.linearize(f, at)
    pull = jax.linear_transpose(push, at)
    pick = (lambda out: out.ravel()) if row is None else (lambda out: out[row])
    place = (lambda w: w.reshape(here.shape)) if row is None else (lambda w: jnp.zeros_like(here).at[row].set(w))
    m, n = pick(here).size, at.size
    steps = min(steps, n, m)

    def fresh(x, basis):
        """The direction that x adds to the basis, and how much; what rounding left over is no direction."""
        scale = jnp.linalg.norm(x)
        for _ in range(2):
            x = x - (basis @ x) @ basis
        size = jnp.linalg.norm(x)
        size = jnp.where(size > ROUNDING * jnp.finfo(x.dtype).eps * scale, size, 0.0)
        return jnp.where(size > 0, x / jnp.where(size > 0, size, 1.0), 0.0), size

    def advance(i, now):
        U, V, alpha, beta = now
        u, size = fresh(pick(push(V[i])), U)
        U, alpha = U.at[i].set(u), alpha.at[i].set(size)
        v, size = fresh(pull(place(u))[0], V)
        return U, V.at[i + 1].set(v), alpha, beta.at[i].set(size)

    def ritz(now, k):
        _, V, alpha, beta = now
        built = jnp.arange(steps) < k
        alpha, above = jnp.where(built, alpha, 0.0), jnp.where(built, beta, 0.0)
        B = jnp.diag(alpha) + jnp.diag(above[:-1] * built[1:], 1)
        squares, left = jnp.linalg.eigh(B @ B.T)  # many times as fast as an SVD, and as exact for the largest one
        value, left = jnp.sqrt(jnp.maximum(squares[-1], 0.0)), left[:, -1]
        right = B.T @ left / jnp.where(value > 0, value, 1.0)
        return value, above[k - 1] * jnp.abs(left[k - 1]), right @ V[:-1]

    def more(now):
        _, k, (value, residual, _) = now
        return (k < steps) & ~(residual <= tolerance * value) & jnp.isfinite(value)

    def work(now):
        state, k, _ = now
        upto = jnp.minimum(k + BLOCK + k // 4, steps)
        state = lax.fori_loop(k, upto, advance, state)
        return state, upto, ritz(state, upto)

    start = jax.random.normal(jax.random.key(0), (n,), at.dtype)
    V = jnp.zeros((steps + 1, n), at.dtype).at[0].set(start / jnp.linalg.norm(start))
    state = (jnp.zeros((steps, m), at.dtype), V, jnp.zeros(steps, at.dtype), jnp.zeros(steps, at.dtype))
    unknown = (jnp.zeros((), at.dtype), jnp.full((), jnp.inf, at.dtype), jnp.zeros(n, at.dtype))
    _, k, (value, residual, direction) = lax.while_loop(more, work, (state, jnp.asarray(0), unknown))
    return SingularValue(value, residual, k, direction)


class SpectralRadius(NamedTuple):
    """value: () |theta| of the dominant Ritz value;  residual: () |J x - theta x| for its unit vector x
    doubt: () residual, or rounding, over the cosine between left and right eigenvector: by how much theta may be off to first order
    steps: of the Arnoldi process"""

    value: jax.Array
    residual: jax.Array
    doubt: jax.Array
    steps: int


def spectral_radius_of(f: Callable, at, *, steps: int = 100) -> SpectralRadius:
    """The spectral radius of the derivative J of f at a point, real or complex eigenvalues, by Arnoldi's process.

        J V = V H + h v e^T,  V orthonormal: eigenvalues of the (steps, steps) matrix H

    f, at: a `Map` onto itself;  steps: at most n; with n it is exact up to rounding. Needs a backend that has `eig`, as the CPU has
    A second process on J^T gives the left eigenvector. Learning maps without a filter are far from normal: for I - gamma G any few
    steps, and rounding alone, show values near sup |1 - gamma z P| and not the one eigenvalue 1 - gamma C B; `doubt` is then large.
    """
    _, push = jax.linearize(f, at)
    pull = jax.linear_transpose(push, at)
    steps = min(steps, at.size)
    theta, x, residual, size = _arnoldi(push, at, steps, None)
    _, w, residual_left, _ = _arnoldi(lambda y: pull(y)[0], at, steps, theta)
    cosine = jnp.abs(jnp.sum(w * x))  # of J^T w = theta w, so without a conjugate
    rounding = MARGIN * jnp.finfo(at.dtype).eps * size
    doubt = jnp.maximum(jnp.maximum(residual, residual_left), rounding) / jnp.maximum(cosine, jnp.finfo(at.dtype).tiny)
    return SpectralRadius(jnp.abs(theta), residual, doubt, steps)


def error_growth(f: Callable, at, trials: int, *, steps: int = 300, tolerance: float = 1e-6) -> SingularValue:
    """The largest |e_{j+i}| / |e_j| for i = 1..J: fields with a leading axis of J. f, at: an `error_map` over J `trials`"""
    return lax.map(lambda row: singular_value(f, at, steps=steps, tolerance=tolerance, row=row), jnp.arange(trials))


def over_plants(quantity: Callable[[Machine], Any], machine: Machine, uncertainty: Uncertainty, drawn: Mapping[str, Any], lanes: int = 4):
    """quantity(machine) for every plant drawn, tiled over devices; `drawn` as from `uncertainty.draw`."""
    run = tiled(lambda common, values: quantity(drawn_machine(common, uncertainty, values)), lanes=lanes)
    return run(machine, {name: jnp.asarray(values) for name, values in drawn.items()})


# Conditions: not for use inside compiled code ------------------------------------------------------------------------------


def contracting(machine: Machine, scheme: Scheme, task: Task, memory: Any = None, *, weights=None, **options) -> Condition:
    """The learning map contracts in the norm of the weighted memory.

    weights, and of options `leaves`: as for `learning_map`;  options `steps`, `tolerance`: as for `singular_value`
    Raises ValueError where machine, scheme and task do not fit, or for a name that the memory has not.
    """
    check(machine, scheme, task)
    found, *at = _singular_of_memory(machine, scheme, task, memory, weights, **options)
    local, where = _local(*at)
    return condition(found.value, CONTRACTION.format(where=where), premises=(local, _resolved(found.value, found.residual, True)))


def attracting(machine: Machine, scheme: Scheme, task: Task, memory: Any = None, **options) -> Condition:
    """The fixed point of the learning map attracts. options: `leaves` of `learning_map`, `steps` of `spectral_radius_of`; raises as above

    Where the eigenvalue is in doubt, it still is < 1 if the eighth power of the derivative contracts, since rho^8 <= ||J^8||.
    """
    check(machine, scheme, task)
    found, *at = _radius_of_memory(machine, scheme, task, memory, **options)
    local, where = _local(*at)
    resolved = _resolved(found.value, found.doubt, False)
    if not resolved.held and found.value < 1:
        power = _singular_of_power(machine, scheme, task, memory, **options)
        resolved = _resolved(power.value, power.residual, True)._replace(detail=f"||J^8|| = {float(power.value):.3g}")
    return condition(found.value, ATTRACTION.format(where=where), premises=(local, resolved))


def error_contracting(machine: Machine, scheme: Scheme, task: Task, memory: Any = None, *, trials: int = 1, **options) -> Condition:
    """A change of the error, however it is shaped, has become smaller `trials` trials later; see `error_map`.

    options: `steps`, `tolerance` of `singular_value`. Raises ValueError where machine, scheme and task do not fit.
    """
    check(machine, scheme, task)
    found, departed = _singular_of_error(machine, scheme, task, memory, trials=trials, **options)
    theorem = ERROR.format(n=trials, where=EVERYWHERE if is_linear(departed) else NEARBY)
    return condition(found.value, theorem, premises=(_resolved(found.value, found.residual, True),))


@partial(jax.jit, static_argnames=("leaves", "steps", "tolerance"))
def _singular_of_memory(machine, scheme, task, memory, weights, *, leaves=None, steps=300, tolerance=1e-6):
    map_ = learning_map(machine, scheme, task, memory, leaves=leaves, weights=weights)
    return singular_value(*map_, steps=steps, tolerance=tolerance), departure(*map_), _distance(map_)


@partial(jax.jit, static_argnames=("leaves", "steps"))
def _radius_of_memory(machine, scheme, task, memory, *, leaves=None, steps=100):
    map_ = learning_map(machine, scheme, task, memory, leaves=leaves)
    return spectral_radius_of(*map_, steps=steps), departure(*map_), _distance(map_)


@partial(jax.jit, static_argnames=("leaves", "steps"))
def _singular_of_power(machine, scheme, task, memory, *, leaves=None, steps=100):
    map_ = learning_map(machine, scheme, task, memory, leaves=leaves)
    _, push = jax.linearize(*map_)
    return singular_value(lambda x: lax.fori_loop(0, 8, lambda _, x: push(x), x), jnp.zeros_like(map_.at), steps=steps)


@partial(jax.jit, static_argnames=("trials", "steps", "tolerance"))
def _singular_of_error(machine, scheme, task, memory, *, trials, steps=300, tolerance=1e-6):
    map_ = error_map(machine, scheme, task, memory, trials=trials)
    return singular_value(*map_, steps=steps, tolerance=tolerance, row=trials - 1), departure(*map_)


def _distance(map_: Map):
    """|f(at) - at| / |at|, zero at a fixed point."""
    return ratio(jnp.linalg.norm(map_.f(map_.at) - map_.at), jnp.linalg.norm(map_.at))


def _local(departed, distance) -> tuple[Premise, str]:
    """The premise under which a derivative at one memory says where learning goes."""
    affine = bool(is_linear(departed))
    found = f"departs from its linearisation by {float(departed):.1e}; another trial moves the memory by {float(distance):.1e} of itself"
    return premise("map affine, or taken at its fixed point", affine or distance <= FIXED, found), EVERYWHERE if affine else NEARBY


def _resolved(value, doubt, lower_bound: bool) -> Premise:
    """The premise that the iteration came close enough to tell the value from 1."""
    value, doubt = float(value), float(doubt)
    clear = value + doubt < 1 or (value >= 1 if lower_bound else value - doubt > 1)
    return premise("iteration converged", clear, f"{value:.9g} within {doubt:.1e}")


# How it is done ------------------------------------------------------------------------------------------------------------


@pytree
class _Prescribed(Scheme):
    """A scheme that is shown a prescribed output instead of the measured one. Its memory is the scheme's and that output."""

    scheme: Scheme = part()

    @property
    def preview(self) -> int:
        return self.scheme.preview

    def table(self, memory, task: Task):
        return self.scheme.table(memory[0], task), memory[1][:-1]

    def init(self, task: Task):
        return self.scheme.init(task)

    def act(self, state, sample):
        row, y = sample.row
        return self.scheme.act(state, sample._replace(row=row, y=y))

    def signals(self, state):
        return self.scheme.signals(state)


def _with_output(machine: Machine, d) -> Machine:
    """The machine with the repetitive disturbance d (N+1, n_y) of its output on top of its own."""
    own = Disturbance() if machine.disturbance is None else machine.disturbance
    return dataclasses.replace(machine, disturbance=dataclasses.replace(own, output=d if own.output is None else own.output + d))


def _arnoldi(apply, like, steps, near):
    """The dominant Ritz value (or that nearest to `near`), its unit vector, its residual, and the Frobenius norm of H."""
    start = jax.random.normal(jax.random.key(1), like.shape, like.dtype)
    V = jnp.zeros((steps + 1, like.size), like.dtype).at[0].set(start / jnp.linalg.norm(start))

    def advance(i, now):
        V, H = now
        x = apply(V[i])
        scale = jnp.linalg.norm(x)
        first = V @ x
        x = x - first @ V
        second = V @ x
        x = x - second @ V
        size = jnp.linalg.norm(x)
        size = jnp.where(size > ROUNDING * jnp.finfo(x.dtype).eps * scale, size, 0.0)  # what rounding left over is no direction
        H = H.at[:, i].set(first + second).at[i + 1, i].set(size)
        return V.at[i + 1].set(jnp.where(size > 0, x / jnp.where(size > 0, size, 1.0), 0.0)), H

    V, H = lax.fori_loop(0, steps, advance, (V, jnp.zeros((steps + 1, steps), like.dtype)))
    values, vectors = jnp.linalg.eig(H[:-1])
    i = jnp.argmax(jnp.abs(values)) if near is None else jnp.argmin(jnp.abs(values - near))
    return values[i], vectors[:, i] @ V[:-1], H[-1, -1] * jnp.abs(vectors[-1, i]), jnp.linalg.norm(H)


def _names(name: str, leaf: str) -> bool:
    """Whether a name means this leaf, or something it is a part of."""
    return leaf == name or leaf.startswith((f"{name}.", f"{name}["))


def _weight(leaf: str, value, weights: Mapping[str, Any], size_y):
    named = [name for name in weights if _names(name, leaf)]
    if named:
        return weights[max(named, key=len)]
    size = _rms(value)
    usable = (size > 0) & (size_y > 0) & (leaf.split(".")[-1] not in OF_OUTPUT)
    return jnp.where(usable, size_y / jnp.where(size > 0, size, 1.0), 1.0)


def _rms(signal):
    return jnp.sqrt(jnp.mean(signal**2))
