"""Primitives of JAX that are written by others: small linear algebra, and parts of arrays.

Each function has the operands and the parameters of a primitive of JAX, and its results.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

if TYPE_CHECKING:
    from ..runtime.jax_internals import ClosedJaxpr

Parameters: TypeAlias = dict[str, Any]  # of a primitive of JAX; each has a type of its own


class Shaped(Protocol):
    """What has the shape and the type of an array."""

    shape: tuple[int, ...]
    dtype: np.dtype


MOST = 16  # rows of a matrix that is solved in single steps, and whole numbers that are sorted


def lu(a: jax.Array, **_: object) -> tuple[jax.Array, ...]:
    """L below the diagonal and U, the row that came to each place, and the order of all rows."""
    if a.ndim > 2:
        return jax.vmap(lu)(a)
    n, steps = len(a), range(min(a.shape))
    rows, order, pivots = [*a], [*jnp.arange(n, dtype=jnp.int32)], []
    for k in steps:
        best, size = jnp.asarray(k, jnp.int32), jnp.abs(rows[k][k])
        for i in range(k + 1, n):
            larger = jnp.abs(rows[i][k]) > size
            best = jnp.where(larger, i, best)
            size = jnp.where(larger, jnp.abs(rows[i][k]), size)
        pivots.append(best)
        for of in (rows, order):
            top = of[k]
            for i in range(k + 1, n):
                of[k] = jnp.where(best == i, of[i], of[k])
                of[i] = jnp.where(best == i, top, of[i])
        pivot = rows[k][k]
        for i in range(k + 1, n):
            share = jnp.where(pivot == 0, rows[i][k], rows[i][k] / pivot)
            rest = rows[i][k + 1 :] - share * rows[k][k + 1 :]
            rows[i] = jnp.concatenate([rows[i][:k], share[None], rest])
    return jnp.stack(rows), jnp.stack(pivots), jnp.stack(order)


def triangular_solve(a: jax.Array, b: jax.Array, *, left_side: bool, lower: bool,
                     transpose_a: bool, unit_diagonal: bool,
                     **_: object) -> tuple[jax.Array, ...]:  # fmt: skip
    """(n, m) the solution of a x = b; of x a = b where a is not on the left side."""
    if a.ndim > 2:
        one = partial(triangular_solve, left_side=left_side, lower=lower, transpose_a=transpose_a,
                      unit_diagonal=unit_diagonal)  # fmt: skip
        return jax.vmap(one)(a, b)
    if transpose_a == left_side:
        a, lower = a.T, not lower
    b = b if left_side else b.T
    n = len(a)
    diagonal = jnp.ones(n, a.dtype) if unit_diagonal else jnp.diagonal(a)
    known = jnp.where(np.tri(n, k=-1, dtype=bool) if lower else ~np.tri(n, dtype=bool), a, 0.0)

    def unknown(x: jax.Array, now: tuple[jax.Array, ...]) -> tuple[jax.Array, None]:
        i, row, scale, right = now
        found = (right - row @ x) / scale
        return lax.dynamic_update_slice(x, found[None], (i, jnp.int32(0))), None

    rows = (jnp.arange(n, dtype=jnp.int32), known, diagonal, b)
    found = lax.scan(unknown, jnp.zeros(b.shape, b.dtype), rows, reverse=not lower)[0]
    return (found if left_side else found.T,)


def _sort(keys: jax.Array, *others: jax.Array, **_: object) -> tuple[jax.Array, ...]:
    """Whole numbers in ascending order, and other arrays in the same one."""
    columns = [[*x] for x in (keys, *others)]
    for last in reversed(range(len(keys))):
        for i in range(last):
            turned = columns[0][i] > columns[0][i + 1]
            for of in columns:
                low, high = of[i : i + 2]
                of[i : i + 2] = jnp.where(turned, high, low), jnp.where(turned, low, high)
    return (*(jnp.stack(x) for x in columns),)


def _by_columns(matrix: jax.Array, vector: jax.Array, **_: object) -> list[jax.Array]:
    return [jnp.matmul(matrix, vector[..., None])[..., 0]]


def _split(x: jax.Array, *, sizes: Sequence[int], axis: int, **_: object) -> list[jax.Array]:
    ends = np.cumsum(sizes)
    return [lax.slice_in_dim(x, int(end) - size, int(end), axis=axis)
            for size, end in zip(sizes, ends, strict=True)]  # fmt: skip


def _stack(*arrays: jax.Array, axis: int, **_: object) -> list[jax.Array]:
    return [lax.concatenate([lax.expand_dims(x, [axis]) for x in arrays], axis)]


def _unstack(x: jax.Array, *, axis: int, **_: object) -> list[jax.Array]:
    return [lax.squeeze(one, [axis]) for one in _split(x, sizes=[1] * x.shape[axis], axis=axis)]


WRITTEN: dict[str, Callable[..., Sequence[jax.Array]]] = {
    "lu": lu, "triangular_solve": triangular_solve, "sort": _sort,
    "by_columns": _by_columns, "split": _split, "stack": _stack, "unstack": _unstack,
}  # fmt: skip


def written(name: str, params: Parameters, operands: Sequence[Shaped]) -> ClosedJaxpr | None:
    """The jaxpr of a primitive by others; None for one that is not written so.

    Linear algebra is that of small real matrices, and few whole numbers are sorted.
    operands: their shapes and types
    """
    if name not in WRITTEN:
        return None
    if name in ("lu", "triangular_solve", "sort"):
        shape, kind = operands[0].shape, operands[0].dtype.kind
        axes, kinds = (1, "iu") if name == "sort" else (2, "f")
        if len(shape) != axes or kind not in kinds or params.get("num_keys", 1) != 1:
            return None
        if not 0 < min(shape) <= max(shape) <= MOST:
            return None
    like = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in operands]
    return jax.make_jaxpr(lambda *x: WRITTEN[name](*x, **params))(*like)
