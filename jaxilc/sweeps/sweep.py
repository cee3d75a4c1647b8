"""Monte-Carlo sweeps: schemes on many uncertain machines, chunk by chunk into a dataset."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import ExitStack, nullcontext
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from ..learning.machine import Machine
from ..learning.metrics import Keep
from ..learning.over_trials import check
from ..learning.watch import Watch
from ..learning.within_trial import bytes_of_trial
from ..pytree.in_short import in_short
from ..pytree.ranges import SEEDS, brief, require
from ..runtime import capacity, provenance
from ..runtime.earlier_names import takes_also
from ..runtime.lanes import usual_lanes
from ..runtime.provenance import describe
from ..runtime.tiles import OPEN
from ..schemes import Scheme
from ..signals.task import Task, Trial
from ..uncertainty import Uncertainty, draw, drawn_count, drawn_machine
from ..uncertainty import check as check_uncertainty
from .grid import Grid, grid_of
from .host import Host
from .layout import Layout, Variable
from .plan import Plan, that_fits
from .store import Store, stored_configuration
from .variables import SIGNALS, coordinates, sizes, variables

if TYPE_CHECKING:
    import xarray as xr
    from distributed import Client

CHUNK = 256
# Where a scheme would have more than CHUNKS such chunks, they are up to LARGEST times as large: the
# files of a chunk take as long to write as some hundred machines take to compute.
CHUNKS, LARGEST = 16, 8
HEAVY = 2**26  # bytes of the results of a chunk, up to which it is made larger
WORK = 4  # arrays of the size of a metric over all machines and trials, needed for its quantiles


@takes_also(samples="machines")
@dataclasses.dataclass(frozen=True)
class Sweep:
    """A fully specified sweep, which `run` computes.

    machine, task, trials: as for `learn`
    schemes: schemes by name
    uncertainty: distributions of the named leaves of the machine
    machines, seed, sampling: how many machines are drawn and how, see `uncertainty.draw`; `samples`
        is an earlier name of `machines`
    keep: signals of the last trial to store, any of y, e, u (they are large)
    chunk: number of machines computed and stored at a time; None for 256, or for a tile on each
        device if that is more, and for up to 8 times as many where there are many machines
    lanes: number of machines vectorised together, None for what suits this backend: 16 or 8 on a
        CPU, by its cache; on an accelerator what its memory holds, see `runtime.lanes`
    quantities: further metrics of each trial, by name, each a function from a trial to a number
    watch: what looks at each trial beside the one before it, such as `theory.BoundsWatch`, whose
        variables become those of the dataset; None: nothing
    grid: values by the name of what has them; at each of their points the same machines are run,
        see `grid`

    The configuration also has chunk, lanes and the number of devices, since sums in another order
    are rounded differently. Where chunk or lanes is None, a resumed store keeps those that it was
    begun with.

    Raises ValueError, before anything is compiled or written, naming what does not fit.
    """

    machine: Machine
    schemes: Mapping[str, Scheme]
    task: Task
    trials: int
    uncertainty: Uncertainty
    machines: int = 1024
    seed: int = 0
    sampling: str = "monte-carlo"
    keep: tuple[str, ...] = ()
    chunk: int = OPEN
    lanes: int = OPEN
    quantities: Mapping[str, Callable[[Trial], jax.Array]] = dataclasses.field(default_factory=dict)
    watch: Watch | None = None
    grid: Mapping[Any, Any] = dataclasses.field(default_factory=dict)
    __repr__ = in_short

    def __post_init__(self):
        for name in ("lanes", "trials", "machines", "chunk"):
            if name not in self._left_open:
                require("Sweep", name, getattr(self, name), "[1, inf)", whole=True)
        require("Sweep", "seed", self.seed, SEEDS, whole=True)
        object.__setattr__(
            self, "keep", tuple(self.keep) if isinstance(self.keep, list) else self.keep
        )
        for name in self.keep if isinstance(self.keep, tuple) else [self.keep]:
            if not isinstance(name, str) or name not in SIGNALS:
                raise ValueError(f"Sweep: keep = {brief(name)} is not one of {', '.join(SIGNALS)}")
        if not isinstance(self.schemes, Mapping):
            raise ValueError(
                f"Sweep: schemes = {brief(self.schemes)} is a {type(self.schemes).__name__}; "
                "allowed are schemes by name, such as {'name': scheme}"
            )
        if not self.schemes:
            raise ValueError("Sweep: schemes is empty; at least one is needed")
        Keep.of(self.quantities)
        for scheme in self.schemes.values():
            check(self.machine, scheme, self.task)
        self._variables()
        check_uncertainty(self.machine, self.uncertainty)
        self.need_room()
        self.axes.check(*self._parts, self.uncertainty, lambda: self.drawn)
        if self.drawn:  # the number of corners, whatever was asked for
            object.__setattr__(self, "machines", len(next(iter(self.drawn.values()))))
        if self.lanes is None:
            variants = self.axes.variants(*self._parts).values()
            most = max(bytes_of_trial(of.scheme, of.task) for of in variants)
            usual = usual_lanes(most) or Host(self._plan()).fitting_lanes()
            object.__setattr__(self, "lanes", usual)
        if self.chunk is None:
            object.__setattr__(self, "chunk", self._usual_chunk())

    @cached_property
    def _left_open(self) -> tuple[str, ...]:
        """Which of lanes and chunk were None at construction, when this is computed."""
        return tuple(name for name in ("lanes", "chunk") if getattr(self, name) is None)

    def _usual_chunk(self) -> int:
        least = max(CHUNK, self.lanes * jax.device_count())
        light = HEAVY * len(self.schemes) // self.bytes_stored(least, points=1)
        members = self.machines * self.axes.points
        return least * max(1, min(LARGEST, light, members // (CHUNKS * least)))

    @property
    def _parts(self) -> tuple[Machine, Mapping[str, Scheme], Task, int]:
        return self.machine, self.schemes, self.task, self.trials

    @cached_property
    def axes(self) -> Grid:
        """The axes of the grid."""
        return grid_of(self.grid, self.machine, self.schemes, self.task)

    def at(self, point: Mapping[str, Any]) -> Sweep:
        """The sweep of one point, without a grid, whose numbers are those of the grid there.

        point: a value of each axis, by the name of its dimension
        Raises ValueError for a value that is not in the grid.
        """
        parts = self.axes.at(self.axes.place_of(point), *self._parts)
        names = ("machine", "schemes", "task", "trials")
        return dataclasses.replace(self, grid={}, **dict(zip(names, parts, strict=True)))

    @cached_property
    def drawn(self) -> dict[str, np.ndarray]:
        """(machines,) drawn numbers by the name of the leaf."""
        return draw(
            self.machine, self.uncertainty, self.machines, seed=self.seed, sampling=self.sampling
        )

    @cached_property
    def plan(self) -> Plan:
        """The plan of this sweep for the processes that compute it."""
        return self._plan()

    def _plan(self) -> Plan:
        fields = {f.name for f in dataclasses.fields(Plan)} - {"drawn"}
        return Plan(**{name: getattr(self, name) for name in fields}, drawn=self.drawn)

    def configuration(self, environment: dict[str, Any] | None = None) -> dict[str, Any]:
        """All that determines the numbers, as JSON.

        environment: environment of the processes that compute, None for this process
        """
        names = [f.name for f in dataclasses.fields(self) if f.name != "grid"]
        fields = {name: describe(getattr(self, name)) for name in names}
        if self.axes.axes:
            fields["grid"] = self.axes.described(self.schemes)
        return fields | {"environment": environment or provenance.environment()}

    def run(
        self,
        out: str | Path | None = None,
        *,
        resume: bool = False,
        progress: Callable[[str, int, int], None] | None = None,
        cluster: str | Path | Client | None = None,
    ) -> xr.Dataset:
        """Compute what is not done yet and return the dataset.

        Its dimensions are scheme, sample (the machines) and trial; its coordinates hold every drawn
        number. Each axis of a grid is a dimension too, after that of the schemes. A run that was
        killed at any moment and resumed ends with the dataset of an uninterrupted one, bit for bit.
        Damaged chunks of the store are computed again.

        out: path of a Zarr store for the dataset, None to keep it in the RAM only
        resume: continue the store at `out`
        progress: function that is called after each chunk with the scheme's name, how many of its
            machines at all points are done so far, and how many of them this call computed
        cluster: a Dask scheduler whose workers compute the chunks, as its address, the file that it
            wrote, or a Client; see `cluster.workers`
        Raises FileExistsError for an `out` that exists without `resume`; ValueError for one that is
        in use, is no store, or was made with another configuration, and, before anything is
        written, for a chunk or a dataset that the RAM cannot hold, with what would fit. On a
        cluster also `ChunkFailed`, for a chunk that no worker could compute.
        """
        if resume and self._left_open and out is not None and Path(out).exists():
            begun = self._as_begun(stored_configuration(Path(out)))
            if begun is not None:
                return begun.run(out, resume=True, progress=progress, cluster=cluster)
        if cluster is None:
            computing = nullcontext(self.host())
        else:
            from .cluster import workers

            computing = workers(self.plan, cluster)
        with computing as hosts:
            return self._run(hosts, out, resume, progress or (lambda name, done, fresh: None))

    def _run(
        self, hosts, out: str | Path | None, resume: bool, progress: Callable[[str, int, int], None]
    ) -> xr.Dataset:
        layout = Layout(
            self._variables(),
            coordinates(self.plan),
            self.chunk,
            self.configuration(hosts.environment),
        )
        found = out is not None and Path(out).exists()
        if found and not resume:
            raise FileExistsError(f"{out} exists already; resume it or choose another place")
        chunks = self.plan.chunks()
        with ExitStack() as opened:
            store = opened.enter_context(Store.resume(out, layout)) if found else None
            pending = [c for c in chunks if store is None or not store.is_done(c.scheme, c.number)]
            copies = 2 if out is None else 1
            self._need_memory(hosts, tuple(dict.fromkeys(c.name for c in pending)), copies=copies)
            computed = opened.enter_context(hosts.computing(pending, copies * self.bytes_stored()))
            store = opened.enter_context(Store.create(out, layout)) if store is None else store
            done = Counter()
            scheme_of = {name: variant.name for name, variant in self.plan.variants.items()}
            for chunk in sorted(set(chunks) - set(pending)):
                name = scheme_of[chunk.name]
                done[name] += chunk.size
                progress(name, done[name], 0)
            for chunk, values in computed:
                store.write(chunk.scheme, chunk.number, slice(chunk.start, chunk.stop), values)
                del values  # the chunk after the next one is started now
                name = scheme_of[chunk.name]
                done[name] += chunk.size
                progress(name, done[name], chunk.size)
            return store.dataset()

    def _as_begun(self, stored: Mapping[str, Any]) -> Sweep | None:
        """This sweep with the lanes and the chunk of a store, where they were left open.

        None where this sweep has them already, or the store has none that are allowed.
        """
        kept = {name: stored.get(name) for name in self._left_open}
        if any(type(size) is not int or size < 1 for size in kept.values()):
            return None
        same = all(getattr(self, name) == size for name, size in kept.items())
        return None if same else dataclasses.replace(self, **kept)

    def compile(self) -> None:
        """Compile the programs, for `run` and for other sweeps of these shapes in this process.

        It may be called in a thread while something else is computed.
        """
        for _ in self.host().chunk_bytes(tuple(self.plan.variants), self.chunk):
            pass

    def host(self) -> Host:
        """This process, ready to compute chunks."""
        return Host(self.plan, shared=True)

    def machine_of(self, number: int) -> Machine:
        """One of the machines, rebuilt from its drawn numbers."""
        drawn = {name: values[number] for name, values in self.drawn.items()}
        return drawn_machine(self.machine, self.uncertainty, drawn)

    def key_of(self, number: int) -> jax.Array:
        """The key of one machine's noise, which does not depend on the chunks or their number."""
        return jax.random.fold_in(jax.random.key(self.seed), number)

    def bytes_stored(
        self,
        machines: float | None = None,
        trials: float | None = None,
        points: float | None = None,
    ) -> int:
        """Bytes of the whole dataset, before compression.

        machines, trials, points: their numbers, None for those of this sweep
        """
        machines = self.machines if machines is None else machines
        trials = self.axes.longest(self.trials) if trials is None else trials
        points = self.axes.size if points is None else points
        lengths = sizes(self.task, len(self.schemes), machines * points, trials)
        return sum(
            np.dtype(v.dtype).itemsize * math.prod(lengths[d] for d in v.dims)
            for v in self._variables().values()
        )

    def _variables(self) -> dict[str, Variable]:
        return variables(self.task, self.keep, self.quantities, self.watch)

    def need_room(self, copies: int = 1) -> None:
        """Raises ValueError where `copies` of the dataset and its summary do not fit in RAM.

        The message says how many machines or trials would fit.
        """
        labels = len(self.uncertainty) + sum(len(axis.values) for axis in self.axes.axes)
        summary = 8 * WORK * len(self.schemes) * self.task.outputs

        def need(machines: float, trials: float, points: float = 1) -> float:
            return (
                copies * self.bytes_stored(machines, trials, points)
                + 8 * labels * machines * points
                + summary * machines * points * trials
                + 8 * trials
            )

        capacity.check_size(
            "Sweep",
            need,
            machines=drawn_count(self.uncertainty, self.machines, self.sampling),
            trials=self.axes.longest(self.trials),
            **({"points": self.axes.size} if self.axes.axes else {}),
        )

    def _need_memory(self, hosts, names: tuple[str, ...], *, copies: int) -> None:
        """Compile a chunk of each variant, and check that it fits in RAM.

        Raises ValueError where one does not fit beside `copies` of the dataset. Where the size of
        the RAM is unknown, nothing is refused.
        """
        self.need_room(copies)
        room, where = hosts.room(copies * self.bytes_stored())
        for name, need in hosts.chunk_bytes(names, self.chunk):
            if room is not None and need > room:
                raise ValueError(
                    f"Sweep: chunk = {self.chunk} needs {capacity.shown(need)} where "
                    f"{capacity.shown(room)} are available{where}; "
                    f"{that_fits(self.plan, hosts, name, need, room)}"
                )
