"""The execution of a batch in tiles that are spread over the devices."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh, PartitionSpec

from ..pytree.ranges import require
from .lanes import fitting_lanes, usual_lanes

OPEN: Any = None  # default of a field whose value is chosen at construction and is then not None


def tiled(fn: Callable[[Any, Any], Any], *, lanes: int | None = None) -> Callable[[Any, Any], Any]:
    """A compiled `run(common, batch)` that gives fn(common, one) for each `one` of the batch.

    The elements of the batch are along the leading axis of its leaves. The batch is spread over all
    devices, and each device computes one tile after another. A tile of 16 elements keeps a trial in
    the cache of a CPU; a batch that is vectorised as a whole is several times slower there. A batch
    smaller than lanes x devices makes one smaller tile for each device. A tile that is not full is
    filled with copies of the last element, whose results are dropped.
    Keep the returned function: it compiles once for each shape of its arguments.

    fn: function of what is common to all elements, and of one element
    lanes: number of elements of a tile, which are vectorised; None: what suits the backend, which
        is 16 on a CPU, and on an accelerator what its memory holds (see `runtime.lanes`)
    Raises ValueError for lanes < 1. The returned function raises ValueError where the lanes follow
    from the memory of a device, and a single element does not fit.
    """
    lanes = usual_lanes() if lanes is None else lanes
    if lanes is not None:
        require("tiled", "lanes", lanes, "[1, inf)", whole=True)
    mesh = Mesh(np.array(jax.devices()), ("tiles",))
    spread = cache(partial(_spread, fn, mesh))
    chosen: dict[Any, int] = {}

    def lanes_of(common, batch) -> int:
        leaves, structure = jax.tree.flatten((common, batch))
        shapes = (structure, *map(jax.typeof, leaves))
        if shapes not in chosen:
            size = _size(batch)
            chosen[shapes] = fitting_lanes(fn, common, batch, size, held=size)
        return chosen[shapes]

    def run(common, batch):
        size = _size(batch)
        of_tile = lanes_of(common, batch) if lanes is None else lanes
        tile = min(of_tile, -(-size // mesh.size)) * mesh.size
        fill = -size % tile
        full = jax.tree.map(
            lambda x: (
                jnp.concatenate([x, jnp.repeat(jnp.asarray(x)[-1:], fill, axis=0)]) if fill else x
            ),
            batch,
        )
        results = spread(of_tile)(common, full)
        return jax.tree.map(lambda x: x[:size], results) if fill else results

    return run


def _spread(fn, mesh: Mesh, lanes: int):
    """The compiled function of a batch, each device with an equal share, in tiles of `lanes`."""

    def on_device(common, share):
        return lax.map(lambda one: fn(common, one), share, batch_size=min(lanes, _size(share)))

    return jax.jit(
        jax.shard_map(
            on_device,
            mesh=mesh,
            in_specs=(PartitionSpec(), PartitionSpec("tiles")),
            out_specs=PartitionSpec("tiles"),
            check_vma=False,
        )
    )


def _size(batch) -> int:
    return len(jax.tree.leaves(batch)[0])
