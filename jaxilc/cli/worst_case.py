"""`jaxilc worst-case`: the machine within the uncertainty with the largest final error."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from .options import (
    DESIGN,
    FigureFormat,
    Json,
    OneScheme,
    OutFolder,
    Params,
    Precision,
    Report,
    ScenarioName,
    Seed,
    Set,
    Spread,
    at_least,
)
from .results import folder_of, show, written
from .verdicts.next_command import Asked

if TYPE_CHECKING:
    from ..scenarios import Scenario
    from ..tuning.worst_machine import WorstMachine


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command(rich_help_panel=DESIGN)(worst_case)


def worst_case(
    scenario: ScenarioName,
    scheme: OneScheme,
    trial: Annotated[
        int | None,
        typer.Option(help="Trial whose metric is to be large; the scenario's last if not given."),
    ] = None,
    starts: Annotated[int, typer.Option(help="Places to climb from.")] = 16,
    steps: Annotated[int, typer.Option(help="Steps of each climb.")] = 30,
    evaluations: Annotated[
        int | None,
        typer.Option(help="Learning processes to spend on either search, in place of --steps."),
    ] = None,
    draws: Annotated[int | None, typer.Option(help="A larger search by chance besides.")] = None,
    spread: Spread = None,
    seed: Seed = 0,
    set_: Set = None,
    params: Params = None,
    out_dir: OutFolder = None,
    json_file: Json = None,
    report: Report = None,
    figures: FigureFormat = None,
    precision: Precision = "float64",
) -> None:
    """The worst machine by climbing the gradient of its error, against machines drawn by chance.

    A gradient counts as three evaluations on top of the one that it belongs to.

    Example: jaxilc worst-case cao-2019 --scheme cfdl-mfailc --trial 40 --draws 10000
    """
    from .progress import working
    from .tuning_numbers import worst_case_numbers

    at_least(1, trial=trial, starts=starts, steps=steps, draws=draws)
    with working("worst-case") as told:
        from .asked import begin, chosen_scenario, spread_of

        begin(precision)
        from ..tuning.worst_case import GRADIENT_COST
        from ..tuning.worst_machine import worst_machine

        at_least(starts * (1 + GRADIENT_COST), evaluations=evaluations)
        chosen = chosen_scenario(scenario, [scheme], trial, set_, params)
        wide = dataclasses.replace(chosen, uncertainty=spread_of(chosen, spread))
        scale, unit = chosen.shown(chosen.judged_by)
        found = worst_machine(
            chosen.machine,
            chosen.schemes[scheme],
            chosen.task,
            chosen.trials,
            wide.uncertainty,
            metric=chosen.judged_by,
            scale=scale,
            quantities=chosen.functions,
            starts=starts,
            steps=steps,
            evaluations=evaluations,
            draws=draws,
            seed=seed,
            progress=lambda done, whole, name: told(name, done, whole),
        )
    options = {
        "scenario": scenario,
        "scheme": scheme,
        "trial": chosen.trials,
        "figure": chosen.judged_by,
        "unit": unit,
        "seed": seed,
        "params": None if params is None else str(params),
        "given": list(set_ or []),
    }
    numbers = options | worst_case_numbers(found, wide.uncertainty)
    asked = Asked(scenario, (scheme,), tuple(set_ or ()), params, trial, spread)
    folder = folder_of(out_dir, f"worst-case-{chosen.name}")
    of_search = {"starts": starts, "steps": steps, "seed": seed}
    _finish(_Found(wide, found, numbers, folder), asked, of_search, json_file, report)


class _Found(NamedTuple):
    """A search that is done: scenario, result, its numbers, and the folder for results."""

    chosen: Scenario
    worst: WorstMachine
    numbers: dict[str, Any]
    folder: Path


def _finish(
    found: _Found,
    asked: Asked,
    options: dict[str, int],
    json_file: Path | None,
    report: Path | None,
) -> None:
    """Print the tables and the verdict of a search, and write its files.

    options: further options, by name, for the report
    """
    from .. import figures
    from ..figures.report import command_report
    from ..storage.sealed import write_json
    from .live import of_worst_case, unexplored
    from .tuning_tables import worst_case_tables
    from .verdicts.case import Case
    from .verdicts.tuning import worst_case_verdict

    chosen, worst, numbers, folder = found
    shown = worst_case_tables(chosen, numbers)
    show(shown)
    axes = figures.worst_against_chance(
        worst.by_chance,
        {name: search.value for name, search in worst.searches.items()},
        nominal=worst.nominal,
        metric=chosen.judged_by,
        unit=numbers["unit"],
    )
    path = figures.save(axes, folder / "worst-case.png")
    verdict = worst_case_verdict(Case.of(chosen, asked), numbers["scheme"], numbers)
    page = command_report(
        report,
        "worst-case",
        shown,
        unexplored([path]),
        scenario=chosen,
        verdict=verdict,
        live=of_worst_case(report, chosen, worst),
        asked=options,
    )
    numbers |= verdict.as_json()
    write_json(folder / "worst-case.json", numbers)
    written([path, *page, folder / "worst-case.json"], json_file, numbers, verdict)
