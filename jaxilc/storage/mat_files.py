"""Reading .mat files of MATLAB 5 to 7 (-v6, -v7): arrays of real numbers, and structures of text.

A file of a trial needs nothing else. SciPy's reader trusts the sizes that a file declares, and
allocates RAM for them. Here each size is checked against the bytes in the file, and the size of an
unpacked element is limited. So a damaged file raises ValueError and nothing else.

    file:     128 bytes of header, whose last two bytes give the byte order, then elements
    element:  type and size, 4 bytes each, then data, padded to a multiple of 8 bytes; or type and
              size in 2 bytes each, then up to 4 bytes of data
    array:    an element that consists of elements: flags, dimensions, name, then those of its class
"""

from __future__ import annotations

import dataclasses
import math
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import TypeAlias

import numpy as np

from ..pytree.ranges import brief
from .reading import read_bytes

ROOM = 64_000_000  # default of the largest number of bytes of a file, packed or unpacked
HEADER, ARRAY, COMPRESSED = 128, 14, 15
STORED = {
    1: "i1",
    2: "u1",
    3: "i2",
    4: "u2",
    5: "i4",
    6: "u4",
    7: "f4",
    9: "f8",
    12: "i8",
    13: "u8",
}  # types of elements
TEXTS = {1: "utf-8", 2: "utf-8", 4: "utf-16", 16: "utf-8", 17: "utf-16", 18: "utf-32"}
STRUCTURE, TEXT, OBJECT, NUMBERS = 2, 4, 17, range(6, 16)  # classes of arrays
COMPLEX = 0x08  # bit of the flags


@dataclasses.dataclass(frozen=True)
class Other:
    """A value that is no array of real numbers, no text and no structure; `said` describes it."""

    said: str


MatValue: TypeAlias = "np.ndarray | str | dict[str, MatValue] | Other"


def read_mat(path: str | Path, room: int = ROOM) -> dict[str, MatValue]:
    """The variables of a file, by name.

    They are arrays of numbers with two dimensions or more, text, structures as dictionaries, and
    `Other`.

    room: largest number of bytes of the file, and of its unpacked content
    Raises ValueError, naming the file, for a file of another version, a damaged file, and a file
    that needs more than `room` bytes.
    """
    content = read_bytes(path, room)
    mark = content[HEADER - 2 : HEADER]
    if content[:4] == b"\x89HDF" or content[HEADER - 4 : HEADER - 2] in (b"\x00\x02", b"\x02\x00"):
        raise ValueError(
            f"{path} is a MATLAB file of version 7.3; allowed are those saved with -v7"
        )
    if mark not in (b"IM", b"MI"):
        raise ValueError(f"{path} is no MATLAB file of version 5 to 7, as -v6 and -v7 save them")
    order = "<" if mark == b"IM" else ">"
    found, left = dict[str, MatValue](), room
    try:
        for kind, data in _elements(memoryview(content)[HEADER:], order):
            if kind == COMPRESSED:
                unpacked = _unpacked(data, left)
                left -= len(unpacked)
                kind, data = next(_elements(memoryview(unpacked), order), (0, data))
            name, value = _array(data, order) if kind == ARRAY else ("", "")
            if name:  # MATLAB adds an array of its own that has no name
                found[name] = value
    except (ValueError, zlib.error) as error:
        raise ValueError(f"{path} is damaged or no MATLAB file: {error}") from None
    return found


def _unpacked(data: memoryview, room: int) -> bytes:
    unpacking = zlib.decompressobj()
    unpacked = unpacking.decompress(data, room + 1)
    if len(unpacked) > room:
        raise ValueError(f"it unpacks to more than the {room:,} bytes that this trial could need")
    if not unpacking.eof:
        raise ValueError("it ends within what is packed")
    return unpacked


def _elements(data: memoryview, order: str) -> Iterator[tuple[int, memoryview]]:
    """The type and the data of each element."""
    at = 0
    while at < len(data):
        if at + 8 > len(data):
            raise ValueError("it ends within an element's size")
        first, size = (int(x) for x in np.frombuffer(data, order + "u4", 2, at))
        if first >> 16:  # a small element
            kind, size, start, after = first & 0xFFFF, first >> 16, at + 4, at + 8
            if size > 4:
                raise ValueError(f"a small element of {size} bytes")
        else:
            kind, start = first, at + 8
            after = start + size + (0 if kind == COMPRESSED else -size % 8)
        if start + size > len(data):
            raise ValueError(f"an element of {size:,} bytes where {len(data) - start:,} are left")
        yield kind, data[start : start + size]
        at = after


def _array(data: memoryview, order: str, depth: int = 0) -> tuple[str, MatValue]:
    """The name and the value of an array."""
    parts = _elements(data, order)
    flags = int(_need(parts, order, "flags", "iu")[0])
    kind = flags & 0xFF
    dims = [1, 1] if kind == OBJECT else [int(d) for d in _need(parts, order, "dimensions", "iu")]
    if len(dims) < 2 or min(dims) < 0:
        raise ValueError(f"an array of dimensions {brief(dims)}")
    name, size = _need(parts, order, "name", "S").tobytes().decode("latin-1"), math.prod(dims)
    if kind == OBJECT:
        return name, Other(
            "an object, such as text in double quotes; allowed is text in single ones"
        )
    if kind in NUMBERS:
        if flags >> 8 & COMPLEX:
            return name, Other("complex numbers")
        values = _need(parts, order, "numbers", "iuf")
        if len(values) != size:
            raise ValueError(
                f"{brief(name)} has {len(values):,} numbers where {size:,} are declared"
            )
        return name, values.astype(values.dtype.newbyteorder("=")).reshape(dims, order="F")
    if kind == TEXT:
        return name, _text(parts, order, size, name)
    if kind == STRUCTURE and size == 1 and depth < 4:
        return name, _structure(parts, order, depth)
    return name, Other(f"a MATLAB array of class {kind} and dimensions {brief(dims)}")


def _need(parts: Iterator[tuple[int, memoryview]], order: str, what: str, kinds: str) -> np.ndarray:
    """The numbers of the next element.

    parts: the elements that are left
    order: byte order, `<` or `>`
    kinds: allowed types: whole numbers `iu`, floating-point numbers `f`, single bytes `S`
    Raises ValueError if the element is missing, of another type, or of a wrong size.
    """
    kind, data = next(parts, (0, memoryview(b"")))
    dtype = np.dtype(order + STORED.get(kind, "i1"))
    if kind not in STORED or (dtype.itemsize > 1 if kinds == "S" else dtype.kind not in kinds):
        raise ValueError(f"an array without its {what}")
    if len(data) % dtype.itemsize or (what == "flags" and len(data) < dtype.itemsize):
        raise ValueError(f"{len(data)} bytes of {dtype.itemsize} each as {what} of an array")
    return np.frombuffer(data, dtype)


def _text(parts: Iterator[tuple[int, memoryview]], order: str, size: int, name: str) -> str:
    kind, data = next(parts, (2, memoryview(b"")))
    if kind not in TEXTS:
        raise ValueError(f"{brief(name)} is text of an unknown kind, {kind}")
    ending = "" if TEXTS[kind] == "utf-8" else "-le" if order == "<" else "-be"
    return bytes(data).decode(TEXTS[kind] + ending, errors="replace")[:size]


def _structure(
    parts: Iterator[tuple[int, memoryview]], order: str, depth: int
) -> dict[str, MatValue]:
    lengths = _need(parts, order, "length of names", "iu")
    names = _need(parts, order, "names", "S").tobytes()
    length = int(lengths[0]) if len(lengths) else 0
    if length < 1:
        raise ValueError(f"a structure whose names have {length} letters")
    fields = [
        names[i : i + length].split(b"\0")[0].decode("latin-1")
        for i in range(0, len(names), length)
    ]
    found = {}
    for field in fields:
        kind, data = next(parts, (0, memoryview(b"")))
        if kind != ARRAY:
            raise ValueError(f"a structure without its field {brief(field)}")
        found[field] = _array(data, order, depth + 1)[1] if len(data) else Other("nothing")
    return found
