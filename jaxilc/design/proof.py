"""What theory says of the law that a design recommends."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..schemes import Scheme
from ..schemes.learning_filter import segments_of
from ..signals.task import Task
from ..theory.certificates import DIVERGES, NOTHING, long_run
from ..theory.frequency import Tried, largest_of
from ..theory.law import law_of
from ..theory.loop import minimal, radius_of
from ..theory.whole_set import WholeSet, bound_of_set
from ..uncertainty import drawn_machines
from .responses import Family

ENCLOSED = 4  # of the worst machines by the grid of frequencies; the nominal one besides
REACHED = 1e-6  # |L P| below which no change of P is felt


class Proof(NamedTuple):
    """The frequency test of a law, enclosed over all frequencies, and two certificates.

    Of a law that is scheduled the test is of each segment, as if it were the law of all samples.

    nominal: sup |Q (keep - L P)| of the nominal machine
    worst:   the same of the worst machine of the family
    at:      the frequency at which it is worst [Hz]
    machine: {name: number} of the worst machine
    machines: number of machines of the family
    claims:  of the nominal and of the worst machine, of `theory.CLAIMS`
    reasons: on what the claims rest, or why nothing is claimed
    scheduled: whether the law is; then the claims decide, since the test does not tell what the
             law does where one segment meets the next
    further: largest |W| with which |keep - L P| + |L P W| <= 1 at each frequency on each machine of
             the family: what each may differ by from its model, P (1 + W D) with |D| <= 1 (Bristow
             2006), and still be safe
    whole:   the test over all machines between those of the family, where it can be proved; None
             where it was not asked for
    """

    nominal: float
    worst: float
    at: float
    machine: dict[str, float]
    machines: int
    claims: tuple[str, str]
    reasons: tuple[str, str]
    scheduled: bool = False
    further: float = np.nan
    whole: WholeSet | None = None

    @property
    def margin(self) -> float:
        return 1 - self.worst

    @property
    def refuted(self) -> str:
        """Why the law cannot be recommended; empty if nothing speaks against it."""
        if not self.worst < 1:
            return f"|Q (1 - L P)| is {self.worst:.3g} at {self.at:.3g} Hz on the worst machine"
        if self.scheduled and NOTHING in self.claims:
            why = self.reasons[self.claims.index(NOTHING)]
            return f"theory does not claim that the scheduled law converges, because {why}"
        return "theory claims that it diverges" if DIVERGES in self.claims else ""


def proof_of(family: Family, scheme: Scheme, task: Task, *, between: bool = False) -> Proof:
    """The proof of a scheme over a family of machines.

    between: whether the machines between those of the family are looked at too
    """
    segments = segments_of(scheme)
    laws = [law_of(one, task) for one in segments]
    sizes = np.array([family.sizes_of_law(law, task.dt) for law in laws])
    of_machine = np.max(sizes, axis=(0, 2))
    which = list(dict.fromkeys([0, *np.argsort(-of_machine)[:ENCLOSED].tolist()]))
    found = []
    for i in which:
        loop = minimal(family.loops[i], task.N)
        found.append(max((largest_of(law, loop, task) for law in laws), key=lambda x: x.value))
    top = max(range(len(which)), key=lambda i: found[i].value)
    both = {name: values[[0, which[top]]] for name, values in family.drawn.items()}
    machine, uncertainty = family.population.machine, family.population.uncertainty
    told = long_run(drawn_machines(machine, uncertainty, both), scheme, task)
    whole = None
    if between and len(segments) == 1:
        whole = _between(family, of_machine, which, found, scheme, task)
    return Proof(
        nominal=float(found[0].value),
        worst=float(found[top].value),
        at=float(found[top].worst),
        machine={name: float(values[which[top]]) for name, values in family.drawn.items()},
        machines=len(family.P),
        claims=(str(told.claim[0]), str(told.claim[-1])),
        reasons=(str(told.reason[0]), str(told.reason[-1])),
        scheduled=len(segments) > 1,
        further=_further(family, laws, sizes, task.dt),
        whole=whole,
    )


def _further(family: Family, laws, sizes, dt: float) -> float:
    """The largest |W| with which |keep - L P| + |L P| |W| <= 1; of one channel."""
    if family.P.ndim != 2:
        return np.nan
    LP = np.abs([family.of_taps(law.L, dt) * family.P for law in laws])
    return float(np.min(np.maximum(1 - sizes, 0) / np.maximum(LP, REACHED)))


def _between(family: Family, sizes, which, found, scheme: Scheme, task: Task) -> WholeSet:
    """What is proved of all machines between those of the family.

    sizes: (S,) of each machine on the grid; of those in `which` the enclosed ones take their place
    """
    values = sizes.copy()
    for i, one in zip(which, found, strict=True):
        values[i] = one.value
    machine, uncertainty = family.population.machine, family.population.uncertainty
    names = tuple(uncertainty)
    drawn = [np.asarray(family.drawn[name]) for name in names]
    points = np.stack(drawn, axis=1) if names else np.zeros((1, 0))
    loops = [minimal(loop, task.N) for loop in family.loops]
    radii = np.array([radius_of(loop) for loop in loops])
    nowhere = np.full(len(values), np.nan)
    tried = Tried(names, points, values, nowhere, nowhere, radii, loops)
    return bound_of_set(machine, scheme, task, law_of(scheme, task), uncertainty, tried)
