"""`sweep`: schemes against many uncertain machines, also over a grid of parameters."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from .. import figures
from ..figures.style import labelled
from ..figures.within_trial import outputs_of
from ..learning.known_metrics import ERRORS
from ..pytree.ranges import share_text, value_text
from ..scenarios import Scenario
from ..scenarios.scenario import Look
from ..sweeps.grid import STEPS, values_at
from ..sweeps.points import BestPoint, at_best, best_points, labels_for, labels_of, point_of
from ..sweeps.summary import SchemeSummary, axes_of, last_errors, summarise
from ..sweeps.sweep import Sweep
from ..theory.bounds import BoundsWatch
from .certifying import bounds_tables, watched_numbers
from .outcome import Figure, Interactive, Numbers, Outcome, Table, Verdict
from .request import Request, as_text, unless_there
from .words import (
    OF_CONTOUR,
    WORDS,
    Case,
    experiment_lines,
    number,
    said,
    several,
    shown_trials,
    size_of,
    trend_of,
)

if TYPE_CHECKING:
    import xarray as xr


NOMINAL = "nominal.zarr"  # the bounds of the nominal machine over a grid
SIGMA_STEPS = 40  # of the Lanczos iteration on the nominal machine of a point
ENOUGH = 0.95  # share of machines within the tolerance with which a scheme is not in request
ALIKE = "Only noise tells these machines apart: without an uncertainty each is the nominal one."

BAND = (
    "Each panel is a scheme: median, 5 to 95 % and worst machine by trial. Beside them stands "
    "which share of the machines ends within a tolerance."
)
MAPS = {
    "grid": "The error of the last trial that 95 % of the machines do not exceed, at each point of "
    "the grid; the star is the best one, and a line encloses where a machine diverges.",
    "grid-best-trial": "The trial of the least error at each point, in the median.",
    "grid-yield": "The share of machines within the tolerance at each point.",
    "contraction": "The change of the error in a trial at each point of the grid, in the median; "
    "on the lines a bound is 1, and in the hatched regions a premise of d2 fails.",
}


def sweep(
    request: Request | str,
    *,
    machines: int = 1024,
    seed: int = 0,
    sampling: str = "monte-carlo",
    grid: str | Sequence[str] = (),
    keep: Sequence[str] = (),
    bounds: bool = False,
    folder: str | Path | None = None,
    resume: bool = False,
    run: Callable[..., xr.Dataset] = Sweep.run,
) -> Outcome:
    """Schemes against many uncertain machines: yield, quantiles, worst case, figure, dataset.

    request: what is simulated; the name of a scenario or a plant file stands for all of it
    machines, seed, sampling, keep: as for `Sweep`
    grid: axes of a grid as texts PATH=VALUES; tables and figure are those of the best point
    bounds: whether d1, d2 and the premises of Cao 2019 are watched on each machine
    folder: for the results; out/sweep-NAME if not given
    resume: whether to go on with what is in the folder
    run: how a plan is run, as `Sweep.run`; its `progress` returns the median error until now
    Raises ValueError naming what is allowed, and FileExistsError for results without `resume`.
    """
    request = Request.of(request)
    chosen = request.scenario(grid=grid)
    plan = Sweep(
        chosen.machine, chosen.schemes, chosen.task, chosen.trials, uncertainty=chosen.uncertainty,
        machines=machines, seed=seed, sampling=sampling, keep=tuple(keep),
        quantities=chosen.functions, grid=request.grid(grid, chosen),
        watch=BoundsWatch() if bounds else None,
    )  # fmt: skip
    fewest = min(of.trials for of in plan.plan.variants.values())
    if bounds and fewest < 2:
        raise ValueError(f"--trials {fewest} is outside its allowed range [2, inf) with --bounds")
    place = Path(folder or f"out/sweep-{chosen.name}")
    stores = [unless_there(place / "dataset.zarr", resume)]
    if bounds and any(axis.size > 1 for axis in plan.axes.axes):
        stores.append(unless_there(place / NOMINAL, resume))
    start, trials, errors = time.perf_counter(), [], {name: np.zeros(0) for name in plan.schemes}

    def progress(name: str, _: int, __: int) -> str:
        told = errors[name].size and plan.axes.size == 1
        return f"median {size_of(chosen, np.median(errors[name]))}" if told else ""

    def results(name: str, values: Mapping[str, np.ndarray]) -> None:
        errors[name] = np.append(errors[name], last_errors(values, chosen.judged_by))
        trials.append(int((values["finite"] | values["diverged"]).sum()))  # a run may have fewer

    dataset = run(plan, stores[0], resume=resume, progress=progress, results=results)
    steps, seconds = sum(trials) * plan.task.N, time.perf_counter() - start
    nominal = run(_nominal(plan), stores[1], resume=resume) if stores[1:] else None
    return _told(chosen, request, dataset, nominal, stores, steps, seconds)


def _told(
    chosen: Scenario, request: Request, whole: xr.Dataset, nominal: xr.Dataset | None,
    stores: list[Path], steps: int, seconds: float,
) -> Outcome:  # fmt: skip
    """The outcome of a sweep: that of the best point, where it has a grid.

    nominal: the same grid of the nominal machine with its bounds, for a map;  stores: of both
    steps, seconds: sample-steps that were computed, and the time with compilation
    """
    dataset, drawn, tolerance = whole, chosen.look, chosen.look["tolerance"]
    speed = f"{steps:.3g} sample-steps in {seconds:.1f} s, compilation included"
    sizes = {axis: dataset.sizes[axis] for axis in axes_of(dataset)}
    best = best_points(dataset, tolerance, metric=chosen.judged_by) if sizes else []
    several = any(size > 1 for size in sizes.values())
    maps = _maps(chosen, request, whole, nominal, best) if several else {}
    if best:
        dataset = at_best(dataset, best)
        chosen = dataclasses.replace(chosen, trials=dataset.sizes["trial"])
    case = Case.of(chosen, request)
    if STEPS in dataset.coords:  # an axis may have other ones than the scenario
        names, steps_of = dataset["scheme"].values, dataset[STEPS].values.tolist()
        case = case._replace(steps=dict(zip(map(str, names), steps_of, strict=True)))
    dataset = _played(dataset, case.steps)
    summary = summarise(dataset, tolerance, metric=chosen.judged_by)
    numbers = sweep_numbers(chosen, summary, tolerance, dataset.sizes["sample"])
    numbers |= axes_numbers(chosen, dataset, tolerance)
    numbers |= grid_numbers(chosen, best, whole) if sizes else {}
    if "contraction_norm" in dataset:
        numbers["bounds"] = watched_numbers(chosen, dataset)
        if sizes:
            numbers["grid"]["bounds"] = watched_numbers(chosen, whole)
    highs = {row.scheme: (drawn["scale"] * row.high).tolist() for row in summary}
    winner = _winner(case, numbers, highs)
    for point in (of for of in best if of.scheme == winner):
        case = case._replace(request=_at(request, whole, point))
    verdict = sweep_verdict(case, numbers, highs)
    told = [sentence for of in best if of.scheme == winner for sentence in of.sentences]
    verdict = verdict._replace(said=(*told, *verdict.said))
    band = partial(figures.error_band, dataset, summary=summary, **drawn)
    return Outcome(
        command="sweep",
        numbers=numbers | {"sample_steps": steps, "seconds": seconds},
        verdict=verdict,
        folder=stores[0].parent,
        scenario=chosen,
        tables=[
            *([grid_table(numbers)] if sizes else []),
            yield_table(numbers),
            spread_table(numbers),
            band_table(numbers),
            *([swept_axes_table(numbers)] if "axes" in numbers else []),
            *bounds_tables(numbers),
        ],
        lines=[
            *sweep_lines(numbers),
            *experiment_lines(chosen),
            *([f"{speed}: {steps / seconds:.3g} a second"] if steps else []),
        ],
        figures=maps | {"error-band": Figure(BAND, band)},
        kept=stores,
        live=partial(live_sweep, dataset, summary, drawn, whole if several else None, best),
        configuration=dataset.attrs["configuration"],
    )


def _played(dataset: xr.Dataset, steps: Mapping[str, int]) -> xr.Dataset:
    """The dataset of which the last trial of each scheme is no experiment, or one that diverged.

    steps: trials of a learning step by scheme, of which the first alone plays what was learned
    """
    ends = [*np.resize(dataset.coords.get("trials", dataset.sizes["trial"]), len(steps))]
    last = []
    for name, J in zip(dataset["scheme"].values, ends, strict=True):
        played = J - (J - 1) % steps[str(name)]
        lost = (dataset["diverged_at"].sel(scheme=name) > played).any()
        last.append(J if lost else played)
    return dataset if last == ends else dataset.assign_coords(trials=("scheme", last))


def live_sweep(
    dataset: xr.Dataset,
    summary: Sequence[SchemeSummary],
    drawn: Look,
    grid: xr.Dataset | None = None,
    best: Sequence[BestPoint] = (),
) -> list[Interactive]:
    """The map of a grid with its best points, errors by trial, machines against parameters."""
    from ..figures import browsers
    from ..figures.by_trial import band_together
    from ..figures.grid_map import live_grid

    parameters = {
        str(name): values.values
        for name, values in dataset.coords.items()
        if values.dims[:1] == ("sample",) and name != "sample"
    }
    return [
        live_grid(grid, best=[*best], **drawn) if grid is not None and best else None,
        band_together(summary, **drawn),
        browsers.machines(dataset, parameters, **drawn),
    ]


def live_store(chosen: Scenario, dataset: xr.Dataset) -> list[Interactive]:
    """The same of machines on which laws were judged, in the units of the scenario."""
    look = chosen.look
    return live_sweep(dataset, summarise(dataset, look["tolerance"], metric=look["metric"]), look)


def sweep_numbers(
    scenario: Scenario, summary: Sequence[SchemeSummary], tolerance: float | None, machines: int
) -> Numbers:
    """The summary of a sweep [shown unit] by scheme, with quantiles and the worst machine by trial.

    tolerance: largest metric that passes [unit of the dataset]; None, and null for the yields
    """
    k, unit = scenario.shown(scenario.judged_by)
    shown = sorted({*shown_trials(scenario), *(len(row.median) for row in summary)})
    schemes = {
        row.scheme: {
            "yield": None if tolerance is None else row.yield_share,
            "yield_interval": None
            if math.isnan(row.yield_low)
            else [row.yield_low, row.yield_high],
            "semi_converged": row.semi_converged,
            "grown_from": row.grown_from,
            "grown_to": row.grown_to,
            "diverged": row.diverged,
            "diverged_at": row.diverged_at,
            "by_trial": {str(j): _in_trial(row, j, k) for j in shown if j <= len(row.median)},
        }
        for row in summary
    }
    return {
        "scenario": scenario.name,
        "trials": scenario.trials,
        "samples": machines,
        "tolerance": None if tolerance is None else k * tolerance,
        "unit": unit,
        "figure": scenario.judged_by.replace("_", " "),
        "schemes": schemes,
    }


def _in_trial(row: SchemeSummary, trial: int, scale: float) -> Numbers:
    """The quantiles over the machines in a trial, and the worst machine."""
    of_all = {"median": row.median, "low": row.low, "high": row.high, "worst": row.worst}
    errors = {name: scale * float(values[trial - 1]) for name, values in of_all.items()}
    return errors | {"worst_sample": int(row.worst_machine[trial - 1])}


def axes_numbers(scenario: Scenario, dataset: xr.Dataset, tolerance: float | None) -> Numbers:
    """The error of the last trial over the machines of a sweep, by scheme and axis [shown unit].

    It is the error by which schemes are judged: of an axis for that of the contour, and the largest
    where they are judged by something else, of which a tolerance says nothing of an axis. Besides
    the outputs there is the contour, where it has that metric; a single output has none.
    """
    if scenario.task.outputs == 1:
        return {}
    known = {of: of for of in (m.name for m in ERRORS)}
    known |= {of_contour: of for of, of_contour in OF_CONTOUR.items()}
    metric = known.get(scenario.judged_by, "max_error")
    tolerance = tolerance if scenario.judged_by in known else None
    errors = {
        called: dataset[metric].isel(channel=i) for i, called in enumerate(outputs_of(dataset))
    }
    if (contour := OF_CONTOUR.get(metric)) in scenario.quantities:
        errors["contour"] = dataset[contour]
    found: Numbers = {}
    for called, values in errors.items():
        named = dataset[["finite", "diverged"]].assign(error=values)
        for row in summarise(named, tolerance, metric="error"):
            last = _in_trial(row, len(row.median), scenario.shown_scale)
            share = None if tolerance is None else row.yield_share
            found.setdefault(row.scheme, {})[called] = last | {"yield": share}
    metric = metric.replace("_", " ")
    return {"axes": found, "axes_of": labelled(WORDS.get(metric, metric), scenario.shown_unit)}


def grid_numbers(scenario: Scenario, best: Sequence[BestPoint], dataset: xr.Dataset) -> Numbers:
    """The best point of each scheme of a grid, with its error [shown unit].

    `own` has its values by the names that an axis of several schemes has for this one.
    """
    (k, _), axes = scenario.shown(scenario.judged_by), axes_of(dataset)
    found = {}
    for of in best:
        row = of._asdict() | {"error": k * of.error}
        own = (labels_for(dataset, axis, of.scheme).sel({axis: of.point[axis]}) for axis in axes)
        row["own"] = {str(value.name): value.item() for value in own}
        row["yield"] = None if np.isnan(of.yield_share) else of.yield_share
        found[row.pop("scheme")] = {n: x for n, x in row.items() if n != "yield_share"}
    return {"grid": {"axes": {axis: dataset.sizes[axis] for axis in axes}, "best": found}}


def swept_axes_table(numbers: Numbers) -> Table:
    """The table of the errors of the last trial of a sweep, axis by axis, and of the contour."""
    shares = [at["yield"] for axes in numbers["axes"].values() for at in axes.values()]
    within = (f"within {numbers['tolerance']:g}",) if None not in shares else ()
    columns = (*within, "median", "95 %", "worst (machine)")
    which, trial, trials = _last_trials(numbers)
    title = f"{numbers['axes_of']} of {which} by axis"
    table = Table("scheme", "axis", right=(*trial, *columns), title=title)
    for name, axes in numbers["axes"].items():
        for axis, at in axes.items():
            share = [*trials[name], *([share_text(at["yield"])] if within else [])]
            worst = f"{number(at['worst'])} ({at['worst_sample']})"
            table.add_row(name, axis, *share, number(at["median"]), number(at["high"]), worst)
    return table


def sweep_lines(numbers: Numbers) -> list[str]:
    """A line for each scheme of a sweep under which machines diverged, or their errors grew."""
    lines = []
    for name, row in numbers["schemes"].items():
        if row["diverged"]:
            lines.append(
                f"{name}: {share_text(row['diverged'])} of the machines diverged, the first at "
                f"trial {row['diverged_at']}"
            )
        if row["semi_converged"]:
            lines.append(
                f"{name}: on {share_text(row['semi_converged'])} of the machines the "
                f"{numbers['figure']} has grown since its best trial, up to "
                f"{number(row['grown_to'])} times"
            )
    if numbers["tolerance"] is None:
        lines.append("no yield: give --tolerance, or `tolerance` in the file")
    return lines


def yield_table(numbers: Numbers) -> Table:
    """The table of yields, where a tolerance is known, and of shares that grew or diverged."""
    known = numbers["tolerance"] is not None
    within = f" within {numbers['tolerance']:g} {numbers['unit']}".rstrip() if known else ""
    which, trial, trials = _last_trials(numbers)
    what = f"{numbers['figure']} of {which}{within}"
    claimed = any(row["yield_interval"] for row in numbers["schemes"].values())
    yields = ("yield" + " (95 % interval)" * claimed,) if known else ()
    columns = (*trial, *yields, "grown (from)", "diverged (from)")
    table = Table(
        "scheme", right=columns, title=f"{several(numbers['samples'], 'machine')}, {what}"
    )
    for name, row in numbers["schemes"].items():
        ends = " – ".join(map(share_text, row["yield_interval"])) if claimed else ""
        table.add_row(
            name,
            *trials[name],
            *([share_text(row["yield"]) + f" ({ends})" * claimed] if known else []),
            _share(row["semi_converged"], row["grown_from"]),
            _share(row["diverged"], row["diverged_at"]),
        )
    return table


def _share(share: float, trial: int) -> str:
    """A text `5.2% (43)`: the share of such machines, and the earliest trial of one of them."""
    return share_text(share) + (f" ({trial})" if trial else "")


def grid_table(numbers: Numbers) -> Table:
    """The table of the best point of each scheme, to which all other tables belong."""
    axes, best = numbers["grid"]["axes"], numbers["grid"]["best"]
    count = several(int(np.prod([*axes.values()], dtype=int)), "point")
    names = zip(*(row["own"] for row in best.values()), strict=True)
    heads = (" / ".join(dict.fromkeys(of_axis)) for of_axis in names)
    columns = (*heads, "95 %", "points within twice", "points that diverge")
    title = f"best of {count}: 95 % {labelled(numbers['figure'], numbers['unit'])}"
    table = Table("scheme", right=columns, title=title)
    for name, row in best.items():
        at = [value_text(x) for x in row["own"].values()]
        near = share_text(row["near"]) if math.isfinite(row["error"]) else "–"
        shares = (near, share_text(row["diverged"]))
        table.add_row(name, *at, number(row["error"]), *shares)
    return table


def spread_table(numbers: Numbers) -> Table:
    """The table of quantiles over the machines in the last trial, and of the worst machine."""
    which, trial, trials = _last_trials(numbers)
    columns = (*trial, "median", "5 %", "95 %", "worst", "its machine")
    title = f"{labelled(numbers['figure'], numbers['unit'])} of {which}"
    table = Table("scheme", right=columns, title=title)
    for name, row in numbers["schemes"].items():
        *_, at = row["by_trial"].values()
        quantiles = (number(at[of]) for of in ("median", "low", "high", "worst"))
        table.add_row(name, *trials[name], *quantiles, str(at["worst_sample"]))
    return table


def _last_trials(numbers: Numbers) -> tuple[str, tuple[str, ...], dict[str, tuple[str, ...]]]:
    """What a title calls the last trial, and a column with its number if the schemes' differ."""
    last = {name: str([*row["by_trial"]][-1]) for name, row in numbers["schemes"].items()}
    if len({*last.values()}) == 1:
        return f"trial {next(iter(last.values()))}", (), dict.fromkeys(last, ())
    return "the last trial", ("trial",), {name: (of,) for name, of in last.items()}


def band_table(numbers: Numbers) -> Table:
    """The table of the median and the 95 % quantile for each trial and scheme."""
    title = f"{labelled(numbers['figure'], numbers['unit'])} by trial: median (95 % quantile)"
    table = Table(right=("trial", *numbers["schemes"]), title=title)
    by_trial = [row["by_trial"] for row in numbers["schemes"].values()]
    for j in sorted({j for of in by_trial for j in of}, key=int):
        rows = [of.get(j) for of in by_trial]
        told = (f"{number(r['median'])} ({number(r['high'])})" if r else "–" for r in rows)
        table.add_row(j, *told)
    return table


def sweep_verdict(case: Case, numbers: Numbers, highs: Mapping[str, Sequence[float]]) -> Verdict:
    """Which scheme has the largest yield, or the least 95 % quantile `highs` of the last trial."""
    rows, best, highs = numbers["schemes"], _winner(case, numbers, highs), case.of_learned(highs)
    row, course, lost = rows[best], trend_of(highs[best]), _lost(rows[best], case.error)
    first = f"{case.head(best)}{_yield(case, numbers, row)}{_spread(case, numbers, row)}."
    told = course.words and case.learns[best]
    second = lost or (f"The 95 % {case.error} {course.words}." if told else "")
    alike = () if case.uncertain or numbers["samples"] == 1 else (ALIKE,)
    enough = row["yield"] is None or row["yield"] >= ENOUGH
    return Verdict(said(first, second, *alike), *_after_sweep(case, best, not lost, enough))


def _winner(case: Case, numbers: Numbers, highs: Mapping[str, Sequence[float]]) -> str:
    """The scheme of which the verdict is."""
    rows, highs = numbers["schemes"], case.of_learned(highs)
    last = {name: math.inf if math.isnan(of[-1]) else of[-1] for name, of in highs.items()}
    return min(rows, key=lambda name: (-(rows[name]["yield"] or 0.0), last[name]))


def _yield(case: Case, numbers: Numbers, row: Numbers) -> str:
    """How many machines end within the tolerance; empty if none is known."""
    if row["yield"] is None:
        return ""
    machines = numbers["samples"]
    if machines == 1:
        ends = "ends" if row["yield"] else "does not end"
        return f"the only machine {ends} within {case.size(numbers['tolerance'])}; "
    which = f"{_percent(row['yield'])} of {machines} machines"
    if row["yield_interval"]:
        which += f" (95 % interval {' to '.join(map(_percent, row['yield_interval']))})"
    if row["yield"] == 1:
        which = f"all {machines} machines"
    return f"{which} end within {case.size(numbers['tolerance'])}; "


def _spread(case: Case, numbers: Numbers, row: Numbers) -> str:
    """The 95 % quantile of the last trial, and the worst machine."""
    *_, at = row["by_trial"].values()
    if numbers["samples"] == 1:
        which = "it" if row["yield"] is not None else "the only machine"
        size = f"{case.an_error} of {case.size(at['high'])}"
        return (
            f"{which} ends with {size if math.isfinite(at['high']) else 'an error that diverged'}"
        )
    which = "of them" if row["yield"] is not None else f"of {numbers['samples']} machines"
    if not math.isfinite(at["high"]):
        return f"fewer than 95 % {which} end with an error that has not diverged"
    worst = case.size(at["worst"]) if math.isfinite(at["worst"]) else "one that has diverged"
    return (
        f"95 % {which} end with {case.an_error} of at most {case.size(at['high'])}, the worst "
        f"(machine {at['worst_sample']}) with {worst}"
    )


def _lost(row: Numbers, error: str) -> str:
    """A sentence on the machines that diverge or whose metric grows, empty if there are none."""
    parts = []
    if row["diverged"]:
        parts.append(
            f"{_percent(row['diverged'])} of the machines diverge, the first in trial "
            f"{row['diverged_at']}"
        )
    if row["semi_converged"]:
        times = number(row["grown_to"])
        parts.append(
            f"on {_percent(row['semi_converged'])} the {error} has grown up to {times} times "
            "since its best trial"
        )
    said = "; ".join(parts)
    return f"{said[:1].upper()}{said[1:]}." if said else ""


def _after_sweep(case: Case, best: str, sound: bool, enough: bool) -> tuple[str, str]:
    if not case.learns[best] or not sound:
        return case.remedy(best)
    if not enough:
        if case.designable:
            return case.remedy(best)
        if case.uncertain:
            return "the worst machine", case.on("worst-case", best)
    return "what theory claims", case.on("certify", best)


def _percent(share: float) -> str:
    return share_text(share).replace("%", " %")


def _maps(
    chosen: Scenario, request: Request, whole: xr.Dataset, nominal: xr.Dataset | None,
    best: Sequence[BestPoint],
) -> dict[str, Figure]:  # fmt: skip
    """The figures of a grid, with the scenario's own point, before and after what was asked."""
    axes = labels_of(whole)
    own = dataclasses.replace(request, set=(), params=None).scenario()
    marks = {own.name: values_at(axes, own)}
    if (changed := values_at(axes, chosen)) != marks[own.name]:
        marks["as asked"] = changed
    shows = {"grid": "high", "grid-best-trial": "best_trial"}
    shows |= {"grid-yield": "yield"} if chosen.tolerance else {}
    draw = partial(figures.grid_map, whole, best=[*best], marks=marks, **chosen.look)
    maps = {name: Figure(MAPS[name], partial(draw, shows=of)) for name, of in shows.items()}
    if nominal is not None:
        at = min(best, key=lambda of: of.rank).point
        longest = sorted(at, key=lambda axis: -whole.sizes[axis])
        others = {axis: [at[axis]] for axis in longest[2:]}
        bounds = nominal.sel(others)
        by_trial = partial(figures.contraction_map, whole.sel(others), bounds=bounds, marks=marks)
        maps["contraction"] = Figure(MAPS["contraction"], by_trial)
    return maps


def _at(request: Request, dataset: xr.Dataset, best: BestPoint) -> Request:
    """The request at one point, as far as `--set` and `--trials` can say it."""
    here = point_of(dataset, best.point)
    trials = here.pop("trials", request.trials)
    shown = {n: f"{x:.6g}" if isinstance(x, float) else as_text(x) for n, x in here.items()}
    point = (f"{n}={x}" for n, x in shown.items() if not n.startswith("task."))
    kept = (one for one in request.set if one.partition("=")[0].strip() not in here)
    return dataclasses.replace(request, set=(*kept, *point), trials=trials)


def _nominal(plan: Sweep) -> Sweep:
    """The grid on the nominal machine alone, for the bound that takes long on all machines."""
    return dataclasses.replace(
        plan, uncertainty={}, machines=1, trials=1, keep=(), quantities={}, chunk=None, lanes=None,
        watch=BoundsWatch(sigma_steps=SIGMA_STEPS),
    )  # fmt: skip
