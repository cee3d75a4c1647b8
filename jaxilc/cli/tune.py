"""`jaxilc tune`: weights tuned by gradients through the learning process."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .console import err, out
from .options import (
    DESIGN,
    TERMS,
    Bounds,
    HeldOut,
    Json,
    OneScheme,
    Optimiser,
    OutFolder,
    OverMachines,
    Params,
    Precision,
    Rate,
    Report,
    Resume,
    Sampling,
    ScenarioName,
    Seed,
    Set,
    Spread,
    Starts,
    Steps,
    Trials,
    TunedOn,
    Unseen,
    Weights,
    at_least,
)
from .results import parameter_file, unless_there, written


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command(rich_help_panel=DESIGN)(tune)


def tune(
    scenario: ScenarioName,
    scheme: OneScheme,
    weights: Weights,
    bounds: Bounds = None,
    objective: Annotated[str, typer.Option(help=TERMS)] = "final",
    risk: OverMachines = "mean",
    trials: Trials = None,
    machines: TunedOn = 32,
    held_out: HeldOut = 32,
    unseen: Unseen = 257,
    compare_trials: Annotated[
        int | None, typer.Option(help="Trials of the comparison; those of the tuning if not given.")
    ] = None,
    steps: Steps = 100,
    starts: Starts = 1,
    rate: Rate = 0.1,
    optimiser: Optimiser = "adam",
    spread: Spread = None,
    sampling: Sampling = "sobol",
    seed: Seed = 0,
    set_: Set = None,
    params: Params = None,
    out_dir: OutFolder = None,
    resume: Resume = False,
    json_file: Json = None,
    report: Report = None,
    precision: Precision = "float64",
) -> None:
    """Tune weights by gradient through the learning, and compare them on machines not seen.

    Example: jaxilc tune cao-2019 --scheme cfdl-mfailc --weights lam,eta,mu,phi0
    --set cfdl-mfailc.lead=3 --objective holding:20
    """
    from .progress import run_tuning, thread_for_later, tuning_bar

    with tuning_bar(steps) as show:
        from .asked import begin, chosen_scenario, objective_asked, tuning_problem

        begin(precision)
        chosen = chosen_scenario(scenario, [scheme], trials, set_, params)
        problem = tuning_problem(
            chosen,
            scheme,
            weights=weights,
            bounds=bounds,
            spread=spread,
            objective=objective_asked(chosen, objective),
            risk=risk,
            options={
                "steps": steps,
                "starts": starts,
                "rate": rate,
                "optimiser": optimiser,
                "machines": machines,
                "held_out": held_out,
                "sampling": sampling,
                "seed": seed,
            },
        )
        at_least(1, unseen=unseen, compare_trials=compare_trials)
        folder = out_dir or Path("out") / f"tune-{chosen.name}"
        # This raises before the tuning what would be raised after it.
        comparison = problem.comparison(trials=compare_trials, machines=unseen)
        state = unless_there(folder / "state", resume)
        later = thread_for_later(comparison.compile)
        tuned = run_tuning(problem, state, show, resume=resume, later=later)
        show("comparing")
        dataset = problem.compare(tuned, trials=compare_trials, machines=unseen)

    from ..figures.report import command_report
    from .tuning_numbers import tuning_numbers
    from .tuning_tables import tuning_lines, tuning_tables

    numbers = tuning_numbers(chosen, scheme, tuned, dataset)
    shown = tuning_tables(chosen, numbers)
    result, warnings = tuning_lines(tuned, numbers)
    for table in shown:
        out.print(table)
    out.print(result, highlight=False)
    for line in warnings:
        err.print(line, highlight=False)
    paths = [
        parameter_file(
            folder / "params.json",
            chosen,
            command="jaxilc tune",
            source=scenario,
            scheme=scheme,
            tuned=tuned,
            held_out_loss=numbers["held_out"],
            configuration=problem.configuration(),
        ),
        *_figures(folder, chosen, tuned, dataset),
    ]
    page = command_report(
        report,
        "tune",
        shown,
        paths,
        scenario=chosen,
        configuration=problem.configuration(),
        lines=[result, *warnings],
        asked={"weights": weights, "objective": objective, "risk": risk},
    )
    written([*paths, *page], json_file, numbers)


def _figures(folder: Path, chosen, tuned, dataset) -> list[Path]:
    """Write the loss of each step, and the error of the given and the tuned weights by trial."""
    from .. import figures

    scale, unit = chosen.shown(chosen.judged_by)
    band = figures.error_band(dataset, metric=chosen.judged_by, scale=scale, unit=unit)
    return [
        figures.save(figures.loss_by_step(tuned), folder / "loss.png"),
        figures.save(band, folder / "learning.png"),
    ]
