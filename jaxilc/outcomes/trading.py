"""`pareto`: a front of two objectives, or the best result for each number of trials."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from .. import figures
from ..sweeps.summary import summarise
from ..tuning import trade_off
from .case import Case
from .outcome import Figure, Outcome, Progress, silent
from .request import Request, unless_there
from .table import Table
from .tuning import (
    WHICH,
    in_words,
    objective_for,
    parameter_file,
    problem_of,
    quantiles,
    run_search,
)
from .verdict import Verdict
from .words import number

if TYPE_CHECKING:
    import xarray as xr

    from ..figures.page import Live
    from ..scenarios import Scenario
    from ..tuning import Tuned, Tuning
    from ..tuning.objectives import Objective
    from ..tuning.trade_off import Point

NEAR = 1.05  # factor above the least error within which fewer trials count as enough


def pareto(
    request: Request | str,
    *,
    weights: str,
    objectives: Sequence[str] = ("final",),
    shares: Sequence[float] = (),
    budgets: Sequence[int] = (),
    risk: str = "mean",
    unseen: int = 257,
    folder: Path | None = None,
    resume: bool = False,
    run: Callable[..., Any] = run_search,
    progress: Progress = silent,
    **settings: Any,
) -> Outcome:
    """Two objectives against each other, or one against the number of trials.

    Each point is a tuning by itself, from the weights as given, and leaves a parameter file.

    request: what is simulated, with one scheme; a name or a plant file stands for all of it
    weights, risk, settings, run: as for `tune`
    objectives: texts of two objectives, or of one beside `budgets`
    shares: of the first objective, `trade_off.SHARES` if not given
    budgets: numbers of trials to tune for
    unseen: machines on which the tunings for numbers of trials are compared
    folder: for the results; out/pareto-NAME if not given
    resume: whether to go on with what is in the folder; shares and budgets may be added
    Raises ValueError naming what is allowed, and FileExistsError for results without `resume`.
    """
    request = Request.of(request)
    _need_one_kind(request, objectives, shares, budgets)
    request = request.expanded()
    longest = dataclasses.replace(request, trials=max(budgets, default=request.trials))
    chosen, scheme = longest.of_one_scheme()
    first, *others = (objective_for(chosen, text) for text in objectives)
    problem = problem_of(chosen, weights, first, risk, **settings)
    place = folder or Path("out") / f"pareto-{chosen.name}"
    of = _Of(Case.of(chosen, request), chosen, scheme, problem, place)
    count = len(budgets or shares or trade_off.SHARES)
    begun: dict[str, int] = {}

    def told(name: str, step: int, *losses: Any) -> None:
        before = begun.setdefault(name, len(begun))
        words = f"{name} ({before + 1} of {count}): {in_words(*losses)}"
        progress(words, before * problem.steps + step, count * problem.steps)

    def solve(search: Callable[..., Any]) -> Any:
        return run(search, unless_there(place / "state", resume), resume=resume, progress=told)

    if budgets:
        found = _by_trials(of, budgets, unseen, solve)
    else:
        (second,) = others
        names = (objectives[0], objectives[1])
        found = _front(of, second, shares or trade_off.SHARES, names, solve)
    asked = dict(zip(("first", "second"), (*objectives, None), strict=False))
    return Outcome(
        command="pareto",
        numbers={"scenario": chosen.name, "scheme": scheme} | asked | found.numbers,
        verdict=found.verdict,
        folder=place,
        scenario=chosen,
        tables=[found.table],
        lines=[
            f"share {share} is left out: another point is no worse in either objective"
            for share in found.numbers.get("left_out", [])
        ],
        figures=found.figures,
        files={
            name: parameter_file("pareto", chosen, request, tuned, point=point)
            for name, (tuned, point) in found.points.items()
        },
        live=found.live,
        configuration=problem.configuration(),
    )


def _need_one_kind(
    request: Request,
    objectives: Sequence[str],
    shares: Sequence[float],
    budgets: Sequence[int],
) -> None:
    """Raises ValueError unless there are two objectives, or one and numbers of trials."""
    if len(objectives) != (1 if budgets else 2):
        beside = f" --budgets {_listed(budgets)}" if budgets else ""
        raise ValueError(
            f"--objective {', '.join(objectives)}{beside}: needed are two objectives, or one and "
            "--budgets"
        )
    for name, value in (("trials", request.trials), ("shares", _listed(shares))):
        if value and budgets:
            raise ValueError(f"--{name} {value} has no meaning beside --budgets {_listed(budgets)}")


def _listed(values: Sequence[float]) -> str:
    return ",".join(map(str, values))


class _Of(NamedTuple):
    """What both kinds of trade-off share: what is told of the scenario, problem and folder."""

    case: Case
    chosen: Scenario
    scheme: str
    problem: Tuning
    folder: Path


class _Found(NamedTuple):
    """The result of a trade-off.

    points: each tuning, with its numbers, by the name of its parameter file
    """

    numbers: dict[str, Any]
    table: Table
    verdict: Verdict
    figures: dict[str, Figure]
    points: dict[str, tuple[Tuned, dict[str, Any]]]
    live: Callable[[], list[Live]]


def _front(
    of: _Of,
    second: Objective,
    shares: Sequence[float],
    names: tuple[str, str],
    solve: Callable[..., Any],
) -> _Found:
    """The front of two objectives; the first one is that of the problem.

    names: texts of the objectives
    solve: a function that runs the tunings
    """
    problem, first = of.problem, of.problem.objective
    points = solve(partial(trade_off.pareto, problem, first, second, shares))
    given = trade_off.held_out_losses(problem, first, second)(problem.start).tolist()
    numbers = front_numbers(problem, points, given, shares)
    one, other = (f"{name}, on held-out machines" for name in names)

    def live() -> list[Live]:
        from ..figures.page import live

        rows = numbers["points"].items()
        weights = {
            None if share == "given" else float(share): row["weights"] for share, row in rows
        }
        drawn = {"first": names[0], "second": names[1], "given": tuple(given)}
        front = figures.pareto_front.described(points, **drawn, weights=weights)
        return [live(front)]

    return _Found(
        numbers,
        front_table(of.chosen, of.scheme, numbers),
        front_verdict(of.case, of.scheme, numbers, of.folder, names),
        {
            "front": Figure(
                "The trade-off: each point is a tuning, with the share of the first objective.",
                partial(figures.pareto_front, points, first=one, second=other, given=tuple(given)),
                live=True,
            )
        },
        {
            f"params-share-{p.share}.json": (p.tuned, numbers["points"][str(p.share)])
            for p in points
        },
        live,
    )


def _by_trials(of: _Of, budgets: Sequence[int], unseen: int, solve: Callable[..., Any]) -> _Found:
    """One tuning for each number of trials, all judged on the same machines, unused in tuning."""
    problem = of.problem
    judged: dict[str, Any] = {"trials": max(budgets), "machines": unseen}
    same = dict.fromkeys(("given", *map(str, budgets)), problem.scheme)
    problem.comparison(same, **judged)  # raises before the tuning
    found = solve(partial(trade_off.by_trials, problem, budgets))
    schemes = {"given": problem.scheme} | {str(J): tuned.scheme for J, tuned in found.items()}
    numbers = budget_numbers(of.chosen, found, problem.comparison(schemes, **judged).run())
    rows, shown = numbers["budgets"], {"metric": numbers["figure"], "unit": numbers["unit"]}
    errors = [[[row[w]["median"], row[w]["worst"]] for row in rows.values()] for w in WHICH]

    def live() -> list[Live]:
        from ..figures.page import live

        each = [row["weights"] for row in rows.values()]
        weights = {name: [of[name] for of in each] for name in each[0]}
        described = figures.final_error_by_trials.described
        return [live(described(budgets, *errors, weights=weights, **shown))]

    return _Found(
        numbers,
        budget_table(of.chosen, of.scheme, numbers),
        budget_verdict(of.case, of.scheme, numbers, of.folder),
        {
            "trials": Figure(
                "The last error with the weights as given, and with those tuned for so many "
                "trials.",
                partial(figures.final_error_by_trials, budgets, *errors, **shown),
                live=True,
            )
        },
        {f"params-{J}-trials.json": (tuned, rows[str(J)]) for J, tuned in found.items()},
        live,
    )


def front_numbers(
    problem: Tuning, points: Sequence[Point], given: Sequence[float], shares: Sequence[float]
) -> dict[str, Any]:
    """Both objectives and the weights for each point of a front, and for the weights as given.

    given: both objectives with the weights as given
    shares: all shares that were asked for
    """
    rows = {"given": {"first": given[0], "second": given[1], "weights": problem.start}}
    rows |= {
        str(p.share): {"first": p.first, "second": p.second, "weights": p.tuned.values}
        for p in points
    }
    left = sorted(set(shares) - {p.share for p in points})
    return {"trials": problem.trials, "points": rows, "left_out": left}


def budget_numbers(
    scenario: Scenario, found: Mapping[int, Tuned], dataset: xr.Dataset
) -> dict[str, Any]:
    """The metric of trial J [shown unit] for each number J of trials of a tuning.

    found: result of `by_trials`
    dataset: sweep of all tuned schemes, named by J as text, and of the scheme `given`
    """
    metric, (scale, unit) = scenario.judged_by, scenario.shown(scenario.judged_by)
    summary = {row.scheme: row for row in summarise(dataset, 1.0, metric=metric)}

    def at(name: str, J: int) -> dict[str, float]:
        return {
            of: scale * float(getattr(summary[name], of)[J - 1])
            for of in ("median", "high", "worst")
        }

    rows = {
        str(J): {
            "given": at("given", J),
            "tuned": at(str(J), J),
            "weights": tuned.values,
            "held_out": {"given": tuned.before, "tuned": tuned.after},
        }
        for J, tuned in found.items()
    }
    return {"figure": metric, "unit": unit, "samples": dataset.sizes["sample"], "budgets": rows}


def front_table(scenario: Scenario, scheme: str, numbers: dict[str, Any]) -> Table:
    """The table of both objectives and the weights for each point of a front."""
    what = f"{scheme}, {numbers['trials']} trials: objectives on held-out machines"
    table = Table("share of first", title=f"{scenario.title}\n{what}")
    for column in ("first", "second", *numbers["points"]["given"]["weights"]):
        table.add_column(column, justify="right")
    for name, row in numbers["points"].items():
        values = (row["first"], row["second"], *row["weights"].values())
        table.add_row(name, *(f"{value:.6g}" for value in values))
    return table


def budget_table(scenario: Scenario, scheme: str, numbers: dict[str, Any]) -> Table:
    """The table for each number of trials: the metric as given and as tuned, and the weights."""
    rows = numbers["budgets"]
    metric = f"{numbers['figure'].replace('_', ' ')} [{numbers['unit']}] of trial J"
    what = f"{metric} on {numbers['samples']} machines never seen: median (95 %, worst)"
    table = Table(title=f"{scenario.title}\n{scheme}, tuned for J trials: {what}")
    for column in ("J", *WHICH, *next(iter(rows.values()))["weights"]):
        table.add_column(column, justify="right")
    for J, row in rows.items():
        weights = (f"{value:.6g}" for value in row["weights"].values())
        table.add_row(J, *(quantiles(row[which]) for which in WHICH), *weights)
    return table


def front_verdict(
    case: Case, scheme: str, numbers: dict[str, Any], folder: Path, names: tuple[str, str]
) -> Verdict:
    """Between what ends the front lies, and the point that is nearest to the best of both.

    numbers: result of `front_numbers`
    folder: folder with the files of parameters
    names: the two objectives, as they were written
    """
    points = {share: row for share, row in numbers["points"].items() if share != "given"}
    given = numbers["points"]["given"]
    if not points:
        return Verdict(("No point of the front is finite.",))
    share = _knee(points)
    row = points[share]
    said = (
        f"The point of share {share} is nearest to the least of both: {names[0]} is "
        f"{number(row['first'])} and {names[1]} {number(row['second'])}, in place of "
        f"{number(given['first'])} and {number(given['second'])} with the weights as given."
    )
    first, second = ([row[k] for row in points.values()] for k in ("first", "second"))
    ends = (
        f"Over {len(points)} points {names[0]} goes from {number(min(first))} to "
        f"{number(max(first))}, {names[1]} from {number(max(second))} to {number(min(second))}."
    )
    params = folder / f"params-share-{share}.json"
    of = case.request.without(scheme)
    following = of.following("run", scheme=scheme, params=params, trials=numbers["trials"])
    return Verdict((said, ends) if len(points) > 1 else (said,), "that point", following)


def _knee(points: dict[str, dict[str, Any]]) -> str:
    """The point with the least sum of both objectives, each as a share of its range."""
    names = ("first", "second")
    low = {k: min(row[k] for row in points.values()) for k in names}
    span = {k: max(row[k] for row in points.values()) - low[k] for k in names}

    def far(share: str) -> float:
        parts = [(points[share][k] - low[k]) / span[k] if span[k] > 0 else 0.0 for k in names]
        return sum(x if math.isfinite(x) else math.inf for x in parts)

    return min(points, key=far)


def budget_verdict(case: Case, scheme: str, numbers: dict[str, Any], folder: Path) -> Verdict:
    """The fewest trials with which the error is near the least, on machines not seen.

    numbers: result of `budget_numbers`
    folder: folder with the files of parameters
    """
    rows = {int(J): row for J, row in numbers["budgets"].items()}
    least = min(row["tuned"]["median"] for row in rows.values())
    J = min((J for J, row in rows.items() if row["tuned"]["median"] <= NEAR * least), default=None)
    if J is None:
        return Verdict(("No number of trials leads to a finite error.",))
    tuned, given = rows[J]["tuned"], rows[J]["given"]
    fewer = [rows[K]["tuned"]["median"] for K in rows if K < J]
    if max(rows) == J and fewer:
        gain = 100 * (1 - tuned["median"] / min(fewer))
        enough = (
            f"{J} trials, the largest of {len(rows)} budgets, still leave {gain:.2g} % less than "
            f"the others, so that more may leave less: a median {case.metric} of"
        )
    elif len(rows) > 1:
        enough = (
            f"{J} trials are enough for a median {case.metric} within 5 % of the least of "
            f"{len(rows)} budgets:"
        )
    else:
        enough = f"Tuned for {J} trials:"
    said = (
        f"{enough} {case.size(tuned['median'])}, in place of {case.size(given['median'])} with "
        f"the weights as given (worst of {numbers['samples']} machines: {case.size(tuned['worst'])}"
        f" in place of {case.size(given['worst'])})."
    )
    of = case.request.without(scheme)
    params = folder / f"params-{J}-trials.json"
    following = of.following("run", scheme=scheme, params=params, trials=J)
    return Verdict((said,), "that tuning", following)
