"""How many machines a device computes together, and how many samples in each pass of a loop.

On a CPU both are constants that were measured, and trials too large for its cache take half as
many machines. An accelerator computes thousands of machines in
the time of a few, since each pass of a loop costs it the launch of its kernels, so it is given as
many machines as its memory holds.

Both numbers change the rounding of results. So neither is timed when a program runs: the lanes
follow from the memory that the device has, not from what is free at the moment, and the samples of
a pass are a table, which `experiments/benchmark/accelerator.py` measures. A run that is resumed on
the same computer then rounds as before. A sweep also stores its lanes, and keeps them when it is
resumed on another one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import partial

import jax
from jax import lax
from jax.ad_checkpoint import checkpoint_name

from ..pytree.aliases import Tree
from ..pytree.ranges import require
from . import capacity

LANES = {"cpu": 16}  # by backend, measured
# Bytes of the cache of a core that a tile should fit into, by backend. Where 16 machines do not fit
# and 8 do, 8 are faster: FFDL-MFAILC of 2000 samples took 1.3 to 1.5 times as long with 16. Where
# neither fits, some schemes are slower with 8; gradients backward are not, they take 0.8 to 0.9 of
# the time. 4 machines are slower than 8 everywhere.
CACHE = {"cpu": 2 * 2**20}
# Samples in each pass of a loop over samples, by backend; 1 where it was not measured. On a CPU
# more are slower. A GPU (NVIDIA H100) launches kernels for each pass, and with 16 learning took 0.1
# to 0.24 of the time. With 64 a thousand machines take a third of that, 32,768 up to 1.3 times as
# long, and programs compile four to eight times as long.
UNROLL = {"cpu": 1, "gpu": 16}
# Backends on which a scan over samples adds them faster than operations on whole arrays do. On the
# same GPU a gradient took 1.3 to 1.6 times as long with such scans.
SCANNED = {"cpu"}
# Bytes of memories of the trials of a machine that a gradient may store, by backend. On a CPU, to
# read so many again took less time than to run their trials again: a gradient took 0.77 to 0.95 of
# the time and compiled in 0.6 to 0.9 of it. With twice as many, FFDL-MFAILC of a few machines took
# 1.3 times as long. An accelerator takes more machines instead.
STORED = {"cpu": 4 * 2**20}
STORED_BESIDES = "stored"
_STORED: ContextVar[int | None] = ContextVar("stored", default=None)
WIDE = 4096  # lanes where a device does not say how much memory it has
SHARE = 0.75  # of the memory of a device that may be planned for a tile
PROBE = 1024  # largest number of machines in the program whose memory is measured


def usual_lanes(of_a_machine: float = 0.0, *, backward: bool = False) -> int | None:
    """The number of machines to vectorise at a time that is best for the backend; starts JAX.

    of_a_machine: bytes that each pass of the loop over trials reads and writes of a machine
    backward: whether derivatives are computed backward, with a slope for each of these numbers
    None for a backend on which it follows from the memory of a device, see `fitting_lanes`.
    """
    backend = jax.default_backend()
    lanes, cache = LANES.get(backend), CACHE.get(backend, math.inf)
    of_a_machine *= 2 if backward else 1
    if lanes is None or lanes * of_a_machine <= cache:
        return lanes
    return lanes // 2 if backward or lanes // 2 * of_a_machine <= cache else lanes


def usual_unroll() -> int:
    """The number of samples in each pass of the loop over samples, for the backend; starts JAX."""
    return UNROLL.get(jax.default_backend(), 1)


def over_samples(
    tick: Callable[[Tree, Tree], tuple[Tree, Tree]],
    start: Tree,
    rows: Tree,
    *,
    length: int | None = None,
    reverse: bool = False,
) -> tuple[Tree, Tree]:
    """`lax.scan` over the samples of a trial, with so many in each pass as suit the backend."""
    return lax.scan(tick, start, rows, length=length, reverse=reverse, unroll=usual_unroll())


def rows_scanned() -> bool:
    """Whether a scan over samples sums them faster than operations on whole arrays; starts JAX."""
    return jax.default_backend() in SCANNED


@contextmanager
def all_stored() -> Generator[None]:
    """A context in which a gradient stores the memories of all trials, however many these are.

    What is traced in it is compiled by `jaxilc.native`.
    """
    token = _STORED.set(2**62)
    try:
        yield
    finally:
        _STORED.reset(token)


def machines_side_by_side() -> bool:
    """Whether what is traced here becomes a program with the machines of a batch side by side."""
    return _STORED.get() is not None


def stored(x: Tree) -> Tree:
    """Arrays that a gradient by a compiled program may store of a trial besides its memories."""
    named = partial(checkpoint_name, name=STORED_BESIDES)
    return jax.tree.map(named, x) if machines_side_by_side() else x


def usual_stored() -> int:
    """The bytes of memories of a machine that a gradient may store, for the backend; starts JAX."""
    stored = _STORED.get()
    return STORED.get(jax.default_backend(), 0) if stored is None else stored


def lanes_for(
    memory: float | None,
    of_a_machine: float,
    machines: int,
    *,
    beside: float = 0.0,
    what: str = "tiled",
) -> int:
    """The number of machines that a device vectorises at a time, which is a power of two.

    It is the largest with lanes x of_a_machine + beside <= SHARE x memory, but no larger than the
    smallest power of two that holds all machines.

    memory: bytes of memory of the device; None if unknown, which allows up to WIDE machines
    of_a_machine: bytes that a machine takes
    beside: bytes that are needed besides, however many machines are vectorised
    Raises ValueError where a single machine does not fit, saying which share of it would.
    """
    require(what, "machines", machines, "[1, inf)", whole=True)
    for name, size in (("memory", memory), ("of_a_machine", of_a_machine), ("beside", beside)):
        require(what, name, size, "[0, inf)", optional=True)
    enough = 1 << int(machines - 1).bit_length()
    if memory is None:
        return min(WIDE, enough)
    room = SHARE * memory - beside
    if room < of_a_machine:
        taken = f"{what}: one machine"
        taken += f" beside {capacity.shown(beside)} of results takes" if beside else " takes"
        share = room / max(of_a_machine, 1)  # of the machine, most of whose memory are its signals
        instead = f"with {math.floor(100 * share)} % of its samples it would fit"
        if share < 0.01:
            instead = "take fewer samples, trials or machines"
        of = f" of the {capacity.shown(memory)} of a device"
        raise capacity.refused(taken, of_a_machine, SHARE * memory, instead, of)
    if not of_a_machine or enough <= room / of_a_machine:
        return enough
    return 1 << (int(room // of_a_machine).bit_length() - 1)


def fitting_lanes(
    fn: Callable[[Tree, Tree], Tree],
    common: Tree,
    batch: Tree,
    machines: int,
    *,
    held: int = 0,
    what: str = "tiled",
) -> int:
    """The lanes for `tiled(fn)`: those usual on the backend, or those that a device can hold.

    The memory of a machine is that of the compiled program of a few machines (at most PROBE), in
    which every array has one row for each machine. The program is compiled and does not run.

    fn, common, batch: as for `tiled` and the function that it returns; of the batch, and of common,
        only shapes and types are read
    held: number of machines whose arguments and results are on the devices at once, besides a tile
    Raises ValueError as `lanes_for` does.
    """
    usual = usual_lanes()
    if usual is not None:
        return usual
    memory, devices = capacity.device_memory(), jax.device_count()
    of_a_device = -(-machines // devices)
    if memory is None:
        return lanes_for(None, 0.0, of_a_device, what=what)
    few = min(PROBE, of_a_device)
    known = jax.eval_shape(lambda *x: x, common, batch)
    rows = jax.tree.map(lambda x: jax.ShapeDtypeStruct((few, *x.shape[1:]), x.dtype), known[1])
    found = jax.jit(jax.vmap(fn, in_axes=(None, 0))).lower(known[0], rows).compile()
    analysis = found.memory_analysis()
    if analysis is None:
        return lanes_for(None, 0.0, of_a_device, what=what)
    signals = (analysis.argument_size_in_bytes + analysis.output_size_in_bytes) / few
    inner = analysis.temp_size_in_bytes / few
    beside = 2 * signals * -(-held // devices)  # the rows of all tiles, and their copy in order
    return lanes_for(memory, signals + inner, of_a_device, beside=beside, what=what)
