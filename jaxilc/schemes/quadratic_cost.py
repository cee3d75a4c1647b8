"""The model and the weights of a quadratic cost, their checks, and the curvature of the cost."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ..plants import StateSpace, TimeVaryingStateSpace
from ..pytree.aliases import Array, Leaf, Tree
from ..pytree.needs import known
from ..signals.task import Task

STEPS = 10  # of the Lanczos process, at most; no more than there are elements
ROUNDING = 100.0  # in units of the last place


def largest_eigenvalue(f: Callable[[Array], Array], like: Array) -> Array:
    """() the largest eigenvalue of a positive semidefinite map f, from below.

        f V = V T + beta v e'

    V is orthonormal (Lanczos, reorthogonalised in full, twice) and starts from a fixed random
    direction. The largest eigenvalue of the tridiagonal T is never above that of f, except for
    rounding, and is equal to it where the process comes to its end before the steps do.

    f: from the shape of `like` to the same
    Unlike `theory.spectrum`, which looks at the residual to decide when to stop, this has a fixed
    number of steps, and so derivatives, backward and of any order.
    """
    n = like.size
    start = jax.random.normal(jax.random.key(0), (n,), like.dtype)
    small = ROUNDING * jnp.finfo(like.dtype).eps

    def advance(now: tuple[Array, Array], i: Array) -> Tree:
        basis, v = now
        basis = basis.at[i].set(v)
        image = f(v.reshape(like.shape)).ravel()
        rest = image
        for _ in range(2):
            rest = rest - (basis @ rest) @ basis
        square = rest @ rest
        # What rounding alone leaves over is no direction.
        goes_on = square > small**2 * (image @ image)
        beta = jnp.sqrt(jnp.where(goes_on, square, 1.0))
        following = jnp.where(goes_on, rest / beta, 0.0)
        return (basis, following), (v @ image, jnp.where(goes_on, beta, 0.0))

    steps = min(STEPS, n)
    before = jnp.zeros((steps, n), like.dtype), start / jnp.linalg.norm(start)
    _, (alpha, beta) = lax.scan(advance, before, jnp.arange(steps))
    # After the end of the process the diagonal is negative, each element by another amount: an
    # eigenvalue that occurs twice has no derivative.
    ended = jnp.cumsum(beta[:-1] == 0) > 0
    after = -alpha[0] * jnp.arange(1, steps)
    diagonal = alpha.at[1:].set(jnp.where(ended, after, alpha[1:]))
    T = jnp.diag(diagonal) + jnp.diag(beta[:-1], 1) + jnp.diag(beta[:-1], -1)
    return jnp.linalg.eigvalsh(T)[-1]


WithModel: TypeAlias = Tree  # a scheme with a model, and weights as `NormOptimal` has them


def need_convex(scheme: WithModel) -> None:
    """Raises ValueError unless the cost of a scheme is convex, with one optimum."""
    need_weights(scheme, "w_q", "w_r", "w_s")
    sums = {"w_r": scheme.w_r, "w_s": scheme.w_s}
    need_definite(type(scheme).__name__, sums, scheme.model.n_u)


def need_definite(owner: str, weights: dict[str, Leaf], size: int) -> None:
    """Raises ValueError unless the sum of two semidefinite weights is positive definite."""
    if not known(weights):
        return
    R, S = (matrix_of(weight, size) for weight in weights.values())
    total, both = eigenvalues_of(R) + eigenvalues_of(S), eigenvalues_of(R + S)
    if np.any(both <= 1e-14 * np.max(total)):
        raise ValueError(
            f"{owner}: {' + '.join(weights)} has the eigenvalues {both}; allowed are positive ones "
            "only"
        )


def need_weights(scheme: WithModel, *names: str) -> None:
    """Raises ValueError unless each named weight is one of the outputs or inputs of the model."""
    for name in names:
        need_weight(type(scheme).__name__, name, getattr(scheme, name), _size_of(scheme, name))


def _size_of(scheme: WithModel, name: str) -> int:
    return scheme.model.n_y if name in ("w_q", "w_y") else scheme.model.n_u


def need_weight(owner: str, name: str, weight: Leaf, size: int) -> None:
    """Raises ValueError unless a weight is a number, a diagonal or a semidefinite matrix."""
    if weight.shape not in ((), (size,), (size, size)):
        raise ValueError(
            f"{owner}: {name} has shape {weight.shape}; allowed are (), ({size},) and "
            f"({size}, {size})"
        )
    if not known(weight):
        return
    W = np.asarray(matrix_of(weight, size))
    # half of the digits must agree, but no more than 6, also in double precision
    rounding = max(1e-6, np.sqrt(np.finfo(W.dtype).eps))
    if np.max(np.abs(W - W.T)) > rounding * np.max(np.abs(W)):
        raise ValueError(f"{owner}: {name} = {W.tolist()} is not symmetric")
    values = eigenvalues_of(W)
    if not np.all(values >= -max(1e-12, size * np.finfo(W.dtype).eps) * np.max(np.abs(values))):
        raise ValueError(f"{owner}: {name} has the eigenvalues {values}; allowed are none below 0")


def need_stable(scheme: WithModel) -> None:
    """Raises ValueError for a constant model that is unstable."""
    model = scheme.model
    if not isinstance(model, StateSpace) or not known(model):
        return
    poles = np.linalg.eigvals(np.asarray(model.A))
    growth = np.max(np.abs(poles) - 1 if model.dt else poles.real, initial=-1.0)
    if growth > 1e-7:
        where = "outside the unit circle" if model.dt else "right of the imaginary axis"
        raise ValueError(
            f"{type(scheme).__name__}: the model is unstable (a pole {growth:.3g} {where}); give "
            "the closed loop that the learned input meets"
        )


def need_channels_of(scheme: WithModel, task: Task) -> None:
    """Raises ValueError where the model has another number of inputs or outputs than the task."""
    model = scheme.model
    for what, of_model, of_task in (
        ("inputs", model.n_u, task.inputs),
        ("outputs", model.n_y, task.outputs),
    ):
        if of_model != of_task:
            raise ValueError(
                f"{type(scheme).__name__}: the model has {of_model} {what} but the task {of_task}"
            )


def need_model_of(scheme: WithModel, task: Task) -> None:
    """Raises ValueError where the model is of another number of channels, samples, or rate."""
    model = scheme.model
    jax.eval_shape(lambda model: model.sampled(task.dt), model)
    need_channels_of(scheme, task)
    if isinstance(model, TimeVaryingStateSpace) and model.N != task.N:
        raise ValueError(
            f"{type(scheme).__name__}: the model is given for N = {model.N} samples but the task "
            f"has N = {task.N}"
        )


def weights_of(scheme: WithModel, *names: str) -> tuple[Array, ...]:
    """The symmetric parts of the weights, so that a gradient step keeps a weight symmetric."""
    return tuple(symmetric_of(getattr(scheme, name), _size_of(scheme, name)) for name in names)


def symmetric_of(weight: Leaf, size: int) -> Array:
    """The symmetric part of a weight as a matrix."""
    W = matrix_of(weight, size)
    return (W + W.T) / 2


def matrix_of(weight: Leaf, size: int) -> Array:
    """A weight, which was given as a number, a diagonal or a matrix, as a matrix."""
    return weight if weight.ndim == 2 else weight * np.eye(size, dtype=weight.dtype)


def eigenvalues_of(W: Leaf) -> np.ndarray:
    """The eigenvalues of the symmetric part of W."""
    W = np.asarray(W)
    return np.linalg.eigvalsh((W + W.T) / 2)
