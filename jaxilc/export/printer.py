"""How a program becomes text: loops over arrays of fixed size, without allocation or recursion.

Steps that only move numbers become other ways to read an array (`View`). Steps that are carried out
element by element share one loop while they have one shape, and a number that is used once is
written where it is used. `Body` prints functions in this way, and a language, its subclass, says
how lines and numbers are written.
"""

from __future__ import annotations

import itertools
import math
import re
import textwrap
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from typing import NamedTuple

import numpy as np
from jax.typing import DTypeLike
from numpy.lib.stride_tricks import as_strided

from ..native.operations import (
    GATHERED,
    MOVES,
    NEUTRAL,
    RUNNING,
    TOGETHER,
    Node,
    Number,
    elementwise,
    formula,
    neutral,
    padded,
    uniform,
)
from ..native.program import Const, Program, Step, Unknown, Value
from .law import Field, Function

LONGEST = 60  # characters of a number that is written where it is used
_NAME = re.compile(r"(?:\w+->)?\w+")
_INDEX = ("i", "j", "h", "g", "f", "e", "d", "c")
SHARED = {"reshape", "squeeze", "expand_dims", "broadcast_in_dim"}
METHOD = {"squeeze": "reshape", "expand_dims": "reshape"}
METHOD |= dict.fromkeys(("transpose", "rev", "broadcast_in_dim", "slice"), "moved")
METHOD |= dict.fromkeys(GATHERED, "gathered") | dict.fromkeys(RUNNING, "running")


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

    @classmethod
    def of(cls, name: str, shape: Sequence[int]) -> View:
        """All of an array by its name, in row-major order; a number alone is a variable."""
        one = math.prod(shape) == 1
        form, strides = (name, ()) if one else (f"{name}[{{}}]", row_major(shape))
        return cls(form, tuple(shape), strides)

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
        pairs = zip(self.strides, row_major(self.shape), self.shape, strict=True)
        return self.single or all(n == 1 or s == t for s, t, n in pairs)

    @property
    def names(self) -> set[str]:
        """What is read."""
        return set(_NAME.findall(self.form))


def row_major(shape: Sequence[int]) -> tuple[int, ...]:
    return tuple(math.prod(shape[i + 1 :]) for i in range(len(shape)))


class Body(ABC):
    """The lines of a language in which functions are printed.

    count: gives the number of each new name
    tables: the tables of constants; by the type and the bytes of each, its name
    """

    index: str  # the type of a place
    end: str  # of a loop

    def __init__(self, depth: int, count: itertools.count[int] | None = None,
                 tables: dict[tuple[str, bytes], str] | None = None):  # fmt: skip
        self.lines: list[str] = []
        self.depth, self.count = depth, itertools.count() if count is None else count
        self.tables = {} if tables is None else tables
        self.views: dict[Value, View] = {}
        self.uses: dict[Value, int] = {}
        # of the loop that is not printed yet: its shape, its lines, and the values known there
        self.shape: tuple[int, ...] = ()
        self.inner: list[str] = []
        self.local: dict[Value, str] = {}
        self.taken: dict[Value, int] = {}
        self.root: dict[Value, Value] = {}
        self.unread: set[Value] = set()  # numbers that are put together in it

    # The language
    # ----------------------------------------------------------------------------------------------

    @abstractmethod
    def type_of(self, dtype: DTypeLike) -> str: ...

    @abstractmethod
    def number(self, value: float | Number, dtype: DTypeLike) -> str:
        """A constant, which a compiler reads as the same number."""

    @abstractmethod
    def operation(self, x: Node, args: Sequence[str]) -> str:
        """The result of an operation on numbers."""

    @abstractmethod
    def place(self, name: str, shape: tuple[int, ...]) -> View:
        """Where a field, an argument or a result of a function lies."""

    @abstractmethod
    def room(self, name: str, kind: str, size: int) -> None:
        """Declare an array, or a variable."""

    @abstractmethod
    def table(self, kind: str, numbers: Sequence[str]) -> str:
        """The name of a new table of constants."""

    @abstractmethod
    def defined(self, name: str, kind: str, text: str, *, changes: bool = False) -> str:
        """The line that declares a number, which may change, and says what it is."""

    @abstractmethod
    def assigned(self, to: str, text: str) -> str: ...

    @abstractmethod
    def head(self, name: str, count: int, back: bool) -> str:
        """The line that begins a loop over places 0 to count - 1, or back from the last one."""

    @abstractmethod
    def leave_unless(self, text: str) -> list[str]:
        """The lines that leave a loop unless something is true."""

    @abstractmethod
    def clamped(self, place: str, last: int) -> str:
        """A place that is found while it runs, within an array."""

    @abstractmethod
    def of_place(self, kind: str) -> str:
        """The form of a place, with {} for it, as a number of a type."""

    # Lines
    # ----------------------------------------------------------------------------------------------

    def line(self, text: str) -> None:
        self.lines.append("    " * self.depth + text)

    def name(self, letter: str) -> str:
        return f"{letter}{next(self.count)}"

    @contextmanager
    def loop(self, name: str, count: int, *, back: bool = False) -> Generator[None]:
        self.line(self.head(name, count, back))
        self.depth += 1
        yield
        self.depth -= 1
        self.line(self.end)

    @contextmanager
    def nested(self, names: Sequence[str], sizes: Sequence[int]) -> Generator[None]:
        with ExitStack() as loops:
            for name, size in zip(names, sizes, strict=True):
                loops.enter_context(self.loop(name, size))
            yield

    @contextmanager
    def each(self, shape: Sequence[int]) -> Generator[list[str]]:
        """Loops over the axes longer than one; gives their indices."""
        sizes = _long(shape)
        index = [self.name("i") for _ in sizes]
        with self.nested(index, sizes):
            yield index

    def set(self, name: str, dtype: DTypeLike, text: str, *, changes: bool = False) -> None:
        self.line(self.defined(name, self.type_of(dtype), opened(text), changes=changes))

    def array(self, shape: Sequence[int], dtype: DTypeLike) -> View:
        """Room for an array; a number alone is a variable."""
        name = self.name("a")
        self.room(name, self.type_of(dtype), math.prod(shape))
        return View.of(name, shape)

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
            return View(self.number(array.ravel()[0], dtype), array.shape)
        kind, flat = self.type_of(dtype), array.ravel()
        if np.array_equal(flat, np.arange(flat.size)):  # the place of each element
            return View(self.of_place(kind), array.shape, row_major(array.shape))
        key = (kind, np.ascontiguousarray(array).tobytes())
        if key not in self.tables:
            self.tables[key] = self.table(kind, [self.number(x, dtype) for x in flat])
        return View.of(self.tables[key], array.shape)

    def copied(self, x: View, dtype: DTypeLike) -> View:
        """The elements one after another, in room of their own."""
        out = self.array(x.shape, dtype)
        self.put(out, x)
        return out

    def put(self, to: View, x: View) -> None:
        with self.each(x.shape) as index:
            self.line(self.assigned(to.at(index), opened(x.at(index))))

    def put_all(self, of: Iterable[tuple[View, View, DTypeLike]]) -> None:
        """Put values into places, each with its type, as if all at once."""
        changed = [(to, x, dtype) for to, x, dtype in of if to != x]
        places = set[str]().union(*(to.names for to, _, _ in changed))
        safe = [(to, self.copied(x, dtype) if x.names & places else x) for to, x, dtype in changed]
        for to, x in safe:
            self.put(to, x)

    # Programs
    # ----------------------------------------------------------------------------------------------

    def start(self, fields: Mapping[str, Field]) -> None:
        """Set each field to what it is at first."""
        for name, of in fields.items():
            flat = of.first.ravel()
            if flat.size:
                self.put(self.place(name, flat.shape), self.constant(flat, flat.dtype))

    def function(self, function: Function) -> None:
        """Print the steps of a function, and what it changes; Unknown for what cannot be held."""
        program, in_place = function.program, function.in_place()
        for x, name in zip(program.ins, function.ins, strict=True):
            self.views[x] = self.place(name, x.shape)
        steps = [step for step in program.steps if step not in in_place.values()]
        read = [x for step in in_place.values() for x in step.ins[1:]]
        outs = {name: x for name, x in zip(function.outs, program.outs, strict=True)
                if name not in in_place}  # fmt: skip
        self.run(Program(program.ins, steps, [*outs.values(), *read]))
        found = [(self.place(name, x.shape), self.view(x), x.dtype) for name, x in outs.items()]
        for name, step in in_place.items():
            view, *places = [self.view(one) for one in step.ins[1:]]
            self.flush()
            to = self.part(self.place(name, step.outs[0].shape), view.shape, places)
            found.append((to, view, step.ins[1].dtype))
        self.flush()
        self.put_all(found)

    def run(self, program: Program) -> list[View]:
        """Print the steps, and give the results."""
        for step in program.steps:
            for x in step.ins:
                self.uses[x] = self.uses.get(x, 0) + 1
        for x in program.outs:
            self.uses[x] = self.uses.get(x, 0) + 2  # read where they are put, and kept until then
        for step in program.steps:
            self.step(step)
        found = [self.view(x) for x in program.outs]
        self.flush()
        return found

    def step(self, step: Step) -> None:
        name, shape = step.name, step.outs[0].shape
        if name in ("scan", "while"):
            getattr(self, name + "_")(step)
        elif not math.prod(shape):
            nothing = step.outs[0].dtype.type(0)
            self.views[step.outs[0]] = View(self.number(nothing, nothing.dtype), shape)
        elif elementwise(name):
            self.one_by_one(step)
        elif not (name in SHARED and self.shared(step)) and not (
            name in GATHERED and self.in_this_loop(step)
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
        self.inner.append(self.defined(name, self.type_of(dtype), opened(text)))
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
        text = self.text(formula(step), operands)
        once = self.uses[out] == 1 and len(text) <= LONGEST
        if shape:
            self.local[out] = closed(text) if once else self.named(out.dtype, text)
            self.root[out] = out
        elif once:
            self.views[out] = View(closed(text), out.shape)
        else:
            self.views[out] = View(self.name("s"), out.shape)
            self.set(self.views[out].form, out.dtype, text)

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
                    self.inner.append(self.assigned(places[root].at(index), opened(text)))
                self.views[value] = places[root]._replace(
                    shape=value.shape, strides=row_major(value.shape)
                )
        inner, self.inner = self.inner, []
        if inner:
            with self.nested(index, self.shape):
                for one in inner:
                    self.line(one)
        self.shape = ()

    def text(self, x: Node, operands: Sequence[str]) -> str:
        if x.name == "operand":
            return operands[x.operand]
        if x.name == "const":
            return self.number(x.value, x.dtype)
        args = [self.text(one, operands) for one in x.args]
        if x.name == "mul" or (x.name in NEUTRAL and x.dtype.kind == "b"):
            one = self.number(neutral(x.name, x.dtype), x.dtype)
            if one in args:  # the other operand is left as it is, to the last bit
                return args[1 - args.index(one)]
        return self.operation(x, args)

    # Other steps
    # ----------------------------------------------------------------------------------------------

    def of_reshape(self, step: Step, ins: list[View]) -> View:
        x, shape = ins[0], step.outs[0].shape
        if _long(x.shape) == _long(shape) and not x.single:  # axes of length one come or go
            long = iter([s for s, n in zip(x.strides, x.shape, strict=True) if n != 1])
            strides = tuple(next(long) if n != 1 else 0 for n in shape)
            return x._replace(shape=shape, strides=strides)
        x = x if x.whole else self.copied(x, step.ins[0].dtype)
        return x._replace(shape=shape, strides=row_major(shape))

    def of_moved(self, step: Step, ins: list[View]) -> View:
        shape = step.outs[0].shape
        return _moved(ins[0], lambda x: MOVES[step.name](step.params, [x], shape))

    def of_dynamic_slice(self, step: Step, ins: list[View]) -> View:
        return self.part(ins[0], step.outs[0].shape, ins[1:])

    def part(self, x: View, shape: tuple[int, ...], places: Sequence[View]) -> View:
        """A part of an array from a place that is found while it runs, and clamped."""
        if x.single:
            return x._replace(shape=shape)
        number, terms = x.start
        for place, n, size, stride in zip(places, x.shape, shape, x.strides, strict=True):
            if n != size:
                name = self.name("p")
                self.line(self.defined(name, self.index, self.clamped(place.at(()), n - size)))
                terms = (*terms, _times(stride, name))
        return x._replace(shape=shape, start=(number, terms))

    def of_dynamic_update_slice(self, step: Step, ins: list[View]) -> View:
        out = self.copied(ins[0], step.outs[0].dtype)
        self.put(self.part(out, ins[1].shape, ins[2:]), ins[1])
        return out

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
        self.put(out, View(value.at(()), shape))
        to, of = padded(step.params, x.shape, shape)
        part = _moved(x, lambda numbers: numbers[of])
        if math.prod(part.shape):
            self.put(_moved(out, lambda numbers: numbers[to]), part)
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
            read = flat._replace(shape=(2,)).at([places.at(index)])
            self.line(self.assigned(out.at(index), read))
        return out

    @contextmanager
    def along(self, sizes: Mapping[int, int]) -> Generator[dict[int, str]]:
        """Loops over axes of these lengths by their numbers; gives the index of each long one."""
        with self.each([*sizes.values()]) as index:
            yield dict(zip([i for i, n in sizes.items() if n != 1], index, strict=True))

    def of_gathered(self, step: Step, ins: list[View]) -> View:
        x, sizes = ins[0], dict(enumerate(ins[0].shape))
        over = {i: sizes.pop(i) for i in sorted(step.params["axes"])}
        if math.prod(over.values()) == 1 and step.name != "reduce_sum":
            return self.of_reshape(step, ins)
        return self.gathered(TOGETHER[step.name], step.outs[0], sizes, over, partial(_at, x))

    def gathered(self, how: str, out: Value, sizes: Mapping[int, int], over: Mapping[int, int],
                 term: Callable[[dict[int, str]], str]) -> View:  # fmt: skip
        """Numbers put together in order: for each of the kept axes, over the others.

        sizes, over: lengths of these axes by their numbers
        term: the number at a place along all of them
        """
        to = None if math.prod(out.shape) == 1 else self.array(out.shape, out.dtype)
        with self.along(sizes) as outer:
            total = self.total(how, out.dtype)
            with self.along(over) as inner:
                self.line(self.more(how, total, term(outer | inner), out.dtype))
            if to is not None:
                self.line(self.assigned(_at(to, outer), total))
        return to or View(total, out.shape)

    def total(self, how: str, dtype: np.dtype) -> str:
        """A variable in which numbers are put together, with what it begins with."""
        name = self.name("t")
        self.set(name, dtype, self.number(neutral(how, dtype), dtype), changes=True)
        return name

    def more(self, how: str, total: str, term: str, dtype: np.dtype) -> str:
        return self.assigned(total, self.together(how, total, term, dtype))

    def in_this_loop(self, step: Step) -> bool:
        """Whether all numbers of the present loop are put together, in the loop itself."""
        x, out, how = step.ins[0], step.outs[0], TOGETHER[step.name]
        if x not in self.local or math.prod(out.shape) != 1:
            return False
        total = self.total(how, out.dtype)
        self.inner.append(self.more(how, total, self.read(x), out.dtype))
        self.views[out] = View(total, out.shape)
        self.unread.add(out)
        return True

    def together(self, name: str, a: str, b: str, dtype: np.dtype) -> str:
        left, right = (Node("operand", (), dtype, i) for i in range(2))
        return opened(self.text(Node(name, (left, right), dtype), [closed(a), closed(b)]))

    def of_running(self, step: Step, ins: list[View]) -> View:
        x, out, back = ins[0], step.outs[0], step.params["reverse"]
        to, sizes = self.array(out.shape, out.dtype), dict(enumerate(out.shape))
        n = sizes.pop(step.params["axis"])
        if n == 1:
            self.put(to, x)
            return to

        def at(view: View, outer: dict[int, str], k: str) -> str:
            return _at(view, outer | {step.params["axis"]: k})

        with self.along(sizes) as outer:
            total, k, first = self.name("t"), self.name("i"), str(n - 1 if back else 0)
            self.set(total, out.dtype, at(x, outer, first), changes=True)
            self.line(self.assigned(at(to, outer, first), total))
            with self.loop(k, n - 1, back=back):
                here = k if back else f"{k} + 1"
                self.line(self.more(RUNNING[step.name], total, at(x, outer, here), out.dtype))
                self.line(self.assigned(at(to, outer, here), total))
        return to

    def of_dot_general(self, step: Step, ins: list[View]) -> View:
        (of_a, of_b), (batch_a, batch_b) = step.params["dimension_numbers"]
        (a, b), out = ins, step.outs[0]
        free_a = [i for i in range(len(a.shape)) if i not in (*of_a, *batch_a)]
        free_b = [i for i in range(len(b.shape)) if i not in (*of_b, *batch_b)]
        # by the axes of the operands, those of the result, or below zero those that are summed
        summed = {-1 - i: a.shape[axis] for i, axis in enumerate(of_a)}
        first = range(len(batch_a) + len(free_a)), range(len(batch_b))
        last = range(len(first[0]), len(out.shape))
        axes_a = dict(zip((*batch_a, *free_a, *of_a), (*first[0], *summed), strict=True))
        axes_b = dict(zip((*batch_b, *free_b, *of_b), (*first[1], *last, *summed), strict=True))

        def product(at: dict[int, str]) -> str:
            left, right = (_at(x, {i: at[of] for i, of in axes.items() if of in at})
                           for x, axes in ((a, axes_a), (b, axes_b)))  # fmt: skip
            return self.together("mul", left, right, out.dtype)

        return self.gathered("add", out, dict(enumerate(out.shape)), summed, product)

    # Loops of the law
    # ----------------------------------------------------------------------------------------------

    def scan_(self, step: Step) -> None:
        of, ins = step.params, self.settled(step.ins)
        n, m, body = of["consts"], of["consts"] + of["carry"], of["body"]
        state = self.carried(step.ins[n:m], ins[n:m])
        kept = [self.array(x.shape, x.dtype) for x in step.outs[of["carry"] :]]
        k = self.name("k")
        with self.loop(k, of["length"], back=of["reverse"]):
            rows = [_row(x, k) for x in ins[m:]]
            self.views.update(zip(body.ins, [*ins[:n], *state, *rows], strict=True))
            found = self.run(body)
            for to, x in zip(kept, found[of["carry"] :], strict=True):
                self.put(_row(to, k), x)
            self.carry_on(state, found, body.outs)
        self.views.update(zip(step.outs, [*state, *kept], strict=True))

    def while_(self, step: Step) -> None:
        of, ins = step.params, self.settled(step.ins)
        n, m = of["of_condition"], of["of_body"]
        state = self.carried(step.ins[n + m :], ins[n + m :])
        with self.loop(self.name("k"), of["bound"]):
            self.views.update(zip(of["condition"].ins, [*ins[:n], *state], strict=True))
            (holds,) = self.run(of["condition"])
            for line in self.leave_unless(closed(holds.at(()))):
                self.line(line)
            self.views.update(zip(of["body"].ins, [*ins[n : n + m], *state], strict=True))
            self.carry_on(state, self.run(of["body"]), of["body"].outs)
        self.views.update(zip(step.outs, state, strict=True))

    def settled(self, values: Sequence[Value]) -> list[View]:
        """The operands of a loop, each computed before it."""
        views = [self.view(x) for x in values]
        self.flush()
        for i, (x, view) in enumerate(zip(values, views, strict=True)):
            if view.single and not isinstance(x, Const) and not view.form.isidentifier():
                views[i] = View(self.name("s"), view.shape)
                self.set(views[i].form, x.dtype, view.form)
        return views

    def carried(self, values: Sequence[Value], first: Sequence[View]) -> list[View]:
        """Room for what goes from pass to pass, with what it is at first."""
        return [self.copied(view, x.dtype) for x, view in zip(values, first, strict=True)]

    def carry_on(self, state: Sequence[View], found: Sequence[View], outs: Sequence[Value]) -> None:
        """Put what a pass has found in place of what it began with."""
        self.put_all((to, x, out.dtype) for to, x, out in zip(state, found, outs, strict=False))


def _moved(x: View, move: Callable[[np.ndarray], np.ndarray]) -> View:
    """The same numbers at other places, which NumPy tells of an array that nobody reads."""
    before = as_strided(np.empty(1, np.int8), x.shape, x.strides or (0,) * len(x.shape))
    after = move(before)
    if x.single:
        return x._replace(shape=after.shape)
    first, last = (of.__array_interface__["data"][0] for of in (before, after))
    number, terms = x.start
    return x._replace(
        shape=after.shape, strides=after.strides, start=(number + last - first, terms)
    )


def _at(view: View, places: Mapping[int, str]) -> str:
    """An element, by the places along its axes."""
    return view.at([places[i] for i in sorted(places)])


def _times(stride: int, index: str) -> str:
    return index if stride == 1 else f"{stride} * {closed(index)}"


def _long(shape: Sequence[int]) -> tuple[int, ...]:
    return tuple(n for n in shape if n != 1)


def _row(x: View, k: str) -> View:
    """The row of an array at a place that a loop counts."""
    if x.single:
        return x._replace(shape=x.shape[1:])
    number, terms = x.start
    terms = (*terms, _times(x.strides[0], k)) if x.shape[0] != 1 else terms
    return x._replace(shape=x.shape[1:], strides=x.strides[1:], start=(number, terms))


def closed(text: str) -> str:
    """A number that may stand beside an operator."""
    plain = re.fullmatch(r"[\w.]+|\w+(->\w+)?\[[^\[\]]*\]|\w+->\w+", text)
    call = re.match(r"(LAW_F\(\w+\)|\w+)(?=\()", text)
    whole = _is_closed(text) or (call and _is_closed(text[call.end() :]))
    return text if plain or whole else f"({text})"


def opened(text: str) -> str:
    """A number without brackets that are around all of it."""
    return text[1:-1] if _is_closed(text) and not text.startswith("(-") else text


def _is_closed(text: str) -> bool:
    """Whether one pair of brackets is around all of a text."""
    depth = 0
    for i, letter in enumerate(text):
        depth += {"(": 1, ")": -1}.get(letter, 0)
        if depth == 0:
            return letter == ")" and i == len(text) - 1
    return False


def wrapped(lines: Iterable[str]) -> list[str]:
    """Lines of up to 94 characters; an empty one stays."""
    return [part for line in lines for part in textwrap.wrap(line, 94) or [""]]


def filled(words: Iterable[str]) -> list[str]:
    """Words with commas between them, in lines of up to 96 characters."""
    return textwrap.wrap(", ".join(words), 96, initial_indent="    ", subsequent_indent="    ",
                         break_long_words=False, break_on_hyphens=False)  # fmt: skip
