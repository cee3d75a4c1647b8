"""The command line for design under a budget: `jaxilc pareto`."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from .options import (
    TERMS,
    Bounds,
    HeldOut,
    Json,
    OneScheme,
    Optimiser,
    OverMachines,
    Params,
    Precision,
    Rate,
    Report,
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
    begin,
    chosen_scenario,
    out,
    progress_bar,
    stopped,
    written,
)
from .terms import numbers_of
from .tune import asked_for, problem_of


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command()(pareto)


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
    samples: TunedOn = 32,
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
    out_dir: Annotated[
        Path | None,
        typer.Option("--out", help="Folder for all results; out/pareto-SCENARIO if not given."),
    ] = None,
    resume: Annotated[
        bool,
        typer.Option("--resume", help="Go on with its tunings; shares and budgets may be added."),
    ] = False,
    json_file: Json = None,
    report: Report = None,
    precision: Precision = "float64",
) -> None:
    """Design under a budget: two objectives against each other (--second), or the first against the
    number of trials (--budgets).

    Each point of either is a tuning by itself, from the weights as given, and leaves a parameter
    file.

    Example: jaxilc pareto li-2020 --scheme fixed-filter --weights learning.filter.cutoff --bounds
    learning.filter.cutoff=2:200
    --second effort --trials 15 --steps 20
    """
    begin(precision)
    from ..figures.report import command_report
    from ..tuning.trade_off import SHARES

    if (second is None) == (budgets is None):
        raise ValueError(
            f"--second {second} and --budgets {budgets}: one of the two is needed, and not both"
        )
    for name, value, other in (("shares", shares, budgets), ("trials", trials, budgets)):
        if value is not None and other is not None:
            raise ValueError(f"--{name} {value} has no meaning beside --budgets {other}")
    if unseen < 1:
        raise ValueError(f"--unseen {unseen} is outside its allowed range [1, inf)")
    allotted = (
        None if budgets is None else [int(J) for J in numbers_of("--budgets", budgets, whole=True)]
    )
    trials = max(allotted) if allotted else trials
    chosen = chosen_scenario(scenario, [scheme], trials, set_, params)
    options = {
        "steps": steps,
        "starts": starts,
        "rate": rate,
        "optimiser": optimiser,
        "machines": samples,
        "held_out": held_out,
    }
    options |= {"sampling": sampling, "seed": seed}
    problem = problem_of(
        chosen,
        scheme,
        weights,
        bounds,
        spread,
        asked_for(chosen, first, "--first"),
        risk,
        **options,
    )
    folder = out_dir or Path("out") / f"pareto-{chosen.name}"
    state = folder / "state"
    if state.exists() and not resume:
        raise FileExistsError(
            f"{state} exists already; add --resume to go on with it, or choose another --out"
        )
    asked = (chosen, scenario, scheme, problem)
    if allotted:
        numbers, table, paths = _by_trials(*asked, allotted, unseen, folder, resume)
    else:
        swept = SHARES if shares is None else numbers_of("--shares", shares)
        numbers, table, paths = _front(
            *asked, asked_for(chosen, str(second), "--second"), swept, folder, resume
        )
    out.print(table)
    lines = [
        f"share {share} is left out: another point is no worse in either objective"
        for share in numbers.get("left_out", [])
    ]
    for line in lines:
        out.print(line, highlight=False)
    numbers = {
        "scenario": chosen.name,
        "scheme": scheme,
        "first": first,
        "second": second,
    } | numbers
    page = command_report(
        report,
        "pareto",
        [table],
        paths,
        scenario=chosen,
        configuration=problem.configuration(),
        lines=lines,
    )
    written([*paths, *page], json_file, numbers)


def _front(chosen, scenario: str, scheme: str, problem, second, shares, folder: Path, resume: bool):
    """Numbers, table and files of a front of two objectives."""
    from .. import figures
    from ..tuning.trade_off import held_out_losses, pareto
    from .titled_table import Table

    first = problem.objective
    points = _with_progress(
        partial(pareto, problem, first, second, shares),
        len(shares),
        problem.steps,
        folder / "state",
        resume,
    )
    given = held_out_losses(problem, first, second)(problem.start).tolist()
    rows = {"given": {"first": given[0], "second": given[1], "weights": problem.start}}
    rows |= {
        str(p.share): {"first": p.first, "second": p.second, "weights": p.tuned.values}
        for p in points
    }
    table = Table(
        "share of first",
        title=f"{chosen.title}\n{scheme}, {chosen.trials} trials: objectives on held-out machines",
    )
    for column in ("first", "second", *problem.start):
        table.add_column(column, justify="right")
    for name, row in rows.items():
        table.add_row(
            name, *(f"{x:.6g}" for x in (row["first"], row["second"], *row["weights"].values()))
        )
    names: dict[str, Any] = {
        "first": "first objective, held out",
        "second": "second objective, held out",
    }
    paths = [
        figures.save(
            figures.pareto_front(points, **names, given=tuple(given)), folder / "front.png"
        )
    ]
    for p in points:
        file = folder / f"params-share-{p.share}.json"
        paths.append(_parameters(chosen, scenario, scheme, p.tuned, file, rows[str(p.share)]))
    left = sorted(set(shares) - {p.share for p in points})
    return {"trials": chosen.trials, "points": rows, "left_out": left}, table, paths


def _by_trials(
    chosen,
    scenario: str,
    scheme: str,
    problem,
    budgets: list[int],
    unseen: int,
    folder: Path,
    resume: bool,
):
    """Numbers, table and files of one tuning for each number of trials, all judged on the same
    unseen machines.
    """
    from .. import figures
    from ..sweeps.summary import summarise
    from ..tuning.trade_off import by_trials
    from .tables import number
    from .titled_table import Table

    problem.comparison(
        dict.fromkeys(("given", *map(str, budgets)), problem.scheme),
        trials=max(budgets),
        machines=unseen,
    )  # refused now
    found = _with_progress(
        partial(by_trials, problem, budgets), len(budgets), problem.steps, folder / "state", resume
    )
    schemes = {"given": problem.scheme} | {str(J): tuned.scheme for J, tuned in found.items()}
    dataset = problem.comparison(schemes, trials=max(budgets), machines=unseen).run()
    figure, (scale, unit) = chosen.judged_by, chosen.shown(chosen.judged_by)
    summary = {row.scheme: row for row in summarise(dataset, 1.0, metric=figure)}

    def at(name: str, J: int) -> dict[str, float]:
        return {
            of: scale * float(getattr(summary[name], of)[J - 1])
            for of in ("median", "high", "worst")
        }

    rows, which = {}, ("given", "tuned")
    for J, tuned in found.items():
        rows[str(J)] = {"given": at("given", J), "tuned": at(str(J), J), "weights": tuned.values}
        rows[str(J)]["held_out"] = {"given": tuned.before, "tuned": tuned.after}
    what = f"{figure.replace('_', ' ')} [{unit}] of trial J on {unseen} machines never seen: median (95 %, worst)"
    table = Table(title=f"{chosen.title}\n{scheme}, tuned for J trials: {what}")
    for column in ("J", *which, *problem.start):
        table.add_column(column, justify="right")
    for J, row in rows.items():
        cells = (
            f"{number(row[of]['median'])} ({number(row[of]['high'])}, {number(row[of]['worst'])})"
            for of in which
        )
        table.add_row(J, *cells, *(f"{value:.6g}" for value in row["weights"].values()))
    errors: dict[str, Any] = {
        of: [[row[of]["median"], row[of]["worst"]] for row in rows.values()] for of in which
    }
    paths = [
        figures.save(
            figures.final_error_by_trials(budgets, **errors, figure=figure, unit=unit),
            folder / "trials.png",
        )
    ]
    for J, tuned in found.items():
        paths.append(
            _parameters(
                chosen, scenario, scheme, tuned, folder / f"params-{J}-trials.json", rows[str(J)]
            )
        )
    return {"figure": figure, "unit": unit, "samples": unseen, "budgets": rows}, table, paths


def _parameters(chosen, scenario: str, scheme: str, tuned, path: Path, row: dict) -> Path:
    """The parameter file of one point."""
    from ..scenarios.from_file import load_scenario
    from ..scenarios.parameters import differing, write_parameters

    changed = differing(tuned.scheme, load_scenario(scenario, chosen.options).schemes[scheme])
    obtained = {"command": "jaxilc pareto", "options": dict(chosen.options), "point": row}
    return write_parameters(path, chosen.name, {scheme: changed}, obtained)


def _with_progress(tunings, count: int, steps: int, state: Path, resume: bool):
    """The tunings behind one progress bar (on a terminal)."""
    with progress_bar("loss") as bar:
        bars: dict = {}

        def progress(name: str, step: int, losses, best: float) -> None:
            if name not in bars:
                bars[name] = bar.add_task(
                    f"{name} ({len(bars) + 1} of {count})", total=steps, loss=""
                )
            bar.update(
                bars[name], completed=step, loss=f"loss {losses.min():.4g}, held out {best:.4g}"
            )

        try:
            return tunings(state, resume=resume, progress=progress)
        except KeyboardInterrupt:
            stopped(state)
