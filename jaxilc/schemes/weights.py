"""Errors that do not count alike: the weight of a record, and what laws with a model make of it.

A wrapper that lets some errors count less, or turns them to the normal of a path, shows its scheme

    e'[k] = W[k] e[k],    by the output  y' = r - W (r - y),  with `Trial.weight` = W

A law without a model learns from e' as from any error. A law with a model predicts e', by what its
model answers times W (H -> W H), so that it makes use of the motion where errors do not count.
"""

from __future__ import annotations

import jax.numpy as jnp

from ..plants import Plant, StateSpace, TimeVaryingStateSpace
from ..plants.plant import Around
from ..pytree.aliases import Array, Function, Leaf, Tree
from ..pytree.fields import child, leaf, pytree
from ..signals.task import Trial


def weighed(trial: Trial, W: Array) -> Trial:
    """The trial with the errors W e, on top of a weight that it has already.

    W: (N+1, n_y, n_y), or (N+1, n_y) for a weight of each output by itself
    """
    W = W if W.ndim == 3 else W[:, :, None] * jnp.eye(W.shape[1], dtype=W.dtype)
    before = trial.weight
    return trial._replace(
        y=trial.r - jnp.einsum("kij,kj->ki", W, trial.e), weight=W if before is None else W @ before
    )


def output_weighed(trial: Trial, y: Array) -> Array:
    """(N+1, n_y) an output y of a model as the weight of the trial shows it."""
    if trial.weight is None:
        return y
    return trial.r - jnp.einsum("kij,kj->ki", trial.weight, trial.r - y)


def model_weighed(model: Tree, trial: Trial) -> Tree:
    """The linear model, sampled, from the input to the outputs as the weight shows them."""
    if trial.weight is None:
        return model
    N, W = len(trial.u), trial.weight[1:]
    if isinstance(model, StateSpace):
        A, B, C = (jnp.broadcast_to(M, (N, *M.shape)) for M in (model.A, model.B, model.C))
    else:
        A, B, C = model.A, model.B, model.C
    return TimeVaryingStateSpace(A, B, W @ C, dt=model.dt)


def answers_weighed(push: Function, pull: Function, trial: Trial) -> tuple[Function, Function]:
    """The linear maps G and G* of a model, as the weight of the trial shows its output."""
    if trial.weight is None:
        return push, pull
    W = trial.weight[1:]
    return (
        lambda u: jnp.einsum("kij,kj->ki", W, push(u)),
        lambda e: pull(jnp.einsum("kij,ki->kj", W, e)),
    )


def counts_at_all(trial: Trial) -> Array | float:
    """(N, n_y) whether the error of each sample from k = 1 on counts; 1 without a weight."""
    if trial.weight is None:
        return 1.0
    return jnp.where(jnp.any(trial.weight[1:] != 0, axis=2), 1.0, 0.0)


@pytree
class WeighedOutput(Around):
    """A plant whose outputs are seen by a weight, W[k] y[k].

    weight: (N+1, n_y, n_y)
    """

    plant: Plant = child()
    weight: Leaf = leaf()

    def initial_state(self) -> Tree:
        """The number of the sample, as a float, and the state of the plant."""
        return jnp.zeros_like(self.weight, shape=()), self.plant.initial_state()

    def step(self, x: Tree, u: Array, dt: float) -> Tree:
        return x[0] + 1.0, self.plant.step(x[1], u, dt)

    def output(self, x: Array) -> Array:
        return self.weight[x[0].astype(int)] @ self.plant.output(x[1])
