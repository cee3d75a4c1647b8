"""One process that computes the chunks of a sweep, on all its devices."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from ..learning.divergence import Course
from ..learning.known_metrics import METRICS
from ..learning.metrics import Keep
from ..learning.over_trials import learn
from ..runtime import capacity, provenance
from ..runtime.lanes import fitting_lanes
from ..runtime.tiles import tiled
from ..uncertainty import drawn_machine
from .plan import Chunk, Plan


class Host:
    """The process that computes the chunks of a plan: this one, or a worker of a cluster.

    environment: what the numbers depend on besides the plan, see `provenance.environment`
    """

    def __init__(self, plan: Plan):
        self.plan, self.environment = plan, provenance.environment()
        self._one = partial(
            _one_machine,
            names=tuple(plan.uncertainty.items()),
            trials=plan.trials,
            keep=plan.keep,
            save=Keep.of(plan.quantities),
        )
        self._run = jax.jit(tiled(self._one, lanes=plan.lanes))

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
        return capacity.program_bytes(self._run, *self._arguments(name, 0, size))

    def chunk_bytes(self, names: tuple[str, ...], size: int) -> Iterator[tuple[str, int]]:
        """Name and `bytes_of` of each scheme, one after another."""
        return ((name, self.bytes_of(name, size)) for name in names)

    def compute(self, chunk: Chunk) -> dict[str, np.ndarray]:
        """The metrics and signals of a chunk by name; the first axis is that of the machines."""
        found = self._run(*self._arguments(chunk.name, chunk.start, self.plan.chunk))
        return {name: np.asarray(value)[: chunk.size] for name, value in found.items()}

    def computed(self, chunks: list[Chunk]) -> Iterator[tuple[Chunk, dict[str, np.ndarray]]]:
        """Each chunk with the result of `compute`, one after another."""
        return ((chunk, self.compute(chunk)) for chunk in chunks)

    def _arguments(self, name: str, start: int, size: int):
        # The last chunk is filled up to full size with the last machine, so that it runs the same
        # program as the others.
        plan = self.plan
        index = np.minimum(np.arange(start, start + min(size, plan.machines)), plan.machines - 1)
        drawn = {name: jnp.asarray(values[index]) for name, values in plan.drawn.items()}
        common = (plan.machine, plan.schemes[name], plan.task, jax.random.key(plan.seed))
        return common, (jnp.asarray(index), drawn)


def _one_machine(
    common, one, *, names, trials: int, keep: tuple[str, ...], save: Keep
) -> dict[str, jax.Array]:
    """The metrics and signals of one drawn machine, for `tiled`."""
    machine, scheme, task, key = common
    index, values = one
    machine = drawn_machine(machine, dict(names), values)
    history = learn(machine, scheme, task, trials, key=jax.random.fold_in(key, index), save=save)
    by_channel = {m.name for m in METRICS if m.axes[-1:] in (("channel",), ("input",))} | {*keep}
    found = history.metrics._asdict() | {name: getattr(history.final, name) for name in keep}
    squeezed = {
        name: x[..., 0] if name in by_channel and x.shape[-1] == 1 else x
        for name, x in found.items()
    }
    return squeezed | history.saved | {name: getattr(history, name) for name in Course._fields}
