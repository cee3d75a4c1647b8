"""The form in which programs are compiled: steps on arrays, in order, without calls.

A program comes from a jaxpr by `lowered`, in which calls are written out, and so are small linear
algebra and parts of arrays. `without_dead` drops the steps that nobody reads.
"""

from __future__ import annotations

import itertools
import math
import operator
from collections.abc import Callable, Collection, Hashable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from itertools import compress
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias, TypeVar

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax import lax

if TYPE_CHECKING:
    from ..runtime.jax_internals import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, Var

Known: TypeAlias = jax.Array | np.ndarray | np.generic
Parameters: TypeAlias = dict[str, Any]  # of a primitive of JAX; each has a type of its own
T = TypeVar("T")

CALLS = {"jit", "pjit", "closed_call", "core_call", "custom_jvp_call", "custom_vjp_call"}
CALLS |= {"remat2", "remat", "checkpoint", "custom_vjp_call_jaxpr", "custom_vmap_call"}
CALLS |= {"eval_jaxpr"}
SAME = {"by_sample", "stop_gradient", "copy", "copy_p", "optimization_barrier", "name"}
OBJECT = "call_hi_primitive"
UNROLLED = 64  # passes of a loop within a sample, up to which they are written one after another
MOST = 16  # rows of a matrix that is solved in single steps, and whole numbers that are sorted
# steps that cost a loop less than to read what they make, see `taking`
CHEAP = {"add", "sub", "neg", "slice", "broadcast_in_dim", "squeeze", "reshape"}
CHEAP |= {"convert_element_type"}


class Unknown(NotImplementedError):
    """Something that cannot be compiled; the message names it."""


class Value:
    """An array that is known when the program runs.

    shape, dtype: those of the array
    """

    def __init__(self, shape: Sequence[int], dtype: np.dtype):
        self.shape, self.dtype = tuple(int(n) for n in shape), dtype

    def __repr__(self) -> str:
        return f"{self.dtype}{list(self.shape)}"


class Const(Value):
    """An array that is known beforehand."""

    def __init__(self, array: Known):
        self.array = array
        super().__init__(np.shape(array), array.dtype)


class Primitive(Protocol):
    """What computes a step by JAX: a primitive of JAX, or `_ForEach`."""

    def bind(self, *arrays: jax.Array, **params: object) -> jax.Array | Sequence[jax.Array]: ...


class Step:
    """An operation on arrays.

    name: the name of its primitive in JAX
    params: the parameters of the primitive; of a scan over trials or samples that was lowered,
        `length`, `reverse`, `consts` and `carry`, the numbers of such operands, and its `body`
    ins, outs: its operands and its results
    primitive: the primitive, where it was not lowered
    """

    def __init__(self, name: str, params: Parameters, ins: list[Value], outs: list[Value],
                 primitive: Primitive | None = None):  # fmt: skip
        self.name, self.params, self.ins, self.outs = name, params, ins, outs
        self.primitive = primitive

    @property
    def body(self) -> Program:
        """A pass of a loop that was lowered."""
        found: Program = self.params["body"]
        return found

    @property
    def length(self) -> int:
        """The number of passes of a loop."""
        return int(self.params["length"])

    def apart(self, of_operands: Sequence[T]) -> tuple[list[T], list[T], list[T]]:
        """What there is for each operand of a loop: read whole, carried, and read row by row."""
        first, carry = _counts(self.params)
        last = first + carry
        return [*of_operands[:first]], [*of_operands[first:last]], [*of_operands[last:]]

    def results_apart(self, of_results: Sequence[T]) -> tuple[list[T], list[T]]:
        """What there is for each result of a loop: carried out of it, and written row by row."""
        _, carry = _counts(self.params)
        return [*of_results[:carry]], [*of_results[carry:]]

    def on(self, ins: list[Value], outs: list[Value] | None = None, **changed: object) -> Step:
        """The same step on other operands, with other results or some parameters changed."""
        outs = self.outs if outs is None else outs
        return Step(self.name, self.params | changed, ins, outs, self.primitive)

    def bound(self, *arrays: Known, **changed: object) -> list[jax.Array]:
        """The results of its primitive by JAX, with some parameters changed."""
        assert self.primitive is not None
        found = self.primitive.bind(*map(_as_jax, arrays), **self.params | changed)
        return [found] if isinstance(found, jax.Array) else [*found]


Parts: TypeAlias = list[tuple[list[Step], Step]]  # loops over trials, with the steps before each


class Program:
    """Steps in order.

    ins: the operands
    steps: the steps
    outs: the results, each an operand, a constant, or the result of a step
    """

    def __init__(self, ins: list[Value], steps: list[Step], outs: list[Value]):
        self.ins, self.steps, self.outs = ins, steps, outs


# From a jaxpr
# --------------------------------------------------------------------------------------------------


def flat(closed: ClosedJaxpr) -> Program:
    """The program of a closed jaxpr with calls written out and loops as they are."""
    return Lowering(None).program(closed)


def lowered(closed: ClosedJaxpr, least: float = 0) -> Program:
    """The program of a closed jaxpr with everything written out that is not a loop over samples.

    least: passes of such a loop; where it is not zero, loops of fewer passes are written out, too,
        and all that are within another
    Raises Unknown for a loop of more than UNROLLED passes that would have to be written out.
    """
    return Lowering(least).program(closed)


def _value(v: Var | Literal) -> Value:
    if not isinstance(v.aval, jax.core.ShapedArray):
        raise Unknown(f"a value of the type {v.aval}")
    return Value(v.aval.shape, v.aval.dtype)


def traced(function: Callable[..., object], operands: Sequence[Value]) -> ClosedJaxpr:
    """The jaxpr of a function of JAX for operands, of which it reads the shapes and types."""
    like = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in operands]
    return jax.make_jaxpr(function)(*like)


class Lowering:
    """What adds the steps of jaxprs to those of a program.

    least: as for `lowered`; None: only calls are written out
    """

    def __init__(self, least: float | None):
        self._least = least
        self.steps: list[Step] = []

    def program(self, closed: ClosedJaxpr) -> Program:
        ins = [_value(v) for v in closed.jaxpr.invars]
        outs = self.inlined(closed, ins)
        return Program(ins, self.steps, outs)

    def one(self, step: Step) -> Sequence[Value]:
        """What stands for the results of a step, which is added."""
        if step.name == "scan" and self._least is not None:
            step = _with_body(step, lowered(step.params["jaxpr"], math.inf if self._least else 0))
        self.steps.append(step)
        return step.outs

    def inlined(self, of: Jaxpr | ClosedJaxpr, ins: Sequence[Value]) -> list[Value]:
        """The results of a jaxpr for these operands; its steps are added."""
        jaxpr = getattr(of, "jaxpr", of)
        known: dict[Var, Value] = {}

        def read(v: Var | Literal) -> Value:
            if hasattr(v, "val"):  # a number in place of a variable
                return Const(np.asarray(v.val, _value(v).dtype))
            return known[v]

        known.update(zip(jaxpr.constvars, map(Const, getattr(of, "consts", ())), strict=True))
        known.update(zip(jaxpr.invars, ins, strict=True))
        for eqn in jaxpr.eqns:
            outs = self._eqn(eqn, [read(v) for v in eqn.invars])
            known.update(zip(eqn.outvars, outs, strict=True))
        return [read(v) for v in jaxpr.outvars]

    def _eqn(self, eqn: JaxprEqn, ins: list[Value]) -> Sequence[Value]:
        name, params = eqn.primitive.name, eqn.params
        primitive: Primitive | None = eqn.primitive
        if name in CALLS:
            names = ("jaxpr", "call_jaxpr", "fun_jaxpr", "call")
            return self.inlined(next(params[name] for name in names if params.get(name)), ins)
        if name in SAME or (name == "reduce_precision" and _whole(params, ins[0].dtype)):
            return ins
        if name == "custom_linear_solve":  # of whose functions it needs one
            lengths = params["const_lengths"]
            first, last = lengths.matvec + lengths.vecmat, sum(lengths)
            own = ins[first : first + lengths.solve]
            return self.inlined(params["jaxprs"].solve, [*own, *ins[last:]])
        if name == "platform_index":
            of = params["platforms"]
            here = next(i for i, names in enumerate(of) if names is None or "cpu" in names)
            return [Const(np.asarray(here, _value(eqn.outvars[0]).dtype))]
        if name == OBJECT:
            return self.inlined(_expanded(eqn), ins)
        if name == "ruled":
            return self.inlined(traced(lambda *x: params["value"]([*x]), ins), ins)
        if name == "scan" and (params["length"] == 1 or params["length"] < (self._least or 0)):
            return self._passes(Step(name, params, ins, []))
        if self._least is not None:
            if name == "cond":
                return self._both(params["branches"], ins)
            if (simple := written(name, params, ins)) is not None:
                return self.inlined(simple, ins)
            if name == "scan":
                params, primitive = _of_scan(params), None
        return self.one(Step(name, params, ins, [*map(_value, eqn.outvars)], primitive))

    def _passes(self, step: Step) -> list[Value]:
        """The results of a scan whose passes are written one after another."""
        length, back = step.length, step.params["reverse"]
        if length > UNROLLED:
            raise Unknown(f"a loop of {length} passes within another")
        whole, state, rows = step.apart(step.ins)
        kept: list[list[Value]] = []
        for i in range(length)[:: -1 if back else 1]:
            now = [self.of(partial(lax.index_in_dim, index=i, keepdims=False), x) for x in rows]
            state, found = step.results_apart(
                self.inlined(step.params["jaxpr"], [*whole, *state, *now])
            )
            kept.append(found)
        kept = kept[::-1] if back else kept
        columns = zip(*kept, strict=True)
        return [*state, *(self.of(lambda *x: _stack(*x, axis=0)[0], *of) for of in columns)]

    def of(self, function: Callable[..., jax.Array], *ins: Value) -> Value:
        """The result of a function of JAX; its steps are added."""
        return self.inlined(traced(function, ins), ins)[0]

    def _both(self, branches: Sequence[ClosedJaxpr], ins: list[Value]) -> list[Value]:
        """The results of a choice, of which all branches are computed, for they have no effects."""
        index, operands = ins[0], ins[1:]
        found = [self.inlined(of, operands) for of in branches]
        if isinstance(index, Const):
            return found[int(np.clip(index.array, 0, len(branches) - 1))]
        return [self.of(lax.select_n, index, *cases) for cases in zip(*found, strict=True)]


def _whole(params: Parameters, dtype: np.dtype) -> bool:
    """Whether numbers of a type keep all their digits when their precision is reduced so."""
    own = jnp.finfo(dtype)
    return params["exponent_bits"] >= own.nexp and params["mantissa_bits"] >= own.nmant


def _expanded(eqn: JaxprEqn) -> ClosedJaxpr:
    """The closed jaxpr of a call for which JAX 0.12 has an object, such as a checkpoint."""
    of, ins = eqn.params["_prim"], [*map(_value, eqn.invars)]
    return traced(lambda *x: jax.tree.leaves(of.expand(*of.in_tree.unflatten(x))), ins)


def _counts(params: Parameters) -> tuple[int, int]:
    """The numbers of operands that each pass of a scan reads whole, and of those it carries."""
    for names in (("consts", "carry"), ("num_consts", "num_carry")):
        if names[0] in params:
            return params[names[0]], params[names[1]]
    consts, carry, _ = params["ft_in"].unpack()  # JAX 0.12
    return len(consts), len(carry)


def _of_scan(params: Parameters) -> Parameters:
    """The parameters of a scan, by names that do not depend on the version of JAX."""
    kept = {name: params[name] for name in ("length", "reverse", "jaxpr")}
    return kept | dict(zip(("consts", "carry"), _counts(params), strict=True))


def _with_body(step: Step, body: Program) -> Step:
    """A loop that is lowered to a body."""
    return Step("scan", _of_scan(step.params) | {"body": body}, step.ins, step.outs)


def loops(program: Program) -> Iterator[Step]:
    """The loops among the steps of a program, without those within them."""
    return (step for step in program.steps if step.name == "scan")


def _of_trial(closed: ClosedJaxpr) -> Program:
    """A trial in which every loop within a loop is written out, or much shorter than the longest.

    Raises Unknown for a loop of more than UNROLLED passes that would have to be written out.
    """
    lengths = [of.length for of in loops(lowered(closed))]
    if not lengths:
        raise Unknown("there is no loop over samples in a loop over trials")
    shortest = min(n for n in lengths if 2 * n > max(lengths))
    return lowered(closed, -(-3 * shortest // 4))


# Primitives that are written by others: each with their operands, parameters and results
# --------------------------------------------------------------------------------------------------


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


def _split(x: jax.Array, *, sizes: Sequence[int], axis: int, **_: object) -> list[jax.Array]:
    ends = np.cumsum(sizes)
    return [lax.slice_in_dim(x, int(end) - size, int(end), axis=axis)
            for size, end in zip(sizes, ends, strict=True)]  # fmt: skip


def _stack(*arrays: jax.Array, axis: int, **_: object) -> list[jax.Array]:
    return [lax.concatenate([lax.expand_dims(x, [axis]) for x in arrays], axis)]


def _unstack(x: jax.Array, *, axis: int, **_: object) -> list[jax.Array]:
    return [lax.squeeze(one, [axis]) for one in _split(x, sizes=[1] * x.shape[axis], axis=axis)]


WRITTEN: dict[str, Callable[..., Sequence[jax.Array]]] = {
    "lu": lu,
    "triangular_solve": triangular_solve,
    "sort": _sort,
    "by_columns": lambda matrix, vector, **_: [jnp.matmul(matrix, vector[..., None])[..., 0]],
    "split": _split,
    "stack": _stack,
    "unstack": _unstack,
}


def written(name: str, params: Parameters, operands: Sequence[Value]) -> ClosedJaxpr | None:
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
    return traced(lambda *x: WRITTEN[name](*x, **params), operands)


# Without what nobody reads
# --------------------------------------------------------------------------------------------------


def without_dead(program: Program, wanted: Sequence[bool] | None = None) -> Program:
    """The program of the wanted results, with all its operands; of loops too, only what is read."""
    outs = program.outs if wanted is None else [*compress(program.outs, wanted)]
    live, kept = {x for x in outs if not isinstance(x, Const)}, []
    for step in reversed(program.steps):
        of = [x in live for x in step.outs]
        if any(of):
            if step.name == "scan" and "body" in step.params:
                step = without_dead_of_loop(step, of)
            kept.append(step)
            live |= {x for x in step.ins if not isinstance(x, Const)}
    return Program(program.ins, kept[::-1], outs)


def read(program: Program) -> list[bool]:
    """Whether each operand is read."""
    live = {*program.outs, *(x for step in program.steps for x in step.ins)}
    return [x in live for x in program.ins]


def made_from(values: Iterable[Value], steps: Sequence[Step]) -> set[Value]:
    """The values, and all that steps make of them."""
    found = {*values}
    for step in steps:
        if not found.isdisjoint(step.ins):
            found.update(step.outs)
    return found


def without_dead_of_loop(step: Step, wanted: Sequence[bool]) -> Step:
    """A loop with only those results, and what they need from pass to pass."""
    while True:
        body = without_dead(step.body, wanted)
        consts, carried, rows = step.apart(read(body))
        more = [*map(operator.or_, wanted, carried), *wanted[len(carried) :]]
        if more == wanted:
            break
        wanted = more
    carried = more[: len(carried)]
    stay = [*consts, *carried, *rows]
    body = Program([*compress(body.ins, stay)], body.steps, body.outs)
    return step.on([*compress(step.ins, stay)], [*compress(step.outs, wanted)],
                   body=body, consts=sum(consts), carry=sum(carried))  # fmt: skip


# What is computed twice
# --------------------------------------------------------------------------------------------------


class Numbering:
    """Numbers of values, by value numbering (Alpern, Wegman and Zadeck 1988).

    Values with the same number are computed in the same way from the same operands. The samples of
    a loop are numbered by what they need of that loop alone; what they compute of rows alone, as
    if a loop of its own computed it, in which JAX may do so before all trials.

    numbers: by what they stand for
    of: what stands for a pass of the loop, within one: "trial" or "sample", and how many there are
    """

    def __init__(self, numbers: dict[Hashable, int] | None = None, of: tuple[str, int] = ("", 0)):
        self._numbers = {} if numbers is None else numbers
        self._pass = of
        self._of: dict[Value, int] = {}
        self._samples: dict[int, int] = {}  # the number of all samples, by that of each one
        self._carried: set[int] = set()

    def __call__(self, x: Value) -> int:
        """The number of a value, which is new if it is no result of what was added."""
        if isinstance(x, Const) and not jnp.issubdtype(x.dtype, jax.dtypes.extended):
            return self._number("const", *_key(x.array))
        return self._of.setdefault(x, self._number(x))

    def _number(self, *key: Hashable) -> int:
        return self._numbers.setdefault(key, len(self._numbers))

    def same(self, x: Value, number: int) -> None:
        """Let a value have this number."""
        self._of[x] = number

    def add(self, steps: Iterable[Step]) -> None:
        """Number the results of steps, whose operands are known."""
        for step in map(_as_lowered, steps):
            operands = [*map(self, step.ins)]
            carried = not self._carried.isdisjoint(operands)
            for i, x in enumerate(step.outs):
                found = self._result(step, i, operands)
                if carried:
                    self._carried.add(found)
                elif not self._samples.keys().isdisjoint(operands):
                    found = self._of_rows(self._number("samples", *self._pass, found))
                self._of[x] = found

    def _of_rows(self, samples: int) -> int:
        found = self._number("row", self._pass[0], samples)
        self._samples[found] = samples
        return found

    def _result(self, step: Step, i: int, operands: Sequence[int]) -> int:
        x, params = step.outs[i], step.params
        if "body" in params:
            found = self.samples(step, step.body.outs[i])
            return self._number("last", found) if i < params["carry"] else found
        if isinstance(step.primitive, _ForEach) or any(_jaxprs_among(params)):
            return self._number(x)
        keys = (y for name in sorted(params) for y in (name, *_key(params[name])))
        return self._number(step.name, *keys, i, str(x), *operands)

    def samples(self, step: Step, x: Value) -> int:
        """The number of what a value in the body of a loop is at all samples."""
        more = Program(step.body.ins, step.body.steps, [*step.body.outs, x])
        loop = step.on(step.ins, [*step.outs, x], body=more)
        loop = without_dead_of_loop(loop, [False] * len(step.outs) + [True])
        within = self.within(loop, "carried", "sample")
        within.add(loop.body.steps)
        *after, found = map(within, loop.body.outs)
        if found in within._samples:
            return within._samples[found]
        begins = map(self, loop.apart(loop.ins)[1])
        return self._number("samples", loop.length, loop.params["reverse"], *begins, *after, found)

    def within(self, loop: Step, carried: str, each: str = "trial") -> Numbering:
        """The numbers of the operands of a pass of a loop.

        carried: what a number that is carried is called;  each: what a pass is
        """
        found = Numbering(self._numbers, (each, loop.length))
        whole, own, rows = loop.apart([*zip(loop.body.ins, loop.ins, strict=True)])
        found._of |= {x: self(given) for x, given in whole}
        found._of |= {x: self._number(carried, i) for i, (x, _) in enumerate(own)}
        found._carried = {found._of[x] for x, _ in own}
        found._of |= {x: found._of_rows(self(given)) for x, given in rows}
        return found


def _key(value: object) -> tuple[Hashable, ...]:
    if isinstance(value, Known):
        value = np.asarray(value)
        return str(value.dtype), value.shape, value.tobytes()
    return (repr(value),)


def _as_lowered(step: Step) -> Step:
    """A loop with its body, where it can be lowered."""
    if step.name != "scan" or "body" in step.params:
        return step
    try:
        body = lowered(step.params["jaxpr"])
    except Unknown:
        return step
    return _with_body(step, body)


def spared(before: list[Step], there: Step, back: Step, tape: Mapping[int, Value]) -> Step:
    """The way back of a gradient, which reads what the way there computed, not computing it again.

    That is what is stored of each trial, and what the next trial began with. The latter is carried
    from the way back of the next trial. A loop over samples of which all else is known becomes
    rows.

    before: the steps before the two ways
    tape: by the number of an operand of the way back, the result of the way there that is stored
    """
    numbers = Numbering()
    numbers.add(before)
    begun, again = numbers.within(there, "memory"), numbers.within(back, "slope")
    inside, own = there.body, back.body
    begun.add(inside.steps)
    for i, x in tape.items():
        again.same(own.ins[i], begun(inside.outs[there.outs.index(x)]))
    again.add(own.steps)
    have = {again(own.ins[i]): own.ins[i] for i in tape}
    begins: dict[Value, tuple[Value, Value]] = {}  # stored of a trial, and after the last one
    for x, after, end in zip(there.apart(inside.ins)[1], inside.outs, there.outs, strict=False):
        stored, number = have.get(begun(x)), begun(after)
        if stored is not None and number not in have and not isinstance(after, Const):
            have[number] = Value(stored.shape, stored.dtype)
            begins[have[number]] = stored, end
    known: dict[Value, Value] = {}
    steps: list[Step] = []
    read = {x for step in own.steps for x in step.ins} | {*own.outs}
    for step in own.steps:
        known |= {x: have[again(x)] for x in step.outs if again(x) in have}
        left = [x in read and x not in known for x in step.outs]
        now = step.on([known.get(x, x) for x in step.ins])
        if any(left) and "body" in step.params and not step.params["reverse"]:
            numbers_of = {x: again.samples(step, x) for x in step.body.outs}
            samples = {x: have[n] for x, n in numbers_of.items() if n in have}
            made, found = _as_rows(now, samples, left) or ([now], [])
            steps += made
            known |= zip(compress(step.outs, left), found, strict=False)
        elif any(left):
            steps.append(now)
    (whole, carried, rows), (last, each) = back.apart(own.ins), back.results_apart(own.outs)
    found = [*last, *(x for x, _ in begins.values()), *each]
    body = Program([*whole, *carried, *begins, *rows], steps, [known.get(x, x) for x in found])
    (whole, carried, rows), (last, each) = back.apart(back.ins), back.results_apart(back.outs)
    ins, outs = [*whole, *carried, *(x for _, x in begins.values()), *rows], [*last, *begins, *each]
    loop = back.on(ins, outs, body=body, carry=len(last) + len(begins))
    return without_dead_of_loop(loop, [x not in begins for x in outs])


def _as_rows(
    step: Step, known: Mapping[Value, Value], wanted: Sequence[bool]
) -> tuple[list[Step], list[Value]] | None:
    """The steps that compute the wanted results of a loop over samples as rows, and these results.

    None where a number that it carries depends on itself.

    known: the rows of values of its body
    """
    body = step.body
    source = {x: (one, i) for one in body.steps for i, x in enumerate(one.outs)}

    def rows(given: Sequence[jax.Array], of_known: Sequence[jax.Array]) -> list[jax.Array]:
        whole, begun, each = step.apart([*zip(body.ins, given, strict=True)])
        found: dict[Value, tuple[Known, bool]] = {x: (array, False) for x, array in whole}
        found |= {x: (array, True) for x, array in (*each, *zip(known, of_known, strict=True))}
        # with whether it is one for each sample
        carried = {x: (array, after) for (x, array), after in zip(begun, body.outs, strict=False)}

        def row(x: Value) -> tuple[Known, bool]:
            if isinstance(x, Const):
                return x.array, False
            if x not in found:
                if x in asked:
                    raise Unknown("a number that depends on itself")
                asked.add(x)
                found[x] = computed(x)
            return found[x]

        def computed(x: Value) -> tuple[Known, bool]:
            if x in carried:
                first, after = carried[x]
                return jnp.concatenate([first[None], of_all(after)[:-1]]), True
            one, i = source[x]
            if one.primitive is None:
                raise Unknown("a loop within a loop")
            operands = [row(y) for y in one.ins]
            arrays, each = [y for y, _ in operands], [0 if r else None for _, r in operands]
            if each.count(None) == len(each):
                return one.bound(*arrays)[i], False
            return jax.vmap(one.bound, each)(*arrays)[i], True

        def of_all(x: Value) -> jax.Array:
            array, each = row(x)
            array = _as_jax(array)
            return array if each else jnp.broadcast_to(array, (step.length, *array.shape))

        asked: set[Value] = set()
        return [of_all(x)[-1] if i < len(begun) else of_all(x)
                for i, x in enumerate(body.outs) if wanted[i]]  # fmt: skip

    ins, n = [*step.ins, *known.values()], len(step.ins)
    try:
        closed = traced(lambda *x: rows(x[:n], x[n:]), ins)
    except (Unknown, RecursionError):  # of a long chain of steps, too
        return None
    lowering = Lowering(0)
    return lowering.steps, lowering.inlined(closed, ins)


# The loops over trials
# --------------------------------------------------------------------------------------------------


def of_trials(
    program: Program,
    foreign: Callable[[Step], bool] = lambda step: False,
    left: Collection[int] = (),
) -> tuple[Parts, list[Step]]:
    """Each loop over trials, lowered, with the steps before it; and the steps after the last one.

    It is a loop that contains a loop; a gradient has one for the way back. A loop over blocks of
    trials around one over the trials of a block counts as one.

    foreign: which steps JAX computes before a loop where it can, see `computed_ahead`
    left: the numbers of such loops that are steps like others
    Raises Unknown where there is no such loop.
    """
    found: list[Step] = []
    steps = without_dead(program).steps
    nested = [step for step in steps if step.name == "scan" and _has_loop(step.params["jaxpr"])]
    if all(number in left for number in range(len(nested))):
        raise Unknown("there is no loop over samples in a loop over trials")
    kept = [step for number, step in enumerate(nested) if number not in left]
    for step in steps:
        if step not in kept:
            found.append(step)
            continue
        shaping, whole, shaped = _as_one(step)
        ahead, loop = computed_ahead(_with_body(whole, _of_trial(whole.params["jaxpr"])), foreign)
        found += [*shaping, *ahead]
        found += [taking(_in_parts(found)[1], loop), *shaped]
    return read_alone(found, program.outs)


def read_alone(steps: list[Step], outs: list[Value]) -> tuple[Parts, list[Step]]:
    """The same of steps, without what nobody reads.

    outs: the results of the program
    """
    return _in_parts(without_dead(Program([], steps, outs)).steps)


def _in_parts(steps: Iterable[Step]) -> tuple[Parts, list[Step]]:
    """The loops over trials among steps, which were lowered, as `of_trials` gives them."""
    found: Parts = []
    before: list[Step] = []
    for step in steps:
        if "body" in step.params:
            found.append((before, step))
            before = []
        else:
            before.append(step)
    return found, before


def taking(before: Sequence[Step], loop: Step) -> Step:
    """A loop over trials that takes parts, sums and copies of what it reads itself.

    JAX takes them before the loop. Within it they cost less than to read them, and what a law and
    the learning from a trial make of the same samples is computed once.

    before: the steps before it
    """
    body, least = loop.body, min(of.length for of in loops(loop.body))
    number, moved = Numbering(), list[Step]()
    reads: dict[int, tuple[Value, Value]] = {}  # what it reads, with what stands for it within
    whole, *others = loop.apart([*zip(loop.ins, body.ins, strict=True)])
    same = {own: reads.setdefault(number(x), (x, own))[1] for x, own in whole}

    def within(x: Value) -> Value:
        """What stands for a value within the loop."""
        if isinstance(x, Const) and math.prod(x.shape) <= MOST:
            return x
        return reads.setdefault(number(x), (x, Value(x.shape, x.dtype)))[1]

    for step in reversed(before):
        if reads.keys().isdisjoint(map(number, step.outs)):
            continue
        step = _as_lowered(step)
        if _cheap(step, least):
            outs = [reads.pop(number(x), (x, Value(x.shape, x.dtype)))[1] for x in step.outs]
            ins = [*map(within, step.ins)]
            moved.insert(0, step.on(ins, outs))
    rest = [x.on([same.get(y, y) for y in x.ins]) for x in body.steps]
    pairs = [*reads.values(), *itertools.chain(*others)]
    of = Program([own for _, own in pairs], [*moved, *rest], [same.get(x, x) for x in body.outs])
    return loop.on([x for x, _ in pairs], body=of, consts=len(reads))


def _cheap(step: Step, least: int) -> bool:
    """Whether a loop takes no longer to compute what a step does than to read it.

    The step makes rows, from rows whose samples it leaves in order and from few numbers.
    least: the samples of the shortest loop over samples
    """
    steps = [step]
    if step.name == "reshape":  # of which samples may become channels
        return False
    if step.name == "scan":
        if "body" not in step.params or step.params["carry"] or step.length < least:
            return False
        steps = step.body.steps
    if any(one.name not in CHEAP or {*(one.params.get("strides") or ())} - {1} for one in steps):
        return False
    types = {"bool", "int32", "int64", "uint32", jnp.result_type(float).name}
    if any(x.dtype.name not in types for one in (step, *steps) for x in (*one.ins, *one.outs)):
        return False

    def axes(x: Value) -> int:
        """How many axes are as long as those of samples."""
        return sum(4 * n >= 3 * least for n in x.shape)

    return all(axes(x) == 1 for x in step.outs) and all(
        axes(x) == 1 or math.prod(x.shape) <= MOST for x in step.ins
    )


def in_order(step: Step) -> bool:
    """Whether a step gives another shape to an array whose numbers stay in their order."""
    shapes = [x.shape for x in (*step.ins, *step.outs)]
    if len(shapes) != 2 or math.prod(shapes[0]) != math.prod(shapes[1]):
        return False
    return step.name in ("reshape", "squeeze", "expand_dims", "broadcast_in_dim", "slice",
                         "concatenate")  # fmt: skip


def _has_loop(jaxpr: Jaxpr | ClosedJaxpr) -> bool:
    return any(
        eqn.primitive.name == "scan" or any(map(_has_loop, jaxprs_within(eqn)))
        for eqn in jaxpr.eqns
    )


def jaxprs_within(eqn: JaxprEqn) -> Iterator[Jaxpr | ClosedJaxpr]:
    """The jaxprs among the parameters of a step of another."""
    expanded = {"": _expanded(eqn)} if eqn.primitive.name == OBJECT else {}
    return _jaxprs_among(eqn.params | expanded)


def _jaxprs_among(params: Parameters) -> Iterator[Jaxpr | ClosedJaxpr]:
    for value in params.values():
        for one in value if isinstance(value, tuple | list) else (value,):
            if hasattr(one, "eqns"):
                yield one


def _as_one(step: Step) -> tuple[list[Step], Step, list[Step]]:
    """A loop over blocks as one over all trials, with what shapes its operands and its results.

    A loop that does more than to run an inner one stays.
    """
    body = without_dead(flat(step.params["jaxpr"]))
    inner = body.steps[0] if len(body.steps) == 1 else None
    if inner is None or inner.name != "scan" or not _has_loop(inner.params["jaxpr"]):
        return [], step, []
    whole, carried, rows = step.apart(body.ins)
    read, begun, by_trial = inner.apart(inner.ins)
    known = all(isinstance(x, Const) or x in whole for x in read) and {*by_trial} <= {*rows}
    back = step.params["reverse"] or inner.params["reverse"]
    if back or not known or begun != carried or body.outs != inner.outs:
        return [], step, []
    trials, source = step.length * inner.length, dict(zip(body.ins, step.ins, strict=True))
    last, blocks = step.results_apart(step.outs)
    given = [source[x] for x in by_trial]
    rows, found = ([Value((trials, *x.shape[2:]), x.dtype) for x in some]
                   for some in (given, blocks))  # fmt: skip
    ins = [*(source.get(x, x) for x in (*read, *begun)), *rows]
    loop = Step("scan", inner.params | {"length": trials}, ins, [*last, *found])
    return [*map(_reshaped, given, rows)], loop, [*map(_reshaped, found, blocks)]


def _reshaped(x: Value, out: Value) -> Step:
    """The step that gives an array another shape."""
    params = {"new_sizes": out.shape, "dimensions": None, "sharding": None}
    return Step("reshape", params, [x], [out], lax.reshape_p)


# What JAX computes ahead
# --------------------------------------------------------------------------------------------------


class _ForEach:
    """What carries out steps by JAX: once, or for each trial at once.

    steps: the steps
    consts, rows: the values that they read, and those of which they read one row in each trial
    outs: their results
    """

    def __init__(self, steps: list[Step], consts: list[Value], rows: list[Value],
                 outs: list[Value]):  # fmt: skip
        self.steps, self.consts, self.rows, self.outs = steps, consts, rows, outs

    def bind(self, *arrays: jax.Array, **_: object) -> list[jax.Array]:
        of_all, by_trial = arrays[: len(self.consts)], arrays[len(self.consts) :]

        def of_one(*rows: jax.Array) -> list[jax.Array]:
            read = [*self.consts, *self.rows]
            known: dict[Value, Known] = dict(zip(read, [*of_all, *rows], strict=True))
            return [*map(_as_jax, map(by_jax(self.steps, known), self.outs))]

        return jax.vmap(of_one)(*by_trial) if self.rows else of_one()


def computed_ahead(step: Step, foreign: Callable[[Step], bool]) -> tuple[list[Step], Step]:
    """A loop over trials without the foreign steps that no trial can change, and those steps.

    What JAX draws for a trial does not depend on what was learned before. So it is drawn for all
    trials before the loop, which reads one row of it in each trial.

    foreign: whether JAX must compute a step
    """
    body = step.body
    whole, carried, rows = step.apart([*zip(body.ins, step.ins, strict=True)])
    learned = made_from((own for own, _ in carried), body.steps)
    varying = made_from((own for own, _ in rows), body.steps)
    source = {x: one for one in body.steps for x in one.outs}
    free: dict[Step, None] = {}  # what no trial can change
    for one in body.steps:
        known = all(source[x] in free for x in one.ins if x in source)
        if known and one.primitive and learned.isdisjoint(one.outs):
            free[one] = None
    drawn = [x for one in free if foreign(one) for x in one.outs]
    moved = without_dead(Program([], [*free], drawn)).steps
    before: list[Step] = []
    outer = dict(zip(body.ins, step.ins, strict=True))
    for by_trial, of in ((False, whole), (True, rows)):
        steps = [x for x in moved if varying.isdisjoint(x.outs) != by_trial]
        needed = {x for one in body.steps if one not in steps for x in one.ins} | {*body.outs}
        outs = [x for one in steps for x in one.outs if x in needed]
        if not outs:
            continue
        made = {x for one in steps for x in one.outs}
        given = {x: 0 for one in steps for x in one.ins if x in outer and x not in made}
        fixed = [x for x in given if x not in varying]
        each = [x for x in given if x in varying]
        new = [Value((step.length, *x.shape) if by_trial else x.shape, x.dtype) for x in outs]
        before.append(Step("ahead", {}, [outer[x] for x in (*fixed, *each)], new,
                           _ForEach(steps, fixed, each, outs)))  # fmt: skip
        outer |= zip(outs, new, strict=True)
        of += zip(outs, new, strict=True)
    pairs = [*whole, *carried, *rows]
    rest = [x for x in body.steps if x not in moved]
    body = Program([own for own, _ in pairs], rest, body.outs)
    return before, step.on([x for _, x in pairs], body=body, consts=len(whole))


# By JAX
# --------------------------------------------------------------------------------------------------


def by_jax(steps: Sequence[Step], known: dict[Value, Known]) -> Callable[[Value], Known]:
    """The function that gives the value of an array after these steps, computed by JAX.

    known: the values of what the steps read; it is extended. A step of which something is unknown
    is left out.
    """

    def value(x: Value) -> Known:
        return x.array if isinstance(x, Const) else known[x]

    for step in steps:
        if all(isinstance(x, Const) or x in known for x in step.ins):
            known.update(zip(step.outs, step.bound(*map(value, step.ins)), strict=True))
    return value


def _as_jax(x: Known) -> jax.Array:
    return x if isinstance(x, jax.Array | jax.core.Tracer) else jnp.asarray(x)
