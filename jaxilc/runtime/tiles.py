"""The execution of a batch in tiles that are spread over the devices."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh, PartitionSpec

from ..pytree.ranges import require

LANES = {"cpu": 16}  # measured; a trial of 16 plants fits into the cache of a core
WIDE = 4096  # for other backends, which were not measured
OPEN: Any = None  # default of a field whose value is chosen at construction and is then not None


def usual_lanes() -> int:
    """The number of machines to vectorise at a time that is best for the backend; starts JAX."""
    return LANES.get(jax.default_backend(), WIDE)


def tiled(fn: Callable[[Any, Any], Any], *, lanes: int | None = None) -> Callable[[Any, Any], Any]:
    """A compiled `run(common, batch)` that gives fn(common, one) for each `one` of the batch.

    The elements of the batch are along the leading axis of its leaves. The batch is spread over all
    devices, and each device computes one tile after another. A tile of 16 elements keeps a trial in
    the cache of a CPU; a batch that is vectorised as a whole is several times slower there. A batch
    smaller than lanes x devices makes one smaller tile for each device. A tile that is not full is
    filled with copies of the last element, whose results are dropped.
    Keep the returned function: it compiles once for each shape of its arguments.

    fn: function of what is common to all elements, and of one element
    lanes: number of elements of a tile, which are vectorised; None: `usual_lanes`
    Raises ValueError for lanes < 1.
    """
    lanes = usual_lanes() if lanes is None else lanes
    require("tiled", "lanes", lanes, "[1, inf)", whole=True)
    mesh = Mesh(np.array(jax.devices()), ("tiles",))

    def on_device(common, share):
        return lax.map(lambda one: fn(common, one), share, batch_size=min(lanes, _size(share)))

    spread = jax.jit(
        jax.shard_map(
            on_device,
            mesh=mesh,
            in_specs=(PartitionSpec(), PartitionSpec("tiles")),
            out_specs=PartitionSpec("tiles"),
            check_vma=False,
        )
    )

    def run(common, batch):
        size = _size(batch)
        tile = min(lanes, -(-size // mesh.size)) * mesh.size
        fill = -size % tile
        full = jax.tree.map(
            lambda x: (
                jnp.concatenate([x, jnp.repeat(jnp.asarray(x)[-1:], fill, axis=0)]) if fill else x
            ),
            batch,
        )
        results = spread(common, full)
        return jax.tree.map(lambda x: x[:size], results) if fill else results

    return run


def _size(batch) -> int:
    return len(jax.tree.leaves(batch)[0])
