"""The execution of a batch in tiles that are spread over the devices."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from functools import cache, lru_cache, partial
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh, PartitionSpec

from ..pytree.aliases import Tree, Value
from ..pytree.ranges import require
from .lanes import fitting_lanes, usual_lanes

T = TypeVar("T")
OPEN: Value = None  # default of a field whose value is chosen at construction and is then not None


def tiled(fn: Callable[[Tree, Tree], T], *, lanes: int | None = None) -> Callable[[Tree, Tree], T]:
    """A compiled `run(common, batch)` that gives fn(common, one) for each `one` of the batch.

    The elements of the batch are along the leading axis of its leaves. The batch is spread over all
    devices, and each device computes one tile after another. A tile of 16 elements keeps a trial in
    the cache of a CPU; a batch that is vectorised as a whole is several times slower there. A batch
    smaller than lanes x devices makes one smaller tile for each device. A tile that is not full is
    filled with copies of the last element, whose results are dropped.
    Keep the returned function: it compiles once for each shape of its arguments.

    lanes: number of elements of a tile, which are vectorised; None: what suits the backend, which
        is 16 on a CPU, and on an accelerator what its memory holds (see `runtime.lanes`)
    Raises ValueError for lanes < 1. The returned function raises ValueError for an empty batch,
    leaves of different lengths, and where the lanes follow from the memory of a device, and a
    single element does not fit.
    """
    lanes = usual_lanes() if lanes is None else lanes
    require("tiled", "lanes", lanes, "[1, inf)", whole=True, optional=True)
    mesh = Mesh(np.array(jax.devices()), ("tiles",))
    filled = cache(partial(_filled, fn, mesh))
    chosen: dict[Hashable, int] = {}

    def lanes_of(common: Tree, batch: Tree) -> int:
        leaves, structure = jax.tree.flatten((common, batch))
        shapes = (structure, *map(jax.typeof, leaves))
        if shapes not in chosen:
            size = _size(batch)
            chosen[shapes] = fitting_lanes(fn, common, batch, size, held=size)
        return chosen[shapes]

    def run(common: Tree, batch: Tree) -> T:
        return filled(lanes_of(common, batch) if lanes is None else lanes)(common, batch)

    return run


@lru_cache(maxsize=64)
def tiled_with(
    fn: Callable[..., T], *, lanes: int | None = None, **options: Value
) -> Callable[[Tree, Tree], T]:
    """`tiled` of `fn` with these options: the same function for the same ones, compiled once."""
    return tiled(partial(fn, **options), lanes=lanes)


def _filled(fn: Callable[[Tree, Tree], T], mesh: Mesh, lanes: int) -> Callable[[Tree, Tree], T]:
    """The compiled function of a batch of any size.

    All of it is one program: the tiles are filled and cut there, since a small batch takes less
    time to compute than to fill from Python.
    """

    def on_device(common: Tree, share: Tree) -> Tree:
        return lax.map(lambda one: fn(common, one), share, batch_size=min(lanes, _size(share)))

    spread = jax.shard_map(
        on_device,
        mesh=mesh,
        in_specs=(PartitionSpec(), PartitionSpec("tiles")),
        out_specs=PartitionSpec("tiles"),
        check_vma=False,
    )

    @jax.jit
    def run(common: Tree, batch: Tree) -> Tree:
        size = _size(batch)
        fill = -size % (min(lanes, -(-size // mesh.size)) * mesh.size)
        if not fill:
            return spread(common, batch)
        copies = jax.tree.map(lambda x: jnp.repeat(x[-1:], fill, axis=0), batch)
        full = jax.tree.map(lambda x, last: jnp.concatenate([x, last]), batch, copies)
        return jax.tree.map(lambda x: x[:size], spread(common, full))

    return run


def _size(batch: Tree) -> int:
    sizes = {np.shape(x)[:1] for x in jax.tree.leaves(batch)}
    if len(sizes) != 1 or sizes <= {(), (0,)}:
        raise ValueError(
            f"tiled: the leaves of the batch have leading axes {sorted(sizes)}; allowed is one "
            "length of all, from 1 on"
        )
    ((size,),) = sizes
    return size
