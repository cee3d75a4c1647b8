"""Files from outside, read so that none can block the process or fill its RAM.

Only a regular file of a bounded size is read, as text, as a tree (TOML, JSON) or as columns. What
is wrong with it is a ValueError that names the file; a file that is not there, or may not be read,
is an OSError.
"""

from __future__ import annotations

import csv
import io
import json
import math
import os
import re
import stat
import tomllib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

BLOCK = 2**24  # bytes
LARGEST_TREE = 16_000_000  # bytes of a TOML or JSON file
LARGEST_TABLE = 256_000_000  # bytes of a file of columns
DEEPEST = 32  # tables and lists within one another
PARSERS = {".toml": tomllib.loads, ".json": json.loads}
_HEADING = re.compile(r"^([^\[\]]+?)\s*(?:\[([^\[\]]*)\])?$")


def read_bytes(path: str | Path, largest: int) -> bytes:
    """All of a file.

    Raises ValueError for a device, a pipe, a folder, and a file of more bytes than `largest`.
    """
    # without waiting: to open a pipe would wait for whoever writes to it
    descriptor = os.open(
        path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
    )
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise ValueError(
            f"{path} is no file, nor a link to one; allowed is no device, pipe or folder"
        )
    content = bytearray()
    with open(descriptor, "rb") as file:
        # block by block, since a single read would take RAM for all that is allowed
        while block := file.read(BLOCK):
            content += block
            if len(content) > largest:
                raise ValueError(f"{path} has more than the {largest:,} bytes that are allowed")
    return bytes(content)


def read_text(path: str | Path, largest: int) -> str:
    """All of a text file in UTF-8, with or without a byte order mark.

    Raises as `read_bytes`, and ValueError for what is no text.
    """
    try:
        return read_bytes(path, largest).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(
            f"{path} is no text in UTF-8: {error.reason} {error.object[error.start]:#04x} "
            f"at byte {error.start}"
        ) from None


def read_tree(path: str | Path, kind: str | None = None) -> Any:
    """What a TOML or JSON file says. kind: `.toml` or `.json`, None to go by its name

    Raises as `read_text`, and ValueError for a file of another kind, or one nested too deeply.
    """
    parser = PARSERS.get(kind or Path(path).suffix)
    if parser is None:
        raise ValueError(f"{path} is not one of {', '.join(PARSERS)}")
    return tree_of(read_text(path, LARGEST_TREE), parser, path)


def tree_of(text: str, parser: Callable[[str], Any], source: Any) -> Any:
    """What a text in TOML or JSON says.

    source: where it is from, for messages
    Raises ValueError for a text that the parser refuses, or that is nested too deeply.
    """
    try:
        tree = parser(text)
    except RecursionError:
        tree = _too_deep(source)
    except ValueError as error:
        raise ValueError(f"{source}: {error}") from None
    level = [tree]
    for _ in range(DEEPEST):
        level = [
            x
            for of in level
            if isinstance(of, dict | list)
            for x in (of.values() if isinstance(of, dict) else of)
        ]
        if not level:
            return tree
    return _too_deep(source)


def _too_deep(source) -> Any:
    raise ValueError(
        f"{source}: tables or lists are nested too deeply; allowed are {DEEPEST} levels"
    )


def read_columns(path: str | Path) -> tuple[list[str], Iterator[tuple[int, list[str]]]]:
    """The header of a text file of columns, and its rows that are not empty, with line numbers.

    The rows come one after another. Columns are separated by semicolons where the header has one,
    else by tabs where it has one, else by commas.
    Raises as `read_text`, and ValueError, also while rows are taken, for a line that is no row.
    """
    text = read_text(path, LARGEST_TABLE)
    head = text[: text.find("\n") + 1 or len(text)]
    delimiter = next((d for d in ";\t," if d in head), ",")
    file = io.StringIO(text, newline="")

    def rows():
        reader = csv.reader(file, delimiter=delimiter)
        while True:
            try:
                row = next(reader, None)
            except csv.Error as error:
                raise ValueError(f"{path}, line {reader.line_num}: {error}") from None
            if row is None:
                return
            yield reader.line_num, row

    found = rows()
    header = [cell.strip() for cell in next(found, (1, []))[1]]
    return header, ((line, row) for line, row in found if any(cell.strip() for cell in row))


def name_and_unit(heading: str) -> tuple[str, str | None]:
    """The parts of a column's heading: `y [mm]` is y in mm, `y` is y without a declared unit, None.

    The name is empty where the heading is none of these.
    """
    found = _HEADING.match(heading)
    return (found[1], found[2]) if found else ("", None)


def numbers_in(row: list[str], at: Sequence[int]) -> list[float]:
    """The numbers of a row in the columns `at`; NaN for a cell that is missing or no number."""
    return [_number(row[i]) if i < len(row) else math.nan for i in at]


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return math.nan
