"""What runs in a worker of a Dask cluster: the chunks of a plan, and what is known of the worker.

Sums in another order are rounded differently, so all workers of a sweep must be alike: the same
versions, backend, number of devices.
"""

from __future__ import annotations

import asyncio
import json
import pickle
import socket
import threading
from collections import Counter
from collections.abc import Mapping
from functools import lru_cache
from typing import Any, NamedTuple

from ..runtime import capacity
from ..runtime.provenance import differences, environment
from ..runtime.start import setup
from .host import Host

_ONE_AT_A_TIME = threading.Lock()


class UnlikeWorkers(ValueError):
    """Workers that would round differently."""


class Found(NamedTuple):
    """What was found of a worker.

    environment: see `provenance.environment`
    host: name of the machine that it runs on
    free: bytes of RAM that are free on this host, None where unknown
    on_devices: bytes that are free on its devices, None where they have no RAM of their own
    limit: bytes that Dask lets it take, None where there is no limit
    """

    environment: dict[str, Any]
    host: str
    free: int | None
    on_devices: int | None
    limit: int | None

    def room(self, stored: int, sharing: int) -> int | None:
        """Bytes that are available for a chunk, None where unknown.

        stored: bytes of the dataset, which lies on the host of the calling process
        sharing: how many workers there are on this worker's host
        """
        if self.on_devices is not None:
            return self.on_devices
        beside = stored if self.host == socket.gethostname() else 0
        rooms = [self.limit, None if self.free is None else max(0, self.free - beside) // sharing]
        return min((room for room in rooms if room is not None), default=None)


async def described(precision: str, dask_worker=None) -> Found:
    """What is known of this worker. Dask hands over `dask_worker`."""
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


def call_host(
    plan: bytes, precision: str, expected: dict[str, Any], method: str, arguments: tuple
) -> Any:
    """The result of a method of the plan's `Host` in this worker.

    There is one call at a time, however many threads the worker has: a chunk takes all devices.
    plan: a pickled `Plan`
    expected: the environment of the other workers
    Raises UnlikeWorkers where that of this worker differs.
    """
    from distributed import get_worker

    with _ONE_AT_A_TIME:
        setup(precision=precision)  # before the plan is unpickled, which makes arrays
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


def common_environment(environments: Mapping[str, dict[str, Any]]) -> dict[str, Any]:
    """The environment that all workers have.

    environments: by the worker's address
    Raises UnlikeWorkers, naming the workers that differ from most of them.
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
