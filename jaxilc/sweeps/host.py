"""One process that computes the chunks of a sweep, on all its devices.

The devices compute while the caller writes: the next chunks are started before the results of the
one before are handed over.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Generator, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from functools import lru_cache, partial
from itertools import islice
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..learning.divergence import Course
from ..learning.known_metrics import METRICS
from ..learning.metrics import Keep
from ..learning.over_trials import learn
from ..runtime import capacity, provenance
from ..runtime.events import COMPILING, COMPUTING
from ..runtime.lanes import fitting_lanes
from ..runtime.tiles import tiled
from ..uncertainty import drawn_machine
from .plan import Chunk, Plan

PROGRAMS = 8  # number of programs, of different sweeps, that are kept in a process
AT_ONCE = 4  # number of chunks that are in the RAM, computed or not; writing takes uneven times
TRIALS_A_PASS = 2  # of the compiled loop over trials, see `learn`
COMPILERS = 4  # number of programs that are compiled at once; a compiler mostly uses one core


class Host:
    """The process that computes the chunks of a plan: this one, or a worker of a cluster.

    environment: what the numbers depend on besides the plan, see `provenance.environment`
    """

    def __init__(self, plan: Plan, *, shared: bool = False):
        """A host of a plan.

        shared: whether to use the compiled programs of earlier hosts of this process, and to leave
            its own to later ones, where the shapes are the same
        """
        self.plan, self.environment = plan, provenance.environment()
        self._needed = 0  # bytes of the largest chunk that was compiled
        self._finished_at = 0.0  # the time at which the last chunk was finished
        names = tuple((name, _Drawn(bool(of.relative))) for name, of in plan.uncertainty.items())
        of_machine = names, plan.trials, plan.keep, Keep.of(plan.quantities)
        self._one = _one_with(*of_machine)
        self._run = (_shared_program if shared else _program)(*of_machine, plan.lanes)

    def fitting_lanes(self) -> int:
        """The lanes that suit the backend and fit for every scheme, see `runtime.lanes`.

        Raises ValueError where a single machine does not fit on a device.
        """
        return min(
            fitting_lanes(
                self._one, *self._arguments(name, 0, 1), self.plan.machines, what=f"Sweep: {name}"
            )
            for name in self.plan.schemes
        )

    def room(self, stored: int) -> tuple[int | None, str]:
        """Bytes that are available for a chunk beside a dataset of `stored` bytes, and where.

        The bytes are None if unknown; the place is given as text.
        """
        host, device = capacity.host_bytes(), capacity.device_bytes()
        return (device if device is not None else None if host is None else host - stored), ""

    def bytes_of(self, name: str, size: int) -> int:
        """Bytes that `size` machines need under a scheme; the program is compiled, but not run."""
        return capacity.program_bytes(self._run.lower(*self._arguments(name, 0, size)))

    def chunk_bytes(self, names: tuple[str, ...], size: int) -> Iterator[tuple[str, int]]:
        """Name and `bytes_of` of each scheme; several are compiled at once."""
        start = time.perf_counter()
        with ThreadPoolExecutor(COMPILERS) as compilers:
            for name, needed in zip(
                names, compilers.map(partial(self.bytes_of, size=size), names), strict=True
            ):
                self._needed = max(self._needed, needed)
                yield name, needed
        jax.monitoring.record_event_duration_secs(COMPILING, time.perf_counter() - start)

    def compute(self, chunk: Chunk) -> dict[str, np.ndarray]:
        """The metrics and signals of a chunk by name; the first axis is that of the machines."""
        begun = time.perf_counter()
        return self._finished(chunk, self._started(chunk), begun)

    @contextmanager
    def computing(
        self, chunks: list[Chunk], stored: int
    ) -> Generator[Iterator[tuple[Chunk, dict]]]:
        """A context with an iterator over the chunks and the results of `compute`, in this order.

        The first chunks are started at once. While the caller uses a chunk, the next ones are
        computed, as many as the RAM can hold beside a dataset of `stored` bytes, up to AT_ONCE.
        """
        room, needed = self.room(stored)[0], max(self._needed, 1)
        at_once = AT_ONCE if room is None else max(1, min(AT_ONCE, room // needed))
        waiting, started = iter(chunks), deque[tuple[Chunk, Future]]()

        def fill():
            for chunk in islice(waiting, at_once - len(started)):
                begun = time.perf_counter()
                found = self._started(chunk)
                started.append((chunk, watcher.submit(self._finished, chunk, found, begun)))

        def finished():
            while started:  # no name refers to the results, so that the caller can free them
                yield started[0][0], started.popleft()[1].result()
                fill()

        with ThreadPoolExecutor(1) as watcher:
            fill()
            yield finished()

    def _started(self, chunk: Chunk) -> dict[str, jax.Array]:
        """The results of `compute` as arrays of JAX, which need not be computed yet."""
        return self._run(*self._arguments(chunk.name, chunk.start, self.plan.chunk))

    def _finished(
        self, chunk: Chunk, found: dict[str, jax.Array], begun: float
    ) -> dict[str, np.ndarray]:
        """The results as NumPy arrays, when they are computed; the time that it took is recorded.

        begun: the time at which the chunk was started; it may have waited for the one before
        """
        jax.block_until_ready(found)
        begun, self._finished_at = max(begun, self._finished_at), time.perf_counter()
        jax.monitoring.record_event_duration_secs(COMPUTING, self._finished_at - begun)
        # The machines that fill the chunk up to full size are left out.
        return {name: np.asarray(value)[: chunk.size] for name, value in found.items()}

    def _arguments(self, name: str, start: int, size: int):
        # The last chunk is filled up to full size with the last machine, so that it runs the same
        # program as the others.
        plan = self.plan
        index = np.minimum(np.arange(start, start + min(size, plan.machines)), plan.machines - 1)
        drawn = {name: jnp.asarray(values[index]) for name, values in plan.drawn.items()}
        common = (plan.machine, plan.schemes[name], plan.task, jax.random.key(plan.seed))
        return common, (jnp.asarray(index), drawn)


class _Drawn(NamedTuple):
    """All that a program needs to know of a distribution."""

    relative: bool


def _one_with(
    names: tuple[tuple[str, _Drawn], ...], trials: int, keep: tuple[str, ...], save: Keep
) -> Any:
    """The function of what is common and of the numbers of one machine."""
    return partial(_one_machine, names=names, trials=trials, keep=keep, save=save)


def _program(names, trials, keep, save, lanes: int | None) -> Any:
    """The compiled function of what is common and of the numbers of the machines of a chunk."""
    return jax.jit(tiled(_one_with(names, trials, keep, save), lanes=lanes))


_shared_program = lru_cache(maxsize=PROGRAMS)(_program)


def _one_machine(
    common, one, *, names, trials: int, keep: tuple[str, ...], save: Keep
) -> dict[str, jax.Array]:
    """The metrics and signals of one drawn machine, for `tiled`."""
    machine, scheme, task, key = common
    index, values = one
    machine = drawn_machine(machine, dict(names), values)
    key = jax.random.fold_in(key, index)
    history = learn(machine, scheme, task, trials, key=key, save=save, trials_a_pass=TRIALS_A_PASS)
    by_channel = {m.name for m in METRICS if m.axes[-1:] in (("channel",), ("input",))} | {*keep}
    found = history.metrics._asdict() | {name: getattr(history.final, name) for name in keep}
    squeezed = {
        name: x[..., 0] if name in by_channel and x.shape[-1] == 1 else x
        for name, x in found.items()
    }
    return squeezed | history.saved | {name: getattr(history, name) for name in Course._fields}
