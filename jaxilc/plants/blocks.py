"""A long trial of a linear plant in blocks of samples.

There is a chain from block to block, and matrix products for all that lies between.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree

from ..pytree.aliases import Array, Tree
from ..pytree.fields import child, pytree, static
from ..runtime.capacity import check_size
from ..runtime.lanes import machines_side_by_side, over_samples
from ..signals.task import Task, product
from .along_motion import flat, stepped
from .cnc_axis import Axes
from .linear import DifferenceEquation, StateSpace
from .plant import Around, Plant

LOST = {"float64": 1e-9, "float32": 1e-4}  # of the largest |y|, by rounding of A


class Block(NamedTuple):
    """The matrices of a block of L samples.

        x[k+L] = x A + U R,    [y[k] ... y[k+L-1]] = x O + U H

    with x[k] as a row and U = [u[k] ... u[k+L-1]].

    A:    (n, n)
    R:    (L n_u, n)
    O:    (n, L n_y)
    H:    (L n_u, L n_y)
    lost: (n, n) what rounding leaves of A: the difference between two blocks in one go and one
          after the other
    """

    A: Array
    R: Array
    O: Array  # noqa: E741
    H: Array
    lost: Array


@pytree
class InBlocks(Around):
    """A linear plant that answers a whole trial at once, for one machine and long trials.

    A step of one plant waits for the step before it. Here the states every `length` samples are a
    chain, and the samples between are two matrix products (`Block`). The matrices are those of the
    plant's own `step`, run from unit states and unit impulses. It serves schemes that play back
    what they learned, with an actuator without rate limit, since the input must be known before the
    trial; under feedback the plant steps as if it were not wrapped.

    plant:  samples into a StateSpace, a DifferenceEquation, or axes of them; its parameters are
            `plant.gain` and so on
    length: samples of a block

    The numbers are those of the steps up to rounding. What rounding of A does to each output is
    estimated to first order, once a block. Where that is beyond 1e-9 of the largest |y| (float32:
    1e-4), or not finite, the plant steps instead. That happens to difference equations of high
    order with poles close together, and to unstable plants in trials long enough to overflow.

    It is worth it for a StateSpace: a trial of 10^5 to 10^6 samples takes a half to a quarter of
    the time. A DifferenceEquation, whose step is short, gains a third at most; gradients gain for
    both. A batch already fills the processor, and under `vmap` the steps are computed as well:
    leave the plants of a sweep as they are. A program that is compiled for the processor at hand
    (`jaxilc.native`) has the machines of a batch side by side, and steps.

    Raises ValueError, when it is sampled, for a plant that is not linear and time-invariant.
    """

    plant: Plant = child()
    length: int = static(default=32, interval="[2, 1e4]", whole=True)

    def check(self, task: Task) -> None:
        super().check(task)
        of_a_row = 8 * 4 * self.length * self.n_u * self.n_y
        check_size("InBlocks", of_a_row, length=self.length)

    def sampled(self, dt: float) -> InBlocks:
        sampled = super().sampled(dt)
        if not _is_linear(sampled.plant):
            raise ValueError(
                f"InBlocks: plant = {type(self.plant).__name__} is not linear and time-invariant; "
                "allowed are plants that sample into "
                "StateSpace, DifferenceEquation, or TwoAxes or ThreeAxes of them"
            )
        return sampled

    def continuous(self) -> StateSpace | None:
        return self.plant.continuous()

    def initial_state(self) -> Tree:
        return self.plant.initial_state()

    def step(self, x: Tree, u: Array, dt: float) -> Tree:
        return self.plant.step(x, u, dt)

    def output(self, x: Tree) -> Array:
        return self.plant.output(x)

    def response(self, u: Array, dt: float) -> Array:
        if machines_side_by_side():
            return stepped(self.plant, u, dt)
        N, L, block = len(u), self.length, _block(self.plant, dt, self.length)
        U = jnp.pad(u, ((0, L - N % L), (0, 0))).reshape(-1, L * self.n_u)
        x = ravel_pytree(self.plant.initial_state())[0]
        X = _chain(block.A, x, U @ block.R)
        Y = U @ block.H + X @ block.O
        A, lost, C, states, first = lax.stop_gradient(
            (block.A, block.lost, block.O[:, : self.n_y], X, Y[:, : self.n_y])
        )
        off = _chain(A, jnp.zeros_like(x), states @ lost) @ C
        good = jnp.all(
            jnp.max(jnp.abs(off), axis=0) <= LOST[Y.dtype.name] * jnp.max(jnp.abs(first), axis=0)
        )
        Y = lax.cond(
            good,
            lambda: Y,
            lambda: stepped(self.plant, U.reshape(-1, self.n_u)[:-1], dt).reshape(Y.shape),
        )
        return Y.reshape(-1, self.n_y)[: N + 1]


def _is_linear(plant: Plant) -> bool:
    if isinstance(plant, Axes):
        return all(_is_linear(axis) for axis in plant.axes.values())
    return isinstance(plant, StateSpace | DifferenceEquation)


def _block(plant: Plant, dt: float, L: int) -> Block:
    start, step, output = flat(plant, dt)
    rest, n, n_u = jnp.zeros_like(start), len(start), plant.n_u

    def free(x: Tree, _: object) -> tuple[Tree, Tree]:
        x = jax.vmap(lambda x: step(x, jnp.zeros(n_u)))(x)
        return x, x

    impulses = jax.vmap(lambda u: step(rest, u))(jnp.eye(n_u))
    start = jnp.concatenate([jnp.eye(n), impulses])
    # by steps, not by squaring, which loses digits where powers of A first grow
    x = jnp.concatenate([start[None], over_samples(free, start, None, length=2 * L)[1]])
    y = jax.vmap(jax.vmap(output))(x)
    lag = np.arange(L) - np.arange(L)[:, None] - 1
    H = jnp.where((lag >= 0)[:, :, None, None], y[np.maximum(lag, 0), n:], 0.0)
    A, twice = x[L, :n], x[2 * L, :n]
    return Block(
        A,
        x[:L, n:][::-1].reshape(L * n_u, n),
        jnp.swapaxes(y[:L, :n], 0, 1).reshape(n, -1),
        jnp.swapaxes(H, 1, 2).reshape(L * n_u, -1),
        twice - A @ A,
    )


def _chain(A: Array, x: Array, f: Array) -> Array:
    """(M, n) the states x[0] = x, x[i+1] = x[i] A + f[i]."""
    columns = A.T
    return over_samples(lambda x, f: (product(columns, x) + f, x), x, f)[1]
