"""What looks at each trial of a learning process beside the trial before it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

from ..pytree.aliases import Array, Tree
from ..schemes import Scheme
from ..signals.task import Task, Trial

if TYPE_CHECKING:
    from .machine import Machine


class Watched(NamedTuple):
    """A variable that a watch finds: whether there is one for each trial, its unit, its meaning."""

    of_trials: bool
    unit: str
    text: str


class Watch:
    """What looks at each trial beside the one before it, and keeps numbers but no signals.

    A metric knows one trial; how much smaller the error of a sample has become is seen in two. A
    subclass is a frozen dataclass: equal ones share a compiled program.
    """

    def variables(self, task: Task) -> dict[str, Watched]:
        """What is found, by name."""
        raise NotImplementedError

    def known(self, machine: Machine, scheme: Scheme, task: Task) -> Mapping[str, Array]:
        """Numbers () by name that are computed once, before the first trial."""
        raise NotImplementedError

    def continued(
        self,
        known: Mapping[str, Array],
        machine: Machine,
        scheme: Scheme,
        task: Task,
        memory: Tree,
    ) -> Mapping[str, Array]:
        """What is known of a run that goes on from a memory, maybe of another machine."""
        del machine, scheme, task, memory
        return known

    def seen(
        self, known: Mapping[str, Array], scheme: Scheme, before: Trial, trial: Trial
    ) -> Mapping[str, Array]:
        """Numbers () by name of a trial and the one before it.

        The first trial that `learn` runs has none before it; there `learn` keeps NaN.
        """
        raise NotImplementedError
