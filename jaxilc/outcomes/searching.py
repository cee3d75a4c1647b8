"""`worst_case`: the machine within the uncertainty with the largest final error."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from pathlib import Path

import numpy as np

from .. import figures
from ..figures.searches import worst_by_effort
from ..figures.style import labelled
from ..pytree.named_paths import get_at
from ..scenarios import Scenario
from ..storage.sealed import write_json
from ..tuning.worst_case import GRADIENT_COST, worst_machine
from ..uncertainty import Uncertainty
from .case import Case, said
from .outcome import Figure, Numbers, Outcome, Progress, Table, Verdict, silent
from .request import Request
from .words import number, several

FEW = 6  # settings of the worst machine that the next command repeats
ALIKE = 1e-3  # of the loss, or of the error: two machines that differ by less are as bad


def worst_case(
    request: Request | str,
    *,
    starts: int = 16,
    steps: int = 30,
    evaluations: int | None = None,
    draws: int | None = None,
    seed: int = 0,
    folder: Path | None = None,
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
            "loss": search.case.loss,
            "evaluations": search.case.evaluations,
            "needed": search.needed,
            "level_with_chance": search.level_with_chance,
            "numbers": search.case.values,
            "set": _settings(search.case.subject, chosen.uncertainty),
        }
        for name, search in found.searches.items()
    }
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
        "searches": searches,
    }
    verdict = worst_case_verdict(Case.of(chosen, request), scheme, numbers)
    shown = {"metric": chosen.judged_by, "unit": unit}
    marked = {name: one.value for name, one in found.searches.items()}
    figure = Figure(
        "The share of drawn machines that err no more than so much, and the errors of the machines "
        "that were searched for.",
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
        folder=folder or Path("out") / f"worst-case-{chosen.name}",
        scenario=chosen,
        tables=worst_case_tables(chosen, numbers),
        figures={"worst-case": figure},
        files={"worst-case.json": partial(write_json, value=numbers | verdict.as_json())},
        live=lambda: [figure.described(), worst_by_effort.described(found.searches, **shown)],
        asked={"starts": starts, "steps": steps, "seed": seed},
    )


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
    loss = max(row["loss"] for row in searches.values())
    near = [
        name
        for name, row in searches.items()
        if row["loss"] == loss or loss - row["loss"] <= ALIKE * abs(loss)
    ]
    return min(near, key=lambda name: searches[name]["needed"])


def worst_case_verdict(case: Case, scheme: str, numbers: Numbers) -> Verdict:
    """How much larger the error of the worst machine is, if it is, and which search found it."""
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
    )
    needed = several(worst["needed"], "simulation")
    first = f"{scheme}: the worst machine {ends}; found by {name}, in {needed}."
    alike = math.isfinite(nominal) and worst["value"] <= (1 + ALIKE) * nominal
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
    return Verdict(said(first, case.beside_tolerance(worst["value"])), what, following)
