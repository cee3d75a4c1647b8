"""What jaxilc computes in `make bench`: a learning process as in a sweep, and its derivatives.

The derivatives are those of a step of `Tuning`, by the same program: errors are bounded, and value
and slope of each machine are computed in tiles. What an optimiser does with them takes no time
beside them and is left out. A scheme without opponents is timed alone, beside the cost of its
operations.
"""

from __future__ import annotations

import dataclasses
import os
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple

import jax
import numpy as np
from contests import SPREAD, sinusoid
from operations import cost, of_a_trial
from timing import OURS, Entry, Row, in_turns

from jaxilc import scenarios
from jaxilc.learning.known_metrics import bytes_of_metrics
from jaxilc.learning.machine import Machine
from jaxilc.learning.metrics import Keep
from jaxilc.learning.over_trials import learn
from jaxilc.learning.within_trial import bytes_of_trial
from jaxilc.native.program import Unknown
from jaxilc.plants import StateSpace
from jaxilc.pytree.named_paths import get_at, interval_at, named_leaves
from jaxilc.runtime.capacity import check_program, check_size
from jaxilc.runtime.lanes import usual_lanes
from jaxilc.runtime.start import NATIVE
from jaxilc.runtime.tiles import tiled
from jaxilc.scenarios import Scenario
from jaxilc.scenarios.xu_2024 import MODEL
from jaxilc.schemes import NormOptimal, Scheme
from jaxilc.signals.task import Task, Trial
from jaxilc.sweeps.host import TRIALS_A_PASS
from jaxilc.tuning import Tuning
from jaxilc.tuning.descent import Evaluation, over_starts
from jaxilc.tuning.objectives import Final, Objective
from jaxilc.tuning.weights import Weights
from jaxilc.uncertainty import Population, Uncertainty, Uniform

SEED = 0


class Program(NamedTuple):
    """A compiled program without arguments.

    run: function that runs it and returns its numbers
    built: time to compile it [s]
    """

    run: Callable[[], Any]
    built: float


@dataclasses.dataclass(frozen=True, eq=False)
class Learning:
    """A learning process of S machines whose weights a tuning could move.

    population, scheme, task, trials, objective, quantities: as for `Tuning`
    """

    population: Population
    scheme: Scheme
    task: Task
    trials: int
    objective: Objective
    quantities: Mapping[str, Callable[[Trial], jax.Array]]

    def metrics(self) -> Program:
        """The metrics and quantities of all trials, without derivatives.

        Raises ValueError where the program does not fit into RAM.
        """
        save = Keep.of(self.quantities)

        def of_one(common, numbered):
            scheme, task = common
            machine, key = self.population.one_of(numbered)
            as_swept: dict[str, Any] = {"save": save, "trials_a_pass": TRIALS_A_PASS}
            history = learn(machine, scheme, task, self.trials, key=key, **as_swept)
            return history.metrics, history.saved

        lanes = usual_lanes(bytes_of_trial(self.scheme, self.task)) or 1
        common, batch = (self.scheme, self.task), self.population.batch()
        return _built(tiled(of_one, lanes=lanes), common, batch)

    def operations(self) -> Counter[str]:
        """The operations of one trial of the nominal machine, by kind, see `operations`."""
        save = Keep.of(self.quantities)

        def run(trials: int, machine: Machine, scheme: Scheme, task: Task):
            history = learn(machine, scheme, task, trials, save=save)
            return history.metrics, history.saved

        return of_a_trial(run, self.population.machine, self.scheme, self.task)

    def derivatives(self, weights: Weights, *, forward: bool, native: bool = False) -> Program:
        """The `Evaluation` of the loss at the start of a tuning of these weights.

        forward: true for forward, false for reverse differentiation
        native: whether a program compiled for this processor computes it
        Raises ValueError where the program does not fit into RAM, Unknown where none can be
        compiled.
        """
        asked = Tuning(
            self.population, self.scheme, self.task, self.trials,
            {name: (of.low, of.high) for name, of in weights.bijections.items()},
            objective=self.objective, quantities=self.quantities, held_out=0, steps=1, clip=np.inf,
            mode="forward" if forward else "reverse",
        )  # fmt: skip
        vars(asked)["population"] = self.population  # it would draw machines where some are given
        with _wanted(native):
            evaluate, compiled = asked.evaluation
        if native and not compiled:
            raise Unknown("a gradient that XLA computes")
        return _built(over_starts(evaluate), weights.starts(1, 0.0, SEED))


def drawn(machine: Machine, uncertainty: Uncertainty, machines: int) -> Population:
    """Machines as a tuning draws them."""
    return Population(machine, uncertainty, count=machines, seed=SEED, sampling="sobol")


def of_each(found: Evaluation) -> np.ndarray:
    """(S, 1, 1+P) the loss of each machine and its slopes, from the `Evaluation` of one start."""
    both = np.concatenate([found.residuals[0][:, None], found.slopes[0]], axis=1)
    return len(both) ** 0.5 * both[:, None]


@contextmanager
def _wanted(native: bool) -> Iterator[None]:
    """Let programs be compiled for this processor, or by XLA."""
    before = os.environ.get(NATIVE)
    os.environ[NATIVE] = "on" if native else "off"
    try:
        yield
    finally:
        os.environ.pop(NATIVE)
        if before is not None:
            os.environ[NATIVE] = before


def _built(f: Callable, *arguments) -> Program:
    program, start = jax.jit(f), time.perf_counter()
    instead = "take fewer plants or trials, or a shorter trial"
    check_program("bench: one program", instead, program.lower(*arguments))
    built = time.perf_counter() - start
    return Program(lambda: jax.device_get(program(*arguments)), built)


# Alone
# --------------------------------------------------------------------------------------------------

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
            chosen = scenarios.load("milc-2024", reading="long-stroke")
            dilc: Any = chosen.schemes["dilc"]
            plant = dilc.learning.scheme.model
            scheme = NormOptimal(plant, w_q=1.0, w_r=1e-4, w_s=1e-3)
            task = Task(sinusoid(2000, plant.dt), dt=plant.dt)
        case "ilc-asmc":
            chosen = scenarios.load("xu-2024", reading="small-gain")
            plant = StateSpace(
                [[0.0, 1.0], [-MODEL["a1"], -MODEL["a2"]]], [[0.0], [MODEL["b"]]], [[1.0, 0.0]]
            )
            scheme = chosen.schemes["ilc-asmc"]
            task = Task(20 * sinusoid(2000, chosen.task.dt), dt=chosen.task.dt)
        case _:
            raise ValueError(f"bench: scheme = {name!r} is not one of {', '.join(ALONE)}")
    machine, gain = Machine(plant), {"plant.B": Uniform(1 - SPREAD, 1 + SPREAD, relative=True)}
    learning = Learning(drawn(machine, gain, plants), scheme, task, 10, Final("rms"), {})
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
        drawn(chosen.machine, chosen.uncertainty, machines),
        schemes_of(chosen)[name],
        chosen.task,
        chosen.trials,
        Final(chosen.judged_by),
        chosen.functions,
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

    population = drawn(chosen.machine, chosen.uncertainty, machines)

    def need(machines: float) -> float:
        return population.bytes_drawn(machines) + COPIES * of_trials * machines

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


def _may_move(of: Learning, name: str) -> bool:
    """Whether a tuning may move a leaf alone, as not one of shares that have a sum."""
    try:
        Weights.of(of.scheme, (name,)).need_room(of.population.machine, of.scheme, of.task)
    except ValueError:
        return False
    return True


def _times(of: Learning, gradients: bool, repeats: int) -> Alone:
    shape, results = (of.population.size, of.trials, of.task.N), {}
    run = of.metrics()
    entries = {OURS: Entry(run.run, *shape, run.built)}
    weights: tuple[str, ...] = ()
    if gradients and (names := [x for x in tunable(of.scheme) if _may_move(of, x)]):
        by = Weights.of(of.scheme, names)
        gradient, weights = of.derivatives(by, forward=False), tuple(by.start)
        entries[GRADIENT] = Entry(gradient.run, *shape, gradient.built)

    def not_compared(found: Mapping[str, Any]) -> dict[str, None]:
        results.update(found)
        return dict.fromkeys(found)

    rows = in_turns(entries, repeats=repeats, agreement=not_compared)
    limit = 1e9 * cost(of.operations()) / of.task.N
    return Alone(rows, limit, weights, int(results[GRADIENT].dropped[0]) if weights else 0)
