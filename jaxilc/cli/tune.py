"""`jaxilc tune`: weights tuned by gradients through the learning process."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

from .console import err
from .options import (
    DESIGN,
    TERMS,
    Bounds,
    FigureFormat,
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
from .results import parameter_file, show, unless_there, written
from .verdicts.next_command import Asked

if TYPE_CHECKING:
    import xarray as xr

    from ..scenarios import Scenario
    from ..tuning import Tuned, Tuning


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command(rich_help_panel=DESIGN)(tune)


def tune(
    scenario: ScenarioName,
    scheme: OneScheme,
    weights: Weights,
    bounds: Bounds = None,
    objective: Annotated[str, typer.Option(help=TERMS)] = "final",
    limit: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=NUMBER",
            help="Largest d2 (Cao 2019, every machine) or contraction (nominal); repeatable.",
        ),
    ] = None,
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
    figures: FigureFormat = None,
    precision: Precision = "float64",
) -> None:
    """Tune weights by gradient through the learning, and compare them on machines not seen.

    Example: jaxilc tune cao-2019 --scheme cfdl-mfailc --weights lam,eta,mu,phi0
    --set cfdl-mfailc.lead=3 --objective holding:20
    """
    from .progress import run_tuning, thread_for_later, tuning_bar
    from .terms import limits_not_met, with_limits

    with tuning_bar(steps) as told:
        from .asked import begin, chosen_scenario, expanded, objective_asked, tuning_problem

        begin(precision)
        objective = with_limits(objective, limit)
        trials, set_, params = expanded(scenario, [scheme], trials, set_, params)
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
        tuned = run_tuning(problem, state, told, resume=resume, later=later)
        told("comparing")
        dataset = problem.compare(tuned, trials=compare_trials, machines=unseen)
    asked = Asked(scenario, (scheme,), tuple(set_ or ()), params, trials, spread)
    options = {"weights": weights, "objective": objective, "risk": risk}
    found = _Found(chosen, scheme, problem, tuned, dataset, limits_not_met(problem, tuned, limit))
    _finish(found, asked, folder, json_file, report, options)


class _Found(NamedTuple):
    """A tuning that is done.

    chosen: the scenario, with the scheme of this name
    problem, tuned: what was solved, and its result
    dataset: result of `Tuning.compare`
    not_met: sentences on limits that the weights exceed
    """

    chosen: Scenario
    scheme: str
    problem: Tuning
    tuned: Tuned
    dataset: xr.Dataset
    not_met: list[str]


def _finish(
    found: _Found,
    asked: Asked,
    folder: Path,
    json_file: Path | None,
    report: Path | None,
    options: dict[str, str],
) -> None:
    """Print the tables and the verdict of a tuning, and write its files.

    options: further options, by name, for the report
    """
    from ..figures.report import command_report
    from .live import of_a_store
    from .tuning_numbers import tuning_numbers
    from .tuning_tables import tuning_lines, tuning_tables
    from .verdicts.case import Case
    from .verdicts.tuning import tune_verdict

    chosen, scheme, problem, tuned, dataset, not_met = found
    numbers = tuning_numbers(chosen, scheme, tuned, dataset)
    shown = tuning_tables(chosen, numbers)
    result, warnings = tuning_lines(tuned, numbers)
    warnings += not_met
    show(shown, [result])
    for line in warnings:
        err.print(line, highlight=False)
    params = parameter_file(
        folder / "params.json",
        chosen,
        command="jaxilc tune",
        source=asked.source,
        scheme=scheme,
        tuned=tuned,
        held_out_loss=numbers["held_out"],
        configuration=problem.configuration(),
    )
    paths = [params, *_figures(folder, chosen, tuned, dataset)]
    verdict = tune_verdict(Case.of(chosen, asked), numbers, params)
    page = command_report(
        report,
        "tune",
        shown,
        paths,
        scenario=chosen,
        configuration=problem.configuration(),
        lines=[result, *warnings],
        verdict=verdict,
        live=of_a_store(report, chosen, dataset),
        asked=options,
    )
    written([*paths, *page], json_file, numbers, verdict)


def _figures(folder: Path, chosen, tuned, dataset) -> list[Path]:
    """Write the loss of each step, and the error of the given and the tuned weights by trial."""
    from .. import figures

    scale, unit = chosen.shown(chosen.judged_by)
    band = figures.error_band(dataset, metric=chosen.judged_by, scale=scale, unit=unit)
    return [
        figures.save(figures.loss_by_step(tuned), folder / "loss.png"),
        figures.save(band, folder / "learning.png"),
    ]
