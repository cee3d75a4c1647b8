"""The search for a learning law: safe weights first, then tuned ones, judged on new machines."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

from ..learning.machine import Machine
from ..pytree.closest import not_one_of
from ..pytree.ranges import require
from ..schemes import Scheme, WithFeedback
from ..signals.task import Task
from ..sweeps import Sweep
from ..sweeps.summary import summarise
from ..uncertainty import Uncertainty
from .candidates import LAWS, Absent, Candidate, candidates
from .judging import Limits, Verdict, judged_trials, limits_of, ranked, verdict
from .proof import Proof, proof_of
from .responses import Family, family_of
from .tuned import tuned

TUNED_ON, HELD_OUT = 24, 24  # machines
AT_ONCE = 2  # tunings
FIRST = "first"  # ends the name of a law whose weights were not tuned

Told = Callable[[str, Any], object]


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


@dataclasses.dataclass(frozen=True)
class Design:
    """The question which learning law suits an uncertain machine; `run` answers it.

    1. Weights for which |Q (1 - L P)| <= 1 - margin at each frequency, on each machine at the
       corners of the uncertainty (and some within), with the least predicted error; P-type and
       PD-type laws are simulated with the ends of the trial.
    2. These tuned by gradient through learning, on other machines, as far as 1. still holds.
    3. A sweep of all laws, with both weights, over machines that neither step has seen, for longer
       than asked.
    4. Of the law with the least 95 % error: the enclosed |Q (1 - L P)|, the certificates of the
       nominal and the worst machine, and which cause adds most to its error.

    machine, task, trials, uncertainty: as for `Sweep`; one input and one output
    feedback: under which the machine learns, None for none
    laws: names of `candidates.LAWS`, all if empty
    metric, tolerance: by which a law is judged, and its largest value that passes
    margin: in (0, 1)
    machines: of the sweep;  steps: of a tuning;  seed: of everything drawn
    Raises ValueError for a setting that is not allowed.
    """

    machine: Machine
    task: Task
    trials: int
    uncertainty: Uncertainty
    feedback: Scheme | None = None
    laws: Sequence[str] = ()
    metric: str = "settled_error"
    tolerance: float | None = None
    margin: float = 0.05
    machines: int = 257
    steps: int = 30
    seed: int = 0

    def __post_init__(self):
        require("Design", "margin", self.margin, "(0, 1)")
        for name in ("trials", "machines", "steps"):
            require("Design", name, getattr(self, name), "[2, inf)", whole=True)
        for name in self.laws:
            if name not in LAWS:
                raise ValueError(not_one_of(f"law = {name!r}", name, LAWS))

    def run(
        self,
        out: str | Path,
        *,
        resume: bool = False,
        told: Told = lambda stage, what: None,
    ) -> Designed:
        """Try the laws, and recommend one.

        out: folder for the states of the tunings and the store of the sweep
        resume: go on with what is in the folder; a design that was killed lost no finished step
        told: called with `safe` and a Candidate or Absent; `tuning` and (name, step, steps);
            `tuned` and the Candidate; `judging` and the machines; `judged` and the Verdicts;
            `proving` and the chosen Candidate
        Raises ValueError for a machine that is not allowed, before anything is simulated.
        """
        out = Path(out)
        family = family_of(self.machine, self.feedback, self.task, self.uncertainty, seed=self.seed)
        found = []
        for one in candidates(
            family, self.feedback, self.task, self.trials, self.margin, self.laws or tuple(LAWS)
        ):
            told("safe", one)
            found.append(one)
        safe = [one for one in found if isinstance(one, Candidate)]
        absent = tuple(one for one in found if isinstance(one, Absent))
        nothing = Designed(None, (), absent, self.trials, judged_trials(self.trials), self.machines)
        if not safe:
            return nothing
        with ThreadPoolExecutor(AT_ONCE) as threads:  # one compiles while the other computes
            better = threads.map(lambda one: self._tuned(one, family, out, resume, told), safe)
            both = [law for pair in zip(better, safe, strict=True) for law in _variants(*pair)]
        told("judging", self.machines)
        judged = self._judged(both, out / "sweep.zarr", resume)
        told("judged", judged)
        chosen, others = self._recommended(judged, family, told)
        return nothing._replace(chosen=chosen, others=others)

    def _tuned(
        self, candidate: Candidate, family: Family, out: Path, resume: bool, told: Told
    ) -> Candidate:
        """The candidate with tuned weights that keep the margin."""

        def tell(step: int, *_) -> None:
            told("tuning", (candidate.name, step, self.steps))

        state = out / f"tuning-{candidate.name}"
        found = tuned(
            candidate,
            family,
            self.machine,
            self.task,
            self.trials,
            self.uncertainty,
            metric=self.metric,
            margin=self.margin,
            out=state,
            resume=resume and state.exists(),
            progress=tell,
            machines=TUNED_ON,
            held_out=HELD_OUT,
            steps=self.steps,
            seed=self.seed,
        )
        told("tuned", found)
        return found

    def _judged(self, laws: list[Candidate], store: Path, resume: bool) -> list[Verdict]:
        """The verdicts on laws by a sweep over new machines."""
        sweep = Sweep(
            self.machine,
            {law.name: law.scheme for law in laws},
            self.task,
            judged_trials(self.trials),
            self.uncertainty,
            machines=self.machines,
            seed=self.seed + 2,
        )
        dataset = sweep.run(store, resume=resume and store.exists())
        summaries = summarise(dataset, self.tolerance, metric=self.metric)
        return [
            verdict(law, summary, self.trials, self.tolerance)
            for law, summary in zip(laws, summaries, strict=True)
        ]

    def _recommended(
        self, judged: list[Verdict], family: Family, told: Told
    ) -> tuple[Recommended | None, tuple[Verdict, ...]]:
        """The best law that theory does not refute, and the verdicts on all others."""
        others, chosen = list(judged), None
        for one in ranked(judged):
            told("proving", one.candidate)
            scheme = one.candidate.scheme
            proof = proof_of(family, scheme, self.machine, self.task, self.uncertainty)
            at = others.index(one)
            if not proof.refuted:
                limits = limits_of(
                    scheme, self.machine, self.task, self.trials, self.metric, one.error
                )
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


def _variants(better: Candidate, safe: Candidate) -> list[Candidate]:
    """A law as tuned, and as chosen by frequency alone if that differs."""
    plain = safe._replace(name=f"{safe.name}-{FIRST}")
    return [better] if better is safe else [better, plain]
