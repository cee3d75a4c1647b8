"""A printer of programs in C99: loops over arrays of fixed size, without allocation or recursion.

Steps that only move numbers become other ways to read an array (`View`). Steps that are carried out
element by element share one loop while they have one shape, and a number that is used once is
written where it is used. Arrays between loops lie in a work space, each where another has ended.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
from jax.typing import DTypeLike

from ..native.operations import Node, Number, elementwise
from ..native.program import Const, Program, Step, Unknown, Value
from . import operations
from .law import Function
from .steps import uniform

LONGEST = 60  # characters of a number that is written where it is used
LITTLE = 32  # elements of an array on the stack
REAL = "law_real"
TYPES = {"f": REAL, "b": "bool", "int32": "int32_t", "int64": "int64_t", "uint32": "uint32_t"}
UNSIGNED = {"int32": "uint32_t", "int64": "uint64_t", "uint32": "uint32_t"}
INFIX = {"add": "+", "sub": "-", "mul": "*", "div": "/", "eq": "==", "ne": "!=", "lt": "<",
         "le": "<=", "gt": ">", "ge": ">="}  # fmt: skip
OF_BITS = {"and": ("&&", "&"), "or": ("||", "|"), "xor": ("!=", "^")}
OF_LIBRARY = {"abs": "fabs", "round_even": "rint", "round_away": "round"} | {
    name: name for name in ("sqrt", "floor", "ceil", "copysign", "exp", "expm1", "log", "log1p",
                            "sin", "cos", "tan", "tanh", "pow")}  # fmt: skip


class View(NamedTuple):
    """A way to read an array.

    form: how an element is written, with {} for its place; without it, all are one number
    shape: of what is read
    strides: by axis
    start: the place of the first element: a number, and terms
    """

    form: str
    shape: tuple[int, ...]
    strides: tuple[int, ...] = ()
    start: tuple[int, tuple[str, ...]] = (0, ())

    def at(self, index: Sequence[str]) -> str:
        """An element; the index has an entry for each axis that is longer than one."""
        if self.single:
            return self.form
        axes = [s for s, n in zip(self.strides, self.shape, strict=True) if n != 1]
        number, terms = self.start
        parts = [*terms, *(_times(s, i) for s, i in zip(axes, index, strict=True) if s)]
        text = " + ".join(parts)
        if number or not text:
            text = f"{text} {'-' if number < 0 else '+'} {abs(number)}" if text else str(number)
        return self.form.format(text.replace("+ -", "- "))

    @property
    def single(self) -> bool:
        """Whether all elements are one number, wherever it lies."""
        return "{}" not in self.form

    @property
    def whole(self) -> bool:
        """Whether the elements follow one another in row-major order."""
        pairs = zip(self.strides, _row_major(self.shape), self.shape, strict=True)
        return self.single or all(n == 1 or s == t for s, t, n in pairs)


def _times(stride: int, index: str) -> str:
    return index if stride == 1 else f"{stride} * {index}"


def _row_major(shape: Sequence[int]) -> tuple[int, ...]:
    return tuple(math.prod(shape[i + 1 :]) for i in range(len(shape)))


def type_of(dtype: DTypeLike) -> str:
    dtype = np.dtype(dtype)
    return TYPES.get(dtype.kind) or TYPES[dtype.name]


def number(value: float | Number, dtype: DTypeLike, single: bool) -> str:
    """A constant, which C reads as the same number."""
    kind = np.dtype(dtype).kind
    if kind == "b":
        return "true" if value else "false"
    if kind != "f":
        return str(int(value)) if value >= 0 else f"({int(value)})"
    if not np.isfinite(value):
        return "NAN" if np.isnan(value) else "INFINITY" if value > 0 else "(-INFINITY)"
    text = f"{float(str(np.float32(value)))!r}f" if single else repr(float(value))
    return f"({text})" if np.signbit(value) else text


def field_name(name: str) -> str:
    """The member of the struct for a field."""
    return re.sub(r"\W+", "_", name, flags=re.ASCII).strip("_")


class Printed(NamedTuple):
    """The lines of a function, its tables of constants, and the room it needs by type."""

    lines: list[str]
    tables: list[str]
    work: dict[str, int]


def printed(function: Function, *, single: bool) -> Printed:
    """The body of a function; raises Unknown for what C cannot hold."""
    return _Body(function, single).printed()


class _Body:
    def __init__(self, function: Function, single: bool):
        self.function, self.single = function, single
        self.lines: list[str] = []
        self.tables: list[str] = []
        self.known_tables: dict[tuple[str, bytes], str] = {}
        self.blocks: list[tuple[int, int]] = []  # lines of loops that are in no other
        self.depth, self.count = 1, itertools.count()
        self.arrays: dict[str, tuple[str, int]] = {}  # by name, type and size
        self.views: dict[Value, View] = {}
        self.uses: dict[Value, int] = {}
        # of the loop that is not printed yet: its shape, its lines, and the values known there
        self.shape: tuple[int, ...] = ()
        self.inner: list[str] = []
        self.local: dict[Value, str] = {}
        self.taken: dict[Value, int] = {}
        self.root: dict[Value, Value] = {}
        self.unread: set[Value] = set()  # numbers that are put together in it

    # Lines
    # ----------------------------------------------------------------------------------------------

    def line(self, text: str) -> None:
        self.lines.append("    " * self.depth + text)

    def name(self, letter: str) -> str:
        return f"{letter}{next(self.count)}"

    @contextmanager
    def loop(self, head: str) -> Generator[None]:
        start = len(self.lines)
        self.line(f"{head} {{")
        self.depth += 1
        yield
        self.depth -= 1
        self.line("}")
        if self.depth == 1:
            self.blocks.append((start, len(self.lines)))

    @contextmanager
    def each(self, shape: Sequence[int], letter: str = "i") -> Generator[list[str]]:
        """Loops over the axes longer than one; gives their indices."""
        sizes = [n for n in shape if n != 1]
        index = [self.name(letter) for _ in sizes]
        if not sizes:
            yield index
            return
        name, *rest = index
        with self.loop(f"for (int {name} = 0; {name} < {sizes[0]}; ++{name})"):
            if rest:
                with self.each_of(rest, sizes[1:]):
                    yield index
            else:
                yield index

    @contextmanager
    def each_of(self, names: Sequence[str], sizes: Sequence[int]) -> Generator[None]:
        with self.loop(f"for (int {names[0]} = 0; {names[0]} < {sizes[0]}; ++{names[0]})"):
            if len(names) > 1:
                with self.each_of(names[1:], sizes[1:]):
                    yield
            else:
                yield

    def array(self, shape: Sequence[int], dtype: DTypeLike) -> View:
        """Room for an array; a number alone is a variable."""
        name, kind, size = self.name("a"), type_of(dtype), math.prod(shape)
        if size == 1:
            self.line(f"{kind} {name};")
            return View(name, tuple(shape))
        self.arrays[name] = (kind, size)
        return View(f"{name}[{{}}]", tuple(shape), _row_major(shape))

    # Values
    # ----------------------------------------------------------------------------------------------

    def view(self, x: Value) -> View:
        if isinstance(x, Const):
            return self.constant(np.asarray(x.array), x.dtype)
        if x in self.local or x in self.unread:
            self.flush()
        return self.views[x]

    def constant(self, array: np.ndarray, dtype: DTypeLike) -> View:
        if uniform(array):
            return View(number(array.ravel()[0], dtype, self.single), array.shape)
        kind = type_of(dtype)
        flat = array.ravel()
        if np.array_equal(flat, np.arange(flat.size)):  # the place of each element
            form = f"(({kind}) ({{}}))" if kind != "int" else "({})"
            return View(form, array.shape, _row_major(array.shape))
        key = (kind, np.ascontiguousarray(array).tobytes())
        if key not in self.known_tables:
            name = f"{self.function.name}_c{len(self.known_tables)}"
            self.known_tables[key] = name
            numbers = [number(x, dtype, self.single) for x in flat]
            self.tables += table(kind, name, numbers)
        return View(f"{self.known_tables[key]}[{{}}]", array.shape, _row_major(array.shape))

    def copied(self, x: View, dtype: DTypeLike) -> View:
        """The elements one after another, in room of their own."""
        out = self.array(x.shape, dtype)
        with self.each(x.shape) as index:
            self.line(f"{out.at(index)} = {x.at(index)};")
        return out

    # Programs
    # ----------------------------------------------------------------------------------------------

    def run(self, program: Program) -> list[Value]:
        """Print the steps; the results are to be read by `view`."""
        for step in program.steps:
            for x in step.ins:
                self.uses[x] = self.uses.get(x, 0) + 1
        for x in program.outs:
            self.uses[x] = self.uses.get(x, 0) + 2  # read where they are put, and kept until then
        for step in program.steps:
            self.step(step)
        return program.outs

    def step(self, step: Step) -> None:
        name, shape = step.name, step.outs[0].shape
        if not math.prod(shape) and name not in ("scan", "while"):
            self.views[step.outs[0]] = View("0", shape)
        elif elementwise(name):
            self.one_by_one(step)
        elif name in ("scan", "while"):
            getattr(self, name + "_")(step)
        elif not (name in SHARED and self.shared(step)) and not (
            name in operations.FIRST and self.in_this_loop(step)
        ):
            ins = [self.view(x) for x in step.ins]
            self.flush()
            self.views[step.outs[0]] = getattr(self, f"of_{METHOD.get(name, name)}")(step, ins)

    def shared(self, step: Step) -> bool:
        """Whether a step gives what is in the present loop another shape of the same elements."""
        x, out = step.ins[0], step.outs[0]
        if x not in self.local or _long(x.shape) != _long(out.shape):
            return False
        text = self.read(x)
        if not text.isidentifier() and self.uses[out] > 1:
            text = self.named(out.dtype, text)
        self.local[out], self.root[out] = text, self.root[x]
        return True

    # Element by element
    # ----------------------------------------------------------------------------------------------

    def read(self, x: Value) -> str:
        """A value in the present loop."""
        self.taken[x] = self.taken.get(x, 0) + 1
        return self.local[x]

    def named(self, dtype: DTypeLike, text: str) -> str:
        name = self.name("v")
        self.inner.append(f"const {type_of(dtype)} {name} = {_open(text)};")
        return name

    def one_by_one(self, step: Step) -> None:
        out, shape = step.outs[0], _long(step.outs[0].shape)
        if shape and shape != self.shape:
            self.flush()
        views = {x: self.view(x) for x in step.ins if not (shape and x in self.local)}
        if shape:
            self.shape = shape  # which is another, where a view has ended the loop before
            views |= {x: self.views[x] for x in step.ins if x not in self.local and x not in views}
        if len(shape) > len(_INDEX):
            raise Unknown(f"an array of {len(shape)} axes")
        names = dict(zip([i for i, n in enumerate(out.shape) if n != 1], _INDEX, strict=False))
        operands = [
            views[x].at([names[i] for i, n in enumerate(x.shape) if n != 1])
            if x in views else self.read(x)
            for x in step.ins
        ]  # fmt: skip
        text = self.text(operations.formula(step).root, operands)
        once = self.uses[out] == 1 and len(text) <= LONGEST
        if not shape:
            if once:
                self.views[out] = View(_closed(text), out.shape)
            else:
                name = self.name("s")
                self.line(f"const {type_of(out.dtype)} {name} = {text};")
                self.views[out] = View(name, out.shape)
        else:
            self.local[out] = _closed(text) if once else self.named(out.dtype, text)
            self.root[out] = out

    def flush(self) -> None:
        """Print the present loop; what is read later gets room."""
        local, self.local, self.unread = self.local, {}, set()
        places: dict[Value, View] = {}
        index = _INDEX[: len(self.shape)]
        for value, text in local.items():
            if self.uses[value] > self.taken.get(value, 0):
                root = self.root[value]
                if root not in places:
                    places[root] = self.array(root.shape, root.dtype)
                    self.inner.append(f"{places[root].at(index)} = {_open(text)};")
                self.views[value] = places[root]._replace(
                    shape=value.shape, strides=_row_major(value.shape)
                )
        inner, self.inner = self.inner, []
        if inner:
            with self.each_of(index, self.shape):
                for one in inner:
                    self.line(one)
        self.shape = ()

    def text(self, x: Node, operands: Sequence[str]) -> str:
        if x.name == "operand":
            return operands[x.operand]
        if x.name == "const":
            return number(x.value, x.dtype, self.single)
        args = [self.text(one, operands) for one in x.args]
        closed, kind = [_closed(one) for one in args], x.args[0].dtype.kind
        one = _NEUTRAL.get(x.name)
        if one in args:  # the other operand is left as it is, to the last bit
            return args[1 - args.index(one)]
        if x.name == "select":
            return f"{closed[0]} ? {closed[2]} : {closed[1]}"
        if x.name == "convert":
            to = type_of(x.dtype)
            made = f"law_to_{to}({args[0]})" if kind == "f" and x.dtype.kind in "iu" else ""
            return made or f"({to}) {closed[0]}"
        if x.name in OF_BITS:
            if kind == "b" and x.name == "xor" and args[1] == "true":
                return f"!{closed[0]}"
            return f" {OF_BITS[x.name][kind != 'b']} ".join(closed)
        if x.name in ("max", "min"):
            if kind == "f":
                return f"law_{x.name}({', '.join(args)})"
            than = ">" if x.name == "max" else "<"
            return f"{closed[0]} {than} {closed[1]} ? {closed[0]} : {closed[1]}"
        if x.name in INFIX:
            if kind in "iu" and x.name in ("add", "sub", "mul"):  # which may not overflow in C
                wide = UNSIGNED[x.dtype.name]
                inner = f" {INFIX[x.name]} ".join(f"({wide}) {one}" for one in closed)
                return f"({type_of(x.dtype)}) ({inner})"
            if kind != "f" and x.name == "div":
                raise Unknown("a division of whole numbers")
            return f" {INFIX[x.name]} ".join(closed)
        if x.name == "neg":
            return f"-{closed[0]}"
        if kind != "f":
            raise Unknown(f"{x.name} of {x.dtype}")
        return f"LAW_F({OF_LIBRARY[x.name]})({', '.join(args)})"

    # Other steps
    # ----------------------------------------------------------------------------------------------

    def of_reshape(self, step: Step, ins: list[View]) -> View:
        x, shape = ins[0], step.outs[0].shape
        if _long(x.shape) == _long(shape) and not x.single:  # axes of length one come or go
            long = iter([s for s, n in zip(x.strides, x.shape, strict=True) if n != 1])
            strides = tuple(next(long) if n != 1 else 0 for n in shape)
            return x._replace(shape=shape, strides=strides)
        x = x if x.whole else self.copied(x, step.ins[0].dtype)
        return x._replace(shape=shape, strides=_row_major(shape))

    def of_transpose(self, step: Step, ins: list[View]) -> View:
        order = step.params["permutation"]
        strides = () if ins[0].single else tuple(ins[0].strides[i] for i in order)
        return ins[0]._replace(shape=step.outs[0].shape, strides=strides)

    def of_rev(self, step: Step, ins: list[View]) -> View:
        strides, (start, terms) = list(ins[0].strides), ins[0].start
        if ins[0].single:
            return ins[0]
        for i in step.params["dimensions"]:
            start += strides[i] * (ins[0].shape[i] - 1)
            strides[i] = -strides[i]
        return ins[0]._replace(strides=tuple(strides), start=(start, terms))

    def of_broadcast_in_dim(self, step: Step, ins: list[View]) -> View:
        x, shape = ins[0], step.outs[0].shape
        if x.single:
            return x._replace(shape=shape)
        strides = [0] * len(shape)
        for i, to in enumerate(step.params["broadcast_dimensions"]):
            strides[to] = x.strides[i] if x.shape[i] == shape[to] else 0
        return x._replace(shape=shape, strides=tuple(strides))

    def of_slice(self, step: Step, ins: list[View]) -> View:
        of, x, shape = step.params, ins[0], step.outs[0].shape
        if x.single:
            return x._replace(shape=shape)
        number, terms = x.start
        number += sum(a * s for a, s in zip(of["start_indices"], x.strides, strict=True))
        by = of["strides"] or (1,) * len(shape)
        strides = tuple(a * s for a, s in zip(by, x.strides, strict=True))
        return x._replace(shape=shape, strides=strides, start=(int(number), terms))

    def of_dynamic_slice(self, step: Step, ins: list[View]) -> View:
        x, shape = ins[0], step.outs[0].shape
        return self.part(x, shape, ins[1:])

    def part(self, x: View, shape: tuple[int, ...], places: Sequence[View]) -> View:
        """A part of an array from a place that is found while it runs, and clamped."""
        if x.single:
            return x._replace(shape=shape)
        number, terms = x.start
        for place, n, size, stride in zip(places, x.shape, shape, x.strides, strict=True):
            if n != size:
                name = self.name("p")
                self.line(f"const int {name} = law_place({place.at(())}, {n - size});")
                terms = (*terms, _times(stride, name))
        return x._replace(shape=shape, start=(number, terms))

    def of_dynamic_update_slice(self, step: Step, ins: list[View]) -> View:
        out = self.copied(ins[0], step.outs[0].dtype)
        self.put(self.part(out, ins[1].shape, ins[2:]), ins[1])
        return out

    def put(self, to: View, x: View) -> None:
        with self.each(x.shape) as index:
            self.line(f"{to.at(index)} = {x.at(index)};")

    def of_concatenate(self, step: Step, ins: list[View]) -> View:
        out, axis = self.array(step.outs[0].shape, step.outs[0].dtype), step.params["dimension"]
        start, stride = 0, out.strides[axis] if out.strides else 0
        for x in ins:
            if math.prod(x.shape):
                self.put(out._replace(shape=x.shape, start=(start * stride, ())), x)
                start += x.shape[axis]
        return out

    def of_pad(self, step: Step, ins: list[View]) -> View:
        (x, value), shape = ins, step.outs[0].shape
        out = self.array(shape, step.outs[0].dtype)
        with self.each(shape) as index:
            self.line(f"{out.at(index)} = {value.at(())};")
        if math.prod(x.shape) == 0:
            return out
        to, of, inner_shape = 0, 0, []
        by = [1 + inner for *_, inner in step.params["padding_config"]]
        strides, own = (view.strides or (0,) * len(shape) for view in (x, out))
        for (low, _, _), b, n, m, s, t in zip(step.params["padding_config"], by, x.shape, shape,
                                              strides, own, strict=True):  # fmt: skip
            inside = [i for i in range(n) if 0 <= low + b * i < m]
            if not inside:
                return out
            inner_shape.append(len(inside))
            of, to = of + s * inside[0], to + t * (low + b * inside[0])
        part = tuple(inner_shape)
        taken = x._replace(shape=part, start=(x.start[0] + of, x.start[1]))
        placed = tuple(b * t for b, t in zip(by, own, strict=True))
        self.put(out._replace(shape=part, strides=placed, start=(to, ())), taken)
        return out

    def of_take(self, step: Step, ins: list[View]) -> View:
        table, shape = step.params["table"], step.outs[0].shape
        x = ins[0] if ins[0].whole else self.copied(ins[0], step.ins[0].dtype)
        if x.single:
            return x._replace(shape=shape)
        flat = x._replace(shape=(math.prod(x.shape),), strides=(1,))
        places = self.constant(np.asarray(table, np.int32), np.int32)
        out = self.array(shape, step.outs[0].dtype)
        with self.each(shape) as index:
            self.line(f"{out.at(index)} = {flat._replace(shape=(2,)).at([places.at(index)])};")
        return out

    def of_gathered(self, step: Step, ins: list[View]) -> View:
        """Numbers put together in order: for each of the kept axes, over the others."""
        x, out, others = ins[0], step.outs[0], list(step.params["axes"])
        kept = [i for i in range(len(x.shape)) if i not in others]
        if math.prod(x.shape[i] for i in others) == 1 and step.name not in ("reduce_sum",):
            return self.of_reshape(step, ins)
        to = None if math.prod(out.shape) == 1 else self.array(out.shape, out.dtype)
        with self.each([x.shape[i] for i in kept]) as outer:
            total = self.total(step)
            with self.each([x.shape[i] for i in others]) as inner:
                places = dict(zip([i for i in kept if x.shape[i] != 1], outer, strict=True))
                places |= zip([i for i in others if x.shape[i] != 1], inner, strict=True)
                self.line(self.more(step, total, x.at([places[i] for i in sorted(places)])))
            if to is not None:
                self.line(f"{to.at(outer)} = {total};")
        return to or View(total, out.shape)

    def total(self, step: Step) -> str:
        """A variable in which numbers are put together, with what it begins with."""
        name, dtype = self.name("t"), step.outs[0].dtype
        first = operations.first(step.name, dtype)
        self.line(f"{type_of(dtype)} {name} = {number(first, dtype, self.single)};")
        return name

    def more(self, step: Step, total: str, term: str) -> str:
        how = operations.TOGETHER[step.name]
        return f"{total} = {self.together(how, total, _closed(term), step.outs[0].dtype)};"

    def in_this_loop(self, step: Step) -> bool:
        """Whether all numbers of the present loop are put together, in the loop itself."""
        x = step.ins[0]
        if x not in self.local or math.prod(step.outs[0].shape) != 1:
            return False
        total = self.total(step)
        self.inner.append(self.more(step, total, self.read(x)))
        self.views[step.outs[0]] = View(total, step.outs[0].shape)
        self.unread.add(step.outs[0])
        return True

    def together(self, name: str, a: str, b: str, dtype: np.dtype) -> str:
        left, right = (Node("operand", (), dtype, i) for i in range(2))
        return self.text(Node(name, (left, right), dtype), [a, b])

    def of_running(self, step: Step, ins: list[View]) -> View:
        axis, x, out = step.params["axis"], ins[0], step.outs[0]
        to, n = self.array(out.shape, out.dtype), out.shape[axis]
        name = operations.TOGETHER[step.name]
        if n == 1:
            self.put(to, x)
            return to
        others = [i for i in range(len(out.shape)) if i != axis and out.shape[i] != 1]
        with self.each([out.shape[i] for i in others]) as outer:
            places = dict(zip(others, outer, strict=True))

            def at(view: View, k: str) -> str:
                every = places | {axis: k}
                return view.at([every[i] for i in sorted(every)])

            first, by = ("0", "+ 1") if not step.params["reverse"] else (str(n - 1), "- 1")
            self.line(f"{at(to, first)} = {at(x, first)};")
            k = self.name("i")
            head = (f"for (int {k} = 1; {k} < {n}; ++{k})" if by == "+ 1"
                    else f"for (int {k} = {n - 2}; {k} >= 0; --{k})")  # fmt: skip
            with self.loop(head):
                back = self.name("i")
                self.line(f"const int {back} = {k} {'- 1' if by == '+ 1' else '+ 1'};")
                text = self.together(name, at(to, back), at(x, k), out.dtype)
                self.line(f"{at(to, k)} = {text};")
        return to

    def of_dot_general(self, step: Step, ins: list[View]) -> View:
        (of_a, of_b), (batch_a, batch_b) = step.params["dimension_numbers"]
        a, b = ins
        out = step.outs[0]
        to = self.array(out.shape, out.dtype)
        free_a = [i for i in range(len(a.shape)) if i not in (*of_a, *batch_a)]
        free_b = [i for i in range(len(b.shape)) if i not in (*of_b, *batch_b)]
        sizes = [a.shape[i] for i in (*batch_a, *free_a)] + [b.shape[i] for i in free_b]
        with self.each(sizes) as outer:
            total = self.name("t")
            self.line(f"{type_of(out.dtype)} {total} = {number(0.0, out.dtype, self.single)};")
            with self.each([a.shape[i] for i in of_a]) as inner:
                long = [*(("o", i) for i, n in enumerate(sizes) if n != 1)]
                at = dict(zip(long, outer, strict=True))
                summed = dict(zip([i for i, x in enumerate(of_a) if a.shape[x] != 1], inner,
                                  strict=True))  # fmt: skip
                place_a, place_b = {}, {}
                for i, axis in enumerate((*batch_a, *free_a)):
                    place_a[axis] = at.get(("o", i))
                for i, axis in enumerate(batch_b):
                    place_b[axis] = at.get(("o", i))
                for i, axis in enumerate(free_b):
                    place_b[axis] = at.get(("o", len(batch_a) + len(free_a) + i))
                for i, (x, y) in enumerate(zip(of_a, of_b, strict=True)):
                    place_a[x] = place_b[y] = summed.get(i)
                left = a.at([p for _, p in sorted(place_a.items()) if p is not None])
                right = b.at([p for _, p in sorted(place_b.items()) if p is not None])
                product = _closed(self.together("mul", _closed(left), _closed(right), out.dtype))
                self.line(f"{total} = {self.together('add', total, product, out.dtype)};")
            self.line(f"{to.at(outer)} = {total};")
        return to

    # Loops of the law
    # ----------------------------------------------------------------------------------------------

    def scan_(self, step: Step) -> None:
        of, ins = step.params, self.settled(step.ins)
        n, m, body = of["consts"], of["consts"] + of["carry"], of["body"]
        state = self.carried(step.ins[n:m], ins[n:m])
        kept = [self.array(x.shape, x.dtype) for x in step.outs[of["carry"] :]]
        k, last = self.name("k"), of["length"] - 1
        there, back = f"{k} = 0; {k} <= {last}; ++{k}", f"{k} = {last}; {k} >= 0; --{k}"
        with self.loop(f"for (int {back if of['reverse'] else there})"):
            rows = [_row(x, k) for x in ins[m:]]
            self.views.update(zip(body.ins, [*ins[:n], *state, *rows], strict=True))
            outs = self.run(body)
            found = [self.view(x) for x in outs]
            self.flush()
            for to, x in zip(kept, found[of["carry"] :], strict=True):
                self.put(_row(to, k), x)
            self.carry_on(state, found[: of["carry"]], outs)
        self.views.update(zip(step.outs, [*state, *kept], strict=True))

    def while_(self, step: Step) -> None:
        of, ins = step.params, self.settled(step.ins)
        n, m = of["of_condition"], of["of_body"]
        state = self.carried(step.ins[n + m :], ins[n + m :])
        k = self.name("k")
        with self.loop(f"for (int {k} = 0; {k} < {of['bound']}; ++{k})"):
            self.views.update(zip(of["condition"].ins, [*ins[:n], *state], strict=True))
            (holds,) = [self.view(x) for x in self.run(of["condition"])]
            self.flush()
            self.line(f"if (!{_closed(holds.at(()))}) {{")
            self.line("    break;")
            self.line("}")
            self.views.update(zip(of["body"].ins, [*ins[n : n + m], *state], strict=True))
            outs = self.run(of["body"])
            found = [self.view(x) for x in outs]
            self.flush()
            self.carry_on(state, found, outs)
        self.views.update(zip(step.outs, state, strict=True))

    def settled(self, values: Sequence[Value]) -> list[View]:
        """The operands of a loop, each computed before it."""
        views = [self.view(x) for x in values]
        self.flush()
        for i, (x, view) in enumerate(zip(values, views, strict=True)):
            if view.single and not isinstance(x, Const) and not view.form.isidentifier():
                name = self.name("s")
                self.line(f"const {type_of(x.dtype)} {name} = {_open(view.form)};")
                views[i] = View(name, view.shape)
        return views

    def carried(self, values: Sequence[Value], first: Sequence[View]) -> list[View]:
        """Room for what goes from pass to pass, with what it is at first."""
        return [self.copied(view, x.dtype) for x, view in zip(values, first, strict=True)]

    def carry_on(self, state: Sequence[View], found: Sequence[View], outs: Sequence[Value]) -> None:
        """Put what a pass has found in place of what it began with, as if all at once."""
        changed = [(to, x, out.dtype) for to, x, out in zip(state, found, outs, strict=False)
                   if to != x]  # fmt: skip
        names = {name for to, _, _ in changed for name in re.findall(r"^\w+", to.form)}
        safe = []
        for to, x, dtype in changed:
            read = set(re.findall(r"\w+", x.form)) & names
            safe.append((to, self.copied(x, dtype) if read and len(changed) > 1 else x))
        for to, x in safe:
            self.put(to, x)

    # The whole function
    # ----------------------------------------------------------------------------------------------

    def printed(self) -> Printed:
        function = self.function
        for x, name in zip(function.program.ins, function.ins, strict=True):
            self.views[x] = self.place(name, x.shape)
        in_place = function.in_place()
        program = function.program
        steps = [step for step in program.steps if step not in in_place.values()]
        read = [x for step in in_place.values() for x in step.ins[1:]]
        outs = [x for x, name in zip(program.outs, function.outs, strict=True)
                if name not in in_place]  # fmt: skip
        self.run(Program(program.ins, steps, [*outs, *read]))
        names = [name for name in function.outs if name not in in_place]
        found = [(self.place(name, x.shape), self.view(x), x.dtype)
                 for name, x in zip(names, outs, strict=True)]  # fmt: skip
        for name, step in in_place.items():
            view, *places = [self.view(one) for one in step.ins[1:]]
            self.flush()
            to = self.part(self.place(name, step.outs[0].shape), view.shape, places)
            found.append((to, view, step.ins[1].dtype))
        self.flush()
        changed = {field_name(name) for name in function.outs}
        safe = []
        for to, view, dtype in found:
            read_fields = set(re.findall(r"l->(\w+)", view.form)) & changed
            safe.append((to, self.copied(view, dtype) if read_fields else view))
        code = ""
        for to, view in safe:
            if to.form == "code":
                code = view.at(())
            else:
                self.put(to, view)
        if code:
            self.line(f"return (int) {_closed(code)};")
        return Printed(*self.with_room())

    def place(self, name: str, shape: tuple[int, ...]) -> View:
        """Where an operand or a result lies: in the struct, or as an argument."""
        one = math.prod(shape) == 1
        if name in ("y", "u"):
            return View(f"{name}[{{}}]", shape, _row_major(shape))
        if name in ("k", "code"):
            return View(name, shape)
        base = f"l->{field_name(name)}"
        return View(base if one else f"{base}[{{}}]", shape, () if one else _row_major(shape))

    def with_room(self) -> tuple[list[str], list[str], dict[str, int]]:
        """The lines with places for the arrays: on the stack, or where another has ended."""
        lives: list[tuple[int, int, str]] = []
        for name in self.arrays:
            at = [i for i, text in enumerate(self.lines) if re.search(rf"\b{name}\b", text)]
            if at:
                around = [(a, b) for a, b in self.blocks if a <= at[-1] and at[0] < b]
                first = min([at[0], *(a for a, _ in around)])
                last = max([at[-1], *(b for _, b in around)])
                lives.append((first, last, name))
        head: list[str] = []
        work: dict[str, int] = {}
        taken: dict[str, list[tuple[int, int, int]]] = {}  # by type: end of life, place, size
        for first, last, name in sorted(lives):
            kind, size = self.arrays[name]
            if size <= LITTLE:
                head.append(f"    {kind} {name}[{size}];")
                continue
            held = [one for one in taken.get(kind, []) if one[0] >= first]
            place = 0
            for _, start, length in sorted(held, key=lambda one: one[1]):
                if start - place >= size:
                    break
                place = max(place, start + length)
            taken[kind] = [*held, (last, place, size)]
            work[kind] = max(work.get(kind, 0), place + size)
            head.append(f"    {kind} *const {name} = l->work_{kind} + {place};")
        return [*head, *self.lines], self.tables, work


def _long(shape: Sequence[int]) -> tuple[int, ...]:
    return tuple(n for n in shape if n != 1)


def _row(x: View, k: str) -> View:
    """The row of an array at a place that a loop counts."""
    if x.single:
        return x._replace(shape=x.shape[1:])
    number, terms = x.start
    terms = (*terms, _times(x.strides[0], k)) if x.shape[0] != 1 else terms
    return x._replace(shape=x.shape[1:], strides=x.strides[1:], start=(number, terms))


def _closed(text: str) -> str:
    """A number that may stand beside an operator."""
    plain = re.fullmatch(r"[\w.]+|\w+(->\w+)?\[[^\[\]]*\]|\w+->\w+", text)
    call = re.match(r"(LAW_F\(\w+\)|law_\w+)(?=\()", text)
    whole = _is_closed(text) or (call and _is_closed(text[call.end() :]))
    return text if plain or whole else f"({text})"


def _open(text: str) -> str:
    return text[1:-1] if _is_closed(text) and not text.startswith("(-") else text


def _is_closed(text: str) -> bool:
    """Whether one pair of brackets is around all of a text."""
    depth = 0
    for i, letter in enumerate(text):
        depth += {"(": 1, ")": -1}.get(letter, 0)
        if depth == 0:
            return letter == ")" and i == len(text) - 1
    return False


def table(kind: str, name: str, numbers: Sequence[str]) -> list[str]:
    """The lines of a table of constants."""
    return [f"static const {kind} {name}[{len(numbers)}] = {{", *_filled(numbers), "};"]


def _filled(words: Sequence[str]) -> list[str]:
    """Words with commas, in lines of up to 96 characters."""
    lines = [""]
    for word in words:
        if len(lines[-1]) + len(word) > 92:
            lines.append("")
        lines[-1] += f"{' ' if lines[-1] else '    '}{word},"
    return lines


_NEUTRAL = {"mul": "1.0", "and": "true", "or": "false"}
_INDEX = ("i", "j", "h", "g", "f", "e", "d", "c")
SHARED = {"reshape", "squeeze", "expand_dims", "broadcast_in_dim"}
METHOD = {"squeeze": "reshape", "expand_dims": "reshape"}
METHOD |= dict.fromkeys(operations.FIRST, "gathered")
METHOD |= dict.fromkeys(("cumsum", "cumprod", "cummax", "cummin"), "running")
