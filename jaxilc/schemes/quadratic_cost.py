"""The nominal model and the weights of a quadratic cost, and what is asked of them."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from ..plants import StateSpace, TimeVaryingStateSpace
from ..pytree.needs import known
from ..signals.task import Task


def need_convex(scheme: Any) -> None:
    """Raises ValueError unless the cost of a scheme is convex, with one optimum.

    scheme: with `model`, and with `w_q`, `w_r` and `w_s` as `NormOptimal` has them
    """
    owner, n_u = type(scheme).__name__, scheme.model.n_u
    for name, size in (("w_q", scheme.model.n_y), ("w_r", n_u), ("w_s", n_u)):
        need_weight(owner, name, getattr(scheme, name), size)
    need_definite(owner, {"w_r": scheme.w_r, "w_s": scheme.w_s}, n_u)


def need_definite(owner: str, weights: dict[str, Any], size: int) -> None:
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


def need_weight(owner: str, name: str, weight, size: int) -> None:
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


def need_stable(scheme: Any) -> None:
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


def need_model_of(scheme: Any, task: Task) -> None:
    """Raises ValueError where the model is of another number of channels, samples, or rate."""
    model, owner = scheme.model, type(scheme).__name__
    jax.eval_shape(lambda model: model.sampled(task.dt), model)
    for what, of_model, of_task in (
        ("inputs", model.n_u, task.inputs),
        ("outputs", model.n_y, task.outputs),
    ):
        if of_model != of_task:
            raise ValueError(f"{owner}: the model has {of_model} {what} but the task {of_task}")
    if isinstance(model, TimeVaryingStateSpace) and model.N != task.N:
        raise ValueError(
            f"{owner}: the model is given for N = {model.N} samples but the task has N = {task.N}"
        )


def weights_of(scheme: Any, *names: str) -> tuple:
    """The symmetric parts of the weights, so that a gradient step keeps a weight symmetric."""
    sizes = (scheme.model.n_y if name == "w_q" else scheme.model.n_u for name in names)
    full = [matrix_of(getattr(scheme, name), size) for name, size in zip(names, sizes, strict=True)]
    return tuple((W + W.T) / 2 for W in full)


def matrix_of(weight, size: int):
    """A weight, which was given as a number, a diagonal or a matrix, as a matrix."""
    return weight if weight.ndim == 2 else weight * np.eye(size, dtype=weight.dtype)


def eigenvalues_of(W) -> np.ndarray:
    """The eigenvalues of the symmetric part of W."""
    W = np.asarray(W)
    return np.linalg.eigvalsh((W + W.T) / 2)
