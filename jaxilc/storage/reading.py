"""Safe reading of files from outside, which cannot block the process or fill its RAM.

Only regular files of a limited size are read: as bytes, as text, or as a tree (TOML, JSON);
`columns` reads tables. An error in the content raises ValueError, which names the file. A file that
does not exist, or may not be read, raises OSError. Messages quote only files whose names, links
followed, end as files of data do: a plant file may name any other, with secrets in it. What is
shown of any file has no control characters (`printable`).
"""

from __future__ import annotations

import json
import os
import re
import stat
import tomllib
import unicodedata
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

if TYPE_CHECKING:
    from ..pytree.aliases import Value

BLOCK = 2**24  # bytes
LARGEST_TREE = 16_000_000  # bytes of a TOML or JSON file
LARGEST_TABLE = 256_000_000  # bytes of a file of columns
DEEPEST = 32  # largest number of levels of nested tables and lists
QUOTED = (
    *(".toml", ".json", ".csv", ".tsv", ".txt", ".dat", ".data", ".asc", ".prn", ".tab", ".log"),
    *(".trc", ".lvm", ".mat", ".npz", ".nc", ".ngc", ".cnc", ".gcode", ".tap", ".mpf"),
)
_PLACE = re.compile(r"\(?(?:at )?line (\d+),? column (\d+)")  # in messages of the parsers
_COMMA = re.compile(r"(?<=[=:\s])[+-]?\d+,\d+(?:[eE][+-]?\d+)?(?=\s*(?:[,}#]|$))")
_KEYS = re.compile(r"[=,{}\[\]#\n]")  # what stands between keys, and between numbers
PARSERS: dict[str, Callable[[str], Value]] = {
    ".toml": tomllib.loads,
    ".json": lambda text: json.loads(text, object_pairs_hook=_table),
}


def read_bytes(path: str | Path, largest: int) -> bytes:
    """The whole content of a file.

    Raises ValueError for a device, a pipe, a folder, and a file of more bytes than `largest`.
    """
    # non-blocking: otherwise, to open a pipe would wait for a process that writes to it
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
        # block by block, since a single read would allocate RAM for the largest allowed size
        while block := file.read(BLOCK):
            content += block
            if len(content) > largest:
                raise ValueError(f"{path} has more than the {largest:,} bytes that are allowed")
    return bytes(content)


def read_text(path: str | Path, largest: int) -> str:
    """The whole text of a file in UTF-8, with or without a byte order mark.

    Raises as `read_bytes`, and ValueError for a file that is not text.
    """
    found = read_bytes(path, largest)
    if found.startswith(b"\x93NUMPY"):
        raise ValueError(
            f"{path} is an array of NumPy, whose columns have no names; allowed is text, or, where "
            "a command reads them, .npz: np.savez('record.npz', t=t, u=u, y=y)"
        )
    try:
        return found.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(
            f"{path} is no text in UTF-8: {error.reason} {error.object[error.start]:#04x} "
            f"at byte {error.start}; save it as UTF-8, from a spreadsheet as `CSV UTF-8`"
        ) from None


def quoted(path: str | Path, text: str) -> str:
    """A text of a file for a message; where the file may not be quoted, that it may not."""
    if Path(os.path.realpath(path)).suffix.lower() in QUOTED:
        return text
    return "(not shown, since the file's name has no ending such as .csv or .txt)"


def printable(text: str) -> str:
    """The text with Python's escapes for characters that cannot be printed, except line ends.

    So it has no control characters, such as colour codes.
    """
    return "".join(
        c
        if c == "\n" or c.isprintable() or unicodedata.category(c) == "Zs"
        else c.encode("unicode_escape").decode()
        for c in text
    )


def read_tree(path: str | Path, kind: str | None = None) -> Value:
    """The content of a TOML or JSON file as dictionaries, lists and values.

    kind: `.toml` or `.json`; None: the suffix of the file
    Raises as `read_text`, and ValueError for a file of another kind, or one nested too deeply.
    """
    parser = PARSERS.get(kind or Path(path).suffix)
    if parser is None:
        raise ValueError(f"{path} is not one of {', '.join(PARSERS)}")
    return tree_of(read_text(path, LARGEST_TREE), parser, path)


def tree_of(text: str, parser: Callable[[str], Value], source: str | Path) -> Value:
    """The content of a text in TOML or JSON as dictionaries, lists and values.

    Raises ValueError for a text that the parser refuses, or that is nested too deeply.
    """
    # A parser of TOML takes the square of the length of a dotted key, in time and in RAM.
    if parser is tomllib.loads and any(key.count(".") > DEEPEST for key in _KEYS.split(text)):
        _too_deep(source)
    try:
        tree = parser(text)
    except RecursionError:
        _too_deep(source)
    except ValueError as error:
        raise ValueError(f"{source}{_place(source, text, error)}") from None
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
    _too_deep(source)


def _table(pairs: list[tuple[str, Value]]) -> dict[str, Value]:
    """A table of a JSON file; raises ValueError for a key that is given twice, as in TOML."""
    names = [name for name, _ in pairs]
    if len({*names}) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"the key {twice[:50]!r} is given a second time; allowed is once")
    return dict(pairs)


def _place(source: str | Path, text: str, error: ValueError) -> str:
    """Where a text is not as its parser needs it, what stands there, and what is allowed."""
    from ..pytree.ranges import brief  # NumPy, which the completion of a shell does not wait for

    found = _PLACE.search(str(error))
    if not found:
        return f": {error}"
    line, column = int(found[1]), int(found[2])
    there = text.split("\n")[line - 1].strip()
    wanted = str(error)[: found.start()].rstrip(" :")
    if comma := _COMMA.search(there):
        wanted = f"a number has a decimal point, {comma[0].replace(',', '.')}"
    wanted = f"{wanted[:1].lower()}{wanted[1:]}"
    return f": line {line}, column {column}: found {quoted(source, brief(there))}; {wanted}"


def _too_deep(source: str | Path) -> NoReturn:
    raise ValueError(
        f"{source}: tables or lists are nested too deeply; allowed are {DEEPEST} levels"
    )
