"""Strict JSON, and JSON and arrays with a checksum of their bytes, so that damage is detected.

JSON has no numbers that are not finite. They are written as the strings "Infinity", "-Infinity" and
"NaN", which `float` understands, and `read_json` returns them as numbers.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import math
from collections.abc import Generator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from .files import write_file
from .reading import LARGEST_TREE, read_bytes, read_text, tree_of

if TYPE_CHECKING:
    from ..pytree.aliases import Leaf, Value

NOT_FINITE = {"Infinity": math.inf, "-Infinity": -math.inf, "NaN": math.nan}
SEAL = "sha256"
LARGEST_ARCHIVE = 2**36  # bytes
LENGTH = 2  # number of bytes for the length of the comment, which is at the end of a zip archive


class Damaged(ValueError):
    """The error for a file whose content is not as it was written."""


def json_text(value: object) -> str:
    """The value as strict JSON with one line for each entry."""
    return json.dumps(_strict(value), indent=1, allow_nan=False) + "\n"


def as_json(value: object) -> Value:
    """The value as it would be read from a file of strict JSON."""
    return json.loads(json_text(value))


def write_json(path: str | Path, value: object) -> None:
    """Write a file of strict JSON completely or not at all."""
    write_file(path, json_text(value))


def read_json(path: str | Path) -> Value:
    """The value in a file of JSON.

    Raises Damaged, naming the file, for a file that is not JSON, and OSError.
    """
    return json_of(path, json_content(path))


def json_content(path: str | Path) -> str:
    """The text of a file of JSON; raises as `read_json`."""
    with _naming(path):
        return read_text(path, LARGEST_TREE)


def json_of(path: str | Path, text: str) -> Value:
    """The value in the text of a file of JSON; raises as `read_json`."""
    with _naming(path):
        return _with_numbers(tree_of(text, json.loads, path))


@contextlib.contextmanager
def _naming(path: str | Path) -> Generator[None]:
    try:
        yield
    except ValueError as error:
        raise Damaged(f"{path} is damaged: {str(error).removeprefix(f'{path}: ')}") from None


def sealed(content: Mapping[str, object]) -> dict[str, Value]:
    """The content as it is in strict JSON, with its checksum."""
    return {**as_json(content), SEAL: seal_of(content)}


def seal_of(content: Mapping[str, object]) -> str:
    """The checksum that `sealed` gives a content."""
    return checksum(json_text(content).encode())


def unsealed(found: Value) -> dict[str, Value]:
    """The content that was given to `sealed`.

    Raises Damaged where the checksum is missing or does not agree with the content.
    """
    seal = found.get(SEAL) if isinstance(found, dict) else None
    content = {name: of for name, of in found.items() if name != SEAL} if seal else {}
    if seal is None:
        raise Damaged("its checksum is missing")
    if seal != seal_of(content):
        raise Damaged("its checksum is that of another content")
    return content


def archive(arrays: Mapping[str, Leaf]) -> bytes:
    """The bytes of a .npz file with its own checksum as the comment of the archive."""
    file = io.BytesIO()
    named: dict[str, Value] = {name: np.asarray(value) for name, value in arrays.items()}
    np.savez(file, **named)
    whole = file.getvalue()
    seal = checksum(whole).encode()
    return whole[:-LENGTH] + _length(seal) + seal


def read_arrays(
    path: str | Path, *, checked: bool = True, sha256: str | None = None
) -> dict[str, np.ndarray]:
    """The arrays of a file that `archive` made.

    checked: whether the file must have a checksum; False also accepts other .npz files
    sha256: of all bytes of the file, where it is known; a file that is whole may be another's
    Raises Damaged, naming the defect, for a file that is damaged, and OSError.
    """
    try:
        found = read_bytes(path, LARGEST_ARCHIVE)
    except ValueError as error:
        raise Damaged(str(error)) from None
    at = max(0, len(found) - len(checksum(b"")) - LENGTH)
    whole, end = found[:at], found[at:]
    seal = checksum(whole + bytes(LENGTH)).encode()
    if checked and end != _length(seal) + seal:
        raise Damaged(f"{path} is damaged: its checksum is missing, or that of another content")
    if sha256 not in (None, checksum(found)):
        raise Damaged(f"{path} is whole, but not the file that was written here")
    try:
        with np.load(io.BytesIO(found), allow_pickle=False) as arrays:
            return dict(arrays)
    except Exception as error:  # NumPy and zipfile raise various errors for a damaged archive
        raise Damaged(f"{path} is damaged: it holds no arrays ({error})") from None


def _strict(value: object) -> object:
    if isinstance(value, Mapping):
        return {str(name): _strict(of) for name, of in value.items()}
    if isinstance(value, list | tuple):
        return [_strict(of) for of in value]
    if isinstance(value, float) and not math.isfinite(value):
        return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"
    return value


def _with_numbers(value: Value) -> Value:
    if isinstance(value, dict):
        return {name: _with_numbers(of) for name, of in value.items()}
    if isinstance(value, list):
        return [_with_numbers(of) for of in value]
    return NOT_FINITE.get(value, value) if isinstance(value, str) else value


def checksum(content: bytes) -> str:
    """The checksum of a content in hexadecimal digits."""
    return hashlib.sha256(content).hexdigest()


def _length(comment: bytes) -> bytes:
    return len(comment).to_bytes(LENGTH, "little")
