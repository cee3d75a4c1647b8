"""The RAM that a tuning takes, computed before anything is drawn or compiled."""

from __future__ import annotations

from typing import NamedTuple

import jax

from ..learning.known_metrics import bytes_of_metrics
from ..learning.machine import Machine
from ..runtime.capacity import check_size
from ..signals.task import Task
from ..uncertainty import Uncertainty, bytes_drawn, check

COPIES = 6  # of the record of each step: in the state, in its file, and while it is written


class Counts(NamedTuple):
    """The numbers that determine the RAM of a tuning.

    weights: number of weights
    The other fields are those of `Tuning`.
    """

    weights: int
    trials: int
    machines: int
    held_out: int
    lanes: int
    starts: int
    steps: int


def need_room(machine: Machine, uncertainty: Uncertainty, task: Task, counts: Counts) -> None:
    """Check that trials, machines, starts and steps fit in RAM.

    Raises ValueError, saying how many would fit, where they do not, and for an uncertainty that
    does not fit the machine.
    """
    check(machine, uncertainty)
    together = min(counts.lanes * jax.device_count(), counts.machines)
    of_a_trial = COPIES * bytes_of_metrics(task) * together

    def of_machines(machines: float, starts: float) -> float:
        drawn = bytes_drawn(machine, uncertainty, machines)
        return drawn + COPIES * 8 * (counts.weights + 1) * machines * starts

    def of_steps(starts: float, steps: float) -> float:
        return COPIES * 8 * (counts.weights + 4) * starts * (steps + 1)

    starts = counts.starts
    check_size("Tuning", lambda trials: of_a_trial * trials, trials=counts.trials)
    for name in ("machines", "held_out"):
        asked = {name: getattr(counts, name), "starts": starts}
        check_size("Tuning", lambda starts, **of: of_machines(sum(of.values()), starts), **asked)
    check_size("Tuning", of_steps, starts=starts, steps=counts.steps)
