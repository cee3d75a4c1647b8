"""`jaxilc pareto`: a front of two objectives, or the best result for each number of trials."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from .options import (
    DESIGN,
    TERMS,
    Bounds,
    FigureFormat,
    HeldOut,
    Json,
    OneScheme,
    Optimiser,
    OutFolder,
    OverMachines,
    Params,
    Precision,
    Rate,
    Report,
    Resume,
    Sampling,
    ScenarioName,
    Seed,
    Set,
    Spread,
    Starts,
    Steps,
    Trials,
    TunedOn,
    Unseen,
    Weights,
    at_least,
)
from .results import parameter_file, show, unless_there, written
from .terms import numbers_of
from .verdicts.next_command import Asked, Verdict

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ..scenarios import Scenario
    from ..tuning import Tuning
    from ..tuning.objectives import Objective
    from .titled_table import Table


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command(rich_help_panel=DESIGN)(pareto)


def pareto(
    scenario: ScenarioName,
    scheme: OneScheme,
    weights: Weights,
    first: Annotated[str, typer.Option(help=f"Objective. {TERMS}")] = "final",
    second: Annotated[
        str | None, typer.Option(help="Objective that competes with it, written alike.")
    ] = None,
    shares: Annotated[
        str | None,
        typer.Option(
            metavar="A,B,C", help="Of the first objective; 0.1,0.3,0.5,0.7,0.9 if not given."
        ),
    ] = None,
    budgets: Annotated[
        str | None,
        typer.Option(metavar="J,K,L", help="In place of --second: numbers of trials to tune for."),
    ] = None,
    bounds: Bounds = None,
    risk: OverMachines = "mean",
    trials: Trials = None,
    machines: TunedOn = 32,
    held_out: HeldOut = 32,
    unseen: Unseen = 257,
    steps: Steps = 100,
    starts: Starts = 1,
    rate: Rate = 0.1,
    optimiser: Optimiser = "adam",
    spread: Spread = None,
    sampling: Sampling = "sobol",
    seed: Seed = 0,
    set_: Set = None,
    params: Params = None,
    out_dir: OutFolder = None,
    resume: Resume = False,
    json_file: Json = None,
    report: Report = None,
    figures: FigureFormat = None,
    precision: Precision = "float64",
) -> None:
    """Two objectives against each other, or the first against the number of trials.

    Give --second for the former, --budgets for the latter. Each point is a
    tuning by itself, from the weights as given, and leaves a parameter file.
    With --resume, shares and budgets may be added.

    Example: jaxilc pareto li-2020 --scheme fixed-filter
    --weights learning.filter.cutoff --bounds learning.filter.cutoff=2:200
    --second effort --trials 15 --steps 20
    """
    from .asked import begin, chosen_scenario, expanded, objective_asked, tuning_problem

    begin(precision)
    from ..tuning.trade_off import SHARES

    _need_one_kind(second, budgets, shares=shares, trials=trials)
    at_least(1, unseen=unseen)
    asked_for = [] if budgets is None else numbers_of("--budgets", budgets, whole=True)
    allotted = [int(J) for J in asked_for]
    trials, set_, params = expanded(scenario, [scheme], trials, set_, params)
    chosen = chosen_scenario(scenario, [scheme], max(allotted, default=trials), set_, params)
    problem = tuning_problem(
        chosen,
        scheme,
        weights=weights,
        bounds=bounds,
        spread=spread,
        objective=objective_asked(chosen, first, "--first"),
        risk=risk,
        options={
            "steps": steps,
            "starts": starts,
            "rate": rate,
            "optimiser": optimiser,
            "machines": machines,
            "held_out": held_out,
            "sampling": sampling,
            "seed": seed,
        },
    )
    folder = out_dir or Path("out") / f"pareto-{chosen.name}"
    unless_there(folder / "state", resume)
    asked = Asked(scenario, (scheme,), tuple(set_ or ()), params, trials, spread)
    of = _Of(chosen, asked, scheme, problem, folder, resume)
    if allotted:
        found = _by_trials(of, allotted, unseen)
    else:
        swept = SHARES if shares is None else numbers_of("--shares", shares)
        other = objective_asked(chosen, str(second), "--second")
        found = _front(of, other, swept, (first, str(second)))
    _finish(of, found, {"first": first, "second": second}, json_file, report)


def _finish(
    of: _Of,
    found: _Found,
    options: dict[str, str | None],
    json_file: Path | None,
    report: Path | None,
) -> None:
    """Print the table and the verdict of a trade-off, and write its files.

    options: texts of the objectives, by option
    """
    from ..figures.report import command_report
    from .live import of_trade_off, unexplored

    lines = [
        f"share {share} is left out: another point is no worse in either objective"
        for share in found.numbers.get("left_out", [])
    ]
    show([found.table], lines)
    page = command_report(
        report,
        "pareto",
        [found.table],
        unexplored(found.paths),
        scenario=of.chosen,
        configuration=of.problem.configuration(),
        lines=lines,
        verdict=found.verdict,
        live=of_trade_off(report, found.numbers, found.names),
    )
    numbers = {"scenario": of.chosen.name, "scheme": of.scheme} | options | found.numbers
    written([*found.paths, *page], json_file, numbers, found.verdict)


def _need_one_kind(second: str | None, budgets: str | None, **of_a_front: object) -> None:
    """Raises ValueError unless one of --second and --budgets is given, with its options only."""
    if (second is None) == (budgets is None):
        raise ValueError(
            f"--second {second} and --budgets {budgets}: one of the two is needed, and not both"
        )
    for name, value in of_a_front.items():
        if value is not None and budgets is not None:
            raise ValueError(f"--{name} {value} has no meaning beside --budgets {budgets}")


class _Of(NamedTuple):
    """The arguments that both kinds of trade-off share.

    asked: options of the command
    folder: folder for results
    resume: whether to continue from the stored states
    """

    chosen: Scenario
    asked: Asked
    scheme: str
    problem: Tuning
    folder: Path
    resume: bool

    def parameters(self, name: str, tuned, point: dict) -> Path:
        """Write the parameter file of one point of the trade-off."""
        return parameter_file(
            self.folder / name,
            self.chosen,
            command="jaxilc pareto",
            source=self.asked.source,
            scheme=self.scheme,
            tuned=tuned,
            point=point,
        )


class _Found(NamedTuple):
    """The result of a trade-off; `names` are the two objectives, none for numbers of trials."""

    numbers: dict[str, Any]
    table: Table
    paths: list[Path]
    verdict: Verdict
    names: tuple[str, ...] = ()


def _front(of: _Of, second: Objective, shares: Sequence[float], names: tuple[str, str]) -> _Found:
    """The front of two objectives; the first one is that of the problem.

    names: texts of the objectives
    """
    from .. import figures
    from ..tuning.trade_off import held_out_losses, pareto
    from .progress import run_tunings
    from .tuning_numbers import front_numbers
    from .tuning_tables import front_table
    from .verdicts.case import Case
    from .verdicts.tuning import front_verdict

    problem, first = of.problem, of.problem.objective
    points = run_tunings(
        partial(pareto, problem, first, second, shares),
        of.folder / "state",
        count=len(shares),
        steps=problem.steps,
        resume=of.resume,
    )
    given = held_out_losses(problem, first, second)(problem.start).tolist()
    numbers = front_numbers(problem, points, given, shares)
    one, other = (f"{name}, on held-out machines" for name in names)
    axes = figures.pareto_front(points, first=one, second=other, given=tuple(given))
    paths = [figures.save(axes, of.folder / "front.png")]
    for p in points:
        row = numbers["points"][str(p.share)]
        paths.append(of.parameters(f"params-share-{p.share}.json", p.tuned, row))
    verdict = front_verdict(Case.of(of.chosen, of.asked), of.scheme, numbers, of.folder, names)
    return _Found(numbers, front_table(of.chosen, of.scheme, numbers), paths, verdict, names)


def _by_trials(of: _Of, budgets: list[int], unseen: int) -> _Found:
    """One tuning for each number of trials, all judged on the same machines, unused in tuning."""
    from .. import figures
    from ..tuning.trade_off import by_trials
    from .progress import run_tunings
    from .tuning_numbers import WHICH, budget_numbers
    from .tuning_tables import budget_table
    from .verdicts.case import Case
    from .verdicts.tuning import budget_verdict

    problem, longest = of.problem, max(budgets)
    same = dict.fromkeys(("given", *map(str, budgets)), problem.scheme)
    problem.comparison(same, trials=longest, machines=unseen)  # raises before the tuning
    found = run_tunings(
        partial(by_trials, problem, budgets),
        of.folder / "state",
        count=len(budgets),
        steps=problem.steps,
        resume=of.resume,
    )
    schemes = {"given": problem.scheme} | {str(J): tuned.scheme for J, tuned in found.items()}
    dataset = problem.comparison(schemes, trials=longest, machines=unseen).run()
    numbers = budget_numbers(of.chosen, found, dataset)
    rows = numbers["budgets"]
    errors = {w: [[row[w]["median"], row[w]["worst"]] for row in rows.values()] for w in WHICH}
    axes = figures.final_error_by_trials(
        budgets, errors["given"], errors["tuned"], metric=numbers["figure"], unit=numbers["unit"]
    )
    paths = [figures.save(axes, of.folder / "trials.png")]
    for J, tuned in found.items():
        paths.append(of.parameters(f"params-{J}-trials.json", tuned, rows[str(J)]))
    verdict = budget_verdict(Case.of(of.chosen, of.asked), of.scheme, numbers, of.folder)
    return _Found(numbers, budget_table(of.chosen, of.scheme, numbers), paths, verdict)
