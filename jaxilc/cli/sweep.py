"""`jaxilc sweep`: schemes against many uncertain machines."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from .console import stage_ends
from .options import (
    SIMULATE,
    FigureFormat,
    Json,
    Machines,
    MetricName,
    OutFolder,
    Params,
    Precision,
    Report,
    Resume,
    Sampling,
    ScenarioName,
    Schemes,
    Seed,
    Set,
    Spread,
    Trials,
)
from .results import show, unless_there, written
from .verdicts.next_command import Asked

if TYPE_CHECKING:
    from ..scenarios import Scenario
    from .progress import Swept
    from .titled_table import Table


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command(rich_help_panel=SIMULATE)(sweep)


def sweep(
    scenario: ScenarioName,
    scheme: Schemes = None,
    trials: Trials = None,
    machines: Machines = 1024,
    seed: Seed = 0,
    spread: Spread = None,
    sampling: Sampling = "monte-carlo",
    metric: MetricName = None,
    tolerance: Annotated[
        float | None,
        typer.Option(help="Largest metric that passes, the one tables show, in its unit."),
    ] = None,
    set_: Set = None,
    params: Params = None,
    out_dir: OutFolder = None,
    resume: Resume = False,
    dask: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Compute on workers of this Dask scheduler: its address, or the file it wrote.",
        ),
    ] = None,
    keep: Annotated[
        list[str] | None,
        typer.Option(help="Store a signal of the last trial: y, e or u; repeatable."),
    ] = None,
    json_file: Json = None,
    report: Report = None,
    figures: FigureFormat = None,
    precision: Precision = "float64",
) -> None:
    """Schemes against many uncertain machines: yield, quantiles, worst case, figure, dataset.

    Example: jaxilc sweep cao-2019 --machines 4096 --spread 0.2 --out out/wide
    """
    from .asked import begin, chosen_scenario, spread_of

    begin(precision)
    from ..scenarios.judging import judged
    from ..sweeps.sweep import Sweep
    from .progress import run_sweep

    chosen = judged(chosen_scenario(scenario, scheme, trials, set_, params), metric)
    plan = Sweep(
        chosen.machine,
        chosen.schemes,
        chosen.task,
        chosen.trials,
        uncertainty=spread_of(chosen, spread),
        machines=machines,
        seed=seed,
        sampling=sampling,
        keep=tuple(keep or ()),
        quantities=chosen.functions,
    )
    largest = _tolerance(chosen, tolerance)
    folder = out_dir or Path("out") / f"sweep-{chosen.name}"
    store = unless_there(folder / "dataset.zarr", resume)
    asked = Asked(
        scenario, tuple(scheme or ()), tuple(set_ or ()), params, trials, spread, metric, tolerance
    )
    stage_ends("start")
    swept = run_sweep(plan, store, resume=resume, cluster=dask)
    stage_ends("run")
    _finish(_Found(chosen, asked, largest, store), swept, json_file, report)


class _Found(NamedTuple):
    """What was swept.

    chosen: the scenario
    asked: options of the command
    tolerance: largest metric that passes [unit of the dataset], None if none is known
    store: place of the dataset, in the folder for results
    """

    chosen: Scenario
    asked: Asked
    tolerance: float | None
    store: Path


def _finish(found: _Found, swept: Swept, json_file: Path | None, report: Path | None) -> None:
    """Print the tables and the verdict of a sweep, and write its files."""
    from .. import figures
    from ..figures.report import command_report
    from ..sweeps.summary import summarise
    from .live import of_sweep
    from .numbers import axes_numbers, sweep_numbers
    from .verdicts.case import Case
    from .verdicts.simulation import sweep_verdict

    chosen, asked, tolerance, store = found
    dataset, seconds, steps = swept
    scale, unit = chosen.shown(chosen.judged_by)
    summary = summarise(dataset, tolerance, metric=chosen.judged_by)
    numbers = sweep_numbers(chosen, summary, tolerance, dataset.sizes["sample"])
    numbers |= axes_numbers(chosen, dataset, tolerance)
    shown, lines = _shown(chosen, numbers, steps, seconds)
    show(shown, lines)
    highs = {row.scheme: [scale * float(high) for high in row.high] for row in summary}
    verdict = sweep_verdict(Case.of(chosen, asked), numbers, highs)
    in_figures = {
        "metric": chosen.judged_by,
        "tolerance": tolerance,
        "scale": scale,
        "unit": unit,
    }
    axes = figures.error_band(dataset, summary=summary, **in_figures)
    path = figures.save(axes, store.parent / "error-band.png")
    page = command_report(
        report,
        "sweep",
        shown,
        [path],
        scenario=chosen,
        configuration=dataset.attrs["configuration"],
        lines=lines,
        verdict=verdict,
        live=of_sweep(report, dataset, summary, in_figures),
    )
    numbers |= {"sample_steps": steps, "seconds": seconds}
    written([path, *page, store], json_file, numbers, verdict)


def _tolerance(chosen: Scenario, tolerance: float | None) -> float | None:
    """The tolerance of the option or of the scenario, in the unit of the simulation."""
    tolerance = chosen.tolerance if tolerance is None else tolerance
    if tolerance is not None and not tolerance > 0:
        raise ValueError(f"--tolerance {tolerance:g} is outside its allowed range (0, inf)")
    return None if tolerance is None else tolerance / chosen.shown(chosen.judged_by)[0]


def _shown(
    chosen: Scenario, numbers: dict[str, Any], steps: int, seconds: float
) -> tuple[list[Table], list[str]]:
    """The tables of a sweep, and the lines below them.

    steps: number of sample-steps that were computed, in so many seconds
    """
    from . import tables

    shown = [tables.yield_table(numbers), tables.spread_table(numbers), tables.band_table(numbers)]
    by_axis = tables.swept_axes_table(numbers)
    shown += [] if by_axis is None else [by_axis]
    lines = [*tables.sweep_lines(numbers), *tables.experiment_lines(chosen)]
    if steps:
        took = f"{steps:.3g} sample-steps in {seconds:.1f} s, compilation included"
        lines.append(f"{took}: {steps / seconds:.3g} a second")
    return shown, lines
