"""The commands for a real machine: `jaxilc next` and `jaxilc trials`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .completion import of_list, scenarios_from, schemes_from
from .console import err, out
from .options import MACHINE, Set
from .results import written
from .titled_table import Table


class Refused(ValueError):
    """The checks refuse a measured trial, or the next input that follows from it."""


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

AcceptSaturation = Annotated[
    bool, typer.Option("--accept-saturation", help="Learn in spite of saturation.")
]
StopOnGrowth = Annotated[
    bool, typer.Option("--stop-on-growth", help="Refuse a trial whose error grew.")
]
NoLearn = Annotated[
    bool,
    typer.Option("--no-learn", help="Look at the trial only; the same schedule is played again."),
]
ReplayedInput = Annotated[
    bool, typer.Option("--replayed-input", help="Without u: the scheme's over the measured y.")
]
Undo = Annotated[
    int | None,
    typer.Option(metavar="J", help="Go back to what was known after trial J, 0 for the start."),
]
Number = Annotated[
    str,
    typer.Option(
        help="Numbers of a C header: double or float.", autocompletion=of_list("double", "float")
    ),
]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Check and report; write nothing.")]


def register(app: typer.Typer) -> None:
    """Add the commands to the command line."""
    app.command("next", rich_help_panel=MACHINE)(next_)
    app.command(rich_help_panel=MACHINE)(trials)


def next_(
    state: Folder,
    measured: Measured = None,
    out_file: Next = None,
    scenario: ScenarioName = None,
    plant_file: PlantFile = None,
    scheme: SchemeName = None,
    set_: Set = None,
    limit: Limit = None,
    largest_correction: Correction = None,
    saturation: Share = None,
    repeatability: Repeatability = None,
    growth: Growth = None,
    accept_saturation: AcceptSaturation = False,
    stop_on_growth: StopOnGrowth = False,
    no_learn: NoLearn = False,
    replayed_input: ReplayedInput = False,
    undo: Undo = None,
    number: Number = "double",
    dry_run: DryRun = False,
) -> None:
    """From a trial measured on a real machine to the input of the next one.

    The first call, without --measured, starts the campaign; a later one without
    it writes the next input once more. What the machine plays: `u` is its whole
    input, `feedforward` is added to its feedback, `reference` takes the place of
    the task's.

    Example: jaxilc next --state x-axis --measured trial-3.csv --out trial-4.csv
    """
    from ..scenarios.campaigns import Given, campaign
    from .asked import begin, settings_of

    begin("float64")
    new = _starts(state, measured, undo, out_file, number, dry_run)
    given = Given(
        scenario=scenario,
        plant_file=plant_file,
        scheme=scheme,
        settings=settings_of(set_),
        rules={
            "limit": limit,
            "correction": largest_correction,
            "saturation": saturation,
            "repeatability": repeatability,
            "growth": growth,
        },
        accept_saturation=accept_saturation,
        stop_on_growth=stop_on_growth,
    )
    now = campaign(state, given, new=new, dry_run=dry_run)
    if new:
        schedules, trial = now.first_schedules(), 1
    else:
        schedules, trial = now.schedules(undo), (now.trials if undo is None else undo) + 1
    if undo is not None and not dry_run:
        now.undo(undo)
    if measured is not None:
        turn = _learned(now, measured, learn=not no_learn, replay_input=replayed_input)
        if not dry_run:
            now.keep(turn)
        schedules, trial = turn.schedules, turn.trial + 1
    _played(None if dry_run else out_file, schedules, now.task, trial, number)


def _starts(
    state: Path,
    measured: Path | None,
    undo: int | None,
    out_file: Path | None,
    number: str,
    dry_run: bool,
) -> bool:
    """Whether the call starts a campaign; raises what is wrong with the options together."""
    from ..hardware.input_files import check_format
    from ..hardware.journal import Journal

    if out_file is not None:
        check_format(out_file, number)
    elif not dry_run:
        raise ValueError("--out is missing; without it, only --dry-run")
    if measured is not None and undo is not None:
        raise ValueError("--measured and --undo exclude each other: undo first, then measure again")
    new = not Journal(state).exists
    if new and (measured is not None or undo is not None):
        raise FileNotFoundError(
            f"{state} holds no campaign; start one without --measured and --undo"
        )
    return new


def _learned(now, measured: Path, **how):
    """The turn that a measured trial makes; its findings are printed.

    Raises Refused where the checks refuse the trial.
    """
    from ..hardware.campaign import refuse
    from ..hardware.trial_files import read_measured

    record = read_measured(measured, now.task, now.recordable())
    turn = now.turn(record, **how)
    _report(turn, record.ignored, now.task.unit)
    try:
        refuse(turn.findings)
    except ValueError as error:
        raise Refused(error) from None
    return turn


def trials(
    state: Folder,
    table: Annotated[Path | None, typer.Option("--csv", help="Write the log to this file.")] = None,
    plot: Annotated[
        Path | None, typer.Option(help="Plot error and input by trial to this file.")
    ] = None,
) -> None:
    """The log of a campaign: every trial with its metrics, undone ones included.

    Example: jaxilc trials --state x-axis --csv log.csv --plot log.png
    """
    from ..hardware.journal import Journal
    from ..hardware.log_file import units, write_log

    journal = Journal(state)
    rows = journal.log()
    out.print(_log_table(str(state), rows))
    files = []
    if table is not None:
        files.append(write_log(table, rows))
    if plot is not None:
        from .. import figures
        from ..figures.campaign import campaign_figure

        unit, input_unit = units(journal)
        axes = campaign_figure(rows, unit=unit, input_unit=input_unit)
        files.append(figures.save(axes, plot))
    written(files, None, [])


def _log_table(title: str, rows: list[dict]) -> Table:
    """A table with a row for each entry of the journal, and all channels of each metric."""
    columns = ("entry", "trial", "event", "rms error", "max error", "effort", "file", "warnings")
    shown = Table(*columns, title=title)
    for row in rows:
        metrics = [
            " ".join(f"{v:.4g}" for name, v in row.items() if name.startswith(start))
            for start in ("max_error", "effort")
        ]
        learned = "" if row["learned"] in ("", True) else ", not learned"
        undone = ", undone" if row["event"] == "trial" and not row["live"] else ""
        error = f"{row['rms_error']:.4g}" if row["rms_error"] != "" else ""
        shown.add_row(
            str(row["serial"]),
            str(row["trial"]),
            f"{row['event']}{learned}{undone}",
            error,
            *metrics,
            str(row["source"]),
            row["warnings"],
        )
    return shown


def _report(turn, ignored, unit: str) -> None:
    """Print the findings of the checks: notes to standard output, warnings to standard error."""
    largest = ", ".join(f"{value:.6g}" for value in turn.metrics["max_error"])
    rms = f"RMS error {turn.metrics['error']:.6g} {unit}"
    out.print(f"trial {turn.trial}: {rms}, largest {largest} {unit}", highlight=False)
    if ignored:
        out.print(f"not used: {', '.join(ignored)}", highlight=False, markup=False)
    for kind, text in turn.findings:
        if kind != "refusal":
            (err if kind == "warning" else out).print(
                f"{kind}: {text}", highlight=False, markup=False, soft_wrap=True
            )


def _played(path: Path | None, schedules, task, trial: int, number: str) -> None:
    """Print the next schedules of the machine, and write them to the path, if it is not None."""
    import numpy as np

    from ..hardware.input_files import write_schedules
    from ..learning.playback import unit_of

    peaks = ", ".join(
        f"{name} up to {np.max(np.abs(schedule)):.6g} {unit_of(name, task)}".strip()
        for name, schedule in schedules.items()
    )
    out.print(f"next: trial {trial}, {peaks}", highlight=False, markup=False, soft_wrap=True)
    if path is None:
        out.print("dry run: nothing was written", highlight=False)
        return
    write_schedules(path, schedules, task, trial=trial, number=number)
    out.print(f"written: {path}", highlight=False, markup=False, soft_wrap=True)
