"""The update law itself, learned: taps of L and Q by gradients over a family, and proved safe.

    u_{j+1} = keep u_j + L e_j,    |keep - L P| <= 1 - margin    on every machine of the family

with keep = Q and Q L in place of L where the law is written Q (u + L e). The taps are first found
by the frequency responses of the family (`by_response`), which is exact far from the ends of a long
trial and takes a second; then a `Tuning` goes on through simulated learning, where the ends of the
trial, limits, saturation, noise and disturbances count.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..learning.machine import Machine
from ..pytree.closest import not_one_of
from ..pytree.ranges import require
from ..schemes import Scheme, WithFeedback
from ..signals.task import Task
from ..sweeps import Sweep
from ..sweeps.summary import summarise
from ..theory.law import law_of
from ..tuning import Tuning
from ..tuning.objectives import Final, Holding
from ..tuning.over_family import OverFamily
from ..uncertainty import Uncertainty
from .by_response import by_response, moved
from .candidates import Candidate, candidates
from .gate import Passed, gate
from .judging import Verdict, judged_trials, verdict
from .kept_taps import kept_or
from .proof import Proof, proof_of
from .responses import Family, family_of
from .shaped import WEIGHT, ShapedFilter, better_of
from .window import Filters, Window, window_of

STARTS = {
    "safe": ("p-type", "pd-type", "model-inverse"),
    "p-type": ("p-type",),
    "inverse": ("model-inverse",),
    "nothing": (),
}
SPARE = 0.02  # beyond the margin, kept in the search for machines that it has not seen
DENSE, CLOSE = 257, 600  # machines and frequencies of the gate
RISE = 0.5  # weight of the largest error of all trials
UNSAFE = 20.0  # weight of the logarithm of |keep - L P| beyond what is allowed
RATE = 0.002  # share of 1 / |P| by which a step changes the taps at one frequency
LEARNED, SAFE = "learned", "safe"

Told = Callable[[str, Any], object]


class Learned(NamedTuple):
    """The result of learning a law.

    law:      with its taps, None if it was refused
    refused:  why, empty if it was not
    start:    the safe law that the taps were taken from, None for none
    verdicts: on machines that no step has seen, of `learned` and of `safe`, the best safe law of a
              few weights; empty where the gate refused
    proof:    of the learned law, over the dense family
    passed:   what the gate let pass
    window, family: where the taps lie, and the dense family
    trials, long, machines: trials asked for, and trials and machines of the sweep
    """

    law: Candidate | None
    refused: str
    start: Candidate | None
    verdicts: dict[str, Verdict]
    proof: Proof | None
    passed: Passed | None
    window: Window
    family: Family
    trials: int
    long: int
    machines: int


@dataclasses.dataclass(frozen=True)
class LearnedLaw:
    """The question which taps of L and Q suit an uncertain machine best; `run` answers it.

    1. The start: the taps of the best safe law of a few weights (`candidates`).
    2. The taps of least predicted error over the family, by its frequency responses.
    3. The better of both, tuned through learning: least mean log e_J + 1/2 log max_j e_j, with the
       monotone condition over the family as a penalty.
    4. The gate: |keep - L P| <= 1 - margin on a denser family of other machines. Taps that fail are
       taken back towards the start as far as needed; if nothing on the way passes, or the proof
       over all frequencies fails, the law is refused.
    5. A sweep over machines that no step has seen, beside the best safe law of a few weights.

    machine, task, trials, uncertainty: as for `Sweep`; one input and one output
    feedback: under which the machine learns, None for none
    taps: odd numbers of taps of L and of Q
    start: of `STARTS`: the best `safe` law, the `p-type` one, the model `inverse`, or `nothing`
    metric: by which a law is judged
    margin: in (0, 1)
    trained_on, held_out, machines: numbers of machines of the tuning, of the choice of its best
        step, and of the sweep
    steps: of the tuning; 0 for the taps by frequency response alone
    seed: of everything drawn
    Raises ValueError for a setting that is not allowed.
    """

    machine: Machine
    task: Task
    trials: int
    uncertainty: Uncertainty
    feedback: Scheme | None = None
    taps: tuple[int, int] = (61, 31)
    start: str = "safe"
    metric: str = "settled_error"
    margin: float = 0.05
    trained_on: int = 32
    held_out: int = 32
    machines: int = 257
    steps: int = 60
    seed: int = 0

    def __post_init__(self):
        require("LearnedLaw", "margin", self.margin, "(0, 0.9)")
        for name, least in (
            ("trials", 2), ("machines", 2), ("trained_on", 1), ("held_out", 0), ("steps", 0),
        ):  # fmt: skip
            require("LearnedLaw", name, getattr(self, name), f"[{least}, inf)", whole=True)
        if self.start not in STARTS:
            raise ValueError(not_one_of(f"start = {self.start!r}", self.start, STARTS))
        most = min(1001, 2 * ((self.task.N - 1) // 2) - 1)
        if len(self.taps) != 2 or any(
            n != int(n) or n % 2 == 0 or not 1 <= n <= most for n in self.taps
        ):
            raise ValueError(
                f"LearnedLaw: taps = {self.taps} are not allowed; allowed are two odd numbers, of "
                f"L and of Q, from 1 to {most} for a trial of {self.task.N} samples"
            )

    def run(
        self,
        out: str | Path,
        *,
        resume: bool = False,
        told: Told = lambda stage, what: None,
    ) -> Learned:
        """Learn the law, and judge it.

        out: folder for the taps of the start, the state of the tuning and the store of the sweep
        resume: go on with what is there; a run that was killed ends with the same taps
        told: called with `safe` and a Candidate or Absent; `found` and the predicted share of the
            error of the start; `tuning` and (step, loss); `gate` and the Passed or the refusal;
            `judging` and the machines; `proving` and the Candidate
        Raises FileExistsError for a folder that exists without `resume`, and ValueError for one of
        another question, and for a machine that is not allowed, before anything is simulated.
        """
        out = Path(out)
        family = family_of(self.machine, self.feedback, self.task, self.uncertainty, seed=self.seed)
        window = window_of(family, self.task, self.taps)
        safe = self._safe(family, told)
        start = self._start_of(safe)
        first = (
            window.nothing() if start is None else window.holding(law_of(start.scheme, self.task))
        )
        found = kept_or(out, self, lambda: self._by_response(family, window, first), resume=resume)
        told("found", found)
        tuned = self._tuned(family, window, (found, first), out / "tuning", resume, told)
        dense = family_of(
            self.machine, self.feedback, self.task, self.uncertainty,
            seed=self.seed + 3, machines=DENSE, points=CLOSE,
        )  # fmt: skip
        passed = gate(dense, window, tuned, (found, first), self.task.dt, 1 - self.margin)
        told("gate", passed)
        nothing = Learned(
            None, "", start, {}, None, None, window, dense,
            self.trials, judged_trials(self.trials), self.machines,
        )  # fmt: skip
        if isinstance(passed, str):
            return nothing._replace(refused=passed)
        return self._judged(nothing, passed, safe, out, resume, told)

    def _safe(self, family: Family, told: Told) -> list[Candidate]:
        """The safe laws of a few weights, the best one first."""
        found = []
        for one in candidates(
            family, self.feedback, self.task, self.trials, self.margin, STARTS["safe"]
        ):
            told("safe", one)
            if isinstance(one, Candidate):
                found.append(one)
        return sorted(found, key=lambda one: one.predicted)

    def _start_of(self, safe: list[Candidate]) -> Candidate | None:
        """The safe law to begin with, None for none; raises ValueError for one that is not safe."""
        found = next((one for one in safe if one.name in STARTS[self.start]), None)
        if found is None and self.start in ("p-type", "inverse"):
            raise ValueError(
                f"LearnedLaw: start = {self.start!r} is not possible, as no weights of this law "
                f"keep the margin {self.margin:g} on every machine; allowed are 'safe', 'nothing' "
                "and a smaller margin"
            )
        return found

    def _by_response(self, family: Family, window: Window, first: Filters) -> Filters:
        below = 1 - self.margin - SPARE
        return by_response(family, window, first, self.task, self.trials, below)

    def _tuned(
        self,
        family: Family,
        window: Window,
        starts: tuple[Filters, Filters],
        out: Path,
        resume: bool,
        told: Told,
    ) -> Filters:
        """The taps after the tuning through learning, from the better one of two starts."""
        if not self.steps:
            return starts[0]

        def problem(start: Filters) -> Tuning:
            return Tuning(
                self.machine,
                _under(ShapedFilter.around(window, start), self.feedback),
                self.task,
                self.trials,
                weights=[WEIGHT if self.feedback is None else f"learning.{WEIGHT}"],
                uncertainty=self.uncertainty,
                objective=Final(self.metric)
                + RISE * Holding(1, self.metric)
                + UNSAFE * OverFamily(family.frequencies, family.P, 1 - self.margin - SPARE),
                machines=self.trained_on,
                held_out=self.held_out,
                steps=self.steps,
                rate=RATE,
                mode="reverse",
                seed=self.seed,
            )

        asked = problem(starts[0])
        if (start := better_of(asked, window, *starts)) is not starts[0]:
            asked = problem(start)

        def tell(step: int, losses, _) -> None:
            told("tuning", (step, float(np.min(losses))))

        tuned = asked.run(out, resume=resume and out.exists(), progress=tell)
        return moved(window, start, np.array(list(tuned.values.values())))

    def _judged(
        self, nothing: Learned, passed: Passed, safe, out: Path, resume: bool, told: Told
    ) -> Learned:
        """The proof and the verdicts on taps that passed the gate."""
        p, q = self.taps
        scheme = _under(nothing.window.of(passed.filters), self.feedback)
        words = f"u' = Q u + L e by learned filters, L of {p} taps and Q of {q}"
        law = Candidate(LEARNED, words, scheme, {}, passed.largest, np.nan)
        told("proving", law)
        proof = proof_of(nothing.family, scheme, self.machine, self.task, self.uncertainty)
        laws = {LEARNED: law} | ({SAFE: safe[0]} if safe else {})
        told("judging", self.machines)
        store = out / "sweep.zarr"
        dataset = Sweep(
            self.machine,
            {name: one.scheme for name, one in laws.items()},
            self.task,
            nothing.long,
            self.uncertainty,
            machines=self.machines,
            seed=self.seed + 2,
        ).run(store, resume=resume and store.exists())
        summaries = summarise(dataset, None, metric=self.metric)
        verdicts = {
            name: verdict(one, summary, self.trials, None)
            for (name, one), summary in zip(laws.items(), summaries, strict=True)
        }
        refused = proof.refuted or verdicts[LEARNED].lost
        return nothing._replace(
            law=None if refused else law,
            refused=refused,
            verdicts=verdicts,
            proof=proof,
            passed=passed,
        )


def _under(scheme: Scheme, feedback: Scheme | None) -> Scheme:
    return scheme if feedback is None else WithFeedback(scheme, feedback)
