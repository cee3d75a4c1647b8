"""A player of function blocks in Structured Text, which are turned into Python line by line.

It knows the part of the language that exported laws are written in: assignments, FOR, IF, EXIT,
functions, and numbers, truth values and arrays of one dimension. It shares no code with
the printer.
"""

import math
import re

import numpy as np

WORDS = {"AND": "and", "OR": "or", "NOT": "not", "XOR": "!=", "TRUE": "True", "FALSE": "False"}
KINDS = {"LREAL": np.float64, "BOOL": bool, "DINT": int, "LINT": int, "UDINT": int}


def _safe(function, at_edges):
    def of(*x):
        try:
            return np.float64(function(*x))
        except (OverflowError, ValueError):
            return np.float64(at_edges(*x))

    return of


LIBRARY = {
    "SEL": lambda which, no, yes: yes if which else no,
    "ABS": abs, "MAX": max, "MIN": min, "SQRT": np.sqrt, "TO_LREAL": np.float64, "TO_DINT": int,
    "TO_LINT": int, "TO_UDINT": int, "TO_BOOL": bool, "LREAL_TO_LINT": lambda x: int(np.rint(x)),
    "EXP": _safe(math.exp, np.exp), "LN": _safe(math.log, np.log), "SIN": _safe(math.sin, np.sin),
    "COS": _safe(math.cos, np.cos), "TAN": _safe(math.tan, np.tan),
    "EXPT": _safe(math.pow, np.float_power), "LREAL": np.float64,
}  # fmt: skip


def _expression(text):
    text = re.sub(r"<>", " != ", text)
    text = re.sub(r"(?<![<>:!])=(?!=)", " == ", text)
    text = re.sub(r"\b(AND|OR|NOT|XOR|TRUE|FALSE)\b", lambda m: WORDS[m[1]], text)
    return re.sub(r"(?<![\w.])(\d+\.\d+(?:E-?\d+)?)", r"LREAL(\1)", text)


def _python(lines):
    out, depth = [], 0
    for text in map(str.strip, lines):
        if loop := re.match(r"FOR (\w+) := (.+) TO (.+?)( BY -1)? DO$", text):
            name, first, last, back = loop.groups()
            by = -1 if back else 1
            out.append("    " * depth + f"for {name} in range({first}, {last} + {by}, {by}):")
            depth += 1
        elif text.startswith("IF "):
            out.append("    " * depth + f"if {_expression(text[3:-5])}:")
            depth += 1
            out.append("    " * depth + "pass")
        elif text.startswith("ELSIF "):
            out.append("    " * (depth - 1) + f"elif {_expression(text[6:-5])}:")
        elif text == "ELSE":
            out.append("    " * (depth - 1) + "else:")
        elif text in ("END_FOR;", "END_FOR", "END_IF", "END_IF;"):
            depth -= 1
        elif text == "EXIT;":
            out.append("    " * depth + "break")
        elif text and not text.startswith("(*"):
            to, value = text.rstrip(";").split(" := ", 1)
            out.append("    " * depth + f"{to} = {_expression(value)}")
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
        self.known = dict(LIBRARY)
        for name, body in re.findall(r"\nFUNCTION (\w+) : \w+\n(.*?)END_FUNCTION\n", text, re.S):
            variables, lines = self._parts(body)
            lines = [re.sub(rf"\b{name}\b(?!\()", "result", line) for line in lines]
            given = [v for v, _, mode in variables if mode == "VAR_INPUT"]
            made = ["result = LREAL(0)", *_python(lines), "return result"]
            code = f"def {name}({', '.join(given)}):\n" + "\n".join("    " + one for one in made)
            exec(code, self.known)
        start, end = text.index("FUNCTION_BLOCK"), text.index("END_FUNCTION_BLOCK")
        variables, lines = self._parts(text[start:end].partition("\n")[2])
        names = [name.lower() for name, _, _ in variables]
        assert len(set(names)) == len(names)  # Structured Text does not know case
        self.known |= {name: value for name, value, _ in variables}
        self.code = compile("\n".join(_python(lines)), "block", "exec")

    @staticmethod
    def _parts(text):
        text = re.sub(r"\(\*.*?\*\)", "", text, flags=re.S)
        variables = []
        for mode, body in re.findall(r"^(VAR\w*(?: CONSTANT)?)\n(.*?)^END_VAR", text, re.S | re.M):
            for one in body.split(";"):
                names, colon, kind = one.partition(" : ")
                kind, _, value = " ".join(kind.split()).partition(" := ")
                if colon:
                    variables += [(name.strip(), _first(kind, value), mode)
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
