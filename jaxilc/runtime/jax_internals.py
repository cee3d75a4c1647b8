"""All uses of parts of JAX that may change without notice, with a fallback for each.

These parts are `jax.extend.core.Primitive`, `jax.interpreters` (`ad`, `batching`, `mlir`) and
`jax.experimental.layout`. `rows_together` uses them to set the layout of arrays in RAM. Its
fallback does nothing; then programs are slower, and no result changes. The fallback is used

    if this version of JAX lacks one of these parts, or they behave differently. A RuntimeWarning,
    once in a process, reports this and names the version.
    if the environment variable JAXILC_JAX_INTERNALS is `off`, without a warning.

`jax.core.Tracer`, which other modules use, is a documented part of JAX.
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
    """The array x unchanged, but under `vmap` equal rows of all members are adjacent in RAM.

    x: (N, ...) an array or tracer, whose rows are along the leading axis
    turned: how the layout is requested from XLA. False, for the carry of a loop: as a layout of the
        axes in their present order. True, for the rows of a scan: as an array with transposed axes.
    """
    bind = _bind()
    return x if bind is None else bind(x, axis=0, turned=turned)


def why_not() -> str | None:
    """The reason why the fallback is used; None where it is not used."""
    return _found()[1]


def _bind() -> Callable[..., Any] | None:
    return _found()[0]


@cache
def _found() -> tuple[Callable[..., Any] | None, str | None]:
    """The function `bind` of the primitive and None, or None and the reason for the fallback."""
    if os.environ.get(SWITCH, "") == "off":
        return None, f"{SWITCH} is off"
    try:
        bind = _primitive()
        _try_out(bind)
    except Exception as error:  # another version of JAX may raise any error
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
    """The function `bind(x, axis, turned)` of a primitive that sets the layout of an array.

    The primitive is the identity, and requests a layout in which the elements along `axis` come
    first.
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
    """Try the primitive with `vmap`, `grad`, `jvp` and the lowering to XLA, without compiling.

    Raises the error of JAX where one of them does not work.
    """

    def both_ways(x):
        turned = [bind(x, axis=0, turned=turned) for turned in (False, True)]
        return jnp.sum(turned[0] * turned[1])

    one = jax.ShapeDtypeStruct((2, 3, 1), jnp.result_type(float))
    whole = jax.vmap(lambda x: (jax.grad(both_ways)(x), jax.jvp(both_ways, (x,), (x,))))
    jax.jit(whole).lower(one)
