"""Monte-Carlo sweeps: schemes against many uncertain machines, chunk by chunk into a labelled
dataset.
"""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing, nullcontext
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..learning.divergence import Course
from ..learning.machine import Machine
from ..learning.metrics import Keep
from ..learning.over_trials import check, learn
from ..pytree.ranges import SEEDS, brief, require
from ..runtime import capacity, provenance
from ..runtime.provenance import describe
from ..runtime.tiles import OPEN, tiled, usual_lanes
from ..schemes import Scheme
from ..signals.task import Task, Trial
from ..uncertainty import Uncertainty, draw, drawn_machine, drawn_samples
from .store import Layout, Store, Variable

if TYPE_CHECKING:
    import xarray as xr
    from distributed import Client

SIGNALS = {"y": ("time", "channel"), "e": ("time", "channel"), "u": ("input_time", "input")}
CHUNK = 256
WORK = 4  # arrays as large as a figure of all samples and trials, to find and draw its quantiles


@dataclasses.dataclass(frozen=True)
class Sweep:
    """A sweep, fully specified: run it with `run`.

    machine, task, trials: as for `learn`;  schemes: by name
    uncertainty: distributions on the machine's named leaves;  samples, seed, sampling: see
    `uncertainty.draw`
    keep: signals of the last trial to store, any of y, e, u (they are large)
    chunk: samples computed and stored at a time, None for 256, or a tile on each device if that is
    more
    quantities: further figures of each trial, by name, each a function of a trial to a number
    lanes: samples vectorised together, None for what suits this backend, see `batch.tiled`; chunk,
    lanes and the number of devices belong to the configuration, since sums in another order round
    otherwise
    Raises ValueError, before anything is compiled or written, naming what does not fit.
    """

    machine: Machine
    schemes: Mapping[str, Scheme]
    task: Task
    trials: int
    uncertainty: Uncertainty
    samples: int = 1024
    seed: int = 0
    sampling: str = "monte-carlo"
    keep: tuple[str, ...] = ()
    chunk: int = OPEN
    lanes: int = OPEN
    quantities: Mapping[str, Callable[[Trial], jax.Array]] = dataclasses.field(default_factory=dict)

    def __post_init__(self):
        object.__setattr__(self, "lanes", usual_lanes() if self.lanes is None else self.lanes)
        require("Sweep", "lanes", self.lanes, "[1, inf)", whole=True)
        object.__setattr__(
            self,
            "chunk",
            max(CHUNK, self.lanes * jax.device_count()) if self.chunk is None else self.chunk,
        )
        for name in ("trials", "samples", "chunk"):
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
                f"Sweep: schemes = {brief(self.schemes)} is a {type(self.schemes).__name__}; allowed are schemes by name, "
                "such as {'name': scheme}"
            )
        if not self.schemes:
            raise ValueError("Sweep: schemes is empty; at least one is needed")
        Keep.of(self.quantities)
        for scheme in self.schemes.values():
            check(self.machine, scheme, self.task)
        self.need_room()
        object.__setattr__(
            self, "samples", len(next(iter(self.drawn.values()))) if self.drawn else self.samples
        )

    @cached_property
    def drawn(self) -> dict[str, np.ndarray]:
        """(samples,) drawn numbers by the leaf's name."""
        return draw(
            self.machine, self.uncertainty, self.samples, seed=self.seed, sampling=self.sampling
        )

    def configuration(self, environment: dict[str, Any] | None = None) -> dict[str, Any]:
        """All that determines the numbers, as JSON.  environment: of the processes that compute,
        None for this one
        """
        fields = {f.name: describe(getattr(self, f.name)) for f in dataclasses.fields(self)}
        return fields | {"environment": environment or provenance.environment()}

    def run(
        self,
        out: str | Path | None = None,
        *,
        resume: bool = False,
        progress: Callable[[str, int, int], None] | None = None,
        cluster: str | Path | Client | None = None,
    ) -> xr.Dataset:
        """Run what is not done yet and return the dataset (dims scheme, sample, trial; coordinates
        carry every drawn number).

        out: where to keep it as a Zarr store, None for memory only;  resume: go on with the store
        at `out`
        progress: called after each chunk with the scheme's name, its samples done so far and how
        many of them this call computed
        cluster: a Dask scheduler whose workers compute the chunks, as its address, the file it
        wrote, or a Client; see `cluster.workers` Killed at any moment, a resumed run ends with the
        dataset of an uninterrupted one, bit for bit; what is damaged in the store is computed
        again. Raises FileExistsError for an `out` that exists without `resume`, ValueError for one
        that is in use, is no store,
        or was made with another configuration, and, before anything is written, for a chunk or a
        dataset larger than the memory there is, with what would fit. On a cluster also
        `cluster.ChunkFailed`, for a chunk that no worker could compute.
        """
        if cluster is None:
            computing = nullcontext(self.host())
        else:
            from .cluster import workers

            computing = workers(self, cluster)
        with computing as hosts:
            return self._run(hosts, out, resume, progress or (lambda name, done, fresh: None))

    def _run(
        self, hosts, out: str | Path | None, resume: bool, progress: Callable[[str, int, int], None]
    ) -> xr.Dataset:
        layout = Layout(
            self._variables(),
            self._coordinates(),
            self.chunk,
            self.configuration(hosts.environment),
        )
        found = out is not None and Path(out).exists()
        if found and not resume:
            raise FileExistsError(f"{out} exists already; resume it or choose another place")
        chunks = [
            Chunk(i, name, number, start, min(start + self.chunk, self.samples))
            for i, name in enumerate(self.schemes)
            for number, start in enumerate(range(0, self.samples, self.chunk))
        ]
        with ExitStack() as opened:
            store = opened.enter_context(Store.resume(out, layout)) if found else None
            pending = [c for c in chunks if store is None or not store.is_done(c.scheme, c.number)]
            self._need_memory(
                hosts, tuple(dict.fromkeys(c.name for c in pending)), copies=2 if out is None else 1
            )
            store = opened.enter_context(Store.create(out, layout)) if store is None else store
            done = Counter()
            for chunk in sorted(set(chunks) - set(pending)):
                done[chunk.name] += chunk.size
                progress(chunk.name, done[chunk.name], 0)
            with closing(hosts.computed(pending)) as finished:
                for chunk, values in finished:
                    store.write(chunk.scheme, chunk.number, slice(chunk.start, chunk.stop), values)
                    done[chunk.name] += chunk.size
                    progress(chunk.name, done[chunk.name], chunk.size)
            return store.dataset()

    def host(self) -> Host:
        """This process, ready to compute chunks."""
        return Host(self)

    def machine_of(self, sample: int) -> Machine:
        """The machine of one sample, rebuilt from its drawn numbers."""
        return drawn_machine(
            self.machine,
            self.uncertainty,
            {name: values[sample] for name, values in self.drawn.items()},
        )

    def key_of(self, sample: int) -> jax.Array:
        """The key of one sample's noise: it does not depend on chunks or on the number of samples."""
        return jax.random.fold_in(jax.random.key(self.seed), sample)

    def bytes_stored(self, samples: float | None = None, trials: float | None = None) -> int:
        """Bytes of the whole dataset, before compression. samples, trials: None for those of this
        sweep
        """
        sizes: dict[str, Any] = {
            "scheme": len(self.schemes),
            "channel": self.task.outputs,
            "input": self.task.inputs,
        }
        sizes |= {
            "sample": self.samples if samples is None else samples,
            "trial": self.trials if trials is None else trials,
        }
        sizes |= {"time": self.task.N + 1, "input_time": self.task.N}
        return sum(
            np.dtype(v.dtype).itemsize * math.prod(sizes[d] for d in v.dims)
            for v in self._variables().values()
        )

    def need_room(self, copies: int = 1) -> None:
        """Raises ValueError, with how many samples or trials would fit, where so many copies of the
        dataset and its summary do not.
        """
        drawn, summary = 8 * len(self.uncertainty), 8 * WORK * len(self.schemes) * self.task.outputs

        def need(samples: float, trials: float) -> float:
            return (
                copies * self.bytes_stored(samples, trials)
                + drawn * samples
                + summary * samples * trials
                + 8 * trials
            )

        capacity.check_size(
            "Sweep",
            need,
            samples=drawn_samples(self.uncertainty, self.samples, self.sampling),
            trials=self.trials,
        )

    def _need_memory(self, hosts, names: tuple[str, ...], *, copies: int) -> None:
        """Compile a chunk of each scheme; ValueError where it does not fit beside `copies` of the
        dataset. Unknown memory is enough.
        """
        self.need_room(copies)
        room, where = hosts.room(copies * self.bytes_stored())
        for name, need in hosts.chunk_bytes(names, self.chunk):
            if room is not None and need > room:
                raise ValueError(
                    f"Sweep: chunk = {self.chunk} needs {capacity.shown(need)} where {capacity.shown(room)} are available{where}; "
                    f"{self._that_fits(hosts, name, need, room)}"
                )

    def _that_fits(self, hosts, name: str, need: int, room: int) -> str:
        # what a chunk needs is a line in its size, from two tiles on; one tile needs no loop over
        # them
        tile, size = self.lanes * hosts.environment["devices"], min(self.chunk, self.samples)
        small = min(2 * tile, size)
        least = next(hosts.chunk_bytes((name,), small))[1] if small < size else need
        if least > room:
            return f"{small} samples at a time need {capacity.shown(least)} already; keep fewer signals, take fewer trials, or shorten them"
        return f"chunk = {int(small + (room - least) / (need - least) * (size - small)) // tile * tile} would fit"

    def _variables(self) -> dict[str, Variable]:
        channel = ("channel",) if self.task.outputs > 1 else ()
        inputs = ("input",) if self.task.inputs > 1 else ()
        per_trial, real = ("scheme", "sample", "trial"), "f8" if jax.config.jax_enable_x64 else "f4"
        unit, input_unit = self.task.unit, self.task.input_unit
        variables = {
            "max_error": Variable(per_trial + channel, real, unit, "largest error of a trial"),
            "rms": Variable(per_trial + channel, real, unit, "root mean square error of a trial"),
            "settled_error": Variable(
                per_trial + channel, real, unit, "largest error in the settled window of a trial"
            ),
            "effort": Variable(
                per_trial + inputs, real, input_unit, "root mean square input of a trial"
            ),
            "finite": Variable(per_trial, "bool", "", "whether the trial stayed finite"),
            "diverged": Variable(
                per_trial,
                "bool",
                "",
                "whether the trial diverged: not finite, or an error far beyond the reference",
            ),
            "diverged_at": Variable(
                ("scheme", "sample"), "i4", "", "first trial that diverged, 0 if none"
            ),
            "grown_from": Variable(
                ("scheme", "sample"),
                "i4",
                "",
                "trial from which on the rms error stays far above its least, or 0",
            ),
        }
        variables |= {
            name: Variable(per_trial, real, "", "figure of a trial") for name in self.quantities
        }
        for name in self.keep:
            time, dim = SIGNALS[name]
            dims = ("scheme", "sample", time) + (
                (dim,) if (inputs if name == "u" else channel) else ()
            )
            variables[name] = Variable(
                dims, real, input_unit if name == "u" else unit, f"{name} of the last trial"
            )
        return variables

    def _coordinates(self) -> dict[str, tuple]:
        coordinates = {
            "scheme": (("scheme",), np.array(list(self.schemes))),
            "sample": (("sample",), np.arange(self.samples)),
            "trial": (("trial",), np.arange(1, self.trials + 1)),
            "channel": (("channel",), np.arange(self.task.outputs)),
            "input": (("input",), np.arange(self.task.inputs)),
            "time": (("time",), self.task.time),
            "input_time": (("input_time",), self.task.time[:-1]),
        }
        used = {d for v in self._variables().values() for d in v.dims}
        return {n: c for n, c in coordinates.items() if n in used} | {
            n: (("sample",), v) for n, v in self.drawn.items()
        }


class Chunk(NamedTuple):
    """Samples of one scheme that are computed and stored together.

    scheme: the scheme's place in the sweep;  name: its name;  number: of the chunk;  start, stop:
    its samples
    """

    scheme: int
    name: str
    number: int
    start: int
    stop: int

    @property
    def size(self) -> int:
        return self.stop - self.start


class Host:
    """This process as the one that computes a sweep's chunks, on all its devices. Each worker of a
    cluster has one as well.
    """

    def __init__(self, sweep: Sweep):
        plan = {
            "names": tuple(sweep.uncertainty.items()),
            "trials": sweep.trials,
            "keep": sweep.keep,
            "save": Keep.of(sweep.quantities),
        }
        self.sweep = sweep
        self.environment = provenance.environment()
        self._run = jax.jit(tiled(partial(_one_sample, **plan), lanes=sweep.lanes))

    def room(self, stored: int) -> tuple[int | None, str]:
        """Bytes there are for a chunk beside a dataset of `stored` bytes, None if unknown, and
        where that is.
        """
        host, device = capacity.host_bytes(), capacity.device_bytes()
        return (device if device is not None else None if host is None else host - stored), ""

    def bytes_of(self, name: str, size: int) -> int:
        """Bytes that `size` samples of a scheme take; they are compiled, not run."""
        return capacity.program_bytes(self._run, *self._arguments(name, 0, size))

    def chunk_bytes(self, names: tuple[str, ...], size: int) -> Iterator[tuple[str, int]]:
        """Name and `bytes_of` of each scheme, one after another."""
        return ((name, self.bytes_of(name, size)) for name in names)

    def compute(self, chunk: Chunk) -> dict[str, np.ndarray]:
        """The figures of a chunk, each with its samples first."""
        figures = self._run(*self._arguments(chunk.name, chunk.start, self.sweep.chunk))
        return {name: np.asarray(value)[: chunk.size] for name, value in figures.items()}

    def computed(self, chunks: list[Chunk]) -> Iterator[tuple[Chunk, dict[str, np.ndarray]]]:
        """Each chunk with its figures, one after another."""
        return ((chunk, self.compute(chunk)) for chunk in chunks)

    def _arguments(self, name: str, start: int, size: int):
        # the last chunk is filled up to full size with its last sample, so that it runs the same
        # program as the others
        sweep = self.sweep
        index = np.minimum(np.arange(start, start + min(size, sweep.samples)), sweep.samples - 1)
        batch = (
            jnp.asarray(index),
            {name: jnp.asarray(values[index]) for name, values in sweep.drawn.items()},
        )
        return (sweep.machine, sweep.schemes[name], sweep.task, jax.random.key(sweep.seed)), batch


def _one_sample(
    common, one, *, names, trials: int, keep: tuple[str, ...], save: Keep
) -> dict[str, jax.Array]:
    """The figures of one sample plant: what `tiled` runs."""
    machine, scheme, task, key = common
    index, values = one
    machine = drawn_machine(machine, dict(names), values)
    history = learn(machine, scheme, task, trials, key=jax.random.fold_in(key, index), save=save)
    figures = history.metrics._asdict() | {name: getattr(history.final, name) for name in keep}
    squeezed = {
        name: x[..., 0] if name != "finite" and x.shape[-1] == 1 else x
        for name, x in figures.items()
    }
    return squeezed | history.saved | {name: getattr(history, name) for name in Course._fields}
