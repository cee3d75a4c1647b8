"""From a function to the steps that every printer knows: the intermediate form of the export.

A function is traced with fixed sizes and lowered as by `native.program`. Each step is written by
the operations of `interpreter` as it comes: steps on constants are carried out, complex numbers
become pairs of real ones, and transforms, solutions of linear equations and convolutions become
loops of sums. What cannot be written so is refused by name.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike

from ..native.operations import MOVES, elementwise, formula, places_of, uniform
from ..native.program import (
    WRITTEN,
    Const,
    Known,
    Lowering,
    Parameters,
    Program,
    Step,
    Unknown,
    Value,
    without_dead,
)
from ..pytree.aliases import Array, Function, Tree
from .interpreter import carried_out, known

if TYPE_CHECKING:
    from ..runtime.jax_internals import ClosedJaxpr, Jaxpr

LARGEST_DENSE = 16  # prime factor of the length of a transform up to which its matrix is stored
# why a step that remains is refused
REASONS = {
    "random_bits": "the law draws random numbers, which a controller cannot repeat",
    "sort": "the law sorts its samples, which takes a time that is not known beforehand",
    "eigh": "the law needs eigenvalues of a matrix that is known only while it runs",
}


class Pair(Value):
    """A complex array as two real ones."""

    def __init__(self, re: Value, im: Value):
        self.parts = re, im
        super().__init__(re.shape, np.dtype(complex))


def program_of(function: Function, *operands: Tree) -> Program:
    """The steps of a function of trees of arrays, flattened; raises Unknown for what is refused."""
    return program_and_result(function, *operands)[0]


def program_and_result(function: Function, *operands: Tree) -> tuple[Program, Tree]:
    """The steps of a function, and the shapes and types of its result in the tree that it is."""
    traced, result = jax.make_jaxpr(function, return_shape=True)(*operands)
    if any(map(_is_key, traced.consts)):
        raise Unknown(REASONS["random_bits"])
    return _with_formulas(without_dead(_written(traced))), result


def _with_formulas(program: Program) -> Program:
    """The program; raises Unknown where the types of a step have no formula."""
    for step in program.steps:
        if elementwise(step.name):
            formula(step)
        for part in {"condition", "body"} & step.params.keys():
            _with_formulas(step.params[part])
    return program


def _written(closed: ClosedJaxpr) -> Program:
    return _Writer(0).program(closed)


class _Writer(Lowering):
    """What adds the steps of jaxprs as they are written by known operations."""

    def inlined(self, of: Jaxpr | ClosedJaxpr, ins: Sequence[Value]) -> list[Value]:
        return [*map(_in_parts, super().inlined(of, ins))]

    def one(self, step: Step) -> Sequence[Value]:
        name, ins = step.name, [*map(_in_parts, step.ins)]
        if name == "scan" and not step.params["length"]:  # no language has arrays without elements
            n, m = step.params["consts"], step.params["carry"]
            return [*ins[n : n + m], *(Const(np.zeros(x.shape, x.dtype)) for x in step.outs[m:])]
        arrays = [x for x in map(_known, ins) if x is not None]
        all_known = len(arrays) == len(ins)
        if all_known and name not in ("scan", "while"):
            return self.constant(step, ins, arrays)
        if any(isinstance(x, Pair) for x in ins) or any(_complex(x) for x in step.outs):
            if name == "scan" and all_known:
                return self.constant(step, ins, arrays)
            if name not in COMPLEX:
                raise Unknown(f"{name} of complex numbers")
            return COMPLEX[name](self, step, ins)
        if name == "select_n" and isinstance(ins[0], Const) and uniform(ins[0].array):
            return [ins[1 + int(np.ravel(ins[0].array)[0])]]
        if name == "integer_pow" and not step.params["y"]:  # which does not read its operand
            return [Const(np.ones(x.shape, x.dtype)) for x in step.outs]
        if name == "conv_general_dilated":
            return self.traced(partial(_convolved, step), ins)
        if name in IN_ORDER:
            return self.traced(IN_ORDER[name], ins)
        if name in ("lu", "triangular_solve"):  # of more rows than `lowered` writes
            return self.traced(partial(WRITTEN[name], **step.params), ins)
        if name in ("gather", "scatter", "scatter-add"):
            return self.moved(step, ins)
        if name == "scan":
            params = step.params | {"body": _written(step.params["jaxpr"])}
            if all_known:
                return self.constant(Step("scan", params, ins, step.outs), ins, arrays)
            return self.added("scan", params, ins, step.outs)
        if name == "while":
            return self.loop(step, ins)
        if not known(name):
            kind = "random_bits" if name.startswith("random") else name
            raise Unknown(REASONS.get(kind, f"the operation {name} is not among the known ones"))
        return self.added(name, step.params, ins, step.outs)

    def added(
        self, name: str, params: Parameters, ins: list[Value], outs: Sequence[Value]
    ) -> list[Value]:
        self.steps.append(Step(name, params, ins, [*outs]))
        return [*outs]

    def traced(self, function: Function, ins: Sequence[Value]) -> list[Value]:
        """What stands for the results of a function of JAX on these operands; constants stay so."""
        free = [i for i, x in enumerate(ins) if not isinstance(x, Const)]

        def of_free(*values: Array) -> list[Array]:
            given = dict(zip(free, values, strict=True))
            return jax.tree.leaves(
                function(*(given.get(i, getattr(x, "array", None)) for i, x in enumerate(ins)))
            )

        shapes = [jax.ShapeDtypeStruct(ins[i].shape, ins[i].dtype) for i in free]
        return self.inlined(jax.make_jaxpr(of_free)(*shapes), [ins[i] for i in free])

    def constant(self, step: Step, ins: list[Value], arrays: list[Known]) -> list[Value]:
        """The results of a step on operands that are these arrays, by JAX if need be."""
        special = any(isinstance(x, Pair) or _is_key(x) for x in ins)
        real = not special and not any(_complex(x) or _is_key(x) for x in step.outs)
        if known(step.name) and real:
            with suppress(Unknown):  # numbers of a type that only constants have
                return [Const(x) for x in carried_out(step, [np.asarray(x) for x in arrays])]
        if step.name == "scan":
            return [Const(np.asarray(x)) for x in _scanned(step, arrays)]
        found = step.bound(*arrays)
        return [Const(x if _is_key(x) else np.asarray(x)) for x in found]

    def moved(self, step: Step, ins: list[Value]) -> list[Value]:
        """A step that moves numbers to places: a table where these are known, else one row."""
        places = ins[1]
        if not isinstance(places, Const):
            return self.traced(partial(_at_places, step), ins)
        shape, dtype = ins[0].shape, ins[0].dtype
        found = places_of(step, shape, places.array, ins[-1].shape)
        if step.name == "gather":
            return self.added("take", {"table": found}, [ins[0]], step.outs)
        if len({*found.flat} - {-1}) < found.size:
            raise Unknown(f"{step.name} to one place more than once")
        table = np.arange(math.prod(shape))
        table[found.ravel()] = table.size + np.arange(found.size)
        table = table.reshape(shape)

        def flat(*arrays: Array) -> Array:
            return jnp.concatenate([jnp.ravel(x) for x in arrays])

        if step.name == "scatter":
            joined = self.traced(flat, [ins[0], ins[2]])
            return self.added("take", {"table": table}, joined, step.outs)
        joined = self.traced(flat, [Const(np.zeros(table.size, dtype)), ins[2]])
        (more,) = self.added("take", {"table": table}, joined, [Value(shape, dtype)])
        return self.traced(jnp.add, [ins[0], more])

    def loop(self, step: Step, ins: list[Value]) -> list[Value]:
        """A loop with a condition, which must count up to a bound."""
        params = step.params
        n, m = params["cond_nconsts"], params["body_nconsts"]
        condition, body = (
            without_dead(_written(params[key])) for key in ("cond_jaxpr", "body_jaxpr")
        )
        bound = _bound(condition, body, ins[n + m :], n, m)
        of = {"condition": condition, "body": body, "bound": bound, "of_condition": n}
        return self.added("while", of | {"of_body": m}, ins, step.outs)


def _scanned(step: Step, arrays: list[Known]) -> list[Array]:
    """The results of a loop on constants, by JAX."""
    of, inner = step.params, step.params["jaxpr"]
    n, m = of["consts"], of["consts"] + of["carry"]

    def body(carry: list[Array], rows: list[Array]) -> tuple[list[Array], list[Array]]:
        outs = jax.core.eval_jaxpr(inner.jaxpr, inner.consts, *arrays[:n], *carry, *rows)
        return outs[: of["carry"]], outs[of["carry"] :]

    rows = list(map(jnp.asarray, arrays[m:]))
    carry, kept = lax.scan(body, list(map(jnp.asarray, arrays[n:m])), rows, length=of["length"],
                           reverse=of["reverse"])  # fmt: skip
    return [*carry, *kept]


def _known(x: Value) -> Known | None:
    """The array that stands for a value, None where it is not known beforehand."""
    if isinstance(x, Pair):
        re, im = map(_known, x.parts)
        return None if re is None or im is None else np.asarray(re) + 1j * np.asarray(im)
    return x.array if isinstance(x, Const) else None


def _in_parts(x: Value) -> Value:
    """A complex constant as two real ones; others as they are."""
    if not isinstance(x, Const) or not _complex(x):
        return x
    return Pair(Const(np.real(x.array)), Const(np.imag(x.array)))


def _complex(x: Value) -> bool:
    return not _is_key(x) and np.issubdtype(np.dtype(x.dtype), np.complexfloating)


def _is_key(x: Value | Array) -> bool:
    return bool(jnp.issubdtype(x.dtype, jax.dtypes.extended))


def _bound(condition: Program, body: Program, first: list[Value], n: int, m: int) -> int:
    """The passes that a loop makes at most: the body counts up, or halves, to a constant.

    first: what the carried values are before the loop
    Raises Unknown where the condition has no such comparison.
    """
    made = {step.outs[0]: step for step in condition.steps}
    turned = {step.outs[0]: step for step in body.steps}
    todo = [condition.outs[0]]
    while todo:
        step = made.get(todo.pop())
        if step is None:
            continue
        if step.name == "and":
            todo += step.ins
        if step.name not in ("lt", "gt") or step.ins[0] not in condition.ins:
            continue
        i = condition.ins.index(step.ins[0]) - n
        one = turned.get(body.outs[i]) if i >= 0 else None
        if one is None or body.ins[m + i] != one.ins[0] or not isinstance(step.ins[1], Const):
            continue
        factor, last, before = one.ins[-1], float(step.ins[1].array), first[i]
        by = float(factor.array) if isinstance(factor, Const) else 0.0
        start = float(before.array) if isinstance(before, Const) else None
        if (step.name, one.name, by) == ("lt", "add", 1.0) and start is not None:
            return max(0, math.ceil(last - start))
        halves = (one.name, by) in (("div", 2.0), ("mul", 0.5))
        if step.name == "gt" and halves and start is not None and last > 0:
            return math.ceil(math.log2(start / last)) + 1
    raise Unknown("the law has a loop of which nobody knows how long it takes")


# What is written by other operations
# --------------------------------------------------------------------------------------------------

# the order of all numbers, in which NaN comes last; -0 counts as 0, as for NumPy
IN_ORDER: dict[str, Function] = {
    "lt_to": lambda x, y: (x < y) | ((x == x) & (y != y)),
    "le_to": lambda x, y: (x <= y) | (y != y),
}


def _convolved(step: Step, x: Array, kernel: Array) -> Array:
    """A convolution of rows (batch, channels, samples) as a sum of shifted rows."""
    of = step.params
    numbers = of["dimension_numbers"]
    plain = all(s == tuple(range(3)) for s in numbers) and kernel.shape[:2] == (1, 1)
    ones = ("window_strides", "lhs_dilation", "rhs_dilation")
    if not plain or x.shape[1] != 1 or any(tuple(of[name]) != (1,) for name in ones):
        raise Unknown("a convolution of several channels")
    x = jnp.pad(x, ((0, 0), (0, 0), of["padding"][0]))
    taps = kernel.shape[-1]
    rows = x.shape[-1] - taps + 1

    def add(total: Array, i: Array) -> tuple[Array, None]:
        part = lax.dynamic_slice_in_dim(x, i, rows, axis=2, allow_negative_indices=False)
        tap = lax.dynamic_slice_in_dim(kernel, i, 1, axis=2, allow_negative_indices=False)
        return total + tap * part, None

    shape = (*x.shape[:2], rows)
    return lax.scan(add, jnp.zeros(shape, x.dtype), jnp.arange(taps, dtype=jnp.int32))[0]


def _at_places(step: Step, operand: Array, places: Array, *_: Array) -> Array:
    """Parts read at places that are known while the law runs, one after another.

    Places beyond the end are moved to it, or read the value that fills, as the step says.
    """
    of, shape = step.params, step.outs[0].shape
    if step.name != "gather" or of["dimension_numbers"].operand_batching_dims:
        raise Unknown(f"{step.name} at several places that are found while it runs")
    numbers, sizes = of["dimension_numbers"], of["slice_sizes"]
    axes = numbers.start_index_map
    last = np.array([operand.shape[axis] - sizes[axis] for axis in axes])

    def part(place: Array) -> Array:
        where = [jnp.zeros((), place.dtype)] * operand.ndim
        for i, axis in enumerate(axes):
            where[axis] = place[i]
        found = lax.dynamic_slice(operand, where, sizes, allow_negative_indices=False)
        if of["mode"] == lax.GatherScatterMode.FILL_OR_DROP:
            inside = jnp.all((place >= 0) & (place <= last))
            found = jnp.where(inside, found, _filling(of["fill_value"], found.dtype))
        return found.reshape(
            [n for i, n in enumerate(sizes) if i not in numbers.collapsed_slice_dims]
        )

    if places.ndim == 1:
        return part(places)
    found = lax.map(part, places.reshape(-1, len(axes)))
    found = found.reshape(*places.shape[:-1], *found.shape[1:])
    batch = [i for i in range(len(shape)) if i not in numbers.offset_dims]
    return jnp.transpose(found, np.argsort([*batch, *numbers.offset_dims]).tolist())


def _filling(value: float | None, dtype: np.dtype) -> float:
    """What is read beyond the end where nothing else is said, as JAX has it."""
    if value is not None or dtype.kind in "fb":
        return np.nan if value is None else value
    return np.iinfo(dtype).min if dtype.kind == "i" else np.iinfo(dtype).max


# Complex numbers
# --------------------------------------------------------------------------------------------------


def dft(re: Array, im: Array, sign: float) -> tuple[Array, Array]:
    """The discrete Fourier transform along the last axis, by factors (Cooley and Tukey 1965).

        X[k + m s] = sum_q w_p^(q s) w_n^(q k) Y_q[k],    w_n = exp(sign 2 pi i / n), n = p m

    where Y_q is the transform of every p-th sample from q on.
    """
    lead, n = re.shape[:-1], re.shape[-1]
    if n == 1:
        return re, im
    p = 4 if n % 4 == 0 else next(d for d in range(2, n + 1) if n % d == 0)
    m, many = n // p, math.prod(lead)
    # all axes but the last are one, so that loops do not nest deeper with each factor
    re, im = (jnp.moveaxis(x.reshape(many, m, p), 2, 1).reshape(many * p, m) for x in (re, im))
    re, im = (x.reshape(many, p, m) for x in dft(re, im, sign))
    turn = sign * 2 * np.pi * np.outer(np.arange(p), np.arange(m)) / n
    re, im = _product(re, im, np.cos(turn), np.sin(turn))
    if p > LARGEST_DENSE:
        re, im = (jnp.moveaxis(x, 1, 2).reshape(many * m, p) for x in (re, im))
        found = _by_chirps(re, im, sign)
        re, im = (jnp.moveaxis(x.reshape(many, m, p), 2, 1) for x in found)
    else:
        w = np.exp(sign * 2j * np.pi * (np.outer(np.arange(p), np.arange(p)) % p) / p)
        c, s = w.real, w.imag
        re, im = (jnp.matmul(c, re) - jnp.matmul(s, im), jnp.matmul(c, im) + jnp.matmul(s, re))
    return re.reshape(*lead, n), im.reshape(*lead, n)


def _by_chirps(re: Array, im: Array, sign: float) -> tuple[Array, Array]:
    """The transform of a long prime length, as a convolution (Bluestein 1970).

    X[k] = w[k] sum_j (x[j] w[j]) conj(w[k - j]),    w[k] = exp(sign pi i k^2 / n)
    """
    n = re.shape[-1]
    m = 2 ** math.ceil(math.log2(2 * n - 1))
    w = np.exp(sign * 1j * np.pi * (np.arange(n) ** 2 % (2 * n)) / n)
    around = np.concatenate([w, np.zeros(m - 2 * n + 1), w[:0:-1]])
    other = np.fft.fft(np.conj(around)) / m
    chirp = w.real, w.imag
    a, b = _product(re, im, *chirp)
    padding = [(0, 0)] * (re.ndim - 1) + [(0, m - n)]
    a, b = dft(jnp.pad(a, padding), jnp.pad(b, padding), -1.0)
    a, b = dft(*_product(a, b, other.real, other.imag), 1.0)
    return _product(a[..., :n], b[..., :n], *chirp)


def _product(a: Array, b: Array, c: ArrayLike, d: ArrayLike) -> tuple[Array, Array]:
    """(a + b i) (c + d i)"""
    return a * c - b * d, a * d + b * c


def _fft(writer: _Writer, step: Step, ins: list[Value]) -> list[Value]:
    kind, lengths = str(step.params["fft_type"]).rpartition(".")[2], step.params["fft_lengths"]
    kind = {"0": "FFT", "1": "IFFT", "2": "RFFT", "3": "IRFFT"}.get(kind, kind)
    if len(lengths) != 1:
        raise Unknown("a transform along several axes")
    n = lengths[0]

    def of_real(x: Array) -> tuple[Array, ...]:
        re, im = dft(x, jnp.zeros_like(x), -1.0)
        return re[..., : n // 2 + 1], im[..., : n // 2 + 1]

    def to_real(re: Array, im: Array) -> Array:
        rest = slice((n - 1) // 2, 0, -1)
        im = im.at[..., 0].set(0.0) if n % 2 else im.at[..., np.array([0, n // 2])].set(0.0)
        re = jnp.concatenate([re, re[..., rest]], axis=-1)
        im = jnp.concatenate([im, -im[..., rest]], axis=-1)
        return dft(re, im, 1.0)[0] / n

    if kind == "RFFT":
        return [Pair(*writer.traced(of_real, ins))]
    if kind == "IRFFT":
        return writer.traced(to_real, _as_pair(ins[0]).parts)
    scale = 1.0 if kind == "FFT" else 1.0 / n
    both = partial(dft, sign=-1.0 if kind == "FFT" else 1.0)
    return [
        Pair(*writer.traced(lambda x, y: [scale * z for z in both(x, y)], _as_pair(ins[0]).parts))
    ]


def _as_pair(x: Value) -> Pair:
    return x if isinstance(x, Pair) else Pair(x, Const(np.zeros(x.shape)))


def _of_pairs(function: Function) -> Callable[[_Writer, Step, list[Value]], list[Value]]:
    """A step on complex numbers as a function of the real and imaginary parts of its operands."""

    def write(writer: _Writer, step: Step, ins: list[Value]) -> list[Value]:
        parts = [part for x in ins for part in _as_pair(x).parts]
        found = writer.traced(function, parts)
        return [Pair(*found)] if len(found) == 2 else found

    return write


def _by_parts(writer: _Writer, step: Step, ins: list[Value]) -> list[Value]:
    """A step that only moves numbers, on real and imaginary parts."""
    found = []
    for parts in zip(*(_as_pair(x).parts for x in ins), strict=True):
        found += writer.traced(step.bound, parts)
    return [Pair(*found)]


def _divided(a: Array, b: Array, c: Array, d: Array) -> tuple[Array, Array]:
    size = c * c + d * d
    return (a * c + b * d) / size, (b * c - a * d) / size


COMPLEX: dict[str, Callable[[_Writer, Step, list[Value]], list[Value]]] = {
    "fft": _fft,
    "mul": _of_pairs(_product),
    "add": _of_pairs(lambda a, b, c, d: (a + c, b + d)),
    "sub": _of_pairs(lambda a, b, c, d: (a - c, b - d)),
    "div": _of_pairs(_divided),
    "conj": _of_pairs(lambda a, b: (a, -b)),
    "real": _of_pairs(lambda a, b: (a,)),
    "imag": _of_pairs(lambda a, b: (b,)),
    "complex": _of_pairs(lambda a, b, c, d: (a, c)),
    "convert_element_type": _of_pairs(lambda a, b: (a * 1.0, b * 1.0)),
    "abs": _of_pairs(lambda a, b: (jnp.sqrt(a * a + b * b),)),
    **dict.fromkeys(MOVES, _by_parts),
}
