"""`tune`: weights tuned by gradient through the learning, compared on machines not seen."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .. import figures
from ..scenarios.from_file import load_scenario
from ..scenarios.parameters import differing, write_parameters
from ..sweeps.summary import summarise
from ..tuning.problem import Tuning
from .case import Case
from .outcome import Figure, Outcome, Progress, silent
from .request import Request, unless_there
from .sweeping import live_store, sweep_numbers
from .table import Table
from .terms import limits_not_met, objective_of, risk_of, weights_of, with_limits
from .verdict import Verdict
from .words import number

if TYPE_CHECKING:
    import numpy as np
    import xarray as xr

    from ..scenarios import Scenario
    from ..tuning import Tuned
    from ..tuning.objectives import Objective

WHICH = ("given", "tuned")
WORTHWHILE = 0.05  # a smaller share by which an error falls is told as none
FEW = 6  # weights that the verdict names


def run_search(
    search: Callable[..., Any],
    state: Path,
    *,
    resume: bool,
    progress: Callable[..., None],
    meanwhile: Sequence[Callable[[], object]] = (),
) -> Any:
    """Run one or several tunings, and do nothing meanwhile.

    search: function of the folder of its state, of `resume` and of `progress`, as `Tuning.run`
    meanwhile: works that may be done while the tuning computes, for what follows it
    """
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
    folder: Path | None = None,
    resume: bool = False,
    run: Callable[..., Any] = run_search,
    progress: Progress = silent,
    **settings: Any,
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
    place = folder or Path("out") / f"tune-{chosen.name}"
    judged: dict[str, Any] = {"trials": compare_trials, "machines": unseen}
    comparison = problem.comparison(**judged)  # raises before the tuning
    progress("compiling", 0, problem.steps)
    tuned = run(
        problem.run,
        unless_there(place / "state", resume),
        resume=resume,
        progress=lambda step, *losses: progress(in_words(*losses), step, problem.steps),
        meanwhile=(comparison.compile,),
    )
    progress("comparing", problem.steps, problem.steps)
    dataset = problem.compare(tuned, **judged)
    numbers = tuning_numbers(chosen, scheme, tuned, dataset)
    for name, of in weights_of(weights).items():
        for weight, row in numbers["weights"].items():
            if of is not None and name in (weight, weight.partition("[")[0]):
                row["range"] = [*map(float, of)]
    result, warnings = tuning_lines(tuned, numbers)
    scale, unit = chosen.shown(chosen.judged_by)
    band = {"metric": chosen.judged_by, "scale": scale, "unit": unit}
    configuration = problem.configuration()
    obtained = {"held_out_loss": numbers["held_out"], "configuration": configuration}
    return Outcome(
        command="tune",
        numbers=numbers,
        verdict=tune_verdict(Case.of(chosen, request), numbers, place / "params.json"),
        folder=place,
        scenario=chosen,
        tables=tuning_tables(chosen, numbers),
        lines=[result],
        warnings=[*warnings, *limits_not_met(problem, tuned, limits)],
        figures={
            "loss": Figure(
                "The loss at each step of the tuning, on the machines tuned on and on others.",
                partial(
                    figures.loss_by_step, tuned, name=f"{risk} of {objective} [ln of error / floor]"
                ),
            ),
            "learning": Figure(
                "The errors by trial over machines that no step has seen, for each law, and their "
                "ratio.",
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


def objective_for(chosen: Scenario, text: str) -> Objective:
    """The objective of a text; a term that names no metric has that which judges the scenario."""
    return objective_of(text, chosen.judged_by, chosen.shown(chosen.judged_by)[0])


def problem_of(
    chosen: Scenario, weights: str, objective: Objective, risk: str, **settings: Any
) -> Tuning:
    """The tuning problem of a scenario with one scheme.

    weights, risk: as texts
    settings: further arguments of `Tuning`, by name
    """
    (scheme,) = chosen.schemes.values()
    return Tuning(
        chosen.machine,
        scheme,
        chosen.task,
        chosen.trials,
        weights=weights_of(weights),
        uncertainty=chosen.uncertainty,
        objective=objective,
        risk=risk_of(risk),
        quantities=chosen.functions,
        **settings,
    )


def in_words(losses: np.ndarray, best: float) -> str:
    """How far a tuning is: the least loss of this step, and the least on the machines held out."""
    return f"loss {losses.min():.4g}, held out {best:.4g}"


def parameter_file(
    command: str, chosen: Scenario, request: Request, tuned: Tuned, **obtained: Any
) -> Callable[[Path], object]:
    """A function that writes the parameters in which a tuned scheme differs from its scenario's.

    command: name of the command that found them
    obtained: further facts on how they were found, as JSON
    """

    def write(path: Path) -> object:
        (scheme,) = chosen.schemes
        printed = load_scenario(request.source, chosen.options).schemes[scheme]
        changed = {scheme: differing(tuned.scheme, printed)}
        how = {"command": f"jaxilc {command}", "options": dict(chosen.options), **obtained}
        return write_parameters(path, chosen.name, changed, how)

    return write


# Numbers, tables and verdict
# --------------------------------------------------------------------------------------------------


def tuning_numbers(
    scenario: Scenario, scheme: str, tuned: Tuned, dataset: xr.Dataset
) -> dict[str, Any]:
    """Weights and held-out losses, and quantiles over the machines of a comparison [shown unit].

    Quantiles are stored by metric, by `given` or `tuned`, and by trial.

    dataset: result of `Tuning.compare`
    """
    trials, machines = dataset.sizes["trial"], dataset.sizes["sample"]
    by_metric = {}
    for metric in dict.fromkeys((scenario.judged_by, "max_error")):
        now = dataclasses.replace(scenario, judged_by=metric, trials=trials)
        summary = summarise(dataset, 1.0, metric=metric)
        of = sweep_numbers(now, summary, 1.0, machines)["schemes"]
        by_metric[metric] = {"unit": scenario.shown(metric)[1]} | {
            which: of[which]["by_trial"] for which in WHICH
        }
    return {
        "scenario": scenario.name,
        "scheme": scheme,
        "trials": trials,
        "samples": machines,
        "weights": {
            name: {"given": tuned.start[name], "tuned": value}
            for name, value in tuned.values.items()
        },
        "held_out": {
            "given": tuned.before,
            "tuned": tuned.after,
            "step": tuned.step,
            "steps": len(tuned.loss),
            "reason": tuned.reason,
        },
        "figures": by_metric,
    }


def tuning_tables(scenario: Scenario, numbers: dict[str, Any]) -> list[Table]:
    """The table of weights, and for each metric a table by trial, as given and as tuned."""
    scheme = numbers["scheme"]
    weights = Table("weight", title=f"{scenario.title}\n{scheme}: weights")
    for column in WHICH:
        weights.add_column(column, justify="right")
    weights.add_column("allowed")
    for name, row in numbers["weights"].items():
        cells = (f"{row[which]:.6g}" for which in WHICH)
        low, high = row.get("range", (None, None))
        allowed = scenario.allowed(f"{scheme}.{name}") if low is None else f"{low:g} to {high:g}"
        weights.add_row(name, *cells, allowed)
    found = [weights]
    for metric, rows in numbers["figures"].items():
        what = f"{metric.replace('_', ' ')} [{rows['unit']}]"
        table = Table(
            title=f"{what} of {numbers['samples']} machines never seen: median (95 %, worst); "
            "ratios are given / tuned"
        )
        for column in ("trial", *WHICH, "ratio of medians", "ratio of worsts"):
            table.add_column(column, justify="right")
        for j in rows["given"]:
            given, tuned = (rows[which][j] for which in WHICH)
            ratios = (_ratio(given[q], tuned[q]) for q in ("median", "worst"))
            table.add_row(j, quantiles(given), quantiles(tuned), *ratios)
        found.append(table)
    return found


def tuning_lines(tuned: Tuned, numbers: dict[str, Any]) -> tuple[str, list[str]]:
    """One line with the held-out loss before and after tuning, and a line for each warning."""
    held = numbers["held_out"]
    result = (
        f"held-out loss {held['given']:.6g} -> {held['tuned']:.6g}, "
        f"step {tuned.step} of {len(tuned.loss)}"
    )
    warnings = [
        f"{name} lay on an end of its range and started from {value:g}"
        for name, value in tuned.nudged.items()
    ]
    if tuned.dropped.any():
        most = int(tuned.dropped.max())
        warnings.append(f"up to {most} machines a step had no finite slope and were left out")
    return result, warnings


def quantiles(row: dict[str, float]) -> str:
    """A text `1.2 (1.5, 1.8)`: the median, and in brackets the 95 % quantile and the worst."""
    return f"{number(row['median'])} ({number(row['high'])}, {number(row['worst'])})"


def _ratio(one: float, other: float) -> str:
    return number(one / other) if other else "–"


def tune_verdict(case: Case, numbers: dict[str, Any], params: Path) -> Verdict:
    """What the tuning gained on machines not seen.

    numbers: result of `tuning_numbers`, whose metric is that of the case
    params: the file of parameters that was written
    """
    metric = case.metric.replace(" ", "_")
    rows, last = numbers["figures"][metric], str(numbers["trials"])
    given, tuned = rows["given"][last], rows["tuned"][last]
    held, scheme = numbers["held_out"], numbers["scheme"]
    if held["step"] == 0:
        said = "No step was better than the weights as given on the machines held out."
        return Verdict((said,), "the worst machine", case.on("worst-case", scheme))
    changed = [
        f"{name} = {number(row['tuned'])} (was {number(row['given'])})"
        for name, row in numbers["weights"].items()
    ]
    more = f" and {len(changed) - FEW} more" if len(changed) > FEW else ""
    median, worst = (
        f"{case.size(tuned[of])} in place of {case.size(given[of])}" for of in ("median", "worst")
    )
    first = (
        f"{', '.join(changed[:FEW])}{more}: of {numbers['samples']} machines not seen, the median "
        f"{case.metric} of trial {last} is {median}, the worst {worst}."
    )
    second = []
    gain = max(1 - tuned[of] / given[of] if given[of] else 0.0 for of in ("median", "worst"))
    if gain < WORTHWHILE:
        second.append(
            f"That is {100 * gain:.2g} % less at best: the weights as given are about as good."
        )
    if tuned["worst"] > given["worst"]:
        second.append("The worst machine has become worse: --risk worst or cvar tunes for it.")
    elif held["reason"] == "steps" and held["step"] == held["steps"]:
        second.append("The last step was the best: more --steps may gain more.")
    of = case.request.without(scheme)
    command = "sweep" if case.uncertain else "run"
    what = "many machines" if case.uncertain else "the whole run"
    following = of.following(command, scheme=scheme, params=params)
    return Verdict((first, *second), what, following)
