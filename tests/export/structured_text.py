"""A player of function blocks in Structured Text, which are turned into Python line by line.

It knows the part of the language that exported laws are written in: assignments, FOR, IF, EXIT,
functions, and numbers, truth values, words of bits and arrays of one dimension. Types are those of
IEC 61131-3: an AND of whole numbers, or one that is assigned to a narrower type, fails. It shares
no code with the printer.
"""

import ast
import math
import re
from functools import reduce

import numpy as np

WORDS = {"AND": "and", "OR": "or", "NOT": "not", "XOR": "^", "TRUE": "True", "FALSE": "False",
         "MOD": "%"}  # fmt: skip
KINDS = {"LREAL": np.float64, "BOOL": bool, "DINT": int, "LINT": int, "UDINT": int}
WIDTHS = {"DINT": 32, "LINT": 64, "UDINT": 32, "DWORD": 32, "LWORD": 64}


def _safe(function, at_edges):
    def of(*x):
        try:
            return np.float64(function(*x))
        except (OverflowError, ValueError):
            return np.float64(at_edges(*x))

    return of


def _to(kind, x):
    if kind not in WIDTHS:
        return KINDS[kind](x)
    size = 2 ** WIDTHS[kind]
    x = int(np.rint(x) if isinstance(x, float) else x) % size
    return x - size if kind in ("DINT", "LINT") and 2 * x >= size else x


LIBRARY = {
    "SEL": lambda which, no, yes: yes if which else no, "to": _to,
    "ABS": abs, "MAX": max, "MIN": min, "SQRT": np.sqrt,
    "quotient": lambda a, b: abs(a) // abs(b) * (-1 if (a < 0) != (b < 0) else 1),
    "EXP": _safe(math.exp, np.exp), "LN": _safe(math.log, np.log), "SIN": _safe(math.sin, np.sin),
    "COS": _safe(math.cos, np.cos), "TAN": _safe(math.tan, np.tan),
    "EXPT": _safe(math.pow, np.float_power), "LREAL": np.float64,
}  # fmt: skip


SIGNS = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.Mod: "%", ast.USub: "-",
         ast.And: "&", ast.Or: "|", ast.BitXor: "^", ast.Not: "not ", ast.Eq: "==", ast.NotEq: "!=",
         ast.Lt: "<", ast.Gt: ">", ast.LtE: "<=", ast.GtE: ">="}  # fmt: skip


def _common(one, other):
    """The type of two operands; literals have that of the other one, and DINT widens to LINT."""
    for kind, to in ((one, other), (other, one)):
        if kind == to or (kind, to) in {("real", "LREAL"), ("DINT", "LINT")}:
            return to
        if kind == "whole" and to in ("DINT", "LINT", "UDINT"):
            return to
    raise AssertionError(f"{one} beside {other}")


def _typed(node, kinds):
    """The type of an expression, whole or real for literals, and its text in Python."""
    parts = [x for x in ast.iter_child_nodes(node) if isinstance(x, ast.expr)]
    found = [_typed(x, kinds) for x in (parts[1:] if isinstance(node, ast.Call) else parts)]
    texts = [text for _, text in found]
    if isinstance(node, ast.Constant):
        kind = {bool: "BOOL", int: "whole", float: "real"}[type(node.value)]
        return kind, f"LREAL({node.value!r})" if kind == "real" else repr(node.value)
    if isinstance(node, ast.Name):
        return kinds.get(node.id), node.id
    if isinstance(node, ast.Subscript):
        assert _common(found[1][0], "DINT") == "DINT"
        return found[0][0], f"{texts[0]}[{texts[1]}]"
    if isinstance(node, ast.Call):
        return _called(node.func.id, found, kinds)
    kind = reduce(_common, (kind for kind, _ in found))
    if isinstance(node, ast.Compare):
        return "BOOL", f"({texts[0]} {SIGNS[type(node.ops[0])]} {texts[1]})"
    of_bits = kind in ("BOOL", "DWORD", "LWORD")
    sign = SIGNS[type(node.op)]
    assert of_bits == (sign in ("&", "|", "^", "not ")), (sign, kind)
    if isinstance(node, ast.UnaryOp):
        return kind, f"({sign}{texts[0]})"
    if kind in WIDTHS and sign in ("/", "%"):
        whole = f"quotient({texts[0]}, {texts[1]})"
        return kind, whole if sign == "/" else f"({texts[0]} - {texts[1]} * {whole})"
    return kind, "(" + f" {sign} ".join(texts) + ")"


def _called(name, given, kinds):
    found, text = [kind for kind, _ in given], f"{name}({', '.join(text for _, text in given)})"
    if name in kinds:
        to, wanted = kinds[name]
        assert [*map(_common, found, wanted)] == wanted, (name, found)
        return to, text
    if conversion := re.fullmatch(r"(\w+_)?TO_(\w+)", name):
        of, to = conversion.groups()
        assert of in (None, f"{found[0]}_")
        assert not (to.endswith("WORD") and found[0] == "whole"), "of how many bits?"
        return to, f"to('{to}', {given[0][1]})"
    if name == "SEL":
        assert found.pop(0) == "BOOL"
    kind = reduce(_common, found)
    assert name in ("SEL", "ABS", "MAX", "MIN") or kind in ("LREAL", "real"), (name, found)
    return {"whole": "DINT", "real": "LREAL"}.get(kind, kind), text


def _expression(text, to, kinds):
    """An expression that is given to a type, in Python."""
    text = re.sub(r"(?<![<>:!])=(?!=)", " == ", text.replace("<>", " != "))
    text = re.sub(r"\b(\w+)#(-?\d+)", r"TO_\1(\2)", text)
    text = re.sub(rf"\b({'|'.join(WORDS)})\b", lambda m: WORDS[m[1]], text)
    kind, text = _typed(ast.parse(text, mode="eval").body, kinds)
    assert _common(kind, to) == to, (text, kind, to)
    return text


def _python(lines, kinds):
    out, depth = [], 0
    for text in map(str.strip, lines):
        if loop := re.match(r"FOR (\w+) := (.+) TO (.+?)( BY -1)? DO$", text):
            first, last = (_expression(one, kinds[loop[1]], kinds) for one in loop.group(2, 3))
            by = -1 if loop[4] else 1
            out.append("    " * depth + f"for {loop[1]} in range({first}, {last} + {by}, {by}):")
            depth += 1
        elif text.startswith("IF "):
            out.append("    " * depth + f"if {_expression(text[3:-5], 'BOOL', kinds)}:")
            depth += 1
            out.append("    " * depth + "pass")
        elif text.startswith("ELSIF "):
            out.append("    " * (depth - 1) + f"elif {_expression(text[6:-5], 'BOOL', kinds)}:")
        elif text == "ELSE":
            out.append("    " * (depth - 1) + "else:")
        elif text in ("END_FOR;", "END_IF;"):
            depth -= 1
        elif text == "EXIT;":
            out.append("    " * depth + "break")
        elif text and not text.startswith("(*"):
            to, value = re.fullmatch(r"(.+) := (.+);", text).groups()
            value = _expression(value, _typed(ast.parse(to, mode="eval").body, kinds)[0], kinds)
            out.append("    " * depth + f"{to} = {value}")
    assert depth == 0
    return out


def _first(kind, value):
    """What a variable is at first, by its type and the text after `:=`."""
    array = re.match(r"ARRAY\[0\.\.(\d+)\] OF (\w+)", kind)
    make = KINDS.get(array[2] if array else kind, str)
    if value.startswith("["):
        words = [word.strip() for word in value[1:-1].split(",")]
        return [word == "TRUE" if make is bool else make(word) for word in words]
    if value:
        return value.strip("'")
    return [make(0)] * (int(array[1]) + 1) if array else make(0)


class Block:
    """A function block with the functions behind it."""

    def __init__(self, text):
        self.known, kinds = dict(LIBRARY), {}
        pattern = r"\nFUNCTION (\w+) : (\w+)\n(.*?)END_FUNCTION\n"
        for name, to, body in re.findall(pattern, text, re.S):
            variables, lines = self._parts(body)
            lines = [re.sub(rf"\b{name}\b(?!\()", "result", line) for line in lines]
            given = [v for v, _, mode, _ in variables if mode == "VAR_INPUT"]
            own = kinds | {"result": to} | {v: kind for v, _, _, kind in variables}
            kinds[name] = to, [own[v] for v in given]
            made = ["result = LREAL(0)", *_python(lines, own), "return result"]
            code = f"def {name}({', '.join(given)}):\n" + "\n".join("    " + one for one in made)
            exec(code, self.known)
        start, end = text.index("FUNCTION_BLOCK"), text.index("END_FUNCTION_BLOCK")
        variables, lines = self._parts(text[start:end].partition("\n")[2])
        names = [name.lower() for name, *_ in variables]
        assert len(set(names)) == len(names)  # Structured Text does not know case
        self.known |= {name: value for name, value, _, _ in variables}
        kinds |= {name: kind for name, _, _, kind in variables}
        self.code = compile("\n".join(_python(lines, kinds)), "block", "exec")

    @staticmethod
    def _parts(text):
        text = re.sub(r"\(\*.*?\*\)", "", text, flags=re.S)
        variables = []
        for mode, body in re.findall(r"^(VAR\w*(?: CONSTANT)?)\n(.*?)^END_VAR", text, re.S | re.M):
            for one in body.split(";"):
                names, colon, kind = one.partition(" : ")
                kind, _, value = " ".join(kind.split()).partition(" := ")
                if colon:
                    variables += [(name.strip(), _first(kind, value), mode, kind.split()[-1])
                                  for name in names.split(",")]  # fmt: skip
        rest = re.sub(r"^VAR\w*(?: CONSTANT)?\n.*?^END_VAR", "", text, flags=re.S | re.M)
        return variables, rest.split("\n")

    def call(self, **given):
        self.known |= given
        with np.errstate(all="ignore"):
            exec(self.code, self.known)

    def trial(self, y):
        """The inputs (N, n_u) that answer the outputs (N+1, n_y) of a trial, and its code."""
        rows = []
        for row in y:
            self.call(measured=row[0] if len(row) == 1 else list(row), begin_trial=True)
            rows.append(np.array(self.known["command"], ndmin=1))
        assert not self.known["running"]
        return np.array(rows[:-1]), self.known["code"]
