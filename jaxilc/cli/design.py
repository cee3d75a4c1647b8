"""`jaxilc design`: which learning law, with which weights, and how safe it is."""

from __future__ import annotations

import shlex
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .completion import of_list, schemes_from
from .console import err, out
from .options import (
    DESIGN,
    FigureFormat,
    Json,
    Report,
    Resume,
    Seed,
    Set,
    Spread,
    Trials,
    file_to_write,
    folder_to_write,
)
from .results import written

if TYPE_CHECKING:
    from ..design import Designed
    from ..scenarios import Scenario

LAWS = ("p-type", "pd-type", "p-type-notch", "model-inverse", "norm-optimal")


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command(rich_help_panel=DESIGN)(design)


def design(
    plant_file: Annotated[
        Path, typer.Argument(metavar="FILE", help="Plant file, TOML or JSON; see `jaxilc init`.")
    ],
    law: Annotated[
        list[str] | None,
        typer.Option(
            help="Law to try; repeatable. All if not given.", autocompletion=of_list(*LAWS)
        ),
    ] = None,
    scheme: Annotated[
        str | None,
        typer.Option(
            "--scheme",
            help="Scheme of the file whose feedback is taken.",
            autocompletion=schemes_from,
        ),
    ] = None,
    margin: Annotated[
        float, typer.Option(help="Least distance of |Q (1 - L P)| from 1, on every machine.")
    ] = 0.05,
    trials: Trials = None,
    machines: Annotated[
        int, typer.Option("--machines", help="Machines on which the laws are judged.")
    ] = 257,
    steps: Annotated[int, typer.Option(help="Steps of each tuning at most.")] = 30,
    spread: Spread = None,
    seed: Seed = 0,
    set_: Set = None,
    out_file: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="FILE",
            help="Plant file to write; axis.design.toml for axis.toml if not given.",
            callback=file_to_write,
        ),
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Replace that file, and its state.")
    ] = False,
    state: Annotated[
        Path | None,
        typer.Option(
            help="Folder for the state; out/design-NAME if not given.", callback=folder_to_write
        ),
    ] = None,
    resume: Resume = False,
    json_file: Json = None,
    report: Report = None,
    figures: FigureFormat = None,
) -> None:
    """Which learning law for this machine, with which weights, is it safe, and what will it reach.

    It tries several laws: safe weights by the frequency response of all machines,
    tuned by gradient, and judged on machines that were not used. The best one is
    written to a plant file that every other command takes.

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
    store = folder / "state" / "sweep.zarr"
    if store.exists():
        scale, unit = chosen.shown(chosen.judged_by)
        band = figures.error_band(
            open_dataset(store),
            metric=chosen.judged_by,
            tolerance=chosen.tolerance,
            scale=scale,
            unit=unit,
        )
        paths.append(figures.save(band, folder / "design.png"))
    page = command_report(report, "design", [table], paths, scenario=chosen, lines=lines)
    numbers = design_numbers(chosen, found)
    if best is not None:
        numbers |= {"verdict": lines, "next": f"jaxilc run {shlex.quote(str(target))}"}
    written([*paths, *page], json_file, numbers)
    if best is not None:
        out.print(next_line(target), highlight=False, soft_wrap=True)
