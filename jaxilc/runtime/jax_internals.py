"""The parts of JAX that it may change without notice, all in this one place, each with a fallback.

Used here: `jax.extend.core.Primitive`, `jax.interpreters` (`ad`, `batching`, `mlir`) and
`jax.experimental.layout`. They give `rows_together` its effect on where arrays lie. Its fallback
does nothing, which costs time and changes no result. It is taken

    where this version of JAX lacks one of these parts, or handles it differently: a RuntimeWarning
    says so once a process, and names the version
    where the environment variable JAXILC_JAX_INTERNALS is `off`, without a warning

`jax.core.Tracer`, which other modules ask for, is a documented part of JAX.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp

SWITCH = "JAXILC_JAX_INTERNALS"


def rows_together(x, *, turned: bool):
    """x itself; under `vmap`, the rows (the leading axis) of all its members lie side by side.

    x: (N, ...) an array or tracer
    turned: how XLA is told. Of a loop's carry it takes a layout of the axes as they are, of a
    scan's rows an array whose axes are transposed.
    """
    bind = _bind()
    return x if bind is None else bind(x, axis=0, turned=turned)


def why_not() -> str | None:
    """Why the fallback is taken, None where it is not."""
    return _found()[1]


def _bind() -> Callable[..., Any] | None:
    return _found()[0]


@cache
def _found() -> tuple[Callable[..., Any] | None, str | None]:
    """`bind` of the primitive, or None and the reason."""
    if os.environ.get(SWITCH, "") == "off":
        return None, f"{SWITCH} is off"
    try:
        bind = _primitive()
        _try_out(bind)
    except Exception as error:  # whatever another version of JAX says
        reason = f"{type(error).__name__}: {error}"
        warnings.warn(
            f"jaxilc does not know how JAX {jax.__version__} lays out arrays ({reason}); results "
            "stay the same, and loops over many machines run slower",
            RuntimeWarning,
            stacklevel=2,
        )
        return None, reason
    return bind, None


def _primitive() -> Callable[..., Any]:
    """`bind(x, axis, turned)` of a primitive that is the identity, and asks for a layout in which
    the elements along `axis` come first.
    """
    from jax.experimental.layout import Layout, with_layout_constraint
    from jax.extend.core import Primitive
    from jax.interpreters import ad, batching, mlir

    def placed(x, *, axis, turned):
        if axis == 0:
            return x
        if not turned:
            order = (axis, *(i for i in range(x.ndim) if i != axis))
            return with_layout_constraint(x, Layout(major_to_minor=order))
        rows = jnp.moveaxis(x, axis, 0)
        rows = with_layout_constraint(rows, Layout(major_to_minor=tuple(range(x.ndim))))
        return jnp.moveaxis(rows, 0, axis)

    def batched(args, dims, *, axis, turned):
        x = jnp.moveaxis(args[0], dims[0], 0)
        return by_sample.bind(x, axis=axis + 1, turned=turned), 0

    by_sample = Primitive("by_sample")
    by_sample.def_impl(lambda x, **_: x)
    by_sample.def_abstract_eval(lambda x, **_: x)
    mlir.register_lowering(by_sample, mlir.lower_fun(placed, multiple_results=False))
    ad.deflinear2(by_sample, lambda cotangent, _, **how: [by_sample.bind(cotangent, **how)])
    batching.primitive_batchers[by_sample] = batched
    return by_sample.bind


def _try_out(bind: Callable[..., Any]) -> None:
    """Take the primitive through `vmap`, a derivative either way, and the lowering to XLA; nothing
    is compiled. Raises whatever JAX does where it handles one of them differently.
    """

    def both_ways(x):
        turned = [bind(x, axis=0, turned=turned) for turned in (False, True)]
        return jnp.sum(turned[0] * turned[1])

    one = jax.ShapeDtypeStruct((2, 3, 1), jnp.result_type(float))
    whole = jax.vmap(lambda x: (jax.grad(both_ways)(x), jax.jvp(both_ways, (x,), (x,))))
    jax.jit(whole).lower(one)
