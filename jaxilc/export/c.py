"""A printer of programs in C99.

Arrays between loops lie in a work space, each where another has ended.
"""

from __future__ import annotations

import re
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
from jax.typing import DTypeLike

from ..native.operations import LIBRARY, Node, Number
from ..native.program import Unknown
from .law import Field, Function
from .printer import Body, View, closed, filled, row_major

LITTLE = 32  # elements of an array on the stack
REAL = "law_real"
TYPES = {"f": REAL, "b": "bool", "int32": "int32_t", "int64": "int64_t", "uint32": "uint32_t"}
UNSIGNED = {"int32": "uint32_t", "int64": "uint64_t", "uint32": "uint32_t"}
INFIX = {"add": "+", "sub": "-", "mul": "*", "div": "/", "rem": "%", "eq": "==", "ne": "!=",
         "lt": "<", "le": "<=", "gt": ">", "ge": ">="}  # fmt: skip
OF_BITS = {"and": ("&&", "&"), "or": ("||", "|"), "xor": ("!=", "^")}
OF_LIBRARY = {"abs": "fabs", "round_even": "rint", "round_away": "round"} | {
    name: name for name in ("sqrt", "floor", "ceil", "copysign", *LIBRARY)
}


def type_of(dtype: DTypeLike) -> str:
    dtype = np.dtype(dtype)
    return TYPES.get(dtype.kind) or TYPES[dtype.name]


def number(value: float | Number, dtype: DTypeLike, single: bool) -> str:
    """A constant, which C reads as the same number."""
    kind = np.dtype(dtype).kind
    if kind == "b":
        return "true" if value else "false"
    if kind != "f":
        if value < 0 and value == np.iinfo(dtype).min:  # the sign is an operation of its own
            return f"INT{8 * np.dtype(dtype).itemsize}_MIN"
        return f"{value}{'u' if kind == 'u' else ''}" if value >= 0 else f"({value})"
    if single:
        with np.errstate(over="ignore"):  # which is infinite then
            value = np.float32(value)
    if not np.isfinite(value):
        return "NAN" if np.isnan(value) else "INFINITY" if value > 0 else "(-INFINITY)"
    text = f"{float(str(value))!r}f" if single else repr(float(value))
    return f"({text})" if np.signbit(value) else text


def field_name(name: str) -> str:
    """The member of the struct for a field."""
    return re.sub(r"\W+", "_", name, flags=re.ASCII).strip("_")


def plain(text: str) -> str:
    """A text that neither ends a comment nor begins another."""
    return text.replace("*/", "* /").replace("/*", "/ *").replace("??", "? ?")


class Printed(NamedTuple):
    """The lines of a function, the lines of its tables, and the room it needs by type."""

    lines: list[str]
    tables: list[str]
    work: dict[str, int]

    def under(self, head: str, before: Sequence[str] = ()) -> str:
        """The text of the function behind its tables, with lines before those of its body."""
        return "\n".join([*self.tables, head, "{", *before, *self.lines, "}", ""])


class Code:
    """A law or a plant in C: the struct of its fields, and its functions.

    start: the function that sets the fields, and what is in `also`, to what they are at first
    functions: the others, by name;  work: the room that they share, by type
    Raises Unknown for what C cannot hold.
    """

    def __init__(self, fields: Mapping[str, Field], functions: Sequence[Function], *,
                 single: bool, also: Mapping[str, Field] | None = None):  # fmt: skip
        if len({*map(field_name, fields)}) < len(fields):
            raise Unknown("two fields have one name in C")
        self.fields, self.single = fields, single
        start = _InC("start", single)
        start.start({**fields, **(also or {})})
        self.start = start.printed()
        self.functions = {one.name: _InC(one.name, single).whole(one) for one in functions}
        self.work: dict[str, int] = {}
        for kind, size in (of for body in self.functions.values() for of in body.work.items()):
            self.work[kind] = max(self.work.get(kind, 0), size)

    @property
    def members(self) -> str:
        """The lines of the struct."""
        lines = []
        for name, of in self.fields.items():
            if not of.first.size:  # C has no arrays without elements
                continue
            size = "" if of.first.size == 1 else f"[{of.first.size}]"
            said = [str(of.first.shape)] if of.first.size > 1 else []
            said += [f"[{plain(of.unit)}]"] if of.unit else []
            told = f"  /* {' '.join(said)} */" if said else ""
            lines.append(f"    {type_of(of.first.dtype)} {field_name(name)}{size};{told}")
        lines += [f"    {kind} work_{kind}[{room}];" for kind, room in self.work.items()]
        return "\n".join(lines)

    @property
    def bytes(self) -> int:
        """The bytes of the struct, without what C pads."""
        sizes = {REAL: 4 if self.single else 8, "bool": 1, "int64_t": 8}
        kept = [(type_of(of.first.dtype), of.first.size) for of in self.fields.values()]
        return sum(sizes.get(kind, 4) * int(n) for kind, n in (*kept, *self.work.items()))


class _InC(Body):
    index, end = "int", "}"

    def __init__(self, name: str, single: bool):
        super().__init__(1)
        self.of, self.single = name, single
        self.lines_of_tables: list[str] = []
        self.blocks: list[tuple[int, int]] = []  # lines of loops that are in no other
        self.arrays: dict[str, tuple[str, int]] = {}  # by name, type and size

    def whole(self, function: Function) -> Printed:
        self.function(function)
        if "code" in function.outs:
            self.lines = ["    int code;", *self.lines, "    return code;"]
            self.blocks = [(a + 1, b + 1) for a, b in self.blocks]
        return self.printed()

    def type_of(self, dtype: DTypeLike) -> str:
        return type_of(dtype)

    def number(self, value: float | Number, dtype: DTypeLike) -> str:
        return number(value, dtype, self.single)

    def place(self, name: str, shape: tuple[int, ...]) -> View:
        if name in ("y", "u"):
            return View(f"{name}[{{}}]", shape, row_major(shape))
        if name in ("k", "code"):
            return View(name, shape)
        return View.of(f"l->{field_name(name)}", shape)

    def room(self, name: str, kind: str, size: int) -> None:
        if size == 1:
            self.line(f"{kind} {name};")
        else:
            self.arrays[name] = (kind, size)

    def table(self, kind: str, numbers: Sequence[str]) -> str:
        name = f"{self.of}_c{len(self.tables)}"
        self.lines_of_tables += table(kind, name, numbers)
        return name

    def defined(self, name: str, kind: str, text: str, *, changes: bool = False) -> str:
        return f"{'' if changes else 'const '}{kind} {name} = {text};"

    def assigned(self, to: str, text: str) -> str:
        return f"{to} = {text};"

    def head(self, name: str, count: int, back: bool) -> str:
        if back:
            return f"for (int {name} = {count - 1}; {name} >= 0; --{name}) {{"
        return f"for (int {name} = 0; {name} < {count}; ++{name}) {{"

    @contextmanager
    def loop(self, name: str, count: int, *, back: bool = False) -> Generator[None]:
        start = len(self.lines)
        with super().loop(name, count, back=back):
            yield
        if self.depth == 1:
            self.blocks.append((start, len(self.lines)))

    def leave_unless(self, text: str) -> list[str]:
        return [f"if (!{text}) {{", "    break;", "}"]

    def clamped(self, place: str, last: int) -> str:
        return f"law_place({place}, {last})"

    def of_place(self, kind: str) -> str:
        return f"(({kind}) ({{}}))"

    def operation(self, x: Node, args: Sequence[str]) -> str:
        near, kind = [closed(one) for one in args], x.args[0].dtype.kind
        if x.name == "select":
            return f"{near[0]} ? {near[2]} : {near[1]}"
        if x.name == "convert":
            to = type_of(x.dtype)
            made = f"law_to_{to}({args[0]})" if kind == "f" and x.dtype.kind in "iu" else ""
            return made or f"({to}) {near[0]}"
        if x.name in OF_BITS:
            if kind == "b" and x.name == "xor" and args[1] == "true":
                return f"!{near[0]}"
            return f" {OF_BITS[x.name][kind != 'b']} ".join(near)
        if x.name in ("max", "min"):
            if kind == "f":
                return f"law_{x.name}({', '.join(args)})"
            than = ">" if x.name == "max" else "<"
            return f"{near[0]} {than} {near[1]} ? {near[0]} : {near[1]}"
        if x.name in INFIX:
            if kind in "iu" and x.name in ("add", "sub", "mul"):  # which may not overflow in C
                wide = UNSIGNED[x.dtype.name]
                inner = f" {INFIX[x.name]} ".join(f"({wide}) {one}" for one in near)
                return f"({type_of(x.dtype)}) ({inner})"
            return f" {INFIX[x.name]} ".join(near)
        if x.name == "neg":
            return f"-{near[0]}"
        if kind != "f":
            raise Unknown(f"{x.name} of {x.dtype}")
        return f"LAW_F({OF_LIBRARY[x.name]})({', '.join(args)})"

    def printed(self) -> Printed:
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
        return Printed([*head, *self.lines], self.lines_of_tables, work)


def table(kind: str, name: str, numbers: Sequence[str]) -> list[str]:
    """The lines of a table of constants."""
    return [f"static const {kind} {name}[{len(numbers)}] = {{", *filled(numbers), "};"]
