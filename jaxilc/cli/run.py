"""`jaxilc list` shows the scenarios and their settings, `jaxilc run` learns on one machine."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..scenarios.catalogue import LISTED
from .completion import scenarios_from
from .console import out
from .options import (
    SIMULATE,
    FigureFormat,
    Json,
    MetricName,
    OutFolder,
    Params,
    Precision,
    Replace,
    Report,
    ScenarioName,
    Schemes,
    Seed,
    Set,
    Trials,
)
from .results import folder_of, show, tell, written
from .titled_table import Table
from .verdicts.next_command import Asked, Verdict

if TYPE_CHECKING:
    from ..scenarios import Scenario


def register(app: typer.Typer) -> None:
    """Add the commands to the command line."""
    app.command("list", rich_help_panel=SIMULATE)(list_)
    app.command(rich_help_panel=SIMULATE)(run)


def list_(
    scenario: Annotated[
        str | None,
        typer.Argument(
            metavar="[SCENARIO]", help="Show all that can be set.", autocompletion=scenarios_from
        ),
    ] = None,
) -> None:
    """List the scenarios, or all that can be set in one.

    Example: jaxilc list cao-2019
    """
    if scenario is None:
        table = Table("scenario", "title", "schemes", "trials", "samples N")
        for name, (title, schemes, trials, samples) in LISTED.items():
            table.add_row(name, title, ", ".join(schemes), str(trials), str(samples))
        said = (
            f"{len(LISTED)} scenarios of papers and other software; a plant file has your machine."
        )
        show([table])
        tell(Verdict((said,), "a plant file", "jaxilc init axis.toml"))
        return
    from ..scenarios.from_file import load_scenario
    from . import tables
    from .asked import begin
    from .verdicts.case import Case
    from .verdicts.simulation import list_verdict

    begin("float64")
    chosen = load_scenario(scenario)
    verdict = list_verdict(Case.of(chosen, Asked(scenario)), chosen.settable(), [*chosen.options])
    show([tables.settable_table(chosen)])
    tell(verdict)


def run(
    scenario: ScenarioName,
    scheme: Schemes = None,
    trials: Trials = None,
    metric: MetricName = None,
    seed: Seed = 0,
    set_: Set = None,
    params: Params = None,
    out_dir: OutFolder = None,
    json_file: Json = None,
    report: Report = None,
    replace: Replace = False,
    figures: FigureFormat = None,
    precision: Precision = "float64",
) -> None:
    """Learn on the nominal machine: errors beside the published ones, figures, dataset.

    Example: jaxilc run cao-2019 --scheme ffdl-mfailc --set ffdl-mfailc.lam=0.5
    """
    from .progress import working

    with working("run") as told:
        from .asked import begin, chosen_scenario, settings_of

        begin(precision)
        import jax

        from ..scenarios.judging import judged
        from ..sweeps import runs

        chosen = judged(chosen_scenario(scenario, scheme, trials, set_, params), metric)
        made_with = runs.configuration(chosen, seed)
        folder = _folder(out_dir, chosen.name, made_with, replace=replace)
        dataset, _ = runs.run_schemes(
            chosen.machine,
            chosen.schemes,
            chosen.task,
            chosen.trials,
            key=jax.random.key(seed),
            quantities=chosen.functions,
            progress=lambda done, name: told(name, done, len(chosen.schemes)),
        )
    from ..figures.report import command_report
    from ..figures.whole_run import save_run
    from ..storage.files import whole_folder
    from . import live, numbers
    from .verdicts.case import Case
    from .verdicts.simulation import run_verdict

    found = numbers.run_numbers(chosen, dataset)
    changed = bool(params) or not settings_of(set_).keys() <= chosen.options.keys()
    shown, lines = _shown(chosen, found, changed=changed)
    show(shown, lines)
    for note in chosen.chosen:
        out.print(f"chosen: {note}", style="dim", highlight=False)
    asked = Asked(scenario, tuple(scheme or ()), tuple(set_ or ()), params, trials, metric=metric)
    verdict = run_verdict(Case.of(chosen, asked), found, numbers.errors_by_trial(chosen, dataset))

    folder_of(folder, "")
    with working("figures") as told:
        shown_trials = numbers.shown_trials(chosen)
        paths = save_run(chosen, dataset, folder, shown_trials, progress=told)
    dataset.attrs["configuration"] = json.dumps(made_with)
    with whole_folder(folder / "dataset.zarr", replace=True) as store:
        dataset.to_zarr(store, consolidated=False)
    page = command_report(
        report,
        "run",
        shown,
        live.unexplored(paths),
        scenario=chosen,
        lines=lines,
        verdict=verdict,
        live=live.of_run(report, chosen, dataset),
    )
    written([*paths, *page, folder / "dataset.zarr"], json_file, found, verdict)


def _folder(asked: Path | None, name: str, made_with: dict[str, Any], *, replace: bool) -> Path:
    """The folder for the results of a run, in which no other run's are mixed with them.

    Without --out it is the first of out/run-NAME, out/run-NAME-2 and so on that is free, or that
    holds a run of the same settings.

    made_with: all that determines the numbers and the figures
    replace: whether the run of other settings in the folder is replaced
    Raises FileExistsError where the folder that was asked for holds a run of other settings.
    """
    from ..runtime.provenance import differences
    from ..sweeps.runs import made_with as of

    def differing(folder: Path) -> list[str]:
        store = folder / "dataset.zarr"
        return differences(of(store), made_with) if store.exists() and not replace else []

    if asked is None:
        first = Path("out") / f"run-{name}"
        counted = (first.with_name(f"{first.name}-{i}") for i in itertools.count(2))
        return next(folder for folder in itertools.chain([first], counted) if not differing(folder))
    found = differing(asked)
    if found:
        more = f" and {len(found) - 1} more" if found[1:] else ""
        raise FileExistsError(
            f"{asked} holds a run of other settings ({found[0]}{more}); choose another --out, or "
            "add --replace"
        )
    return asked


def _shown(
    chosen: Scenario, found: dict[str, Any], *, changed: bool
) -> tuple[list[Table], list[str]]:
    """The tables of a run, and the lines below them.

    changed: whether --set or --params changed a value of the machine or of a scheme
    """
    from . import tables

    by_axis = tables.axes_table(found)
    shown = [tables.run_table(chosen, found), tables.last_trial_table(found)]
    shown += [] if by_axis is None else [by_axis]
    lines = [*tables.course_lines(found), *tables.experiment_lines(chosen)]
    lines += tables.other_rows(chosen, found)
    if chosen.due and changed:
        lines.append(
            "published values hold for the scenario as it stands; --set or --params changed it here"
        )
    else:
        lines += tables.reading_lines(chosen, found)
    return shown, lines
