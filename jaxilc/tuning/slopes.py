"""A value with its slopes by a few weights, forward or backward."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp


def value_and_slope(f: Callable, z, *given, forward: bool):
    """f(z, *given) and its (P,) gradient, by P forward derivatives at once or one reverse pass.

    Under `vmap` over what is given, the P forward derivatives stay outside of the batch, so that
    those of all members for one weight are adjacent in RAM, as the members themselves are.
    """
    return _forward(f)(z, given) if forward else jax.value_and_grad(f)(z, *given)


def _forward(f: Callable) -> Callable:
    def slopes(of, z):
        """The values of a function, any shape, and its derivatives, with P as the last axis."""
        if z.size == 1:
            value, slope = jax.jvp(of, (z,), (jnp.ones_like(z),))
            return value, slope[..., None]
        return jax.vmap(lambda tangent: jax.jvp(of, (z,), (tangent,)), out_axes=(None, -1))(
            jnp.eye(z.size, dtype=z.dtype)
        )

    def alone(z, given):
        return slopes(lambda z: f(z, *given), z)

    of_one = jax.custom_batching.custom_vmap(alone)

    @of_one.def_vmap
    def of_batch(axis_size, batched, z, given):
        axes = jax.tree.map(lambda is_batched: 0 if is_batched else None, batched)
        if axes[0] == 0:
            found = jax.vmap(alone, in_axes=axes)(z, given)
        else:
            found = slopes(lambda z: jax.vmap(lambda one: f(z, *one), axes[1:])(given), z)
        return found, (True, True)

    return of_one
