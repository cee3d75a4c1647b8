"""What a tuning takes of memory, reckoned before anything is drawn or compiled."""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax

from ..learning.over_trials import bytes_of_figures
from ..runtime.capacity import check_size
from ..uncertainty import bytes_drawn, check

if TYPE_CHECKING:
    from .problem import Tuning

COPIES = 6  # of what is kept of each step: in the state, in its file, on the way there


def need_room(problem: Tuning) -> None:
    """Raises ValueError, with what would fit, where trials, plants, starts or steps do not, and for
    an uncertainty that does not fit the machine."""
    check(problem.machine, problem.uncertainty)
    weights = len(problem.start)
    together = min(problem.lanes * jax.device_count(), problem.samples)
    of_a_trial = COPIES * bytes_of_figures(problem.task) * together

    def of_plants(plants: float, starts: float) -> float:
        drawn = bytes_drawn(problem.machine, problem.uncertainty, plants)
        return drawn + COPIES * 8 * (weights + 1) * plants * starts

    def of_steps(starts: float, steps: float) -> float:
        return COPIES * 8 * (weights + 4) * starts * (steps + 1)

    starts = problem.starts
    check_size("Tuning", lambda trials: of_a_trial * trials, trials=problem.trials)
    for name in ("samples", "held_out"):
        counts = {name: getattr(problem, name), "starts": starts}
        check_size("Tuning", lambda starts, **of: of_plants(sum(of.values()), starts), **counts)
    check_size("Tuning", of_steps, starts=starts, steps=problem.steps)
