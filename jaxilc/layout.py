"""Where the samples of a batch lie in memory: under `vmap`, those of all its members at one instant side by side.

XLA would keep each member's samples together, as `vmap` numbers them, and turn every signal about on its way into the loop over time
and out of it, on a CPU a third of a trial. Both functions return what they are given, and matter only under `vmap`.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax.experimental.layout import Layout, with_layout_constraint
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir


def carried(signals):
    """signals: a tree whose arrays of two or more axes have one row a sample, on their way from trial to trial"""
    return _each(_lie, signals, turned=False)


def read(signals):
    """The same on their way into a scan over samples."""
    return _each(_lie, signals, turned=True)


def _each(of, signals, **how):
    return jax.tree.map(lambda x: of.bind(x, **how) if jnp.ndim(x) > 1 else x, signals)


_lie = Primitive("lie")
_lie.def_impl(lambda x, *, turned: x)
_lie.def_abstract_eval(lambda x, *, turned: x)
mlir.register_lowering(_lie, lambda ctx, x, *, turned: [x])
ad.deflinear2(_lie, lambda ct, _, *, turned: [_lie.bind(ct, turned=turned)])


def _batched(args, axes, *, turned):
    """Rows of samples, each with the whole batch. XLA takes it in one of two forms: for a loop's carry as the layout of an array
    whose axes stay, for a scan's rows as an array of turned axes."""
    x = jnp.moveaxis(args[0], axes[0], 0)
    rows_first = Layout(major_to_minor=(1, 0, *range(2, x.ndim)))
    if not turned:
        return with_layout_constraint(x, rows_first), 0
    rows = with_layout_constraint(jnp.moveaxis(x, 1, 0), Layout(major_to_minor=tuple(range(x.ndim))))
    return jnp.moveaxis(rows, 1, 0), 0


batching.primitive_batchers[_lie] = _batched
