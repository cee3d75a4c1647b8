"""`jaxilc sweep`: schemes against many uncertain machines."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .console import out, stage_ends
from .options import (
    SIMULATE,
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
from .results import unless_there, written


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
    precision: Precision = "float64",
) -> None:
    """Schemes against many uncertain machines: yield, quantiles, worst case, figure, dataset.

    Example: jaxilc sweep cao-2019 --machines 4096 --spread 0.2 --out out/wide
    """
    from .asked import begin, chosen_scenario, spread_of

    begin(precision)
    from .. import figures
    from ..figures.report import command_report
    from ..scenarios.judging import judged
    from ..sweeps.summary import summarise
    from ..sweeps.sweep import Sweep
    from . import tables
    from .numbers import axes_numbers, sweep_numbers
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
    scale, unit = chosen.shown(chosen.judged_by)
    tolerance = chosen.tolerance if tolerance is None else tolerance
    if tolerance is not None and not tolerance > 0:
        raise ValueError(f"--tolerance {tolerance:g} is outside its allowed range (0, inf)")
    tolerance = None if tolerance is None else tolerance / scale
    folder = out_dir or Path("out") / f"sweep-{chosen.name}"
    store = unless_there(folder / "dataset.zarr", resume)
    stage_ends("start")
    dataset, seconds, steps = run_sweep(plan, store, resume=resume, cluster=dask)
    stage_ends("run")

    summary = summarise(dataset, tolerance, metric=chosen.judged_by)
    numbers = sweep_numbers(chosen, summary, tolerance, plan.machines)
    numbers |= axes_numbers(chosen, dataset, tolerance)
    shown = [tables.yield_table(numbers), tables.spread_table(numbers), tables.band_table(numbers)]
    by_axis = tables.swept_axes_table(numbers)
    shown += [] if by_axis is None else [by_axis]
    for table in shown:
        out.print(table)
    lines = tables.sweep_lines(numbers)
    for line in lines:
        out.print(line, highlight=False)
    if steps:
        took = f"{steps:.3g} sample-steps in {seconds:.1f} s, compilation included"
        out.print(f"{took}: {steps / seconds:.3g} a second", highlight=False)
    axes = figures.error_band(
        dataset,
        metric=chosen.judged_by,
        tolerance=tolerance,
        scale=scale,
        unit=unit,
        summary=summary,
    )
    path = figures.save(axes, folder / "error-band.png")
    page = command_report(
        report,
        "sweep",
        shown,
        [path],
        scenario=chosen,
        configuration=dataset.attrs["configuration"],
        lines=lines,
    )
    written([path, *page, store], json_file, numbers | {"sample_steps": steps, "seconds": seconds})
