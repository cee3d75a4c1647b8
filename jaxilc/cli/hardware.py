"""The command line for a real machine: `jaxilc next` and `jaxilc trials`."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import Annotated, Any

import typer

from .completion import of_list, scenarios_from, schemes_from

Folder = Annotated[Path, typer.Option("--state", help="Folder of the campaign.")]
Measured = Annotated[
    Path | None,
    typer.Option(
        "--measured", metavar="TRIAL", help="Measured trial, .csv or .mat; none starts a campaign."
    ),
]
Next = Annotated[
    Path | None,
    typer.Option(
        "--out", metavar="NEXT", help="What the machine plays next: .csv, .mat or .h (C)."
    ),
]
ScenarioName = Annotated[
    str | None,
    typer.Option(
        "--scenario",
        metavar="NAME|FILE",
        help="Scenario or plant file to start from.",
        autocompletion=scenarios_from,
    ),
]
PlantFile = Annotated[Path | None, typer.Option(help="Plant file (TOML or JSON) to start from.")]
SchemeName = Annotated[
    str | None,
    typer.Option(
        "--scheme", help="Scheme; not needed where only one learns.", autocompletion=schemes_from
    ),
]
Set = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="PATH=VALUE", help="Set a parameter of the scenario; repeatable."
    ),
]
Limit = Annotated[
    float | None, typer.Option(help="Largest |input| played; the machine's own if not given.")
]
Correction = Annotated[
    float | None,
    typer.Option("--largest-correction", help="Largest departure of a learned reference."),
]
Share = Annotated[
    float | None,
    typer.Option("--saturation", help="Share of samples at the limit that is accepted."),
]
Repeatability = Annotated[
    float | None, typer.Option(help="Largest RMS difference of two trials of one schedule.")
]
Growth = Annotated[
    float | None, typer.Option(help="Share by which the RMS error may grow without a warning.")
]

KEPT_RULES = (
    "limit",
    "correction",
    "saturation",
    "repeatability",
    "growth",
)  # from the first call on, until given anew


def register(app: typer.Typer) -> None:
    """Add the commands to the command line."""
    app.command("next")(next_)
    app.command()(trials)


def next_(
    state: Folder,
    measured: Measured = None,
    out: Next = None,
    scenario: ScenarioName = None,
    plant_file: PlantFile = None,
    scheme: SchemeName = None,
    set_: Set = None,
    limit: Limit = None,
    largest_correction: Correction = None,
    saturation: Share = None,
    repeatability: Repeatability = None,
    growth: Growth = None,
    accept_saturation: Annotated[
        bool, typer.Option("--accept-saturation", help="Learn in spite of saturation.")
    ] = False,
    stop_on_growth: Annotated[
        bool, typer.Option("--stop-on-growth", help="Refuse a trial whose error grew.")
    ] = False,
    no_learn: Annotated[
        bool,
        typer.Option(
            "--no-learn", help="Look at the trial only; the same schedule is played again."
        ),
    ] = False,
    replayed_input: Annotated[
        bool, typer.Option("--replayed-input", help="Without u: the scheme's over the measured y.")
    ] = False,
    undo: Annotated[
        int | None,
        typer.Option(metavar="J", help="Go back to what was known after trial J, 0 for the start."),
    ] = None,
    number: Annotated[
        str,
        typer.Option(
            help="Numbers of a C header: double or float.",
            autocompletion=of_list("double", "float"),
        ),
    ] = "double",
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Check and report; write nothing.")
    ] = False,
) -> None:
    """From a trial measured on a real machine to the input of the next one.

    The first call, without --measured, starts the campaign; a later one without it writes the next
    input once more.
    What the machine plays: `u` is its whole input, `feedforward` is added to its feedback,
    `reference` takes the place of the task's.

    Example: jaxilc next --state x-axis --measured trial-3.csv --out trial-4.csv
    """
    from ..hardware.campaign import Campaign, refuse
    from ..hardware.checks import Rules
    from ..hardware.journal import Journal
    from ..hardware.trial_files import check_format, read_measured
    from ..runtime.start import setup
    from .options import Refused

    setup(precision="float64")
    if out is not None:
        check_format(out, number)
    elif not dry_run:
        raise ValueError("--out is missing; without it, only --dry-run")
    if measured is not None and undo is not None:
        raise ValueError("--measured and --undo exclude each other: undo first, then measure again")
    journal = Journal(state)
    new = not journal.exists
    if new and (measured is not None or undo is not None):
        raise FileNotFoundError(
            f"{state} holds no campaign; start one without --measured and --undo"
        )
    before = {} if new else _kept(journal)
    given = dict(
        zip(KEPT_RULES, (limit, largest_correction, saturation, repeatability, growth), strict=True)
    )
    recipe = _recipe(
        before,
        scenario,
        plant_file,
        scheme,
        set_,
        {name: v for name, v in given.items() if v is not None},
    )
    rules = Rules(
        **recipe["rules"], accept_saturation=accept_saturation, stop_on_growth=stop_on_growth
    )
    recipe["scheme"], chosen = _chosen(recipe)
    subject = (state, chosen.schemes[recipe["scheme"]], chosen.task)
    common = {"actuator": chosen.machine.actuator, "rules": rules, "recipe": recipe}
    if new:
        campaign = Campaign.start(*subject, **common, dry_run=dry_run)
        schedules, trial = campaign.first_schedules(), 1
    else:
        campaign = Campaign.open(*subject, **common)
        schedules, trial = campaign.schedules(undo), (campaign.trials if undo is None else undo) + 1
    if undo is not None and not dry_run:
        campaign.undo(undo)
    if measured is not None:
        record = read_measured(measured, campaign.task, campaign.recordable())
        turn = campaign.turn(record, learn=not no_learn, replay_input=replayed_input)
        _report(turn, record.ignored, campaign.task.unit)
        try:
            refuse(turn.findings)
        except ValueError as error:
            raise Refused(error) from None
        if not dry_run:
            campaign.keep(turn)
        schedules, trial = turn.schedules, turn.trial + 1
    _played(out, schedules, campaign.task, trial, number, dry_run)


def trials(
    state: Folder,
    table: Annotated[Path | None, typer.Option("--csv", help="Write the log to this file.")] = None,
    plot: Annotated[
        Path | None, typer.Option(help="Plot error and input by trial to this file.")
    ] = None,
) -> None:
    """The log of a campaign: every trial with its figures, undone ones included.

    Example: jaxilc trials --state x-axis --csv log.csv --plot log.png
    """
    from ..hardware.journal import Journal
    from ..storage.files import atomically
    from .options import out as console
    from .titled_table import Table

    journal = Journal(state)
    rows = journal.log()
    shown = Table(
        "entry",
        "trial",
        "event",
        "rms error",
        "max error",
        "effort",
        "file",
        "warnings",
        title=str(state),
    )
    for row in rows:
        figures = [
            " ".join(f"{v:.4g}" for name, v in row.items() if name.startswith(start))
            for start in ("max_error", "effort")
        ]
        undone = row["event"] == "trial" and not row["live"]
        event = f"{row['event']}{'' if row['learned'] in ('', True) else ', not learned'}{', undone' if undone else ''}"
        error = f"{row['rms_error']:.4g}" if row["rms_error"] != "" else ""
        shown.add_row(
            str(row["serial"]),
            str(row["trial"]),
            event,
            error,
            *figures,
            str(row["source"]),
            row["warnings"],
        )
    console.print(shown)
    written = []
    if table is not None:
        text = io.StringIO()
        writer = csv.DictWriter(
            text,
            list(dict.fromkeys(name for row in rows for name in row)),
            restval="",
            lineterminator="\n",
        )
        writer.writeheader()
        writer.writerows(rows)
        atomically(table, lambda file: file.write(text.getvalue().encode()))
        written.append(table)
    if plot is not None:
        from .. import figures
        from ..figures.campaign import campaign_figure

        task = journal.last_known()["configuration"].get("task")
        unit, input_unit = (
            str(task.get(name, "")) if isinstance(task, dict) else ""
            for name in ("unit", "input_unit")
        )
        written.append(figures.save(campaign_figure(rows, unit=unit, input_unit=input_unit), plot))
    if written:
        console.print("written: " + ", ".join(map(str, written)), highlight=False, soft_wrap=True)


def _kept(journal) -> dict[str, Any]:
    """The recipe of a campaign. Raises ValueError for what `jaxilc next` does not write."""
    from ..pytree.ranges import is_number

    recipe = journal.last_known()["recipe"]
    kinds = {"scenario": str, "scheme": str, "settings": dict, "rules": dict}
    rules = recipe.get("rules", {})
    if not all(
        isinstance(recipe.get(name, kind()), kind) for name, kind in kinds.items()
    ) or not all(name in KEPT_RULES and is_number(value) for name, value in rules.items()):
        raise ValueError(
            f"{journal.path} was not started by `jaxilc next`, or its last recipe is damaged; --undo cannot mend it"
        )
    return recipe


def _recipe(before, scenario, plant_file, scheme, settings, rules) -> dict[str, Any]:
    """How scheme and task are made: as before, but for what is given anew."""
    from ..scenarios import SCENARIOS

    if scenario is not None and plant_file is not None:
        raise ValueError("--scenario and --plant-file exclude each other")
    source = scenario if plant_file is None else str(plant_file)
    if source is None and "scenario" not in before:
        raise ValueError("the first call needs --scenario or --plant-file")
    if source is not None and source not in SCENARIOS and Path(source).suffix:
        source = str(Path(source).absolute())  # found again from wherever the next call comes
    values = dict(before.get("settings", {}))
    for setting in settings or []:
        path, equals, value = setting.partition("=")
        if not equals:
            raise ValueError(f"--set {setting!r} is not PATH=VALUE")
        values[path.strip()] = value.strip()
    return {
        "scenario": source or before["scenario"],
        "scheme": scheme or before.get("scheme"),
        "settings": values,
        "rules": before.get("rules", {}) | rules,
    }


def _chosen(recipe: dict[str, Any]):
    """The name of the scheme and the scenario."""
    from ..scenarios.from_file import load_scenario

    chosen = load_scenario(recipe["scenario"], recipe["settings"])
    learning = [name for name, scheme in chosen.schemes.items() if scheme.learns]
    name = recipe["scheme"] or (learning[0] if len(learning) == 1 else None)
    if name is None and learning:
        raise ValueError(f"--scheme is missing; those that learn are {', '.join(learning)}")
    if name not in learning:
        raise ValueError(
            f"scheme = {name!r} is not one of those that learn: {', '.join(learning) or 'none'}"
        )
    return name, chosen


def _report(turn, ignored, unit: str) -> None:
    """What was found about a measured trial: notes to standard output, warnings to standard error."""
    from .options import err, out

    largest = ", ".join(f"{value:.6g}" for value in turn.figures["max_error"])
    out.print(
        f"trial {turn.trial}: RMS error {turn.figures['error']:.6g} {unit}, largest {largest} {unit}",
        highlight=False,
    )
    if ignored:
        out.print(f"not used: {', '.join(ignored)}", highlight=False, markup=False)
    for kind, text in turn.findings:
        if kind != "refusal":
            (err if kind == "warning" else out).print(
                f"{kind}: {text}", highlight=False, markup=False, soft_wrap=True
            )


def _played(path: Path | None, schedules, task, trial: int, number: str, dry_run: bool) -> None:
    """Write what the machine plays, and say what it is."""
    import numpy as np

    from ..hardware.trial_files import write_schedules
    from ..learning.playback import unit_of
    from .options import out

    peaks = ", ".join(
        f"{name} up to {np.max(np.abs(schedule)):.6g} {unit_of(name, task)}".strip()
        for name, schedule in schedules.items()
    )
    out.print(f"next: trial {trial}, {peaks}", highlight=False, markup=False, soft_wrap=True)
    if dry_run or path is None:
        out.print("dry run: nothing was written", highlight=False)
        return
    write_schedules(path, schedules, task, trial=trial, number=number)
    out.print(f"written: {path}", highlight=False, markup=False, soft_wrap=True)
