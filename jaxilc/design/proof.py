"""What theory says of the law that a design recommends."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..learning.machine import Machine
from ..schemes import Scheme
from ..signals.task import Task
from ..theory.by_frequency import largest_of
from ..theory.certificates import DIVERGES, long_run
from ..theory.law import law_of
from ..theory.loop import minimal
from ..theory.over_frequency import lines
from ..uncertainty import Uncertainty, drawn_machines
from .responses import Family

ENCLOSED = 4  # of the worst machines by the grid of frequencies; the nominal one besides


class Proof(NamedTuple):
    """The frequency test of a law, enclosed over all frequencies, and two certificates.

    nominal: sup |Q (keep - L P)| of the nominal machine
    worst:   the same of the worst machine of the family
    at:      the frequency at which it is worst [Hz]
    machine: {name: number} of the worst machine
    machines: number of machines of the family
    claims:  of the nominal and of the worst machine, of `theory.CLAIMS`
    reasons: on what the claims rest, or why nothing is claimed
    """

    nominal: float
    worst: float
    at: float
    machine: dict[str, float]
    machines: int
    claims: tuple[str, str]
    reasons: tuple[str, str]

    @property
    def margin(self) -> float:
        return 1 - self.worst

    @property
    def refuted(self) -> str:
        """Why the law cannot be recommended; empty if nothing speaks against it."""
        if not self.worst < 1:
            return f"|Q (1 - L P)| is {self.worst:.3g} at {self.at:.3g} Hz on the worst machine"
        return "theory claims that it diverges" if DIVERGES in self.claims else ""


def proof_of(
    family: Family,
    scheme: Scheme,
    machine: Machine,
    task: Task,
    uncertainty: Uncertainty,
) -> Proof:
    """The proof of a scheme over a family of machines."""
    law = law_of(scheme, task)
    keep, L = (family.of_taps(taps, task.dt) for taps in (law.keep, law.L))
    sizes = np.max(np.abs(keep - L * family.P), axis=1)
    which = list(dict.fromkeys([0, *np.argsort(-sizes)[:ENCLOSED].tolist()]))
    found = []
    for i in which:
        loop = minimal(family.loops[i], task.N)
        found.append(largest_of(law, loop, task, lines(task, None, [loop])))
    top = max(range(len(which)), key=lambda i: found[i].value)
    both = {name: values[[0, which[top]]] for name, values in family.drawn.items()}
    told = long_run(drawn_machines(machine, uncertainty, both), scheme, task)
    return Proof(
        nominal=float(found[0].value),
        worst=float(found[top].value),
        at=float(found[top].worst),
        machine={name: float(values[which[top]]) for name, values in family.drawn.items()},
        machines=len(family.P),
        claims=(str(told.claim[0]), str(told.claim[-1])),
        reasons=(str(told.reason[0]), str(told.reason[-1])),
    )
