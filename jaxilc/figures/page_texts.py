"""Values and tables as the texts of a page."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from rich.table import Table

NOT_IN_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def text_rows(values: Mapping[str, object]) -> dict[str, str]:
    return {text_of(str(name)): text_of(_value(value)) for name, value in values.items()}


def flat(value: Any, path: str = "") -> list[tuple[str, object]]:
    """Nested settings as pairs of a path and a value."""
    if isinstance(value, Mapping):
        return [
            pair
            for name, of in value.items()
            for pair in flat(of, f"{path}.{name}" if path else str(name))
        ]
    if isinstance(value, list | tuple):
        if all(not isinstance(of, Mapping | list | tuple) for of in value):
            return [(path, ", ".join(_value(of) for of in value))]
        return [pair for i, of in enumerate(value) for pair in flat(of, f"{path}[{i}]")]
    return [(path, value)]


def of_rich(table: Table) -> dict[str, Any]:
    """The caption, the headers, which columns hold numbers, and the rows of a table."""
    rows = zip(*([_plain(cell) for cell in column.cells] for column in table.columns), strict=True)
    return {
        "caption": text_of(_plain(table.title)),
        "headers": [text_of(_plain(c.header)) for c in table.columns],
        "numeric": [c.justify == "right" for c in table.columns],
        "rows": [[text_of(cell) for cell in row] for row in rows],
    }


def of_rows(caption: str, rows: Sequence[Mapping[str, object]]) -> dict[str, Any]:
    names = list(dict.fromkeys(name for row in rows for name in row))
    return {
        "caption": text_of(caption),
        "headers": [text_of(name) for name in names],
        "numeric": [any(_is_number(row.get(name)) for row in rows) for name in names],
        "rows": [[text_of(_value(row.get(name))) for name in names] for row in rows],
    }


def _plain(cell: object) -> str:
    """The text of a cell of a table of `rich`.

    Brackets are units, not markup. Where they are escaped, the backslash is removed.
    """
    return (
        cell.replace("\\[", "[")
        if isinstance(cell, str)
        else getattr(cell, "plain", "" if cell is None else str(cell))
    )


def _value(value: object) -> str:
    if value is None:
        return ""
    return (
        f"{value:.6g}"
        if _is_number(value) and not isinstance(value, int | np.integer)
        else str(value)
    )


def _is_number(value: object) -> bool:
    return isinstance(value, int | float | np.number) and not isinstance(value, bool)


def text_of(text: str) -> str:
    """The text; a character that XML does not allow becomes a replacement character."""
    return NOT_IN_XML.sub("\ufffd", text)
