"""The update law itself, learned: taps of L and Q by gradients over a family, and proved safe.

    u_{j+1} = keep u_j + L e_j,    |keep - L P| <= 1 - margin    on every machine of the family

with keep = Q and Q L in place of L where the law is written Q (u + L e). The taps are first found
by the frequency responses of the family (`by_response`), which is exact far from the ends of a long
trial and takes a second; then a `Tuning` goes on through simulated learning, where the ends of the
trial, limits, saturation, noise and disturbances count.
"""

from __future__ import annotations

import dataclasses
import json
import logging
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..pytree.aliases import Leaf, Value
from ..pytree.closest import need_known
from ..pytree.in_short import in_short
from ..pytree.named_paths import replaced, settable
from ..pytree.needs import need_channels
from ..pytree.ranges import allowed, as_numbers, brief, fits, is_whole, require
from ..runtime.provenance import describe, environment, need_described, need_same
from ..schemes import Scheme
from ..storage.files import need_free
from ..storage.sealed import Damaged, as_json, json_text, read_json, sealed, unsealed, write_json
from ..tuning import Tuning
from ..tuning.objectives import Final, Holding, Objective
from ..tuning.risks import Mean, Risk
from ..uncertainty import takes_population
from .by_response import FirstTaps, best_of_leads, exchanged, held, radius_in_a_trial, sizes_of
from .candidates import Candidate, judged_trials, penalty
from .judging import Proof, Question, Told, Verdict, proof_of
from .responses import Family, under
from .window import Filters, ShapedFilter, Window, window_of

SPARE = 0.02  # beyond the margin, kept in the search for machines that it has not seen
DENSE, CLOSE = 257, 600  # machines and frequencies of the gate
WATCH = 129  # machines that watch the search by frequency
RISE = 0.5  # weight of the largest error of all trials
RATE = 0.002  # share of 1 / |P| by which a step changes the taps at one frequency
LEARNED, SAFE = "learned", "safe"
KINDS = {"coupled": bool, "objective": Objective | None, "risk": Risk}
WAYS = np.linspace(0.0, 1.0, 21)  # from what was learned to a law that is known to be safer
BEGUN = "start.json"  # the taps with which a tuning begins, in its folder
STARTS = {
    "safe": ("p-type", "pd-type", "p-type-notch", "model-inverse"),
    "p-type": ("p-type",),
    "inverse": ("model-inverse",),
    "nothing": (),
}

log = logging.getLogger("jaxilc")


class Passed(NamedTuple):
    """Taps that pass the gate.

    way:     share of the way back on which they lie: 0 for those that were learned
    largest: |keep - L P| at its largest, on the machines and lines of the family
    """

    filters: Filters
    way: float
    largest: float


class Taps(NamedTuple):
    """The taps that were learned.

    start:  the safe law that they were taken from, None for none
    family: the dense family of the gate
    passed: what the gate let pass, or why nothing did
    """

    start: Candidate | None
    window: Window
    family: Family
    passed: Passed | str


class Learned(NamedTuple):
    """The result of learning a law.

    law:      with its taps, None if it was refused
    refused:  why, empty if it was not
    start:    the safe law that the taps were taken from, None for none
    verdicts: on the nominal machine and others that no step has seen, of `learned` and of `safe`,
              the best safe law of a few weights; empty where the gate refused
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

    def __repr__(self) -> str:
        return in_short(self)


@takes_population
@dataclasses.dataclass(frozen=True)
class LearnedLaw(Question):
    """The question which taps of L and Q suit an uncertain machine best; `run` answers it.

    1. The start: the taps of the best safe law of a few weights (`candidates`).
    2. The taps of least predicted error over the family, by its frequency responses; machines on
       which they break the bound join the family (`by_response`).
    3. The better of both, tuned through learning: least mean log e_J + 1/2 log max_j e_j, with the
       monotone condition over the family as a penalty. The segments of a law part only here.
    4. The gate: |keep - L P| <= 1 - margin on a denser family of other machines, and no growth from
       the ends of a trial on the nominal and the worst one. Taps that fail are taken back towards
       the start as far as needed; if nothing on the way passes, or the proof over all frequencies
       fails, the law is refused.
    5. A sweep over the nominal machine and others that no step has seen, beside the best safe law
       of a few weights.

    machine, task, trials, uncertainty, feedback, metric, margin, machines, seed, quantities:
        see `Question`.
        With several inputs and outputs the taps are full matrices.
    taps: odd numbers of taps of L and of Q
    start: of `STARTS`: the best `safe` law, the `p-type` one, the model `inverse`, or `nothing`.
        With `safe` the taps that are found from nothing are taken if they are better, and for
        several channels it is nothing.
    starts: first samples of the segments after the first, rising, which have taps of their own
    coupled: whether each input learns from all errors, or from that of its own channel only
    limit: () or (n_u,) largest |u| that is learned [unit of u]; None: no limit
    objective: number of one machine that the tuning makes small, None for that of step 3; the
        penalty comes on top
    risk: how the numbers of all machines are combined, as for `Tuning`; in step 2 too
    trained_on, held_out: numbers of machines of the tuning and of the choice of its best step
    steps: of the tuning; 0 for the taps by frequency response alone
    Raises ValueError for a setting that is not allowed.
    """

    taps: tuple[int, int] = (61, 31)
    start: str = "safe"
    starts: tuple[int, ...] = ()
    coupled: bool = True
    limit: Leaf | None = None
    objective: Objective | None = None
    risk: Risk = dataclasses.field(default_factory=Mean)
    trained_on: int = 32
    held_out: int = 32
    steps: int = 60
    __repr__ = in_short

    def __post_init__(self) -> None:
        super().__post_init__()
        require("LearnedLaw", "margin", self.margin, "(0, 0.9)")
        for name, least in (("trained_on", 1), ("held_out", 0), ("steps", 0)):
            require("LearnedLaw", name, getattr(self, name), f"[{least}, inf)", whole=True)
        need_known(f"start = {self.start!r}", self.start, STARTS)
        if self.task.inputs * self.task.outputs > 1 and self.start in ("p-type", "inverse"):
            raise ValueError(
                f"LearnedLaw: start = {self.start!r} is not possible with {self.task.inputs} "
                f"inputs and {self.task.outputs} outputs; allowed is 'nothing'"
            )
        for name, kind in KINDS.items():
            if not fits(value := getattr(self, name), kind):
                raise ValueError(f"LearnedLaw: {name} = {brief(value)}; {allowed(kind)}")
        if self.limit is not None:
            require("LearnedLaw", "limit", self.limit, "(0, inf)", many=True)
            need_channels(self, self.task.inputs, "limit")
        most = min(1001, 2 * ((self.task.N - 1) // 2) - 1)
        if not _whole(self.taps, 2) or any(n % 2 == 0 or not 1 <= n <= most for n in self.taps):
            raise ValueError(
                f"LearnedLaw: taps = {self.taps} are not allowed; allowed are two odd numbers, of "
                f"L and of Q, from 1 to {most} for a trial of {self.task.N} samples"
            )
        if not _whole(self.starts) or np.any(np.diff([0, *self.starts, self.task.N]) <= 0):
            raise ValueError(
                f"LearnedLaw: starts = {self.starts} are not allowed; allowed are whole samples "
                f"that rise within a trial of {self.task.N}"
            )

    def run(
        self, out: str | Path, *, resume: bool = False, told: Told = lambda stage, what: None
    ) -> Learned:
        """Learn the law, and judge it.

        out: folder for the taps of the start, the state of the tuning and the store of the sweep
        resume: go on with what is there; a run that was killed ends with the same taps
        told: called with `safe` and a Candidate or Absent; `found` and the taps by response;
            `tuning` and (step, loss); `gate` and the Passed or the refusal; `judging` and the
            machines; `proving` and the Candidate
        Raises FileExistsError for a folder that exists without `resume`, and ValueError for one of
        another question, and for a machine that is not allowed, before anything is simulated.
        """
        out = Path(out)
        family = self.resolved()
        safe = self._safe(family, told)
        taps = self.learned_taps(family, safe, out, resume=resume, told=told)
        nothing = Learned(
            None, "", taps.start, {}, None, None, taps.window, taps.family,
            self.trials, judged_trials(self.trials), self.machines,
        )  # fmt: skip
        if isinstance(taps.passed, str):
            return nothing._replace(refused=taps.passed)
        law = self.candidate(taps.window, taps.passed)
        told("proving", law)
        proof = proof_of(taps.family, law.scheme, self.task, between=True)
        laws = {LEARNED: law} | ({SAFE: safe[0]} if safe else {})
        told("judging", self.machines)
        judged = self.swept(list(laws.values()), out / "sweep.zarr", resume=resume)
        verdicts = dict(zip(laws, judged, strict=True))
        refused = proof.refuted or verdicts[LEARNED].lost
        return nothing._replace(
            law=None if refused else law,
            refused=refused,
            verdicts=verdicts,
            proof=proof,
            passed=taps.passed,
        )

    def resolved(self, **how: Value) -> Family:
        """The `family`, of any number of channels, with lines that resolve its taps."""
        return self.family(several=True, taps=max(self.taps), **how)

    def learned_taps(
        self, family: Family, safe: list[Candidate], out: Path, *, resume: bool, told: Told
    ) -> Taps:
        """The taps that passed the gate, or why none did: steps 2 to 4, from safe laws."""
        start, below = self._start_of(safe), 1 - self.margin - SPARE
        law = None if start is None else start.scheme
        laws = (law, None) if law is not None and self.start == "safe" else (law,)

        def at(lead: int) -> Window:
            return window_of(
                family, self.task, self.taps, starts=self.starts, limit=self.limit,
                coupled=self.coupled, lead=lead,
            )  # fmt: skip

        def joined(besides) -> Family:
            return self.resolved(besides=besides)

        def by_frequency() -> FirstTaps:
            lead, begin = best_of_leads(family, at, laws, self.task, self.trials, below, self.risk)
            return exchanged(
                family, joined, lambda turn: self.resolved(after=4 + turn, machines=WATCH),
                at(lead).unscheduled(), begin, self.task, self.trials, below,
                1 - self.margin - SPARE / 2, self.risk,
            )  # fmt: skip

        begun = kept_or(out, self, by_frequency, resume=resume)
        window = at(begun.lead)
        by_lines = window.throughout(begun.filters)
        first = held(window, law, self.task)
        told("found", by_lines)
        wider = joined(begun.besides) if begun.besides else family
        tuned = self._tuned(wider, window, (by_lines, first), out / "tuning", resume, told)
        dense = self.resolved(after=3, machines=DENSE, points=CLOSE)

        def ends(filters: Filters, machine: int) -> bool:
            return radius_in_a_trial(dense, window, filters, self.task, machine) < 1

        passed = gate(dense, window, tuned, (by_lines, first), self.task.dt, 1 - self.margin, ends)
        told("gate", passed)
        return Taps(start, window, dense, passed)

    def candidate(self, window: Window, passed: Passed) -> Candidate:
        """The law with taps that passed the gate."""
        p, q = self.taps
        words = f"u' = Q u + L e by learned filters, L of {p} taps and Q of {q}"
        if window.unit is not None:
            words += f", {self.task.inputs} x {self.task.outputs} matrices"
        if self.starts:
            words += f", in {len(self.starts) + 1} segments"
        scheme = under(window.of(passed.filters), self.feedback)
        return Candidate(LEARNED, words, scheme, {}, passed.largest, np.nan)

    def _safe(self, family: Family, told: Told) -> list[Candidate]:
        """The safe laws of a few weights, the best one first; none for several channels.

        What they learn is limited as the taps are.
        """
        if family.P.ndim > 2:
            return []
        laws, _ = self.safe(family, STARTS["safe"], told)
        laws = [law._replace(scheme=self._limited(law.scheme)) for law in laws]
        return sorted(laws, key=lambda one: one.predicted)

    def _limited(self, scheme: Value) -> Scheme:
        learning = scheme if self.feedback is None else scheme.learning
        paths = (path for path in settable(learning) if path.rpartition(".")[2] == "limit")
        return under(replaced(learning, dict.fromkeys(paths, self.limit)), self.feedback)

    def _start_of(self, safe: list[Candidate]) -> Candidate | None:
        """The safe law to begin with, None for none; raises ValueError for one that is not safe."""
        first = next((one for one in safe if one.name in STARTS[self.start]), None)
        if first is None and self.start in ("p-type", "inverse"):
            raise ValueError(
                f"LearnedLaw: start = {self.start!r} is not possible, as no weights of this law "
                f"keep the margin {self.margin:g} on every machine; allowed are 'safe', 'nothing' "
                "and a smaller margin"
            )
        return first

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
        made_small = self.objective or Final(self.metric) + RISE * Holding(1, self.metric)
        unsafe = penalty(family, 1 - self.margin - SPARE)
        weight = "z" if self.feedback is None else "learning.z"

        def problem(start: Filters) -> Tuning:
            return Tuning(
                family.population, under(ShapedFilter.around(window, start), self.feedback),
                self.task, self.trials, weights=[weight],
                objective=made_small + unsafe, risk=self.risk, machines=self.trained_on,
                held_out=self.held_out, steps=self.steps, rate=RATE, mode="reverse",
                quantities=self.quantities,
            )  # fmt: skip

        tuning = problem(starts[0])
        if (start := better_of(tuning, window, *starts)) is not starts[0]:
            tuning = problem(start)

        def tell(step: int, losses, _) -> None:
            told("tuning", (step, float(np.min(losses))))

        tuned = tuning.run(out, resume=resume and out.exists(), progress=tell)
        return window.moved(start, np.array(list(tuned.values.values())))


def _whole(values: Value, count: int | None = None) -> bool:
    """Whether these are whole numbers in a row, so many if it is given."""
    found = as_numbers(values)
    right = found is not None and found.ndim == 1 and count in (None, len(found))
    return right and all(map(is_whole, values))


def kept_or(
    folder: Path, asked: object, compute: Callable[[], FirstTaps], *, resume: bool
) -> FirstTaps:
    """The taps with which a tuning begins: those kept in its folder, or computed and kept there.

    Those in a damaged file are computed again. Raises FileExistsError for a folder with taps
    without `resume`, and ValueError for taps of another question, and for those of an earlier
    version that differ from segment to segment.
    """
    file = folder / BEGUN
    question = json.loads(json_text({"asked": describe(asked), "environment": environment()}))
    if file.exists():
        if not resume:
            need_free(folder)
        try:
            stored = as_json(unsealed(read_json(file)))
            need_same(folder, stored["question"], question, "made for another question")
            filters = Filters(*(np.asarray(stored[name], float) for name in Filters._fields))
            besides = {name: np.asarray(of, float) for name, of in stored["besides"].items()}
            kept = FirstTaps(filters, int(stored["lead"]), besides)
        except (Damaged, KeyError):
            log.warning("%s is damaged, or another file; its taps are computed again", file)
        else:
            if filters.keep.ndim % 2 == 0:
                raise ValueError(
                    f"{folder} was begun by an earlier version with other taps in each segment; "
                    "choose another place"
                )
            return kept
    need_described(question)
    taps = compute()
    folder.mkdir(parents=True, exist_ok=True)
    found, besides = (
        {name: np.asarray(values).tolist() for name, values in of.items()}
        for of in (taps.filters._asdict(), taps.besides)
    )
    write_json(file, sealed({"question": question, "lead": taps.lead, "besides": besides, **found}))
    return taps


def better_of(problem: Tuning, window: Window, one: Filters, other: Filters) -> Filters:
    """The filters of less loss on the held-out machines, the first of them where both are alike.

    problem: a tuning of the steps z of a `ShapedFilter` around `one`
    """
    steps = np.stack([np.zeros(window.number_of_steps()), window.steps(one, other)])
    of_one, of_other = problem.held_out_losses(dict(zip(problem.start, steps.T, strict=True)))
    return other if of_other < of_one or not np.isfinite(of_one) else one


# The gate
# --------------------------------------------------------------------------------------------------


def gate(
    family: Family,
    window: Window,
    learned: Filters,
    safer: Sequence[Filters],
    dt: float,
    most: float,
    ends: Callable[[Filters, int], bool] = lambda filters, machine: True,
) -> Passed | str:
    """The taps that were learned, taken back no further than |keep - L P| <= most asks, or why not.

    A tuning of a few trials may also end at taps with which learning diverges late, from an end of
    the trial, which the frequency does not tell; these are taken back too.

    Since |keep - L P| is convex in the taps, what lies between two laws is at no frequency worse
    than the worse of them, so a way back to a safe law ends at a safe law.

    safer: laws towards which the taps are taken back, one after the other
    ends: whether taps are safe at the ends of a trial of a machine of this number; it is asked of
        the nominal machine and of the worst one
    """
    for filters in safer:
        for way in WAYS:
            between = learned.towards(filters, float(way))
            sizes = np.max(sizes_of(family, window, between, dt), axis=1)
            worst, largest = int(np.argmax(sizes)), float(np.max(sizes))
            if largest <= most and all(ends(between, machine) for machine in {0, worst}):
                return Passed(between, float(way), largest)
    return _refusal(family, sizes_of(family, window, learned, dt), most)


def _refusal(family: Family, sizes: np.ndarray, most: float) -> str:
    which, line = np.unravel_index(int(np.argmax(sizes)), sizes.shape)
    if sizes[which, line] <= most:
        return (
            "learning would diverge from an end of the trial, where L looks for errors that do not "
            "exist, and no law on the way back to the start is safe there"
        )
    on = ", ".join(f"{name} = {values[which]:.4g}" for name, values in family.drawn.items())
    return (
        f"|Q (1 - L P)| is {sizes[which, line]:.3g} at {family.frequencies[line]:.3g} Hz"
        f"{f' on the machine with {on}' if on else ''}; allowed is {most:.3g}, and no law on the "
        "way back to the start keeps it"
    )
