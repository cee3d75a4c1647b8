"""`jaxilc learn-law`: the update law itself, by its taps, learned and proved safe."""

from __future__ import annotations

import math
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from .completion import of_list
from .console import err, out
from .design import next_line, of_judged, place_of, proof_numbers, safety_said, target_of
from .options import (
    DESIGN,
    TERMS,
    FeedbackOf,
    FigureFormat,
    Force,
    Json,
    JudgedOn,
    Margin,
    OutPlant,
    OverMachines,
    PlantFile,
    Report,
    Resume,
    Seed,
    Set,
    Spread,
    StateFolder,
    Trials,
)
from .progress import progress_bar
from .results import show, written
from .titled_table import Table

if TYPE_CHECKING:
    from ..design import Learned, LearnedLaw
    from ..design.judging import Verdict
    from ..scenarios import Scenario

SAME = 1.02  # ratio of two errors up to which they count as equal
LEARNED, SAFE = "learned", "safe"  # names in `Learned.verdicts`
STARTS = ("safe", "p-type", "inverse", "nothing")


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command("learn-law", rich_help_panel=DESIGN)(learn_law)


def learn_law(
    plant_file: PlantFile,
    taps: Annotated[
        str, typer.Option(metavar="L,Q", help="Odd numbers of taps of L and of Q.")
    ] = "61,31",
    start: Annotated[
        str,
        typer.Option(
            help=f"Law to start from: {', '.join(STARTS)}.", autocompletion=of_list(*STARTS)
        ),
    ] = "safe",
    segments: Annotated[
        str,
        typer.Option(
            metavar="T,...", help="Times [s] at which a segment with taps of its own begins."
        ),
    ] = "",
    decentralised: Annotated[
        bool,
        typer.Option(
            "--decentralised", help="Of several channels, each input learns from its own error."
        ),
    ] = False,
    limit: Annotated[
        float | None, typer.Option(help="Largest |u| that is learned; none if not given.")
    ] = None,
    objective: Annotated[
        str | None,
        typer.Option(help=f"{TERMS} final + 0.5*holding:1 if not given.", show_default=False),
    ] = None,
    risk: OverMachines = "mean",
    scheme: FeedbackOf = None,
    margin: Margin = 0.05,
    trials: Trials = None,
    trained_on: Annotated[int, typer.Option(help="Machines on which the law is learned.")] = 32,
    machines: JudgedOn = 257,
    steps: Annotated[
        int, typer.Option(help="Steps through learning; 0 for the frequency response alone.")
    ] = 60,
    spread: Spread = None,
    seed: Seed = 0,
    set_: Set = None,
    out_file: OutPlant = None,
    force: Force = False,
    state: StateFolder = None,
    resume: Resume = False,
    json_file: Json = None,
    report: Report = None,
    figures: FigureFormat = None,
) -> None:
    """Learn the update law itself, the taps of L and Q, and prove it safe before it is written.

    The taps come from gradients through the learning of many machines. A law that
    is not safe on every machine of a dense family is taken back, or not written. Of
    several channels the taps are matrices; with --segments the law is scheduled.

    Example: jaxilc learn-law axis.toml --taps 61,31
    """
    target = target_of(plant_file, out_file, "learned", replace=force or resume)
    from .asked import begin, objective_asked, scenario_to_design, spread_of
    from .terms import risk_of

    counted, combined = _taps(taps), risk_of(risk)
    begin("float64")
    from ..design import LearnedLaw, feedback_among

    chosen = scenario_to_design(plant_file, scheme, trials, set_)
    folder = state or Path("out") / f"learn-law-{chosen.name}"
    question = LearnedLaw(
        chosen.machine,
        chosen.task,
        chosen.trials,
        spread_of(chosen, spread),
        feedback=feedback_among(chosen.schemes),
        taps=counted,
        start=start,
        starts=_samples(segments, float(chosen.task.dt)),
        coupled=not decentralised,
        limit=limit,
        objective=None if objective is None else objective_asked(chosen, objective),
        risk=combined,
        metric=chosen.judged_by,
        margin=margin,
        trained_on=trained_on,
        held_out=trained_on,
        machines=machines,
        steps=steps,
        seed=seed,
        quantities=chosen.functions,
    )
    place = place_of(folder / "state", force=force, resume=resume)
    with Progress(question) as progress:
        learned = question.run(place, resume=resume, told=progress)
    _leave(chosen, learned, plant_file, target, folder, json_file, report)
    if learned.law is None:
        err.print("the law is refused, and no plant file was written", highlight=False)
        raise typer.Exit(1)


def _taps(text: str) -> tuple[int, int]:
    """Two numbers, such as 61,31. Raises ValueError for other text."""
    try:
        of_L, of_Q = map(int, text.split(","))
    except ValueError:
        raise ValueError(
            f"--taps {text!r} is not allowed; allowed are two odd numbers, as in 61,31"
        ) from None
    return of_L, of_Q


def _samples(text: str, dt: float) -> tuple[int, ...]:
    """The first samples of segments that begin at times [s], such as 0.2,0.5."""
    try:
        return tuple(round(float(time) / dt) for time in text.split(",") if time.strip())
    except (ValueError, OverflowError):
        raise ValueError(
            f"--segments {text!r} is not allowed; allowed are times in seconds, as in 0.2,0.5"
        ) from None


def _leave(
    chosen: Scenario,
    learned: Learned,
    plant_file: Path,
    target: Path,
    folder: Path,
    json_file: Path | None,
    report: Path | None,
) -> None:
    """Print table and verdict, and write the plant file, the figures and what was asked for."""
    from .. import figures
    from ..figures.report import command_report
    from ..scenarios.design_file import write_design

    table, lines, paths, live = _table(chosen, learned), _lines_of(chosen, learned), [], []
    show([table] if learned.verdicts else [], lines)
    if learned.law is not None:
        law = learned.law
        paths.append(write_design(target, plant_file, {law.name: law.scheme}, lines))
    if learned.passed is not None:
        task = chosen.task
        unit = f"{task.input_unit}/{task.unit}" if task.input_unit and task.unit else ""
        axes = figures.learned_law_figure(learned, float(task.dt), unit=unit)
        paths.append(figures.save(axes, folder / "law.png"))
    if learned.verdicts:
        band, live = of_judged(folder / "state", folder / "learning.png", chosen, report)
        paths += band
    page = command_report(
        report, "learn-law", [table], paths, scenario=chosen, lines=lines, live=live
    )
    written([*paths, *page], json_file, _numbers(chosen, learned) | {"verdict": lines})
    out.print(_next_line(learned, plant_file, target), highlight=False, soft_wrap=True)


# What is printed
# --------------------------------------------------------------------------------------------------


class Progress:
    """A context whose value prints what the learning of a law has found so far, and shows a bar."""

    def __init__(self, question: LearnedLaw):
        self.steps = question.steps

    def __enter__(self) -> Progress:
        self.bar = progress_bar("said")
        self.bar.__enter__()
        self.whole = self.bar.add_task("frequency", total=self.steps or None, said="")
        return self

    def __exit__(self, *error) -> None:
        self.bar.__exit__(*error)

    def __call__(self, stage: str, what: Any) -> None:
        from ..design.candidates import Candidate

        if stage == "safe" and isinstance(what, Candidate):
            self.bar.update(self.whole, said=what.name)
        elif stage == "found":
            said = "The taps by frequency response are found"
            if self.steps:
                said += f"; {self.steps} steps through learning follow"
            out.print(f"{said}.", highlight=False, soft_wrap=True)
        elif stage == "tuning":
            step, loss = what
            self.bar.update(
                self.whole, description="learning", completed=step, said=f"loss {loss:.4g}"
            )
        elif stage in ("gate", "proving", "judging"):
            self.bar.update(self.whole, description=stage, said="")


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


def _lines_of(chosen: Scenario, learned: Learned) -> list[str]:
    """The verdict in sentences, without the next command."""
    if learned.law is None:
        return [
            f"The learned law is refused: {learned.refused}.",
            "More taps, a smaller --margin, or less uncertainty (a better fit, `jaxilc identify`) "
            "may give one that is not.",
        ]
    assert learned.passed is not None
    assert learned.proof is not None
    back = ""
    if learned.passed.way:
        back = f", taken back by {learned.passed.way:.0%} of the way to the start so as to be safe"
    begun = "Safe, but not the best" if _behind(learned) else f"Take {LEARNED}"
    lines = [f"{begun}: {learned.law.words}{back}. {_errors_said(chosen, learned)}"]
    if SAFE in learned.verdicts:
        lines.append(_compared(learned))
    elif learned.window.unit is not None:
        lines.append("There is no law of a few weights for several channels, to compare it with.")
    else:
        lines.append("No law of a few weights is safe on every machine, to compare it with.")
    lines.append(safety_said(learned.proof))
    return lines


def _next_line(learned: Learned, plant_file: Path, target: Path) -> str:
    """The next commands."""
    if learned.law is None:
        return f"Next: jaxilc design {shlex.quote(str(plant_file))}"
    if _behind(learned):
        return f"Next, for the safe law: jaxilc design {shlex.quote(str(plant_file))}"
    return next_line(target)


def _numbers(chosen: Scenario, learned: Learned) -> dict[str, Any]:
    """Every number of a learned law, as JSON."""
    scale, unit = chosen.shown(chosen.judged_by)
    filters = None if learned.passed is None else learned.passed.filters
    return {
        "metric": chosen.judged_by,
        "unit": unit,
        "trials": learned.trials,
        "judged_to_trial": learned.long,
        "machines": learned.machines,
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


def _errors(one: Verdict, trial: int) -> dict[str, float]:
    """Of one trial: the error that half, 95 % and all of the machines do not exceed."""
    of = one.summary
    both = {"median": of.median, "error_95": of.high, "worst": of.worst}
    return {name: float(values[trial - 1]) for name, values in both.items()}


def _errors_said(chosen: Scenario, learned: Learned) -> str:
    scale, unit = chosen.shown(chosen.judged_by)
    one, name = learned.verdicts[LEARNED], chosen.judged_by.replace("_", " ")
    errors = _errors(one, learned.trials)

    def size(value: float) -> str:
        return f"{value * scale:.3g} {unit}".rstrip()

    return (
        f"Of {learned.machines} machines that it has not seen, half are at or below a {name} of "
        f"{size(errors['median'])} in trial {learned.trials} and 95 % at or below "
        f"{size(errors['error_95'])}; to trial {learned.long} 95 % stay at or below "
        f"{size(one.error)}."
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
