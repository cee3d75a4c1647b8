"""A sweep over many hosts: workers of a Dask cluster compute its chunks, the calling process alone
writes them.

Whatever runs Dask will do: SLURM, Kubernetes, SSH, two shells. The scheduler and all workers need
this package and the modules of the user's own classes; no files are shared. A chunk whose worker
dies is computed again by another one.

Sums in another order round otherwise, so the workers must be alike: the same versions, backend,
number of devices. With that, and processors of one kind, the dataset is the one that such a host
makes alone, bit for bit.
"""

from __future__ import annotations

import asyncio
import dataclasses
import json
import pickle
import re
import socket
import threading
import uuid
from collections import Counter
from collections.abc import Generator, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax

from ..runtime import capacity
from ..runtime.provenance import differences, environment
from ..runtime.start import setup
from ..storage.reading import read_tree

if TYPE_CHECKING:
    from distributed import Client, Future

    from .sweep import Chunk, Host, Sweep

PATIENCE = 30.0  # seconds until a scheduler must have answered
# seconds until a first worker must have joined: on many nodes at once, Python starts slowly
ARRIVAL = 120.0
AHEAD = 2  # chunks given to each worker: one to compute and one to go on with
LARGE = "1GB"  # of a sweep's drawn numbers, before Dask warns; it does at 10 MB

_ONE_AT_A_TIME = threading.Lock()


class ChunkFailed(RuntimeError):
    """A chunk that no worker could compute. What was finished before is in the store."""


class UnlikeWorkers(ValueError):
    """Workers that would round differently."""


@contextmanager
def workers(sweep: Sweep, cluster: str | Path | Client) -> Generator[Workers]:
    """The workers of a Dask cluster, ready for a sweep, as `Sweep.run` uses them; its tasks are
    cancelled at the end.

    cluster: the scheduler's address (`tcp://host:8786`), the file it wrote (`--scheduler-file`), or
    a Client, which stays open
    Raises ImportError without `distributed`, ConnectionError where no scheduler answers or no
    worker joins, ValueError for a text that is neither, for workers that are not alike, and for a
    sweep of classes that workers cannot import.
    """
    try:
        from distributed import Client
    except ImportError:
        raise ImportError(
            "a sweep over a cluster needs dask.distributed: pip install 'jaxilc[cluster]'"
        ) from None
    _check_importable(sweep)
    if isinstance(cluster, Client):
        yield Workers(cluster, sweep)
        return
    address = _address(cluster)
    try:
        client = Client(address, timeout=PATIENCE, set_as_default=False)
    except OSError:
        raise ConnectionError(
            f"no Dask scheduler answers at {address} within {PATIENCE:g} s"
        ) from None
    with client:
        yield Workers(client, sweep)


class Workers:
    """What `Sweep.run` needs of the processes that compute; the same as `sweep.Host`, on many
    hosts.

    environment: of all workers. One that joins later with another one refuses its first chunk.
    """

    def __init__(self, client: Client, sweep: Sweep):
        import cloudpickle
        import dask

        self.client = client
        self._precision = "float64" if jax.config.jax_enable_x64 else "float32"
        self._found = self._describe()
        self.environment = _common(
            {address: found.environment for address, found in self._found.items()}
        )
        self._run = uuid.uuid4().hex
        with dask.config.set({"distributed.admin.large-graph-warning-threshold": LARGE}):
            # a task rather than scattered data, which would be lost with the workers that hold it
            self._plan = client.submit(
                bytes, cloudpickle.dumps(sweep), key=f"jaxilc-plan-{self._run}"
            )

    def room(self, stored: int) -> tuple[int | None, str]:
        """Bytes there are for a chunk on the worker that has least, None if unknown, and which one
        that is.
        """
        sharing = Counter(found.host for found in self._found.values())
        rooms = {
            address: found.room(stored, sharing[found.host])
            for address, found in self._found.items()
        }
        known = {address: room for address, room in rooms.items() if room is not None}
        least = min(known, key=lambda address: known[address], default=None)
        return (None, "") if least is None else (known[least], f" on the worker {least}")

    def chunk_bytes(self, names: tuple[str, ...], size: int) -> Iterator[tuple[str, int]]:
        """Name and `Host.bytes_of` of each scheme; the schemes are compiled by several workers at
        once.
        """
        futures = {
            name: self._submit(("jaxilc-compile", self._run, name, size), "bytes_of", name, size)
            for name in names
        }
        return (
            (name, _result(future, f"compiling scheme {name!r}"))
            for name, future in futures.items()
        )

    def computed(self, chunks: list[Chunk]) -> Iterator[tuple[Chunk, dict[str, Any]]]:
        """Each chunk with its figures, as they are finished. Few are under way at a time, so that
        neither side fills its memory.
        """
        from distributed import as_completed

        waiting, running, finished = iter(chunks), {}, as_completed(loop=self.client.loop)

        def fill():
            many = AHEAD * max(1, len(self.client.nthreads()))
            for chunk in islice(waiting, max(0, many - len(running))):
                future = self._submit(
                    ("jaxilc-chunk", self._run, chunk.scheme, chunk.number), "compute", chunk
                )
                running[future] = chunk
                finished.add(future)

        try:
            fill()
            for future in finished:
                chunk = running[future]
                what = f"scheme {chunk.name!r}, chunk {chunk.number} (samples {chunk.start} to {chunk.stop - 1})"
                figures = _result(future, what)
                del running[future], future
                fill()
                yield chunk, figures
        except OSError as error:  # of Dask's connections
            raise ChunkFailed(f"the Dask scheduler is gone: {error}") from error
        finally:
            with suppress(OSError):
                self.client.cancel(list(running))

    def _submit(self, key: tuple, method: str, *arguments) -> Future:
        return self.client.submit(
            _on_worker, self._plan, self._precision, self.environment, method, arguments, key=key
        )

    def _describe(self) -> dict[str, Found]:
        try:
            self.client.wait_for_workers(1, timeout=ARRIVAL)
        except TimeoutError:
            raise ConnectionError(
                f"no worker joined the Dask scheduler within {ARRIVAL:g} s"
            ) from None
        found = self.client.run(_describe, self._precision, on_error="return")
        for address, answer in found.items():
            if isinstance(answer, Exception):
                raise UnlikeWorkers(
                    f"the worker {address} cannot run jaxilc: {type(answer).__name__}: {answer}"
                )
        return found


class Found(NamedTuple):
    """A worker. environment: see `results.environment`;  host: its name;  free, on_devices, limit:
    bytes, None where unknown or none
    """

    environment: dict[str, Any]
    host: str
    free: int | None
    on_devices: int | None
    limit: int | None

    def room(self, stored: int, sharing: int) -> int | None:
        """Bytes for a chunk where `sharing` workers are on this host; beside the dataset, if the
        calling process is there as well.
        """
        if self.on_devices is not None:
            return self.on_devices
        beside = stored if self.host == socket.gethostname() else 0
        rooms = [self.limit, None if self.free is None else max(0, self.free - beside) // sharing]
        return min((room for room in rooms if room is not None), default=None)


async def _describe(precision: str, dask_worker=None) -> Found:
    # in a thread: starting JAX, or waiting for another sweep's chunk, must not keep the worker from
    # answering the scheduler
    return await asyncio.to_thread(_found, precision, dask_worker)


def _found(precision: str, worker) -> Found:
    import dask
    import psutil

    with _ONE_AT_A_TIME:
        setup(precision=precision)
        limit = worker.memory_manager.memory_limit
        if limit is not None:  # beyond this share of it Dask kills a worker
            share = dask.config.get("distributed.worker.memory.terminate") or 1.0
            limit = max(0, int(share * limit) - psutil.Process().memory_info().rss)
        return Found(
            environment(),
            socket.gethostname(),
            capacity.host_bytes(),
            capacity.device_bytes(),
            limit,
        )


def _on_worker(
    plan: bytes, precision: str, expected: dict[str, Any], method: str, arguments: tuple
) -> Any:
    """A method of the sweep's `Host` in this worker. One at a time: a chunk takes all devices,
    whatever the worker's threads.
    """
    from distributed import get_worker

    with _ONE_AT_A_TIME:
        setup(precision=precision)  # before the plan is unpickled, which makes arrays
        host = _host(plan, precision)
        differing = differences(host.environment, expected)
        if differing:
            raise UnlikeWorkers(
                f"the worker {get_worker().address} is not like those of this sweep: {'; '.join(differing)}"
            )
        return getattr(host, method)(*arguments)


@lru_cache(maxsize=2)
def _host(plan: bytes, precision: str) -> Host:
    """The sweep in this worker, kept with its compiled programs from chunk to chunk."""
    return pickle.loads(plan).host()


def _result(future: Future, what: str) -> Any:
    try:
        return future.result()
    except UnlikeWorkers:
        raise
    except Exception as error:
        raise ChunkFailed(
            f"{what} failed on the cluster: {type(error).__name__}: {error}"
        ) from error


def _common(environments: Mapping[str, dict[str, Any]]) -> dict[str, Any]:
    """The environment that all workers have. Raises UnlikeWorkers naming those that differ from
    most.
    """
    texts = {address: json.dumps(found, sort_keys=True) for address, found in environments.items()}
    ((most, _),) = Counter(texts.values()).most_common(1)
    alike, odd = next(a for a in texts if texts[a] == most), [a for a in texts if texts[a] != most]
    if odd:
        lines = [
            f"the worker {a} is not like {alike}: {'; '.join(differences(environments[a], environments[alike]))}"
            for a in odd
        ]
        raise UnlikeWorkers("; ".join(lines))
    return environments[alike]


def _address(cluster: str | Path) -> str:
    if Path(cluster).is_file():
        try:
            return str(read_tree(cluster, ".json")["address"])
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(
                f"cluster = {str(cluster)!r} is not a file that a Dask scheduler wrote ({error})"
            ) from None
    if not re.fullmatch(r"(\w+://)?[^/\s]+:\d+", str(cluster)):
        raise ValueError(
            f"cluster = {str(cluster)!r} is neither an address such as tcp://host:8786 nor a scheduler's file that is there"
        )
    return str(cluster)


def _check_importable(sweep: Sweep) -> None:
    # cloudpickle would send such a class along, but JAX does not know it there
    for node in _nodes([sweep.machine, sweep.task, sweep.schemes]):
        cls = type(node)
        if cls.__module__ == "__main__" or "<locals>" in cls.__qualname__:
            raise ValueError(
                f"cluster: workers cannot import {cls.__module__}.{cls.__qualname__}; put it into a module that is installed there"
            )


def _nodes(tree: Any) -> Iterator[Any]:
    if isinstance(tree, Mapping | list | tuple):
        for child in tree.values() if isinstance(tree, Mapping) else tree:
            yield from _nodes(child)
    elif dataclasses.is_dataclass(tree):
        yield tree
        yield from _nodes([getattr(tree, field.name) for field in dataclasses.fields(tree)])
