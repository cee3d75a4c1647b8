"""`tune`, `pareto`, `worst_case`: what the gradient through the learning finds."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, Protocol, TypeVar

import numpy as np

from .. import figures
from ..figures.searches import worst_by_effort
from ..figures.style import labelled
from ..learning.over_trials import check
from ..pytree.aliases import Value
from ..pytree.closest import first_of, listed
from ..pytree.named_paths import get_at
from ..pytree.ranges import share_text
from ..scenarios import Scenario
from ..scenarios.from_file import load_scenario
from ..scenarios.parameters import differing, write_parameters
from ..storage.sealed import write_json
from ..sweeps.summary import summarise
from ..tuning import Tuned, Tuning, trade_off
from ..tuning.objectives import Final, Objective
from ..tuning.worst_case import DRAWS, ENOUGH, GRADIENT_COST, worst_machine
from ..uncertainty import Normal, Uncertainty
from .outcome import Figure, Numbers, Outcome, Progress, Table, Verdict, silent
from .request import Request, unless_there
from .sweeping import live_store, sweep_numbers
from .terms import limits_not_met, objective_for, risk_of, weights_of, with_limits
from .words import Case, number, several

if TYPE_CHECKING:
    import xarray as xr


WHICH = ("given", "tuned")
WORTHWHILE = 0.05  # a smaller share by which an error falls is told as none
FEW = 6  # weights that the verdict names, and settings of a machine that a command repeats
ENDED = {  # why a tuning ended before its last step, by its reason
    "patience": ", where it stopped, as no later one was better",
    "no machine has a finite loss": ", where it stopped, as no machine had a finite loss there",
}


T = TypeVar("T")


class Run(Protocol):
    """How one or several tunings are run, as `run_search`."""

    def __call__(self, search: Callable[..., T], *state: Value, **how: Value) -> T: ...


def run_search(
    search: Callable[..., T],
    state: Path,
    *,
    resume: bool,
    progress: Callable[..., object],
    meanwhile: Sequence[Callable[[], object]] = (),
) -> T:
    """Run a search, such as `Tuning.run`, in the folder of its state, and do nothing meanwhile."""
    return search(state, resume=resume, progress=progress)


def tune(
    request: Request | str,
    *,
    weights: str,
    objective: str = "final",
    limits: Sequence[str] = (),
    risk: str = "mean",
    unseen: int = 257,
    compare_trials: int | None = None,
    folder: str | Path | None = None,
    resume: bool = False,
    run: Run = run_search,
    progress: Progress = silent,
    **settings: Value,
) -> Outcome:
    """Tune weights by gradient through the learning, and compare them on machines not seen.

    request: what is simulated, with one scheme; a name or a plant file stands for all of it
    weights: leaves or elements of the scheme, with or without bounds: `lam=0.1:10,phi0[0]`
    objective, risk: as texts, `final:20 + 0.3*final@max_error` and `cvar:0.9`
    limits: largest values NAME=NUMBER of `d2` or `contraction`
    unseen: number of machines of the comparison, the nominal one included
    compare_trials: trials of the comparison; those of the tuning if not given
    folder: for the results; out/tune-NAME if not given
    resume: whether to go on with what is in the folder
    run: how a tuning is run, as `run_search`
    settings: further arguments of `Tuning`, such as `machines`, `steps` and `seed`
    Raises ValueError naming what is allowed, and FileExistsError for results without `resume`.
    """
    objective = with_limits(objective, limits)
    request = Request.of(request).expanded()
    chosen, scheme = request.of_one_scheme()
    problem = problem_of(chosen, weights, objective_for(chosen, objective), risk, **settings)
    place = Path(folder or f"out/tune-{chosen.name}")
    comparison = problem.comparison(trials=compare_trials, machines=unseen)  # may raise
    progress("compiling", 0, problem.steps)
    tuned = run(
        problem.run,
        unless_there(place / "state", resume),
        resume=resume,
        progress=lambda step, *losses: progress(in_words(*losses), step, problem.steps),
        meanwhile=(comparison.compile,),
    )
    progress("comparing", problem.steps, problem.steps)
    dataset = problem.compare(tuned, trials=compare_trials, machines=unseen)
    numbers = tuning_numbers(chosen, scheme, tuned, dataset)
    _tell_ranges(problem, weights, numbers["weights"])
    result, warnings = tuning_lines(tuned, numbers)
    by_last = is_error_of(problem, chosen.judged_by, numbers["trials"])
    shown = dataclasses.replace(request, trials=compare_trials or request.trials)
    scale, unit = chosen.shown(chosen.judged_by)
    band = {"metric": chosen.judged_by, "scale": scale, "unit": unit}
    configuration = problem.configuration()
    obtained = {"held_out_loss": numbers["held_out"], "configuration": configuration}
    return Outcome(
        command="tune",
        numbers=numbers,
        verdict=tune_verdict(
            Case.of(chosen, shown), numbers, place / "params.json", by_last=by_last
        ),
        folder=place,
        scenario=chosen,
        tables=tuning_tables(chosen, numbers),
        lines=[result],
        warnings=[*warnings, *without_size(problem), *limits_not_met(problem, tuned, limits)],
        figures={
            "loss": Figure(
                "The loss at each step of the tuning, on the machines tuned on and on others.",
                partial(
                    figures.loss_by_step, tuned, name=f"{risk} of {objective} [ln of error / floor]"
                ),
            ),
            "learning": Figure(
                "The errors by trial over the nominal machine and others that no step has seen, "
                "for each law, and their ratio.",
                partial(figures.given_and_tuned, dataset, **band),
            ),
        },
        files={"params.json": parameter_file("tune", chosen, request, tuned, **obtained)},
        live=partial(live_store, chosen, dataset),
        asked={"weights": weights, "objective": objective, "risk": risk},
        configuration=configuration,
    )


# What `tune` and `pareto` share
# --------------------------------------------------------------------------------------------------


def problem_of(
    chosen: Scenario, weights: str, objective: Objective, risk: str, **settings: Value
) -> Tuning:
    """The tuning problem of a scenario with one scheme, with further arguments of `Tuning`."""
    (scheme,) = chosen.schemes.values()
    return Tuning(
        chosen.machine, scheme, chosen.task, chosen.trials, weights=weights_of(weights),
        uncertainty=chosen.uncertainty, objective=objective, risk=risk_of(risk),
        quantities=chosen.functions, **settings,
    )  # fmt: skip


def is_error_of(problem: Tuning, metric: str, trial: int) -> bool:
    """Whether a tuning is for the metric of this trial, and for nothing else."""
    return all(
        isinstance(term, Final) and (term.metric, term.trial or problem.trials) == (metric, trial)
        for _, term in problem.objective.terms
    )


def in_words(losses: np.ndarray, best: float) -> str:
    """How far a tuning is: the least loss of this step, and the least on the machines held out."""
    return f"loss {np.nanmin(losses):.4g}, held out {best:.4g}"


def parameter_file(
    command: str, chosen: Scenario, request: Request, tuned: Tuned, **obtained: object
) -> Callable[[Path], object]:
    """A function that writes the parameters in which a tuned scheme differs from its scenario's."""

    def write(path: Path) -> object:
        (scheme,) = chosen.schemes
        printed = load_scenario(request.source, chosen.options).schemes[scheme]
        changed = {scheme: differing(tuned.scheme, printed)}
        how = {"command": f"jaxilc {command}", "options": dict(chosen.options), **obtained}
        return write_parameters(path, chosen.name, changed, how)

    return write


# Numbers, tables and verdict
# --------------------------------------------------------------------------------------------------


def tuning_numbers(scenario: Scenario, scheme: str, tuned: Tuned, dataset: xr.Dataset) -> Numbers:
    """Weights, held-out losses, and quantiles over machines by metric, tuning and trial."""
    trials, machines = dataset.sizes["trial"], dataset.sizes["sample"]
    by_metric, diverged, rows = {}, {}, []
    for metric in dict.fromkeys((scenario.judged_by, "max_error")):
        now = dataclasses.replace(scenario, judged_by=metric, trials=trials)
        summary = summarise(dataset, 1.0, metric=metric)
        of = sweep_numbers(now, summary, 1.0, machines)["schemes"]
        by_metric[metric] = {"unit": scenario.shown(metric)[1]} | {
            which: of[which]["by_trial"] for which in WHICH
        }
        diverged = {which: of[which]["diverged"] for which in WHICH}
        rows += [of[which]["by_trial"] for which in WHICH]
    return {
        "scenario": scenario.name,
        "scheme": scheme,
        "trials": trials,
        "samples": machines,
        "drawn": _drawn(bool(scenario.uncertainty), machines, *rows),
        "diverged": diverged,
        "weights": {
            name: {"given": tuned.start[name], "tuned": value}
            for name, value in tuned.values.items()
        },
        "held_out": held_out(tuned),
        "figures": by_metric,
    }


def held_out(tuned: Tuned) -> Numbers:
    """The losses on the machines held out, the step of the least one, and why the tuning ended."""
    return {
        "given": tuned.before,
        "tuned": tuned.after,
        "step": tuned.step,
        "steps": len(tuned.loss),
        "reason": tuned.reason,
    }


def tuning_tables(scenario: Scenario, numbers: Numbers) -> list[Table]:
    """The table of weights, and for each metric a table by trial, as given and as tuned."""
    scheme = numbers["scheme"]
    weights = Table("weight", right=WHICH, title=f"{scenario.title}\n{scheme}: weights")
    weights.add_column("allowed")
    for name, row in numbers["weights"].items():
        cells = (f"{row[which]:.6g}" for which in WHICH)
        low, high = row.get("range", (None, None))
        allowed = scenario.allowed(f"{scheme}.{name}") if low is None else f"{low:g} to {high:g}"
        weights.add_row(name, *cells, allowed)
    found = [weights]
    for metric, rows in numbers["figures"].items():
        what = labelled(metric, rows["unit"])
        table = Table(
            right=("trial", *WHICH, "ratio of medians", "ratio of worsts"),
            title=f"{what} {_over(numbers['samples'], numbers['drawn'])}; ratios are given / tuned",
        )
        for j in rows["given"]:
            given, tuned = (rows[which][j] for which in WHICH)
            both = ((given[q], tuned[q]) for q in ("median", "worst"))
            ratios = (number(one / other) if other else "–" for one, other in both)
            table.add_row(j, quantiles(given), quantiles(tuned), *ratios)
        found.append(table)
    return found


def _drawn(uncertain: bool, machines: int, *rows: Numbers) -> str:
    """What differs among so many machines: `machines`, `runs` of one machine, or nothing.

    rows: quantiles by trial, {trial: {"median": .., "worst": ..}}
    """
    if uncertain and machines > 1:
        return "machines"
    differ = any(row["median"] != row["worst"] for of in rows for row in of.values())
    return "runs" if differ else ""


def _over(machines: int, drawn: str) -> str:
    """The machines whose quantiles are shown, in words; drawn: what `_drawn` says."""
    of = {
        "machines": f"{machines} machines",
        "runs": f"{machines} runs of the machine, each drawn anew",
        "": "the machine, nothing being drawn",
    }
    return f"of {of[drawn]}: median (95 %, worst)"


def tuning_lines(tuned: Tuned, numbers: Numbers) -> tuple[str, list[str]]:
    """One line with the held-out loss before and after tuning, and a line for each warning."""
    held = numbers["held_out"]
    result = (
        f"held-out loss {held['given']:.6g} -> {held['tuned']:.6g}, "
        f"step {tuned.step} of {len(tuned.loss)}{ENDED.get(tuned.reason, '')}"
    )
    warnings = [
        f"{name} lay on an end of its range and started from {value:g}"
        for name, value in tuned.nudged.items()
    ]
    if tuned.dropped.any():
        most = int(tuned.dropped.max())
        warnings.append(f"up to {most} machines a step had no finite slope and were left out")
    return result, warnings


def without_size(problem: Tuning) -> list[str]:
    """A line on the weights whose steps suit them only by chance, as nothing tells their size."""
    names = [
        name
        for name, of in problem.bijections.items()
        if not problem.start[name] and {abs(of.low), abs(of.high)} <= {0.0, math.inf}
    ]
    if not names or problem.optimiser != "adam":
        return []
    return [
        f"without a finite range, nothing tells the size of what starts at 0: {listed(names)}. So "
        f"steps are {problem.rate:g} in whatever unit it has; {names[0]}=LOW:HIGH would tell it"
    ]


def quantiles(row: dict[str, float]) -> str:
    """A text `1.2 (1.5, 1.8)`: the median, and in brackets the 95 % quantile and the worst."""
    return f"{number(row['median'])} ({number(row['high'])}, {number(row['worst'])})"


def _share(share: float) -> str:
    return {0.0: "none", 1.0: "all"}.get(share) or share_text(share)


def tune_verdict(case: Case, numbers: Numbers, params: Path, *, by_last: bool = True) -> Verdict:
    """What the tuning gained on machines not seen.

    by_last: whether the objective is the error of the last trial alone, so that this error tells
        which weights are better
    """
    metric = case.metric.replace(" ", "_")
    rows, last = numbers["figures"][metric], str(numbers["trials"])
    given, tuned = rows["given"][last], rows["tuned"][last]
    held, scheme = numbers["held_out"], numbers["scheme"]
    kept = (math.isclose(row["tuned"], row["given"]) for row in numbers["weights"].values())
    unmoved = held["step"] == 0 and all(kept)  # and not another start, which no step has bettered
    if unmoved or not held["tuned"] < held["given"]:  # where the start was moved into its range
        said = "No step judged on the machines held out was better than the weights as given."
        if not held["steps"]:
            said = "No machine has a finite loss with the weights as given: nothing was tuned."
        if not case.uncertain:
            return Verdict((said,), "what theory claims", case.on("certify", scheme))
        return Verdict((said,), "the worst machine", case.on("worst-case", scheme))
    changed = [
        f"{name} = {number(row['tuned'])} (was {number(row['given'])})"
        for name, row in numbers["weights"].items()
    ]
    median, worst = (
        f"{case.size(tuned[of])} in place of {case.size(given[of])}" for of in ("median", "worst")
    )
    first = f"{first_of(changed, FEW)}: "
    machines, drawn, what = numbers["samples"], numbers["drawn"], f"{case.error} of trial {last}"
    if drawn == "machines":
        first += f"of {machines} machines, the nominal one and {machines - 1} not seen, "
    elif drawn:
        first += f"of {machines} runs of the machine, each drawn anew, "
    diverged = [_share(numbers["diverged"][which]) for which in WHICH]
    if drawn and tuned["median"] == math.inf:
        first += f"{diverged[1]} diverge within {last} trials, and with the weights as given "
        first += f"{diverged[0]}."
    elif drawn:
        first += f"the median {what} is {median}, the worst {worst}."
    else:
        first += f"the {what} is {median}."
    second = []
    gain = max(1 - tuned[of] / given[of] if given[of] else 0.0 for of in ("median", "worst"))
    if not by_last:
        second.append(
            "The objective is another than this error: on the machines held out its loss is "
            f"{held['tuned']:.4g} in place of {held['given']:.4g}."
        )
    elif -math.inf < gain < WORTHWHILE:
        change = "more at least" if gain < 0 else "less at best"
        good = "about as good" if gain > -WORTHWHILE else "better in this"
        said = f"That is {abs(100 * gain):.2g} % {change}: the weights as given are {good}."
        second.append(said)
    if by_last and tuned["worst"] > given["worst"]:
        one = "run" if drawn == "runs" else "machine"
        second.append(f"The worst {one} has become worse: --risk worst or cvar tunes for it.")
    else:
        second += [*_at_ends(numbers["weights"]), *_unfinished({"": held})]
    of = case.request.without(scheme)
    command = "sweep" if case.uncertain else "run"
    what = "many machines" if case.uncertain else "the whole run"
    following = of.following(command, scheme=scheme, params=params)
    return Verdict((first, *second), what, following)


def _unfinished(tunings: Mapping[str, Numbers], of: str = "{}") -> list[str]:
    """A sentence if the last step of some tunings was the best, with their names in the text of."""
    late = [
        name
        for name, held in tunings.items()
        if held["reason"] == "steps" and held["step"] == held["steps"]
    ]
    which = of.format(", ".join(late))
    more = f"The last step was the best{which}: more --steps, in another --out, may gain more."
    return [more] if late else []


def _tell_ranges(problem: Tuning, weights: str, rows: Numbers) -> None:
    """Add to the rows of weights that have bounds their range, and the end that was reached."""
    bounded = tuple(f"{name}[" for name, of in weights_of(weights).items() if of is not None)
    for weight, row in rows.items():
        if f"{weight}[".startswith(bounded):
            row["range"] = [problem.bijections[weight].low, problem.bijections[weight].high]
            if (end := _end_reached(problem, weight, row)) is not None:
                row["end"] = end


def _end_reached(problem: Tuning, name: str, row: Numbers) -> float | None:
    """The end of its range that a weight has come to, where a value beyond is allowed."""
    found = problem.bijections[name].reached(row["given"], row["tuned"])
    try:
        if found is not None:
            check(problem.population.machine, problem.scheme_of({name: found[1]}), problem.task)
    except ValueError:
        return None
    return found and found[0]


def _at_ends(weights: Mapping[str, Numbers]) -> list[str]:
    """A sentence on the first weight that has come to an end of the range asked for."""
    return [
        f"{name} has come to the end {row['end']:g} of its range, {row['range'][0]:g} to "
        f"{row['range'][1]:g}: beyond it may be a better value."
        for name, row in weights.items()
        if "end" in row
    ][:1]


# `pareto`: two objectives, or the best result for each number of trials
# --------------------------------------------------------------------------------------------------


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
    folder: str | Path | None = None,
    resume: bool = False,
    run: Run = run_search,
    progress: Progress = silent,
    **settings: Value,
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
    place = Path(folder or f"out/pareto-{chosen.name}")
    count = len(budgets or shares or trade_off.SHARES)
    begun: dict[str, int] = {}

    def told(name: str, step: int, losses: np.ndarray, best: float) -> None:
        before = begun.setdefault(name, len(begun))
        words = f"{name} ({before + 1} of {count}): {in_words(losses, best)}"
        progress(words, before * problem.steps + step, count * problem.steps)

    of = _Of(request, chosen, scheme, problem, place, run, resume, told)
    if budgets:
        found = _by_trials(of, budgets, unseen)
    else:
        (second,) = others
        found = _front(of, second, shares or trade_off.SHARES, (objectives[0], objectives[1]))
    asked = dict(zip(("first", "second"), (*objectives, None), strict=False))
    numbers = {"scenario": chosen.name, "scheme": scheme} | asked | found.numbers
    return dataclasses.replace(found, numbers=numbers)


def _need_one_kind(
    request: Request, objectives: Sequence[str], shares: Sequence[float], budgets: Sequence[int]
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
    """What both kinds of trade-off share: scenario, problem and folder, and how it is run."""

    request: Request
    chosen: Scenario
    scheme: str
    problem: Tuning
    folder: Path
    run: Run
    resume: bool
    progress: Callable[..., object]

    def solve(self, search: Callable[..., T]) -> T:
        """The result of a search, whose state is in the folder."""
        state = unless_there(self.folder / "state", self.resume)
        return self.run(search, state, resume=self.resume, progress=self.progress)

    def outcome(self, points: Mapping[str, tuple[Tuned, Numbers]], **found: Value) -> Outcome:
        """What was found; each tuning, with its numbers, by the name of its parameter file."""
        asked, configuration = (self.chosen, self.request), self.problem.configuration()
        made = {"machine": configuration["machine"]}
        files = {
            name: parameter_file("pareto", *asked, tuned, point=point, configuration=made)
            for name, (tuned, point) in points.items()
        }
        return Outcome(
            command="pareto", folder=self.folder, scenario=self.chosen, files=files,
            configuration=configuration, **found,
        )  # fmt: skip


def _front(of: _Of, second: Objective, shares: Sequence[float], names: tuple[str, str]) -> Outcome:
    """The front of two objectives; the first one is that of the problem."""
    problem, first = of.problem, of.problem.objective
    losses = trade_off.held_out_losses(problem, first, second)  # compiled once for both
    points = of.solve(partial(trade_off.pareto, problem, first, second, shares, losses=losses))
    one, other = given = losses(problem.start).tolist()
    rows: Numbers = {"given": {"first": one, "second": other, "weights": problem.start}}
    rows |= {
        str(p.share): {
            "first": p.first,
            "second": p.second,
            "weights": p.tuned.values,
            "held_out": held_out(p.tuned),
        }
        for p in points
    }
    left = sorted(set(shares) - {p.share for p in points})
    numbers: Numbers = {"trials": problem.trials, "points": rows, "left_out": left}
    first_name, second_name = (f"{name}, on held-out machines" for name in names)
    weights = {
        None if share == "given" else float(share): row["weights"] for share, row in rows.items()
    }
    case = Case.of(of.chosen, of.request)
    draw = partial(
        figures.pareto_front, points, first=first_name, second=second_name, given=given,
        weights=weights,
    )  # fmt: skip
    caption = "The trade-off: each point is a tuning, with the share of the first objective."
    return of.outcome(
        {f"params-share-{p.share}.json": (p.tuned, rows[str(p.share)]) for p in points},
        numbers=numbers,
        verdict=front_verdict(case, of.scheme, numbers, of.folder, names),
        tables=[front_table(of.chosen, of.scheme, numbers)],
        lines=[
            f"share {share} is left out: another point, or the weights as given, is no worse in "
            "either objective"
            for share in left
        ],
        figures={"front": Figure(caption, draw, live=True)},
    )


def _by_trials(of: _Of, budgets: Sequence[int], unseen: int) -> Outcome:
    """One tuning for each number of trials, all judged on the same machines, unused in tuning."""
    problem = of.problem
    most = max(budgets)
    same = dict.fromkeys(("given", *map(str, budgets)), problem.scheme)
    problem.comparison(same, trials=most, machines=unseen)  # raises before the tuning
    found = of.solve(partial(trade_off.by_trials, problem, budgets))
    schemes = {"given": problem.scheme} | {str(J): tuned.scheme for J, tuned in found.items()}
    compared = problem.comparison(schemes, trials=most, machines=unseen).run()
    numbers = budget_numbers(of.chosen, found, compared)
    rows, metric, unit = numbers["budgets"], numbers["figure"], numbers["unit"]
    errors = [[[row[w]["median"], row[w]["worst"]] for row in rows.values()] for w in WHICH]
    weights = {name: [row["weights"][name] for row in rows.values()] for name in problem.start}
    case = Case.of(of.chosen, of.request)
    draw = partial(
        figures.final_error_by_trials, budgets, *errors, metric=metric, unit=unit, weights=weights
    )
    caption = "The last error with the weights as given, and with those tuned for so many trials."
    return of.outcome(
        {f"params-{J}-trials.json": (tuned, rows[str(J)]) for J, tuned in found.items()},
        numbers=numbers,
        verdict=budget_verdict(case, of.scheme, numbers, of.folder),
        tables=[budget_table(of.chosen, of.scheme, numbers)],
        figures={"trials": Figure(caption, draw, live=True)},
    )


def budget_numbers(scenario: Scenario, found: Mapping[int, Tuned], dataset: xr.Dataset) -> Numbers:
    """The metric of trial J [shown unit] over the machines, as given and as tuned for J trials."""
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
            "held_out": held_out(tuned),
        }
        for J, tuned in found.items()
    }
    return {"figure": metric, "unit": unit, "samples": dataset.sizes["sample"], "budgets": rows}


def front_table(scenario: Scenario, scheme: str, numbers: Numbers) -> Table:
    """The table of both objectives and the weights for each point of a front."""
    what = f"{scheme}, {numbers['trials']} trials: objectives on held-out machines"
    columns = ("first", "second", *numbers["points"]["given"]["weights"])
    table = Table("share of first", right=columns, title=f"{scenario.title}\n{what}")
    for name, row in numbers["points"].items():
        values = (row["first"], row["second"], *row["weights"].values())
        table.add_row(name, *(f"{value:.6g}" for value in values))
    return table


def budget_table(scenario: Scenario, scheme: str, numbers: Numbers) -> Table:
    """The table for each number of trials: the metric as given and as tuned, and the weights."""
    rows = numbers["budgets"]
    metric = f"{labelled(numbers['figure'], numbers['unit'])} of trial J"
    errors = ({which: row[which] for which in WHICH} for row in rows.values())
    drawn = _drawn(bool(scenario.uncertainty), numbers["samples"], *errors)
    what = f"{metric} {_over(numbers['samples'], drawn)}"
    columns = ("J", *WHICH, *next(iter(rows.values()))["weights"])
    title = f"{scenario.title}\n{scheme}, tuned for J trials: {what}"
    table = Table(right=columns, title=title)
    for J, row in rows.items():
        weights = (f"{value:.6g}" for value in row["weights"].values())
        table.add_row(J, *(quantiles(row[which]) for which in WHICH), *weights)
    return table


def front_verdict(
    case: Case, scheme: str, numbers: Numbers, folder: Path, names: tuple[str, str]
) -> Verdict:
    """Between what ends the front lies, and the point that is nearest to the best of both."""
    points = {share: row for share, row in numbers["points"].items() if share != "given"}
    given = numbers["points"]["given"]
    if not points:
        return Verdict(("No point is better than the weights as given.",))
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
    late = _unfinished({of: row["held_out"] for of, row in points.items()}, " for share {}")
    return Verdict((said, *([ends] if len(points) > 1 else []), *late), "that point", following)


def _knee(points: dict[str, Numbers]) -> str:
    """The point with the least sum of both objectives, each as a share of its range."""
    names = ("first", "second")
    low = {k: min(row[k] for row in points.values()) for k in names}
    span = {k: max(row[k] for row in points.values()) - low[k] for k in names}

    def far(share: str) -> float:
        parts = [(points[share][k] - low[k]) / span[k] if span[k] > 0 else 0.0 for k in names]
        return sum(x if math.isfinite(x) else math.inf for x in parts)

    return min(points, key=far)


def budget_verdict(case: Case, scheme: str, numbers: Numbers, folder: Path) -> Verdict:
    """The fewest trials with which the error is near the least, on machines not seen."""
    rows = {int(J): row for J, row in numbers["budgets"].items()}
    least = min(row["tuned"]["median"] for row in rows.values())
    if not math.isfinite(least):
        return Verdict(("No number of trials leads to a finite error.",))
    J = min(J for J, row in rows.items() if row["tuned"]["median"] <= NEAR * least)
    tuned, given = rows[J]["tuned"], rows[J]["given"]
    fewer = [rows[K]["tuned"]["median"] for K in rows if K < J]
    if max(rows) == J and fewer:
        gain = 100 * (1 - tuned["median"] / min(fewer))
        enough = (
            f"{J} trials, the largest of {len(rows)} budgets, still leave {gain:.2g} % less than "
            f"the others, so that more may leave less: a median {case.error} of"
        )
    elif len(rows) > 1:
        enough = (
            f"{J} trials are enough for a median {case.error} within 5 % of the least of "
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
    late = _unfinished(
        {J: row["held_out"] for J, row in numbers["budgets"].items()}, " for {} trials"
    )
    return Verdict((said, *late), "that tuning", following)


# `worst_case`: the machine within the uncertainty with the largest final error
# --------------------------------------------------------------------------------------------------


ALIKE = 1e-3  # of the error, or of its logarithm where all diverge: machines this near are as bad


def worst_case(
    request: Request | str,
    *,
    starts: int = 16,
    steps: int = 30,
    evaluations: int | None = None,
    draws: int | None = None,
    seed: int = 0,
    folder: str | Path | None = None,
    progress: Progress = silent,
) -> Outcome:
    """The worst machine by climbing the gradient of its error, against machines drawn by chance.

    request: what is simulated, with one scheme; its last trial is the one whose metric is large
    starts, steps, evaluations, draws, seed: as for `tuning.worst_case`
    folder: for the results; out/worst-case-NAME if not given
    Raises ValueError naming what is allowed.
    """
    least = starts * (1 + GRADIENT_COST)
    if evaluations is not None and evaluations < least:
        raise ValueError(f"--evaluations {evaluations} is outside its allowed range [{least}, inf)")
    request = Request.of(request)
    chosen, scheme = request.of_one_scheme()
    scale, unit = chosen.shown(chosen.judged_by)
    found = worst_machine(
        chosen.machine, chosen.schemes[scheme], chosen.task, chosen.trials, chosen.uncertainty,
        metric=chosen.judged_by, scale=scale, quantities=chosen.functions, starts=starts,
        steps=steps, evaluations=evaluations, draws=draws, seed=seed,
        progress=lambda done, whole, name: progress(name, done, whole),
    )  # fmt: skip
    searches = {
        name: {
            "value": search.value,
            "over_noise": search.over_noise,
            "loss": search.case.loss,
            "evaluations": search.case.evaluations,
            "needed": search.needed,
            "level_with_chance": search.level_with_chance,
            "numbers": search.case.values,
            "set": _settings(search.case.subject, chosen.uncertainty),
        }
        for name, search in found.searches.items()
    }
    share, left_out = outside(chosen.uncertainty)
    numbers: Numbers = {
        "scenario": request.source,
        "scheme": scheme,
        "trial": chosen.trials,
        "figure": chosen.judged_by,
        "unit": unit,
        "seed": seed,
        "params": None if request.params is None else str(request.params),
        "given": [*request.set],
        "nominal": found.nominal,
        "outside": share,
        "searches": searches,
    }
    verdict = worst_case_verdict(Case.of(chosen, request), scheme, numbers, left_out)
    shown = {"metric": chosen.judged_by, "unit": unit}
    marked = {name: one.value for name, one in found.searches.items()}
    figure = Figure(
        "The share of drawn machines that err no more than so much, and the errors of the machines "
        f"that were searched for. {left_out}".strip(),
        partial(
            figures.worst_against_chance, found.by_chance, marked, nominal=found.nominal,
            machines={name: one.case.values for name, one in found.searches.items()}, **shown,
        ),
        live=True,
    )  # fmt: skip
    return Outcome(
        command="worst-case",
        numbers=numbers,
        verdict=verdict,
        folder=Path(folder or f"out/worst-case-{chosen.name}"),
        scenario=chosen,
        tables=worst_case_tables(chosen, numbers),
        figures={"worst-case": figure},
        files={"worst-case.json": partial(write_json, value=numbers | verdict.as_json())},
        live=lambda: [figure.described(), worst_by_effort.described(found.searches, **shown)],
        asked={"starts": starts, "steps": steps, "seed": seed},
    )


def outside(uncertainty: Uncertainty) -> tuple[float, str]:
    """The share of the machines outside the box that is searched, and a sentence if there are any.

    Only a normal distribution reaches beyond its corners, between which it is drawn as if uniform.
    """
    names = [name for name, of in uncertainty.items() if isinstance(of, Normal)]
    share = 1.0 - math.erf(math.sqrt(2.0)) ** len(names)
    said = (
        f"The search stays within two standard deviations of the mean of {listed(names)}, beyond "
        f"which {100 * share:.2g} % of the machines lie, and its draws are spread evenly there, "
        "unlike those of a sweep."
    )
    return share, said if names else ""


def _settings(machine, uncertainty: Uncertainty) -> list[str]:
    """The drawn leaves, element by element, as arguments of `--set`."""
    found = []
    for name in uncertainty:
        value = np.asarray(get_at(machine, name))
        for index in np.ndindex(value.shape):
            element = "".join(f"[{i}]" for i in index)
            found.append(f"{name}{element}={float(value[index])!r}")
    return found


def worst_case_tables(scenario: Scenario, numbers: Numbers) -> list[Table]:
    """The tables of the result and cost of each search, and of the worst machine for `--set`."""
    metric = labelled(numbers["figure"], numbers["unit"])
    what = f"largest {metric} at trial {numbers['trial']}, nominal {number(numbers['nominal'])}"
    columns = ("found", "evaluations", "of them until found", "until level with chance")
    title = f"{scenario.title}\n{numbers['scheme']}: {what}"
    table = Table("search", right=columns, title=title)
    for name, row in numbers["searches"].items():
        level = row["level_with_chance"]
        table.add_row(
            name,
            number(row["value"]),
            str(row["evaluations"]),
            str(row["needed"]),
            "never" if level is None else str(level),
        )
    worst = numbers["searches"][found_by(numbers["searches"])]
    settings = ((setting,) for setting in worst["set"])
    return [table, Table("--set", title="the worst machine", rows=settings)]


def found_by(searches: Mapping[str, Numbers]) -> str:
    """The search that found the worst machine, or one as bad, with the fewest evaluations."""
    largest = max(row["value"] for row in searches.values())
    worst = {name: row for name, row in searches.items() if row["value"] * (1 + ALIKE) >= largest}
    if largest == math.inf:  # of errors that diverge the loss tells how far
        loss = max(row["loss"] for row in worst.values())
        worst = {name: row for name, row in worst.items() if loss - row["loss"] <= ALIKE}
    return min(worst, key=lambda name: worst[name]["needed"])


def worst_case_verdict(case: Case, scheme: str, numbers: Numbers, left_out: str = "") -> Verdict:
    """How much larger the error of the worst machine is, if it is, and which search found it.

    left_out: what `outside` says
    """
    searches, nominal = numbers["searches"], numbers["nominal"]
    name = found_by(searches)
    worst, trial = searches[name], numbers["trial"]
    times = ""
    if 0 < nominal < math.inf and math.isfinite(worst["value"]):
        times = f", {number(worst['value'] / nominal)} times that of the nominal machine"
    ends = (
        f"has {case.an_error} of {case.size(worst['value'])} in trial {trial}{times}"
        if math.isfinite(worst["value"])
        else f"diverges within {several(trial, 'trial')}"
        + (", as the nominal one does" if nominal == math.inf else "")
    )
    needed = several(worst["needed"], "simulation")
    first = f"{scheme}: the worst machine {ends}; found by {name}, in {needed}."
    largest = max(row["value"] for row in searches.values())
    alike = math.isfinite(nominal) and largest <= (1 + ALIKE) * nominal
    if alike:
        first = (
            f"{scheme}: of the machines that were tried none is worse by {100 * ALIKE:g} % than "
            f"the nominal one, whose {case.error} in trial {trial} is {case.size(nominal)}."
        )
    if alike or len(worst["set"]) > FEW:
        what, following = "what theory claims", case.on("certify", scheme)
    else:
        settings = (*case.request.set, *worst["set"])
        what = "that machine"
        following = case.request.following("run", scheme=scheme, set=settings)
    said, judged = [first], worst["value"]
    if (over_noise := worst["over_noise"]) is not None and math.isfinite(judged):
        judged = over_noise
        said.append(
            f"That is with one draw of its noise: with {DRAWS} others, the error that {ENOUGH:.0%} "
            f"of them do not exceed is {case.size(judged)}."
        )
    said += filter(None, (case.beside_tolerance(judged), left_out))
    return Verdict(tuple(said), what, following)
