"""`jaxilc design`: which learning law, with which weights, and how safe it is."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

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
from .places import place_of, target_of
from .results import written

if TYPE_CHECKING:
    from ..design import Designed
    from ..scenarios import Scenario

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
    from .design_lines import Progress

    chosen = scenario_to_design(plant_file, scheme, trials, set_)
    folder = state or Path("out") / f"design-{chosen.name}"
    scale, _ = chosen.shown(chosen.judged_by)
    asked = Design(
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
    with Progress(chosen, steps) as told:
        found = asked.run(place, resume=resume, told=told)
    _leave(chosen, found, plant_file, target, folder, json_file, report)
    if found.chosen is None:
        err.print("no law is recommended, and no plant file was written", highlight=False)
        raise typer.Exit(1)


def _leave(
    chosen: Scenario,
    found: Designed,
    plant_file: Path,
    target: Path,
    folder: Path,
    json_file: Path | None,
    report: Path | None,
) -> None:
    """Print table and verdict, and write the plant file, the figure and what was asked for."""
    from .. import figures
    from ..figures.report import command_report
    from ..scenarios.design_file import write_design
    from ..sweeps.store import open_dataset
    from .design_lines import design_numbers, design_table, lines_of, lost_lines, next_line
    from .live import of_a_store

    table, best = design_table(chosen, found), found.chosen
    lines = lost_lines(found) if best is None else lines_of(chosen, found, best)
    out.print(table)
    for line in lines:
        out.print(line, highlight=False)
    paths = []
    if best is not None:
        candidate = best.verdict.candidate
        schemes = {candidate.name: candidate.scheme}
        paths.append(write_design(target, plant_file, schemes, lines))
    store, live = folder / "state" / "sweep.zarr", []
    if store.exists():
        scale, unit = chosen.shown(chosen.judged_by)
        judged = open_dataset(store)
        live = of_a_store(report, chosen, judged)
        band = figures.error_band(
            judged,
            metric=chosen.judged_by,
            tolerance=chosen.tolerance,
            scale=scale,
            unit=unit,
        )
        paths.append(figures.save(band, folder / "design.png"))
    page = command_report(report, "design", [table], paths, scenario=chosen, lines=lines, live=live)
    numbers = design_numbers(chosen, found)
    if best is not None:
        numbers |= {"verdict": lines, "next": f"jaxilc run {shlex.quote(str(target))}"}
    written([*paths, *page], json_file, numbers)
    if best is not None:
        out.print(next_line(target), highlight=False, soft_wrap=True)
