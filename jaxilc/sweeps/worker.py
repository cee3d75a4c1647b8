"""The functions that run in a worker of a Dask cluster: its description, and chunks of a plan.

Sums in another order are rounded differently, so all workers of a sweep must have the same
versions, backend and number of devices.
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
from typing import TYPE_CHECKING, NamedTuple

from ..pytree.aliases import Value
from ..runtime import capacity
from ..runtime.provenance import Environment, differences, environment
from ..runtime.start import setup
from .host import Host

if TYPE_CHECKING:
    from distributed import Worker

_ONE_AT_A_TIME = threading.Lock()


class UnlikeWorkers(ValueError):
    """The workers differ, so that their numbers would be rounded differently."""


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
        return Found(
            environment(),
            socket.gethostname(),
            capacity.host_bytes(),
            capacity.device_bytes(),
            limit,
        )


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
