"""What every design is asked, and the steps that a design and the learning of a law share."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import jax
import numpy as np

from ..learning.machine import Machine
from ..pytree.ranges import require
from ..schemes import Scheme
from ..signals.task import Task, Trial
from ..sweeps import Sweep
from ..sweeps.summary import summarise
from ..uncertainty import Population, Uncertainty
from .candidates import Absent, Candidate, candidates
from .judging import Verdict, judged_trials, verdict
from .responses import Family, designed_on, family_of

Told = Callable[[str, object], object]


@dataclasses.dataclass(frozen=True)
class Question:
    """An uncertain machine, its task, and how a law for it is judged.

    machine, task, trials, uncertainty: as for `Sweep`; a `Population` may stand for the machine
    feedback: under which the machine learns, None for none
    metric: by which a law is judged
    margin: least distance of |Q (1 - L P)| from 1 on every machine, in (0, 1)
    machines: of the sweep that judges
    quantities: further metrics of a trial by name, as for `Tuning`
    highest: largest cutoff that is looked for [Hz]
    seed: of everything drawn: families have `seed`, `seed` + 3 and those from `seed` + 4 on,
        tunings `seed` and `seed` + 1, and the machines that judge `seed` + 2
    """

    machine: Machine | Population
    task: Task
    trials: int
    uncertainty: Uncertainty
    feedback: Scheme | None = None
    metric: str = "settled_error"
    margin: float = 0.05
    machines: int = 257
    seed: int = 0
    highest: float = np.inf
    quantities: Mapping[str, Callable[[Trial], jax.Array]] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        owner = type(self).__name__
        require(owner, "margin", self.margin, "(0, 1)")
        for name in ("trials", "machines"):
            require(owner, name, getattr(self, name), "[2, inf)", whole=True)

    def family(self) -> Family:
        """The responses of machines drawn with the seed; see `family_of`."""
        population = designed_on(self.machine, self.uncertainty, seed=self.seed)
        family = family_of(population, self.feedback, self.task)
        return family._replace(highest=self.highest)

    def safe(
        self, family: Family, names: Sequence[str], told: Told
    ) -> tuple[list[Candidate], list[Absent]]:
        """The laws of a few weights with safe ones, and those that have none; each is told."""
        tried: list[Candidate | Absent] = []
        for one in candidates(
            family, self.feedback, self.task, self.trials, self.margin, tuple(names)
        ):
            told("safe", one)
            tried.append(one)
        found = [one for one in tried if isinstance(one, Candidate)]
        return found, [one for one in tried if isinstance(one, Absent)]

    def swept(
        self,
        laws: Sequence[Candidate],
        store: Path,
        *,
        resume: bool,
        tolerance: float | None = None,
    ) -> list[Verdict]:
        """The verdicts on laws by a sweep over machines that nothing else has seen."""
        schemes = {law.name: law.scheme for law in laws}
        dataset = Sweep(
            self.machine, schemes, self.task, judged_trials(self.trials), self.uncertainty,
            machines=self.machines, seed=self.seed + 2, quantities=self.quantities,
        ).run(store, resume=resume and store.exists())  # fmt: skip
        summaries = summarise(dataset, tolerance, metric=self.metric)
        return [
            verdict(law, summary, self.trials, tolerance)
            for law, summary in zip(laws, summaries, strict=True)
        ]
