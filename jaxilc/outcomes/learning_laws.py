"""`learn_law`: the update law itself, by its taps, learned and proved safe."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .. import figures
from ..design import LearnedLaw
from ..design.candidates import Candidate
from ..design.learned import LEARNED, SAFE
from .designing import (
    about,
    judged_numbers,
    of_judged,
    on_the_machine,
    proof_numbers,
    safety_said,
    size_of,
    state_of,
    target_of,
    written,
)
from .outcome import Figure, Outcome, Progress, silent
from .request import Request
from .table import Table
from .terms import objective_of, risk_of
from .verdict import Verdict

if TYPE_CHECKING:
    from ..design import Learned
    from ..design.judging import Verdict as Judged
    from ..design.question import Told
    from ..scenarios import Scenario

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
    folder: Path | None = None,
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
    resume: whether to go on with the state in the folder
    folder: for the state and the figures; out/learn-law-NAME if not given
    say: called with a sentence when the taps by frequency response are found
    Raises ValueError naming what is allowed, and FileExistsError for what is not to be replaced.
    """
    request = Request.of(request)
    target = target_of(request, out, "learned", replace=force or resume)
    combined = risk_of(risk)
    chosen = request.machine_to_design()
    place = folder or Path("out") / f"learn-law-{chosen.name}"
    scale = chosen.shown(chosen.judged_by)[0]
    question = LearnedLaw(
        **about(chosen),
        taps=taps,
        start=start,
        starts=_samples(segments, float(chosen.task.dt)),
        coupled=coupled,
        limit=limit,
        objective=None if objective is None else objective_of(objective, chosen.judged_by, scale),
        risk=combined,
        margin=margin,
        trained_on=trained_on,
        held_out=trained_on,
        machines=machines,
        steps=steps,
        seed=seed,
        quantities=chosen.functions,
    )
    state = state_of(place, force=force, resume=resume)
    learned = question.run(state, resume=resume, told=_told(steps, progress, say))
    said = _sentences(chosen, learned)
    judged = of_judged(state, chosen, "learning", "The errors by trial") if learned.verdicts else {}
    law = {} if learned.passed is None else {"law": _law_figure(chosen, learned)}
    return Outcome(
        command="learn-law",
        numbers=_numbers(chosen, learned),
        verdict=_verdict(learned, said, request, target),
        folder=place,
        scenario=chosen,
        tables=[_table(chosen, learned)] if learned.verdicts else [],
        kept=written(request, target, learned.law, said) if learned.law else (),
        failed="" if learned.law else "the law is refused, and no plant file was written",
        **judged | {"figures": law | judged.get("figures", {})},
    )


def _samples(times: Sequence[float], dt: float) -> tuple[int, ...]:
    """The first samples of segments that begin at times [s]."""
    samples = [time / dt for time in times]
    if not all(map(math.isfinite, samples)):
        raise ValueError(f"segments = {times} are not allowed; allowed are times in seconds")
    return tuple(map(round, samples))


def _told(steps: int, progress: Progress, say: Progress) -> Told:
    """What the learning of a law tells of its course, as progress and as a sentence."""

    def told(stage: str, what: Any) -> None:
        if stage == "safe" and isinstance(what, Candidate):
            progress(f"frequency: {what.name}")
        elif stage == "found":
            follow = f"; {steps} steps through learning follow" if steps else ""
            say(f"The taps by frequency response are found{follow}.")
        elif stage == "tuning":
            step, loss = what
            progress(f"learning, loss {loss:.4g}", step, steps)
        elif stage in ("gate", "proving", "judging"):
            progress(stage)

    return told


def _law_figure(chosen: Scenario, learned: Learned) -> Figure:
    task = chosen.task
    unit = f"{task.input_unit}/{task.unit}" if task.input_unit and task.unit else ""
    return Figure(
        "The learned law in time and in frequency, beside the inverse of the plant.",
        partial(figures.learned_law_figure, learned, float(task.dt), unit=unit),
    )


def _table(chosen: Scenario, learned: Learned) -> Table:
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


def _sentences(chosen: Scenario, learned: Learned) -> tuple[str, ...]:
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
    return first, beside, safety_said(learned.proof)


def _numbers(chosen: Scenario, learned: Learned) -> dict[str, Any]:
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
    errors = _errors(one, learned.trials)
    return (
        f"Of {learned.machines} machines that it has not seen, half are at or below a "
        f"{chosen.judged_by.replace('_', ' ')} of {size(errors['median'])} in trial "
        f"{learned.trials} and 95 % at or below {size(errors['error_95'])}; to trial "
        f"{learned.long} 95 % stay at or below {size(one.error)}."
    )


def _gain(learned: Learned) -> float:
    """The median error of the best safe law, in units of that of the learned law."""
    ours, safe = (
        _errors(learned.verdicts[role], learned.trials)["median"] for role in (LEARNED, SAFE)
    )
    return safe / ours if ours > 0 else math.inf


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
    return (
        f"In the median that is {1 / gain:.3g} times more than with {law}{began}: take that one, "
        "or more --taps."
    )
