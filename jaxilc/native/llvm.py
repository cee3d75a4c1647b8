"""The text of a program for LLVM, from the plan of a loop over trials.

A vector holds a number of each machine of a group. The function that is printed runs groups of
machines, each through the trials `begin` to before `end`:

    run(first, last, given, out, work, begin, end)

given: pointers to the operands: one number for all machines, or (groups, ..., lanes)
out: pointers to the results, (groups, ..., lanes) each
work: room for what one group carries and keeps
"""

from __future__ import annotations

import math
import platform
from collections.abc import Callable, Iterable, Sequence
from functools import reduce

import numpy as np

from .operations import (
    CONVERSIONS,
    Array,
    At,
    AtIndex,
    Buffer,
    Cell,
    Given,
    Node,
    Number,
    Sample,
    instruction,
)
from .rows import (
    Handed,
    Loop,
    Row,
    Segment,
    Stored,
    Trials,
    begun_early,
    handed_on,
    in_turn,
    reached,
    small,
    without_choices,
)

ALIGNED = 64  # bytes
FOLLOWED = 12  # rows of machines that a processor reads ahead of a loop by itself
AHEAD = 24  # samples ahead of a loop for which more rows are asked for; 64 leave the first cache
FLUSH = 0x8040  # of the register MXCSR: results and operands too small to be normal are zero
OPERANDS = "i64 %first, i64 %last, ptr %given, ptr %out, ptr %work, i64 %begin, i64 %end"
WIDTH = '"min-legal-vector-width"="512" "prefer-vector-width"="512"'
TYPES = {"float64": "double", "float32": "float", "bool": "i1"}


class Lines:
    """Lines of a function.

    letter: with which the names of its values begin
    """

    def __init__(self, letter: str):
        self.letter, self.count = letter, 0
        self.lines: list[str] = []

    def add(self, text: str) -> str:
        """A line whose result has a new name, which is returned."""
        self.count += 1
        name = f"%{self.letter}{self.count}"
        self.do(f"{name} = {text}")
        return name

    def do(self, text: str) -> None:
        self.lines.append(f"  {text}")

    def place(self, base: str, offset: int | str, kind: str = "i8") -> str:
        """The pointer to what is so many bytes, or numbers of another kind, behind another."""
        return self.add(f"getelementptr {kind}, ptr {base}, i64 {offset}")

    def field(self, base: str, offset: int, kind: str = "ptr") -> str:
        """What is there."""
        return self.add(f"load {kind}, ptr {self.place(base, offset)}")

    def pointers(self, base: str, count: int) -> list[str]:
        """The first pointers at a place."""
        return [self.field(base, 8 * i) for i in range(count)]

    def times(self, x: str, factor: int, more: int | str | None = None) -> str:
        """A whole number times another, and more."""
        product = self.add(f"mul i64 {x}, {factor}")
        return product if more is None else self.add(f"add i64 {product}, {more}")

    def label(self) -> str:
        self.count += 1
        return f"b{self.count}"

    def loop(self, first: str, last: str, step: int = 1) -> tuple[str, list[str]]:
        """Begin a loop; its counter, and the lines that end it."""
        before, head, after = self.label(), self.label(), self.label()
        self.do(f"br label %{before}")
        self.lines.append(f"{before}:")
        self.do(f"br label %{head}")
        self.lines.append(f"{head}:")
        self.count += 1
        k, name = f"%k{self.count}", f"%n{self.count}"
        self.do(f"{k} = phi i64 [{first}, %{before}], [{name}, %{head}e]")
        end = [
            f"  br label %{head}e", f"{head}e:",
            f"  {name} = add i64 {k}, {step}",
            f"  %c{self.count} = icmp ne i64 {name}, {last}",
            f"  br i1 %c{self.count}, label %{head}, label %{after}",
            f"{after}:",
        ]  # fmt: skip
        return k, end


class Text(Lines):
    """The text of the program of a plan.

    lanes: number of machines in a group
    wanted: whether each result of the loop over trials is read by somebody
    in_vectors: what gives the name of a function of the C library for as many numbers as there are
        lanes, by its usual name and the number of its operands; None where there is none
    name: that of the function
    function: its text, beside what it declares
    work: bytes that a group needs
    """

    def __init__(
        self,
        plan: Trials,
        lanes: int,
        wanted: Sequence[bool],
        in_vectors: Callable[[str, int], str | None],
        name: str = "run",
    ):
        assert all(wanted[plan.carry :])  # there is no room for others
        super().__init__("v")
        self.plan, self.lanes, self.wanted, self.in_vectors = plan, lanes, wanted, in_vectors
        self.declared: set[str] = set()
        self.straight: dict[Node, str] = {}
        self.inside: dict[Node, str] = {}
        self.asking: dict[tuple[Buffer, int], int] = {}
        self.read: dict[Buffer, str] = {}  # the pointers to rows that a trial reads, and writes
        self.written: dict[Buffer, str] = {}
        self.rooms: dict[Buffer, str] = {}
        self.others: dict[Buffer, str] = {}  # to which those that are written elsewhere go
        self.turns: dict[Buffer, tuple[str, str]] = {}  # where both pointers of those are
        self.work = 0
        self.taped = _taped(plan)
        self.passed = _passed(plan)
        self.doubled = [x for x in _doubled(plan) if x not in {*self.taped, *self.passed}]
        self.function = self._printed_function(name)

    # Lines
    # ----------------------------------------------------------------------------------------------

    def type_of(self, dtype: np.dtype) -> str:
        return f"<{self.lanes} x {_scalar(dtype)}>"

    def stored_type(self, dtype: np.dtype, *, alike: bool = False) -> str:
        """The type of numbers as they are in RAM."""
        scalar = "i8" if dtype.kind == "b" else _scalar(dtype)
        return scalar if alike else f"<{self.lanes} x {scalar}>"

    def const(self, value: Number, dtype: np.dtype) -> str:
        one = f"{_scalar(dtype)} {_number(value, dtype)}"
        return f"<{', '.join([one] * self.lanes)}>"

    def splat(self, scalar: str, kind: str) -> str:
        """A vector of a number."""
        vector = f"<{self.lanes} x {kind}>"
        first = self.add(f"insertelement {vector} poison, {kind} {scalar}, i32 0")
        return self.add(
            f"shufflevector {vector} {first}, {vector} poison, <{self.lanes} x i32> zeroinitializer"
        )

    def load(self, base: str, index: str, dtype: np.dtype, *, alike: bool) -> str:
        """The numbers at a place of an array in RAM."""
        kind = self.stored_type(dtype, alike=alike)
        found = self.add(f"load {kind}, ptr {self.place(base, index, kind)}, "
                         f"align {dtype.itemsize}")  # fmt: skip
        if alike:
            found = self.splat(found, kind)
        if dtype.kind == "b":
            found = self.add(f"icmp ne <{self.lanes} x i8> {found}, zeroinitializer")
        return found

    def _next(self, k: str, last: int, d: int) -> str:
        """The sample after another, or the last one again."""
        at_end = self.add(f"icmp eq i64 {k}, {last}")
        return self.add(f"select i1 {at_end}, i64 {k}, i64 {self.add(f'add i64 {k}, {d}')}")

    def _ask_for(self, buffer: Buffer, index: str) -> None:
        """Let the processor bring a number into its cache; there need not be one."""
        place = self.place(self.read[buffer], index, self.stored_type(buffer.dtype))
        self.declared.add("declare void @llvm.prefetch.p0(ptr, i32, i32, i32)")
        self.do(f"call void @llvm.prefetch.p0(ptr {place}, i32 0, i32 3, i32 1)")

    def store(self, value: str, base: str, index: str, dtype: np.dtype) -> None:
        kind = self.stored_type(dtype)
        if dtype.kind == "b":
            value = self.add(f"zext {self.type_of(dtype)} {value} to {kind}")
        place = self.place(base, index, kind)
        self.do(f"store {kind} {value}, ptr {place}, align {dtype.itemsize}")

    # Nodes
    # ----------------------------------------------------------------------------------------------

    def values(self, nodes: Iterable[Node], k: str | None = None) -> list[str]:
        """The names of the values of nodes, which are printed where they were not yet.

        k: the counter of the loop, within one
        """
        nodes = list(nodes)
        for node in in_turn(nodes[::-1], lambda x: x in self._known(x)):
            args = [self._known(x)[x] for x in node.args]
            self._known(node)[node] = self._printed(node, args, k)
        return [self._known(x)[x] for x in nodes]

    def _known(self, node: Node) -> dict[Node, str]:
        return self.inside if node.varies else self.straight

    def _printed(self, node: Node, args: list[str], k: str | None) -> str:
        kind = self.type_of(node.dtype)
        match node.what:
            case Cell():
                return self.add(f"load {kind}, ptr {self._cell(node)}")
            case Given(number, m):
                at = str(m)
                if node.name == "by_trial":
                    at = self.times(self.trial, math.prod(self.plan.body.ins[number].shape), m)
                return self.load(self.given[number], at, node.dtype, alike=node.alike)
            case At(buffer, sign, c, m):
                index = self._index(k, sign, c, buffer.width, m)
                if (ahead := self.asking.pop((buffer, m), None)) is not None:
                    self._ask_for(buffer, self.add(f"add i64 {index}, {ahead * buffer.width}"))
                return self.load(self.read[buffer], index, node.dtype, alike=buffer.alike)
            case Sample(sign, c):
                index = self._index(k, sign, c, 1, 0)
                wide = self.splat(index, "i64")
                if node.dtype.itemsize == 8:
                    return wide
                return self.add(f"trunc <{self.lanes} x i64> {wide} to {kind}")
            case AtIndex() as where:
                return self._row(node, where, args[0])
        match node.name:
            case "const":
                return self.const(node.value, node.dtype)
            case "select":
                yes = f"{kind} {args[2]}, {kind} {args[1]}"
                return self.add(f"select <{self.lanes} x i1> {args[0]}, {yes}")
            case "bits":
                return self.add(f"bitcast {self.type_of(node.args[0].dtype)} {args[0]} to {kind}")
            case "convert":
                return self._converted(node, args[0])
        # a product less itself is 0, and not what it is rounded by
        if node.dtype.kind == "f" and node.name in ("add", "sub") and len({*node.args}) > 1:
            for i in (0, 1):
                if node.args[i].name == "mul":
                    return self._fused(node, i, args[1 - i])
        if node.name == "max" and "abs" in (names := [x.name for x in node.args]):
            return self._larger(kind, *(args[::-1] if names[0] == "abs" else args))
        text = instruction(node.name, node.args[0].dtype.kind)
        assert text is not None, node.name
        of = self.type_of(node.args[0].dtype)
        if text.startswith("@llvm"):
            name = f"{text}.{self._suffix(node.args[0].dtype)}"
            return self._called(name, kind, [of] * len(args), args)
        if text.startswith("@"):
            return self._for_each(text, node.dtype, args)
        if text == "fneg":
            return self.add(f"fneg {of} {args[0]}")
        return self.add(f"{text} {of} {args[0]}, {args[1]}")

    def _fused(self, node: Node, at: int, other: str) -> str:
        """A sum or difference of a product, which is operand `at`, rounded once.

        It is fused wherever it is computed. A row that is computed in two loops, such as that of a
        maximum and that of the place of this maximum, would not be the same if LLVM chose.
        """
        kind, product = self.type_of(node.dtype), node.args[at]
        a, b = (self._known(x)[x] for x in product.args)
        if node.name == "sub" and at == 0:
            other = self.add(f"fneg {kind} {other}")
        if node.name == "sub" and at == 1:
            a = self.add(f"fneg {kind} {a}")
        name = f"@llvm.fmuladd.{self._suffix(node.dtype)}"
        return self._called(name, kind, [kind] * 3, [a, b, other])

    def _larger(self, kind: str, x: str, size: str) -> str:
        """The maximum of a number and the size of another one, NaN if one of them is.

        A processor has an instruction for the inner choice, and no zero of a size has a sign.
        """
        bits = f"<{self.lanes} x i1>"
        above, none = (
            self.add(f"fcmp {of} {kind} {x}, {y}") for of, y in (("ogt", size), ("uno", x))
        )
        larger = self.add(f"select {bits} {above}, {kind} {x}, {kind} {size}")
        return self.add(f"select {bits} {none}, {kind} {x}, {kind} {larger}")

    def _called(self, name: str, kind: str, types: list[str], args: list[str]) -> str:
        self.declared.add(f"declare {kind} {name}({', '.join(types)})")
        given = ", ".join(f"{t} {x}" for t, x in zip(types, args, strict=True))
        return self.add(f"call {kind} {name}({given})")

    def _suffix(self, dtype: np.dtype) -> str:
        letter = "f" if dtype.kind == "f" else "i"
        return f"v{self.lanes}{letter}{8 * dtype.itemsize}"

    def _for_each(self, name: str, dtype: np.dtype, args: list[str]) -> str:
        """The results of a function of the C library, in vectors where it has them."""
        kind, scalar = self.type_of(dtype), _scalar(dtype)
        if name == "@log":  # it would not take tiny numbers as zero, as XLA does here alone
            same = f"@llvm.canonicalize.{self._suffix(dtype)}"
            args = [self._called(same, kind, [kind], args)]
        name += "f" if scalar == "float" else ""
        vectors = self.in_vectors(name[1:], len(args))
        if vectors is not None:
            return self._called(f"@{vectors}", kind, [kind] * len(args), args)
        self.declared.add(f"declare {scalar} {name}({', '.join([scalar] * len(args))})")
        found = "poison"
        for lane in range(self.lanes):
            ones = [self.add(f"extractelement {kind} {x}, i32 {lane}") for x in args]
            one = self.add(f"call {scalar} {name}({', '.join(f'{scalar} {x}' for x in ones)})")
            found = self.add(f"insertelement {kind} {found}, {scalar} {one}, i32 {lane}")
        return found

    def _converted(self, node: Node, x: str) -> str:
        source = node.args[0].dtype
        of, to = self.type_of(source), self.type_of(node.dtype)
        if source.kind in "iu" and node.dtype.kind in "iu":
            here, there = source.itemsize, node.dtype.itemsize
            if here == there:
                return x
            longer = "sext" if source.kind == "i" else "zext"
            return self.add(f"{longer if there > here else 'trunc'} {of} {x} to {to}")
        text = CONVERSIONS[source.kind + node.dtype.kind]
        if text.startswith("@"):
            name = f"{text}.{self._suffix(node.dtype)}.{self._suffix(source)}"
            return self._called(name, to, [of], [x])
        return self.add(f"{text} {of} {x} to {to}")

    def _index(self, k: str | None, sign: int, c: int, width: int, m: int) -> str:
        """The place of number m of row sign k + c; k, or sign k, may be known beforehand."""
        if sign == 0:
            return str(c * width + m)
        assert k is not None
        if not k.startswith("%"):
            return str((sign * int(k) + c) * width + m)
        return self.times(k, sign * width, c * width + m)

    def _row(self, node: Node, where: AtIndex, index: str) -> str:
        """Number m of the row of a table at an index, which may be another for each machine."""
        buffer, m, _ = where
        base, kind = self.read[buffer], self.type_of(node.args[0].dtype)
        alike = node.args[0].alike
        scalar = _scalar(node.args[0].dtype)
        found = "poison"
        for lane in range(1 if alike else self.lanes):
            at = self.add(f"extractelement {kind} {index}, i32 {lane}")
            if scalar != "i64":
                at = self.add(f"sext {scalar} {at} to i64")
            at = self.times(at, buffer.width, m)
            if alike:
                return self.load(base, at, buffer.dtype, alike=buffer.alike)
            if not buffer.alike:
                at = self.times(at, self.lanes, lane)
            one = self.stored_type(buffer.dtype, alike=True)
            place = self.place(base, at, one)
            value = self.add(f"load {one}, ptr {place}, align {buffer.dtype.itemsize}")
            if one == "i8":
                value = self.add(f"trunc i8 {value} to i1")
            vector = self.type_of(buffer.dtype)
            found = self.add(
                f"insertelement {vector} {found}, {_scalar(buffer.dtype)} {value}, i32 {lane}"
            )
        return found

    # Places
    # ----------------------------------------------------------------------------------------------

    def _cell(self, cell: Node) -> str:
        assert isinstance(cell.what, Cell)
        name = f"%cell{cell.what.number}"
        self.cells[name] = self.type_of(cell.dtype)
        return name

    def _put_all(self, cells: Iterable[Node], values: Iterable[str]) -> None:
        for cell, value in zip(cells, values, strict=True):
            self._put(cell, value)

    def _put(self, cell: Node, value: str) -> None:
        kind = self.type_of(cell.dtype)
        self.do(f"store {kind} {value}, ptr {self._cell(cell)}")

    def _room(self, buffer: Buffer) -> str:
        """The place of a buffer in the working memory."""
        place = self.work
        self.work += aligned(buffer.size * buffer.dtype.itemsize * self.lanes)
        return self.place("%work", place)

    # The function
    # ----------------------------------------------------------------------------------------------

    def _printed_function(self, name: str) -> str:
        self.cells: dict[str, str] = {}
        self._group()
        body, self.lines = self.lines, []
        for cell, kind in self.cells.items():
            self.do(f"{cell} = alloca {kind}, align {ALIGNED}")
        head = self.lines
        flushing, restoring = self._flushing()
        return "\n".join([
            f"define void @{name}({OPERANDS}) #0 {{",
            "entry:", *flushing, *head, *body, *restoring, "  ret void", "}",
        ])  # fmt: skip

    def _flushing(self) -> tuple[list[str], list[str]]:
        """The lines that let the processor take numbers below 1e-307 as zero, and the reverse.

        XLA does so. On other processors than those of x86 they remain.
        """
        if platform.machine() not in ("x86_64", "AMD64"):
            return [], []
        for name in ("ld", "st"):
            self.declared.add(f"declare void @llvm.x86.sse.{name}mxcsr(ptr)")
        return [
            "  %before = alloca i32", "  %flushing = alloca i32",
            "  call void @llvm.x86.sse.stmxcsr(ptr %before)",
            "  %mode = load i32, ptr %before", f"  %flush = or i32 %mode, {FLUSH}",
            "  store i32 %flush, ptr %flushing",
            "  call void @llvm.x86.sse.ldmxcsr(ptr %flushing)",
        ], ["  call void @llvm.x86.sse.ldmxcsr(ptr %before)"]  # fmt: skip

    def _group(self) -> None:
        plan, body = self.plan, self.plan.body
        given = self.pointers("%given", len(body.ins) + len(plan.given))
        self.results = self.pointers("%out", len(body.outs))
        for buffer in plan.buffers:
            if buffer.kind in ("carried", "kept"):
                self.rooms[buffer] = self._room(buffer)
            if buffer in self.doubled:
                self.others[buffer] = self._room(buffer)
                self.turns[buffer] = self.add("alloca ptr"), self.add("alloca ptr")
        group, end = self.loop("%first", "%last")
        for i, x in enumerate(body.ins):
            alike = plan.alike[i]
            by_trial = plan.trials if i >= plan.consts + plan.carry else 1
            at = self.times(group, 0 if alike else math.prod(x.shape) * by_trial)
            given[i] = self.place(given[i], at, self.stored_type(x.dtype))
        self.given = given
        self._begin(group)
        self._trials(group)
        self._end(group)
        self.lines += end

    def _carried(self) -> Iterable[tuple[int, Stored | Array]]:
        """The number among the carried, and the cells or rows."""
        ins = self.plan.ins[self.plan.consts : self.plan.consts + self.plan.carry]
        return ((i, x) for i, x in enumerate(ins) if isinstance(x, Stored | Array))

    def _begin(self, group: str) -> None:
        """What is carried into the first trial."""
        plan = self.plan
        for i, x in self._carried():
            number = plan.consts + i
            alike = plan.alike[number]
            if isinstance(x, Stored):
                room = self.rooms[x.buffer]
                if x.buffer.size:
                    target = room
                    if x.buffer in self.taped:
                        target = self._of_trial(x.buffer, self.times(group, plan.trials, "%begin"))
                    self._copy(x.buffer, self.given[number], target, alike=alike)
                if x.buffer in self.doubled:
                    self._take_turns(x.buffer, room, self.others[x.buffer])
            else:
                for m, cell in enumerate(x.flat):
                    value = self.load(self.given[number], str(m), cell.dtype, alike=alike)
                    self._put(cell, value)

    def _take_turns(self, buffer: Buffer, read: str, written: str) -> None:
        """Let the next trial read what was written, where both are kept apart."""
        for pointer, place in zip((read, written), self.turns[buffer], strict=True):
            self.do(f"store ptr {pointer}, ptr {place}")

    def _rows(self, buffer: Buffer, base: str, number: str, *, alike: bool = False) -> str:
        """The place of the rows of a buffer, of which there are more, by their number."""
        at = self.times(number, buffer.size)
        return self.place(base, at, self.stored_type(buffer.dtype, alike=alike))

    def _of_trial(self, carried: Buffer, trial: str) -> str:
        """The place among the results for what is carried into a trial."""
        return self._rows(carried, self.results[self.taped[carried].number], trial)

    def _given_for(self, given: Buffer, trial: str) -> str:
        """The place of the rows that are given for a trial."""
        return self._rows(given, self.given[given.number], trial, alike=given.alike)

    def _copy(self, buffer: Buffer, source: str, target: str, *, alike: bool = False) -> None:
        """Copy the rows of a buffer, which have one number for all machines if they are alike."""
        k, end = self.loop("0", str(buffer.size))
        self.store(self.load(source, k, buffer.dtype, alike=alike), target, k, buffer.dtype)
        self.lines += end

    def _trials(self, group: str) -> None:
        plan = self.plan
        ends = ("%begin", "%end", 1)
        if plan.reverse:
            ends = self.add("sub i64 %end, 1"), self.add("sub i64 %begin, 1"), -1
        j, end = self.loop(*ends)
        self.trial, self.straight = j, {}
        trial = self.times(group, plan.trials, j)
        for buffer in plan.buffers:
            read = written = self.rooms.get(buffer, "")
            if buffer in self.doubled:
                read, written = (self.add(f"load ptr, ptr {x}") for x in self.turns[buffer])
            elif buffer in self.taped:
                last = self.add(f"icmp eq i64 {self.add('sub i64 %end, 1')}, {j}")
                after = self._of_trial(buffer, self.add(f"add i64 {trial}, 1"))
                read = self._of_trial(buffer, trial)
                written = self.add(f"select i1 {last}, ptr {written}, ptr {after}")
            elif buffer in self.passed:
                begun = self.add(f"icmp eq i64 {j}, {ends[0]}")
                before = self._given_for(self.passed[buffer], self.add(f"sub i64 {j}, {ends[2]}"))
                read = self.add(f"select i1 {begun}, ptr {read}, ptr {before}")
            elif buffer.kind == "given":
                read = self._given_for(buffer, j) if buffer.by_trial else self.given[buffer.number]
            elif buffer.kind == "out":
                written = self._rows(buffer, self.results[buffer.number], trial)
            self.read[buffer], self.written[buffer] = read, written
        for number in range(len(plan.loops) + 1):
            self.values(plan.picks.get(number, []))
            if number < len(plan.loops):
                self._loop(plan.loops[number])
        self._results(trial)
        for buffer in self.doubled:
            self._take_turns(buffer, self.written[buffer], self.read[buffer])
        self.lines += end

    def _results(self, trial: str) -> None:
        """What each trial gives, and the single numbers that it carries to the next one."""
        plan = self.plan
        new: dict[Node, str] = {}
        for i, x in enumerate(plan.outs):
            if isinstance(x, Row):
                continue
            values = self.values(x.flat)
            if i < plan.carry:
                cells = small(plan.ins[plan.consts + i])
                new |= zip(cells.flat, values, strict=True)
                continue
            self._give(i, trial, x, values)
        self._put_all(new, new.values())

    def _give(self, i: int, number: str, x: Array, values: Iterable[str]) -> None:
        """Store single numbers in their place among those of all groups, or trials, of a result."""
        at = self.times(number, x.size)
        for m, (node, value) in enumerate(zip(x.flat, values, strict=True)):
            self.store(value, self.results[i], self.add(f"add i64 {at}, {m}"), node.dtype)

    def _end(self, group: str) -> None:
        """What is carried out of the last trial."""
        for i, x in self._carried():
            if not self.wanted[i]:
                continue
            if isinstance(x, Stored):
                buffer = x.buffer
                out = self._rows(buffer, self.results[i], group)
                source = self.rooms[buffer]
                if buffer in self.doubled:
                    source = self.add(f"load ptr, ptr {self.turns[buffer][0]}")
                if buffer in self.passed:
                    last = "%begin" if self.plan.reverse else self.add("sub i64 %end, 1")
                    source = self._given_for(self.passed[buffer], last)
                self._copy(buffer, source, out)
            else:
                self._give(i, group, x, (self._printed(cell, [], None) for cell in x.flat))

    # A loop over samples
    # ----------------------------------------------------------------------------------------------

    def _loop(self, loop: Loop) -> None:
        for scan in loop.scans:
            for i, cells in scan.cells.items():
                self._put_all(cells.flat, self.values(scan.begin(i).flat))
        for segment in loop.segments:
            self._segment(segment, loop.direction)

    def _segment(self, of: Segment, direction: int) -> None:
        """The samples of a segment, which are printed once more without what is rarely chosen."""
        rarely, rest = without_choices(self.plan, of)
        if not rarely:
            return self._samples(of, direction)
        holds = self.values(rarely)
        kind = f"<{self.lanes} x i1>"
        some = reduce(lambda x, y: self.add(f"or {kind} {x}, {y}"), holds)
        name = f"@llvm.vector.reduce.or.v{self.lanes}i1"
        self.declared.add(f"declare i1 {name}({kind})")
        chosen = self.add(f"call i1 {name}({kind} {some})")
        known = dict(self.straight)
        labels = self.label(), self.label(), self.label()
        self.do(f"br i1 {chosen}, label %{labels[0]}, label %{labels[1]}")
        for label, segment in zip(labels, (of, rest), strict=False):
            self.lines.append(f"{label}:")
            self.straight = dict(known)
            self._samples(segment, direction)
            self.do(f"br label %{labels[2]}")
        self.lines.append(f"{labels[2]}:")
        self.straight = known
        return None

    def _samples(self, of: Segment, direction: int) -> None:
        stores = [x for x in of.stores if x[0] not in self.passed]
        stores += [(r.kept, offset, x) for r, offset, x in of.results if r.kept is not None]
        nodes = [node for _, _, array in stores for node in array.flat]
        nodes += [new for _, new in of.cells]
        if not nodes:
            return
        before = reached(nodes, lambda x: x.args if x.varies else ())
        self.values(x for x in before if not x.varies)
        self.inside = {}
        begin, last, d = of.first, of.last, 1
        if direction <= 0:
            begin, last, d = of.last - 1, of.first - 1, -1
        handed, early, then = list[Handed](), list[tuple[Node, Node]](), list[str]()
        k, end = str(begin), list[str]()
        if of.last - of.first > 1:
            handed = handed_on(self.plan, of, nodes, d)
            wanted = [*nodes, *(x.ahead for x in handed)]
            early = begun_early(self.plan, stores, wanted, handed, d)
            first = [*((x.cell, x.node) for x in handed), *early]
            self._put_all((x for x, _ in first), self.values((x for _, x in first), k))
            k, end = self.loop(str(begin), str(last), d)
            self.asking = _asked_for(nodes, d)
            now = {node: self._printed(cell, [], k) for cell, node in first}
            self.inside = {x.node: now[x.ahead] for x in handed if x.ahead in now}
            then = self.values((x for _, x in early), self._next(k, last - d, d)) if early else []
            self.inside = now
        self.values([*nodes, *(x.ahead for x in handed)], k)
        for buffer, offset, array in stores:
            for m, node in enumerate(array.flat):
                if isinstance(node.what, At) and self.taped.get(node.what.buffer) == buffer:
                    continue  # it is there
                index = self._index(k, 1, offset, buffer.width, m)
                self.store(self._known(node)[node], self.written[buffer], index, buffer.dtype)
        for cell, new in (*of.cells, *((x.cell, x.ahead) for x in handed)):
            self._put(cell, self._known(new)[new])
        self._put_all((x for x, _ in early), then)
        self.lines += end
        self.inside, self.asking = {}, {}


def _asked_for(nodes: Iterable[Node], d: int) -> dict[tuple[Buffer, int], int]:
    """The rows that a loop asks for ahead, by buffer and number, with how many samples ahead.

    They are more than a processor follows by itself, or none. The way back of FFDL-MFAILC has 24,
    and value and slopes took 0.93 of the time.
    d: 1 for a loop that runs forward, -1 for one that runs backward
    """
    read = [x.what for x in in_turn(nodes) if isinstance(x.what, At)]
    found = {
        (x.buffer, x.number): x.sign * d * AHEAD for x in read if x.sign and not x.buffer.alike
    }
    return found if len(found) > FOLLOWED else {}


def aligned(size: int) -> int:
    """The bytes of so many of which the next are aligned."""
    return -(-size // ALIGNED) * ALIGNED


def module(functions: Sequence[Text]) -> str:
    """The text of a module of functions, whose names differ.

    They align the stack. LLVM aligns it to 16 bytes where it decides late to keep registers there,
    so that most of them may lie across two lines of the cache: the slopes of FFDL-MFAILC took
    up to 1.2 times as long, by where the stack began.
    """
    declared = {line for one in functions for line in one.declared}
    attributes = f"attributes #0 = {{ noinline nounwind alignstack={ALIGNED} {WIDTH} }}"
    return "\n".join([*sorted(declared), *(one.function for one in functions), attributes])


def _doubled(plan: Trials) -> list[Buffer]:
    """The carried rows that are written elsewhere, since somebody reads the old ones later."""
    found = []
    for number, loop in enumerate(plan.loops):
        for sink in loop.sinks:
            d, buffer = loop.direction, sink.buffer
            if buffer.kind == "carried" and any(
                at > number or (at == number and (sign != 1 or d * c < d * sink.offset))
                for read, at, sign, c in plan.reads if read == buffer
            ):  # fmt: skip
                found.append(buffer)
    return found


def _taped(plan: Trials) -> dict[Buffer, Buffer]:
    """The carried rows that are kept for each trial, as a gradient does, with the results they are.

    A trial writes what it carries to where the results of the next one are.
    """
    found: dict[Buffer, Buffer] = {}
    written = {sink.buffer for loop in plan.loops for sink in loop.sinks}
    kept: dict[Buffer, set[Buffer | None]] = {}
    for loop in plan.loops if not plan.reverse else []:
        for segment in loop.segments:
            for buffer, offset, array in segment.stores:
                if buffer.kind == "out":
                    places = (At(buffer, 1, offset, m) for m in range(array.size))
                    kept.setdefault(buffer, set()).update(map(_begun_with, array.flat, places))
    for out, begun in kept.items():
        carried = begun.pop()
        if begun or carried is None or carried in found or carried not in written:
            continue
        if (carried.length, carried.width, carried.dtype) == (out.length, out.width, out.dtype):
            found[carried] = out
    return found


def _begun_with(node: Node, at: At) -> Buffer | None:
    """The carried rows of which a number of a result is that at the same place."""
    what = node.what
    if not isinstance(what, At) or what.buffer.kind != "carried":
        return None
    return what.buffer if what == at._replace(buffer=what.buffer) else None


def _passed(plan: Trials) -> dict[Buffer, Buffer]:
    """The carried rows that were given for the trial before, with the latter, which are read."""
    sinks = [(sink.buffer, row) for loop in plan.loops for sink in loop.sinks for row in sink.rows]
    return {
        buffer: row.buffer for buffer, row in sinks
        if buffer.kind == "carried" and isinstance(row, Stored) and row.axis == 0
        and row.buffer.kind == "given" and row.buffer.by_trial and not row.buffer.alike
    }  # fmt: skip


def _scalar(dtype: np.dtype) -> str:
    return TYPES.get(dtype.name, f"i{8 * dtype.itemsize}")


def _number(value: Number, dtype: np.dtype) -> str:
    if dtype.kind == "f":
        return f"0x{np.float64(value).view(np.uint64):016X}"
    return ("true" if value else "false") if dtype.kind == "b" else str(int(value))
