"""The command line: `jaxilc list | run | sweep | certify | identify | reproduce`; the other commands are in the modules `cli_...`."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from . import cli_bench, cli_machine, cli_tuning
from .cli_common import (
    Json,
    Params,
    Precision,
    Report,
    Sampling,
    ScenarioName,
    Schemes,
    Seed,
    Set,
    Spread,
    Trials,
    begin,
    chosen_scenario,
    err,
    folder_of,
    out,
    progress_bar,
    spread_of,
    stopped,
    written,
)

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Iterative learning control of machine-tool feed drives: simulate, sweep, tune.",
)


@app.command("list")
def list_(scenario: Annotated[str | None, typer.Argument(metavar="[SCENARIO]", help="Show all that can be set.")] = None) -> None:
    """List the scenarios, or all that can be set in one.

    Example: jaxilc list cao-2019
    """
    from . import scenarios
    from .plant_files import load_scenario

    if scenario is not None:
        loaded = load_scenario(scenario)
        table = Table("--set", "value", "allowed", title=loaded.title)
        for option, default in loaded.options.items():
            table.add_row(option, str(default), "option of the scenario")
        for path, value in loaded.settable().items():
            table.add_row(path, _brief(value), loaded.allowed(path))
        out.print(table)
        return
    table = Table("scenario", "title", "schemes", "trials", "samples N")
    for name in scenarios.SCENARIOS:
        loaded = scenarios.load(name)
        table.add_row(name, loaded.title, ", ".join(loaded.schemes), str(loaded.trials), str(loaded.task.N))
    out.print(table)


@app.command()
def run(
    scenario: ScenarioName,
    scheme: Schemes = None,
    trials: Trials = None,
    seed: Seed = 0,
    set_: Set = None,
    params: Params = None,
    out_dir: Annotated[Path | None, typer.Option("--out", help="Folder for figures and dataset; out/run-SCENARIO if not given.")] = None,
    json_file: Json = None,
    report: Report = None,
    precision: Precision = "float64",
) -> None:
    """Learn on the nominal machine: errors by trial beside the published ones, figures, dataset.

    Example: jaxilc run cao-2019 --scheme ffdl-mfailc --set ffdl-mfailc.lam=0.5
    """
    begin(precision)
    import jax

    from . import figures, runs, tables
    from .report import command_report

    chosen = chosen_scenario(scenario, scheme, trials, set_, params)
    key = jax.random.key(seed)
    dataset, _ = runs.run_schemes(chosen.machine, chosen.schemes, chosen.task, chosen.trials, key=key, quantities=chosen.functions)
    numbers = tables.run_figures(chosen, dataset)
    table, lines = tables.run_table(chosen, numbers), tables.other_rows(chosen, numbers)
    out.print(table)
    for line in lines:
        out.print(line, highlight=False)
    for note in chosen.chosen:
        out.print(f"chosen: {note}", style="dim", highlight=False)

    folder = folder_of(out_dir, f"run-{chosen.name}")
    shown = {"scale": chosen.shown_scale, "unit": chosen.shown_unit}
    scale, unit = chosen.shown(chosen.judged_by)
    axes = figures.error_by_trial(dataset, figure=chosen.judged_by, published=chosen.due, scale=scale, unit=unit)
    paths = [figures.save(axes, folder / "error-by-trial.png")]
    some = [j for j in tables.shown_trials(chosen) if j in (2, 20, chosen.trials)] or [chosen.trials]
    for name in chosen.schemes:
        axes = figures.tracking(dataset, name, some, **shown)
        paths.append(figures.save(axes, folder / f"tracking-{name}.png"))
    dataset.to_zarr(folder / "dataset.zarr", mode="w", consolidated=False)
    page = command_report(report, "run", [table], paths, scenario=chosen, lines=lines)
    written([*paths, *page, folder / "dataset.zarr"], json_file, numbers)


@app.command()
def sweep(
    scenario: ScenarioName,
    scheme: Schemes = None,
    trials: Trials = None,
    samples: Annotated[int, typer.Option(help="Machines, the nominal one included.")] = 1024,
    seed: Seed = 0,
    spread: Spread = None,
    sampling: Sampling = "monte-carlo",
    tolerance: Annotated[float | None, typer.Option(help="Largest figure that passes, the one tables show, in its unit.")] = None,
    set_: Set = None,
    params: Params = None,
    out_dir: Annotated[Path | None, typer.Option("--out", help="Folder for figure and dataset; out/sweep-SCENARIO if not given.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with the dataset in the folder.")] = False,
    keep: Annotated[list[str] | None, typer.Option(help="Store a signal of the last trial: y, e or u; repeatable.")] = None,
    json_file: Json = None,
    report: Report = None,
    precision: Precision = "float64",
) -> None:
    """Schemes against many uncertain machines: yield, quantiles, worst case, figure, labelled dataset.

    Example: jaxilc sweep cao-2019 --samples 4096 --spread 0.2 --out out/wide
    """
    begin(precision)
    from . import figures, tables
    from .report import command_report
    from .summary import summarise
    from .sweep import Sweep

    chosen = chosen_scenario(scenario, scheme, trials, set_, params)
    uncertainty = spread_of(chosen, spread)
    common = (chosen.machine, chosen.schemes, chosen.task, chosen.trials, uncertainty, samples, seed, sampling)
    plan = Sweep(*common, keep=tuple(keep or ()), quantities=chosen.functions)
    scale, unit = chosen.shown(chosen.judged_by)
    tolerance = (chosen.tolerance if tolerance is None else tolerance) / scale
    if not tolerance > 0:
        raise ValueError(f"--tolerance {tolerance * scale:g} is outside its allowed range (0, inf)")
    folder = out_dir or Path("out") / f"sweep-{chosen.name}"
    store = folder / "dataset.zarr"
    if store.exists() and not resume:
        raise FileExistsError(f"{store} exists already; add --resume to go on with it, or choose another --out")
    dataset, seconds, steps = _with_progress(plan, folder_of(folder, ""), store, resume)

    numbers = tables.sweep_figures(chosen, summarise(dataset, tolerance, figure=chosen.judged_by), tolerance, plan.samples)
    shown = [tables.yield_table(numbers), tables.band_table(numbers)]
    for table in shown:
        out.print(table)
    if steps:
        out.print(f"{steps:.3g} sample-steps in {seconds:.1f} s, compilation included: {steps / seconds:.3g} a second", highlight=False)
    axes = figures.error_band(dataset, figure=chosen.judged_by, tolerance=tolerance, scale=scale, unit=unit)
    path = figures.save(axes, folder / "error-band.png")
    page = command_report(report, "sweep", shown, [path], scenario=chosen, configuration=plan.configuration())
    written([path, *page, store], json_file, numbers | {"sample_steps": steps, "seconds": seconds})


@app.command()
def certify(
    scenario: ScenarioName,
    scheme: Schemes = None,
    trials: Trials = None,
    samples: Annotated[int, typer.Option(help="Machines, the nominal one included.")] = 64,
    seed: Seed = 0,
    spread: Spread = None,
    sampling: Sampling = "monte-carlo",
    set_: Set = None,
    params: Params = None,
    out_dir: Annotated[Path | None, typer.Option("--out", help="Folder for the figures; out/certify-SCENARIO if not given.")] = None,
    json_file: Json = None,
    precision: Precision = "float64",
) -> None:
    """Each machine's convergence from theory alone, then against simulation: verdicts, premises of the bounds, confusion table.

    Example: jaxilc certify cao-2019 --scheme cfdl-mfailc --trials 200 --samples 256
    """
    begin(precision)
    from . import figures, tables
    from .schemes import FFDLMFAILC
    from .theory import certify as of_machines
    from .theory import premises
    from .uncertainty import draw

    chosen = chosen_scenario(scenario, scheme, trials, set_, params)
    uncertainty = spread_of(chosen, spread)
    drawn = draw(chosen.machine, uncertainty, samples, seed=seed, sampling=sampling)
    learning = {name: s for name, s in chosen.schemes.items() if s.learns}
    if not learning:
        raise ValueError(f"certify: none of {', '.join(chosen.schemes)} learns; there is nothing to certify")
    folder, paths, numbers = folder_of(out_dir, f"certify-{chosen.name}"), [], {}
    for name, one in learning.items():
        start = time.perf_counter()
        common = (chosen.machine, one, chosen.task, chosen.trials, uncertainty, drawn)
        found = of_machines(*common)
        seconds = time.perf_counter() - start
        shares = premises(*common) if isinstance(one, FFDLMFAILC) else None
        numbers[name] = tables.certificate_figures(found, shares, seconds)
        for table in tables.certificate_tables(name, chosen.trials, numbers[name]):
            out.print(table)
        axes = figures.certificate(found, scale=chosen.shown_scale, unit=chosen.shown_unit, title=name)
        paths.append(figures.save(axes, folder / f"{name}.png"))
        if len(found.broken_promises()):
            err.print(f"{name}: machines {found.broken_promises().tolist()} were certified monotone and grew: please report this")
    written(paths, json_file, {"scenario": scenario, "trials": chosen.trials, "samples": samples, "schemes": numbers})


@app.command()
def identify(
    record: Annotated[Path, typer.Argument(metavar="RECORD", help="Text file of columns with a header: time, input, output.")],
    poles: Annotated[int, typer.Option(help="Real poles.")] = 1,
    pairs: Annotated[int, typer.Option(help="Pairs of poles, real or complex.")] = 1,
    zeros: Annotated[int, typer.Option(help="Real zeros, of either sign.")] = 1,
    time_name: Annotated[str, typer.Option("--time", help="Column of the time [s].")] = "t",
    input_name: Annotated[str, typer.Option("--input", help="Column of the input.")] = "u",
    output_name: Annotated[str, typer.Option("--output", help="Column of the output.")] = "y",
    out_dir: Annotated[Path | None, typer.Option("--out", help="Folder for the figures; out/identify if not given.")] = None,
    json_file: Json = None,
) -> None:
    """A plant from a recorded experiment: parameters with 95 % intervals, fit, validation figure.

    Example: jaxilc identify record.csv --poles 1 --pairs 1 --zeros 1
    """
    begin("float64")
    from . import figures, identification, tables
    from .records import read_record

    measured = read_record(record, time=time_name, input=input_name, output=output_name)
    found = identification.identify(measured, poles=poles, pairs=pairs, zeros=zeros)
    rows = found.summary()
    out.print(tables.identification_table(str(record), rows))
    if not found.white:
        out.print("the residual is not white: another structure may fit better, and the intervals are too narrow", highlight=False)
    folder = folder_of(out_dir, "identify")
    paths = [figures.save(figures.record_figure(measured), folder / "record.png")]
    paths.append(figures.save(figures.validation_figure(measured, found), folder / "validation.png"))
    numbers = {name: {"value": value, "low": low, "high": high} for name, value, low, high in rows}
    written(paths, json_file, numbers | {"white": bool(found.white), "converged": bool(found.converged)})


@app.command()
def reproduce(
    scenario: Annotated[list[str] | None, typer.Argument(metavar="[SCENARIO]...", help="Scenarios; all if none is given.")] = None,
    json_file: Json = None,
    precision: Precision = "float64",
) -> None:
    """Every published number beside ours, with the ratio, a verdict and how the paper was read.

    Example: jaxilc reproduce cao-2019 dai-2014 --json out/reproduce.json
    """
    begin(precision)
    from . import reproduction, tables

    numbers = [row.as_dict() for row in reproduction.reproduce(scenario or ())]
    out.print(tables.reproduction_table(numbers))
    written([], json_file, numbers)


cli_tuning.register(app)
cli_machine.register(app)
cli_bench.register(app)


def main() -> None:
    """The console script. A user's mistake is one line on standard error and exit code 2, without a traceback."""
    try:
        app()
    except (ValueError, FileExistsError, FileNotFoundError, PermissionError) as error:
        if os.environ.get("JAXILC_TRACEBACK"):
            raise
        err.print(f"error: {error}", highlight=False, markup=False, soft_wrap=True)
        sys.exit(2)


def _with_progress(plan, folder: Path, store: Path, resume: bool):
    """Run the plan behind a progress bar (on a terminal); the dataset, the seconds and the sample-steps it took."""
    start, counted = time.perf_counter(), {}
    with progress_bar("rate") as bar:
        bars = {name: bar.add_task(name, total=plan.samples, rate="") for name in plan.schemes}

        def progress(name: str, done: int, fresh: int) -> None:
            counted[name] = counted.get(name, 0) + fresh
            steps = sum(counted.values()) * plan.trials * plan.task.N
            bar.update(bars[name], completed=done, rate=f"{steps / (time.perf_counter() - start):.2g} steps/s")

        try:
            dataset = plan.run(store, resume=resume, progress=progress)
        except KeyboardInterrupt:
            stopped(store)
    return dataset, time.perf_counter() - start, sum(counted.values()) * plan.trials * plan.task.N


def _brief(value) -> str:
    import numpy as np

    if value is None or isinstance(value, str | int | tuple):
        return str(value)
    return np.array2string(np.asarray(value), precision=6, threshold=6)


if __name__ == "__main__":
    main()
