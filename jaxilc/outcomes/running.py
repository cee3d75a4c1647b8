"""`run`: schemes learn on one machine, the nominal one of a scenario."""

from __future__ import annotations

import itertools
import json
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from .. import figures
from ..figures.style import labelled
from ..figures.within_trial import outputs_of
from ..learning.divergence import CEILING, GROWTH
from ..learning.known_metrics import ERRORS, OF_TRIALS
from ..pytree.closest import first_of
from ..runtime.provenance import differences
from ..scenarios import Published, Scenario
from ..scenarios.reproduction import met
from ..schemes.scheme import trials_of_step
from ..storage.files import whole_folder
from ..sweeps import runs
from ..uncertainty import key_of
from .outcome import Figure, Interactive, Numbers, Outcome, Progress, Table, Verdict, silent
from .request import Request, settings_of
from .words import (
    DIVERGES,
    EXACT,
    FALLS,
    GROWS,
    HEADS,
    OF_CONTOUR,
    SETTLED,
    Case,
    Trend,
    diverged,
    experiment_lines,
    number,
    said,
    several,
    shown_trials,
    trend_of,
)

if TYPE_CHECKING:
    import xarray as xr


CURVES = (2, 20)  # trials that are drawn besides the last one
CHANGED = "published values hold for the scenario as it stands; --set or --params changed it here"
# What is said of printed numbers of papers, and of other software.
COUNTED = ("published numbers are met within 30 %", "numbers of other software agree")
OPEN = "The paper is silent at {places} places; --details tells what was chosen."
ALIKE = 0.02  # schemes whose errors differ by no more than this share are told as alike
# What the figures of a scheme show, by the name of the function that draws them.
OF_A_SCHEME = {
    "tracking": "output, error and input within chosen trials; the right column shows the shaded "
    "part.",
    "spectrum": "the amplitude of the error at each frequency, for chosen trials.",
    "contour": "the path with the motion, whose distance from it is drawn larger, and the contour "
    "error along the path.",
}


def run(
    request: Request | str,
    *,
    seed: int = 0,
    folder: str | Path | None = None,
    replace: bool = False,
    progress: Progress = silent,
) -> Outcome:
    """Learn on the nominal machine: errors beside the published ones, figures, dataset.

    request: what is simulated; the name of a scenario or a plant file stands for all of it
    seed: of noise and of all else that is drawn
    folder: for the results; the first of out/run-NAME, out/run-NAME-2 and so on that is free, or
        that holds a run of the same settings, if not given
    replace: whether the run of other settings in the folder is replaced
    Raises ValueError naming what is allowed, and FileExistsError where the folder holds a run of
    other settings.
    """
    request = Request.of(request)
    chosen = request.scenario()
    made_with = runs.configuration(chosen, seed)
    place = _folder(folder, chosen.name, made_with, replace=replace)
    dataset, _ = runs.run_schemes(
        chosen.machine, chosen.schemes, chosen.task, chosen.trials, key=key_of(seed),
        quantities=chosen.functions,
        progress=lambda done, name: progress(name, done, len(chosen.schemes)),
    )  # fmt: skip
    numbers = run_numbers(chosen, dataset)
    changed = request.params or not settings_of(request.set).keys() <= chosen.options.keys()
    published = [CHANGED] if chosen.due and changed else reading_lines(chosen, numbers)
    choices = [f"chosen: {text}" for text in chosen.chosen]
    return Outcome(
        command="run",
        numbers=numbers,
        verdict=run_verdict(Case.of(chosen, request), numbers, errors_by_trial(chosen, dataset)),
        folder=place,
        scenario=chosen,
        tables=[
            run_table(chosen, numbers),
            last_trial_table(numbers),
            *([axes_table(numbers)] if chosen.task.outputs > 1 else []),
        ],
        lines=[
            *course_lines(numbers),
            *experiment_lines(chosen),
            *other_rows(chosen, numbers),
            *published,
            *(choices if request.of_file or not choices else [OPEN.format(places=len(choices))]),
        ],
        details=[] if request.of_file else choices,
        figures=_figures(chosen, dataset),
        files={"dataset.zarr": partial(_store, dataset, made_with)},
        live=partial(_live, chosen, dataset),
    )


def _store(dataset: xr.Dataset, made_with: Numbers, place: Path) -> None:
    """Write the dataset of a run, with all that determines it, in place of another."""
    dataset.attrs["configuration"] = json.dumps(made_with)
    with whole_folder(place, replace=True) as store:
        dataset.to_zarr(store, consolidated=False)


def _figures(chosen: Scenario, dataset: xr.Dataset) -> dict[str, Figure]:
    """The figures of a run: the metric that judges it, and of each scheme what its trials are."""
    in_unit = {"scale": chosen.shown_scale, "unit": chosen.shown_unit}
    drawn = {
        "error-by-trial": Figure(
            "The errors by trial, a curve for each scheme; circles are published, a dashed line is "
            "the tolerance.",
            partial(figures.error_by_trial, dataset, published=chosen.due, **chosen.look),
            live=True,
        )
    }
    last = chosen.trials
    trials = [j for j in shown_trials(chosen) if j in (*CURVES, last)] or [last]
    for name, scheme in chosen.schemes.items():
        kinds = ["tracking", *(["spectrum"] if scheme.learns else [])]
        if chosen.task.outputs == 2 and "contour_max" in chosen.quantities:
            kinds.append("contour")
        for kind in kinds:
            drawn[f"{kind}-{name}"] = Figure(
                f"{name}: {OF_A_SCHEME[kind]}",
                partial(getattr(figures, kind), dataset, name, trials, **in_unit),
                live=kind == "tracking",
            )
    return drawn


def _live(chosen: Scenario, dataset: xr.Dataset) -> list[Interactive]:
    """The errors by trial, and a trial that a slider chooses."""
    from ..figures import browsers

    errors = figures.error_by_trial.described(dataset, published=chosen.due, **chosen.look)
    within = browsers.trials(dataset, scale=chosen.shown_scale, unit=chosen.shown_unit)
    return [errors, within]


def _folder(asked: str | Path | None, name: str, made_with: Numbers, *, replace: bool) -> Path:
    """The folder for the results of a run, in which no run of other settings is."""

    def differing(folder: Path) -> list[str]:
        store = folder / "dataset.zarr"
        return (
            differences(runs.made_with(store), made_with) if store.exists() and not replace else []
        )

    if asked is None:
        first = Path("out") / f"run-{name}"
        counted = (first.with_name(f"{first.name}-{i}") for i in itertools.count(2))
        return next(folder for folder in itertools.chain([first], counted) if not differing(folder))
    asked = Path(asked)
    found = differing(asked)
    if found:
        raise FileExistsError(
            f"{asked} holds a run of other settings ({first_of(found, 1)}); choose another --out, "
            "or add --replace"
        )
    return asked


def run_numbers(scenario: Scenario, dataset: xr.Dataset) -> Numbers:
    """The metrics of a run [shown unit] by scheme, metric and trial, with the published ones.

    With several channels the largest counts. The errors of a trial that diverged are infinite.
    """
    schemes: Numbers = {}
    for name, scheme in scenario.schemes.items():
        chosen = _largest(dataset, name)
        known = (*(m.name for m in OF_TRIALS), *scenario.quantities)
        shown = {metric: _shown(scenario, chosen, metric) for metric in known}
        by_metric = {
            m: {str(j): float(values.sel(trial=j)) for j in shown_trials(scenario)}
            for m, values in shown.items()
        }
        published = [_beside(p, scenario, shown) for p in scenario.due if p.scheme == name]
        axes = _by_axis(scenario, dataset.sel(scheme=name))
        course = {event: int(chosen[event]) for event in ("diverged_at", "grown_from")}
        grown = _grown(chosen, trials_of_step(scheme, scenario.task))
        schemes[name] = by_metric | course | grown | axes | {"published": published}
    return {
        "scenario": scenario.name,
        "trials": scenario.trials,
        "unit": scenario.shown_unit,
        "schemes": schemes,
    }


def errors_by_trial(scenario: Scenario, dataset: xr.Dataset) -> dict[str, list[float]]:
    """The metric that judges a scenario, of every trial by scheme, as in `run_numbers`."""
    found = {
        name: _shown(scenario, _largest(dataset, name), scenario.judged_by)
        for name in scenario.schemes
    }
    return {name: errors.fillna(np.inf).values.tolist() for name, errors in found.items()}


def _largest(dataset: xr.Dataset, scheme: str) -> xr.Dataset:
    """The results of one scheme, of several outputs or inputs the largest."""
    return dataset.sel(scheme=scheme).max(["channel", "input"], skipna=False)


def _shown(scenario: Scenario, chosen: xr.Dataset, metric: str) -> xr.DataArray:
    """A metric of one scheme [shown unit], infinite where a trial diverged."""
    values = scenario.shown(metric)[0] * chosen[metric]
    return values if metric == "best_trial" else values.where(~chosen["diverged"], np.inf)


def _by_axis(scenario: Scenario, chosen: xr.Dataset) -> Numbers:
    """The errors of each output by its name and trial [shown unit]; nothing for a single output."""
    if scenario.task.outputs == 1:
        return {}
    shown = {metric.name: _shown(scenario, chosen, metric.name) for metric in ERRORS}
    axes = {
        called: {
            metric: {str(j): float(errors.sel(trial=j)[i]) for j in shown_trials(scenario)}
            for metric, errors in shown.items()
        }
        for i, called in enumerate(outputs_of(chosen))
    }
    return {"axes": axes}


def _grown(chosen: xr.Dataset, every: int) -> Numbers:
    """The rms error of the last trial in units of that of the best trial, and its number.

    every: as `schemes.scheme.trials_of_step`, by which experiments are left out
    """
    rms = chosen["rms"].values[::every]
    best = int(np.nanargmin(np.where(np.isfinite(rms), rms, np.inf)))
    return {
        "best": best * every + 1,
        "grown_to": float(rms[-1] / rms[best]) if rms[best] > 0 else 1.0,
    }


def _beside(p: Published, scenario: Scenario, shown: dict[str, xr.DataArray]) -> Numbers:
    """A published number and ours, None of a trial that was not run, and whether it is met."""
    trial = p.trial or 1
    ours = float(shown[p.quantity].sel(trial=trial)) if trial <= scenario.trials else None
    near = None if ours is None else met(p, ours)
    return {
        "trial": p.trial,
        "quantity": p.quantity,
        "value": p.value,
        "unit": scenario.shown(p.quantity)[1],
        "source": p.source,
        "agreement": p.agreement,
        "ours": ours,
        "met": near,
    }


def run_table(scenario: Scenario, numbers: Numbers) -> Table:
    """The metric that judges by trial and scheme, with published values in brackets."""
    metric, (_, unit) = scenario.judged_by, scenario.shown(scenario.judged_by)
    lines, printed = [], ""
    for j in shown_trials(scenario):
        cells = []
        for rows in numbers["schemes"].values():
            values = [
                p["value"] for p in rows["published"] if p["quantity"] == metric and p["trial"] == j
            ]
            printed = ", published value in brackets" if values else printed
            cells.append(number(rows[metric][str(j)]) + "".join(f" ({v:g})" for v in values))
        lines.append((str(j), *cells))
    what = f"{labelled(metric, unit)} by trial{printed}"
    return Table(right=("trial", *scenario.schemes), title=f"{scenario.title}\n{what}", rows=lines)


def other_rows(scenario: Scenario, numbers: Numbers) -> list[str]:
    """The published numbers that have no cell in `run_table`, one line each."""
    in_table = {(scenario.judged_by, j) for j in shown_trials(scenario)}
    lines = []
    for name, rows in numbers["schemes"].items():
        for p in rows["published"]:
            if p["ours"] is not None and (p["quantity"], p["trial"]) not in in_table:
                at = f" at trial {p['trial']}" if p["trial"] else ""
                ours = f"{p['quantity'].replace('_', ' ')}{at} is {number(p['ours'])} {p['unit']}"
                lines.append(f"{name}: {ours} (published {p['value']:g})")
    return lines


def reading_lines(scenario: Scenario, numbers: Numbers) -> list[str]:
    """A sentence where ours and published numbers part: what is simulated, what is judged."""
    beside = [p for rows in numbers["schemes"].values() for p in rows["published"]]
    counts = []
    for of_software, judged_so in enumerate(COUNTED):
        of = [p for p in beside if (p["agreement"] is not None) == of_software]
        near = [p["met"] for p in of if p["met"] is not None]
        if not all(near):
            counts.append(f"{near.count(True)} of {len(near)} {judged_so}")
    if not counts:
        return []
    judged = {name: value for p in scenario.due for name, value in p.options}
    judged |= {k: v for k, v in scenario.usual.items() if k == "reading"}
    other = [name for name, value in judged.items() if scenario.options.get(name) != value]
    here = ", ".join(f"{name}={scenario.options[name]}" for name in other)
    there = " ".join(f"--set {name}={judged[name]}" for name in other)
    lines = counts
    if other:
        lines[-1] += f": simulated is {here}"
        lines.append(f"The paper is judged with {there}")
    return [". ".join([*lines, f"jaxilc reproduce {scenario.name} says how each number was read."])]


def last_trial_table(numbers: Numbers) -> Table:
    """The table of the errors of the last trial of a run by every metric, and of the best trial."""
    last = str(numbers["trials"])
    title = f"trial {last}, errors in {numbers['unit'] or 'the unit of y'}"
    table = Table("scheme", right=(*HEADS, "best trial (by rms)"), title=title)
    for name, rows in numbers["schemes"].items():
        errors = (number(rows[m.name][last]) for m in ERRORS)
        table.add_row(name, *errors, str(rows["best"]))
    return table


def axes_table(numbers: Numbers) -> Table:
    """The table of the errors of the last trial of a run, axis by axis, and of the contour."""
    last = str(numbers["trials"])
    title = f"trial {last} by axis, errors in {numbers['unit'] or 'the unit of y'}"
    table = Table("scheme", "axis", right=HEADS, title=title)
    for name, rows in numbers["schemes"].items():
        for axis, errors in rows["axes"].items():
            table.add_row(name, axis, *(number(errors[m.name][last]) for m in ERRORS))
        if "contour_max" in rows:
            contour = {of: number(rows[m][last]) for of, m in OF_CONTOUR.items()}
            table.add_row(name, "contour", *(contour.get(m.name, "") for m in ERRORS))
    return table


def course_lines(numbers: Numbers) -> list[str]:
    """A line for each scheme of a run that diverged, or whose error has grown."""
    lines = []
    for name, rows in numbers["schemes"].items():
        if rows["diverged_at"]:
            lines.append(
                f"{name}: diverged at trial {rows['diverged_at']}: not finite, "
                f"or an error of {CEILING:g} times the reference"
            )
        elif rows["grown_from"]:
            lines.append(
                f"{name}: the rms error has grown {number(rows['grown_to'])} times since trial "
                f"{rows['best']}; from trial {rows['grown_from']} on it is more than "
                f"{1 + GROWTH:g} times its least"
            )
    return lines


def run_verdict(case: Case, numbers: Numbers, errors: Mapping[str, Sequence[float]]) -> Verdict:
    """Which scheme ends with the least error, how far it came, and where it goes.

    errors: of the trials by scheme [unit of the case], infinite where a trial diverged
    """
    trials, errors = numbers["trials"], case.of_learned(errors)
    best = min(errors, key=lambda name: (diverged(errors[name]), errors[name][-1]))
    first, last = errors[best][0], errors[best][-1]
    alike = [
        name
        for name, of in errors.items()
        if name != best and not diverged(of) and of[-1] <= (1 + ALIKE) * last
    ]
    course = trend_of(errors[best])
    course = course._replace(words=course.words and f"it {course.words}")
    if course.kind == DIVERGES:
        which = best if len(errors) == 1 else "Every scheme"
        return Verdict(
            (f"{which} diverges within {several(trials, 'trial')}.",), *case.remedy(best)
        )
    if last > EXACT * first:
        course = _with_rms(course, numbers["schemes"][best])
    played = trials - (trials - 1) % case.steps.get(best, 1)  # the last trial that is no experiment
    begun = f", after {case.size(first)} in trial 1" if played > 1 else ""
    it = f"; {course.words}" if course.words and case.learns[best] else ""
    ends = f"trial {played} has {case.an_error} of {case.size(last)}{begun}{it}."
    head = f"{case.head(best, alike)}{ends}"
    passed = case.tolerance is None or last <= case.tolerance
    sentences = said(head, _larger_elsewhere(case, best, numbers), case.beside_tolerance(last))
    return Verdict(sentences, *_after_run(case, best, course, passed, trials))


def _larger_elsewhere(case: Case, best: str, numbers: Numbers) -> str:
    """A sentence where the best scheme, by a settled or rms error, errs more at some sample."""
    trial, rows = str(numbers["trials"]), numbers["schemes"]
    largest = {name: of["max_error"][trial] for name, of in rows.items() if "max_error" in of}
    least = min(largest, key=lambda name: largest[name], default=best)
    if case.metric not in ("settled error", "rms") or largest.get(best, 0) <= (
        1 + ALIKE
    ) * largest.get(least, 0):
        return ""
    of_whole = (f"{number(largest[name])} {numbers['unit']}".rstrip() for name in (best, least))
    ours, other = of_whole
    return f"Over the whole trial it errs by up to {ours}, and {least} by {other}."


def _with_rms(course: Trend, row: Numbers) -> Trend:
    """The trend of a metric, with a subject; it also grows if the rms error of the run does."""
    if course.kind in (FALLS, SETTLED) and row["grown_from"]:
        times, best = number(row["grown_to"]), row["best"]
        words = f"its rms error has grown {times} times since trial {best}"
        return course._replace(kind=GROWS, words=words)
    return course


def _after_run(case: Case, best: str, course: Trend, passed: bool, trials: int) -> tuple[str, str]:
    if not case.learns[best] or course.kind == GROWS:
        return case.remedy(best)
    if course.kind == FALLS and (case.tolerance is None or not passed):
        return "until it settles", case.on("run", best, trials=2 * trials)
    if not passed:
        return case.remedy(best)
    if case.uncertain:
        return "many machines", case.on("sweep", best)
    return "what theory claims", case.on("certify", best)
