"""`jaxilc next`: learning on a real machine, from a measured trial to the input of the next one."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..outcomes.request import settings_of
from . import trials
from .completion import scenarios_from, schemes_from
from .console import err, out
from .groups import add
from .options import (
    MACHINE,
    InputColumn,
    OutputColumn,
    Pages,
    Params,
    Set,
    TimeColumn,
)
from .present import written
from .start import begin
from .trials import Folder, Plot

if TYPE_CHECKING:
    from ..hardware.calibration import Expected
    from ..hardware.journal import Journal
    from ..hardware.prediction import Prediction
    from ..scenarios.campaigns import Opened


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
SchemeName = Annotated[
    str | None,
    typer.Option(
        "--scheme", help="Scheme; not needed where only one learns.", autocompletion=schemes_from
    ),
]
NoLearn = Annotated[
    bool,
    typer.Option("--no-learn", help="Look at the trial only; the same schedule is played again."),
]
Undo = Annotated[
    int | None,
    typer.Option(metavar="J", help="Go back to what was known after trial J, 0 for the start."),
]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Check and report; write nothing.")]


# What `--set campaign.NAME=VALUE` sets, with the type of the value and what it means.
OF_CAMPAIGN = {
    "limit": (float, "largest |input| played; the machine's own if not given"),
    "largest_correction": (float, "largest departure of a learned reference"),
    "saturation": (float, "share of samples at the limit that is accepted"),
    "repeatability": (float, "largest rms difference of two trials of one schedule"),
    "growth": (float, "share by which the rms error may grow without a warning"),
    "accept_saturation": (bool, "learn in spite of saturation"),
    "stop_on_growth": (bool, "refuse a trial whose error grew"),
    "accept": (str, "what is not refused in this call: frozen,jump,schedule,growth,input"),
    "replayed_input": (bool, "without u: the scheme's input over the measured y"),
    "short_trial": (bool, "the trial may have ended early: learn from its part"),
    "predict": (bool, "whether errors of trials are predicted by the plant file, from now on"),
    "reference": (str, "column of the reference, which need not be there"),
    "columns": (str, "names of the columns of a file without a header: sample,u [V],y [mm]"),
    "number": (str, "numbers of a C header: double or float"),
}


class Refused(ValueError):
    """The checks refuse a measured trial, or the next input that follows from it."""


def register(app: typer.Typer) -> None:
    """Add the commands to the command line."""
    add(app, next_, MACHINE, "next")
    trials.register(app)


def next_(
    state: Folder,
    pages: Pages,
    measured: Measured = None,
    time_name: TimeColumn = "t",
    input_name: InputColumn = "u",
    output_name: OutputColumn = "y",
    out_file: Next = None,
    scenario: ScenarioName = None,
    scheme: SchemeName = None,
    params: Params = None,
    set_: Set = None,
    no_learn: NoLearn = False,
    undo: Undo = None,
    dry_run: DryRun = False,
    plot: Plot = None,
) -> None:
    """From a trial measured on a real machine to the input of the next one.

    The first call, without --measured, starts the campaign; a later one without
    it writes the next input once more. What the machine plays: `u` is its whole
    input, `feedforward` is added to its feedback, `reference` takes the place of
    the task's. `--set campaign.NAME=VALUE` sets how a campaign is checked, such as
    campaign.limit, the largest input, and campaign.accept_saturation=true.

    Example: jaxilc next --state x-axis --measured trial-3.csv --out trial-4.csv
    """
    from ..hardware.trial_files import OPTIONS, read_measured, read_short
    from ..scenarios.campaigns import Given, open_campaign

    begin()
    settings, of = _of_campaign(settings_of(set_ or ()))
    names = {"t": time_name, "u": input_name, "y": output_name, "r": of.get("reference", "r")}
    columns = {OPTIONS[signal]: name for signal, name in names.items() if name != signal}
    headings = [name.strip() for name in of.get("columns", "").split(",") if name.strip()]
    if headings:
        columns["--set campaign.columns"] = of["columns"]
    new = _starts(state, measured, undo, out_file, of.get("number", "double"), dry_run)
    given = Given(
        scenario=scenario,
        scheme=scheme,
        params=params,
        settings=settings,
        predict=of.get("predict"),
        rules={
            "limit": of.get("limit"),
            "correction": of.get("largest_correction"),
            "saturation": of.get("saturation"),
            "repeatability": of.get("repeatability"),
            "growth": of.get("growth"),
        },
        accept_saturation=of.get("accept_saturation", False),
        stop_on_growth=of.get("stop_on_growth", False),
        accept=tuple(name.strip() for name in of.get("accept", "").split(",") if name.strip()),
    )
    opened = open_campaign(state, given, new=new, dry_run=dry_run)
    now = opened.campaign
    if not (new or now.journal.bound or dry_run or undo is not None):
        _bind(now.journal)
    source = _say_source(opened)
    schedules = now.first_schedules() if new else now.schedules(undo)
    trial = 1 if new else (now.trials if undo is None else undo) + 1
    if undo is not None and not dry_run:
        now.undo(undo)
    turn, prediction, expected = None, None, None
    if measured is not None:
        record = (read_short if of.get("short_trial") else read_measured)(
            measured, now.task, now.recordable(), names, headings
        )
        prediction = _predicted(opened, compute=True, store=not dry_run)
        turn = _turn(
            opened,
            record,
            prediction,
            learn=not no_learn,
            replay_input=of.get("replayed_input", False),
        )
        if not dry_run:
            now.keep(turn)
        schedules, trial = turn.schedules, turn.trial + 1
    _played(None if dry_run else out_file, schedules, now.task, trial, of.get("number", "double"))
    if not dry_run and (measured is None or prediction is not None):
        # Of the next trial; a stop while it is simulated loses nothing, all is written by now.
        prediction = _predicted(opened, compute=new or measured is not None, store=True)
        expected = _expected(opened, prediction)
    files = measured, out_file, plot, pages.numbers
    _close(opened, turn, (prediction, expected), source, trial, files, columns, dry_run)


def _of_campaign(settings: dict[str, str]) -> tuple[dict[str, str], dict[str, Any]]:
    """The settings of the scenario, and those of the campaign, whose names begin with `campaign.`.

    Raises ValueError for a name that is not known, or a value that has another type.
    """
    found: dict[str, Any] = {}
    rest = {}
    for path, text in settings.items():
        owner, _, name = path.partition(".")
        if owner != "campaign":
            rest[path] = text
        elif name not in OF_CAMPAIGN:
            known = ", ".join(OF_CAMPAIGN)
            raise ValueError(f"--set {path}: a campaign has no {name!r}; it has {known}")
        else:
            found[name] = _read(path, text, OF_CAMPAIGN[name][0])
    return rest, found


def _read(path: str, text: str, kind: type) -> object:
    """The value of a setting of a campaign."""
    truth = {"true": True, "false": False}
    try:
        return truth[text] if kind is bool else kind(text)
    except (KeyError, ValueError):
        allowed = "true or false" if kind is bool else "a number"
        raise ValueError(f"--set {path}={text} is not {allowed}") from None


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


def _bind(journal: Journal) -> None:
    """Bind the entries of a campaign of before, and say so; one without its head stays as it is."""
    journal.live()  # raises where entries have been bound before
    journal.bind()
    out.print(
        f"note: nothing said which entries belong to {journal.path}, which is older than that; "
        "those that are there do from now on",
        highlight=False,
        soft_wrap=True,
    )


def _say_source(opened: Opened) -> list[str]:
    """Print and return the sentences on what the campaign belongs to, and what has changed."""
    from ..scenarios.campaign_source import said_of_change, said_of_source

    said = said_of_source(opened.recipe)
    for line in said:
        out.print(line, highlight=False, soft_wrap=True)
    changed = said_of_change(opened.recipe, trials.UNCHANGED)
    if changed:
        err.print(f"warning: {changed}", highlight=False, soft_wrap=True)
    return [*said, changed] if changed else said


def _predicted(opened: Opened, *, compute: bool, store: bool) -> Prediction | None:
    """The prediction of the campaign, None without one; where there can be none, says why.

    compute: whether it is simulated where the folder does not have it
    """
    from ..hardware.prediction import kept, key_of, next_step, of_campaign

    if not opened.recipe.get("predict", True):
        return None
    journal, configuration = opened.campaign.journal, opened.campaign.configuration_hash
    if not compute:
        return kept(journal.path, configuration, key_of(opened.subject))
    try:
        return of_campaign(
            journal.path,
            opened.subject,
            next_step(journal.live()),
            expected=opened.scenario.trials,
            configuration=configuration,
            store=store,
        )
    except ValueError as error:
        out.print(f"note: nothing is predicted: {error}", highlight=False, soft_wrap=True)
        return None


def _expected(opened: Opened, prediction: Prediction | None) -> Expected | None:
    """What the campaign expects of its next trial, None where nothing is predicted."""
    return None if prediction is None else opened.campaign.expected(opened.subject.machine)


def _turn(opened: Opened, record, prediction: Prediction | None, **how):
    """The turn that a measured trial makes; its findings are printed.

    Raises Refused where the checks refuse the trial.
    """
    from ..hardware.campaign import refuse

    now = opened.campaign
    turn = now.turn(record, **how, expected=_expected(opened, prediction))
    predicted, finding = trials.against_prediction(now, turn, prediction)
    turn.findings.extend(finding)
    largest = ", ".join(f"{value:.6g}" for value in turn.metrics["max_error"])
    unit = now.task.unit
    rms = f"RMS error {turn.metrics['error']:.6g} {unit}"
    out.print(f"trial {turn.trial}: {rms}, largest {largest} {unit}", highlight=False)
    if predicted:
        out.print(predicted, highlight=False, soft_wrap=True)
    if record.ignored:
        out.print(f"not used: {', '.join(record.ignored)}", highlight=False, markup=False)
    for kind, text in turn.findings:
        if kind != "refusal":
            (err if kind == "warning" else out).print(
                f"{kind}: {text}", highlight=False, markup=False, soft_wrap=True
            )
    try:
        refuse(turn.findings)
    except ValueError as error:
        back = trials.step_back(now)
        raise Refused(f"{error}. Nothing was learned or written{back}") from None
    return turn


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


def _close(
    opened: Opened,
    turn,
    predicted: tuple[Prediction | None, Expected | None],
    source: list[str],
    trial: int,
    files: tuple[Path | None, Path | None, Path | None, Path | None],
    columns: dict[str, str],
    dry_run: bool,
) -> None:
    """Print the verdict and the next command; write the figure and the numbers, if asked for.

    predicted: the prediction of the plant file, and what is expected of the next trial
    trial: number of the next trial
    files: those of --measured, --out, --plot, and the one for the numbers
    columns: options that name columns of the measured trial, with their values
    """
    from ..hardware.checks import experiment_numbers

    measured, out_file, plot, json_file = files
    prediction = predicted[0]
    now, journal = opened.campaign, opened.campaign.journal
    rows = journal.log() if journal.exists else []
    live = journal.live() if journal.exists else []
    if plot is not None and live and not dry_run:
        plot = trials.save_figure(plot, now, rows, live, predicted)
    numbers_of = experiment_numbers(now.scheme, now.task, live)
    known = opened.scenario.potential
    stop = None if known is None else known.stop
    growth, unit = now.rules.growth, now.task.unit
    verdict = trials.verdict(live, turn, prediction, unit, growth, numbers_of, stop)
    following = trials.next_command(journal.path, trial, measured, out_file, columns)
    step = "" if dry_run else trials.coming(live, predicted, trial, now.task.unit)
    for line in (*([step] if step else []), *verdict, following):
        out.print(line, highlight=False, soft_wrap=True)
    numbers: dict[str, Any] = {
        "source": trials.source_numbers(opened.recipe),
        "said": source,
        "next_trial": trial,
        "verdict": verdict,
        "next": following,
        **trials.turn_numbers(live, turn, prediction),
    }
    paths = [plot] if plot is not None and live and not dry_run else []
    written(paths, None if dry_run else json_file, numbers)
