"""What follows from each row of a trial alone, with a derivative that goes row by row.

A gradient through learning needs the slope by each weight, which is a sum over all samples. XLA
takes the sum over a whole array from a copy in which the samples of each machine are adjacent, and
such copies took most of the time of a gradient. Here the slopes are gathered in one scan over the
samples, in which those of all machines at one instant are adjacent.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar, cast

import jax
from jax import lax
from jax.custom_derivatives import SymbolicZero

from .sample_layout import for_scan

F = TypeVar("F", bound=Callable[..., Any])


def by_row(function: F) -> F:
    """Decorate f(weights, *rows), whose results at a sample follow from the rows at that sample.

        out[k] = f(w, x[k]),    d out[k] = (df/dw) dw + (df/dx[k]) dx[k]

    f is called with whole arrays, as it is written. Its derivatives, forward and backward, are
    computed in a scan over k, which calls f with one row at a time. So f must give the same for a
    row (n,) as for all rows (N, n), as arithmetic does.

    weights: the first argument, a tree without an axis of samples: the scheme, in a method of one
    rows: trees of arrays (N, n)
    """

    @jax.custom_jvp
    def whole(weights, rows):
        return function(weights, *rows)

    def with_tangents(primals, tangents):
        return whole(*primals), _tangents(function, primals, tangents)

    whole.defjvp(with_tangents, symbolic_zeros=True)

    @wraps(function)
    def wrapped(weights, *rows):
        return whole(weights, rows)

    return cast("F", wrapped)


def _tangents(function: Callable[..., Any], primals, tangents):
    """The tangents of the results, (N, n) each; one that is known to be zero takes no time."""
    values, tree = jax.tree.flatten(primals)
    found = enumerate(jax.tree.leaves(tangents))
    moving = {i: tangent for i, tangent in found if not isinstance(tangent, SymbolicZero)}
    of_weights = len(jax.tree.leaves(primals[0]))
    weights, d_weights = values[:of_weights], {i: d for i, d in moving.items() if i < of_weights}
    rows, d_rows = values[of_weights:], {i: d for i, d in moving.items() if i >= of_weights}

    @jax.checkpoint  # so that a gradient stores nothing for each row
    def of_row(weights, row, tangents):
        at = dict(enumerate([*weights, *row]))

        def moved(values):
            weights, rows = jax.tree.unflatten(tree, list((at | values).values()))
            return function(weights, *rows)

        return jax.jvp(moved, ({i: at[i] for i in tangents},), (tangents,))[1]

    def tick(_, now):
        row, d_row = now
        return None, of_row(weights, row, d_weights | d_row)

    return for_scan(lax.scan(tick, None, for_scan((rows, d_rows)))[1])
