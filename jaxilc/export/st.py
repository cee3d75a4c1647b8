"""A law as a function block in Structured Text (IEC 61131-3), for TwinCAT 3 and CODESYS.

Each step of the program is written out in its order: loops over flat arrays of LREAL, one array for
each result, so that the text can be followed beside the meaning of the operations. The functions
that Structured Text lacks stand behind the block.
"""

from __future__ import annotations

import itertools
import math
import re
import textwrap
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
from jax.typing import DTypeLike

from ..native.operations import Node, Number, elementwise
from ..native.program import Const, Program, Step, Unknown, Value
from . import guard, operations
from .law import Function, Law
from .steps import uniform

BYTES = {"LREAL": 8, "LINT": 8, "DINT": 4, "UDINT": 4, "BOOL": 1}
TYPES = {"f": "LREAL", "b": "BOOL", "int32": "DINT", "int64": "LINT", "uint32": "UDINT"}
INFIX = {"add": "+", "sub": "-", "mul": "*", "div": "/", "eq": "=", "ne": "<>", "lt": "<",
         "le": "<=", "gt": ">", "ge": ">=", "and": "AND", "or": "OR", "xor": "XOR"}  # fmt: skip
CALLS = {"abs": "ABS", "sqrt": "SQRT", "exp": "EXP", "log": "LN", "sin": "SIN", "cos": "COS",
         "tan": "TAN", "pow": "EXPT", "floor": "LAW_FLOOR", "ceil": "LAW_CEIL",
         "round_even": "LAW_ROUND", "copysign": "LAW_COPYSIGN", "tanh": "LAW_TANH",
         "max": "LAW_MAX", "min": "LAW_MIN"}  # fmt: skip
OWN = """
(* The larger and the smaller number; the first one if it is not a number. *)
FUNCTION LAW_MAX : LREAL
VAR_INPUT
    a, b : LREAL;
END_VAR
LAW_MAX := SEL(a <> a OR a > b, b, a);
END_FUNCTION

FUNCTION LAW_MIN : LREAL
VAR_INPUT
    a, b : LREAL;
END_VAR
LAW_MIN := SEL(a <> a OR a < b, b, a);
END_FUNCTION

(* A place of a part within an array, whose last possible one is given. *)
FUNCTION LAW_PLACE : DINT
VAR_INPUT
    place : LINT;
    last : DINT;
END_VAR
IF place < 0 THEN
    LAW_PLACE := 0;
ELSIF place > last THEN
    LAW_PLACE := last;
ELSE
    LAW_PLACE := TO_DINT(place);
END_IF
END_FUNCTION

(* Whole numbers near a number. From 2^52 on every number is whole. *)
FUNCTION LAW_FLOOR : LREAL
VAR_INPUT
    x : LREAL;
END_VAR
LAW_FLOOR := x;
IF ABS(x) < 4503599627370496.0 THEN
    LAW_FLOOR := TO_LREAL(LREAL_TO_LINT(x));
    IF LAW_FLOOR > x THEN
        LAW_FLOOR := LAW_FLOOR - 1.0;
    END_IF
END_IF
END_FUNCTION

FUNCTION LAW_CEIL : LREAL
VAR_INPUT
    x : LREAL;
END_VAR
LAW_CEIL := -LAW_FLOOR(-x);
END_FUNCTION

(* The nearest whole number; of two equally near the even one. *)
FUNCTION LAW_ROUND : LREAL
VAR_INPUT
    x : LREAL;
END_VAR
VAR
    below, rest : LREAL;
END_VAR
below := LAW_FLOOR(x);
rest := x - below;
LAW_ROUND := below;
IF rest > 0.5 OR rest = 0.5 AND LAW_FLOOR(below / 2.0) * 2.0 <> below THEN
    LAW_ROUND := below + 1.0;
END_IF
END_FUNCTION

FUNCTION LAW_COPYSIGN : LREAL
VAR_INPUT
    a, b : LREAL;
END_VAR
LAW_COPYSIGN := SEL(b < 0.0 OR b = 0.0 AND 1.0 / b < 0.0, ABS(a), -ABS(a));
END_FUNCTION

FUNCTION LAW_TANH : LREAL
VAR_INPUT
    x : LREAL;
END_VAR
LAW_TANH := 1.0 - 2.0 / (EXP(2.0 * x) + 1.0);
END_FUNCTION

(* The whole part of a number, held within the range of the integer; 0 for what is not a number. *)
FUNCTION LAW_TO_DINT : DINT
VAR_INPUT
    x : LREAL;
END_VAR
IF x >= 2147483647.0 THEN
    LAW_TO_DINT := 2147483647;
ELSIF x <= -2147483648.0 THEN
    LAW_TO_DINT := -2147483648;
ELSIF x = x THEN
    LAW_TO_DINT := TO_DINT(SEL(x < 0.0, LAW_FLOOR(x), -LAW_FLOOR(-x)));
END_IF
END_FUNCTION

FUNCTION LAW_TO_LINT : LINT
VAR_INPUT
    x : LREAL;
END_VAR
IF x >= 9.2E18 THEN
    LAW_TO_LINT := 9223372036854775807;
ELSIF x <= -9.2E18 THEN
    LAW_TO_LINT := -9223372036854775807;
ELSIF x = x THEN
    LAW_TO_LINT := LREAL_TO_LINT(SEL(x < 0.0, LAW_FLOOR(x), -LAW_FLOOR(-x)));
END_IF
END_FUNCTION
"""


class FunctionBlock(NamedTuple):
    """The text of `law.st`, and the bytes of its variables and tables without what is padded."""

    text: str
    bytes: int


def function_block(law: Law, about: Sequence[str], digest: str) -> FunctionBlock:
    """A law in Structured Text; raises Unknown for what the language cannot hold."""
    block, total = _Block(law), 0
    text = block.printed(about, digest)
    for line in [*block.variables, *block.constants, *block.kept]:
        found = re.search(r" : (?:ARRAY\[0\.\.(\d+)\] OF )?(\w+)", line)
        if found:
            total += (int(found[1] or 0) + 1) * BYTES[found[2]]
    return FunctionBlock(text, total)


def type_of(dtype: DTypeLike) -> str:
    dtype = np.dtype(dtype)
    found = TYPES.get(dtype.kind) or TYPES.get(dtype.name)
    if found is None:
        raise Unknown(f"numbers of the type {dtype} in Structured Text")
    return found


def number(value: float | Number, dtype: DTypeLike) -> str:
    """A constant, which a compiler reads as the same number."""
    kind = np.dtype(dtype).kind
    if kind == "b":
        return "TRUE" if value else "FALSE"
    if kind != "f":
        return str(int(value)) if value >= 0 else f"({int(value)})"
    if np.isnan(value):
        return "nan"
    if np.isinf(value):
        return "inf" if value > 0 else "(-inf)"
    text = repr(float(value)).upper()
    mantissa, _, power = text.partition("E")
    mantissa += "" if "." in mantissa else ".0"
    text = mantissa + (f"E{int(power)}" if power else "")
    return f"({text})" if np.signbit(value) else text


class _Flat:
    """How the elements of an array are written, by their places in row-major order.

    form: with {} for the place; without it, all are one number
    """

    def __init__(self, form: str):
        self.form = form

    def __getitem__(self, place: str) -> str:
        return self.form.format(place) if "{}" in self.form else self.form


class _Block:
    def __init__(self, law: Law):
        self.law, self.count = law, itertools.count()
        self.lines: list[str] = []
        self.depth = 0
        self.variables: list[str] = []
        self.tables: dict[tuple[str, bytes], str] = {}
        self.constants: list[str] = []
        self.kept: list[str] = []  # fields of the law
        self.values: dict[Value, _Flat] = {}
        self.names: dict[str, str] = {}
        for name in law.fields:  # names differ by more than case here
            short = re.sub(r"_+", "_", re.sub(r"\W", "_", name)).strip("_")
            taken = {one.lower() for one in self.names.values()}
            while short.lower() in taken:
                short += "x"
            self.names[name] = short

    # Lines
    # ----------------------------------------------------------------------------------------------

    def line(self, text: str) -> None:
        self.lines.append("    " * self.depth + text)

    def new(self, letter: str, kind: str, size: int = 1) -> str:
        name = f"{letter}{next(self.count)}"
        of = kind if size == 1 else f"ARRAY[0..{size - 1}] OF {kind}"
        self.variables.append(f"    {name} : {of};")
        return name

    def room(self, x: Value) -> _Flat:
        size = math.prod(x.shape)
        name = self.new("a" if size > 1 else "s", type_of(x.dtype), size)
        return _Flat(f"{name}[{{}}]" if size > 1 else name)

    @contextmanager
    def loop(self, n: int, *, back: bool = False) -> Generator[str]:
        """A loop over places 0 to n - 1, or back from the last one; of one pass it is none."""
        if n == 1:
            yield "0"
            return
        name = self.new("i", "DINT")
        self.line(f"FOR {name} := " + (f"{n - 1} TO 0 BY -1 DO" if back else f"0 TO {n - 1} DO"))
        self.depth += 1
        yield name
        self.depth -= 1
        self.line("END_FOR")

    @contextmanager
    def over(self, shape: Sequence[int]) -> Generator[list[str]]:
        """Loops over all axes; gives their indices."""
        if not shape:
            yield []
            return
        with self.loop(shape[0]) as first, self.over(shape[1:]) as rest:
            yield [first, *rest]

    def copy(self, to: _Flat, x: _Flat, size: int, at: str = "", of: str = "") -> None:
        with self.loop(size) as i:
            self.line(f"{to[_sum(at, i)]} := {x[_sum(of, i)]};")

    # Values
    # ----------------------------------------------------------------------------------------------

    def value(self, x: Value) -> _Flat:
        if isinstance(x, Const):
            return self.constant(np.asarray(x.array), x.dtype)
        return self.values[x]

    def constant(self, array: np.ndarray, dtype: DTypeLike) -> _Flat:
        flat = array.ravel()
        if uniform(array):
            return _Flat(number(flat[0], dtype))
        if not np.all(np.isfinite(flat)) and np.dtype(dtype).kind == "f":
            raise Unknown("a table with numbers that are not finite, in Structured Text")
        key = (type_of(dtype), np.ascontiguousarray(array).tobytes())
        if key not in self.tables:
            self.tables[key] = name = f"c{len(self.tables)}"
            words = [number(x, dtype).strip("()") for x in flat]
            self.constants += [f"    {name} : ARRAY[0..{flat.size - 1}] OF {key[0]} := [",
                               *_filled(words), "    ];"]  # fmt: skip
        return _Flat(f"{self.tables[key]}[{{}}]")

    # Steps
    # ----------------------------------------------------------------------------------------------

    def run(self, program: Program) -> None:
        for step in program.steps:
            self.step(step)

    def step(self, step: Step) -> None:
        if step.name in ("scan", "while"):
            (self.scan if step.name == "scan" else self.until)(step)
            return
        out, ins = step.outs[0], [self.value(x) for x in step.ins]
        if not math.prod(out.shape):
            self.values[out] = _Flat("0")
        elif step.name in ("reshape", "squeeze", "expand_dims"):
            self.values[out] = ins[0]
        else:
            self.values[out] = to = self.room(out)
            if elementwise(step.name):
                self.one_by_one(step, ins, to)
            else:
                WRITTEN[step.name](self, step, ins, to)

    def one_by_one(self, step: Step, ins: list[_Flat], to: _Flat) -> None:
        shape = step.outs[0].shape
        size = math.prod(shape)
        alike = all(math.prod(x.shape) in (1, size) for x in step.ins)
        with self.over([size] if alike else shape) as index:
            places = [
                _at(_row_major(x.shape), [i if n > 1 else "0" for i, n in
                                          zip(index, x.shape, strict=True)])
                if not alike else index[0] if math.prod(x.shape) > 1 else "0"
                for x in step.ins
            ]  # fmt: skip
            operands = [x[place] for x, place in zip(ins, places, strict=True)]
            at = index[0] if alike else _at(_row_major(shape), index)
            text = self.formula(operations.formula(step).root, operands)
            self.line(f"{to[at]} := {_open(text)};")

    def formula(self, x: Node, operands: Sequence[str]) -> str:
        if x.name == "operand":
            return operands[x.operand]
        if x.name == "const":
            return number(x.value, x.dtype)
        args = [self.formula(one, operands) for one in x.args]
        kind = x.args[0].dtype.kind
        if x.name == "select":
            return f"SEL({', '.join(map(_open, args))})"
        if x.name == "convert":
            to = type_of(x.dtype)
            if kind == "f" and to == "UDINT":  # whose conversion rounds
                raise Unknown("a conversion to UDINT in Structured Text")
            way = f"LAW_TO_{to}" if kind == "f" and to in ("DINT", "LINT") else f"TO_{to}"
            return args[0] if to == type_of(x.args[0].dtype) else f"{way}({_open(args[0])})"
        if x.name in INFIX:
            if kind in "iu" and x.name == "div":
                raise Unknown("a division of whole numbers")
            return f"({f' {INFIX[x.name]} '.join(args)})"
        if x.name == "neg":
            return f"(-{args[0]})"
        if x.name in ("max", "min") and kind != "f":
            return f"{x.name.upper()}({', '.join(map(_open, args))})"
        if x.name == "round_away" or x.name not in CALLS or kind != "f":
            raise Unknown(f"{x.name} of {x.dtype} in Structured Text")
        return f"{CALLS[x.name]}({', '.join(map(_open, args))})"

    def together(self, name: str, a: str, b: str, dtype: np.dtype) -> str:
        left, right = (Node("operand", (), np.dtype(dtype), i) for i in range(2))
        return _open(self.formula(Node(name, (left, right), np.dtype(dtype)), [a, b]))

    def moved(self, shape: Sequence[int], strides: Sequence[int], start: int | str, x: _Flat,
              to: _Flat) -> None:  # fmt: skip
        """The elements of a part, in row-major order, each read at its place in x."""
        with self.over(shape) as index:
            self.line(f"{to[_at(_row_major(shape), index)]} := {x[_at(strides, index, start)]};")

    def scan(self, step: Step) -> None:
        of, body = step.params, step.params["body"]
        n, m = of["consts"], of["consts"] + of["carry"]
        ins = [self.value(x) for x in step.ins]
        state = [self.room(x) for x in step.outs[: of["carry"]]]
        kept = [self.room(x) for x in step.outs[of["carry"] :]]
        for to, x, one in zip(state, ins[n:m], step.ins[n:m], strict=True):
            self.copy(to, x, math.prod(one.shape))
        rows = [self.room(x) for x in body.ins[m:]]
        if of["length"]:
            with self.loop(of["length"], back=of["reverse"]) as k:
                for to, x, one in zip(rows, ins[m:], body.ins[m:], strict=True):
                    size = math.prod(one.shape)
                    self.copy(to, x, size, of=_times(size, k))
                self.values.update(zip(body.ins, [*ins[:n], *state, *rows], strict=True))
                self.run(body)
                found = [self.value(x) for x in body.outs]
                for to, x, one in zip(kept, found[of["carry"] :], body.outs[of["carry"] :],
                                      strict=True):  # fmt: skip
                    size = math.prod(one.shape)
                    self.copy(to, x, size, at=_times(size, k))
                self.carry_on(state, found[: of["carry"]], body.outs)
        self.values.update(zip(step.outs, [*state, *kept], strict=True))

    def carry_on(self, state: list[_Flat], found: list[_Flat], values: Sequence[Value]) -> None:
        """Put what a pass has found in place of what it began with, as if all at once."""
        pairs = [(to, x, v) for to, x, v in zip(state, found, values, strict=False)
                 if to.form != x.form]  # fmt: skip
        forms = {to.form for to, _, _ in pairs}
        safe = []
        for to, x, v in pairs:
            if x.form in forms:
                x, before = self.room(v), x
                self.copy(x, before, math.prod(v.shape))
            safe.append((to, x, v))
        for to, x, v in safe:
            self.copy(to, x, math.prod(v.shape))

    def until(self, step: Step) -> None:
        of, ins = step.params, [self.value(x) for x in step.ins]
        n, m = of["of_condition"], of["of_body"]
        state = [self.room(x) for x in step.outs]
        for to, x, one in zip(state, ins[n + m :], step.outs, strict=True):
            self.copy(to, x, math.prod(one.shape))
        with self.loop(max(2, of["bound"])):
            self.values.update(zip(of["condition"].ins, [*ins[:n], *state], strict=True))
            self.run(of["condition"])
            self.line(f"IF NOT {self.value(of['condition'].outs[0])['0']} THEN")
            self.line("    EXIT;")
            self.line("END_IF")
            self.values.update(zip(of["body"].ins, [*ins[n : n + m], *state], strict=True))
            self.run(of["body"])
            self.carry_on(state, [self.value(x) for x in of["body"].outs], of["body"].outs)
        self.values.update(zip(step.outs, state, strict=True))

    # The block
    # ----------------------------------------------------------------------------------------------

    def field(self, name: str) -> _Flat:
        size = self.law.fields[name].first.size
        return _Flat(self.names[name] + ("[{}]" if size > 1 else ""))

    def function(self, function: Function, given: Mapping[str, _Flat]) -> None:
        """A function of the law: its steps, and then what it changes, as if all at once."""

        def place(name: str) -> _Flat:
            return given[name] if name in given else self.field(name)

        program = function.program
        self.values.update(zip(program.ins, map(place, function.ins), strict=True))
        in_place = function.in_place()
        self.run(Program(program.ins, [s for s in program.steps if s not in in_place.values()],
                         program.outs))  # fmt: skip
        whole = [(place(name), x) for name, x in zip(function.outs, program.outs, strict=True)
                 if name not in in_place]  # fmt: skip
        parts = [(self.field(name), step) for name, step in in_place.items()]
        held = []
        for _, step in parts:  # what is put into a part may be a field that changes, too
            row = self.room(step.ins[1])
            self.copy(row, self.value(step.ins[1]), math.prod(step.ins[1].shape))
            starts = _starts(self, [self.value(x) for x in step.ins[2:]], step.outs[0].shape,
                             step.ins[1].shape)  # fmt: skip
            held.append((row, starts))
        self.carry_on([to for to, _ in whole], [self.value(x) for _, x in whole],
                      [x for _, x in whole])  # fmt: skip
        for (to, step), (row, starts) in zip(parts, held, strict=True):
            self.put(to, row, step.outs[0].shape, step.ins[1].shape, starts)

    def put(self, to: _Flat, x: _Flat, whole: Sequence[int], part: Sequence[int],
            starts: Sequence[str]) -> None:  # fmt: skip
        with self.over(part) as index:
            places = [_sum(a, b) for a, b in zip(starts, index, strict=True)]
            self.line(f"{to[_at(_row_major(whole), places)]} := "
                      f"{x[_at(_row_major(part), index)]};")  # fmt: skip

    def part(self, name: str, depth: int, **given: _Flat) -> list[str]:
        self.lines, self.depth = [], depth
        self.function(next(f for f in self.law.functions if f.name == name), given)
        return self.lines

    def printed(self, about: Sequence[str], digest: str) -> str:
        law, task = self.law, self.law.task
        measured = _Flat("measured[{}]" if task.outputs > 1 else "measured")
        command = _Flat("command[{}]" if task.inputs > 1 else "command")
        begin = self.part("begin", 1)
        sample = self.part("sample", 2, k=_Flat("sample"), y=measured, u=command)
        end = self.part("end", 2, y=measured, code=_Flat("code"))
        first, texts = list[str](), "\n".join([*begin, *sample, *end])
        for name, of in law.fields.items():
            flat, short = of.first.ravel(), self.names[name]
            if not re.search(rf"\b{short}\b", texts) or not flat.size:
                continue
            unit = f"  (* [{of.unit}] *)" if of.unit else ""
            size = f"ARRAY[0..{flat.size - 1}] OF " if flat.size > 1 else ""
            self.kept.append(f"    {short} : {size}{type_of(flat.dtype)};{unit}")
            self.lines, self.depth = first, 1
            self.copy(self.field(name), self.constant(of.first, flat.dtype), flat.size)
        floats = [f"    {name} : LREAL;" for name in ("inf", "nan")]
        said = "".join(
            f"   {line}\n"
            for line in _wrapped(
                [*about, f"certificate {digest}", *(one.format(N=task.N) for one in ABOUT)]
            )
        )
        codes = "".join(f"   {i} {meaning}\n" for i, meaning in enumerate(guard.MEANINGS))
        join = "\n".join
        return f"""(*
{said}   The codes of a trial:
{codes}*)
FUNCTION_BLOCK FB_Law
VAR_INPUT
    measured : {_many(task.outputs)}; (* measured output [{task.unit or "1"}] *)
    begin_trial : BOOL; (* a trial begins where none is running *)
END_VAR
VAR_OUTPUT
    command : {_many(task.inputs)}; (* input of the plant [{task.input_unit or "1"}] *)
    running : BOOL; (* a trial is running *)
    trials : DINT; (* trials that have ended *)
    code : DINT; (* what the last trial ended with *)
END_VAR
VAR
    started : BOOL;
    sample : DINT;
    zero : LREAL;
{join(floats)}
{join(self.kept)}
{join(self.variables)}
END_VAR
VAR CONSTANT
    certificate : STRING(80) := '{digest}';
{join(self.constants)}
END_VAR
IF NOT started THEN
    zero := 0.0;
    inf := 1.0 / zero;
    nan := inf - inf;
{join(first)}
    started := TRUE;
END_IF
IF begin_trial AND NOT running THEN
{join(begin)}
    sample := 0;
    running := TRUE;
END_IF
IF running THEN
    IF sample < {task.N} THEN
{join(sample)}
        sample := sample + 1;
    ELSE
{join(end)}
        trials := trials + 1;
        running := FALSE;
{join(f"        command{f'[{i}]' if task.inputs > 1 else ''} := 0.0;" for i in range(task.inputs))}
    END_IF
END_IF
END_FUNCTION_BLOCK
{OWN}"""


ABOUT = (
    "The block is called once in each sample time, for {N} samples and one more in a trial. It "
    "begins a trial when begin_trial is true and none is running, and learns at the last call. "
    "Between trials command is 0.",
    "Numbers are LREAL. Quotients by zero and numbers that are not finite follow IEEE 754, as the "
    "guard needs: the floating-point exceptions of the task must be off.",
)


def _many(count: int) -> str:
    return "LREAL" if count == 1 else f"ARRAY[0..{count - 1}] OF LREAL"


def _wrapped(lines: Sequence[str]) -> list[str]:
    plain = [line.replace("*)", "* )").replace("(*", "( *") for line in lines]
    return [part for line in plain for part in textwrap.wrap(line, 94) or [""]]


# Steps on arrays
# --------------------------------------------------------------------------------------------------


def _transpose(block: _Block, step: Step, ins: list[_Flat], to: _Flat) -> None:
    strides = _row_major(step.ins[0].shape)
    block.moved(step.outs[0].shape, [strides[i] for i in step.params["permutation"]], 0, ins[0], to)


def _rev(block: _Block, step: Step, ins: list[_Flat], to: _Flat) -> None:
    shape, strides, start = step.outs[0].shape, list(_row_major(step.outs[0].shape)), 0
    for i in step.params["dimensions"]:
        start += strides[i] * (shape[i] - 1)
        strides[i] = -strides[i]
    block.moved(shape, strides, start, ins[0], to)


def _broadcast(block: _Block, step: Step, ins: list[_Flat], to: _Flat) -> None:
    shape, strides = step.outs[0].shape, [0] * len(step.outs[0].shape)
    own = step.ins[0].shape
    for i, axis in enumerate(step.params["broadcast_dimensions"]):
        strides[axis] = _row_major(own)[i] if own[i] == shape[axis] else 0
    block.moved(shape, strides, 0, ins[0], to)


def _slice(block: _Block, step: Step, ins: list[_Flat], to: _Flat) -> None:
    of, strides = step.params, _row_major(step.ins[0].shape)
    by = of["strides"] or (1,) * len(strides)
    start = sum(a * s for a, s in zip(of["start_indices"], strides, strict=True))
    block.moved(step.outs[0].shape, [a * s for a, s in zip(by, strides, strict=True)], int(start),
                ins[0], to)  # fmt: skip


def _concatenate(block: _Block, step: Step, ins: list[_Flat], to: _Flat) -> None:
    axis, strides, start = step.params["dimension"], _row_major(step.outs[0].shape), 0
    for x, value in zip(ins, step.ins, strict=True):
        if math.prod(value.shape):
            with block.over(value.shape) as index:
                place = _at(strides, index, start * strides[axis])
                block.line(f"{to[place]} := {x[_at(_row_major(value.shape), index)]};")
        start += value.shape[axis]


def _pad(block: _Block, step: Step, ins: list[_Flat], to: _Flat) -> None:
    shape, own = step.outs[0].shape, step.ins[0].shape
    block.copy(to, _Flat(ins[1]["0"]), math.prod(shape))
    parts, of, start = [], 0, 0
    strides = list(_row_major(shape))
    for axis, (low, _, inner) in enumerate(step.params["padding_config"]):
        inside = [i for i in range(own[axis]) if 0 <= low + (1 + inner) * i < shape[axis]]
        if not inside:
            return
        parts.append(len(inside))
        of += _row_major(own)[axis] * inside[0]
        start += strides[axis] * (low + (1 + inner) * inside[0])
        strides[axis] *= 1 + inner
    with block.over(parts) as index:
        read = ins[0][_at(_row_major(own), index, of)]
        block.line(f"{to[_at(strides, index, start)]} := {read};")


def _iota(block: _Block, step: Step, ins: list[_Flat], to: _Flat) -> None:
    out = step.outs[0]
    with block.over(out.shape) as index:
        place = _at(_row_major(out.shape), index)
        block.line(f"{to[place]} := TO_{type_of(out.dtype)}({index[step.params['dimension']]});")


def _take(block: _Block, step: Step, ins: list[_Flat], to: _Flat) -> None:
    places = block.constant(np.asarray(step.params["table"], np.int32), np.int32)
    with block.loop(math.prod(step.outs[0].shape)) as i:
        block.line(f"{to[i]} := {ins[0][places[i]]};")


def _starts(block: _Block, ins: Sequence[_Flat], whole: Sequence[int],
            part: Sequence[int]) -> list[str]:  # fmt: skip
    names = [block.new("p", "DINT") for _ in ins]
    for name, x, n, size in zip(names, ins, whole, part, strict=True):
        block.line(f"{name} := LAW_PLACE({x['0']}, {n - size});")
    return names


def _dynamic_slice(block: _Block, step: Step, ins: list[_Flat], to: _Flat) -> None:
    whole, part = step.ins[0].shape, step.outs[0].shape
    starts = _starts(block, ins[1:], whole, part)
    with block.over(part) as index:
        places = [_sum(a, b) for a, b in zip(starts, index, strict=True)]
        read = ins[0][_at(_row_major(whole), places)]
        block.line(f"{to[_at(_row_major(part), index)]} := {read};")


def _dynamic_update(block: _Block, step: Step, ins: list[_Flat], to: _Flat) -> None:
    whole, part = step.outs[0].shape, step.ins[1].shape
    block.copy(to, ins[0], math.prod(whole))
    block.put(to, ins[1], whole, part, _starts(block, ins[2:], whole, part))


def _gathered(block: _Block, step: Step, ins: list[_Flat], to: _Flat) -> None:
    shape, axes, out = step.ins[0].shape, step.params["axes"], step.outs[0]
    kept = [i for i in range(len(shape)) if i not in axes]
    first, dtype = operations.FIRST[step.name], np.dtype(out.dtype)
    if dtype.kind in "iu" and not np.isfinite(first):
        info = np.iinfo(dtype.name)
        first = info.min if first < 0 else info.max
    total = block.new("t", type_of(dtype))
    with block.over([shape[i] for i in kept]) as outer:
        block.line(f"{total} := {number(first, dtype)};")
        with block.over([shape[i] for i in axes]) as inner:
            at = dict(zip(kept, outer, strict=True)) | dict(zip(axes, inner, strict=True))
            x = ins[0][_at(_row_major(shape), [at[i] for i in range(len(shape))])]
            how = operations.TOGETHER[step.name]
            block.line(f"{total} := {block.together(how, total, x, dtype)};")
        block.line(f"{to[_at(_row_major(out.shape), outer)]} := {total};")


def _running(block: _Block, step: Step, ins: list[_Flat], to: _Flat) -> None:
    axis, out = step.params["axis"], step.outs[0]
    n, strides = out.shape[axis], _row_major(out.shape)
    others = [size if i != axis else 1 for i, size in enumerate(out.shape)]
    total = block.new("t", type_of(out.dtype))
    back, how = step.params["reverse"], operations.TOGETHER[step.name]
    with block.over(others) as index:
        index[axis] = str(n - 1 if back else 0)
        block.line(f"{total} := {ins[0][_at(strides, index)]};")
        block.line(f"{to[_at(strides, index)]} := {total};")
        if n == 1:
            return
        with block.loop(n - 1, back=back) as i:
            index[axis] = i if back else _sum(i, "1")
            text = block.together(how, total, ins[0][_at(strides, index)], out.dtype)
            block.line(f"{total} := {text};")
            block.line(f"{to[_at(strides, index)]} := {total};")


def _dot(block: _Block, step: Step, ins: list[_Flat], to: _Flat) -> None:
    (of_a, of_b), (batch_a, batch_b) = step.params["dimension_numbers"]
    (a, b), out = (x.shape for x in step.ins), step.outs[0]
    free_a = [i for i in range(len(a)) if i not in (*of_a, *batch_a)]
    free_b = [i for i in range(len(b)) if i not in (*of_b, *batch_b)]
    total = block.new("t", type_of(out.dtype))
    with block.over(out.shape) as index:
        block.line(f"{total} := {number(0, out.dtype)};")
        with block.over([a[i] for i in of_a]) as inner:
            more = len(batch_a) + len(free_a)
            at_a = dict(zip((*batch_a, *free_a, *of_a), (*index[:more], *inner), strict=True))
            at_b = dict(
                zip(
                    (*batch_b, *free_b, *of_b),
                    (*index[: len(batch_b)], *index[more:], *inner),
                    strict=True,
                )
            )
            left, right = (
                x[_at(_row_major(shape), [at[i] for i in range(len(shape))])]
                for x, shape, at in zip(ins, (a, b), (at_a, at_b), strict=True)
            )
            product = f"({block.together('mul', left, right, out.dtype)})"
            block.line(f"{total} := {block.together('add', total, product, out.dtype)};")
        block.line(f"{to[_at(_row_major(out.shape), index)]} := {total};")


WRITTEN: dict[str, Callable[[_Block, Step, list[_Flat], _Flat], None]] = {
    "transpose": _transpose, "rev": _rev, "broadcast_in_dim": _broadcast, "slice": _slice,
    "concatenate": _concatenate, "pad": _pad, "iota": _iota, "take": _take,
    "dynamic_slice": _dynamic_slice, "dynamic_update_slice": _dynamic_update, "dot_general": _dot,
    **dict.fromkeys(operations.FIRST, _gathered),
    **dict.fromkeys(("cumsum", "cumprod", "cummax", "cummin"), _running),
}  # fmt: skip


def _filled(words: Sequence[str]) -> list[str]:
    lines = [""]
    for i, word in enumerate(words):
        if len(lines[-1]) + len(word) > 92:
            lines.append("")
        lines[-1] += f"{' ' if lines[-1] else '        '}{word}{',' if i < len(words) - 1 else ''}"
    return lines


def _row_major(shape: Sequence[int]) -> tuple[int, ...]:
    return tuple(math.prod(shape[i + 1 :]) for i in range(len(shape)))


def _times(stride: int, index: str) -> str:
    return "" if index == "0" or stride == 0 else index if stride == 1 else f"{stride} * {index}"


def _sum(*parts: str) -> str:
    return " + ".join(part for part in parts if part and part != "0") or "0"


def _at(strides: Sequence[int], index: Sequence[str], start: int | str = 0) -> str:
    """The place that indices name: start + strides . index."""
    terms = []
    for stride, i in zip(strides, index, strict=True):
        i = f"({i})" if "+" in i and stride != 1 else i
        terms.append(_times(stride, i))
    return _sum(str(start), *terms).replace("+ -", "- ")


def _open(text: str) -> str:
    """A text without brackets that are around all of it."""
    depth = 0
    for i, letter in enumerate(text):
        depth += {"(": 1, ")": -1}.get(letter, 0)
        if depth == 0:
            return text[1:-1] if letter == ")" and i == len(text) - 1 and i else text
    return text
