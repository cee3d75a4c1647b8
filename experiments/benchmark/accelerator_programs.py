"""The programs that `accelerator.py` checks and times, and the clock for them."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import contests
import jax
import jax.numpy as jnp
import numpy as np
import peers
from accelerator_rows import MEASURED, Row
from jax.sharding import Mesh, NamedSharding, PartitionSpec

import jaxilc
from jaxilc.pytree.named_paths import replaced
from jaxilc.runtime import capacity, lanes

MOVED = {"forward": 1, "gradient": 4}  # times that the bytes of a trial move
LONG = 5.0  # seconds of a run above which the first one is its time
ENOUGH = 0.3  # seconds of runs in all, after which no other is timed
COMPARED = 16  # machines whose results are kept, to be compared between rows


def use(precision: str, unroll: int | None = None) -> None:
    """From now on, compute in this precision, with so many samples in each pass of the loop.

    unroll: None for as many as before
    """
    jax.config.update("jax_enable_x64", precision == "float64")
    if unroll is not None:
        lanes.UNROLL[jax.default_backend()] = unroll
    jax.clear_caches()


def setting(trials: int, samples: int, machines: int):
    """The setting of `make bench` for so many machines, and what is common to them."""
    of = contests.setting("cfdl", machines, trials, samples)
    gains = of.gains.astype(np.asarray(of.machine.plant.b).dtype)
    return of._replace(gains=gains), (of.machine, of.scheme, of.task)


def of_one(what: str, trials: int) -> Callable[[Any, Any], jax.Array]:
    """The function of one machine: its metrics, or its last error with slopes by three weights."""

    def learned(common, b, scheme):
        return jaxilc.learn(replaced(common[0], {"plant.b": b}), scheme, common[2], trials)

    def forward(common, b):
        history = learned(common, b, common[1])
        return jnp.concatenate([getattr(history, name) for name in peers.METRICS], axis=-1)

    def gradient(common, b):
        value, slope = jax.value_and_grad(lambda s: learned(common, b, s).rms[-1, 0])(common[1])
        return jnp.stack([value, slope.lam, slope.rho, slope.eta])

    return {"forward": forward, "gradient": gradient}[what]


def results(what: str, trials: int, samples: int, machines: int) -> np.ndarray:
    """(machines, trials or 1, 4) results in tiles of 16 machines."""
    of, common = setting(trials, samples, machines)
    run = jaxilc.tiled(of_one(what, trials), lanes=16)
    return np.asarray(run(common, of.b)).reshape(machines, -1, 4)


def least_bytes(common) -> int:
    """The bytes that move at least in one trial of one machine; see `accelerator`."""
    machine, scheme, task = common
    key = jax.random.key(0)

    def parts():
        memory = scheme.initial_memory(task)
        trial = jaxilc.run_trial(machine, scheme, task, memory, key)
        return scheme.schedule(memory, task), 2 * [trial.y, trial.u, trial.signals], 2 * [memory]

    return sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(jax.eval_shape(parts)))


def seconds_of(call) -> tuple[float, Any]:
    """The shortest time of several runs after the first one, or of a long first one; the result."""
    times, found = [], None
    while len(times) < 2 or (sum(times[1:]) < ENOUGH and len(times) < 20):
        start = time.perf_counter()
        found = jax.block_until_ready(call())
        times.append(time.perf_counter() - start)
        if times[0] > LONG:
            break
    return min(times[1:] or times), found


def copy_rate(passes: int = 10) -> float:
    """Bytes a second that are read and written by a copy in place, on all devices."""
    free = capacity.device_bytes() or capacity.host_bytes() or 2**32
    size = max(2**18, min(2**28, free // 64)) // jax.device_count() * jax.device_count()
    shared = NamedSharding(Mesh(np.array(jax.devices()), ("x",)), PartitionSpec("x"))
    x = jax.device_put(np.zeros(size, np.float32), shared)
    run = jax.jit(lambda x: jax.lax.fori_loop(0, passes, lambda _, x: x + np.float32(1), x))
    return 2 * x.nbytes * passes / seconds_of(lambda: run(x))[0]


def seconds_a_pass(passes: int = 20_000) -> float:
    """Seconds of one pass of a loop that adds one to 4096 numbers."""
    run = jax.jit(lambda x: jax.lax.fori_loop(0, passes, lambda _, x: x + 1, x))
    x = jnp.zeros(4096)
    return seconds_of(lambda: run(x))[0] / passes


def fitting(row: Row, samples: int) -> int:
    """The lanes that jaxilc takes for a row."""
    of, common = setting(row.trials, samples, row.machines)
    each = of_one(row.what, row.trials)
    return lanes.fitting_lanes(each, common, of.b, row.machines, held=row.machines)


def timed(
    row: Row, samples: int, lanes_taken: int, passes: int, rate: float
) -> tuple[dict[str, Any], np.ndarray | None]:
    """The times of a row and its bytes on one device, and the results of the first machines.

    passes: number of passes of the loop over samples on one device
    rate: bytes a second of a copy
    The results are None where the program does not fit into the memory; then it is not run.
    """
    of, common = setting(row.trials, samples, row.machines)
    run = jax.jit(jaxilc.tiled(of_one(row.what, row.trials), lanes=lanes_taken))
    start = time.perf_counter()
    size = capacity.program_bytes(run.lower(common, of.b), devices=1)
    found = {"bytes": size, "compile_seconds": time.perf_counter() - start}
    room = capacity.device_memory() or (capacity.host_bytes() or 2**62) // jax.device_count()
    if size > room:
        said = f"{capacity.shown(size)} on a device, where {capacity.shown(room)} are available"
        return found | {"status": f"out of memory: {said}"}, None
    b = jnp.asarray(of.b)
    seconds, values = seconds_of(lambda: run(common, b))
    moved = MOVED[row.what] * least_bytes(common) * row.machines * row.trials
    steps = row.machines * row.trials * samples
    times = {
        "status": MEASURED,
        "seconds": seconds,
        "seconds_a_pass": seconds / passes,
        "ns_a_step": 1e9 * seconds / steps,
        "share_of_bandwidth": moved / seconds / rate,
    }
    few = min(COMPARED, row.machines)
    return found | times, np.asarray(values[:few]).reshape(few, -1, 4)
