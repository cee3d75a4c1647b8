"""Rows of the signals of a trial, one a sample: their layout in RAM, shifts, sums, and derivatives.

The layout of the samples of a batch: those of all machines at one instant are adjacent. XLA would
keep the samples of each machine together, as `vmap` numbers them, and would transpose every signal
before the loop over time and after it. On a CPU that took a quarter of the time of CFDL-MFAILC.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import TypeVar, cast

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero

from ..pytree.aliases import Array, Function, Tree
from ..runtime.jax_internals import rows_together
from ..runtime.lanes import over_samples, rows_scanned

F = TypeVar("F", bound=Function)
T = TypeVar("T", bound=Tree)


def for_carry(signals: T) -> T:
    """The signals with the layout for the carry of the loop over trials.

    signals: a tree; its arrays of two or more axes have one row for each sample
    The layout has an effect only under `vmap`.
    """
    return _laid_out(signals, turned=False)


def for_scan(signals: T) -> T:
    """The signals with the layout for the rows of a scan over samples, before or after the scan."""
    return _laid_out(signals, turned=True)


def _laid_out(signals: T, *, turned: bool) -> T:
    return jax.tree.map(
        lambda x: rows_together(x, turned=turned) if jnp.ndim(x) > 1 else x, signals
    )


def advance(signal: Array, samples: int) -> Array:
    """The rows signal[k + samples], k = 0..N-1, of a (N+1, n) signal; zero after the trial."""
    if samples == 0:
        return signal[:-1]
    rows = signal[samples:]
    return jnp.pad(rows, ((0, len(signal) - 1 - len(rows)), (0, 0)))


def delay(signal: Array, samples: int) -> Array:
    """The rows signal[k - samples], k = 0..N-1, of a (N, n) signal; zero before the trial."""
    if samples == 0:
        return signal
    # XLA writes a padded signal, `jnp.pad`, in a loop over the machines that is not vectorised
    return jnp.concatenate([jnp.zeros_like(signal[:samples]), signal[:-samples]])


def ahead_of(rows: Array, preview: int) -> Array:
    """(N, preview, n) at each sample the rows signal[k], signal[k+1], ... of a (N, n) signal.

    After the trial the last row is held.
    """
    held = jnp.pad(rows, ((0, preview - 1), (0, 0)), mode="edge")
    return jnp.stack([held[i : i + len(rows)] for i in range(preview)], axis=1)


def plus(signal: Array, other: Array | None) -> Array:
    """The sum of a signal and another one, where there is another one."""
    return signal if other is None else signal + other


def running_sum(signal: Array) -> Array:
    """The sums over i <= k of the rows signal[i], as (N, n).

    `jnp.cumsum` adds in several passes over the signal, and on a CPU takes longer than the trial
    itself.
    """
    if not rows_scanned():
        return jnp.cumsum(signal, axis=0)

    def add(total: Array, row: Array) -> tuple[Array, Array]:
        return total + row, total + row

    return for_scan(over_samples(add, jnp.zeros_like(signal[0]), for_scan(signal))[1])


def by_row(function: F) -> F:
    """Decorate f(weights, *rows), whose results at a sample follow from the rows at that sample.

        out[k] = f(w, x[k]),    d out[k] = (df/dw) dw + (df/dx[k]) dx[k]

    f is called with whole arrays, as it is written. Its derivatives, forward and backward, are
    computed in a scan over k, which calls f with one row at a time. So f must give the same for a
    row (n,) as for all rows (N, n), as arithmetic does.

    A gradient through learning needs the slope by each weight, which is a sum over all samples. XLA
    takes the sum over a whole array from a copy in which the samples of each machine are adjacent,
    and on a CPU such copies took most of the time of a gradient. Here the slopes are gathered in
    one scan. On an accelerator whole arrays are faster, and f is differentiated as it is.

    weights: the first argument, a tree without an axis of samples: the scheme, in a method of one
    rows: trees of arrays (N, n)
    """

    @jax.custom_jvp
    def whole(weights: Tree, rows: Tree) -> Tree:
        return function(weights, *rows)

    def with_tangents(primals: Tree, tangents: Tree) -> Tree:
        return whole(*primals), _tangents(function, primals, tangents)

    whole.defjvp(with_tangents, symbolic_zeros=True)

    @wraps(function)
    def wrapped(weights: Tree, *rows: Tree) -> Tree:
        return whole(weights, rows) if rows_scanned() else function(weights, *rows)

    return cast("F", wrapped)


def _tangents(function: Callable[..., Tree], primals: Tree, tangents: Tree) -> Tree:
    """The tangents of the results, (N, n) each; one that is known to be zero takes no time."""
    values, tree = jax.tree.flatten(primals)
    found = enumerate(jax.tree.leaves(tangents))
    moving = {i: tangent for i, tangent in found if not isinstance(tangent, SymbolicZero)}
    of_weights = len(jax.tree.leaves(primals[0]))
    weights, d_weights = values[:of_weights], {i: d for i, d in moving.items() if i < of_weights}
    rows, d_rows = values[of_weights:], {i: d for i, d in moving.items() if i >= of_weights}

    @jax.checkpoint  # so that a gradient stores nothing for each row
    def of_row(weights: Tree, row: Tree, tangents: Tree) -> Tree:
        at = dict(enumerate([*weights, *row]))

        def moved(values: Tree) -> Tree:
            weights, rows = jax.tree.unflatten(tree, list((at | values).values()))
            return function(weights, *rows)

        return jax.jvp(moved, ({i: at[i] for i in tangents},), (tangents,))[1]

    def tick(_: None, now: Tree) -> tuple[None, Tree]:
        row, d_row = now
        return None, of_row(weights, row, d_weights | d_row)

    return for_scan(over_samples(tick, None, for_scan((rows, d_rows)))[1])
