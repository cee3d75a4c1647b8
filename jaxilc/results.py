"""Labelled results: a Zarr store filled region by region, opened as an xarray dataset.

A store holds one array per figure, a marker for every chunk that is complete, and the configuration that made it. A chunk is
marked only after all of its arrays are written, so what is marked is there, whenever the process was killed.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from .recipe import describe as describe  # of what a configuration is made

if TYPE_CHECKING:
    import xarray as xr
    import zarr

DONE = "chunk_done"
CONFIGURATION = "configuration"


@dataclasses.dataclass(frozen=True)
class Variable:
    """An array of the dataset: its dimensions and dtype, and what it is."""

    dims: tuple[str, ...]
    dtype: str
    unit: str = ""
    description: str = ""


class Store:
    """A Zarr group of variables over named dimensions, filled in chunks along (scheme, sample). See `create` and `resume`."""

    def __init__(self, group: zarr.Group):
        self.group: Any = group  # what an index finds in it is an array here, never another group

    @classmethod
    def create(
        cls, path: str | Path | None, variables: Mapping[str, Variable], coordinates: Mapping[str, tuple], chunk: int, configuration: dict
    ) -> Store:
        """A new store; path None keeps it in memory.

        coordinates: name -> (dims, values); every dimension has one.  chunk: samples per region
        Raises FileExistsError if something is already there.
        """
        import zarr.storage

        if path is not None and Path(path).exists():
            raise FileExistsError(f"{path} exists already; resume it or choose another place")
        group = zarr.create_group(zarr.storage.MemoryStore() if path is None else str(path))
        sizes = {dims[0]: len(values) for name, (dims, values) in coordinates.items() if dims == (name,)}
        for name, variable in variables.items():
            shape = tuple(sizes[d] for d in variable.dims)
            chunks = tuple(1 if d == "scheme" else min(chunk, n) if d == "sample" else n for d, n in zip(variable.dims, shape, strict=True))
            array = group.create_array(name, shape=shape, chunks=chunks, dtype=variable.dtype, dimension_names=variable.dims)
            array.attrs.update({"units": variable.unit, "description": variable.description})
        for name, (dims, values) in coordinates.items():
            values = np.asarray(values)
            array = group.create_array(
                name, shape=values.shape, dtype=str if values.dtype.kind == "U" else values.dtype, dimension_names=dims
            )
            array[:] = values.astype(object) if values.dtype.kind == "U" else values
        marks = (sizes["scheme"], -(-sizes["sample"] // chunk))
        group.create_array(DONE, shape=marks, chunks=(1, 1), dtype="bool", fill_value=False, dimension_names=("scheme", "chunk"))
        group.attrs[CONFIGURATION] = configuration  # last: a store without it was killed while being laid out
        return cls(group)

    @classmethod
    def resume(cls, path: str | Path, configuration: dict) -> Store:
        """The store at `path`, to go on with. Raises ValueError if it is none, or was made with another configuration."""
        import zarr

        try:
            group = zarr.open_group(str(path), mode="r+")
            found = group.attrs[CONFIGURATION]
        except (FileNotFoundError, KeyError):
            raise ValueError(f"{path} is not a store that can be resumed; remove it and start again") from None
        differing = differences(found, json.loads(json.dumps(configuration)))
        if differing:
            raise ValueError(f"{path} was made with another configuration; it differs in: {'; '.join(differing)}")
        return cls(group)

    def is_done(self, scheme: int, chunk: int) -> bool:
        return bool(self.group[DONE][scheme, chunk])

    def write(self, scheme: int, chunk: int, samples: slice, values: Mapping[str, np.ndarray]) -> None:
        """One finished chunk of one scheme; values have the samples first."""
        for name, value in values.items():
            self.group[name][scheme, samples] = value
        self.group[DONE][scheme, chunk] = True

    def dataset(self) -> xr.Dataset:
        return _as_dataset(self.group.store)


def open_dataset(path: str | Path) -> xr.Dataset:
    """The dataset of a store, complete or not: what no chunk has filled is NaN or 0. Raises FileNotFoundError."""
    if not Path(path).is_dir():
        raise FileNotFoundError(f"{path} is not a dataset of results")
    return _as_dataset(str(path))


def _as_dataset(store) -> xr.Dataset:
    import xarray as xr

    dataset = xr.open_zarr(store, chunks=None, consolidated=False).load().drop_vars(DONE)
    return dataset.set_coords([name for name, array in dataset.data_vars.items() if "units" not in array.attrs])


def differences(found: Any, wanted: Any, path: str = "") -> list[str]:
    """Where two configurations differ, one line each: `seed: 1 there, 2 here`."""
    if isinstance(found, dict) and isinstance(wanted, dict):
        names = sorted(found.keys() | wanted.keys())
        return [line for n in names for line in differences(found.get(n), wanted.get(n), f"{path}.{n}" if path else n)]
    return [] if found == wanted else [f"{path}: {found} there, {wanted} here"]


def environment(*packages: str) -> dict[str, Any]:
    """What the numbers depend on besides the parameters: versions, also of further `packages`, backend, devices, precision."""
    return {
        "versions": {name: version(name) for name in ("jaxilc", "jax", "jaxlib", "numpy", *packages)},
        "backend": jax.default_backend(),
        "devices": jax.device_count(),
        "precision": "float64" if jax.config.jax_enable_x64 else "float32",
    }
