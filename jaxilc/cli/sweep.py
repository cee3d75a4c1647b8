"""`jaxilc sweep`: schemes against many uncertain machines."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from .console import stage_ends
from .options import (
    SIMULATE,
    FigureFormat,
    GridAxes,
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

NOMINAL = "nominal.zarr"  # the bounds of the nominal machine over a grid
SIGMA_STEPS = 40  # of the Lanczos iteration on the nominal machine of a point

if TYPE_CHECKING:
    import xarray as xr

    from ..scenarios import Scenario
    from ..sweeps.points import BestPoint
    from ..sweeps.sweep import Sweep
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
    grid: GridAxes = None,
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
    bounds: Annotated[
        bool,
        typer.Option(
            "--bounds",
            help="Contraction of each trial; d1, d2 and premises of Cao 2019, on each machine.",
        ),
    ] = False,
    json_file: Json = None,
    report: Report = None,
    figures: FigureFormat = None,
    precision: Precision = "float64",
) -> None:
    """Schemes against many uncertain machines: yield, quantiles, worst case, figure, dataset.

    With --grid they run at every point of a grid; tables and figure are those of the best point.

    Example: jaxilc sweep cao-2019 --machines 4096 --spread 0.2 --out out/wide
    """
    from .asked import begin, chosen_scenario, grid_asked, spread_of

    begin(precision)
    from ..scenarios.judging import judged
    from ..sweeps.sweep import Sweep
    from ..theory.bounds import BoundsWatch
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
        grid=grid_asked(
            chosen,
            grid,
            lambda more: chosen_scenario(scenario, scheme, trials, [*(set_ or ()), more], params),
        ),
        watch=BoundsWatch() if bounds else None,
    )
    largest = _tolerance(chosen, tolerance)
    folder = out_dir or Path("out") / f"sweep-{chosen.name}"
    store, mapped = unless_there(folder / "dataset.zarr", resume), None
    if bounds and any(axis.size > 1 for axis in plan.axes.axes):
        mapped = unless_there(folder / NOMINAL, resume)
    asked = Asked(
        scenario, tuple(scheme or ()), tuple(set_ or ()), params, trials, spread, metric, tolerance
    )
    stage_ends("start")
    swept = run_sweep(plan, store, resume=resume, cluster=dask)
    nominal = None
    if mapped is not None:
        nominal = run_sweep(_nominal(plan), mapped, resume=resume, cluster=dask).dataset
    stage_ends("run")
    _finish(_Found(chosen, asked, largest, store, nominal), swept, json_file, report)


class _Found(NamedTuple):
    """What was swept.

    chosen: the scenario
    asked: options of the command
    tolerance: largest metric that passes [unit of the dataset], None if none is known
    store: place of the dataset, in the folder for results
    nominal: the same grid of the nominal machine with its bounds; None without a map of them
    """

    chosen: Scenario
    asked: Asked
    tolerance: float | None
    store: Path
    nominal: xr.Dataset | None


def _finish(found: _Found, swept: Swept, json_file: Path | None, report: Path | None) -> None:
    """Print the tables and the verdict of a sweep, and write its files."""
    from .. import figures
    from ..figures.report import command_report
    from ..sweeps.points import at_best, best_points
    from ..sweeps.summary import axes_of, summarise
    from .live import of_sweep
    from .numbers import axes_numbers, grid_numbers, sweep_numbers, watched_numbers
    from .verdicts.case import Case
    from .verdicts.simulation import sweep_verdict

    chosen, asked, tolerance, store, _ = found
    dataset, seconds, steps = swept
    scale, unit = chosen.shown(chosen.judged_by)
    whole, sizes = dataset, {axis: dataset.sizes[axis] for axis in axes_of(dataset)}
    best = []
    if sizes:
        best = best_points(dataset, tolerance, metric=chosen.judged_by)
        asked = _at(asked, dataset, _first(best))
        dataset = at_best(dataset, best)
        chosen = dataclasses.replace(chosen, trials=dataset.sizes["trial"])
    summary = summarise(dataset, tolerance, metric=chosen.judged_by)
    numbers = sweep_numbers(chosen, summary, tolerance, dataset.sizes["sample"])
    numbers |= axes_numbers(chosen, dataset, tolerance)
    numbers |= grid_numbers(chosen, best, sizes) if sizes else {}
    if "contraction_norm" in dataset:
        numbers["bounds"] = watched_numbers(chosen, dataset)
        if sizes:
            numbers["grid"]["bounds"] = watched_numbers(chosen, whole)
    shown, lines = _shown(chosen, numbers, steps, seconds)
    show(shown, lines)
    highs = {row.scheme: [scale * float(high) for high in row.high] for row in summary}
    verdict = sweep_verdict(Case.of(chosen, asked), numbers, highs)
    if sizes:
        verdict = verdict._replace(said=(*_first(best).sentences, *verdict.said))
    in_figures = {
        "metric": chosen.judged_by,
        "tolerance": tolerance,
        "scale": scale,
        "unit": unit,
    }
    axes = figures.error_band(dataset, summary=summary, **in_figures)
    paths = [figures.save(axes, store.parent / "error-band.png")]
    several = any(size > 1 for size in sizes.values())
    if several:
        paths = [*_maps(found, whole, best, in_figures), *paths]
    page = command_report(
        report,
        "sweep",
        shown,
        paths,
        scenario=chosen,
        configuration=dataset.attrs["configuration"],
        lines=lines,
        verdict=verdict,
        live=of_sweep(report, dataset, summary, in_figures, whole if several else None, best),
    )
    numbers |= {"sample_steps": steps, "seconds": seconds}
    stores = [store] if found.nominal is None else [store, store.with_name(NOMINAL)]
    written([*paths, *page, *stores], json_file, numbers, verdict)


def _maps(found: _Found, whole: xr.Dataset, best: list[BestPoint], in_figures) -> list[Path]:
    """The figures of a grid, with the scenario's own point, before and after what was asked."""
    from .. import figures
    from ..sweeps.grid import values_at
    from ..sweeps.points import labels_of
    from .asked import chosen_scenario

    asked, axes = found.asked, labels_of(whole)
    own = chosen_scenario(asked.source, list(asked.schemes), asked.trials, None, None)
    marks = {own.name: values_at(axes, own)}
    if (changed := values_at(axes, found.chosen)) != marks[own.name]:
        marks["as asked"] = changed
    shows = {"grid": "high", "grid-best-trial": "best_trial"}
    shows |= {"grid-yield": "yield"} if found.tolerance else {}
    paths = []
    for name, number in shows.items():
        drawn = figures.grid_map(whole, shows=number, best=best, marks=marks, **in_figures)
        paths.append(figures.save(drawn, found.store.parent / f"{name}.png"))
    if found.nominal is not None:
        at = _first(best).point
        longest = sorted(at, key=lambda axis: -whole.sizes[axis])
        others = {axis: [at[axis]] for axis in longest[2:]}
        bounds = found.nominal.sel(others)
        drawn = figures.contraction_map(whole.sel(others), bounds=bounds, marks=marks)
        paths.append(figures.save(drawn, found.store.parent / "contraction.png"))
    return paths


def _first(best: Sequence[BestPoint]) -> BestPoint:
    """The best of the best points of all schemes."""
    return min(best, key=lambda of: of.rank)


def _at(asked: Asked, dataset: xr.Dataset, best: BestPoint) -> Asked:
    """The options of the command at one point, as far as `--set` and `--trials` can say it."""
    from .stored_grid import point_of

    here = point_of(dataset, best.point)
    trials = here.pop("trials", asked.trials)
    shown = {n: f"{x:.6g}" if isinstance(x, float) else f"{x}" for n, x in here.items()}
    point = (f"{n}={x}" for n, x in shown.items() if not n.startswith("task."))
    kept = (one for one in asked.set if one.partition("=")[0].strip() not in here)
    return dataclasses.replace(asked, set=(*kept, *point), trials=trials)


def _nominal(plan: Sweep) -> Sweep:
    """The grid on the nominal machine alone, for the bound that takes long on all machines."""
    from ..theory.bounds import BoundsWatch

    return dataclasses.replace(
        plan, uncertainty={}, machines=1, trials=1, keep=(), quantities={}, chunk=None, lanes=None,
        watch=BoundsWatch(sigma_steps=SIGMA_STEPS),
    )  # fmt: skip


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

    best = tables.grid_table(numbers)
    shown = [] if best is None else [best]
    shown += [tables.yield_table(numbers), tables.spread_table(numbers), tables.band_table(numbers)]
    by_axis = tables.swept_axes_table(numbers)
    shown += [] if by_axis is None else [by_axis]
    shown += _of_bounds(numbers)
    lines = [*tables.sweep_lines(numbers), *tables.experiment_lines(chosen)]
    if steps:
        took = f"{steps:.3g} sample-steps in {seconds:.1f} s, compilation included"
        lines.append(f"{took}: {steps / seconds:.3g} a second")
    return shown, lines


def _of_bounds(numbers: dict[str, Any]) -> list[Table]:
    """The tables of `watched_numbers`, none without any; the premises are those of all points."""
    from .certificate_tables import contraction_table, premises_table

    at_best = numbers.get("bounds", {})
    of_all, where = (
        numbers.get("grid", {}).get("bounds", at_best),
        " at all points" * ("grid" in numbers),
    )
    proved = [name for name, row in of_all.items() if row["d2"] is not None]
    tables = [premises_table(f"{name}{where}", of_all[name]) for name in proved]
    return [contraction_table(at_best), *tables] if at_best else []
