"""The command line: `jaxilc list | run | sweep`, and how it ends; the other commands are in the
modules `cli_...`.
"""

from __future__ import annotations

import sys
import time
import traceback
from pathlib import Path
from typing import Annotated

import typer

from ..scenarios.catalogue import LISTED
from . import bench, checks, hardware, pareto, tune
from .completion import scenarios_from
from .console import ended, speak, tracebacks
from .options import (
    Json,
    Params,
    Precision,
    Refused,
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
    folder_to_write,
    out,
    progress_bar,
    spread_of,
    stopped,
    written,
)
from .titled_table import Table

EXIT_CODES = (
    "Exit codes:",
    "0    done",
    "1    an error of jaxilc itself, with its traceback; without one, a chunk of a sweep that no worker could compute",
    "2    a mistake in what was asked: one line that names what is allowed",
    "3    next: the measured trial, or the input after it, is refused",
    "130  stopped by Ctrl-C: sweep, tune and pareto keep what is done, and go on with --resume",
)

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Iterative learning control of machine-tool feed drives: simulate, sweep, tune.",
    epilog="\n\n".join(EXIT_CODES),
)


def _version(asked: bool) -> None:
    if asked:
        from importlib.metadata import version
        from platform import python_version

        typer.echo(f"jaxilc {version('jaxilc')} (jax {version('jax')}, Python {python_version()})")
        raise typer.Exit


@app.callback()
def options(
    quiet: Annotated[
        bool,
        typer.Option(
            "--quiet", "-q", help="Print warnings and errors only; files are written all the same."
        ),
    ] = False,
    verbose: Annotated[
        bool,
        typer.Option(
            "--verbose",
            "-v",
            help="Log versions, devices and every program compiled, with times; show tracebacks.",
        ),
    ] = False,
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_version, is_eager=True, help="Show the version and exit."
        ),
    ] = False,
) -> None:
    """What holds for every command; before its name.

    Example: jaxilc --quiet run cao-2019 --json out/run.json
    """
    speak(quiet=quiet, verbose=verbose)


@app.command("list")
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
    begin("float64")
    from ..scenarios.from_file import load_scenario

    loaded = load_scenario(scenario)
    table = Table("--set", "value", "allowed", title=loaded.title)
    for option, default in loaded.options.items():
        table.add_row(option, str(default), "option of the scenario")
    for path, value in loaded.settable().items():
        table.add_row(path, _brief(value), loaded.allowed(path))
    out.print(table)


@app.command()
def run(
    scenario: ScenarioName,
    scheme: Schemes = None,
    trials: Trials = None,
    seed: Seed = 0,
    set_: Set = None,
    params: Params = None,
    out_dir: Annotated[
        Path | None,
        typer.Option(
            "--out",
            help="Folder for figures and dataset; out/run-SCENARIO if not given.",
            callback=folder_to_write,
        ),
    ] = None,
    json_file: Json = None,
    report: Report = None,
    precision: Precision = "float64",
) -> None:
    """Learn on the nominal machine: errors by trial beside the published ones, figures, dataset.

    Example: jaxilc run cao-2019 --scheme ffdl-mfailc --set ffdl-mfailc.lam=0.5
    """
    begin(precision)
    import jax

    from .. import figures, plants
    from ..figures.report import command_report
    from ..storage.files import whole_folder
    from ..sweeps import runs
    from . import tables

    chosen = chosen_scenario(scenario, scheme, trials, set_, params)
    key = jax.random.key(seed)
    dataset, _ = runs.run_schemes(
        chosen.machine,
        chosen.schemes,
        chosen.task,
        chosen.trials,
        key=key,
        quantities=chosen.functions,
    )
    numbers = tables.run_figures(chosen, dataset)
    table, lines = (
        tables.run_table(chosen, numbers),
        [*tables.course_lines(numbers), *tables.other_rows(chosen, numbers)],
    )
    out.print(table)
    for line in lines:
        out.print(line, highlight=False)
    for note in chosen.chosen:
        out.print(f"chosen: {note}", style="dim", highlight=False)

    folder = folder_of(out_dir, f"run-{chosen.name}")
    shown = {"scale": chosen.shown_scale, "unit": chosen.shown_unit}
    scale, unit = chosen.shown(chosen.judged_by)
    axes = figures.error_by_trial(
        dataset, figure=chosen.judged_by, published=chosen.due, scale=scale, unit=unit
    )
    paths = [figures.save(axes, folder / "error-by-trial.png")]
    some = [j for j in tables.shown_trials(chosen) if j in (2, 20, chosen.trials)] or [
        chosen.trials
    ]
    for name in chosen.schemes:
        axes = figures.tracking(dataset, name, some, **shown)
        paths.append(figures.save(axes, folder / f"tracking-{name}.png"))
        if chosen.schemes[name].learns:
            for figure in (figures.spectrum, figures.time_frequency):
                axes = figure(dataset, name, some, **shown)
                paths.append(
                    figures.save(axes, folder / f"{figure.__name__.replace('_', '-')}-{name}.png")
                )
        if isinstance(chosen.machine.plant, plants.TwoAxes):
            axes = figures.contour(dataset, name, some, **shown)
            paths.append(figures.save(axes, folder / f"contour-{name}.png"))
    with whole_folder(folder / "dataset.zarr", replace=True) as store:
        dataset.to_zarr(store, consolidated=False)
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
    tolerance: Annotated[
        float | None,
        typer.Option(help="Largest figure that passes, the one tables show, in its unit."),
    ] = None,
    set_: Set = None,
    params: Params = None,
    out_dir: Annotated[
        Path | None,
        typer.Option(
            "--out", help="Folder for figure and dataset; out/sweep-SCENARIO if not given."
        ),
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with the dataset in the folder.")
    ] = False,
    dask: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Compute on the workers of this Dask scheduler: its address, or the file it wrote.",
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
    """Schemes against many uncertain machines: yield, quantiles, worst case, figure, labelled
    dataset.

    Example: jaxilc sweep cao-2019 --samples 4096 --spread 0.2 --out out/wide
    """
    begin(precision)
    from .. import figures
    from ..figures.report import command_report
    from ..sweeps.summary import summarise
    from ..sweeps.sweep import Sweep
    from . import tables

    chosen = chosen_scenario(scenario, scheme, trials, set_, params)
    uncertainty = spread_of(chosen, spread)
    common = (
        chosen.machine,
        chosen.schemes,
        chosen.task,
        chosen.trials,
        uncertainty,
        samples,
        seed,
        sampling,
    )
    plan = Sweep(*common, keep=tuple(keep or ()), quantities=chosen.functions)
    scale, unit = chosen.shown(chosen.judged_by)
    tolerance = (chosen.tolerance if tolerance is None else tolerance) / scale
    if not tolerance > 0:
        raise ValueError(f"--tolerance {tolerance * scale:g} is outside its allowed range (0, inf)")
    folder = out_dir or Path("out") / f"sweep-{chosen.name}"
    store = folder / "dataset.zarr"
    if store.exists() and not resume:
        raise FileExistsError(
            f"{store} exists already; add --resume to go on with it, or choose another --out"
        )
    dataset, seconds, steps = _with_progress(plan, store, resume, dask)

    numbers = tables.sweep_figures(
        chosen, summarise(dataset, tolerance, metric=chosen.judged_by), tolerance, plan.machines
    )
    shown = [tables.yield_table(numbers), tables.spread_table(numbers), tables.band_table(numbers)]
    for table in shown:
        out.print(table)
    if steps:
        out.print(
            f"{steps:.3g} sample-steps in {seconds:.1f} s, compilation included: {steps / seconds:.3g} a second",
            highlight=False,
        )
    axes = figures.error_band(
        dataset, figure=chosen.judged_by, tolerance=tolerance, scale=scale, unit=unit
    )
    path = figures.save(axes, folder / "error-band.png")
    page = command_report(
        report,
        "sweep",
        shown,
        [path],
        scenario=chosen,
        configuration=dataset.attrs["configuration"],
    )
    written([path, *page, store], json_file, numbers | {"sample_steps": steps, "seconds": seconds})


checks.register(app)
tune.register(app)
pareto.register(app)
hardware.register(app)
bench.register(app)


def main() -> None:
    """The console script. A user's mistake is one line on standard error and exit code 2, without a
    traceback.
    """
    try:
        app()
    except (ValueError, OSError) as error:
        if tracebacks():
            err.print(traceback.format_exc(), highlight=False, markup=False, soft_wrap=True)
        err.print(f"error: {_said(error)}", highlight=False, markup=False, soft_wrap=True)
        sys.exit(3 if isinstance(error, Refused) else 2)
    finally:
        ended()


def _said(error: ValueError | OSError) -> str:
    """The message in one line; of a system's error, the file before what is wrong with it."""
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename2 or error.filename or 'input or output'}: {error.strerror.lower()}"
    return " ".join(str(error).split("\n"))


def _with_progress(plan, store: Path, resume: bool, cluster: str | None):
    """Run the plan behind a progress bar (on a terminal); the dataset, the seconds and the
    sample-steps it took.
    """
    from ..sweeps.cluster import ChunkFailed

    start, counted = time.perf_counter(), {}
    with progress_bar("rate") as bar:
        bars = {name: bar.add_task(name, total=plan.machines, rate="") for name in plan.schemes}

        def progress(name: str, done: int, fresh: int) -> None:
            counted[name] = counted.get(name, 0) + fresh
            steps = sum(counted.values()) * plan.trials * plan.task.N
            bar.update(
                bars[name],
                completed=done,
                rate=f"{steps / (time.perf_counter() - start):.2g} steps/s",
            )

        try:
            dataset = plan.run(store, resume=resume, progress=progress, cluster=cluster)
        except KeyboardInterrupt:
            stopped(store)
        except ImportError as error:
            if cluster is None:
                raise
            raise ValueError(f"--dask: {error}") from None
        except ChunkFailed as error:
            err.print(f"error: {error}", highlight=False, markup=False, soft_wrap=True)
            err.print(
                f"{store} holds what is done: the same command with --resume goes on",
                highlight=False,
                soft_wrap=True,
            )
            sys.exit(1)
    return dataset, time.perf_counter() - start, sum(counted.values()) * plan.trials * plan.task.N


def _brief(value) -> str:
    import numpy as np

    if value is None or isinstance(value, str | int | tuple):
        return str(value)
    return np.array2string(np.asarray(value), precision=6, threshold=6)


if __name__ == "__main__":
    main()
