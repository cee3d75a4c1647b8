"""What a plant does in a whole trial, and its linear form along that motion."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from ..pytree.aliases import Array, Tree
from ..runtime.lanes import over_samples
from .linear import TimeVaryingStateSpace
from .plant import Plant


def motion(plant: Plant, u: Array, dt: float) -> Array:
    """(N+1, n_y) the output of the plant from rest under the input u (N, n_u).

    The plant is prepared for dt [s] here. Where it knows its outputs from all inputs at once
    (`Plant.response`), they are asked for; otherwise it steps.
    """
    plant, u = _prepared(plant, u, dt)
    return stepped(plant, u, dt) if plant.response is None else plant.response(u, dt)


def _prepared(plant: Plant, u: Array, dt: float) -> tuple[Plant, Array]:
    """The plant, sampled for dt [s], and the input, in the larger precision of both.

    They are arrays of JAX: those of NumPy, such as a table of the samples, cannot be looked up
    within a loop.
    """
    u = jnp.asarray(u)
    real = jnp.result_type(u, *jax.tree.leaves(plant))
    plant, u = jax.tree.map(lambda x: jnp.asarray(x, real), (plant, u))
    return jax.tree.map(jnp.asarray, plant.sampled(dt)), u


def stepped(plant: Plant, u: Array, dt: float) -> Array:
    """The same of a plant that is prepared for dt [s], step by step."""

    def step(x: Tree, u_k: Array) -> tuple[Tree, Tree]:
        x = plant.step(x, u_k, dt)
        return x, plant.output(x)

    start = plant.initial_state()
    return jnp.concatenate([plant.output(start)[None], over_samples(step, start, u)[1]])


class Flat(NamedTuple):
    """A plant whose state is one vector (n,), as derivatives by it take it.

    start: (n,) the initial state
    step:   (n,), (n_u,) -> (n,) the state after a sample
    output: (n,) -> (n_y,)
    """

    start: Array
    step: Callable[[Array, Array], Array]
    output: Callable[[Array], Array]


def flat(plant: Plant, dt: float) -> Flat:
    """The plant, sampled for dt [s], with a flat state."""
    start, unravel = ravel_pytree(plant.initial_state())
    return Flat(
        start,
        lambda x, u: ravel_pytree(plant.step(unravel(x), u, dt))[0],
        lambda x: plant.output(unravel(x)),
    )


def linearised(plant: Plant, u: Array, dt: float) -> TimeVaryingStateSpace:
    """The plant for small changes of the input u (N, n_u), along its motion from rest.

        x[k+1] = A[k] x[k] + B[k] u[k],    y[k+1] = C[k] x[k+1]

    where x, u and y are the changes. A and B are the derivatives of `step` at the state and the
    input of the sample k, C is that of `output` one sample later. Time and memory are linear in N.
    """
    plant, u = _prepared(plant, u, dt)
    start, step, output = flat(plant, dt)

    def along(x: Array, u_k: Array) -> tuple[Array, Tree]:
        A, B = jax.jacfwd(step, (0, 1))(x, u_k)
        x = step(x, u_k)
        return x, (A, B, jax.jacfwd(output)(x))

    A, B, C = over_samples(along, start, u)[1]
    return TimeVaryingStateSpace(A, B, C, dt=dt)
