"""Where the samples of a batch lie in memory: under `vmap`, those of all its members at one instant
side by side.

XLA would keep each member's samples together, as `vmap` numbers them, and turn every signal about
on its way into the loop over time and out of it, on a CPU a quarter of the time of CFDL-MFAILC.
Both functions return what they are given, and matter only under `vmap`.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax.experimental.layout import Layout, with_layout_constraint
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir


def for_carry(signals):
    """signals: a tree whose arrays of two or more axes have one row a sample, on their way from
    trial to trial
    """
    return jax.tree.map(
        lambda x: _by_sample.bind(x, axis=0, turned=False) if jnp.ndim(x) > 1 else x, signals
    )


def for_scan(signals):
    """The same on their way into a scan over samples, or out of it."""
    return jax.tree.map(
        lambda x: _by_sample.bind(x, axis=0, turned=True) if jnp.ndim(x) > 1 else x, signals
    )


def _placed(x, *, axis, turned):
    """x: with the samples along `axis`. XLA takes the wish in one of two forms: of a loop's carry
    as a layout of the axes as they are, of a scan's rows as an array of turned axes."""
    if axis == 0:
        return x
    if not turned:
        return with_layout_constraint(
            x, Layout(major_to_minor=(axis, *(i for i in range(x.ndim) if i != axis)))
        )
    rows = with_layout_constraint(
        jnp.moveaxis(x, axis, 0), Layout(major_to_minor=tuple(range(x.ndim)))
    )
    return jnp.moveaxis(rows, 0, axis)


def _batched(args, dims, *, axis, turned):
    return _by_sample.bind(jnp.moveaxis(args[0], dims[0], 0), axis=axis + 1, turned=turned), 0


_by_sample = Primitive("by_sample")
_by_sample.def_impl(lambda x, **_: x)
_by_sample.def_abstract_eval(lambda x, **_: x)
mlir.register_lowering(_by_sample, mlir.lower_fun(_placed, multiple_results=False))
ad.deflinear2(_by_sample, lambda cotangent, _, **how: [_by_sample.bind(cotangent, **how)])
batching.primitive_batchers[_by_sample] = _batched
