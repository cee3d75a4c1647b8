"""`jaxilc list` shows the scenarios and their settings, `jaxilc run` learns on one machine."""

from __future__ import annotations

from typing import Annotated

import typer

from ..scenarios.catalogue import LISTED
from .completion import scenarios_from
from .console import out
from .options import (
    SIMULATE,
    Json,
    MetricName,
    OutFolder,
    Params,
    Precision,
    Report,
    ScenarioName,
    Schemes,
    Seed,
    Set,
    Trials,
)
from .results import folder_of, written
from .titled_table import Table


def register(app: typer.Typer) -> None:
    """Add the commands to the command line."""
    app.command("list", rich_help_panel=SIMULATE)(list_)
    app.command(rich_help_panel=SIMULATE)(run)


def list_(
    scenario: Annotated[
        str | None,
        typer.Argument(
            metavar="[SCENARIO]", help="Show all that can be set.", autocompletion=scenarios_from
        ),
    ] = None,
) -> None:
    """List the scenarios, or all that can be set in one.

    Example: jaxilc list cao-2019
    """
    if scenario is None:
        table = Table("scenario", "title", "schemes", "trials", "samples N")
        for name, (title, schemes, trials, samples) in LISTED.items():
            table.add_row(name, title, ", ".join(schemes), str(trials), str(samples))
        out.print(table)
        return
    from ..scenarios.from_file import load_scenario
    from . import tables
    from .asked import begin

    begin("float64")
    out.print(tables.settable_table(load_scenario(scenario)))


def run(
    scenario: ScenarioName,
    scheme: Schemes = None,
    trials: Trials = None,
    metric: MetricName = None,
    seed: Seed = 0,
    set_: Set = None,
    params: Params = None,
    out_dir: OutFolder = None,
    json_file: Json = None,
    report: Report = None,
    precision: Precision = "float64",
) -> None:
    """Learn on the nominal machine: errors beside the published ones, figures, dataset.

    Example: jaxilc run cao-2019 --scheme ffdl-mfailc --set ffdl-mfailc.lam=0.5
    """
    from .asked import begin, chosen_scenario

    begin(precision)
    import jax

    from ..figures.report import command_report
    from ..figures.whole_run import save_run
    from ..scenarios.judging import judged
    from ..storage.files import whole_folder
    from ..sweeps import runs
    from . import numbers, tables

    chosen = judged(chosen_scenario(scenario, scheme, trials, set_, params), metric)
    dataset, _ = runs.run_schemes(
        chosen.machine,
        chosen.schemes,
        chosen.task,
        chosen.trials,
        key=jax.random.key(seed),
        quantities=chosen.functions,
    )
    found = numbers.run_numbers(chosen, dataset)
    by_axis = tables.axes_table(found)
    shown = [tables.run_table(chosen, found), tables.last_trial_table(found)]
    shown += [] if by_axis is None else [by_axis]
    lines = [*tables.course_lines(found), *tables.other_rows(chosen, found)]
    if chosen.published and (set_ or params):
        lines.append(
            "published values hold for the scenario as it stands; --set or --params changed it here"
        )
    for table in shown:
        out.print(table)
    for line in lines:
        out.print(line, highlight=False)
    for note in chosen.chosen:
        out.print(f"chosen: {note}", style="dim", highlight=False)

    folder = folder_of(out_dir, f"run-{chosen.name}")
    paths = save_run(chosen, dataset, folder, numbers.shown_trials(chosen))
    with whole_folder(folder / "dataset.zarr", replace=True) as store:
        dataset.to_zarr(store, consolidated=False)
    page = command_report(report, "run", shown, paths, scenario=chosen, lines=lines)
    written([*paths, *page, folder / "dataset.zarr"], json_file, found)
