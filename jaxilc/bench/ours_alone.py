"""The time of jaxilc without opponents: of a scheme's learning process, and of its gradient."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from .. import scenarios
from ..learning.known_metrics import bytes_of_metrics
from ..learning.machine import Machine
from ..plants import StateSpace
from ..pytree.named_paths import get_at, interval_at, named_leaves
from ..runtime.capacity import check_size
from ..scenarios import Scenario
from ..scenarios.xu_2024 import MODEL
from ..schemes import NormOptimal, Scheme
from ..signals.task import Task
from ..tuning.objectives import Final
from ..tuning.weights import Weights
from ..uncertainty import Uniform, bytes_drawn
from .derivatives import SEED, Learning, machines_of
from .operations import cost
from .settings import SPREAD, sinusoid
from .timing import OURS, Entry, Row, in_turns

ALONE = ("noilc", "ilc-asmc")
GRADIENT = "gradient"
COPIES = 3  # of the metrics: on the devices, without the machines that fill tiles, on the host


class Alone(NamedTuple):
    """The times of one scheme.

    rows: the row of its run, `OURS`, and that of its reverse gradient, `GRADIENT`, where asked for
    limit: what its operations alone would cost, see `operations` [ns per sample-step]
    weights: names of the weights by which the gradient is; without weights there is no gradient
    dropped: number of machines whose slopes are not finite
    """

    rows: dict[str, Row]
    limit: float
    weights: tuple[str, ...] = ()
    dropped: int = 0


def alone(name: str, plants: int, *, gradients: bool = True, repeats: int = 5) -> Alone:
    """The times of one scheme in ten trials of 2000 samples.

    The names are:

    noilc       norm-optimal learning by the Riccati recursion on the drive of MILC 2024, with 10 %
                model error
    ilc-asmc    the scheme of Xu 2024 on its identified model

    Raises ValueError for another name.
    """
    match name:
        case "noilc":
            chosen = scenarios.load("milc-2024")
            dilc: Any = chosen.schemes["dilc"]
            plant = dilc.learning.scheme.model
            scheme = NormOptimal(plant, w_q=1.0, w_r=1e-4, w_s=1e-3)
            task = Task(sinusoid(2000, plant.dt), dt=plant.dt)
        case "ilc-asmc":
            chosen = scenarios.load("xu-2024")
            plant = StateSpace(
                [[0.0, 1.0], [-MODEL["a1"], -MODEL["a2"]]], [[0.0], [MODEL["b"]]], [[1.0, 0.0]]
            )
            scheme = chosen.schemes["ilc-asmc"]
            task = Task(20 * sinusoid(2000, chosen.task.dt), dt=chosen.task.dt)
        case _:
            raise ValueError(f"bench: scheme = {name!r} is not one of {', '.join(ALONE)}")
    machine, gain = Machine(plant), {"plant.B": Uniform(1 - SPREAD, 1 + SPREAD, relative=True)}
    batch = machines_of(machine, gain).drawn(SEED, plants, nominal=True)
    learning = Learning(machine, scheme, task, 10, gain, Final("rms"), {}, batch)
    return _times(learning, gradients, repeats)


def of_scenario(
    chosen: Scenario, name: str, machines: int, *, gradients: bool = True, repeats: int = 5
) -> Alone:
    """The times of one scheme of a scenario, in the size of the scenario.

    The machines have the uncertainty of the scenario, and the gradient is that of the metric by
    which the scenario is judged.

    Raises ValueError where the machines do not fit into RAM, and as `schemes_of` does.
    """
    need_room(chosen, machines)
    learning = Learning(
        chosen.machine,
        schemes_of(chosen)[name],
        chosen.task,
        chosen.trials,
        chosen.uncertainty,
        Final(chosen.judged_by),
        chosen.functions,
        machines_of(chosen.machine, chosen.uncertainty).drawn(SEED, machines, nominal=True),
    )
    return _times(learning, gradients, repeats)


def schemes_of(chosen: Scenario) -> dict[str, Scheme]:
    """The schemes of a scenario that learn, by name; raises ValueError where there is none."""
    learning = {name: scheme for name, scheme in chosen.schemes.items() if scheme.learns}
    if not learning:
        raise ValueError(f"bench: {chosen.name} has no scheme that learns")
    return learning


def need_room(chosen: Scenario, machines: int) -> None:
    """Raises ValueError where the metrics of all trials of all machines do not fit into RAM."""
    of_trials = (bytes_of_metrics(chosen.task) + 8 * len(chosen.quantities)) * chosen.trials

    def need(machines: float) -> float:
        drawn = bytes_drawn(chosen.machine, chosen.uncertainty, machines)
        return drawn + COPIES * of_trials * machines

    check_size(f"bench: {chosen.name}", need, machines=machines)


def tunable(scheme: Scheme) -> tuple[str, ...]:
    """The leaves by which the gradient of a scheme is timed.

    They are those that are numbers or vectors and lie inside their ranges; a matrix belongs to
    a model.
    """
    return tuple(
        name
        for name, value in named_leaves(scheme).items()
        if np.ndim(value) <= 1 and np.size(value) and _inside(scheme, name)
    )


def _inside(scheme: Scheme, name: str) -> bool:
    allowed, value = interval_at(scheme, name), np.asarray(get_at(scheme, name))
    if allowed is None:
        return False
    return bool(np.all((allowed.low < value) & (value < allowed.high)))


def _times(of: Learning, gradients: bool, repeats: int) -> Alone:
    shape, results = (len(of.batch[0]), of.trials, of.task.N), {}
    run = of.metrics()
    entries = {OURS: Entry(run.run, *shape, run.built)}
    names, weights = tunable(of.scheme) if gradients else (), ()
    if names:
        by = Weights.of(of.scheme, names)
        gradient, weights = of.derivatives(by, forward=False), tuple(by.start)
        entries[GRADIENT] = Entry(gradient.run, *shape, gradient.built)

    def not_compared(found: Mapping[str, Any]) -> dict[str, None]:
        results.update(found)
        return dict.fromkeys(found)

    rows = in_turns(entries, repeats=repeats, agreement=not_compared)
    limit = 1e9 * cost(of.operations()) / of.task.N
    return Alone(rows, limit, weights, int(results[GRADIENT].dropped[0]) if weights else 0)
