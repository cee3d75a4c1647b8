"""One process that computes the chunks of a sweep, on all its devices.

The devices compute while the caller writes: the next chunks are started before the results of the
one before are handed over.
"""

from __future__ import annotations

import logging
import math
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache, cached_property, lru_cache, partial
from itertools import islice
from typing import NamedTuple, TypeAlias

import jax
import numpy as np

from ..learning.divergence import Course
from ..learning.known_metrics import METRICS
from ..learning.metrics import Keep, Watch
from ..learning.over_trials import learn
from ..native.run import Compiled, Native
from ..pytree.aliases import Tree
from ..pytree.named_paths import replaced
from ..runtime import capacity, provenance
from ..runtime.lanes import fitting_lanes
from ..runtime.start import COMPILING, COMPUTING, native_unwanted
from ..runtime.tiles import tiled
from ..uncertainty import Drawn, drawn_machine, key_of
from .plan import Chunk, Plan
from .store import UNFILLED

log = logging.getLogger("jaxilc")

PROGRAMS = 8  # number of programs, of different sweeps, that are kept in a process
AT_ONCE = 4  # number of chunks that are in the RAM, computed or not; writing takes uneven times
TRIALS_A_PASS = 2  # of the compiled loop over trials, see `learn`
ByName: TypeAlias = dict[str, jax.Array]
Started: TypeAlias = ByName | Callable[[], ByName]
COMPILERS = 4  # number of programs that are compiled at once; a compiler mostly uses one core


class Host:
    """The process that computes the chunks of a plan: this one, or a worker of a cluster."""

    def __init__(self, plan: Plan, *, shared: bool = False):
        """A host of a plan.

        shared: whether to use the compiled programs of earlier hosts of this process, and to leave
            its own to later ones, where the shapes are the same
        """
        self.plan = plan
        self._needed = 0  # bytes of the largest chunk that was compiled
        self._finished_at = 0.0  # the time at which the last chunk was finished
        self._first: dict[Chunk, dict[str, np.ndarray]] = {}  # computed before all is compiled
        drawn = tuple(
            (n, Drawn(bool(of.relative))) for n, of in plan.population.uncertainty.items()
        )
        of = drawn, plan.keep, Keep.of(plan.quantities), plan.watch
        make = _shared_program if shared else _program
        self._members = {v.trials: _Member(*of, v.trials) for v in plan.variants.values()}
        self._programs = {n: make(of, plan.lanes) for n, of in self._members.items()}
        self._natives: dict[int, Native[Tree, Tree, ByName] | str] = {}
        for n, member in self._members.items():
            why_not = native_unwanted(partial(math.prod, (plan.members, n, plan.task.N)))
            if not shared:
                why_not = "the workers of a cluster may differ in their processors"
            self._natives[n] = why_not or _shared_native(member)
        self._why_not = cache(self._reason)
        self._by_trial = {
            n: v.dims.index("trial") - 1 for n, v in plan.variables.items() if "trial" in v.dims
        }

    @cached_property
    def environment(self) -> provenance.Environment:
        """What the numbers depend on besides the plan, see `provenance.environment`.

        `native` are the variants that a program compiled for this processor computes; a few
        machines of each are then computed by XLA too, and compared.
        """
        names = [*self.plan.variants]
        with ThreadPoolExecutor(COMPILERS) as compilers:
            reasons = dict(zip(names, compilers.map(self._why_not, names), strict=True))
        for name, reason in reasons.items():
            by = "a program for this processor" if reason is None else f"XLA: {reason}"
            log.info("native: %s is computed by %s", name, by)
        native = [name for name, reason in reasons.items() if reason is None]
        found = provenance.environment(*["llvmlite"][: len(native)])
        if native:
            found["native"] = native
        return found

    def _reason(self, name: str) -> str | None:
        """The reason why XLA computes a variant; None where it does not."""
        native = self._natives[self.plan.variants[name].trials]
        if isinstance(native, str):
            return native
        return native.why_not(*self._arguments(name, 0, self.plan.chunk), ahead=True)

    def _native(self, name: str) -> Compiled[Tree, Tree, ByName] | None:
        """The program for this processor of a variant; None where XLA computes it."""
        native = self._natives[self.plan.variants[name].trials]
        if isinstance(native, str) or self._why_not(name) is not None:
            return None
        return native.program(*self._arguments(name, 0, self.plan.chunk))

    def fitting_lanes(self) -> int:
        """The lanes that suit the backend and fit for every scheme, see `runtime.lanes`.

        Raises ValueError where a single machine does not fit on a device.
        """
        return min(
            fitting_lanes(
                self._members[variant.trials].found,
                *self._arguments(name, 0, 1),
                self.plan.members,
                what=f"Sweep: {name}",
            )
            for name, variant in self.plan.variants.items()
        )

    def room(self, stored: int) -> tuple[int | None, str]:
        """Bytes that are available for a chunk beside a dataset of `stored` bytes, and where.

        The bytes are None if unknown; the place is given as text.
        """
        host, device = capacity.host_bytes(), capacity.device_bytes()
        # a chunk that is computed already becomes a part of the dataset
        stored -= sum(x.nbytes for of in self._first.values() for x in of.values())
        return (device if device is not None else None if host is None else host - stored), ""

    def bytes_of(self, name: str, size: int) -> int:
        """Bytes that `size` members of a variant need; the program is compiled, but not run."""
        native = self._native(name)
        if native is not None:
            return native.bytes_of(size)
        return capacity.program_bytes(self._run(name).lower(*self._arguments(name, 0, size)))

    def chunk_bytes(self, names: tuple[str, ...], size: int) -> Iterator[tuple[str, int]]:
        """Name and `bytes_of` of each variant; several are compiled at once."""
        start = time.perf_counter()
        with ThreadPoolExecutor(COMPILERS) as compilers:
            for name, needed in zip(
                names, compilers.map(partial(self.bytes_of, size=size), names), strict=True
            ):
                self._needed = max(self._needed, needed)
                yield name, needed
        jax.monitoring.record_event_duration_secs(COMPILING, time.perf_counter() - start)

    def compute(self, chunk: Chunk) -> dict[str, np.ndarray]:
        """The metrics and signals of a chunk by name; the first axis is that of the members."""
        begun = time.perf_counter()
        return self._finished(chunk, self._started(chunk), begun)

    def first(self, chunk: Chunk, stored: int) -> dict[str, np.ndarray]:
        """The results of `compute`, which `computing` then has: a first number before all compile.

        Empty where the RAM does not hold the chunk beside a dataset of `stored` bytes.
        """
        room, _ = self.room(stored)
        if room is not None and self.bytes_of(chunk.name, self.plan.chunk) > room:
            return {}
        self._first[chunk] = self.compute(chunk)
        return self._first[chunk]

    @contextmanager
    def computing(
        self, chunks: list[Chunk], stored: int
    ) -> Generator[Iterator[tuple[Chunk, dict[str, np.ndarray]]]]:
        """A context with an iterator over the chunks and the results of `compute`, in this order.

        The first chunks are started at once. While the caller uses a chunk, the next ones are
        computed, as many as the RAM can hold beside a dataset of `stored` bytes, up to AT_ONCE.
        """
        room, needed = self.room(stored)[0], max(self._needed, 1)
        at_once = AT_ONCE if room is None else max(1, min(AT_ONCE, room // needed))
        waiting, started = iter(chunks), deque[tuple[Chunk, Future[dict[str, np.ndarray]]]]()

        def fill() -> None:
            for chunk in islice(waiting, at_once - len(started)):
                if chunk in self._first:
                    started.append((chunk, watcher.submit(self._first.pop, chunk)))
                    continue
                begun = time.perf_counter()
                found = self._started(chunk)
                started.append((chunk, watcher.submit(self._finished, chunk, found, begun)))

        def finished() -> Iterator[tuple[Chunk, dict[str, np.ndarray]]]:
            while started:  # no name refers to the results, so that the caller can free them
                yield started[0][0], started.popleft()[1].result()
                fill()

        with ThreadPoolExecutor(1) as watcher:
            fill()
            yield finished()

    def _started(self, chunk: Chunk) -> Started:
        """The results of `compute` as arrays that need not be computed yet, or what gives them."""
        arguments = self._arguments(chunk.name, chunk.start, self.plan.chunk)
        native = self._native(chunk.name)
        return self._run(chunk.name)(*arguments) if native is None else partial(native, *arguments)

    def _run(self, name: str) -> jax.stages.Wrapped:
        """The compiled function of a variant."""
        return self._programs[self.plan.variants[name].trials]

    def _finished(self, chunk: Chunk, started: Started, begun: float) -> dict[str, np.ndarray]:
        """The results as NumPy arrays, when they are computed; the time that it took is recorded.

        begun: the time at which the chunk was started; it may have waited for the one before
        """
        found = jax.block_until_ready(started() if callable(started) else started)
        begun, self._finished_at = max(begun, self._finished_at), time.perf_counter()
        jax.monitoring.record_event_duration_secs(COMPUTING, self._finished_at - begun)
        # The members that fill the chunk up to full size are left out.
        values = {name: np.asarray(value)[: chunk.size] for name, value in found.items()}
        missing = self.plan.longest - self.plan.variants[chunk.name].trials
        if missing:
            values |= {n: _longer(values[n], axis, missing) for n, axis in self._by_trial.items()}
        return values

    def _arguments(self, name: str, start: int, size: int) -> tuple[Tree, Tree]:
        # The last chunk is filled up to full size with the last member, so that it runs the same
        # program as the others.
        plan, of = self.plan, self.plan.variants[name]
        member = np.minimum(np.arange(start, start + min(size, plan.members)), plan.members - 1)
        point, index = np.divmod(member, plan.machines)
        drawn = {n: x[plan.first + index] for n, x in plan.population.drawn.items()}
        at_point = plan.axes.leaves_at(point, of.name)
        common = (of.machine, of.scheme, of.task, key_of(plan.population.seed))
        return common, (index, drawn, at_point)


def _longer(values: np.ndarray, axis: int, missing: int) -> np.ndarray:
    """The values of a variant that has fewer trials than another, with those that it has not."""
    widths = [(0, missing if i == axis else 0) for i in range(values.ndim)]
    return np.pad(values, widths, constant_values=UNFILLED[values.dtype.kind])


class _Member(NamedTuple):
    """What a program computes of each machine at each point.

    uncertainty: names that are drawn
    """

    uncertainty: tuple[tuple[str, Drawn], ...]
    keep: tuple[str, ...]
    save: Keep
    watch: Watch | None
    trials: int

    def found(self, common: Tree, one: Tree) -> ByName:
        """The metrics and signals of one drawn machine at one point, for `tiled`."""
        (*parts, key), (index, values, at_point) = common, one
        machine, scheme, task = (
            replaced(part, at_point[name]) if name in at_point else part
            for name, part in zip(("machine", "scheme", "task"), parts, strict=True)
        )
        machine = drawn_machine(machine, dict(self.uncertainty), values)
        of, key = (machine, scheme, task, self.trials), jax.random.fold_in(key, index)
        history = learn(*of, key=key, save=self.save, watch=self.watch, trials_a_pass=TRIALS_A_PASS)
        along = {m.name for m in METRICS if m.axes[-1:] in (("channel",), ("input",))} | {
            *self.keep
        }
        found = history.metrics._asdict() | {n: getattr(history.final, n) for n in self.keep}
        squeezed = {
            name: x[..., 0] if name in along and x.shape[-1] == 1 else x
            for name, x in found.items()
        }
        for name, x in history.saved.items():
            if x.shape[1:]:
                raise ValueError(
                    f"quantity = {name!r} has shape {x.shape[1:]}; allowed is one number of a trial"
                )
        squeezed |= history.saved | history.watched
        return squeezed | {name: getattr(history, name) for name in Course._fields}


def _program(of: _Member, lanes: int | None) -> jax.stages.Wrapped:
    """The compiled function of what is common and of the numbers of the members of a chunk."""
    return jax.jit(tiled(of.found, lanes=lanes))


_shared_program = lru_cache(maxsize=PROGRAMS)(_program)


@lru_cache(maxsize=PROGRAMS)
def _shared_native(of: _Member) -> Native[Tree, Tree, ByName]:
    """The function compiled for this processor, where it can be."""
    return Native(of.found)
