"""The RAM that a tuning takes, computed before anything is drawn or compiled."""

from __future__ import annotations

from typing import NamedTuple

import jax

from ..learning.known_metrics import bytes_of_metrics
from ..learning.machine import Machine
from ..runtime.capacity import check_size
from ..signals.task import Task
from ..uncertainty import Uncertainty, bytes_drawn, check

COPIES = 6  # of what is kept of each step: in the state, in its file, and on the way to the file


class Counts(NamedTuple):
    """How much of everything a tuning has. weights: how many;  the others: see `Tuning`"""

    weights: int
    trials: int
    machines: int
    held_out: int
    lanes: int
    starts: int
    steps: int


def need_room(machine: Machine, uncertainty: Uncertainty, task: Task, counts: Counts) -> None:
    """Raises ValueError where trials, machines, starts or steps do not fit in RAM, with how many
    would fit, and for an uncertainty that does not fit the machine.
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
