"""`design` and `learn_law`: a learning law for a machine, with its weights or by its taps."""

from __future__ import annotations

import math
import shlex
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TypeVar

from .. import figures
from ..design import Design, Designed, Learned, LearnedLaw, Recommended, feedback_among
from ..design.candidates import Absent, Candidate
from ..design.judging import LIKE, Limits, Proof, Told
from ..design.judging import Verdict as Judged
from ..design.learned import LEARNED, SAFE
from ..pytree.aliases import Value
from ..pytree.named_paths import get_at
from ..scenarios import Scenario
from ..scenarios.design_file import design_path, need_same_folder, write_design
from ..schemes import Scheme
from ..storage.columns import plain_unit
from ..storage.files import need_unused
from ..storage.sealed import Damaged, checksum, read_json, sealed, unsealed, write_json
from ..sweeps.store import open_dataset
from ..theory.on_lines import rounded
from ..uncertainty import Uncertainty
from .outcome import Figure, Interactive, Numbers, Outcome, Progress, Table, Verdict, silent
from .repeating import Following, following, recurs, repeats_in, within_numbers, within_trial
from .request import Request
from .sweeping import live_store
from .terms import objective_for, risk_of
from .words import FALLS, machine_said, number, several, size_of, trend_of

Q = TypeVar("Q")

NOTHING_RECURS = (
    "The record tells nothing of how the error repeats: what is new in each trial is larger, or "
    "the trial is too short."
)
STATE, WRITTEN = "state", "written.json"  # the folder of a state; what it wrote, by its checksum
EDGES = {"low": "notch from", "high": "notch to"}
CAUSES = {
    "law": "the filter and the number of trials",
    "limits": "the limits of the actuator",
    "noise": "noise",
    "machines": "the uncertainty of the machine",
}


def design(
    request: Request | str | Path,
    *,
    laws: Sequence[str] = (),
    margin: float = 0.05,
    machines: int = 257,
    steps: int = 30,
    seed: int = 0,
    record: str | Path | Sequence[str | Path] = (),
    out: str | Path | None = None,
    force: bool = False,
    resume: bool = False,
    folder: str | Path | None = None,
    progress: Progress = silent,
    say: Progress = silent,
) -> Outcome:
    """Which learning law for a machine, with which weights, is it safe, and what will it reach.

    With a record it tells whether the error repeats from trial to trial, in a period or in the
    position. For the latter two a law of its own is written beside the recommended one, where its
    condition holds.

    request: a plant file, or what is asked of one; the feedback of its scheme is taken
    laws, margin, machines, steps, seed: as for `Design`
    record: files of trials without learning, or the folder of a campaign, as for `potential`; a
        file without times has the sample time of the task
    out: plant file to write; beside the one given, as axis.design.toml, if not given
    force: whether that file, and the state in the folder, are replaced
    resume: whether to go on with the state in the folder, and replace what it has written
    folder: for the state and the figure; out/design-NAME if not given
    say: called with a sentence on the first safe answer, minutes before the end
    Raises ValueError naming what is allowed, and FileExistsError for what is not to be replaced.
    """
    request = Request.of(request)
    target = target_of(request, out, "design")
    chosen = request.machine_to_design()
    place = Path(folder or f"out/design-{chosen.name}")
    need_replaceable(target, place, force=force, resume=resume)
    within, lines = None, []
    if record:
        repeats = repeats_in(record, without=float(chosen.task.dt))
        own = chosen.task.unit
        repeats = repeats._replace(unit=repeats.unit or own, place=repeats.place or None)
        for what, unit in (("unit", repeats.unit), ("unit of its position", repeats.place)):
            if unit and own and plain_unit(unit) != plain_unit(own):
                raise ValueError(
                    f"record has the {what} {unit!r}, the task has {own!r}; allowed is one, in "
                    "which the law by position is written, and nothing is converted"
                )
        within = within_trial(repeats)
        lines = recurs(within, repeats) or [NOTHING_RECURS]
        say(lines[0])
    question = asked_of(
        Design, chosen, laws=tuple(laws), tolerance=chosen.look["tolerance"], margin=margin,
        machines=machines, steps=steps, seed=seed, quantities=chosen.functions,
    )  # fmt: skip
    state = state_of(place, force=force, resume=resume)
    designed = question.run(state, resume=resume, told=_told(chosen, steps, progress, say))
    best = designed.chosen
    said = _sentences(chosen, designed)
    further, numbers = Following(), _numbers(chosen, designed)
    if within is not None:
        ranked = [best.verdict] if best else []
        ranked += [one for one in designed.others if not one.lost]
        laws_found = [one.candidate.scheme for one in ranked]
        further = following(chosen, within, laws_found, progress)
        numbers |= within_numbers(within) | {"following": further.numbers}
    kept = []
    if best is not None:
        law = best.verdict.candidate
        schemes = {law.name: law.scheme} | further.schemes
        kept.append(written_by(state, target, request, schemes, said))
    shown, live = of_judged(state, chosen, "design", "The errors by trial of the laws")
    return Outcome(
        command="design",
        numbers=numbers,
        verdict=Verdict(said) if best is None else on_the_machine(said, target),
        folder=place,
        scenario=chosen,
        tables=[_table(chosen, designed)],
        lines=[*lines, *further.lines],
        kept=kept,
        failed="" if best else "no law is recommended, and no plant file was written",
        figures=shown,
        live=live,
    )


def _told(chosen: Scenario, steps: int, progress: Progress, say: Progress) -> Told:
    """What a design tells of its course, as progress and as a sentence on its first safe answer."""
    safe, done = [], {}
    progress("responses of all machines")

    def told(stage: str, what: object) -> None:
        if stage == "safe" and isinstance(what, Candidate | Absent):
            progress(f"frequency: {what.name}")
            if isinstance(what, Candidate):
                safe.append(what.name)
                if len(safe) == 1:
                    say(_first_answer(chosen, what))
        elif stage == "tuning" and isinstance(what, tuple):
            name, done[name], _ = what
            laws = {*safe, *done}
            progress(f"tuning {name}", sum(done.values()), steps * len(laws))
        elif stage == "judging":
            progress(f"judging on {what} machines")
        elif stage == "proving" and isinstance(what, Candidate):
            progress(f"certifying {what.name}")

    return told


# Of `learn_law` too
# --------------------------------------------------------------------------------------------------


def target_of(request: Request, out: str | Path | None, what: str) -> Path:
    """The plant file to write; raises ValueError where it may not lie there."""
    source = Path(request.source)
    if not request.of_file:
        raise ValueError(
            f"{source} is no plant file; allowed is a TOML or JSON file, such as `jaxilc init` "
            "writes. A scenario of a paper has laws of its own: `jaxilc tune` changes their weights"
        )
    target = Path(out) if out else design_path(source, what)
    need_same_folder(source, target)
    return target


def need_replaceable(target: Path, folder: Path, *, force: bool, resume: bool) -> None:
    """Raises FileExistsError for a plant file that would be replaced without having been asked for.

    To go on with a state replaces what this state has written, as it was written.
    """
    if force or not target.exists():
        return
    with suppress(OSError, Damaged, KeyError):
        known = unsealed(read_json(folder / STATE / WRITTEN))["plant file"]
        if resume and known == checksum(target.read_bytes()):
            return
    told = "add --force to replace it"
    if resume:
        told = (
            "the state does not say that it wrote it as it is; add --force beside --resume to "
            "replace the file alone"
        )
    raise FileExistsError(f"{target} exists already; {told}")


def written_by(
    state: Path, target: Path, request: Request, schemes: Mapping[str, Scheme], said: Iterable[str]
) -> Path:
    """Write a plant file as `write_design` does, and keep its checksum in the state."""
    path = write_design(target, request.source, schemes, said)
    write_json(state / WRITTEN, sealed({"plant file": checksum(path.read_bytes())}))
    return path


def state_of(folder: Path, *, force: bool, resume: bool) -> Path:
    """The folder for the state, without that of an earlier run, which is refused or replaced."""
    state = folder / STATE
    if state.exists() and not resume:
        need_unused(state)
        if not force:
            raise FileExistsError(
                f"{state} exists already; add --resume to go on with it, --force to begin anew, "
                "or choose another --state"
            )
        shutil.rmtree(state)
    return state


def asked_of(question: Callable[..., Q], chosen: Scenario, **settings: Value) -> Q:
    """A question of `jaxilc.design` on a plant file, with further settings of it."""
    return question(
        machine=chosen.machine, task=chosen.task, trials=chosen.trials,
        uncertainty=chosen.uncertainty, feedback=feedback_among(chosen.schemes),
        metric=chosen.judged_by,
        highest=math.inf if chosen.potential is None else chosen.potential.cutoff, **settings,
    )  # fmt: skip


def of_judged(
    state: Path, chosen: Scenario, name: str, what: str
) -> tuple[dict[str, Figure], Callable[[], Sequence[Interactive]]]:
    """The figure of the sweep that judged by its name, and the interactive one."""
    if not (store := state / "sweep.zarr").exists():
        return {}, tuple  # where nothing was judged
    judged = open_dataset(store)
    caption = f"{what} over the nominal machine and others that no step has seen."
    draw = partial(figures.error_band, judged, **chosen.look)
    return {name: Figure(caption, draw)}, partial(live_store, chosen, judged)


def on_the_machine(said: Sequence[str], target: Path) -> Verdict:
    """The verdict on a law that may be played: it is simulated first."""
    command = f"jaxilc run {shlex.quote(str(target))}"
    return Verdict(tuple(said), "before `jaxilc next` plays it on the machine", command)


def judged_numbers(chosen: Scenario, found: Designed | Learned) -> Numbers:
    """How the laws were judged, as JSON."""
    return {
        "metric": chosen.judged_by,
        "unit": chosen.shown(chosen.judged_by)[1],
        "trials": found.trials,
        "judged_to_trial": found.long,
        "machines": found.machines,
    }


def safety_said(proof: Proof, uncertainty: Uncertainty) -> str:
    """How safe a law is, where the margin is least, and what theory claims."""
    nominal, worst = proof.claims
    without = f" (of trials without {proof.without})" if proof.without else ""
    said = (
        f"|Q (1 - L P)|{without} is at most {proof.worst:.3f}, so the margin is "
        f"{proof.margin:.3f}; it is least at {proof.at:.3g} Hz"
    )
    if proof.machine:
        at = machine_said(proof.machine, uncertainty)
        said += f" on the worst of {several(proof.machines, 'machine')} ({at})"
    said += f"{_beyond(proof)}. Theory claims for the long run, of the nominal machine: {nominal}"
    said += f"; of the worst: {worst}." if proof.machine else "."
    doubts = {r for c, r in zip(proof.claims, proof.reasons, strict=True) if c == "not claimed"}
    return said + "".join(f" Not claimed because {reason}." for reason in sorted(doubts))


def _beyond(proof: Proof) -> str:
    """What is proved of machines that are none of the family."""
    said = ""
    if proof.whole is not None:
        at_most = f"proved to be at most {proof.whole.bound:.3f}, " if proof.whole.proved else ""
        which = "all machines between the ends of these numbers" if proof.machine else "the machine"
        said += f"; of {which} it is {at_most or 'not proved: '}{proof.whole.how}"
    if proof.further > 0:
        said += (
            "; each stable response from what is learned to the output may differ from its model "
            f"by {number(rounded(100 * proof.further))} % at any frequency that was tried"
        )
    return said


def proof_numbers(proof: Proof) -> Numbers:
    """The numbers of a proof, as JSON."""
    of_set = None
    if proof.whole is not None:
        of_set = {
            "bound": proof.whole.bound if proof.whole.proved else None,
            "how": proof.whole.how,
        }
    further = None if math.isnan(proof.further) else proof.further
    return proof._asdict() | {"margin": proof.margin, "whole": of_set, "further": further}


# Of `design`
# --------------------------------------------------------------------------------------------------


def _first_answer(chosen: Scenario, what: Candidate) -> str:
    scale, unit = chosen.shown_scale, chosen.shown_unit
    return (
        f"A first safe answer, by frequency alone: {_with_weights(what, chosen)}. "
        f"|Q (1 - L P)| is at most {what.largest:.2f}; predicted rms error of trial "
        f"{chosen.trials}: {what.predicted * scale:.3g} {unit}".rstrip()
        + ". Tuning and judging follow."
    )


def _with_weights(what: Candidate, chosen: Scenario) -> str:
    """A law with its weights in words, with the units that are known."""
    task = chosen.task
    units = dict.fromkeys(("cutoff", "low", "high"), " Hz")
    per = f" {task.input_unit}/{task.unit}" if task.input_unit and task.unit else ""
    units |= dict.fromkeys(("gamma_p", "gamma_d"), "" if task.input_unit == task.unit else per)
    said = [what.words]
    for path in what.bounds:
        name = path.rpartition(".")[2]
        value = f"{float(get_at(what.scheme, path)):.4g}{units.get(name, '')}"
        said.append(f"{EDGES.get(name, name)} = {value}")
    if lead := _lead(what.scheme):
        said.append(f"lead = {several(lead, 'sample')}")
    return ", ".join(said)


def _lead(scheme: Scheme | None) -> int:
    while scheme is not None:
        if (lead := getattr(scheme, "lead", None)) is not None:
            return int(lead)
        scheme = getattr(scheme, "learning", None) or getattr(scheme, "scheme", None)
    return 0


def _table(chosen: Scenario, designed: Designed) -> Table:
    """A row for each law that was tried: the recommended one first."""
    scale, unit = chosen.shown(chosen.judged_by)
    name = chosen.judged_by.replace("_", " ")
    table = Table(
        "law", "|Q (1 - L P)|", f"95 % [{unit}]" if unit else "95 %", "settled", "verdict",
        title=f"{chosen.name}: {name} on {designed.machines} machines, "
        f"{_trials_said(designed.trials, designed.long, 'trials')}",
    )  # fmt: skip
    best = None if designed.chosen is None else designed.chosen.verdict
    for one in (*((best,) if best else ()), *designed.others):
        verdict = "lost" if one.lost else "larger error"
        settled = f"trial {one.settled_at}" if one.settled_at else "–"
        if best is not None and not one.lost and one.error <= LIKE * best.error:
            verdict = "recommended" if one is best else "as good"
        table.add_row(
            one.candidate.name,
            f"{one.candidate.largest:.3f}",
            f"{one.error * scale:.4g}",
            "still falls" if _falls(one) else settled,
            verdict,
        )
    for one in designed.absent:
        table.add_row(one.name, "", "", "", "no safe weights")
    return table


def _sentences(chosen: Scenario, designed: Designed) -> tuple[str, ...]:
    """The verdict: why laws are out of question, and the one to take or what to do without one."""
    out_of_question = (
        *(f"{one.name}: {one.why}." for one in designed.absent),
        *(f"{one.candidate.name}: {one.lost}." for one in designed.others if one.lost),
    )
    if designed.chosen is not None:
        return *out_of_question, *_recommended(chosen, designed, designed.chosen)
    return (
        *out_of_question,
        "No law holds on every machine. Narrow the uncertainty (a better fit, `jaxilc identify`), "
        "lower --margin, or give the axis a feedback that damps its resonance.",
    )


def _recommended(chosen: Scenario, designed: Designed, best: Recommended) -> list[str]:
    one, size = best.verdict, partial(size_of, chosen)
    said = [
        f"Take {one.candidate.name}: {_with_weights(one.candidate, chosen)}.",
        f"Of {designed.machines} machines, the nominal one and {designed.machines - 1} that the "
        f"design has not seen, 95 % are at or below a {chosen.judged_by.replace('_', ' ')} of "
        f"{size(one.error)} in {_trials_said(designed.trials, designed.long)}; half of "
        f"them are at or below {size(one.median)}, all of them at or below {size(one.worst)}.",
        safety_said(best.proof, chosen.uncertainty),
    ]
    if chosen.tolerance is not None:
        said.append(
            f"Tolerance {chosen.tolerance:g} {chosen.shown(chosen.judged_by)[1]}: "
            + (
                f"95 % of the machines are within it in each trial from {one.tolerated_from} on."
                if one.tolerated_from
                else f"{one.summary.yield_share:.1%} of the machines are within it at the end; "
                "95 % is not reached."
            )
        )
    if chosen.potential is not None:
        floor, stop, cutoff = chosen.potential
        unit = chosen.task.unit
        said.append(
            f"Measured repeats leave {floor:.3g} {unit} to any law, and nothing is to be gained "
            f"above {cutoff:.4g} Hz: stop once a trial has an RMS error below {stop:.3g} {unit}."
        )
    return [
        *said,
        _stop_said(one, designed.trials, designed.long),
        _limits_said(best.limits, size, uncertain=bool(chosen.uncertainty)),
    ]


def _limits_said(limits: Limits, size: Callable[[float], str], *, uncertain: bool) -> str:
    """From which cause most of the error comes, and the error as each is added."""
    said = (
        f"Most of the error comes from {CAUSES[limits.largest]}: without noise and limits the "
        f"nominal machine reaches {size(limits.law)}, with the limits of the actuator "
        f"{size(limits.limits)}, with noise too {size(limits.noise)}"
    )
    if uncertain:
        said += f", and 95 % of the uncertain machines {size(limits.machines)}"
    return f"{said}."


def _trials_said(first: int, last: int, several: str = "each trial from") -> str:
    return f"trial {last}" if first == last else f"{several} {first} to {last}"


def _falls(one: Judged) -> bool:
    """Whether the error still falls, in the trials after those asked for or at the end of all."""
    return one.still_falls or trend_of(one.summary.high.tolist()).kind == FALLS


def _stop_said(one: Judged, trials: int, long: int) -> str:
    """After which trial to stop; trials, long: number of trials asked for, and run."""
    if one.still_falls:
        return (
            f"The error still falls after trial {trials}, by {one.gained_later:.0%} to "
            f"trial {long}: more trials than {trials} leave less."
        )
    if _falls(one):
        return f"The error still falls in trial {long}: more trials leave less."
    later = f" up to {long}" if 2 * one.settled_at > long else ""
    return f"Stop after trial {one.settled_at}: what later trials{later} gain is less than 5 %."


def _numbers(chosen: Scenario, designed: Designed) -> Numbers:
    """Every number of a design, as JSON."""
    scale, best = chosen.shown(chosen.judged_by)[0], designed.chosen

    def of(one: Judged) -> Numbers:
        law = one.candidate
        return {
            "law": law.name,
            "weights": {path: float(get_at(law.scheme, path)) for path in law.bounds},
            "lead": _lead(law.scheme),
            "largest_contraction": law.largest,
            "error_95": one.error * scale,
            "error_median": one.median * scale,
            "error_worst": one.worst * scale,
            "settled_at": one.settled_at,
            "tolerated_from": one.tolerated_from,
            "lost": one.lost,
        }

    return judged_numbers(chosen, designed) | {
        "chosen": None if best is None else of(best.verdict),
        "others": [of(one) for one in designed.others],
        "absent": {one.name: one.why for one in designed.absent},
        "limits": best and {k: v * scale for k, v in best.limits._asdict().items()},
        "proof": best and proof_numbers(best.proof),
    }


# `learn_law`: the update law itself, by its taps, learned and proved safe
# --------------------------------------------------------------------------------------------------


SAME = 1.02  # ratio of two errors up to which they count as equal


def learn_law(
    request: Request | str | Path,
    *,
    taps: tuple[int, int] = (61, 31),
    start: str = "safe",
    segments: Sequence[float] = (),
    coupled: bool = True,
    limit: float | None = None,
    objective: str | None = None,
    risk: str = "mean",
    margin: float = 0.05,
    trained_on: int = 32,
    machines: int = 257,
    steps: int = 60,
    seed: int = 0,
    out: str | Path | None = None,
    force: bool = False,
    resume: bool = False,
    folder: str | Path | None = None,
    progress: Progress = silent,
    say: Progress = silent,
) -> Outcome:
    """Learn the update law itself, the taps of L and Q, and prove it safe before it is written.

    request: a plant file, or what is asked of one; the feedback of its scheme is taken
    taps, start, coupled, limit, margin, trained_on, machines, steps, seed: as for `LearnedLaw`
    segments: times at which a segment with taps of its own begins [s]
    objective: as `jaxilc tune --objective` takes it, final + 0.5*holding:1 if not given
    risk: as `jaxilc tune --risk` takes it
    out: plant file to write; beside the one given, as axis.learned.toml, if not given
    force: whether that file, and the state in the folder, are replaced
    resume: whether to go on with the state in the folder, and replace what it has written
    folder: for the state and the figures; out/learn-law-NAME if not given
    say: called with a sentence when the taps by frequency response are found
    Raises ValueError naming what is allowed, and FileExistsError for what is not to be replaced.
    """
    request = Request.of(request)
    target = target_of(request, out, "learned")
    combined = risk_of(risk)
    chosen = request.machine_to_design()
    place = Path(folder or f"out/learn-law-{chosen.name}")
    need_replaceable(target, place, force=force, resume=resume)
    question = asked_of(
        LearnedLaw, chosen, taps=taps, start=start,
        starts=_samples(segments, float(chosen.task.dt)), coupled=coupled, limit=limit,
        objective=None if objective is None else objective_for(chosen, objective),
        risk=combined, margin=margin, trained_on=trained_on, held_out=trained_on, machines=machines,
        steps=steps, seed=seed, quantities=chosen.functions,
    )  # fmt: skip
    state = state_of(place, force=force, resume=resume)
    learned = question.run(state, resume=resume, told=_law_told(steps, progress, say))
    said = _law_sentences(chosen, learned)
    shown, live = of_judged(state, chosen, "learning", "The errors by trial")
    law, task = {}, chosen.task
    if learned.passed is not None:
        unit = f"{task.input_unit}/{task.unit}" if task.input_unit and task.unit else ""
        law["law"] = Figure(
            "The learned law in time and in frequency, beside the inverse of the plant.",
            partial(figures.learned_law_figure, learned, float(task.dt), unit=unit),
        )
    return Outcome(
        command="learn-law", numbers=_law_numbers(chosen, learned),
        verdict=_verdict(learned, said, request, target), folder=place, scenario=chosen,
        tables=[_law_table(chosen, learned)] if learned.verdicts else [],
        kept=[written_by(state, target, request, {LEARNED: learned.law.scheme}, said)]
        if learned.law
        else [],
        failed="" if learned.law else "the law is refused, and no plant file was written",
        figures=law | shown, live=live,
    )  # fmt: skip


def _samples(times: Sequence[float], dt: float) -> tuple[int, ...]:
    """The first samples of segments that begin at times [s]."""
    samples = [time / dt for time in times]
    if not all(map(math.isfinite, samples)):
        raise ValueError(f"segments = {times} are not allowed; allowed are times in seconds")
    return tuple(map(round, samples))


def _law_told(steps: int, progress: Progress, say: Progress) -> Told:
    """What the learning of a law tells of its course, as progress and as a sentence."""

    def told(stage: str, what: object) -> None:
        if stage == "safe" and isinstance(what, Candidate):
            progress(f"frequency: {what.name}")
        elif stage == "found":
            follow = f"; {steps} steps through learning follow" if steps else ""
            say(f"The taps by frequency response are found{follow}.")
        elif stage == "tuning" and isinstance(what, tuple):
            step, loss = what
            progress(f"learning, loss {loss:.4g}", step, steps)
        elif stage in ("gate", "proving", "judging"):
            progress(stage)

    return told


def _law_table(chosen: Scenario, learned: Learned) -> Table:
    """The errors of the last trial asked for: of the learned law, and of the best safe one."""
    scale, unit = chosen.shown(chosen.judged_by)
    at = f" [{unit}]" if unit else ""
    name = chosen.judged_by.replace("_", " ")
    table = Table(
        "law", "|Q (1 - L P)|", f"median{at}", f"95 %{at}", f"worst{at}",
        title=f"{chosen.name}: {name} of trial {learned.trials} on {learned.machines} machines",
    )  # fmt: skip
    for role, one in learned.verdicts.items():
        largest = (
            learned.proof.worst if role == LEARNED and learned.proof else one.candidate.largest
        )
        name = role if role == LEARNED else f"{one.candidate.name}, safe"
        errors = (f"{error * scale:.4g}" for error in _errors(one, learned.trials).values())
        table.add_row(name, f"{largest:.3f}", *errors)
    return table


def _verdict(learned: Learned, said: tuple[str, ...], request: Request, target: Path) -> Verdict:
    if learned.law is not None and not _behind(learned):
        return on_the_machine(said, target)
    what = "" if learned.law is None else "for the safe law"
    return Verdict(said, what, request.following("design", scheme="".join(request.schemes)))


def _law_sentences(chosen: Scenario, learned: Learned) -> tuple[str, ...]:
    """The verdict in sentences, without the next command."""
    if learned.law is None:
        return (
            f"The learned law is refused: {learned.refused}.",
            "More taps, a smaller --margin, or less uncertainty (a better fit, `jaxilc identify`) "
            "may give one that is not.",
        )
    assert learned.passed is not None
    assert learned.proof is not None
    back = ""
    if learned.passed.way:
        back = f", taken back by {learned.passed.way:.0%} of the way to the start so as to be safe"
    begun = "Safe, but not the best" if _behind(learned) else f"Take {LEARNED}"
    if SAFE in learned.verdicts:
        beside = _compared(learned)
    elif learned.window.unit is not None:
        beside = "There is no law of a few weights for several channels, to compare it with."
    else:
        beside = "No law of a few weights is safe on every machine, to compare it with."
    first = f"{begun}: {learned.law.words}{back}. {_errors_said(chosen, learned)}"
    return first, beside, safety_said(learned.proof, chosen.uncertainty)


def _law_numbers(chosen: Scenario, learned: Learned) -> Numbers:
    """Every number of a learned law, as JSON."""
    scale = chosen.shown(chosen.judged_by)[0]
    filters = None if learned.passed is None else learned.passed.filters
    return judged_numbers(chosen, learned) | {
        "refused": learned.refused,
        "start": None if learned.start is None else learned.start.name,
        "errors": {
            role: {"law": one.candidate.name}
            | {name: error * scale for name, error in _errors(one, learned.trials).items()}
            for role, one in learned.verdicts.items()
        },
        "way_back": None if learned.passed is None else learned.passed.way,
        "L": None if filters is None else filters.L.tolist(),
        "Q": None if filters is None else filters.keep.tolist(),
        "lead": learned.window.lead,
        "proof": learned.proof and proof_numbers(learned.proof),
    }


def _errors(one: Judged, trial: int) -> dict[str, float]:
    """Of one trial: the error that half, 95 % and all of the machines do not exceed."""
    of = one.summary
    both = {"median": of.median, "error_95": of.high, "worst": of.worst}
    return {name: float(values[trial - 1]) for name, values in both.items()}


def _errors_said(chosen: Scenario, learned: Learned) -> str:
    one, size = learned.verdicts[LEARNED], partial(size_of, chosen)
    errors, later = _errors(one, learned.trials), ""
    if learned.long > learned.trials:
        later = f"; in each trial to {learned.long} 95 % are at or below {size(one.error)}"
    return (
        f"Of {learned.machines} machines, the nominal one and {learned.machines - 1} that it has "
        "not seen, half are at or below a "
        f"{chosen.judged_by.replace('_', ' ')} of {size(errors['median'])} in trial "
        f"{learned.trials} and 95 % at or below {size(errors['error_95'])}{later}."
    )


def _gain(learned: Learned) -> float:
    """The median error of the best safe law, in units of that of the learned law."""
    ours, safe = (
        _errors(learned.verdicts[role], learned.trials)["median"] for role in (LEARNED, SAFE)
    )
    return 1.0 if safe == ours else safe / ours if ours > 0 else math.inf


def _behind(learned: Learned) -> bool:
    """Whether the best safe law of a few weights leaves clearly less error."""
    return SAFE in learned.verdicts and not _gain(learned) > 1 / SAME


def _compared(learned: Learned) -> str:
    safe, gain = learned.verdicts[SAFE].candidate, _gain(learned)
    law = f"the best safe law of a few weights, {safe.name}"
    began = " from which it began" if learned.start is safe else ""
    if gain > SAME:
        return f"In the median that is {gain:.3g} times less than with {law}{began}."
    if gain > 1 / SAME:
        return f"In the median that is as much as with {law}{began}: more taps gain nothing here."
    times = f"{1 / gain if gain else math.inf:.3g} times"
    return (
        f"In the median that is {times} more than with {law}{began}: take that one, or more --taps."
    )
