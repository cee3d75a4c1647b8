"""The search for a learning law: safe weights first, then tuned ones, judged on new machines."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

from ..pytree.closest import need_known
from ..pytree.in_short import in_short
from ..pytree.ranges import require
from ..schemes import Scheme, WithFeedback
from ..uncertainty import takes_population
from . import candidates
from .candidates import Absent, Candidate, judged_trials, tuned
from .judging import Limits, Proof, Question, Told, Verdict, limits_of, proof_of, ranked
from .learned import LEARNED, LearnedLaw
from .responses import Family

LAWS = (*candidates.LAWS, LEARNED)  # that a design tries, from the simplest to the most complex
TUNED_ON, HELD_OUT = 24, 24  # machines
AT_ONCE = 2  # tunings
FIRST = "first"  # ends the name of a law whose weights were not tuned
TAPS = 61, 31  # of the learned law, fewer in a short trial


class Recommended(NamedTuple):
    """The law that a design recommends, what theory says of it, and what limits its error."""

    verdict: Verdict
    proof: Proof
    limits: Limits


class Designed(NamedTuple):
    """The result of a design.

    chosen:  the recommended law, None if no law holds
    others:  the verdicts on the other laws, in the order of their errors
    absent:  laws without safe weights
    trials, long: trials asked for, and trials of the sweep
    machines: number of machines of the sweep
    """

    chosen: Recommended | None
    others: tuple[Verdict, ...]
    absent: tuple[Absent, ...]
    trials: int
    long: int
    machines: int

    def __repr__(self) -> str:
        return in_short(self)


@takes_population
@dataclasses.dataclass(frozen=True)
class Design(Question):
    """The question which learning law suits an uncertain machine; `run` answers it.

    1. Weights for which |Q (1 - L P)| <= 1 - margin at each frequency, on each machine at the
       corners of the uncertainty (and some within), with the least predicted error; P-type and
       PD-type laws are simulated with the ends of the trial.
    2. These tuned by gradient through learning, on other machines, as far as 1. still holds. From
       the best of them a law is learned by its taps (`LearnedLaw`), where its gate lets it pass.
    3. A sweep of all laws, with both weights, over machines that neither step has seen, for longer
       than asked.
    4. Of the law with the least 95 % error: the enclosed |Q (1 - L P)|, the certificates of the
       nominal and the worst machine, and which cause adds most to its error.

    machine, task, trials, uncertainty, feedback, metric, margin, machines, seed, quantities:
        see `Question`; one input and one output
    laws: names of `LAWS`, all if empty
    tolerance: largest value of the metric that passes
    steps: of a tuning
    Raises ValueError for a setting that is not allowed.
    """

    laws: Sequence[str] = ()
    tolerance: float | None = None
    steps: int = 30
    __repr__ = in_short

    def __post_init__(self) -> None:
        super().__post_init__()
        require("Design", "steps", self.steps, "[2, inf)", whole=True)
        for name in self.laws:
            need_known(f"law = {name!r}", name, LAWS)

    def run(
        self, out: str | Path, *, resume: bool = False, told: Told = lambda stage, what: None
    ) -> Designed:
        """Try the laws, and recommend one.

        out: folder for the states of the tunings and the store of the sweep
        resume: go on with what is in the folder; a design that was killed lost no finished step
        told: called with `safe` and a Candidate or Absent; `tuning` and (name, step, steps);
            `candidates` and the Candidate; `judging` and the machines; `judged` and the Verdicts;
            `proving` and the chosen Candidate
        Raises ValueError for a machine that is not allowed, before anything is simulated.
        """
        out, family, asked = Path(out), self.family(), self.laws or LAWS
        names = [name for name in asked if name != LEARNED]
        safe, absent = self.safe(family, names, told)
        with ThreadPoolExecutor(AT_ONCE) as threads:  # one compiles while the other computes
            better = threads.map(lambda one: self._tuned(one, family, out, resume, told), safe)
            laws: list[Candidate] = []
            for now, before in zip(better, safe, strict=True):
                laws.append(now)
                if now is not before:  # as chosen by frequency alone
                    laws.append(before._replace(name=f"{before.name}-{FIRST}"))
        if LEARNED in asked:
            one = self._learned(safe, out / LEARNED, resume, told)
            if isinstance(one, Candidate):
                laws.append(one)
            else:
                absent.append(one)
        nothing = Designed(
            None, (), tuple(absent), self.trials, judged_trials(self.trials), self.machines
        )
        if not laws:
            return nothing
        told("judging", self.machines)
        judged = self.swept(laws, out / "sweep.zarr", resume=resume, tolerance=self.tolerance)
        told("judged", judged)
        chosen, others = self._recommended(judged, family, told)
        return nothing._replace(chosen=chosen, others=others)

    def _learned(
        self, safe: list[Candidate], out: Path, resume: bool, told: Told
    ) -> Candidate | Absent:
        """The law by its taps that is learned from the best safe one, or why there is none."""
        longest = 2 * ((self.task.N - 1) // 2) - 1
        shared = {f.name: getattr(self, f.name) for f in dataclasses.fields(Question)}
        asked = LearnedLaw(
            **shared,
            taps=(min(TAPS[0], longest), min(TAPS[1], longest)),
            trained_on=TUNED_ON,
            held_out=HELD_OUT,
            steps=self.steps,
        )

        def tell(stage: str, what: object) -> None:
            if stage == "tuning" and isinstance(what, tuple):
                told(stage, (LEARNED, what[0], self.steps))

        ordered = sorted(safe, key=lambda one: one.predicted)
        taps = asked.learned_taps(asked.resolved(), ordered, out, resume=resume, told=tell)
        if isinstance(taps.passed, str):
            return Absent(LEARNED, taps.passed)
        law = asked.candidate(taps.window, taps.passed)
        told("tuned", law)
        return law

    def _tuned(
        self, candidate: Candidate, family: Family, out: Path, resume: bool, told: Told
    ) -> Candidate:
        """The candidate with tuned weights that keep the margin."""

        def tell(step: int, *_) -> None:
            told("tuning", (candidate.name, step, self.steps))

        state = out / f"tuning-{candidate.name}"
        found = tuned(
            candidate, family, self.task, self.trials, metric=self.metric, margin=self.margin,
            out=state, resume=resume and state.exists(), progress=tell, machines=TUNED_ON,
            held_out=HELD_OUT, steps=self.steps, quantities=self.quantities,
        )  # fmt: skip
        told("tuned", found)
        return found

    def _recommended(
        self, judged: list[Verdict], family: Family, told: Told
    ) -> tuple[Recommended | None, tuple[Verdict, ...]]:
        """The best law that theory does not refute, and the verdicts on all others."""
        others, chosen = list(judged), None
        for one in ranked(judged):
            told("proving", one.candidate)
            scheme = one.candidate.scheme
            proof = proof_of(family, scheme, self.task)
            at = others.index(one)
            if not proof.refuted:
                limits = limits_of(self, family.population, scheme, one.error)
                chosen = Recommended(one, proof, limits)
                del others[at]
                break
            others[at] = one._replace(lost=proof.refuted)
        return chosen, tuple(sorted(others, key=lambda one: (bool(one.lost), one.error)))


def feedback_among(schemes: Mapping[str, Scheme]) -> Scheme | None:
    """The feedback of the schemes, under which a design learns; None if they have none.

    Raises ValueError where two schemes have different ones.
    """
    found = {
        name: scheme.feedback
        for name, scheme in schemes.items()
        if isinstance(scheme, WithFeedback)
    }
    told = {str(feedback) for feedback in found.values()}
    if len(told) > 1:
        raise ValueError(
            f"design: the schemes {', '.join(found)} have different feedbacks; choose one by "
            "--scheme NAME"
        )
    return next(iter(found.values()), None)
