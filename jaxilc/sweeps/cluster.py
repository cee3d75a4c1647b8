"""A sweep over many hosts: workers of a Dask cluster compute its chunks.

Only the calling process writes them to the store. Dask may run on SLURM, Kubernetes, over SSH, or
in two shells. The scheduler and all workers need this package and the modules of the user's own
classes, but no shared files. A chunk whose worker dies is computed again by another one.

Sums in another order are rounded differently, so all workers must have the same versions, backend
and number of devices. If their processors are of one kind as well, the dataset equals the one that
a single such host computes, bit for bit.
"""

from __future__ import annotations

import asyncio
import dataclasses
import json
import logging
import pickle
import re
import socket
import threading
import uuid
from collections import Counter
from collections.abc import Generator, Hashable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import jax
import numpy as np

from ..pytree.aliases import Tree, Value
from ..runtime import capacity
from ..runtime.provenance import Environment, differences, environment
from ..runtime.start import setup
from ..storage.reading import read_tree
from .host import Host
from .plan import Chunk, Plan

if TYPE_CHECKING:
    from distributed import Client, Future, Worker

T = TypeVar("T")
PATIENCE = 30.0  # seconds within which a scheduler must answer
# Seconds within which a first worker must join: Python starts slowly on many nodes at once.
ARRIVAL = 120.0
AHEAD = 2  # chunks given to each worker: the one that it computes, and the next one
_ONE_AT_A_TIME = threading.Lock()
LARGE = "1GB"  # size of a pickled plan above which Dask warns, in place of its usual 10 MB


class ChunkFailed(RuntimeError):
    """A chunk could not be computed by any worker; the chunks finished before are in the store."""


class UnlikeWorkers(ValueError):
    """The workers differ, so that their numbers would be rounded differently."""


@contextmanager
def workers(plan: Plan, cluster: str | Path | Client) -> Generator[Workers]:
    """The workers of a Dask cluster, ready for a plan; their tasks are cancelled at the end.

    cluster: the scheduler's address (`tcp://host:8786`), the file that it wrote
        (`--scheduler-file`), or a Client, which stays open
    Raises ImportError without `distributed`, ConnectionError where no scheduler answers or no
    worker joins, and ValueError for a text that is neither address nor file, for workers with
    different environments, and for a sweep of classes that workers cannot import.
    """
    try:
        from distributed import Client
    except ImportError:
        raise ImportError(
            "a sweep over a cluster needs dask.distributed: pip install 'jaxilc[cluster]'"
        ) from None
    _check_importable(plan)
    if isinstance(cluster, Client):
        yield Workers(cluster, plan)
        return
    address = _address(cluster)
    try:
        client = Client(address, timeout=PATIENCE, set_as_default=False)
    except OSError:
        raise ConnectionError(
            f"no Dask scheduler answers at {address} within {PATIENCE:g} s"
        ) from None
    log = logging.getLogger("distributed.client")
    level = log.level
    log.setLevel(logging.CRITICAL)  # it logs a traceback of what `ChunkFailed` says in a line
    try:
        with client:
            yield Workers(client, plan)
    finally:
        log.setLevel(level)


class Workers:
    """The processes that compute the chunks of a plan, with the methods of `Host`.

    environment: environment that all workers have; a worker with another one that joins later
        refuses its first chunk
    """

    def __init__(self, client: Client, plan: Plan):
        import cloudpickle
        import dask

        self.client = client
        self._precision = "float64" if jax.config.jax_enable_x64 else "float32"
        self._found = self._known()
        self.environment = common_environment(
            {address: found.environment for address, found in self._found.items()}
        )
        self._run = uuid.uuid4().hex
        with dask.config.set({"distributed.admin.large-graph-warning-threshold": LARGE}):
            # A task is used, since scattered data would be lost with the workers that hold it.
            self._plan = client.submit(
                bytes, cloudpickle.dumps(plan), key=f"jaxilc-plan-{self._run}"
            )

    def room(self, stored: int) -> tuple[int | None, str]:
        """Bytes that are available for a chunk on the worker that has least, and which one it is.

        The bytes are None if unknown; the worker is given as text.
        """
        sharing = Counter(found.host for found in self._found.values())
        known = [
            (room, f" on the worker {address}")
            for address, found in self._found.items()
            if (room := found.room(stored, sharing[found.host])) is not None
        ]
        return min(known, default=(None, ""))

    def chunk_bytes(self, names: tuple[str, ...], size: int) -> Iterator[tuple[str, int]]:
        """Name and `Host.bytes_of` of each scheme; several workers compile them at once."""
        futures = {
            name: self._submit(("jaxilc-compile", self._run, name, size), "bytes_of", name, size)
            for name in names
        }
        return (
            (name, _result(future, f"compiling scheme {name!r}"))
            for name, future in futures.items()
        )

    @contextmanager
    def computing(
        self, chunks: list[Chunk], stored: int
    ) -> Generator[Iterator[tuple[Chunk, dict[str, np.ndarray]]]]:
        """A context with an iterator over the chunks and the results of `Host.compute`.

        They come in the order in which they are finished. Few chunks are computed at a time,
        whatever the bytes `stored` of the dataset, so that no process fills its RAM.
        """
        from distributed import as_completed

        waiting, finished = iter(chunks), as_completed(loop=self.client.loop)
        running: dict[Future[Value], Chunk] = {}

        def fill() -> None:
            many = AHEAD * max(1, len(self.client.nthreads()))
            for chunk in islice(waiting, max(0, many - len(running))):
                future = self._submit(
                    ("jaxilc-chunk", self._run, chunk.scheme, chunk.number), "compute", chunk
                )
                running[future] = chunk
                finished.add(future)

        def computed() -> Iterator[tuple[Chunk, dict[str, np.ndarray]]]:
            try:
                fill()
                for future in finished:
                    chunk = running[future]
                    machines = f"machines {chunk.start} to {chunk.stop - 1}"
                    what = f"scheme {chunk.name!r}, chunk {chunk.number} ({machines})"
                    values = _result(future, what)
                    del running[future], future
                    fill()
                    yield chunk, values
            except OSError as error:  # of Dask's connections
                raise ChunkFailed(f"the Dask scheduler is gone: {error}") from error

        try:
            yield computed()
        finally:
            with suppress(OSError):
                self.client.cancel(list(running))

    def _submit(self, key: tuple[Hashable, ...], method: str, *arguments: Value) -> Future[Value]:
        return self.client.submit(
            call_host, self._plan, self._precision, self.environment, method, arguments, key=key
        )

    def _known(self) -> dict[str, Found]:
        """The properties of each worker, by its address."""
        try:
            self.client.wait_for_workers(1, timeout=ARRIVAL)
        except TimeoutError:
            raise ConnectionError(
                f"no worker joined the Dask scheduler within {ARRIVAL:g} s"
            ) from None
        found = self.client.run(described, self._precision, on_error="return")
        for address, answer in found.items():
            if isinstance(answer, Exception):
                raise UnlikeWorkers(
                    f"the worker {address} cannot run jaxilc: {type(answer).__name__}: {answer}"
                )
        return found


def _result(future: Future[T], what: str) -> T:
    try:
        return future.result()
    except UnlikeWorkers:
        raise
    except Exception as error:
        raise ChunkFailed(
            f"{what} failed on the cluster: {type(error).__name__}: {error}"
        ) from error


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
            f"cluster = {str(cluster)!r} is neither an address such as tcp://host:8786 nor a "
            "scheduler's file that is there"
        )
    return str(cluster)


def _check_importable(plan: Plan) -> None:
    # cloudpickle would send such a class along, but JAX has not registered it on the worker.
    for node in _nodes([plan.population.machine, plan.task, plan.schemes, *plan.variants.values()]):
        cls = type(node)
        if cls.__module__ == "__main__" or "<locals>" in cls.__qualname__:
            raise ValueError(
                f"cluster: workers cannot import {cls.__module__}.{cls.__qualname__}; put it into "
                "a module that is installed there"
            )


def _nodes(tree: Tree) -> Iterator[Tree]:
    if isinstance(tree, Mapping | list | tuple):
        for child in tree.values() if isinstance(tree, Mapping) else tree:
            yield from _nodes(child)
    elif dataclasses.is_dataclass(tree):
        yield tree
        yield from _nodes([getattr(tree, field.name) for field in dataclasses.fields(tree)])


# What runs in a worker: its description, and chunks of a plan
# --------------------------------------------------------------------------------------------------


class Found(NamedTuple):
    """The properties of a worker.

    free: bytes of RAM that are free on this host, None where unknown
    on_devices: bytes that are free on its devices, None where they have no RAM of their own
    limit: bytes that Dask allows the worker, None where there is no limit
    """

    environment: Environment
    host: str
    free: int | None
    on_devices: int | None
    limit: int | None

    def room(self, stored: int, sharing: int) -> int | None:
        """Bytes that are available for a chunk, None where unknown.

        stored: bytes of the dataset, which is on the host of the calling process
        """
        if self.on_devices is not None:
            return self.on_devices
        beside = stored if self.host == socket.gethostname() else 0
        rooms = [self.limit, None if self.free is None else max(0, self.free - beside) // sharing]
        return min((room for room in rooms if room is not None), default=None)


async def described(precision: str, dask_worker: Worker) -> Found:
    """The properties of this worker, which Dask passes."""
    # A thread is used, so that the worker answers the scheduler while JAX starts or while it waits
    # for a chunk of another sweep.
    return await asyncio.to_thread(_found, precision, dask_worker)


def _found(precision: str, worker: Worker) -> Found:
    import dask
    import psutil

    with _ONE_AT_A_TIME:
        setup(precision=precision)
        limit = worker.memory_manager.memory_limit
        if limit is not None:  # Dask kills a worker beyond this share of the limit
            share = dask.config.get("distributed.worker.memory.terminate") or 1.0
            limit = max(0, int(share * limit) - psutil.Process().memory_info().rss)
        free = capacity.host_bytes(), capacity.device_bytes()
        return Found(environment(), socket.gethostname(), *free, limit)


def call_host(
    plan: bytes, precision: str, expected: Environment, method: str, arguments: tuple[Value, ...]
) -> Value:
    """The result of a method of the plan's `Host` in this worker.

    Calls run one at a time, however many threads the worker has, since a chunk uses all devices.

    Raises UnlikeWorkers where the environment of this worker differs.
    """
    from distributed import get_worker

    with _ONE_AT_A_TIME:
        setup(precision=precision)  # must come before the plan is unpickled, which makes arrays
        host = _host(plan, precision)
        differing = differences(host.environment, expected)
        if differing:
            raise UnlikeWorkers(
                f"the worker {get_worker().address} is not like those of this sweep: "
                f"{'; '.join(differing)}"
            )
        return getattr(host, method)(*arguments)


@lru_cache(maxsize=2)
def _host(plan: bytes, precision: str) -> Host:
    """The host of a plan in this worker, kept with its compiled programs from chunk to chunk."""
    return Host(pickle.loads(plan))


def common_environment(environments: Mapping[str, Environment]) -> Environment:
    """The environment that all workers have.

    Raises UnlikeWorkers naming the workers that differ from the majority.
    """
    texts = {address: json.dumps(found, sort_keys=True) for address, found in environments.items()}
    ((most, _),) = Counter(texts.values()).most_common(1)
    alike, odd = next(a for a in texts if texts[a] == most), [a for a in texts if texts[a] != most]
    if odd:
        differing = {a: "; ".join(differences(environments[a], environments[alike])) for a in odd}
        raise UnlikeWorkers(
            "; ".join(f"the worker {a} is not like {alike}: {of}" for a, of in differing.items())
        )
    return environments[alike]
