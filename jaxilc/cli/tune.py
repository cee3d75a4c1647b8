"""The command line for tuning: `jaxilc tune` and `jaxilc worst-case`."""

from __future__ import annotations

import dataclasses
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
    err,
    folder_of,
    folder_to_write,
    out,
    progress_bar,
    spread_of,
    stopped,
    written,
)
from .terms import objective_of, risk_of, weights_of


def register(app: typer.Typer) -> None:
    """Add the commands to the command line."""
    app.command()(tune)
    app.command()(worst_case)


def tune(
    scenario: ScenarioName,
    scheme: OneScheme,
    weights: Weights,
    bounds: Bounds = None,
    objective: Annotated[str, typer.Option(help=TERMS)] = "final",
    risk: OverMachines = "mean",
    trials: Trials = None,
    samples: TunedOn = 32,
    held_out: HeldOut = 32,
    unseen: Unseen = 257,
    compare_trials: Annotated[
        int | None, typer.Option(help="Trials of the comparison; those of the tuning if not given.")
    ] = None,
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
        typer.Option(
            "--out",
            help="Folder for all results; out/tune-SCENARIO if not given.",
            callback=folder_to_write,
        ),
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with the tuning in the folder.")
    ] = False,
    json_file: Json = None,
    report: Report = None,
    precision: Precision = "float64",
) -> None:
    """Weights by gradient through the learning, over many machines; given against tuned on machines
    never seen.

    Example: jaxilc tune cao-2019 --scheme cfdl-mfailc --weights lam,eta,mu,phi0 --set
    cfdl-mfailc.lead=3 --objective holding:20
    """
    begin(precision)
    from .. import figures
    from ..figures.report import command_report
    from ..scenarios.from_file import load_scenario
    from ..scenarios.parameters import differing, write_parameters
    from . import tuning_tables

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
        chosen, scheme, weights, bounds, spread, asked_for(chosen, objective), risk, **options
    )
    for name, value in (("unseen", unseen), ("compare-trials", compare_trials)):
        if value is not None and value < 1:
            raise ValueError(f"--{name} {value} is outside its allowed range [1, inf)")
    folder = out_dir or Path("out") / f"tune-{chosen.name}"
    problem.comparison(
        trials=compare_trials, machines=unseen
    )  # refused now rather than after the tuning
    state = folder / "state"
    if state.exists() and not resume:
        raise FileExistsError(
            f"{state} exists already; add --resume to go on with it, or choose another --out"
        )
    tuned = _with_progress(problem, state, resume)
    dataset = problem.compare(tuned, trials=compare_trials, machines=unseen)

    numbers = tuning_tables.tuning_figures(chosen, scheme, tuned, dataset)
    shown = tuning_tables.tuning_tables(chosen, numbers)
    for table in shown:
        out.print(table)
    held = numbers["held_out"]
    result = f"held-out loss {held['given']:.6g} -> {held['tuned']:.6g}, step {tuned.step} of {len(tuned.loss)}"
    out.print(result, highlight=False)
    warnings = [
        f"{name} lay on an end of its range and started from {value:g}"
        for name, value in tuned.nudged.items()
    ]
    if tuned.dropped.any():
        warnings.append(
            f"up to {int(tuned.dropped.max())} machines a step had no finite slope and were left out"
        )
    for line in warnings:
        err.print(line, highlight=False)
    changed = differing(tuned.scheme, load_scenario(scenario, chosen.options).schemes[scheme])
    obtained = {
        "command": "jaxilc tune",
        "options": dict(chosen.options),
        "held_out_loss": held,
        "configuration": problem.configuration(),
    }
    paths = [write_parameters(folder / "params.json", chosen.name, {scheme: changed}, obtained)]
    paths.append(figures.save(figures.loss_by_step(tuned), folder / "loss.png"))
    scale, unit = chosen.shown(chosen.judged_by)
    axes = figures.error_band(dataset, figure=chosen.judged_by, scale=scale, unit=unit)
    paths.append(figures.save(axes, folder / "learning.png"))
    given = {"weights": weights, "objective": objective, "risk": risk}
    lines = [result, *warnings]
    page = command_report(
        report,
        "tune",
        shown,
        paths,
        scenario=chosen,
        configuration=problem.configuration(),
        lines=lines,
        asked=given,
    )
    written([*paths, *page], json_file, numbers)


def worst_case(
    scenario: ScenarioName,
    scheme: OneScheme,
    trial: Annotated[
        int | None,
        typer.Option(help="Trial whose figure is to be large; the scenario's last if not given."),
    ] = None,
    starts: Annotated[int, typer.Option(help="Places to climb from.")] = 16,
    steps: Annotated[int, typer.Option(help="Steps of each climb.")] = 30,
    evaluations: Annotated[
        int | None,
        typer.Option(help="Learning processes to spend on either search, in place of --steps."),
    ] = None,
    draws: Annotated[int | None, typer.Option(help="A larger search by chance besides.")] = None,
    spread: Spread = None,
    seed: Seed = 0,
    set_: Set = None,
    params: Params = None,
    out_dir: Annotated[
        Path | None,
        typer.Option(
            "--out",
            help="Folder for all results; out/worst-case-SCENARIO if not given.",
            callback=folder_to_write,
        ),
    ] = None,
    json_file: Json = None,
    report: Report = None,
    precision: Precision = "float64",
) -> None:
    """The worst machine of the uncertain set, by climbing the gradient of its error, against as
    many machines drawn by chance.

    A gradient counts as three evaluations on top of the one that it belongs to.

    Example: jaxilc worst-case cao-2019 --scheme cfdl-mfailc --trial 40 --draws 10000
    """
    begin(precision)
    from .. import figures
    from ..figures.report import command_report
    from ..tuning.worst_case import GRADIENT_COST, monte_carlo_search, worst_case_search
    from . import tuning_tables

    at_least_one = (
        ("trial", trial, 1),
        ("starts", starts, 1),
        ("steps", steps, 1),
        ("draws", draws, 1),
    )
    for name, value, low in (
        *at_least_one,
        ("evaluations", evaluations, starts * (1 + GRADIENT_COST)),
    ):
        if value is not None and value < low:
            raise ValueError(f"--{name} {value} is outside its allowed range [{low}, inf)")
    chosen = chosen_scenario(scenario, [scheme], trial, set_, params)
    uncertainty = spread_of(chosen, spread)
    loss, shown, figure_of = _judged(chosen, scheme)
    steps = steps if evaluations is None else evaluations // (starts * (1 + GRADIENT_COST))
    _need_room(chosen, uncertainty, starts, steps, evaluations, draws)
    climbed = worst_case_search(
        loss, chosen.machine, uncertainty, starts=starts, steps=steps, seed=seed
    )
    found = {
        "gradient": climbed,
        "chance": monte_carlo_search(
            loss, chosen.machine, uncertainty, climbed.evaluations, seed=seed
        ),
    }
    if draws is not None:
        found["more chance"] = monte_carlo_search(
            loss, chosen.machine, uncertainty, draws, seed=seed
        )

    unit = chosen.shown(chosen.judged_by)[1]
    numbers: dict[str, Any] = {
        "scenario": scenario,
        "scheme": scheme,
        "trial": chosen.trials,
        "figure": chosen.judged_by,
        "unit": unit,
    }
    numbers |= {
        "seed": seed,
        "params": None if params is None else str(params),
        "given": list(set_ or []),
    }
    numbers |= {"nominal": figure_of(chosen.machine), "searches": {}}
    for name, case in found.items():
        each = (
            starts * (1 + GRADIENT_COST) if case is climbed else 1
        )  # evaluations between two looks at `best`
        level = (
            each * (1 + int((case.best >= found["chance"].loss).argmax()))
            if case.loss >= found["chance"].loss
            else None
        )
        row = {"value": figure_of(case.subject), "loss": case.loss, "evaluations": case.evaluations}
        row |= {"needed": each * (1 + int(case.best.argmax())), "level_with_chance": level}
        numbers["searches"][name] = row | {
            "numbers": case.values,
            "set": _settings(case.subject, uncertainty),
        }
    shown_tables = tuning_tables.worst_case_tables(chosen, numbers)
    for table in shown_tables:
        out.print(table)
    folder = folder_of(out_dir, f"worst-case-{chosen.name}")
    largest = found.get("more chance", found["chance"])
    worst = {name: row["value"] for name, row in numbers["searches"].items()}
    axes = figures.worst_against_chance(
        shown(largest.found), worst, nominal=numbers["nominal"], figure=chosen.judged_by, unit=unit
    )
    path = figures.save(axes, folder / "worst-case.png")
    wide = dataclasses.replace(chosen, uncertainty=uncertainty)
    given = {"starts": starts, "steps": steps, "seed": seed}
    page = command_report(report, "worst-case", shown_tables, [path], scenario=wide, asked=given)
    written([path, *page], folder / "worst-case.json", numbers)
    if json_file is not None:
        written([], json_file, numbers)


def asked_for(chosen, text: str, option: str = "--objective"):
    """The objective of this text, by the figure that the scenario is judged by where it names none."""
    return objective_of(text, chosen.judged_by, chosen.shown(chosen.judged_by)[0], option)


def problem_of(
    chosen,
    scheme: str,
    weights: str,
    bounds: list[str] | None,
    spread: float | None,
    objective,
    risk: str,
    **options,
):
    """The tuning problem as asked for. options: those of `Tuning`, by name"""
    from ..tuning.problem import Tuning

    asked = (weights_of(weights, bounds), spread_of(chosen, spread), objective, risk_of(risk))
    return Tuning(
        chosen.machine,
        chosen.schemes[scheme],
        chosen.task,
        chosen.trials,
        *asked,
        quantities=chosen.functions,
        **options,
    )


def _with_progress(problem, state: Path, resume: bool):
    """Tune behind a progress bar (on a terminal)."""
    with progress_bar("loss") as bar:
        one = bar.add_task("tuning", total=problem.steps, loss="")

        def progress(step: int, losses, best: float) -> None:
            bar.update(one, completed=step, loss=f"loss {losses.min():.4g}, held out {best:.4g}")

        try:
            return problem.run(state, resume=resume, progress=progress)
        except KeyboardInterrupt:
            stopped(state)


def _need_room(
    chosen, uncertainty, starts: int, steps: int, evaluations: int | None, draws: int | None
) -> None:
    """Raises ValueError, before the climb, for a trial or a search by chance after it that does not
    fit into memory.
    """
    from ..learning.known_metrics import bytes_of_metrics
    from ..runtime.capacity import check_size
    from ..tuning.worst_case import GRADIENT_COST, bytes_of_a_draw

    of_trial, each = bytes_of_metrics(chosen.task), bytes_of_a_draw(uncertainty)
    check_size(
        "worst-case",
        lambda trial, starts: 4 * of_trial * trial * starts,
        trial=chosen.trials,
        starts=starts,
    )
    if evaluations is None:
        cost = each * (1 + GRADIENT_COST)
        check_size(
            "worst-case", lambda starts, steps: cost * starts * steps, starts=starts, steps=steps
        )
    for name, count in (("evaluations", evaluations), ("draws", draws)):
        if count is not None:
            check_size("worst-case", lambda **counts: each * sum(counts.values()), **{name: count})


def _judged(chosen, scheme: str):
    """The loss of a machine, that loss as the figure that is shown, and the figure of a machine
    itself.
    """
    import jax.numpy as jnp
    import numpy as np

    from ..learning.divergence import peak
    from ..learning.metrics import Keep
    from ..learning.over_trials import learn
    from ..tuning.objectives import Final, judge

    figure, keep, law = chosen.judged_by, Keep.of(chosen.functions), chosen.schemes[scheme]
    scale, objective = chosen.shown(figure)[0], Final(figure)

    def loss(machine):
        return judge(machine, law, chosen.task, chosen.trials, objective, save=keep)

    def shown(losses):
        """The inverse of the logarithm that `objectives` takes; of several outputs the largest peak
        counts.
        """
        unit = scale * float(jnp.max(peak(chosen.task))) * objective.floor
        return unit * np.sqrt(np.maximum(np.exp(2.0 * losses) - 1.0, 0.0))

    def figure_of(machine) -> float:
        history = learn(machine, law, chosen.task, chosen.trials, save=keep)
        values = history.saved[figure] if figure in history.saved else getattr(history, figure)
        return scale * float(jnp.max(values[-1])) if not history.diverged[-1] else float("inf")

    return loss, shown, figure_of


def _settings(machine, uncertainty) -> list[str]:
    """The leaves that were drawn, element by element, as --set takes them."""
    import numpy as np

    from ..pytree.named_paths import get_at

    found = []
    for name in uncertainty:
        value = np.asarray(get_at(machine, name))
        for index in np.ndindex(value.shape):
            found.append(
                f"machine.{name}{''.join(f'[{i}]' for i in index)}={float(value[index])!r}"
            )
    return found
