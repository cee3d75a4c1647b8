"""`jaxilc design`: which learning law, with which weights, and how safe it is.

`learn-law` has its files, its sentence on safety and its next command in the same way.
"""

from __future__ import annotations

import math
import shlex
import shutil
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from .completion import of_list
from .console import err, out
from .options import (
    DESIGN,
    FeedbackOf,
    FigureFormat,
    Force,
    Json,
    JudgedOn,
    Margin,
    OutPlant,
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
    from ..design import Designed, Recommended
    from ..design.candidates import Absent, Candidate
    from ..design.judging import Verdict
    from ..design.proof import Proof
    from ..scenarios import Scenario

EDGES = {"low": "notch from", "high": "notch to"}
CAUSES = {
    "law": "the filter and the number of trials",
    "limits": "the limits of the actuator",
    "noise": "noise",
    "machines": "the uncertainty of the machine",
}
LAWS = ("p-type", "pd-type", "p-type-notch", "model-inverse", "norm-optimal", "learned")


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command(rich_help_panel=DESIGN)(design)


def design(
    plant_file: PlantFile,
    law: Annotated[
        list[str] | None,
        typer.Option(
            help="Law to try; repeatable. All if not given.", autocompletion=of_list(*LAWS)
        ),
    ] = None,
    scheme: FeedbackOf = None,
    margin: Margin = 0.05,
    trials: Trials = None,
    machines: JudgedOn = 257,
    steps: Annotated[int, typer.Option(help="Steps of each tuning at most.")] = 30,
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
    """Which learning law for this machine, with which weights, is it safe, and what will it reach.

    It tries several laws: safe weights by the frequency response of all machines,
    tuned by gradient, one of them by its taps (see `learn-law`), and judged on machines
    that were not used. The best one is written to a plant file that every other command
    takes.

    Example: jaxilc design axis.toml
    """
    target = target_of(plant_file, out_file, "design", replace=force or resume)
    from .asked import begin, scenario_to_design, spread_of

    begin("float64")
    from ..design import Design, feedback_among

    chosen = scenario_to_design(plant_file, scheme, trials, set_)
    folder = state or Path("out") / f"design-{chosen.name}"
    scale, _ = chosen.shown(chosen.judged_by)
    question = Design(
        chosen.machine,
        chosen.task,
        chosen.trials,
        spread_of(chosen, spread),
        feedback=feedback_among(chosen.schemes),
        laws=tuple(law or ()),
        metric=chosen.judged_by,
        tolerance=None if chosen.tolerance is None else chosen.tolerance / scale,
        margin=margin,
        machines=machines,
        steps=steps,
        seed=seed,
    )
    place = place_of(folder / "state", force=force, resume=resume)
    with Progress(chosen, steps) as progress:
        designed = question.run(place, resume=resume, told=progress)
    _leave(chosen, designed, plant_file, target, folder, json_file, report)
    if designed.chosen is None:
        err.print("no law is recommended, and no plant file was written", highlight=False)
        raise typer.Exit(1)


def _leave(
    chosen: Scenario,
    designed: Designed,
    plant_file: Path,
    target: Path,
    folder: Path,
    json_file: Path | None,
    report: Path | None,
) -> None:
    """Print table and verdict, and write the plant file, the figure and what was asked for."""
    from ..figures.report import command_report
    from ..scenarios.design_file import write_design

    table, best = _table(chosen, designed), designed.chosen
    lines = _lost_lines(designed) if best is None else _lines_of(chosen, designed, best)
    show([table], lines)
    paths = []
    if best is not None:
        law = best.verdict.candidate
        paths.append(write_design(target, plant_file, {law.name: law.scheme}, lines))
    figures, live = of_judged(
        folder / "state", folder / "design.png", chosen, report, tolerance=chosen.tolerance
    )
    paths += figures
    page = command_report(report, "design", [table], paths, scenario=chosen, lines=lines, live=live)
    numbers = _numbers(chosen, designed)
    if best is not None:
        numbers |= {"verdict": lines, "next": f"jaxilc run {shlex.quote(str(target))}"}
    written([*paths, *page], json_file, numbers)
    if best is not None:
        out.print(next_line(target), highlight=False, soft_wrap=True)


# Files, of `learn-law` too
# --------------------------------------------------------------------------------------------------


def target_of(plant_file: Path, out_file: Path | None, what: str, *, replace: bool) -> Path:
    """The plant file to write; raises ValueError or FileExistsError where it may not be written.

    what: the middle of its name where no file is asked for, axis.design.toml for `design`
    """
    from ..scenarios.design_file import design_path, need_same_folder

    if plant_file.suffix not in (".toml", ".json"):
        raise ValueError(
            f"{plant_file} is no plant file; allowed is a TOML or JSON file, such as `jaxilc init` "
            "writes. A scenario of a paper has laws of its own: `jaxilc tune` changes their weights"
        )
    target = out_file or design_path(plant_file, what)
    need_same_folder(plant_file, target)
    if target.exists() and not replace:
        raise FileExistsError(f"{target} exists already; add --force to replace it")
    return target


def place_of(state: Path, *, force: bool, resume: bool) -> Path:
    """The folder for the state, without that of an earlier run if it is to be replaced."""
    if state.exists() and not resume:
        if not force:
            raise FileExistsError(
                f"{state} exists already; add --resume to go on with it, --force to begin anew, "
                "or choose another --state"
            )
        shutil.rmtree(state)
    return state


def of_judged(
    state: Path, file: Path, chosen: Scenario, report: Path | None, **options: Any
) -> tuple[list[Path], list]:
    """The figure of the sweep that judged, written to a file, and what the page shows of it.

    Both are empty where nothing was judged.

    state: folder of the state
    options: of `figures.error_band`
    """
    from .. import figures
    from ..sweeps.store import open_dataset
    from .live import of_a_store

    store = state / "sweep.zarr"
    if not store.exists():
        return [], []
    scale, unit = chosen.shown(chosen.judged_by)
    judged = open_dataset(store)
    live = of_a_store(report, chosen, judged)
    band = figures.error_band(judged, metric=chosen.judged_by, scale=scale, unit=unit, **options)
    return [figures.save(band, file)], live


# What is printed
# --------------------------------------------------------------------------------------------------


class Progress:
    """A context whose value prints what a design has found so far, and shows a bar."""

    def __init__(self, chosen: Scenario, steps: int):
        self.chosen, self.steps = chosen, steps
        self.lock, self.bars, self.first = threading.Lock(), {}, True

    def __enter__(self) -> Progress:
        self.bar = progress_bar("said")
        self.bar.__enter__()
        self.whole = self.bar.add_task("frequency", total=None, said="")
        return self

    def __exit__(self, *error) -> None:
        self.bar.__exit__(*error)

    def __call__(self, stage: str, what: Any) -> None:
        with self.lock:
            getattr(self, f"_{stage}")(what)

    def _safe(self, what: Candidate | Absent) -> None:
        from ..design.candidates import Candidate

        self.bar.update(self.whole, said=what.name)
        if self.first and isinstance(what, Candidate):
            self.first = False
            out.print(_first_answer(self.chosen, what), highlight=False, soft_wrap=True)

    def _tuning(self, what: tuple[str, int, int]) -> None:
        name, step, steps = what
        self.bar.update(self.whole, description="tuning", said="")
        if name not in self.bars:
            self.bars[name] = self.bar.add_task(f"tuning {name}", total=steps, said="")
        self.bar.update(self.bars[name], completed=step)

    def _tuned(self, what: Candidate) -> None:
        if what.name in self.bars:
            self.bar.update(self.bars[what.name], completed=self.steps, said="done")

    def _judging(self, what: int) -> None:
        self.bar.update(self.whole, description=f"judging on {what} machines")

    def _judged(self, what: list) -> None:
        self.bar.update(self.whole, description="judged")

    def _proving(self, what: Candidate) -> None:
        self.bar.update(self.whole, description=f"certifying {what.name}")


def _first_answer(chosen: Scenario, what: Candidate) -> str:
    scale, unit = chosen.shown_scale, chosen.shown_unit
    return (
        f"A first safe answer, by frequency alone: {_with_weights(what, chosen)}. "
        f"|Q (1 - L P)| is at most {what.largest:.2f}; predicted rms error of trial "
        f"{chosen.trials}: {what.predicted * scale:.3g} {unit}".rstrip()
        + ". Tuning and judging follow."
    )


def _with_weights(what: Candidate, chosen: Scenario) -> str:
    return ", ".join(filter(None, (what.words, _weights_of(what, chosen))))


def _weights_of(what: Candidate, chosen: Scenario) -> str:
    """The weights of a law in words, with the units that are known."""
    from ..pytree.named_paths import get_at

    task = chosen.task
    units = dict.fromkeys(("cutoff", "low", "high"), " Hz")
    per = f" {task.input_unit}/{task.unit}" if task.input_unit and task.unit else ""
    units |= dict.fromkeys(("gamma_p", "gamma_d"), "" if task.input_unit == task.unit else per)
    said = []
    for path in what.bounds:
        name = path.rpartition(".")[2]
        value = f"{float(get_at(what.scheme, path)):.4g}{units.get(name, '')}"
        said.append(f"{EDGES.get(name, name)} = {value}")
    lead = _lead(what.scheme)
    return ", ".join(said + ([f"lead = {lead} samples"] if lead else []))


def _lead(scheme: Any) -> int:
    while scheme is not None:
        if hasattr(scheme, "lead"):
            return int(scheme.lead)
        scheme = getattr(scheme, "learning", None) or getattr(scheme, "scheme", None)
    return 0


def _table(chosen: Scenario, designed: Designed) -> Table:
    """A row for each law that was tried: the recommended one first."""
    scale, unit = chosen.shown(chosen.judged_by)
    name = chosen.judged_by.replace("_", " ")
    table = Table(
        "law", "|Q (1 - L P)|", f"95 % [{unit}]" if unit else "95 %", "settled", "verdict",
        title=f"{chosen.name}: {name} on {designed.machines} machines, trials {designed.trials} to "
        f"{designed.long}",
    )  # fmt: skip
    best = None if designed.chosen is None else designed.chosen.verdict
    for one in (*((best,) if best else ()), *designed.others):
        verdict = "recommended" if one is best else "lost" if one.lost else "larger error"
        table.add_row(
            one.candidate.name,
            f"{one.candidate.largest:.3f}",
            f"{one.error * scale:.4g}",
            f"trial {one.settled_at}",
            verdict,
        )
    for one in designed.absent:
        table.add_row(one.name, "", "", "", "no safe weights")
    return table


def _lines_of(chosen: Scenario, designed: Designed, chosen_law: Recommended) -> list[str]:
    """The verdict in sentences, without the next command."""
    one, limits = chosen_law.verdict, chosen_law.limits
    scale, unit = chosen.shown(chosen.judged_by)

    def size(value: float) -> str:
        return f"{value * scale:.3g} {unit}".rstrip()

    name = chosen.judged_by.replace("_", " ")
    law = one.candidate
    lines = [
        *_reasons(designed),
        f"Take {law.name}: {_with_weights(law, chosen)}.",
        f"Of {designed.machines} machines that the design has not seen, 95 % stay at or below a "
        f"{name} of {size(one.error)} from trial {designed.trials} to {designed.long}; half of "
        f"them stay at or below {size(one.median)}, all of them at or below {size(one.worst)}.",
        safety_said(chosen_law.proof),
    ]
    if chosen.tolerance is not None:
        lines.append(
            f"Tolerance {chosen.tolerance:g} {unit}: "
            + (
                f"95 % of the machines are within it from trial {one.tolerated_from} on."
                if one.tolerated_from
                else f"{one.summary.yield_share:.0%} of the machines are within it at the end; "
                "95 % is not reached."
            )
        )
    lines += [
        f"Stop after trial {one.settled_at}: what later trials gain is less than 5 %.",
        f"Most of the error comes from {CAUSES[limits.largest]}: without noise and limits the "
        f"nominal machine reaches {size(limits.law)}, with the limits of the actuator "
        f"{size(limits.limits)}, with noise too {size(limits.noise)}, and 95 % of the uncertain "
        f"machines {size(limits.machines)}.",
    ]
    return lines


def next_line(target: Path) -> str:
    """The next commands."""
    file = shlex.quote(str(target))
    return (
        f"Next: jaxilc run {file}, and then on the machine: "
        f"jaxilc next --state out/campaign --plant-file {file} --out trial-1.csv"
    )


def safety_said(proof: Proof) -> str:
    """How safe a law is, where the margin is least, and what theory claims."""
    nominal, worst = proof.claims
    said = (
        f"|Q (1 - L P)| is at most {proof.worst:.3f}, so the margin is {proof.margin:.3f}; it is "
        f"least at {proof.at:.3g} Hz"
    )
    if proof.machine:
        at = ", ".join(f"{name} = {value:.4g}" for name, value in proof.machine.items())
        said += f" on the worst of {proof.machines} machines ({at})"
    said += f"{_beyond(proof)}. Theory claims for the long run, of the nominal machine: {nominal}"
    said += f"; of the worst: {worst}." if proof.machine else "."
    doubts = {r for c, r in zip(proof.claims, proof.reasons, strict=True) if c == "not claimed"}
    return said + "".join(f" Not claimed because {reason}." for reason in sorted(doubts))


def proof_numbers(proof: Proof) -> dict[str, Any]:
    """The numbers of a proof, as JSON."""
    of_set = None
    if proof.whole is not None:
        of_set = {
            "bound": proof.whole.bound if proof.whole.proved else None,
            "how": proof.whole.how,
        }
    further = None if math.isnan(proof.further) else proof.further
    return proof._asdict() | {"margin": proof.margin, "whole": of_set, "further": further}


def _beyond(proof: Proof) -> str:
    """What is proved of machines that are none of the family."""
    said = ""
    if proof.whole is not None:
        at_most = f"proved to be at most {proof.whole.bound:.3f}, " if proof.whole.proved else ""
        said += (
            f"; of the machines between these it is {at_most or 'not proved: '}{proof.whole.how}"
        )
    if proof.further > 0:
        said += (
            f"; each of them may differ from its model by {100 * proof.further:.2g} % at any "
            "frequency"
        )
    return said


def _lost_lines(designed: Designed) -> list[str]:
    """Why no law can be recommended, and what to do."""
    return [
        *_reasons(designed),
        "No law holds on every machine. Narrow the uncertainty (a better fit, `jaxilc identify`), "
        "lower --margin, or give the axis a feedback that damps its resonance.",
    ]


def _reasons(designed: Designed) -> list[str]:
    """Why laws are out of question."""
    return [
        *(f"{one.name}: {one.why}." for one in designed.absent),
        *(f"{one.candidate.name}: {one.lost}." for one in designed.others if one.lost),
    ]


def _numbers(chosen: Scenario, designed: Designed) -> dict[str, Any]:
    """Every number of a design, as JSON."""
    from ..pytree.named_paths import get_at

    scale, unit = chosen.shown(chosen.judged_by)

    def of(one: Verdict) -> dict[str, Any]:
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

    best = designed.chosen
    return {
        "metric": chosen.judged_by,
        "unit": unit,
        "trials": designed.trials,
        "judged_to_trial": designed.long,
        "machines": designed.machines,
        "chosen": None if best is None else of(best.verdict),
        "others": [of(one) for one in designed.others],
        "absent": {one.name: one.why for one in designed.absent},
        "limits": best and {k: v * scale for k, v in best.limits._asdict().items()},
        "proof": best and proof_numbers(best.proof),
    }
