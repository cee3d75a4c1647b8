"""Linear plants: state space, constant or varying over a trial, and difference equation."""

from __future__ import annotations

import math
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ..pytree.aliases import Array, Leaf, Tree, Value
from ..pytree.fields import child, leaf, pytree, static
from ..signals.task import Task, product
from .plant import Plant

LARGEST_ORDER = 1000  # of a transfer function; its matrices have as many rows
MOST_SQUARED = 40  # times, of a matrix exponential
BALANCED = 100  # steps at most, which scale the states of a plant
MOST_TERMS = 500  # of a difference equation; compiling takes time in their square

Sampled = TypeVar("Sampled", bound=Value)  # a plant with its own sample time `dt`


@jax.jit
def zoh(A: Array, B: Array, dt: float) -> tuple[Array, Array]:
    """Exact zero-order hold: exp([[A, B], [0, 0]] dt) = [[A_d, B_d], [0, I]].

    A: (n, n) [1/s], B: (n, n_u), dt [s] -> A_d (n, n), B_d (n, n_u)

    States and inputs are first scaled by powers of two: of a companion form, whose numbers are
    powers of the frequencies, the exponential would lose its digits.
    """
    n, m = B.shape
    states = _balancing(A)
    A, B = A * states / states[:, None], B / states[:, None]
    size = jnp.max(jnp.abs(A))
    ratio = jnp.max(jnp.abs(B), axis=0) / jnp.where(size > 0, size, 1.0)
    inputs = _power_of_two(jnp.log2(jnp.where(jnp.isfinite(ratio), jnp.maximum(ratio, 1.0), 1.0)))
    block = jnp.zeros((n + m, n + m), jnp.result_type(A, B)).at[:n, :n].set(A)
    transition = exponential(block.at[:n, n:].set(B / inputs) * dt)
    back = states[:, None]
    return transition[:n, :n] * back / states, transition[:n, n:] * back * inputs


def exponential(M: Array) -> Array:
    """(n, n) exp(M), by the Taylor polynomial of order 19 of M 2^-s, squared s times.

    s is the least number for which the 1-norm of M 2^-s is 1 or less; the result is NaN where it is
    above 40. `jax.scipy.linalg.expm` takes two to three times as long to compile, backward too, and
    is NaN for a norm of 7e5.
    """
    norm = jnp.max(jnp.sum(jnp.abs(lax.stop_gradient(M)), axis=0))
    s = jnp.maximum(jnp.ceil(jnp.log2(norm)), 0.0)
    M = M * _power_of_two(-s)
    powers = [jnp.eye(len(M), dtype=M.dtype), M, M @ M]
    powers.append(powers[2] @ M)
    fourth = powers[2] @ powers[2]

    def part(k: int) -> Array:
        terms = (x * (1.0 / math.factorial(k + i)) for i, x in enumerate(powers))
        return sum(terms, jnp.zeros_like(M))

    R = part(16)
    for k in (12, 8, 4, 0):
        R = R @ fourth + part(k)

    def squared(i: Array, R: Array) -> Array:
        return lax.cond(i < s, lambda x: x @ x, lambda x: x, R)

    return jnp.where(s > MOST_SQUARED, jnp.nan, lax.fori_loop(0, MOST_SQUARED, squared, R))


def _balancing(A: Array) -> Array:
    """(n,) powers of two d such that the rows of A d_j / d_i are about as large as its columns.

    The sums of sizes beside the diagonal are meant (Osborne 1960), and a state whose row or column
    is zero there keeps its scale.
    """
    n = len(A)
    size = jnp.where(np.eye(n, dtype=bool), 0.0, jnp.abs(lax.stop_gradient(A)))

    def nearer(_: object, d: Array) -> Array:
        scaled = size * jnp.exp2(d - d[:, None])
        ratio = jnp.sum(scaled, axis=1) / jnp.sum(scaled, axis=0)
        return d + jnp.where(jnp.isfinite(ratio) & (ratio > 0), jnp.log2(ratio), 0.0) / 4

    return _power_of_two(lax.fori_loop(0, min(8 * n, BALANCED), nearer, jnp.zeros(n, size.dtype)))


def _power_of_two(exponent: Array) -> Array:
    """2 to the nearest whole number, exactly."""
    whole = jnp.round(lax.stop_gradient(exponent))
    return jnp.ldexp(jnp.ones_like(whole), whole.astype(int))


def matching(plant: Sampled, dt: float) -> Sampled:
    """`plant`, if its own sample time is the task's dt; else ValueError."""
    if abs(plant.dt - dt) > 1e-9 * dt:
        raise ValueError(
            f"{type(plant).__name__} is sampled at {plant.dt:.10g} s but the task at {dt:.10g} s; "
            f"allowed is dt = {plant.dt:.10g}"
        )
    return plant


class _Matrices(Plant):
    """A plant with the matrices B (..., n, n_u) and C (..., n_y, n)."""

    B: Leaf
    C: Leaf

    @property
    def n_u(self) -> int:
        return self.B.shape[-1]

    @property
    def n_y(self) -> int:
        return self.C.shape[-2]


@pytree
class StateSpace(_Matrices):
    """x' = A x + B u, y = C x in continuous time, or x[k+1] = A x[k] + B u[k] in discrete time.

    A:  (n, n)
    B:  (n, n_u)
    C:  (n_y, n)
    x0: (n,) initial state; None for rest
    dt: sample time the matrices belong to [s]; 0 for continuous time, which is then sampled exactly
        with a zero-order hold

    Raises ValueError for shapes that do not fit, or a task of another sample time.
    """

    A: Leaf = leaf()
    B: Leaf = leaf()
    C: Leaf = leaf()
    x0: Leaf | None = leaf(default=None, optional=True)
    dt: float = static(default=0.0, interval="[0, inf)")

    def __post_init__(self) -> None:
        n = len(self.A) if self.A.ndim else 0
        fits = (
            self.A.shape == (n, n)
            and self.B.shape[:-1] == (n,)
            and self.C.shape[1:] == (n,)
            and self.B.ndim == self.C.ndim == 2
        )
        if not fits:
            raise ValueError(
                f"StateSpace: A {self.A.shape}, B {self.B.shape}, C {self.C.shape} do not fit; "
                "allowed are (n, n), (n, n_u), (n_y, n)"
            )
        if self.x0 is not None and self.x0.shape != (n,):
            raise ValueError(f"StateSpace: x0 has shape {self.x0.shape}; allowed is ({n},)")

    def sampled(self, dt: float) -> StateSpace:
        if self.dt:
            return matching(self, dt)
        A, B = zoh(self.A, self.B, dt)
        return StateSpace(A, B, self.C, self.x0, dt=dt)

    def continuous(self) -> StateSpace | None:
        return None if self.dt else self

    def initial_state(self) -> Tree:
        if self.x0 is None:
            return jnp.zeros_like(self.A, shape=self.A.shape[-1:])
        return jnp.asarray(self.x0)

    def step(self, x: Tree, u: Array, dt: float) -> Tree:
        return product(self.A, x) + product(self.B, u)

    def output(self, x: Tree) -> Array:
        return product(self.C, x)


@pytree
class TimeVaryingStateSpace(_Matrices):
    """A plant that is linearised along its motion, over one trial of N samples.

        x[k+1] = A[k] x[k] + B[k] u[k],    y[k+1] = C[k] x[k+1]

    A:  (N, n, n)
    B:  (N, n, n_u)
    C:  (N, n_y, n); C[k] belongs to the output a sample after k
    dt: sample time [s]

    It starts at rest, with y[0] = 0. Raises ValueError for shapes that do not fit, or a task of
    another length or sample time.
    """

    A: Leaf = leaf()
    B: Leaf = leaf()
    C: Leaf = leaf()
    dt: float = static(interval="(0, inf)")

    def __post_init__(self) -> None:
        A, B, C = (np.shape(M) for M in (self.A, self.B, self.C))
        fits = len(A) == len(B) == len(C) == 3
        if not (fits and A[1] == A[2] and B[:2] == A[:2] == C[::2]):
            raise ValueError(
                f"TimeVaryingStateSpace: A {A}, B {B}, C {C} do not fit; allowed are (N, n, n), "
                "(N, n, n_u), (N, n_y, n)"
            )

    @property
    def N(self) -> int:
        return self.A.shape[-3]

    def check(self, task: Task) -> None:
        if self.N != task.N:
            raise ValueError(
                f"TimeVaryingStateSpace: the plant is given for N = {self.N} samples but the task "
                f"has N = {task.N}"
            )

    def sampled(self, dt: float) -> TimeVaryingStateSpace:
        return matching(self, dt)

    def initial_state(self) -> Tree:
        """The sample's number and the state."""
        return jnp.zeros((), int), jnp.zeros_like(self.A, shape=self.A.shape[-1:])

    def step(self, x: Tree, u: Array, dt: float) -> Tree:
        k, state = x
        A, B = jnp.asarray(self.A)[k], jnp.asarray(self.B)[k]  # of NumPy, no traced k is taken
        return k + 1, product(A, state) + product(B, u)

    def output(self, x: Tree) -> Array:
        k, state = x
        C = jnp.asarray(self.C)[jnp.maximum(k - 1, 0)]
        return jnp.where(k > 0, product(C, state), 0.0)


@pytree
class DifferenceEquation(Plant):
    """y[k] = sum_{i=1..n} (a_i y[k-i] + b_i u[k-i]), with one input and one output.

    a, b: (n,) coefficients, with the signs as written above
    dt:   sample time they belong to [s]

    The state is the transposed direct form II, which needs no shifting registers of y and u. Raises
    ValueError for shapes that differ, n > 500, or a task of another sample time.
    """

    a: Leaf = leaf()
    b: Leaf = leaf()
    dt: float = static(interval="(0, inf)")

    def __post_init__(self) -> None:
        if self.a.shape != self.b.shape or self.a.ndim != 1 or not self.a.size:
            raise ValueError(
                f"DifferenceEquation: a {self.a.shape} and b {self.b.shape} must both have shape "
                "(n,), n >= 1; pad with zeros"
            )
        if self.a.shape[-1] > MOST_TERMS:
            raise ValueError(
                f"DifferenceEquation: a and b have n = {self.a.shape[-1]} coefficients; allowed "
                f"are at most {MOST_TERMS}; a longer model can be a StateSpace"
            )

    def sampled(self, dt: float) -> DifferenceEquation:
        return _Taken(tuple(self.a), tuple(self.b), dt=matching(self, dt).dt)

    def initial_state(self) -> Tree:
        return tuple(jnp.zeros_like(a) for a in self.a)

    def step(self, x: Tree, u: Array, dt: float) -> Tree:
        # registers one by one: as an array, shifting them would cost a copy a sample
        return tuple(
            s + a * x[0] + b * u[0] for s, a, b in zip((*x[1:], 0.0), self.a, self.b, strict=True)
        )

    def output(self, x: Tree) -> Array:
        return x[0][None]


@pytree
class _Taken(DifferenceEquation):
    """The difference equation with its coefficients one by one.

    Picked from an array in a loop over samples, they would keep a batch from being vectorised.
    """

    a: tuple[Leaf, ...] = child()
    b: tuple[Leaf, ...] = child()

    def __post_init__(self) -> None:
        """Nothing to check: they were, as arrays."""

    def sampled(self, dt: float) -> DifferenceEquation:
        return matching(self, dt)
