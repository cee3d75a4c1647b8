"""All uses of parts of JAX that may change without notice, with a fallback for each.

These parts are `jax.extend.core.Primitive`, `jax.interpreters` (`ad`, `batching`, `mlir`) and
`jax.experimental.layout`. Without them `rows_together` does nothing, `product_by_columns` leaves
its derivatives to JAX, and `jax.custom_jvp` and `custom_vmap` stand in for `with_slope` and
`with_batches`; then programs are slower, and results are the same up to their rounding, but for
second derivatives in reverse mode, which lose a part. The fallbacks are used

    if this version of JAX lacks one of these parts, or they behave differently. A RuntimeWarning,
    once in a process, reports this and names the version.
    if the environment variable JAXILC_JAX_INTERNALS is `off`, without a warning.

`sealed_programs` gives each program in the cache of JAX a checksum; without the part that it
replaces, `jax._src.compilation_cache`, the cache stays as JAX has it. So does that of
`arrays_by_precision`, without `jax._src.dtypes`.

`jax.core.Tracer`, which other modules use, is a documented part of JAX.
"""

from __future__ import annotations

import hashlib
import os
import warnings
from collections.abc import Callable
from contextlib import suppress
from functools import cache, partial
from typing import TYPE_CHECKING, NamedTuple, NoReturn, TypeAlias, TypeVar

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import custom_vmap

from ..pytree.aliases import Array, Function, Tree, Value

if TYPE_CHECKING:  # types that the compiler of learning names, none of which is used at run time
    from jax.extend.core import ClosedJaxpr as ClosedJaxpr
    from jax.extend.core import Jaxpr as Jaxpr
    from jax.extend.core import JaxprEqn as JaxprEqn
    from jax.extend.core import Literal as Literal
    from jax.extend.core import Var as Var

T = TypeVar("T")
Lists: TypeAlias = Callable[..., list[Array]]
SWITCH = "JAXILC_JAX_INTERNALS"
COLUMNS = 8  # of a matrix, up to which their sum is faster than a matrix product


def rows_together(x: Array, *, turned: bool) -> Array:
    """The array x unchanged, but under `vmap` equal rows of all members are adjacent in RAM.

    x: (N, ...) an array or tracer, whose rows are along the leading axis
    turned: how the layout is requested from XLA. False, for the carry of a loop: as a layout of the
        axes in their present order. True, for the rows of a scan: as an array with transposed axes.
    """
    known = _found()[0]
    return x if known is None else known.rows(x, axis=0, turned=turned)


def product_by_columns(matrix: Array, vector: Array) -> Array:
    """matrix (m, n) @ vector (n,) as the sum of the n columns, n >= 1, each times its number.

    The derivatives by matrix and vector are products of this kind, too. JAX would put together the
    derivative by the vector from a padded array for each column, in every sample of a loop: a
    gradient through P-type learning of a plant with 8 states took twice as long. JAX keeps them
    where it follows what differs from device to device (`shard_map` with `check_vma`).
    """
    known = _found()[0]
    if known is None or _followed(matrix) or _followed(vector):
        return _sum_of_columns(matrix, vector)
    dtype = jnp.result_type(matrix, vector)  # of both, so that each slope has its operand's type
    return known.product(jnp.asarray(matrix, dtype), jnp.asarray(vector, dtype))


def with_slope(function: Function, slope: Function) -> Function:
    """The function, with a derivative of its own, which may be differentiated again.

        d function(x) = slope(x, dx),    x: tuple of the arguments, dx: tuple of their tangents

    `jax.custom_jvp` says the same. But where JAX divides a loop for reverse mode into what is known
    before and what depends on the differentiated variable, it drops the rule from the first part,
    so that a second derivative takes the derivative of the function as it is written. Here the rule
    stays. Arguments and results are trees of arrays of floating point numbers; neither function may
    use tracers that are not among its arguments.
    """

    def ruled(*arguments: Tree) -> Tree:
        known = _found()[0]
        if known is None:
            plain = jax.custom_jvp(function)
            plain.defjvp(lambda at, by: (plain(*at), slope(at, by)))
            return plain(*arguments)
        values, tree = jax.tree.flatten(arguments)
        result = jax.tree.structure(jax.eval_shape(function, *arguments))

        def value_of(values: list[Array]) -> list[Array]:
            return jax.tree.leaves(function(*jax.tree.unflatten(tree, values)))

        def slope_of(*both: list[Array]) -> list[Array]:
            return jax.tree.leaves(slope(*(jax.tree.unflatten(tree, x) for x in both)))

        return jax.tree.unflatten(result, known.ruled(*values, value=value_of, slope=slope_of))

    return ruled


def of_any_ranks(function: T) -> T:
    """The function, in which arrays of other ranks may meet, whatever a user asks of his own."""
    allowing: T = jax.numpy_rank_promotion("allow")(function)
    return allowing


def once(arguments: T, refusal: str) -> T:
    """The tree of arrays itself; raises ValueError with this message where it is differentiated.

    What a rule of `with_slope` computes from `once(x)` has no further derivative by x.
    """

    def refuse(at: Tree, by: Tree) -> NoReturn:
        raise ValueError(refusal)

    return jax.tree.map(with_slope(lambda x: x, refuse), arguments)


def with_batches(function: Lists, batched: Lists, outs: tuple[jax.ShapeDtypeStruct, ...]) -> Lists:
    """The function of arrays, with a rule of its own for a batch.

    `jax.custom_batching.custom_vmap` says the same, but traces the function even where only its
    rule is used. Here it is traced when it is computed.

    batched: the results of a batch, from its size, whether each argument has an axis of the batch
        in front, and the arguments
    outs: shape and type of each result of the function
    """
    known = _found()[0]
    if known is None:
        plain = custom_vmap(function)
        plain.def_vmap(lambda count, moved, *x: (batched(count, moved, *x), [True] * len(outs)))
        return plain
    return partial(known.batches, function=function, rule=batched, outs=outs)


def sealed_programs() -> None:
    """Let JAX keep a program together with a checksum over it and its key.

    JAX takes what it finds under a key: of a damaged program it warns, one that was exchanged for
    another ends in an AssertionError or computes something else. With the checksum both are
    removed, compiled again and written again. A program that cannot be written is not kept.
    """
    try:
        from jax._src import compilation_cache
        from jax._src.lru_cache import LRUCache
    except ImportError:
        return

    class Sealed(LRUCache):
        def get(self, key: str) -> bytes | None:
            found = super().get(key)
            if found is None or found[:32] == seal(key, found[32:]):
                return found and found[32:]
            with suppress(OSError):
                (self.path / f"{key}-cache").unlink()
            return None

        def put(self, key: str, value: bytes) -> None:
            with suppress(OSError):
                super().put(key, seal(key, value) + value)

    def opened(path: str) -> tuple[Sealed, str]:
        return Sealed(path, max_size=jax.config.jax_compilation_cache_max_size), path

    compilation_cache.get_file_cache = opened  # ty: ignore[invalid-assignment]


@cache
def arrays_by_precision() -> None:
    """Let JAX keep what it makes of an array of NumPy for each precision apart.

    JAX keeps it by the array alone, while anything holds it, such as a program with this array
    among its constants. After a change of the precision it would hand it, in the other precision,
    to each program of which the array is an argument: an error of JAX (E0102).
    """
    try:
        from jax._src import dtypes, lib
        from jax._src.literals import TypedNdArray

        kept_by: Function = vars(lib)["weakref_lru_cache"].weak_key_weak_value_cache
        register: Function = vars(dtypes)["register_canonicalize_value_handler"]
    except (ImportError, KeyError, AttributeError):
        return
    made = cache(lambda dtype: kept_by(lambda x: TypedNdArray(np.asarray(x, dtype))))
    register(np.ndarray, lambda x: made(dtypes.canonicalize_dtype(x.dtype))(x))


def seal(key: str, value: bytes) -> bytes:
    """The 32 bytes before what is kept under a key."""
    return hashlib.sha256(key.encode() + b"\0" + value).digest()


def why_not() -> str | None:
    """The reason why the fallbacks are used; None where they are not used."""
    return _found()[1]


class Known(NamedTuple):
    """The functions `bind` of the primitives."""

    rows: Function  # of `rows_together`
    product: Function  # of `product_by_columns`
    ruled: Function  # of `with_slope`
    batches: Function  # of `with_batches`


@cache
def _found() -> tuple[Known | None, str | None]:
    """What is known of this version of JAX and None, or None and the reason for the fallbacks."""
    if os.environ.get(SWITCH, "") == "off":
        return None, f"{SWITCH} is off"
    try:
        known = Known(
            _rows_primitive(), _product_primitive(), _ruled_primitive(), _batches_primitive()
        )
        _try_out(known)
    except Exception as error:  # another version of JAX may raise any error
        reason = f"{type(error).__name__}: {error}"
        warnings.warn(
            f"jaxilc does not know how JAX {jax.__version__} lays out arrays ({reason}); loops "
            "over many machines run slower, and second derivatives in reverse mode lose a part. "
            "All other results stay the same",
            RuntimeWarning,
            stacklevel=2,
        )
        return None, reason
    return known, None


def _primitive(
    name: str, value: Function, shaped: Function, batched: Function, *, several: bool = False
) -> Value:
    """A new primitive that computes a value, one array or several, with its rule for batches."""
    from jax.extend.core import Primitive
    from jax.interpreters import batching, mlir

    made = Primitive(name)
    made.multiple_results = several
    made.def_impl(value)
    made.def_abstract_eval(shaped)
    mlir.register_lowering(made, mlir.lower_fun(value, multiple_results=several))
    batching.primitive_batchers[made] = batched
    return made


def _rows_primitive() -> Function:
    """The function `bind(x, axis, turned)` of a primitive that sets the layout of an array.

    The primitive is the identity, and requests a layout in which the elements along `axis` come
    first.
    """
    from jax.experimental.layout import Layout, with_layout_constraint
    from jax.interpreters import ad

    def placed(x: Array, *, axis: int, turned: bool) -> Array:
        if axis == 0:
            return x
        if not turned:
            order = (axis, *(i for i in range(x.ndim) if i != axis))
            return with_layout_constraint(x, Layout(major_to_minor=order))
        rows = jnp.moveaxis(x, axis, 0)
        rows = with_layout_constraint(rows, Layout(major_to_minor=tuple(range(x.ndim))))
        return jnp.moveaxis(rows, 0, axis)

    def batched(
        args: list[Array], dims: list[int], *, axis: int, turned: bool
    ) -> tuple[Array, int]:
        x = jnp.moveaxis(args[0], dims[0], 0)
        return by_sample.bind(x, axis=axis + 1, turned=turned), 0

    by_sample = _primitive("by_sample", placed, lambda x, **_: x, batched)
    by_sample.def_impl(lambda x, **_: x)
    ad.deflinear2(by_sample, lambda cotangent, _, **how: [by_sample.bind(cotangent, **how)])
    return by_sample.bind


def _followed(x: Array) -> bool:
    """Whether JAX follows on which devices x differs; its type has names for it that changed."""
    kind = jax.typeof(x)
    return bool(getattr(getattr(kind, "mat", None), "varying", None) or getattr(kind, "vma", None))


def _sum_of_columns(matrix: Array, vector: Array) -> Tree:
    """The products of matrices (..., m, n) and vectors (..., n)."""
    return sum(matrix[..., j] * vector[..., j, None] for j in range(matrix.shape[-1]))


def _product_primitive() -> Function:
    """The function `bind(matrix, vector)` of a primitive that is linear in each of the two.

    Its operands are (..., m, n) and (..., n), with as many axes before these. Such an axis has the
    length 1 in an operand that is the same for all members of a batch.
    """
    from jax.interpreters import ad

    def shaped(matrix: Array, vector: Array) -> jax.core.ShapedArray:
        before = np.broadcast_shapes(matrix.shape[:-2], vector.shape[:-1])
        return jax.core.ShapedArray((*before, matrix.shape[-2]), matrix.dtype)

    def summed(slope: Array, operand: Tree) -> Array:
        """The slope by an operand, added up over the members that share it."""
        shared = enumerate(zip(slope.shape, operand.aval.shape, strict=True))
        return jnp.sum(slope, [i for i, (n, own) in shared if own == 1 != n], keepdims=True)

    def by_matrix(slope: Array, matrix: Array, vector: Array) -> Array:
        return summed(slope[..., :, None] * vector[..., None, :], matrix)

    def by_vector(slope: Array, matrix: Array, vector: Array) -> Array:
        if 0 < matrix.shape[-2] <= COLUMNS:
            return summed(by_columns.bind(jnp.swapaxes(matrix, -1, -2), slope), vector)
        return summed(jnp.sum(matrix * slope[..., :, None], axis=-2), vector)

    def batched(operands: list[Array], dims: list[int | None]) -> tuple[Array, int]:
        pairs = zip(operands, dims, strict=True)
        return by_columns.bind(
            *(x[None] if d is None else jnp.moveaxis(x, d, 0) for x, d in pairs)
        ), 0

    by_columns = _primitive("by_columns", _sum_of_columns, shaped, batched)
    ad.defbilinear(by_columns, by_matrix, by_vector)
    return by_columns.bind


def _ruled_primitive() -> Function:
    """The function `bind(*x, value, slope)` of a primitive with a value and a rule for its slope.

    value: from a list of arrays to a list of arrays
    slope: from two such lists, the arguments and their tangents, to a list of the tangents of value
    """
    from jax.interpreters import ad

    def shaped(*x: Tree, value: Lists, slope: Lists) -> list[jax.core.ShapedArray]:
        return jax.make_jaxpr(value)(list(x)).out_avals

    def moved(
        x: list[Array], dx: list[Array], *, value: Lists, slope: Lists
    ) -> tuple[list[Array], list[Array]]:
        dx = [ad.instantiate_zeros(d) for d in dx]
        return ruled.bind(*x, value=value, slope=slope), slope(list(x), dx)

    def batched(
        x: list[Array], axes: list[int | None], *, value: Lists, slope: Lists
    ) -> tuple[list[Array], list[int]]:
        dims = list(axes)
        found = ruled.bind(*x, value=jax.vmap(value, (dims,)), slope=jax.vmap(slope, (dims, dims)))
        return found, [0] * len(found)

    def evaluated(*x: Array, value: Lists, slope: Lists) -> list[Array]:
        return value(list(x))

    ruled = _primitive("ruled", evaluated, shaped, batched, several=True)
    ad.primitive_jvps[ruled] = moved
    return ruled.bind


def _batches_primitive() -> Function:
    """The function `bind(*x, function, rule, outs)` of a primitive with a rule for batches."""

    def batched(
        x: list[Array], dims: list[int], *, rule: Lists, **_: Value
    ) -> tuple[list[Array], list[int]]:
        moved = [d is not None for d in dims]
        front = [jnp.moveaxis(a, d, 0) if m else a for a, d, m in zip(x, dims, moved, strict=True)]
        found = rule(front[moved.index(True)].shape[0], moved, *front)
        return found, [0] * len(found)

    def evaluated(*x: Array, function: Lists, **_: Value) -> list[Array]:
        return function(*x)

    def shaped(*_: Array, outs: Value, **how: Value) -> list[jax.core.ShapedArray]:
        return [jax.core.ShapedArray(x.shape, x.dtype) for x in outs]

    return _primitive("batches", evaluated, shaped, batched, several=True).bind


def _try_out(known: Known) -> None:
    """Try the primitives with `vmap`, `grad`, `jvp` and the lowering to XLA, without compiling.

    Raises the error of JAX where one of them does not work.
    """

    def all_ways(x: Array) -> Array:
        turned = [known.rows(x, axis=0, turned=turned) for turned in (False, True)]
        product = known.product(turned[0] * turned[1], x[0])
        return jnp.sum(known.ruled(product, value=lambda x: x, slope=lambda x, dx: dx)[0])

    def batch(x: Array) -> list[Array]:
        double = {"function": lambda x: [2 * x], "rule": lambda n, moved, x: [2 * x]}
        return known.batches(x, **double, outs=(jax.ShapeDtypeStruct(x.shape, x.dtype),))

    one = jax.ShapeDtypeStruct((2, 3, 1), jnp.result_type(float))
    whole = jax.vmap(lambda x: (jax.grad(all_ways)(x), jax.jvp(all_ways, (x,), (x,)), batch(x)))
    jax.jit(whole).lower(one)
