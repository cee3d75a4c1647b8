"""The layout of a store of results: its arrays, and the files that are known before computing."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from ..storage.sealed import as_json, sealed

if TYPE_CHECKING:
    import zarr

DONE = "chunk_done"
METADATA = "zarr.json"
VOUCHING = (METADATA, f"{DONE}/{METADATA}")  # files with the checksums of the others
UNFILLED = {"f": np.nan, "i": -1, "u": 0, "b": False, "U": ""}  # values where nothing was computed


@dataclasses.dataclass(frozen=True)
class Variable:
    """An array of the dataset: its dimensions, dtype, unit and description."""

    dims: tuple[str, ...]
    dtype: str
    unit: str = ""
    description: str = ""


@dataclasses.dataclass(frozen=True)
class Layout:
    """The contents of a store that are known before anything is computed.

    variables: arrays by name
    coordinates: dimensions and values by name; every dimension has one
    chunk: number of machines that are computed and stored together
    configuration: all that determines the numbers, as JSON
    """

    variables: Mapping[str, Variable]
    coordinates: Mapping[str, tuple]
    chunk: int
    configuration: Mapping[str, Any]

    @cached_property
    def sizes(self) -> dict[str, int]:
        """The length of each dimension."""
        return {dims[0]: len(v) for name, (dims, v) in self.coordinates.items() if dims == (name,)}

    @cached_property
    def recipe(self) -> dict[str, Any]:
        """The configuration as it is read back from a file."""
        return as_json(self.configuration)

    def files(self) -> dict[str, Any]:
        """The files of a store in which nothing is computed yet, by name."""
        from zarr import create_group
        from zarr.storage import MemoryStore

        files: dict[str, Any] = {}
        group, sizes = create_group(MemoryStore(files)), self.sizes
        along = sizes | {"scheme": 1, "sample": min(self.chunk, sizes["sample"])}
        for name, of in self.variables.items():
            shape, chunks = (tuple(by[d] for d in of.dims) for by in (sizes, along))
            array = _array(group, name, np.dtype(of.dtype), of.dims, shape, chunks)
            array.attrs.update({"units": of.unit, "description": of.description})
        for name, (dims, values) in self.coordinates.items():
            values = np.asarray(values)
            array = _array(group, name, values.dtype, dims, values.shape, values.shape)
            array[...] = values.astype(object) if values.dtype.kind == "U" else values
        marks = (sizes["scheme"], -(-sizes["sample"] // self.chunk))
        marked = _array(group, DONE, np.dtype("u8"), ("scheme", "chunk"), marks, (1, 1))
        sums = {name: sum_of(f.to_bytes()) for name, f in files.items() if name not in VOUCHING}
        known = {"configuration": self.recipe, "chunk": self.chunk, "checksums": sums}
        for place in (group, marked):  # two copies, since one may be damaged
            place.attrs.update(sealed(known))
        return files


def sum_of(content: bytes) -> str:
    """The checksum of the content of a file."""
    return hashlib.blake2b(content, digest_size=16).hexdigest()


def _array(group: zarr.Group, name: str, dtype: np.dtype, dims, shape, chunks) -> Any:
    from zarr.codecs import Crc32cCodec, ZstdCodec

    return group.create_array(
        name,
        shape=shape,
        chunks=chunks,
        dtype=str if dtype.kind == "U" else dtype,
        fill_value=UNFILLED[dtype.kind],
        compressors=[ZstdCodec(level=0), Crc32cCodec()],
        dimension_names=dims,
    )
