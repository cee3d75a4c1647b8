"""Labelled results: a Zarr store that is filled chunk by chunk, and opened as an xarray dataset.

A store holds one array for each variable, the coordinates, the configuration that made it, and a
mark for every complete chunk: a checksum of the chunk's numbers, its place and the configuration. A
chunk is marked when all of its arrays are on the disk. When a store is resumed or opened, its
numbers are read and compared with their marks, so that missing, truncated or altered data are
found. The bytes of each file also have a checksum (crc32c), for programs that do not know the
marks.
"""

from __future__ import annotations

import dataclasses
import hashlib
import logging
import math
import os
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from ..pytree.aliases import Value
from ..runtime.provenance import need_described, need_same
from ..storage.files import need_free, only_one, remove_leftovers, whole_folder
from ..storage.sealed import Damaged, as_json, json_text, read_json, sealed, unsealed
from .grid import unfolded

if TYPE_CHECKING:
    import xarray as xr
    import zarr
    from zarr.abc.store import Store as ZarrStore
    from zarr.core.buffer import Buffer

log = logging.getLogger("jaxilc")

DONE = "chunk_done"
METADATA = "zarr.json"
VOUCHING = (METADATA, f"{DONE}/{METADATA}")  # files with the checksums of the others
LONGEST_TEXT = 10_000  # bytes of a name, such as that of a scheme
# Values where nothing was computed.
UNFILLED: dict[str, float | str] = {"f": np.nan, "i": -1, "u": 0, "b": False, "U": ""}
Coordinate: TypeAlias = tuple[tuple[str, ...], np.ndarray]  # dimensions and values


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

    coordinates: dimensions and values by name; every dimension has one
    chunk: number of machines that are computed and stored together
    configuration: all that determines the numbers, as JSON
    """

    variables: Mapping[str, Variable]
    coordinates: Mapping[str, Coordinate]
    chunk: int
    configuration: Mapping[str, object]

    @cached_property
    def sizes(self) -> dict[str, int]:
        """The length of each dimension."""
        return {dims[0]: len(v) for name, (dims, v) in self.coordinates.items() if dims == (name,)}

    @cached_property
    def recipe(self) -> dict[str, Value]:
        """The configuration as it is read back from a file."""
        return as_json(self.configuration)

    def files(self) -> dict[str, Buffer]:
        """The files of a store in which nothing is computed yet, by name."""
        from zarr import create_group
        from zarr.storage import MemoryStore

        files: dict[str, Buffer] = {}
        group, sizes = create_group(MemoryStore(files)), self.sizes
        along = sizes | {"scheme": 1, "sample": min(self.chunk, sizes["sample"])}
        for name, of in self.variables.items():
            shape, chunks = (tuple(by[d] for d in of.dims) for by in (sizes, along))
            array = _array(group, name, np.dtype(of.dtype), of.dims, shape, chunks)
            array.attrs.update({"units": of.unit, "description": of.description})
        for name, (dims, values) in self.coordinates.items():
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


def _array(
    group: zarr.Group,
    name: str,
    dtype: np.dtype,
    dims: tuple[str, ...],
    shape: tuple[int, ...],
    chunks: tuple[int, ...],
) -> zarr.Array[Value]:
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


class Store:
    """A Zarr store of a layout, filled in chunks along (scheme, sample).

    It is made by `create` or `resume`. While it is open, no other process can resume it.
    """

    def __init__(
        self, store: ZarrStore, layout: Layout, closing: ExitStack, path: Path | None = None
    ):
        import zarr

        self.path = path  # None where it is in the RAM
        self.layout, self._store, self._closing = layout, store, closing
        self._known: dict[str, np.ndarray] = {}  # all values that were written or read so far
        with zarr.config.set({"array.write_empty_chunks": True}):  # NaN may be a computed value
            group = zarr.open_group(store, mode="r+")
            self._arrays: dict[str, Value] = {n: group[n] for n in (*layout.variables, DONE)}

    @classmethod
    def create(cls, path: str | Path | None, layout: Layout) -> Store:
        """A new store at `path`; None keeps it in the RAM.

        Raises FileExistsError if something is already there, and ValueError for a configuration
        that does not tell all.
        """
        if path is None:
            from zarr.storage import MemoryStore

            return cls(MemoryStore(layout.files()), layout, ExitStack())
        need_free(path)
        need_described(layout.recipe)
        from ..storage.durable import DurableStore

        with whole_folder(path) as unfinished:
            for name, content in layout.files().items():
                (unfinished / name).parent.mkdir(parents=True, exist_ok=True)
                (unfinished / name).write_bytes(content.to_bytes())
        with ExitStack() as closing:
            closing.enter_context(only_one(path))
            return cls(DurableStore(Path(path)), layout, closing.pop_all(), Path(path))

    @classmethod
    def resume(cls, path: str | Path, layout: Layout) -> Store:
        """The store at `path`, to continue it.

        Files that are known before computing are repaired. A store that has earlier names in its
        configuration keeps them (see `earlier_names`).

        Raises ValueError if it is no store, was made with another configuration, or is in use.
        """
        from ..storage.durable import DurableStore, write_below

        path = Path(path)
        with ExitStack() as closing:
            closing.enter_context(only_one(path))
            found = stored_configuration(path)
            need_same(path, found, layout.recipe)
            layout = dataclasses.replace(layout, configuration=found)  # marks depend on it
            remove_leftovers(path)
            for file, why in _harmful(path):
                log.warning("%s; it is removed, and computed again", why)
                file.unlink()
            for name, content in layout.files().items():
                file, wanted = path / name, content.to_bytes()
                if not file.is_file() or file.read_bytes() != wanted:
                    log.warning("%s was missing or damaged, and is written again", file)
                    write_below(path, name, wanted)
            return cls(DurableStore(path), layout, closing.pop_all(), path)

    def __enter__(self) -> Store:
        return self

    def __exit__(self, *_: object) -> None:
        self._closing.close()

    def is_done(self, scheme: int, chunk: int) -> bool:
        """Whether a chunk is stored undamaged; its values are read and compared with its mark."""
        try:
            mark = int(self._arrays[DONE][scheme, chunk])
            if not mark:
                return False
            machines = _machines(chunk, self.layout.chunk, self.layout.sizes["sample"])
            values = {n: self._arrays[n][scheme, machines] for n in self.layout.variables}
            if _is_mark(mark, self.layout.recipe, values, (scheme, chunk)):
                self._keep(scheme, machines, values)
                return True
            wrong = "its values are not those that were marked"
        except Exception as error:  # any error of a codec on damaged bytes
            wrong = str(error)
        log.warning("chunk %d of scheme %d is damaged and computed again: %s", chunk, scheme, wrong)
        return False

    def write(
        self, scheme: int, chunk: int, machines: slice, values: Mapping[str, np.ndarray]
    ) -> None:
        """Store and mark one finished chunk of one scheme.

        values: arrays by name; the first axis is that of the machines
        Raises FileNotFoundError where the folder was removed since it was opened.
        """
        self._need_folder()
        values = {n: np.asarray(value, self._arrays[n].dtype) for n, value in values.items()}
        for name, value in values.items():
            self._arrays[name][scheme, machines] = value
        self._arrays[DONE][scheme, chunk] = _mark(self.layout.recipe, values, (scheme, chunk))
        self._keep(scheme, machines, values)

    def dataset(self) -> xr.Dataset:
        """The dataset with every chunk that this store wrote, or found undamaged.

        Raises FileNotFoundError where the folder was removed, and ValueError where it was damaged.
        """
        self._need_folder()
        try:
            found = _opened(self._store)
            known = {n: (found[n].dims, of, found[n].attrs) for n, of in self._known.items()}
            return _labelled(found.assign(known).load(), self.layout.recipe)
        except (KeyError, OSError, ValueError) as error:
            raise Damaged(_damaged(self.path, error)) from None

    def _need_folder(self) -> None:
        if self.path is not None and not (self.path / METADATA).is_file():
            said = "was removed while the sweep was running; run it again"
            raise FileNotFoundError(f"{self.path} {said}")

    def _keep(self, scheme: int, machines: slice, values: Mapping[str, np.ndarray]) -> None:
        # The files need not be read again for the dataset.
        for name, value in values.items():
            if name not in self._known:
                of = self._arrays[name]
                self._known[name] = np.full(of.shape, of.fill_value, of.dtype)
            self._known[name][scheme, machines] = value


def open_dataset(path: str | Path) -> xr.Dataset:
    """The dataset of a store, complete or not.

    Values that were not computed, or not stored whole, are NaN, -1 or False.

    Raises FileNotFoundError where there is none, and ValueError naming what is damaged.
    """
    path = Path(path)
    if not ((path / METADATA).exists() or (path / DONE / METADATA).exists()):
        raise FileNotFoundError(
            f"{path} is not a dataset of results; in the folder of a command it is dataset.zarr"
        )
    try:
        for _, why in _harmful(path):
            raise Damaged(why)
        known = unsealed(read_json(path / METADATA)["attributes"])
        for name, checksum in known["checksums"].items():
            if sum_of((path / name).read_bytes()) != checksum:
                raise Damaged(f"{name} is not as it was written")
        dataset = _opened(path)
        dataset[DONE].load()  # before the numbers, since a sweep may be writing these
        _keep_marked(dataset.load(), known["configuration"], known["chunk"])
    except Exception as error:  # any error of a codec on damaged bytes
        raise Damaged(_damaged(path, error)) from None
    return _labelled(dataset, known["configuration"])


def _harmful(path: Path) -> Iterator[tuple[Path, str]]:
    """The pipes and devices in a store, and the chunks that would unpack to too much, with why."""
    for folder, _, names in os.walk(path):
        for file in (Path(folder, name) for name in names):
            if file.exists() and not file.is_file():
                yield file, f"{file} is no file"
    for file in path.glob(f"*/{METADATA}"):
        try:
            array = read_json(file)
            kind, grid = array["data_type"], array["chunk_grid"]["configuration"]
            of_each = LONGEST_TEXT if kind == "string" else np.dtype(kind).itemsize
            largest = of_each * math.prod(grid["chunk_shape"])
        except (OSError, ValueError, TypeError, KeyError):
            continue  # a damaged description is told, or mended, later
        for chunk in filter(Path.is_file, file.parent.glob("c/**/[0-9]*")):
            with open(chunk, "rb") as opened:
                size = _unpacked_size(opened.read(18))
            if size > largest:
                yield chunk, f"{chunk} would unpack to {size:,} bytes; a chunk has {largest:,}"


def _unpacked_size(head: bytes) -> float:
    """The size that a frame of Zstandard declares (RFC 8878, 3.1.1.1); infinite without one."""
    if head[:4] != b"\x28\xb5\x2f\xfd" or len(head) < 6:
        return 0  # its codec refuses it
    single, flag = head[4] >> 5 & 1, head[4] >> 6
    length = (single, 2, 4, 8)[flag]
    at = 6 - single + (0, 1, 2, 4)[head[4] & 3]
    size = int.from_bytes(head[at : at + length], "little") + 256 * (flag == 1)
    return size if length else math.inf


def stored_configuration(path: Path) -> dict[str, Value]:
    """The configuration of a store, from the first undamaged one of its two copies.

    Raises ValueError where both are damaged.
    """
    for name in VOUCHING:
        try:
            return as_json(unsealed(read_json(path / name)["attributes"])["configuration"])
        except (OSError, ValueError, KeyError, TypeError):
            continue
    said = f"{path} is not a store that can be resumed"
    raise ValueError(f"{said}; choose another folder, or remove it")


def _opened(store: Path | ZarrStore) -> xr.Dataset:
    """The dataset of a store; a unit such as `days since` is one of an output, and no date's.

    The variables are sorted by name: a file system lists them in any order.
    """
    import xarray as xr

    found = xr.open_zarr(store, chunks=None, consolidated=False, decode_times=False)
    return found[sorted(map(str, found.variables))]


def _keep_marked(dataset: xr.Dataset, recipe: Mapping[str, Value], chunk: int) -> None:
    """Remove what was stored of chunks without a mark: a part of them, where a sweep was stopped.

    Raises Damaged for a chunk that does not agree with its mark.
    """
    variables = [name for name, array in dataset.data_vars.items() if "units" in array.attrs]
    for (scheme, number), mark in np.ndenumerate(dataset[DONE].values):
        machines = _machines(number, chunk, dataset.sizes["sample"])
        found = {str(name): dataset[name].values[scheme, machines] for name in variables}
        if not mark:
            for values in found.values():
                values[...] = UNFILLED[values.dtype.kind]
        elif not _is_mark(mark, recipe, found, (scheme, number)):
            name = dataset["scheme"].values[scheme]
            raise Damaged(f"chunk {number} of scheme {name!r} is not as it was marked")


def _damaged(path: Path | None, error: Exception) -> str:
    return f"{path} is damaged: {error}; resuming the sweep mends it"


def _machines(chunk: int, size: int, machines: int) -> slice:
    """The machines of a chunk."""
    return slice(chunk * size, min((chunk + 1) * size, machines))


def _is_mark(
    mark: int, recipe: Mapping[str, Value], values: Mapping[str, np.ndarray], place: tuple[int, int]
) -> bool:
    """Whether a mark is that of a chunk at its place; marks of before did not hold the place."""
    return any(int(mark) == _mark(recipe, values, of) for of in (place, ()))


def _mark(
    recipe: Mapping[str, Value], values: Mapping[str, np.ndarray], place: tuple[int, ...]
) -> int:
    """A checksum of a chunk's values, of its scheme and number, and of the configuration.

    It is never 0, which means no mark.
    """
    found = hashlib.blake2b(json_text(recipe).encode(), digest_size=8)
    found.update(np.asarray(place, "<i8").tobytes())
    for name in sorted(values):
        found.update(name.encode() + values[name].tobytes())
    return int.from_bytes(found.digest(), "little") or 1


def _labelled(dataset: xr.Dataset, recipe: Mapping[str, Value]) -> xr.Dataset:
    """The dataset without the marks of the store, with its coordinates, and the axes of a grid."""
    dataset = dataset.drop_vars(DONE)
    dataset.attrs = {"configuration": dict(recipe)}
    known = [name for name, array in dataset.data_vars.items() if "units" not in array.attrs]
    dataset = dataset.set_coords(known)
    return unfolded(dataset, recipe["grid"]) if "grid" in recipe else dataset
