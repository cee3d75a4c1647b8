"""`jaxilc worst-case`: the machine within the uncertainty with the largest final error."""

from __future__ import annotations

import dataclasses
from typing import Annotated

import typer

from .console import out
from .options import (
    DESIGN,
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
from .results import folder_of, written


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
    precision: Precision = "float64",
) -> None:
    """The worst machine by climbing the gradient of its error, against machines drawn by chance.

    A gradient counts as three evaluations on top of the one that it belongs to.

    Example: jaxilc worst-case cao-2019 --scheme cfdl-mfailc --trial 40 --draws 10000
    """
    from .asked import begin, chosen_scenario, spread_of

    begin(precision)
    from .. import figures
    from ..figures.report import command_report
    from ..tuning.worst_case import GRADIENT_COST
    from ..tuning.worst_machine import worst_machine
    from .tuning_numbers import worst_case_numbers
    from .tuning_tables import worst_case_tables

    at_least(1, trial=trial, starts=starts, steps=steps, draws=draws)
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
    )
    asked = {
        "scenario": scenario,
        "scheme": scheme,
        "trial": chosen.trials,
        "figure": chosen.judged_by,
        "unit": unit,
        "seed": seed,
        "params": None if params is None else str(params),
        "given": list(set_ or []),
    }
    numbers = asked | worst_case_numbers(found, wide.uncertainty)
    shown = worst_case_tables(chosen, numbers)
    for table in shown:
        out.print(table)
    folder = folder_of(out_dir, f"worst-case-{chosen.name}")
    axes = figures.worst_against_chance(
        found.by_chance,
        {name: search.value for name, search in found.searches.items()},
        nominal=found.nominal,
        metric=chosen.judged_by,
        unit=unit,
    )
    path = figures.save(axes, folder / "worst-case.png")
    page = command_report(
        report,
        "worst-case",
        shown,
        [path],
        scenario=wide,
        asked={"starts": starts, "steps": steps, "seed": seed},
    )
    written([path, *page], folder / "worst-case.json", numbers)
    if json_file is not None:
        written([], json_file, numbers)
