"""What every design is asked, and its laws judged on machines that no step of it has seen."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from ..learning.known_metrics import OF_TRIALS
from ..learning.machine import Machine
from ..learning.metrics import Keep
from ..learning.over_trials import learn
from ..pytree.aliases import Value
from ..pytree.closest import need_known
from ..pytree.ranges import brief, require, share_text
from ..schemes import Scheme
from ..schemes.learning_filter import segments_of
from ..signals.task import Task, Trial
from ..sweeps import Sweep
from ..sweeps.summary import SchemeSummary, summarise
from ..theory.certificates import DIVERGES, NOTHING, long_run
from ..theory.chance import draws
from ..theory.frequency import Tried, WholeSet, bound_of_set, largest_of
from ..theory.law import law_of
from ..theory.linearity import not_whole
from ..theory.loop import minimal, radius_of
from ..uncertainty import Population, Uncertainty, drawn_machines
from .candidates import Absent, Candidate, candidates, judged_trials
from .responses import MACHINES, Family, designed_on, family_of

Told = Callable[[str, object], object]

LIKE = 1.01  # errors within this factor count as equal; the simpler law is then taken
SETTLED = 1.05  # factor above the error at the end, within which a trial counts as settled
GROWN = 2.0  # factor by which the error may not have grown at the end of the sweep


class Verdict(NamedTuple):
    """How a candidate did on the machines of the sweep.

    candidate: the law
    error: 95 % of the machines are at or below it in the last trial asked for, and in each trial of
        the sweep after that [unit of the metric]
    median: the same for 50 %
    worst: the same for all machines
    settled_at: first trial whose 95 % error is at most 5 % above its end, the mean of the last
        quarter of the trials from the last one asked for on; 0 if `error` is infinite
    tolerated_from: first trial from which on 95 % of the machines stay within the tolerance, 0 if
        there is none
    lost: why the law is out of question, empty if it is not
    summary: of the sweep
    gained_later: the share by which the 95 % error falls from the least of the trials asked for to
        that end
    """

    candidate: Candidate
    error: float
    median: float
    worst: float
    settled_at: int
    tolerated_from: int
    lost: str
    summary: SchemeSummary
    gained_later: float = 0.0

    @property
    def still_falls(self) -> bool:
        """Whether trials after those asked for gain more than what counts as settled."""
        return self.gained_later > 1 - 1 / SETTLED


def verdict(
    candidate: Candidate, summary: SchemeSummary, trials: int, tolerance: float | None
) -> Verdict:
    """The verdict on a candidate from its sweep, which may have more trials than asked for."""
    last = trials - 1
    lost = ""
    if summary.diverged > 0:
        lost = share_text(summary.diverged)
        lost += f" of the machines diverge, from trial {summary.diverged_at}"
    elif summary.worst[-1] > GROWN * summary.worst[last]:
        factor = summary.worst[-1] / summary.worst[last]
        lost = f"the error grows {factor:.1f} times from trial {trials} to {len(summary.worst)}"
    high, error = summary.high, float(np.max(summary.high[last:]))
    least = float(np.min(high[:trials]))  # by chance one trial has more
    end = float(np.mean(high[last:][-max((len(high) - last) // 4, 1) :]))
    if not lost and error >= high[0]:
        lost = f"it leaves {error / high[0]:.2g} times the error of the first trial"
    return Verdict(
        candidate, error=error, median=float(np.max(summary.median[last:])),
        worst=float(np.max(summary.worst[last:])),
        settled_at=1 + int(np.argmax(high <= SETTLED * end)) if np.isfinite(error) else 0,
        tolerated_from=_stays_from(high, tolerance), lost=lost, summary=summary,
        gained_later=1 - end / least if 0 < least < np.inf else 0.0,
    )  # fmt: skip


def _stays_from(high: np.ndarray, tolerance: float | None) -> int:
    """The first trial from which on the errors stay within the tolerance, 0 if there is none."""
    beyond = np.flatnonzero(~(high <= (np.inf if tolerance is None else tolerance)))
    if tolerance is None or (len(beyond) and beyond[-1] == len(high) - 1):
        return 0
    return 1 + (int(beyond[-1]) + 1 if len(beyond) else 0)


def ranked(verdicts: Sequence[Verdict]) -> list[Verdict]:
    """The laws that hold, given from the simplest on: the first near the least, then by error."""
    sound = [one for one in verdicts if not one.lost]
    least = min((one.error for one in sound), default=np.inf)
    first = next((one for one in sound if one.error <= LIKE * least), None)
    return sorted(sound, key=lambda one: (one is not first, one.error))


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
        require(owner, "highest", self.highest, "(0, inf]")
        known = (*(one.name for one in OF_TRIALS if one.swept), *self.quantities)
        need_known(f"{owner}: metric = {brief(self.metric)}", self.metric, known)

    def family(self, *, after: int = 0, machines: int = MACHINES, **how: Value) -> Family:
        """The responses of machines drawn with a seed so far `after` the own one; see `family_of`.

        how: as for `family_of`
        """
        seed = self.seed + after
        population = designed_on(self.machine, self.uncertainty, machines=machines, seed=seed)
        family = family_of(population, self.feedback, self.task, **how)
        return family._replace(highest=self.highest, metric=self.metric)

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
        """The verdicts on laws by a sweep over the nominal machine and others not seen before."""
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


class Limits(NamedTuple):
    """The error as one cause after the other is added [unit of the metric].

    Each is the largest in the trials from the last one asked for on, as `Verdict.error` is.

    law:     of the nominal machine without noise and limits: what filter and trials leave
    limits:  with the limits of actuator and scheme
    noise:   with noise too, of which 95 % of the draws leave no more
    machines: of 95 % of the uncertain machines
    """

    law: float
    limits: float
    noise: float
    machines: float

    @property
    def largest(self) -> str:
        """The name of the cause that adds most."""
        steps = np.diff([0.0, *self])
        return self._fields[int(np.argmax(steps))]


def limits_of(asked: Question, population: Population, scheme: Scheme, error: float) -> Limits:
    """What limits the error of a scheme, which 95 % of the machines of `Question.swept` have.

    population: the machines of the question
    """
    machine, keep, first = population.machine, Keep.of(asked.quantities), asked.trials - 1
    long, quiet = judged_trials(asked.trials), machine.noiseless()

    def of_one(machine: Machine, scheme: Scheme) -> float:
        history = learn(machine, scheme, asked.task, long, save=keep)
        found = history.metrics._asdict() | history.saved
        return float(np.max(np.asarray(found[asked.metric])[first:]))

    def of_draws() -> float:
        """The error of the nominal machine, with the noise of the machines that judge."""
        swept = Sweep(
            machine, {"law": scheme}, asked.task, long, {}, machines=asked.machines,
            seed=asked.seed + 2, quantities=asked.quantities,
        ).run()  # fmt: skip
        return float(np.max(summarise(swept, None, metric=asked.metric)[0].high[first:]))

    noise = error
    if population.uncertainty:
        noise = of_draws() if draws(machine) else of_one(machine, scheme)
    return Limits(
        law=of_one(quiet.unlimited(), scheme.unlimited()),
        limits=of_one(quiet, scheme),
        noise=noise,
        machines=error,
    )


# What theory says of the law that is recommended
# --------------------------------------------------------------------------------------------------

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
    further: largest |W| with which |keep - L P| + |L P W| <= 1 at each frequency of the grid, on
             each machine of the family: what each may differ by from its model, P (1 + W D) with
             |D| <= 1 (Bristow 2006), and still be safe
    whole:   the test over all machines between those of the family, where it can be proved; None
             where it was not asked for
    without: what of the variation the test leaves out, and the claims do not, see `not_whole`
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
    without: str = ""

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
    """The proof of a scheme over a family, and of all machines between those if it is asked for."""
    segments = segments_of(scheme)
    laws = [law_of(one, task) for one in segments]
    sizes = np.array([family.sizes_of_law(law, task.dt) for law in laws])
    of_machine = np.max(sizes, axis=(0, 2))
    ends = _corners(family) if between else []  # what is proved between them is largest there
    which = list(dict.fromkeys([0, *np.argsort(-of_machine)[:ENCLOSED].tolist(), *ends]))
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
        nominal=float(found[0].value), worst=float(found[top].value), at=float(found[top].worst),
        machine={name: float(values[which[top]]) for name, values in family.drawn.items()},
        machines=len(family.P), claims=(str(told.claim[0]), str(told.claim[-1])),
        reasons=(str(told.reason[0]), str(told.reason[-1])), scheduled=len(segments) > 1,
        further=_further(family, laws, sizes, task.dt), whole=whole,
        without=not_whole(machine, uncertainty),
    )  # fmt: skip


def _corners(family: Family) -> list[int]:
    """The machines of which each uncertain number is at an end of its distribution."""
    ends = {name: one.corners() for name, one in family.population.uncertainty.items()}
    at_end = [np.isin(family.drawn[name], of) for name, of in ends.items()]
    return np.flatnonzero(np.all(at_end, axis=0)).tolist() if ends else []


def _further(family: Family, laws, sizes, dt: float) -> float:
    """The largest |W| with which |keep - L P| + |L P| |W| <= 1; of one channel."""
    if family.P.ndim != 2:
        return np.nan
    LP = np.abs([family.of_taps(law.L, dt) * family.P for law in laws])
    return float(np.min(np.maximum(1 - sizes, 0) / np.maximum(LP, REACHED)))


def _between(family: Family, sizes, which, found, scheme: Scheme, task: Task) -> WholeSet:
    """What is proved between the machines of a family, by their sizes (S,) and enclosed ones."""
    values = sizes.copy()
    for i, one in zip(which, found, strict=True):
        values[i] = one.value
    names = tuple(family.population.uncertainty)
    drawn = [np.asarray(family.drawn[name]) for name in names]
    points = np.stack(drawn, axis=1) if names else np.zeros((1, 0))
    loops = [minimal(loop, task.N) for loop in family.loops]
    radii = np.array([radius_of(loop) for loop in loops])
    nowhere = np.full(len(values), np.nan)
    tried = Tried(names, points, values, nowhere, nowhere, radii, loops)
    return bound_of_set(family.population, scheme, task, law_of(scheme, task), tried)
