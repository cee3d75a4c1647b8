"""A law as a function block in Structured Text (IEC 61131-3), for TwinCAT 3 and CODESYS.

The block declares all variables before its code. The functions that Structured Text lacks stand
behind it.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jax.typing import DTypeLike

from ..native.operations import Node, Number
from ..native.program import Unknown
from . import guard
from .c import OF_BITS, field_name
from .law import Law
from .printer import Body, View, closed, filled, opened, wrapped

BYTES = {"LREAL": 8, "LINT": 8, "DINT": 4, "UDINT": 4, "BOOL": 1}
TYPES = {"f": "LREAL", "b": "BOOL", "int32": "DINT", "int64": "LINT", "uint32": "UDINT"}
GIVEN = {"k": "sample", "y": "measured", "u": "command", "code": "code"}
INFIX = {"add": "+", "sub": "-", "mul": "*", "div": "/", "rem": "MOD", "eq": "=", "ne": "<>",
         "lt": "<", "le": "<=", "gt": ">", "ge": ">=", "and": "AND", "or": "OR",
         "xor": "XOR"}  # fmt: skip
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
END_IF;
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
    END_IF;
END_IF;
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
END_IF;
END_FUNCTION

FUNCTION LAW_COPYSIGN : LREAL
VAR_INPUT
    a, b : LREAL;
END_VAR
LAW_COPYSIGN := SEL(b < 0.0 OR b = 0.0 AND 1.0 / b < 0.0, ABS(a), -ABS(a));
END_FUNCTION

(* By EXP(z) - 1 for z = -2 |x|, whose rounding the quotient by LN takes out (W. Kahan). *)
FUNCTION LAW_TANH : LREAL
VAR_INPUT
    x : LREAL;
END_VAR
VAR
    z, power, less : LREAL;
END_VAR
z := -2.0 * ABS(x);
power := EXP(z);
less := z;
IF z < -40.0 THEN
    less := -1.0;
ELSIF power <> 1.0 THEN
    less := (power - 1.0) * (z / LN(power));
END_IF;
LAW_TANH := LAW_COPYSIGN(less / (less + 2.0), x);
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
END_IF;
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
END_IF;
END_FUNCTION
"""


class FunctionBlock(NamedTuple):
    """The text of `law.st`, and the bytes of its variables and tables without what is padded."""

    text: str
    bytes: int


class _Declared:
    """What the functions of a block declare together.

    variables: type and size by name
    constants: type and numbers of the tables by name
    names: those of the fields, which differ by more than case
    """

    def __init__(self, law: Law):
        self.variables: dict[str, tuple[str, int]] = {}
        self.constants: dict[str, tuple[str, Sequence[str]]] = {}
        self.names: dict[str, str] = {}
        for name in law.fields:
            short = re.sub(r"_+", "_", field_name(name))
            taken = {one.lower() for one in self.names.values()}
            while short.lower() in taken:
                short += "x"
            self.names[name] = short
        self.count = itertools.count()
        self.tables: dict[tuple[str, bytes], str] = {}


class _InText(Body):
    index, end = "DINT", "END_FOR;"

    def __init__(self, declared: _Declared, depth: int):
        super().__init__(depth, declared.count, declared.tables)
        self.declared = declared

    def type_of(self, dtype: DTypeLike) -> str:
        dtype = np.dtype(dtype)
        found = TYPES.get(dtype.kind) or TYPES.get(dtype.name)
        if found is None:
            raise Unknown(f"numbers of the type {dtype} in Structured Text")
        return found

    def number(self, value: float | Number, dtype: DTypeLike) -> str:
        kind = np.dtype(dtype).kind
        if kind == "b":
            return "TRUE" if value else "FALSE"
        if kind != "f":
            if value < 0 and value == np.iinfo("int64").min:  # the sign is an operation of its own
                return f"({int(value) + 1} - 1)"
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

    def place(self, name: str, shape: tuple[int, ...]) -> View:
        return View.of(GIVEN.get(name) or self.declared.names[name], shape)

    def room(self, name: str, kind: str, size: int) -> None:
        self.declared.variables[name] = kind, size

    def table(self, kind: str, numbers: Sequence[str]) -> str:
        if not {"nan", "inf", "(-inf)"}.isdisjoint(numbers):
            raise Unknown("a table with numbers that are not finite, in Structured Text")
        name = f"c{len(self.declared.constants)}"
        self.declared.constants[name] = kind, [one.strip("()") for one in numbers]
        return name

    def defined(self, name: str, kind: str, text: str, *, changes: bool = False) -> str:
        self.room(name, kind, 1)
        return self.assigned(name, text)

    def assigned(self, to: str, text: str) -> str:
        return f"{to} := {text};"

    def head(self, name: str, count: int, back: bool) -> str:
        self.room(name, self.index, 1)
        places = f"{count - 1} TO 0 BY -1" if back else f"0 TO {count - 1}"
        return f"FOR {name} := {places} DO"

    def leave_unless(self, text: str) -> list[str]:
        return [f"IF NOT {text} THEN", "    EXIT;", "END_IF;"]

    def clamped(self, place: str, last: int) -> str:
        return f"LAW_PLACE({place}, {last})"

    def of_place(self, kind: str) -> str:
        return f"TO_{kind}({{}})"

    def operation(self, x: Node, args: Sequence[str]) -> str:
        kind, listed = x.args[0].dtype.kind, ", ".join(map(opened, args))
        if x.name == "select":
            return f"SEL({listed})"
        if x.name == "convert":
            to = self.type_of(x.dtype)
            if kind == "f" and to == "UDINT":  # whose conversion rounds
                raise Unknown("a conversion to UDINT in Structured Text")
            way = f"LAW_TO_{to}" if kind == "f" and to in ("DINT", "LINT") else f"TO_{to}"
            return args[0] if to == self.type_of(x.args[0].dtype) else f"{way}({listed})"
        if x.name in OF_BITS and kind != "b":  # operations of words of bits, and not of numbers
            word = "LWORD" if x.dtype.itemsize == 8 else "DWORD"
            of = rf"{self.type_of(x.dtype)}#\1"  # a number without a type may have fewer bits
            typed = (re.sub(r"^\(?(-?\d+)\)?$", of, opened(one)) for one in args)
            words = f" {INFIX[x.name]} ".join(f"TO_{word}({one})" for one in typed)
            return f"TO_{self.type_of(x.dtype)}({words})"
        if x.name in INFIX:
            return f" {INFIX[x.name]} ".join(map(closed, args))
        if x.name == "neg":
            return f"-{closed(args[0])}"
        if x.name in ("max", "min") and kind != "f":
            return f"{x.name.upper()}({listed})"
        if x.name == "round_away" or x.name not in CALLS or kind != "f":
            raise Unknown(f"{x.name} of {x.dtype} in Structured Text")
        return f"{CALLS[x.name]}({listed})"


def function_block(law: Law, about: Sequence[str], digest: str) -> FunctionBlock:
    """A law in Structured Text; raises Unknown for what the language cannot hold."""
    declared, task = _Declared(law), law.task
    parts = begin, sample, end = [_InText(declared, depth) for depth in (1, 2, 2)]
    for part, function in zip(parts, law.functions, strict=True):
        part.function(function)
    read = set(re.findall(r"\w+", "\n".join(line for part in parts for line in part.lines)))
    fields = {name: of for name, of in law.fields.items() if declared.names[name] in read}
    first = _InText(declared, 1)
    first.start(fields)
    kinds = {name: (first.type_of(of.first.dtype), of.first.size) for name, of in fields.items()}
    kept = [
        f"    {declared.names[name]} : {_many(*kinds[name])};"
        + (f"  (* [{_plain(of.unit)}] *)" if of.unit else "")
        for name, of in fields.items()
    ]
    variables = [f"    {name} : {_many(*of)};" for name, of in declared.variables.items()]
    constants = [
        line
        for name, (kind, numbers) in declared.constants.items()
        for line in (f"    {name} : {_many(kind, len(numbers))} := [", *filled(numbers), "    ];")
    ]
    told = [*about, f"certificate {digest}", *(one.format(N=task.N) for one in ABOUT)]
    said = "".join(f"   {line}\n" for line in wrapped(map(_plain, told)))
    codes = "".join(f"   {i} {meaning}\n" for i, meaning in enumerate(guard.MEANINGS))
    of_y, of_u = (_plain(unit) or "1" for unit in (task.unit, task.input_unit))
    join = "\n".join
    text = f"""(*
{said}   The codes of a trial:
{codes}*)
FUNCTION_BLOCK FB_Law
VAR_INPUT
    measured : {_many("LREAL", task.outputs)}; (* measured output [{of_y}] *)
    begin_trial : BOOL; (* a trial begins where none is running *)
END_VAR
VAR_OUTPUT
    command : {_many("LREAL", task.inputs)}; (* input of the plant [{of_u}] *)
    running : BOOL; (* a trial is running *)
    trials : DINT; (* trials that have ended *)
    code : DINT; (* what the last trial ended with *)
END_VAR
VAR
    started : BOOL;
    sample : DINT;
    zero : LREAL;
    inf : LREAL;
    nan : LREAL;
{join(kept)}
{join(variables)}
END_VAR
VAR CONSTANT
    certificate : STRING[80] := '{digest}';
{join(constants)}
END_VAR
IF NOT started THEN
    zero := 0.0;
    inf := 1.0 / zero;
    nan := inf - inf;
{join(first.lines)}
    started := TRUE;
END_IF;
IF begin_trial AND NOT running THEN
{join(begin.lines)}
    sample := 0;
    running := TRUE;
END_IF;
IF running THEN
    IF sample < {task.N} THEN
{join(sample.lines)}
        sample := sample + 1;
    ELSE
{join(end.lines)}
        trials := trials + 1;
        running := FALSE;
{join(f"        command{f'[{i}]' if task.inputs > 1 else ''} := 0.0;" for i in range(task.inputs))}
    END_IF;
END_IF;
END_FUNCTION_BLOCK
{OWN}"""
    sizes = [*declared.variables.values(), *(kinds[name] for name in fields)]
    sizes += [(kind, len(numbers)) for kind, numbers in declared.constants.values()]
    return FunctionBlock(text, sum(BYTES[kind] * size for kind, size in sizes))


ABOUT = (
    "The block is called once in each sample time, for {N} samples and one more in a trial. It "
    "begins a trial when begin_trial is true and none is running, and learns at the last call. "
    "Between trials command is 0.",
    "Numbers are LREAL. Quotients by zero and numbers that are not finite follow IEEE 754, as the "
    "guard needs: the floating-point exceptions of the task must be off.",
)


def _many(kind: str, count: int) -> str:
    return kind if count == 1 else f"ARRAY[0..{count - 1}] OF {kind}"


def _plain(text: str) -> str:
    """A text that neither ends a comment nor begins another."""
    return text.replace("*)", "* )").replace("(*", "( *")
