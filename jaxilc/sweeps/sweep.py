"""Monte-Carlo sweeps: schemes on many uncertain machines, chunk by chunk into a dataset."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, ExitStack, nullcontext
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, cast

import jax
import numpy as np

from ..learning.machine import Machine
from ..learning.metrics import Keep, Watch
from ..learning.over_trials import check, need_kinds
from ..learning.within_trial import bytes_of_trial
from ..pytree.aliases import Value
from ..pytree.in_short import in_short
from ..pytree.ranges import SEEDS, brief, require
from ..runtime import capacity, provenance
from ..runtime.earlier_names import takes_also
from ..runtime.jax_internals import of_any_ranks
from ..runtime.lanes import usual_lanes
from ..runtime.provenance import describe
from ..runtime.tiles import OPEN
from ..schemes import Scheme
from ..signals.task import Task, Trial
from ..storage.files import need_free
from ..uncertainty import Population, Uncertainty, takes_population
from .grid import Grid, grid_of
from .host import Host
from .plan import SIGNALS, Plan
from .runs import need_schemes
from .store import DONE, Layout, Store, stored_configuration

if TYPE_CHECKING:
    import xarray as xr
    from distributed import Client

    from .cluster import Workers

CHUNK = 256
# Where a scheme would have more than CHUNKS such chunks, they are up to LARGEST times as large: the
# files of a chunk take as long to write as some hundred machines take to compute.
CHUNKS, LARGEST = 16, 8
CHOSEN = ("lanes", "chunk")  # where they are left open
HEAVY = 2**26  # bytes of the results of a chunk, up to which it is made larger


@takes_also(samples="machines")
@takes_population
@dataclasses.dataclass(frozen=True)
class Sweep:
    """A fully specified sweep, which `run` computes.

    machine, task, trials: as for `learn`; a `Population` may take the place of the machine
    uncertainty, machines, seed, sampling, grid: which machines are drawn, and at which points they
        are run, see `Population`; `samples` is an earlier name of `machines`
    keep: signals of the last trial to store, any of y, e, u (they are large)
    chunk: number of machines computed and stored at a time; None for 256, or for a tile on each
        device if that is more, and for up to 8 times as many where there are many machines
    lanes: number of machines vectorised together, None for what suits this backend: 16 or 8 on a
        CPU, by its cache; on an accelerator what its memory holds, see `runtime.lanes`
    quantities: further metrics of each trial, by name, each a function from a trial to a number
    watch: what looks at each trial beside the one before it, such as `theory.BoundsWatch`, whose
        variables become those of the dataset; None: nothing

    A sweep has what it was given; `plan` has the chunk and the lanes that were left open. Both and
    the number of devices are in the configuration, since sums in another order are rounded
    differently. What was left open, a resumed store keeps as it was begun with.

    Raises ValueError, before anything is compiled or written, naming what does not fit.
    """

    machine: Machine | Population
    schemes: Mapping[str, Scheme]
    task: Task
    trials: int
    uncertainty: Uncertainty
    machines: int = 1024
    seed: int = 0
    sampling: str = "monte-carlo"
    keep: tuple[str, ...] = ()
    chunk: int | None = None
    lanes: int | None = None
    quantities: Mapping[str, Callable[[Trial], jax.Array]] = dataclasses.field(default_factory=dict)
    watch: Watch | None = None
    grid: Mapping[Value, Value] = dataclasses.field(default_factory=dict)
    __repr__ = in_short

    def __post_init__(self) -> None:
        for name in ("trials", "machines", *(n for n in CHOSEN if getattr(self, n) is not None)):
            require("Sweep", name, getattr(self, name), "[1, inf)", whole=True)
        require("Sweep", "seed", self.seed, SEEDS, whole=True)
        for name in self.keep if isinstance(self.keep, tuple | list) else [self.keep]:
            if not isinstance(name, str) or name not in SIGNALS:
                raise ValueError(f"Sweep: keep = {brief(name)} is not one of {', '.join(SIGNALS)}")
        need_schemes("Sweep", self.schemes)
        Keep.of(self.quantities)
        if self.watch is not None:
            need_kinds(watch=self.watch)
        for name, scheme in self.schemes.items():
            if not isinstance(name, str):
                raise ValueError(f"Sweep: schemes has the name {brief(name)}; allowed is text")
            if name in ("machine", "task"):
                raise ValueError(
                    f"Sweep: schemes has a scheme {name!r}, with which a grid names other parts; "
                    "allowed is another name"
                )
            need_kinds(machine=self.machine, scheme=scheme, task=self.task)
            if not self.grid:  # whose points the plan checks; they may replace what is wrong here
                check(cast("Machine", self.machine), scheme, self.task)
        _ = self.plan  # which cannot be made of a machine, a draw or a grid that does not fit

    @cached_property
    def population(self) -> Population:
        """The machines, with the axes of the grid."""
        of = self.machine, self.uncertainty, self.grid, self.machines, self.seed, self.sampling
        return Population(*of)

    @cached_property
    def plan(self) -> Plan:
        """The plan of this sweep for the processes that compute it."""
        population = self.population
        axes = grid_of(self.grid, population.machine, self.schemes, self.task)
        plan = Plan(
            population, self.schemes, self.task, self.trials, tuple(self.keep),
            self.quantities, self.watch, axes, self.chunk or OPEN, self.lanes or OPEN,
        )  # fmt: skip
        plan.need_room()
        axes.check(population, plan.parts, self.quantities)
        known = plan.coordinates() if self.quantities else {}
        for name in self.quantities:
            if name in known:
                raise ValueError(
                    f"quantity = {name!r} is a coordinate of the dataset; choose another name"
                )
            if name in ("", DONE) or "/" in name:
                raise ValueError(
                    f"quantity = {name!r} cannot name a variable of a store; allowed is another "
                    "name without '/'"
                )
        if plan.lanes is None:
            each = {id(of.scheme): of for of in plan.variants.values()}.values()
            most = max(bytes_of_trial(of.scheme, of.task) for of in each)
            lanes = usual_lanes(most) or Host(plan).fitting_lanes()
            plan = dataclasses.replace(plan, lanes=lanes)
        return plan if plan.chunk is not None else dataclasses.replace(plan, chunk=_chunk_of(plan))

    @property
    def axes(self) -> Grid:
        """The axes of the grid."""
        return self.plan.axes

    def at(self, point: Mapping[str, Value]) -> Sweep:
        """The sweep of one point, without a grid, whose numbers are those of the grid there.

        point: a value of each axis, by the name of its dimension
        Raises ValueError for a value that is not in the grid.
        """
        parts = self.axes.at(self.axes.place_of(point), self.plan.parts)
        return dataclasses.replace(self, grid={}, **parts._asdict())

    @property
    def drawn(self) -> dict[str, np.ndarray]:
        """(machines,) drawn numbers by the name of the leaf."""
        return self.population.drawn

    def configuration(self, environment: provenance.Environment | None = None) -> dict[str, object]:
        """All that determines the numbers, as JSON.

        environment: environment of the processes that compute, None for this process
        """
        names = [f.name for f in dataclasses.fields(self) if f.name != "grid"]
        of = {name: self.plan if name in ("machines", *CHOSEN) else self for name in names}
        fields: dict[str, object] = {name: describe(getattr(of[name], name)) for name in names}
        if self.axes.axes:
            fields["grid"] = self.axes.described(self.schemes)
        return fields | {"environment": environment or provenance.environment()}

    @of_any_ranks
    def run(
        self,
        out: str | Path | None = None,
        *,
        resume: bool = False,
        progress: Callable[[str, int, int], object] | None = None,
        results: Callable[[str, Mapping[str, np.ndarray]], object] | None = None,
        cluster: str | Path | Client | None = None,
    ) -> xr.Dataset:
        """Compute what is not done yet and return the dataset.

        Its dimensions are scheme, sample (the machines) and trial; its coordinates hold every drawn
        number. Each axis of a grid is a dimension too, after that of the schemes. A run that was
        killed at any moment and resumed ends with the dataset of an uninterrupted one, bit for bit.
        Damaged chunks of the store are computed again.

        out: path of a Zarr store for the dataset, None to keep it in the RAM only
        progress: function that is called after each chunk with the scheme's name, how many of its
            machines at all points are done so far, and how many of them this call computed
        results: function that is called before `progress` with the scheme's name and what this call
            computed of it: arrays by the name of their variable, the machines along the first axis;
            with the first chunk already before other schemes are compiled and anything is stored
        cluster: a Dask scheduler whose workers compute the chunks, as its address, the file that it
            wrote, or a Client; see `cluster.workers`
        Raises FileExistsError for an `out` that exists without `resume`; ValueError for one that is
        in use, is no store, or was made with another configuration, and, before anything is
        written, for a chunk or a dataset that the RAM cannot hold, with what would fit. On a
        cluster also `ChunkFailed`, for a chunk that no worker could compute.
        """
        if resume and out is not None and Path(out).exists():
            begun = self._as_begun(stored_configuration(Path(out)))
            if begun is not None:
                return begun.run(
                    out, resume=True, progress=progress, results=results, cluster=cluster
                )
        computing: AbstractContextManager[Host | Workers]
        if cluster is None:
            computing = nullcontext(self.host())
        else:
            from .cluster import workers

            computing = workers(self.plan, cluster)
        with computing as hosts:
            return self._run(hosts, out, resume, progress or _silent, results or _silent)

    def _run(
        self,
        hosts: Host | Workers,
        out: str | Path | None,
        resume: bool,
        progress: Callable[[str, int, int], object],
        results: Callable[[str, Mapping[str, np.ndarray]], object],
    ) -> xr.Dataset:
        found = out if out is not None and Path(out).exists() else None
        if out is not None and not resume:
            need_free(out)
        chunks, copies = self.plan.chunks(), 2 if out is None else 1
        scheme_of = {name: variant.name for name, variant in self.plan.variants.items()}
        told = None  # the chunk whose results are told before the other variants are compiled
        if found is None and isinstance(hosts, Host):
            first = hosts.first(chunks[0], copies * self.plan.bytes_stored())
            if first:
                told = chunks[0]
                results(scheme_of[told.name], first)
            del first
        plan, made_with = self.plan, self.configuration(hosts.environment)
        layout = Layout(plan.variables, plan.coordinates(), int(plan.chunk), made_with)
        with ExitStack() as opened:
            store = None if found is None else opened.enter_context(Store.resume(found, layout))
            pending = [c for c in chunks if store is None or not store.is_done(c.scheme, c.number)]
            names = tuple(dict.fromkeys(c.name for c in pending))
            stored = need_memory(self.plan, hosts, names, copies=copies)
            computed = opened.enter_context(hosts.computing(pending, stored))
            store = opened.enter_context(Store.create(out, layout)) if store is None else store
            done = Counter[str]()
            for chunk in sorted(set(chunks) - set(pending)):
                name = scheme_of[chunk.name]
                done[name] += chunk.size
                progress(name, done[name], 0)
            for chunk, values in computed:
                store.write(chunk.scheme, chunk.number, slice(chunk.start, chunk.stop), values)
                name = scheme_of[chunk.name]
                if chunk != told:
                    results(name, values)
                del values  # the chunk after the next one is started now
                done[name] += chunk.size
                progress(name, done[name], chunk.size)
            return store.dataset()

    def _as_begun(self, stored: Mapping[str, Value]) -> Sweep | None:
        """This sweep with the lanes and the chunk of a store, where they were left open.

        None where this sweep has them already, or the store has none that are allowed.
        """
        kept: dict[str, Value] = {n: stored.get(n) for n in CHOSEN if getattr(self, n) is None}
        if any(type(size) is not int or size < 1 for size in kept.values()):
            return None
        same = all(getattr(self.plan, name) == size for name, size in kept.items())
        return None if same else dataclasses.replace(self, **kept)

    def compile(self) -> None:
        """Compile the programs, for `run` and for other sweeps of these shapes in this process.

        It may be called in a thread while something else is computed.
        """
        for _ in self.host().chunk_bytes(tuple(self.plan.variants), self.plan.chunk):
            pass

    def host(self) -> Host:
        """This process, ready to compute chunks."""
        return Host(self.plan, shared=True)

    def machine_of(self, number: int) -> Machine:
        """One of the machines, rebuilt from its drawn numbers."""
        return self.population.machine_of(number)

    def key_of(self, number: int) -> jax.Array:
        """The key of one machine's noise, which does not depend on the chunks or their number."""
        return self.population.key_of(number)

    def bytes_stored(self) -> int:
        """Bytes of the whole dataset, before compression."""
        return self.plan.bytes_stored()

    def need_room(self, copies: int = 1) -> None:
        """Raises ValueError where `copies` of the dataset and its summary do not fit in RAM."""
        self.plan.need_room(copies)


def _silent(*of: object) -> None:
    """Nobody asked to be told."""


def _chunk_of(plan: Plan) -> int:
    """The number of machines that are computed and stored at a time where none is asked for."""
    least = max(CHUNK, plan.lanes * jax.device_count())
    light = HEAVY * len(plan.schemes) // plan.bytes_stored(least, points=1)
    return least * max(1, min(LARGEST, light, plan.members // (CHUNKS * least)))


def need_memory(plan: Plan, hosts: Host | Workers, names: tuple[str, ...], *, copies: int) -> int:
    """The bytes of `copies` of the dataset; a chunk of each variant is compiled, to check it fits.

    Raises ValueError where a chunk does not fit in RAM beside them. Where the size of the RAM is
    unknown, nothing is refused.
    """
    plan.need_room(copies)
    stored = copies * plan.bytes_stored()
    room, where = hosts.room(stored)
    for name, need in hosts.chunk_bytes(names, plan.chunk):
        if room is not None and need > room:
            instead = _that_fits(plan, hosts, name, need, room)
            raise capacity.refused(f"Sweep: chunk = {plan.chunk} takes", need, room, instead, where)
    return stored


def _that_fits(plan: Plan, hosts: Host | Workers, name: str, need: int, room: int) -> str:
    """What would fit where a chunk of a variant needs more bytes than there is room for."""
    # From two tiles on, the RAM of a chunk is linear in its size; a single tile needs less, since
    # there is no loop over tiles.
    tile, size = plan.lanes * hosts.environment["devices"], min(plan.chunk, plan.members)
    small = min(2 * tile, size)
    least = next(hosts.chunk_bytes((name,), small))[1] if small < size else need
    if least > room:
        fewer = f"a smaller chunk or fewer lanes than {plan.lanes}, " if plan.lanes > 1 else ""
        return (
            f"{small} machines at a time take {capacity.shown(least)} already; take {fewer}"
            "fewer trials or shorter ones, or keep fewer signals"
        )
    fits = int(small + (room - least) / (need - least) * (size - small)) // tile * tile
    return f"chunk = {fits} would fit"
