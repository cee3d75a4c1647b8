"""A scheme as a table of a plant file, and a plant file with one scheme more."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np

from ..pytree.fields import is_decorated, kind_of
from ..schemes import Scheme
from ..storage.files import atomically
from .from_file import read_scenario


def table_of(name: str, scheme: Scheme) -> str:
    """The lines of `[schemes.NAME]` that describe a scheme, without fields at their default."""
    lines = [f"[schemes.{json.dumps(name)}]", f'class = "{type(scheme).__name__}"']
    lines += [f"{field} = {_value(value)}" for field, value in _fields(scheme)]
    return "\n".join(lines) + "\n"


def write_with_scheme(path: Path, source: str, name: str, scheme: Scheme) -> tuple[Path, bool]:
    """Write a plant file with one scheme more, and say whether a command can take it.

    A TOML file is written as it is with the table of the scheme below. Where the source is none, or
    names files that are not found from the folder of the new file, the table alone is written, to
    be added to a file by hand.
    """
    table = f"\n# Found by `jaxilc filter`.\n{table_of(name, scheme)}"
    before = Path(source).read_text() if Path(source).suffix == ".toml" else ""
    _write(path, before + table)
    if before:
        try:
            read_scenario(path)
            return path, True
        except (ValueError, OSError):
            _write(path, table)
    return path, False


def _write(path: Path, text: str) -> None:
    atomically(path, lambda file: file.write(text.encode()))


def _fields(tree: Any) -> list[tuple[str, Any]]:
    """The fields of an object that differ from their default."""
    found = []
    for field in dataclasses.fields(tree):
        value = getattr(tree, field.name)
        default = field.default
        same = (
            default is not dataclasses.MISSING
            and kind_of(field) != "child"
            and (value is None) == (default is None)
            and np.array_equal(np.asarray(value), np.asarray(default))
        )
        if not same and value is not None:
            found.append((field.name, value))
    return found


def _value(value: Any) -> str:
    """A value as TOML."""
    if is_decorated(type(value)):
        inside = [f'class = "{type(value).__name__}"']
        inside += [f"{name} = {_value(one)}" for name, one in _fields(value)]
        return "{ " + ", ".join(inside) + " }"
    if isinstance(value, str | bool):
        return json.dumps(value)
    return repr(np.asarray(value).tolist())
