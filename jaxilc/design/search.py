"""The search for a learning law: safe weights first, then tuned ones, judged on new machines."""

from __future__ import annotations

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
from .judging import Limits, Verdict, limits_of, long_run, ranked, verdict
from .proof import Proof, proof_of
from .responses import family_of
from .tuned import tuned

TUNED_ON, HELD_OUT = 24, 24  # machines
AT_ONCE = 2  # tunings
BY_FREQUENCY = "by-frequency"  # ends the name of a law whose weights were not tuned


class Recommended(NamedTuple):
    """The law that a design recommends, what theory says of it, and what limits its error."""

    verdict: Verdict
    proof: Proof
    limits: Limits


class Design(NamedTuple):
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
    plain = safe._replace(name=f"{safe.name}-{BY_FREQUENCY}")
    return [better] if better is safe else [better, plain]


def design_law(
    machine: Machine,
    task: Task,
    trials: int,
    uncertainty: Uncertainty,
    out: str | Path,
    *,
    feedback: Scheme | None = None,
    laws: Sequence[str] = (),
    metric: str = "settled_error",
    tolerance: float | None = None,
    margin: float = 0.1,
    machines: int = 257,
    steps: int = 30,
    seed: int = 0,
    resume: bool = False,
    told: Callable[[str, Any], object] = lambda stage, what: None,
) -> Design:
    """Try the laws of `candidates.LAWS` on an uncertain machine, and recommend one.

    1. Weights for which |Q (1 - L P)| <= 1 - margin at each frequency, on each machine at the
       corners of the uncertainty (and some within), with the least predicted error.
    2. These tuned by gradient through learning, on other machines, as far as 1. still holds.
    3. A sweep of all laws, with both weights, over machines that neither step has seen, for longer
       than asked.
    4. Of the law with the least 95 % error: the enclosed |Q (1 - L P)|, the certificates of the
       nominal and the worst machine, and which cause adds most to its error.

    machine, task, trials, uncertainty: as for `Sweep`; one input and one output
    out: folder for the states of the tunings and the store of the sweep
    feedback: under which the machine learns, None for none
    laws: names of `candidates.LAWS`, all if empty
    metric, tolerance: by which a law is judged, and its largest value that passes
    margin: in (0, 1)
    machines: of the sweep;  steps: of a tuning;  seed: of everything drawn
    resume: go on with what is in the folder; a design that was killed lost no finished step
    told: called with `safe` and a Candidate or Absent; `tuning` and (name, step, steps); `tuned`
        and the Candidate; `judging` and the machines; `judged` and the Verdicts; `proving` and the
        chosen Candidate
    Raises ValueError for a machine or a setting that is not allowed, before anything is compiled.
    """
    out = Path(out)
    require("design", "margin", margin, "(0, 1)")
    for name, value in (("trials", trials), ("machines", machines), ("steps", steps)):
        require("design", name, value, "[2, inf)", whole=True)
    for name in laws:
        if name not in LAWS:
            raise ValueError(not_one_of(f"law = {name!r}", name, LAWS))
    family = family_of(machine, feedback, task, uncertainty, seed=seed)
    safe: list[Candidate] = []
    absent: list[Absent] = []
    for found in candidates(family, feedback, task, trials, margin, laws or tuple(LAWS)):
        if isinstance(found, Candidate):
            safe.append(found)
        else:
            absent.append(found)
        told("safe", found)
    long = long_run(trials)
    nothing = Design(None, (), tuple(absent), trials, long, machines)
    if not safe:
        return nothing

    def improved(candidate: Candidate) -> Candidate:
        def tell(step: int, *_) -> None:
            told("tuning", (candidate.name, step, steps))

        state = out / f"tuning-{candidate.name}"
        found = tuned(
            candidate,
            family,
            machine,
            task,
            trials,
            uncertainty,
            metric=metric,
            margin=margin,
            out=state,
            resume=resume and state.exists(),
            progress=tell,
            machines=TUNED_ON,
            held_out=HELD_OUT,
            steps=steps,
            seed=seed,
        )
        told("tuned", found)
        return found

    with ThreadPoolExecutor(AT_ONCE) as threads:  # one compiles while the other computes
        better = list(threads.map(improved, safe))
    judging = [one for pair in zip(better, safe, strict=True) for one in _variants(*pair)]
    told("judging", machines)
    schemes, store = {one.name: one.scheme for one in judging}, out / "sweep.zarr"
    sweep = Sweep(machine, schemes, task, long, uncertainty, machines=machines, seed=seed + 2)
    summaries = summarise(
        sweep.run(store, resume=resume and store.exists()), tolerance, metric=metric
    )
    judged = [
        verdict(candidate, summary, trials, tolerance)
        for candidate, summary in zip(judging, summaries, strict=True)
    ]
    told("judged", judged)
    chosen: Recommended | None = None
    for one in ranked(judged):
        told("proving", one.candidate)
        scheme = one.candidate.scheme
        proof = proof_of(family, scheme, machine, task, uncertainty, trials)
        if not proof.refuted:
            limits = limits_of(scheme, machine, task, trials, metric, one.error)
            chosen = Recommended(one, proof, limits)
            judged.remove(one)
            break
        judged[judged.index(one)] = one._replace(lost=proof.refuted)
    others = sorted(judged, key=lambda one: (bool(one.lost), one.error))
    return nothing._replace(chosen=chosen, others=tuple(others))
