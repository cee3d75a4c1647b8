"""`jaxilc learn-law`: the update law itself, by its taps, learned and proved safe."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .completion import of_list
from .console import err, out
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
from .places import place_of, target_of
from .results import written

if TYPE_CHECKING:
    from ..design import Learned
    from ..scenarios import Scenario

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
    from .learn_law_lines import Progress

    chosen = scenario_to_design(plant_file, scheme, trials, set_)
    folder = state or Path("out") / f"learn-law-{chosen.name}"
    asked = LearnedLaw(
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
    with Progress(chosen, asked) as told:
        found = asked.run(place, resume=resume, told=told)
    _leave(chosen, found, plant_file, target, folder, json_file, report)
    if found.law is None:
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
    found: Learned,
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
    from ..sweeps.store import open_dataset
    from .learn_law_lines import law_numbers, law_table, lines_of, next_line
    from .live import of_a_store

    table, lines, paths = law_table(chosen, found), lines_of(chosen, found), []
    if found.verdicts:
        out.print(table)
    for line in lines:
        out.print(line, highlight=False)
    if found.law is not None:
        paths.append(write_design(target, plant_file, {found.law.name: found.law.scheme}, lines))
    if found.passed is not None:
        task = chosen.task
        unit = f"{task.input_unit}/{task.unit}" if task.input_unit and task.unit else ""
        law = figures.learned_law_figure(found, float(task.dt), unit=unit)
        paths.append(figures.save(law, folder / "law.png"))
    store, live = folder / "state" / "sweep.zarr", []
    if store.exists() and found.verdicts:
        scale, unit = chosen.shown(chosen.judged_by)
        judged = open_dataset(store)
        live = of_a_store(report, chosen, judged)
        band = figures.error_band(judged, metric=chosen.judged_by, scale=scale, unit=unit)
        paths.append(figures.save(band, folder / "learning.png"))
    page = command_report(
        report, "learn-law", [table], paths, scenario=chosen, lines=lines, live=live
    )
    numbers = law_numbers(chosen, found) | {"verdict": lines}
    written([*paths, *page], json_file, numbers)
    out.print(next_line(found, plant_file, target), highlight=False, soft_wrap=True)
