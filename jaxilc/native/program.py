"""The form in which programs are compiled: steps on arrays, in order, without calls.

A program comes from a jaxpr by `lowered`, in which calls are written out, and so are small linear
algebra and parts of arrays. `without_dead` drops the steps that nobody reads.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from functools import partial
from itertools import compress
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax import lax

if TYPE_CHECKING:
    from ..runtime.jax_internals import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, Var

Known: TypeAlias = jax.Array | np.ndarray | np.generic
Parameters: TypeAlias = dict[str, Any]  # of a primitive of JAX; each has a type of its own

CALLS = {"jit", "pjit", "closed_call", "core_call", "custom_jvp_call", "custom_vjp_call"}
CALLS |= {"remat2", "remat", "checkpoint", "custom_vjp_call_jaxpr", "custom_vmap_call"}
CALLS |= {"eval_jaxpr"}
SAME = {"by_sample", "stop_gradient", "copy", "copy_p", "optimization_barrier", "name"}
OBJECT = "call_hi_primitive"
UNROLLED = 64  # passes of a loop within a sample, up to which they are written one after another
MOST = 16  # rows of a matrix that is solved in single steps, and whole numbers that are sorted


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

    def bound(self, *arrays: Known, **changed: object) -> list[jax.Array]:
        """The results of its primitive by JAX, with some parameters changed."""
        assert self.primitive is not None
        found = self.primitive.bind(*map(_as_jax, arrays), **self.params | changed)
        return [found] if isinstance(found, jax.Array) else [*found]


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
            body = lowered(step.params["jaxpr"], math.inf if self._least else 0)
            step.params = step.params | {"body": body}
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
        if name in SAME:
            return ins
        if name == "custom_linear_solve":  # of whose functions it needs one
            counts = params["const_lengths"]
            first, last = counts.matvec + counts.vecmat, sum(counts)
            own = ins[first : first + counts.solve]
            return self.inlined(params["jaxprs"].solve, [*own, *ins[last:]])
        if name == "platform_index":
            of = params["platforms"]
            here = next(i for i, names in enumerate(of) if names is None or "cpu" in names)
            return [Const(np.asarray(here, _value(eqn.outvars[0]).dtype))]
        if name == OBJECT:
            return self.inlined(_expanded(eqn), ins)
        if name == "ruled":
            like = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in ins]
            return self.inlined(jax.make_jaxpr(params["value"])(like), ins)
        if name == "scan" and (params["length"] == 1 or params["length"] < (self._least or 0)):
            return self._passes(params, ins)
        if self._least is not None:
            if name == "cond":
                return self._both(params["branches"], ins)
            if (simple := written(name, params, ins)) is not None:
                return self.inlined(simple, ins)
            if name == "scan":
                of = {key: params[key] for key in ("length", "reverse", "jaxpr")}
                params, primitive = of | _counts(params), None
        return self.one(Step(name, params, ins, [*map(_value, eqn.outvars)], primitive))

    def _passes(self, params: Parameters, ins: list[Value]) -> list[Value]:
        """The results of a scan whose passes are written one after another."""
        length, (consts, carry) = params["length"], _counts(params).values()
        if length > UNROLLED:
            raise Unknown(f"a loop of {length} passes within another")
        state, rows = ins[consts : consts + carry], ins[consts + carry :]
        kept: list[list[Value]] = []
        for i in range(length)[:: -1 if params["reverse"] else 1]:
            now = [self._row(x, i) for x in rows]
            found = self.inlined(params["jaxpr"], [*ins[:consts], *state, *now])
            state = found[:carry]
            kept.append(found[carry:])
        kept = kept[::-1] if params["reverse"] else kept
        stacked = [
            self._add("concatenate", [self.reshaped(x, (1, *x.shape)) for x in column],
                      (length, *column[0].shape), dimension=0)
            for column in zip(*kept, strict=True)
        ]  # fmt: skip
        return [*state, *stacked]

    def _row(self, x: Value, i: int) -> Value:
        start, limit = (i, *(0 for _ in x.shape[1:])), (i + 1, *x.shape[1:])
        part = self._add("slice", [x], (1, *x.shape[1:]), start_indices=start, limit_indices=limit,
                         strides=None)  # fmt: skip
        return self.reshaped(part, x.shape[1:])

    def reshaped(self, x: Value, shape: Sequence[int]) -> Value:
        return self._add("reshape", [x], shape, new_sizes=tuple(shape), dimensions=None,
                         sharding=None)  # fmt: skip

    def _add(self, name: str, ins: list[Value], shape: Sequence[int],
             dtype: np.dtype | None = None, **params: object) -> Value:  # fmt: skip
        """The result of a step that is added; its primitive is that of `jax.lax`."""
        out = Value(shape, ins[0].dtype if dtype is None else dtype)
        return self.one(Step(name, params, ins, [out], getattr(lax, f"{name}_p")))[0]

    def _both(self, branches: Sequence[ClosedJaxpr], ins: list[Value]) -> list[Value]:
        """The results of a choice, of which all branches are computed, for they have no effects."""
        index, operands = ins[0], ins[1:]
        found = [self.inlined(of, operands) for of in branches]
        if isinstance(index, Const):
            return found[int(np.clip(index.array, 0, len(branches) - 1))]
        outs = found[-1]
        for i, of in reversed(list(enumerate(found[:-1]))):
            at = Const(np.asarray(i, index.dtype))
            here = self._add("le", [index, at], (), np.dtype(bool))
            outs = [self._add("select_n", [here, x, y], x.shape, x.dtype)
                    for x, y in zip(outs, of, strict=True)]  # fmt: skip
        return outs


def _expanded(eqn: JaxprEqn) -> ClosedJaxpr:
    """The closed jaxpr of a call for which JAX 0.12 has an object, such as a checkpoint."""
    of = eqn.params["_prim"]
    like = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in map(_value, eqn.invars)]
    return jax.make_jaxpr(lambda *x: jax.tree.leaves(of.expand(*of.in_tree.unflatten(x))))(*like)


def _counts(params: Parameters) -> dict[str, int]:
    """The numbers of operands that each pass of a scan reads whole, and of those it carries."""
    if "num_consts" in params:
        return {"consts": params["num_consts"], "carry": params["num_carry"]}
    consts, carry, _ = params["ft_in"].unpack()  # JAX 0.12
    return {"consts": len(consts), "carry": len(carry)}


def loops(program: Program) -> Iterator[Step]:
    """The loops among the steps of a program, without those within them."""
    return (step for step in program.steps if step.name == "scan")


def _of_trial(closed: ClosedJaxpr) -> Program:
    """A trial in which every loop within a loop is written out, or much shorter than the longest.

    Raises Unknown for a loop of more than UNROLLED passes that would have to be written out.
    """
    lengths = [of.params["length"] for of in loops(lowered(closed))]
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
    like = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in operands]
    return jax.make_jaxpr(lambda *x: WRITTEN[name](*x, **params))(*like)


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
    params, wanted = step.params, list(wanted)
    consts, carry = params["consts"], params["carry"]
    while True:
        body = without_dead(params["body"], wanted)
        live = read(body)
        more = [w or live[consts + i] for i, w in enumerate(wanted[:carry])] + wanted[carry:]
        if more == wanted:
            break
        wanted = more
    stay = [*live[:consts], *wanted[:carry], *live[consts + carry :]]
    body = Program([*compress(body.ins, stay)], body.steps, body.outs)
    of = {"body": body, "consts": sum(live[:consts]), "carry": sum(wanted[:carry])}
    return Step("scan", params | of, [*compress(step.ins, stay)], [*compress(step.outs, wanted)])


# The loops over trials
# --------------------------------------------------------------------------------------------------


def of_trials(
    program: Program,
    foreign: Callable[[Step], bool] = lambda step: False,
    left: Collection[int] = (),
) -> tuple[list[tuple[list[Step], Step]], list[Step]]:
    """Each loop over trials, lowered, with the steps before it; and the steps after the last one.

    It is a loop that contains a loop; a gradient has one for the way back. A loop over blocks of
    trials around one over the trials of a block counts as one.

    foreign: which steps JAX computes before a loop where it can, see `computed_ahead`
    left: the numbers of such loops that are steps like others
    Raises Unknown where there is no such loop.
    """
    found: list[tuple[list[Step], Step]] = []
    before: list[Step] = []
    steps = without_dead(program).steps
    nested = [step for step in steps if step.name == "scan" and _has_loop(step.params["jaxpr"])]
    kept = [step for number, step in enumerate(nested) if number not in left]
    for at, step in enumerate(steps):
        if step not in kept:
            before.append(step)
            continue
        read_later = {x for later in steps[at + 1 :] for x in later.ins} | {*program.outs}
        whole, shaped = _as_one(step, before) or (step, [])
        shaped = [one for one in shaped if one.outs[0] in read_later]
        read_later |= {one.ins[0] for one in shaped}
        params = whole.params
        of = {"length": params["length"], "reverse": params["reverse"]}
        of |= _counts(params) | {"body": _of_trial(params["jaxpr"])}
        ahead, loop = computed_ahead(Step("scan", of, whole.ins, whole.outs), foreign)
        found.append(([*before, *ahead], loop))
        before = shaped
    if not found:
        raise Unknown("there is no loop over samples in a loop over trials")
    read_later = {*program.outs, *(x for step in before for x in step.ins)}
    for i, (steps, loop) in reversed([*enumerate(found)]):
        found[i] = steps, without_dead_of_loop(loop, [x in read_later for x in loop.outs])
        read_later |= {x for step in (*steps, found[i][1]) for x in step.ins}
    return found, before


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
    expanded = [_expanded(eqn)] if eqn.primitive.name == OBJECT else []
    for value in (*eqn.params.values(), expanded):
        for one in value if isinstance(value, tuple | list) else (value,):
            if hasattr(one, "eqns"):
                yield one


def _as_one(step: Step, before: list[Step]) -> tuple[Step, list[Step]] | None:
    """A loop over blocks as one over all trials, and the steps that shape its results.

    None for a loop that does more than to run an inner one. The steps that shape its operands are
    added before it.
    """
    body = without_dead(flat(step.params["jaxpr"]))
    consts, carry = _counts(step.params).values()
    if len(body.steps) != 1 or body.steps[0].name != "scan" or step.params["reverse"]:
        return None
    inner = body.steps[0]
    within, of_inner = _counts(inner.params).values()
    if of_inner != carry or inner.params["reverse"]:
        return None
    if body.outs != inner.outs or not _has_loop(inner.params["jaxpr"]):
        return None
    place = {x: i for i, x in enumerate(body.ins)}
    source = [x if isinstance(x, Const) else place[x] for x in inner.ins]
    rows = [i for i in source[within + carry :] if not isinstance(i, Const)]
    if source[within : within + carry] != list(range(consts, consts + carry)):
        return None
    if len(rows) < len(source) - within - carry or any(i < consts + carry for i in rows):
        return None
    if any(not isinstance(i, Const) and i >= consts for i in source[:within]):
        return None
    trials = step.params["length"] * inner.params["length"]
    ins = [i if isinstance(i, Const) else step.ins[i] for i in source[: within + carry]]
    shaping = Lowering(None)
    for i in rows:
        x = step.ins[i]
        ins.append(shaping.reshaped(x, (trials, *x.shape[2:])))
    before += shaping.steps
    shaped: list[Step] = []
    outs = list(step.outs[:carry])
    for x in step.outs[carry:]:
        whole = Value((trials, *x.shape[2:]), x.dtype)
        params = {"new_sizes": x.shape, "dimensions": None, "sharding": None}
        shaped.append(Step("reshape", params, [whole], [x], lax.reshape_p))
        outs.append(whole)
    return Step("scan", inner.params | {"length": trials}, ins, outs), shaped


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
    params, body = step.params, step.params["body"]
    consts, carry = params["consts"], params["carry"]
    ins, inner = [*step.ins], [*body.ins]
    learned = made_from(inner[consts : consts + carry], body.steps)
    varying = made_from(inner[consts + carry :], body.steps)
    source = {x: one for one in body.steps for x in one.outs}
    moved: set[Step] = set()
    for one in body.steps:
        chain, todo = {one}, [one] if foreign(one) else []
        while todo:
            needed = {source[x] for x in todo.pop().ins if x in source} - chain
            chain |= needed
            todo += needed
        if foreign(one) and all(of.primitive and learned.isdisjoint(of.outs) for of in chain):
            moved |= chain
    before: list[Step] = []
    outer = dict(zip(inner, ins, strict=True))
    for by_trial in (False, True):
        steps = [x for x in body.steps if x in moved and varying.isdisjoint(x.outs) != by_trial]
        needed = {x for one in body.steps if one not in steps for x in one.ins} | {*body.outs}
        outs = [x for one in steps for x in one.outs if x in needed]
        if not outs:
            continue
        made = {x for one in steps for x in one.outs}
        given = {x: 0 for one in steps for x in one.ins if x in outer and x not in made}
        fixed = [x for x in given if x not in varying]
        rows = [x for x in given if x in varying]
        new = [Value((params["length"], *x.shape) if by_trial else x.shape, x.dtype) for x in outs]
        before.append(Step("ahead", {}, [outer[x] for x in (*fixed, *rows)], new,
                           _ForEach(steps, fixed, rows, outs)))  # fmt: skip
        outer |= zip(outs, new, strict=True)
        at = len(inner) if by_trial else consts
        ins[at:at], inner[at:at] = new, outs
        consts += 0 if by_trial else len(outs)
    rest = Program(inner, [x for x in body.steps if x not in moved], body.outs)
    return before, Step("scan", params | {"body": rest, "consts": consts}, ins, step.outs)


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
