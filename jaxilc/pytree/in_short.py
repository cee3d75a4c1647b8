"""Objects as a few lines of text, for `print`: a field a line, and long arrays by their shapes."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import jax
import jax.core
import numpy as np

from .aliases import Value
from .ranges import brief

WIDTH, LINES = 100, 20  # of the text of an object, at most
FEW = 6  # numbers of an array that are shown


def in_short(thing: Value) -> str:
    """The text of a dataclass or a named tuple, of at most 20 lines of 100 characters.

    Fields that have their default values are left out of the objects within, and of one that has
    more fields than lines. A class takes it by the line `__repr__ = in_short`,
    a named tuple by a method that returns it.
    """
    name, rows = type(thing).__name__, _fields(thing, all_of_them=True)
    if len(rows) > LINES - 2:
        rows = _fields(thing)
    inline = f"{name}({', '.join(rows)})"
    if len(inline) <= WIDTH:
        return inline
    more = len(rows) - (LINES - 2)
    rows = [row if len(row) < WIDTH - 4 else f"{row[: WIDTH - 9]} ..." for row in rows]
    rows = [*rows[: LINES - 3], f"... {more + 1} more"] if more > 0 else rows
    return "\n".join([f"{name}(", *(f"    {row}," for row in rows), ")"])


def _fields(thing: Value, *, all_of_them: bool = False) -> list[str]:
    """`name=value` of each field; of a dataclass only where it is not the default, if not asked."""
    if not dataclasses.is_dataclass(thing):
        return [f"{name}={_value(of)}" for name, of in zip(thing._fields, thing, strict=True)]
    pairs = [(f, getattr(thing, f.name)) for f in dataclasses.fields(thing)]
    return [f"{f.name}={_value(of)}" for f, of in pairs if all_of_them or not _is_default(of, f)]


def _is_default(value: Value, field: dataclasses.Field[Value]) -> bool:
    made = field.default_factory
    default = field.default if made is dataclasses.MISSING else made()
    if default is dataclasses.MISSING or isinstance(value, jax.core.Tracer):
        return False
    if isinstance(value, np.ndarray | jax.Array):
        return np.array_equal(value, np.asarray(default))
    return type(value) is type(default) and repr(value) == repr(default)


def _value(value: Value) -> str:
    """A value in one line, which may be long."""
    if isinstance(value, jax.Array | np.ndarray | np.generic):
        if isinstance(value, jax.core.Tracer) or value.size > FEW:
            return f"{value.dtype}{list(value.shape)}"
        return " ".join(np.array2string(np.asarray(value), precision=6, separator=", ").split())
    if isinstance(value, type):
        return value.__name__
    if dataclasses.is_dataclass(value) or hasattr(value, "_fields"):
        return f"{type(value).__name__}({', '.join(_fields(value))})"
    if isinstance(value, Mapping) and not hasattr(value, "sizes"):  # a dataset is a mapping, too
        return "{" + ", ".join(f"{name}: {_value(of)}" for name, of in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_value, value[:LINES])) + ", ..." * (len(value) > LINES) + "]"
    return f"{type(value).__name__}{dict(value.sizes)}" if hasattr(value, "sizes") else brief(value)
