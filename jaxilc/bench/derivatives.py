"""A learning process of jaxilc to time: its run, as in a sweep, and its derivatives.

The derivatives are those of a step of `Tuning`, by the same program: errors are bounded, and value
and slope of each machine are computed in tiles. What an optimiser does with them takes no time
beside them and is left out.
"""

from __future__ import annotations

import dataclasses
import time
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

from ..learning.divergence import CEILING
from ..learning.machine import Machine
from ..learning.metrics import Keep
from ..learning.over_trials import learn
from ..learning.within_trial import bytes_of_trial
from ..runtime.capacity import check_program
from ..runtime.lanes import usual_lanes
from ..schemes import Scheme
from ..signals.task import Task, Trial
from ..sweeps.host import TRIALS_A_PASS
from ..tuning.descent import Evaluation
from ..tuning.losses import Losses
from ..tuning.machines import Machines
from ..tuning.objectives import Objective
from ..tuning.risks import Mean
from ..tuning.starts import over_starts
from ..tuning.weights import Weights
from ..uncertainty import Uncertainty
from .operations import of_a_trial

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

    machine, scheme, task, trials, uncertainty, objective, quantities: as for `Tuning`
    batch: the numbers of the machines and their drawn values, as `Machines.drawn` returns them
    """

    machine: Machine
    scheme: Scheme
    task: Task
    trials: int
    uncertainty: Uncertainty
    objective: Objective
    quantities: Mapping[str, Callable[[Trial], jax.Array]]
    batch: Any

    @property
    def machines(self) -> Machines:
        return machines_of(self.machine, self.uncertainty)

    def metrics(self) -> Program:
        """The metrics and quantities of all trials, without derivatives.

        Raises ValueError where the program does not fit into RAM.
        """
        save = Keep.of(self.quantities)

        def of_one(common, numbered):
            scheme, task = common
            machine, key = self.machines.one(numbered, SEED)
            as_swept: dict[str, Any] = {"save": save, "trials_a_pass": TRIALS_A_PASS}
            history = learn(machine, scheme, task, self.trials, key=key, **as_swept)
            return history.metrics, history.saved

        lanes = usual_lanes(bytes_of_trial(self.scheme, self.task)) or self.machines.lanes
        machines = dataclasses.replace(self.machines, lanes=lanes)
        return _built(machines.tiled(of_one, self.batch), (self.scheme, self.task), self.batch)

    def operations(self) -> Counter[str]:
        """The operations of one trial of the nominal machine, by kind, see `operations`."""
        save = Keep.of(self.quantities)

        def run(trials: int, machine: Machine, scheme: Scheme, task: Task):
            history = learn(machine, scheme, task, trials, save=save)
            return history.metrics, history.saved

        return of_a_trial(run, self.machine, self.scheme, self.task)

    def derivatives(self, weights: Weights, *, forward: bool) -> Program:
        """The `Evaluation` of the loss at the start of a tuning of these weights.

        forward: true for forward, false for reverse differentiation
        Raises ValueError where the program does not fit into RAM.
        """
        losses = Losses(
            machines=self.machines,
            weights=weights,
            scheme=self.scheme,
            task=self.task,
            trials=self.trials,
            risk=Mean(),
            mode="forward" if forward else "reverse",
            truncate=None,
            ceiling=CEILING,
            quantities=self.quantities,
        )
        lanes = losses.fitting_lanes(self.objective, len(self.batch[0]))
        losses = dataclasses.replace(
            losses, machines=dataclasses.replace(self.machines, lanes=lanes)
        )
        evaluate = losses.evaluation(self.objective, self.batch, SEED, clip=np.inf)
        return _built(over_starts(evaluate), weights.starts(1, 0.0, SEED))


def machines_of(machine: Machine, uncertainty: Uncertainty) -> Machines:
    """The set from which a tuning draws its machines, with its usual settings."""
    return Machines(machine, uncertainty, SEED, "sobol", usual_lanes() or 1, starts=1)


def of_each(found: Evaluation) -> np.ndarray:
    """(S, 1, 1+P) the loss of each machine and its slopes, from the `Evaluation` of one start."""
    both = np.concatenate([found.residuals[0][:, None], found.slopes[0]], axis=1)
    return len(both) ** 0.5 * both[:, None]


def _built(f: Callable, *arguments) -> Program:
    program, start = jax.jit(f), time.perf_counter()
    instead = "take fewer plants or trials, or a shorter trial"
    check_program("bench: one program", instead, program.lower(*arguments))
    built = time.perf_counter() - start
    return Program(lambda: jax.device_get(program(*arguments)), built)
