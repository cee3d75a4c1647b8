"""A scheme as a table of a plant file, and a plant file with one scheme more."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit

from ..pytree.fields import kind_of
from ..schemes import Scheme
from ..storage.files import atomically
from .from_file import read_scenario
from .specification import HIDDEN, classes


def table_of(made: Any) -> dict[str, Any]:
    """The table of a scheme, a filter or a model, with the name of its class.

    Fields that have their default value are left out. Raises ValueError for a class that a file
    cannot name.
    """
    cls = type(made)
    if classes().get(cls.__name__) is not cls:
        raise ValueError(f"{cls.__name__} is no class that a plant file can name")
    table: dict[str, Any] = {"class": cls.__name__}
    for field in dataclasses.fields(made):
        value = getattr(made, field.name)
        if field.name in HIDDEN or value is None or _is_default(value, field.default):
            continue
        table[field.name] = _of_part(value) if kind_of(field) == "child" else _plain(value)
    return table


def _of_part(value: Any) -> Any:
    """The table of a part, or those of several."""
    return [table_of(one) for one in value] if isinstance(value, tuple) else table_of(value)


def toml_of(schemes: Mapping[str, Scheme]) -> str:
    """The tables `[schemes.NAME]` as text; parts of a scheme are tables in one line.

    Raises ValueError as `table_of` does.
    """
    document, made = tomlkit.document(), tomlkit.table(is_super_table=True)
    for name, scheme in schemes.items():
        table = tomlkit.table()
        for key, value in table_of(scheme).items():
            table.append(key, _item(value))
        made.append(name, table)
    document.append("schemes", made)
    return tomlkit.dumps(document)


def write_with_scheme(path: Path, source: str, name: str, scheme: Scheme) -> tuple[Path, bool]:
    """Write a plant file with one scheme more, and say whether a command can take it.

    A TOML file is written as it is with the table of the scheme below. Where the source is none, or
    names files that are not found from the folder of the new file, the table alone is written, to
    be added to a file by hand.
    """
    table = f"\n# Found by `jaxilc filter`.\n{toml_of({name: scheme})}"
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


def _item(value: Any) -> Any:
    if isinstance(value, list) and value and isinstance(value[0], Mapping):
        tables = tomlkit.array()
        for one in value:
            tables.append(_item(one))
        return tables
    if not isinstance(value, Mapping):
        return tomlkit.item(value)
    table = tomlkit.inline_table()
    for key, inner in value.items():
        table.append(key, _item(inner))
    return table


def _is_default(value: Any, default: Any) -> bool:
    if default is dataclasses.MISSING or default is None:
        return False
    try:
        return bool(np.shape(value) == np.shape(default) and np.all(np.asarray(value) == default))
    except (TypeError, ValueError):
        return value == default


def _plain(value: Any) -> Any:
    """A number, text or list."""
    if isinstance(value, str | bool | int):
        return value
    return list(value) if isinstance(value, tuple) else np.asarray(value).tolist()
