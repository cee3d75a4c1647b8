"""`jaxilc next` and `jaxilc trials`: learning on a real machine, and the log of a campaign."""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping
from functools import partial
from itertools import accumulate
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Context, Option

from ..outcomes.outcome import Figure, Interactive, Numbers, Table, Verdict
from ..outcomes.request import settings_of
from .console import begin, out, say, warn
from .options import OF_CAMPAIGN, OneScheme, Pages, figure_to_write, names_in, scenarios_from
from .present import stored, written

if TYPE_CHECKING:
    from ..hardware.calibration import Expected
    from ..hardware.campaign import Campaign, Turn
    from ..hardware.checks import Finding
    from ..hardware.journal import Journal, Manifest
    from ..hardware.prediction import Place, Prediction
    from ..pytree.aliases import Value
    from ..scenarios.campaigns import Opened


Plot = Annotated[Path | None, Option(callback=figure_to_write)]
LITTLE = 0.02  # share by which the error falls at least in `PATIENCE` trials while it is learned
PATIENCE = 3
_LAST_NUMBER = re.compile(r"^(.*?)(\d+)(\D*)$")
UNCHANGED = (
    "while scheme, task and actuator are the same: learning goes on as before, and what is "
    "predicted follows the file as it is now"
)


def trials(state: Path, pages: Pages, csv: Path | None = None, plot: Plot = None) -> None:
    """The log of a campaign: every trial with its metrics, undone ones included.

    state: Folder of the campaign.
    csv: Write the log to this file.
    plot FIGURE: Plot errors, prediction and the last trial to this file.

    Example: jaxilc trials --state x-axis --csv log.csv --plot log.png
    """
    from ..figures.report import command_report
    from ..hardware.journal import Journal, units, write_log
    from ..hardware.prediction import kept
    from ..scenarios.campaign_source import belongs_to, for_verdict
    from ..schemes.scheme import trials_of_step

    journal, report = Journal(state), pages.file(".html")
    rows = journal.log()
    known = journal.last_known()
    recipe = known["recipe"] if "scenario" in known["recipe"] else {}
    live, prediction = _live(journal), kept(journal.path, str(known.get("configuration_hash")))
    places = {} if prediction is None else _places(live, prediction)
    of = zip(("errors", "effort"), units(journal), strict=True)
    told = ", ".join(f"{what} in {unit}" for what, unit in of if unit)
    title = f"{state}: {told}" if told else str(state)
    log = _log_table(title, rows, places)
    out.print(log)
    said, changed = _say_source(recipe) if recipe else ([], "")
    files = []
    if csv is not None:
        files.append(write_log(csv, rows))
    old = bool(recipe) and ("stop" not in recipe or "trials_of_step" not in known)
    now = _opened(state) if live and (plot or report or old) else None
    by = for_verdict(recipe, known.get("trials_of_step"))
    if now is not None:
        by = for_verdict(now.recipe, trials_of_step(now.scheme, now.task))
    unit = units(journal)[0]
    sentences = verdict(live, None, prediction, unit, **by, state=state) if live else []
    measured = Path(live[-1]["source"]) if len(live) > 1 else None
    following = next_command(state, len(live) or 1, measured, None)
    if measured is not None and _named_otherwise(measured):
        following = following.replace("record it,", "record it, name its columns as before,", 1)
    for line in (*sentences, following) if live else ():
        say(line)
    placed = [{"serial": serial, **place._asdict()} for serial, place in places.items()]
    numbers = {
        "source": belongs_to(recipe) if recipe else {},
        "changed": changed,
        "trials": rows,
        "predicted": prediction
        and {"machines": prediction.machines, **prediction.bands(), "trials": placed},
        "verdict": sentences,
        "next": following if live else "",
    }
    in_json = stored(pages.file(".json"), numbers)
    figure = _figure(journal, rows, live, (prediction, None))
    if plot is not None:
        files.append(_save(figure, plot, now, live))
    if report is not None:
        found = _verdict(sentences, following) if live else Verdict(())
        asked = {"campaign": "; ".join(said)} if said else {}
        shown: list[Interactive] = _browser(now, live)
        if any(row["event"] == "trial" for row in rows):
            shown.insert(0, figure.described())
        page = command_report(report, "trials", [log], verdict=found, live=shown, asked=asked)
        files.append(page)
    written([*files, *in_json])


def _named_otherwise(measured: Path) -> bool:
    """Whether `next` was told the names of columns, as the record shows by no header with `y`."""
    from ..storage.columns import name_and_unit, read_columns

    try:
        header, _ = read_columns(measured)
    except OSError:
        return False
    except ValueError:
        return measured.suffix != ".mat"
    return all(name_and_unit(heading)[0].rstrip("0123456789") != "y" for heading in header)


def _verdict(lines: list[str], following: str) -> Verdict:
    """The verdict on a campaign for its page, from the lines that are printed."""
    said = [line.removeprefix("verdict: ") for line in lines]
    what, _, command = following.partition(", then: ")
    return Verdict(tuple(line[:1].upper() + line[1:] for line in said), what, command)


def _live(journal: Journal) -> list[Manifest]:
    """The manifests that count; none where the campaign must be taken back first."""
    try:
        return journal.live()
    except ValueError as error:
        warn(f"warning: {error}")
        return []


def _opened(state: Path) -> Campaign | None:
    """The campaign with its task, None where its plant file does not give it any more."""
    from ..scenarios.campaigns import Given, open_campaign

    begin()
    try:
        return open_campaign(state, Given(), new=False).campaign
    except (ValueError, OSError) as error:
        warn(f"warning: neither reference nor experiments of the campaign are known: {error}")
        return None


def _figure(
    journal: Journal,
    rows: list[Manifest],
    live: list[Manifest],
    predicted: tuple[Prediction | None, Expected | None],
) -> Figure:
    """The errors of a campaign by trial, with the prediction, and what the next trial will have."""
    from ..figures.experiments import bands_by_trial, campaign_figure
    from ..hardware.journal import units

    (prediction, expected), (unit, input_unit) = predicted, units(journal)
    bands = bands_by_trial(live, prediction, expected) if prediction and live else None
    draw = partial(campaign_figure, rows, unit=unit, input_unit=input_unit, bands=bands)
    return Figure("", draw)


def _save(figure: Figure, path: Path, now: Campaign | None, live: list[Manifest]) -> Path:
    """Write that figure to a file, with the last trial in time where the campaign is known."""
    from .. import figures
    from ..figures.experiments import LastTrial
    from ..hardware.campaign import TRIAL

    last = None
    if now is not None and len(live) > 1:
        task, signals = now.task, now.journal.arrays(live[-1], TRIAL)
        last = LastTrial(live[-1]["trial"], task.time, task.reference, signals["y"], signals["u"])
    return figures.save(figure.draw(last=last), path)


def _browser(now: Campaign | None, live: list[Manifest]) -> list[Interactive]:
    """The measured trials in time, for a page; nothing where the campaign is not known."""
    from ..figures import browsers
    from ..hardware.campaign import TRIAL

    if now is None or len(live) < 2:
        return []
    measured = {m["trial"]: now.journal.arrays(m, TRIAL) for m in live[1:]}
    return [browsers.measured_trials(now.task, measured)]


def _places(live: list[Manifest], prediction: Prediction) -> dict[int, Place]:
    """Where each whole trial that counts lies on what was expected, by its serial."""
    from ..hardware.calibration import kept
    from ..hardware.journal import METRICS, is_part
    from ..hardware.prediction import steps

    places = {
        manifest["serial"]: _place(prediction, step, manifest[METRICS], kept(manifest), manifest)
        for manifest, step in zip(live[1:], steps(live), strict=True)
        if not is_part(manifest)
    }
    return {serial: place for serial, place in places.items() if place}


def _log_table(title: str, rows: list[Manifest], places: Mapping[int, Place]) -> Table:
    """A row for each entry of the journal, with all channels, and predicted bands if any."""
    marks = {"within": "", "slight": " ({}outside)", "clear": " ({}far outside)"}
    which = {"RMS error": "", "largest error": "largest "}  # whose own band has no column
    predicted = {
        serial: f"{place.rms[0]:.3g} to {place.rms[1]:.3g}"
        + marks[place.level].format(which[place.error])
        for serial, place in places.items()
        if place.rms[0] < place.rms[1]
    }
    band = ("predicted rms",) if predicted else ()
    columns = ("entry", "trial", "event", "rms error", *band, "max error", "effort", "file")
    shown = Table(*columns, "warnings", title=title)
    for row in rows:
        metrics = [
            " ".join(f"{v:.4g}" for name, v in row.items() if name.startswith(start))
            for start in ("max_error", "effort")
        ]
        learned = "" if row["learned"] in ("", True) else ", not learned"
        undone = ", undone" if row["event"] == "trial" and not row["live"] else ""
        error = f"{row['rms_error']:.4g}" if row["rms_error"] != "" else ""
        shown.add_row(
            str(row["serial"]), str(row["trial"]), f"{row['event']}{learned}{undone}", error,
            *([predicted.get(row["serial"], "")] if band else []), *metrics, str(row["source"]),
            row["warnings"],
        )  # fmt: skip
    return shown


# Sentences
# --------------------------------------------------------------------------------------------------


def against_prediction(
    now: Campaign, turn: Turn, prediction: Prediction | None, place: Place | None
) -> tuple[str, list[Finding]]:
    """The sentence on what was predicted for a trial, and a finding where it lies outside."""
    from ..hardware.checks import GROWN_BEYOND

    if prediction is None or place is None:
        return "", []
    unit = now.task.unit
    if turn.expected is None and prediction.certain:
        median = f"{float(prediction.rms.median[place.step - 1]):.3g} {unit}".strip()
        return f"predicted: RMS error {median}; the file gives no uncertainty and no noise", []
    found = [] if place.level == "within" else [_outside(now, turn, place, prediction)]
    if place.level == "clear" and place.distance > 0 and not turn.refusals:
        error = turn.metrics["error"]
        found += now.grown_beyond(turn.record, error, GROWN_BEYOND, turn.expected)
    share = f"95 % of {prediction.machines} drawn machines"
    if turn.expected is not None:
        share = "90 % by the trials so far"
    return f"predicted: {_range(place, unit)}, {share}", found


def _outside(now: Campaign, turn: Turn, place: Place, prediction: Prediction) -> Finding:
    """The finding of a trial outside its band, with what it means and what to do."""
    from ..hardware.checks import Finding

    above, trial, side = place.distance > 0, turn.trial, _side(turn, place)
    fit = f"jaxilc identify --state {shlex.quote(str(now.journal.path))}"
    fit += f" --out {new_plant_file(now.recipe)}"
    if turn.expected is not None:
        return _unexpected(now, turn, place, fit)
    if place.level == "slight":
        text = (
            f"trial {trial}: the {place.error} is {side} the 95 % band, as far out as that of one "
            "trial in twenty is on a machine that is as the file says; look at the next trials"
        )
        return Finding("note", text)
    text = (
        f"trial {trial} lies outside the 95 % band: its {place.error} is {side} it, further out "
        f"than 99 % of the drawn machines come in any of {prediction.trials} trials. The plant "
        "differs from the file"
    )
    if not above:
        text += ": it learns faster, so the margin to instability is not that of the file either"
    elif not prediction.noisy:
        text += (
            ", or it is the noise, of which the file states none: measure a trial twice "
            "(--no-learn) and give the noise under [machine.sensor]"
        )
    what_next = "Re-identify" if not above else "Stop and look for the cause, or re-identify"
    return Finding("warning", f"{text}. {what_next}: {fit}")


def _side(turn: Turn, place: Place) -> str:
    """On which side of its band an error lies, in words."""
    if not place.distance > 0:
        return "below"
    largest = place.error != "RMS error"
    error = max(turn.metrics["max_error"]) if largest else turn.metrics["error"]
    return f"{error / (place.largest if largest else place.rms)[1]:.3g} times the upper end of"


def _unexpected(now: Campaign, turn: Turn, place: Place, fit: str) -> Finding:
    """The finding of a trial outside the band that the trials before gave."""
    from ..hardware.checks import Finding

    side = _side(turn, place)
    text = f"trial {turn.trial}: the {place.error} is {side} the band of the trials so far"
    if place.level == "slight":
        return Finding(
            "note", f"{text}, as one of the two is in one trial of ten; look at the next trials"
        )
    changed = now.what_changed(turn.record, turn.expected)
    text += f"; suspected is {changed.text or 'a changed machine'}"
    then = (changed.then or "look for the cause, or identify the plant again").capitalize()
    if all(kind != "refusal" for kind, _ in turn.findings):
        text += ". It is told once: the next band begins here"
    return Finding("warning", f"{text}. {then}: {fit}")


def step_back(now: Campaign, out_file: Path | None) -> str:
    """How to play the best input so far again; an empty text before the first trial."""
    from ..hardware.checks import comparable

    errors = comparable(now.scheme, now.task, now.journal.live())
    if not errors:
        return ""
    best, least = min(errors, key=lambda one: one[1])
    said = f"{least:.4g} {now.task.unit}".rstrip()
    back = back_to(now.journal.path, best, out_file)
    return f"; back to the input of trial {best} ({said}): {back}"


def back_to(state: Path, trial: int, out_file: Path | None) -> str:
    """The command that writes once more what a trial played, beside the file of the next input."""
    words = ["jaxilc", "next", "--state", state, "--undo", trial - 1]
    best = (out_file or Path("next.csv")).with_stem("best")
    return shlex.join(map(str, [*words, "--out", best]))


def new_plant_file(recipe: Numbers) -> str:
    """A name for a plant file that is fitted to the trials of a campaign: axis-2.toml."""
    file = recipe.get("file")
    given = Path(str(file.get("given"))) if isinstance(file, dict) else Path("axis.toml")
    found = _LAST_NUMBER.match(given.stem)
    numbered = found is not None and found[1].endswith("-") and not found[3]
    stem = f"{found[1]}{int(found[2]) + 1}" if found and numbered else f"{given.stem}-2"
    return shlex.quote(str(given.with_name(f"{stem}.toml")))


def coming(
    live: list[Manifest],
    predicted: tuple[Prediction | None, Expected | None],
    trial: int,
    unit: str,
) -> str:
    """A sentence on what is predicted for the next trial, empty without a band."""
    from ..hardware.prediction import next_step

    (prediction, expected), step = predicted, next_step(live) if live else 1
    if expected is not None:
        band = _band(expected, 0, unit)
    elif prediction is None or prediction.certain or not 1 <= step <= prediction.trials:
        return ""
    else:
        band = _band(prediction, step - 1, unit)
    return f"trial {trial} is predicted to have {band}"


def _band(of: Prediction | Expected, at: int, unit: str) -> str:
    low, _, high = (float(end[at]) for end in of.rms)
    return f"an RMS error of {low:.3g} to {high:.3g} {unit}".rstrip()


def verdict(
    live: list[Manifest],
    turn: Turn | None,
    prediction: Prediction | None,
    unit: str,
    growth: float = 0.02,
    trials_of_step: int = 1,
    stop: float | None = None,
    state: Path = Path("STATE"),
    out_file: Path | None = None,
) -> list[str]:
    """One or two sentences on what the campaign has reached since its machine was last another.

    live: manifests that count;  turn: the trial of this call, which may not be among them
    growth: see `Rules`
    trials_of_step: number of trials of a step, of which the first alone plays what was learned
    stop: RMS error below which nothing shows that there is more to learn; None: it is not known
    state, out_file: folder of the campaign and file with the next input, for a command to type
    """
    from ..hardware.checks import growth_accepted
    from ..hardware.journal import METRICS, is_part

    trials = live[1:]
    if turn is not None and (not trials or trials[-1]["trial"] < turn.trial):
        trials.append({**turn._asdict(), METRICS: turn.metrics})
    if not trials:
        if prediction is None or prediction.certain:
            return ["no trial is measured yet"]
        last = prediction.trials - (prediction.trials - 1) % trials_of_step
        of_last = f"{_band(prediction, last - 1, unit)} for trial {last}"
        return [f"no trial is measured yet; the plant file predicts {of_last}"]
    last = trials[-1]["trial"]
    learned = list(accumulate((bool(m["learned"]) for m in trials[:-1]), initial=0))
    changed = growth_accepted([*live[:1], *trials])
    errors, of_inputs = [], dict[int, float]()  # the first error with each input that was learned
    for m, taught in zip(trials, learned, strict=True):
        if taught % trials_of_step == 0 and not is_part(m):
            errors.append((m["trial"], m[METRICS]["error"]))
            if m["trial"] >= changed:
                of_inputs.setdefault(taught, errors[-1][1])
    if not errors:
        return [f"verdict: trial {last} ended early; no whole trial is measured yet"]
    (first, begun), (trial, error) = errors[0], errors[-1]
    if trial != last:
        said = f"verdict: trial {last} ended early, so its error is that of a part"
        if experiment := learned[-1] % trials_of_step:
            said = (
                f"verdict: trial {last} is experiment {experiment} between two learning steps, "
                "whose error says nothing of them"
            )
        return [f"{said}; trial {trial} had an RMS error of {error:.4g} {unit}".rstrip()]
    best, least = min((one for one in errors if one[0] >= changed), key=lambda one: one[1])
    said = f"verdict: trial {trial} has an RMS error of {error:.4g} {unit}".rstrip()
    if len(errors) > 1 and begun:
        times = error / begun
        share = f"{times:.2%} of" if times > 0.01 else f"{100 * times:.2g}% of"
        said += f", {f'{times:.3g} times' if times > 1 else share} that of trial {first}"
    ended = f"learning has ended, and the input of trial {best} may be played from now on: "
    ended += back_to(state, best, out_file)
    if stop is not None and error <= stop:
        below = f"{stop:.3g} {unit}".rstrip()
        return [f"{said}; what is new in each trial explains all of it (below {below}): {ended}"]
    if error > (1 + growth) * least:
        return [f"{said}; the best was trial {best} with {least:.4g} {unit}".rstrip()]
    least_so_far = [*accumulate(of_inputs.values(), min)]
    before = zip(least_so_far, least_so_far[PATIENCE:], strict=False)
    fell = [after <= (1 - LITTLE) * of for of, after in before]
    if any(fell) and not fell[-1]:
        return [f"{said}; it has not fallen by {LITTLE:.0%} in the last {PATIENCE} trials: {ended}"]
    if fell and not fell[-1]:
        said += f"; it has not fallen by {LITTLE:.0%} in any {PATIENCE} trials: learning is slow, "
        said += "or has nothing left to learn"
    return [said]


def next_command(
    state: Path,
    trial: int,
    measured: Path | None,
    out_file: Path | None,
    columns: Mapping[str, str] | None = None,
) -> str:
    """What to play and record next, and the command that takes it, by names like those of now."""
    played = out_file or Path("next.csv")
    record = Path(f"trial-{trial}.csv") if measured is None else _with_number(measured, trial)
    after = _numbered_on(played, trial)
    words = ["jaxilc", "next", "--state", state, "--measured", record]
    for option, name in (columns or {}).items():
        *set_, option = option.split()
        words += [*set_, f"{option}={name}"]
    command = shlex.join(map(str, [*words, "--out", after]))
    return f"play {played}, record it, then: {command}"


def _with_number(path: Path, trial: int) -> Path:
    """The name of the record of a trial after that of another one: trial-3.csv, trial-4.csv."""
    found = _LAST_NUMBER.match(path.stem)
    stem = f"{found[1]}{trial}{found[3]}" if found else f"{path.stem}-{trial}"
    return path.with_name(stem + path.suffix)


def _numbered_on(path: Path, trial: int) -> Path:
    """The name of the file with the next input; its number goes on if it is that of the trial.

    A number that belongs to a word, as in axis1.csv, is none of a trial.
    """
    found = _LAST_NUMBER.match(path.stem)
    apart = found is not None and found[1][-1:] in ("-", "_", "")
    if found is None or not apart or int(found[2]) != trial:
        return path
    return path.with_name(f"{found[1]}{trial + 1}{found[3]}{path.suffix}")


def _place(
    prediction: Prediction,
    step: int,
    metrics: Manifest,
    expected: Expected | None,
    stored: Manifest | None = None,
) -> Place | None:
    """Where a trial lies on what the trials before it expected, or else the plant file."""
    from ..hardware.prediction import place_of

    errors = metrics["error"], max(metrics.get("max_error") or [0.0])
    if expected is not None:
        return expected.place(*errors)
    return place_of(prediction, step, *errors, stored)


def _range(place: Place, unit: str) -> str:
    rms, most = (" to ".join(f"{end:.3g}" for end in band) for band in (place.rms, place.largest))
    return f"RMS error {rms} {unit}".rstrip() + f", largest {most} {unit}".rstrip()


# `jaxilc next`
# --------------------------------------------------------------------------------------------------


SETTINGS = "--set campaign.NAME=VALUE sets how a campaign is checked, by NAME: " + "; ".join(
    f"{name}: {meaning}" for name, (_, meaning) in OF_CAMPAIGN.items()
)  # below the options of `jaxilc next --help`


class Refused(ValueError):
    """The checks refuse a measured trial, or the next input that follows from it."""


def next_(
    context: Context,
    state: Path,
    pages: Pages,
    measured: Path | None = None,
    time: str = "t",
    input: str = "u",
    output: str = "y",
    out_file: Annotated[Path | None, Option("--out")] = None,
    scenario: Annotated[str | None, Option(autocompletion=scenarios_from)] = None,
    scheme: OneScheme = None,
    params: Path | None = None,
    set_: list[str] | None = None,
    no_learn: bool = False,
    undo: int | None = None,
    dry_run: bool = False,
    plot: Plot = None,
) -> None:
    """From a trial measured on a real machine to the input of the next one.

    The first call, without --measured, starts the campaign; a later one without
    it writes the next input once more. What the machine plays: `u` is its whole
    input, `feedforward` is added to its feedback, `reference` takes the place of
    the task's.

    state: Folder of the campaign.
    measured TRIAL: Measured trial, .csv or .mat; none starts a campaign.
    out_file NEXT: What the machine plays next: .csv, .mat or .h (C).
    scenario NAME|FILE: Scenario or plant file to start from.
    scheme: Scheme; not needed where only one learns.
    no_learn: Look at the trial only; the same schedule is played again.
    undo J: Go back to what was known after trial J, 0 for the start.
    dry_run: Check and report; write nothing.
    plot FIGURE: Plot errors, prediction and the last trial to this file.

    Example: jaxilc next --state x-axis --measured trial-3.csv --out trial-4.csv
    """
    from ..hardware.campaign import AGAIN, refuse
    from ..hardware.checks import beyond_limits, too_fast
    from ..hardware.trial_files import OPTIONS, read_measured
    from ..scenarios.campaigns import Given, open_campaign
    from ..storage.files import only_one

    if (page := pages.file(".html")) is not None:
        raise ValueError(
            f"--report {page} is a page, which `jaxilc trials` writes; allowed here is .json"
        )
    begin()
    settings, of = _of_campaign(settings_of(set_ or ()))
    names = {"t": time, "u": input, "y": output, "r": of.get("reference", "r")}
    columns = {OPTIONS[signal]: name for signal, name in names.items() if name != signal}
    headings, accept = (
        [name for name in names_in(of.get(key)) if name] for key in ("columns", "accept")
    )
    if headings:
        columns["--set campaign.columns"] = of["columns"]
    new = _starts(state, measured, undo, out_file, of.get("number", "double"), dry_run)
    rules = {name: of.get(name) for name in ("limit", "saturation", "repeatability", "growth")}
    given = Given(
        scenario=scenario, scheme=scheme, params=params, settings=settings,
        predict=of.get("predict"), rules={"correction": of.get("largest_correction"), **rules},
        accept_saturation=of.get("accept_saturation", False),
        stop_on_growth=of.get("stop_on_growth", False),
        accept=tuple(accept),
    )  # fmt: skip
    if not (new or dry_run):  # to the end, so that what is written belongs to the last entry
        context.with_resource(only_one(state, AGAIN))
    opened = open_campaign(state, given, new=new, dry_run=dry_run)
    now = opened.campaign
    if not (new or now.journal.bound or dry_run or undo is not None):
        _bind(now.journal)
    said, changed = _say_source(opened.recipe)
    source = [*said, changed] if changed else said
    if not new:
        _say_otherwise(now.journal)
    schedules = now.first_schedules() if new else now.schedules(undo)
    trial = 1 if new else (now.trials if undo is None else undo) + 1
    if measured is None and not new:
        refuse(beyond_limits(schedules, now.task, now.actuator, now.rules))
        if undo is None:
            _say_not_kept(opened)
    if measured is None:
        for kind, text in too_fast(schedules, now.task, now.actuator):
            warn(f"{kind}: {text}")
    if undo is not None and (doubt := now.doubt(undo)):
        warn(f"warning: {doubt}")
    if undo is not None and not dry_run:
        now.undo(undo, alone=True)
    turn, place, prediction, expected = None, None, None, None
    if measured is not None:
        short = of.get("short_trial", False)
        recordable = now.recordable()
        record = read_measured(measured, now.task, recordable, names, headings, short=short)
        prediction = _predicted(opened, compute=True, store=not dry_run)
        replayed = of.get("replayed_input", False)
        how = {"learn": not no_learn, "replay_input": replayed}
        turn, place = _turn(opened, record, prediction, out_file, **how)
        if not dry_run:
            now.keep(turn, alone=True)
        schedules, trial = turn.schedules, turn.trial + 1
    _played(None if dry_run else out_file, schedules, now.task, trial, of.get("number", "double"))
    if not dry_run and (measured is None or prediction is not None):
        # Of the next trial; a stop while it is simulated loses nothing, all is written by now.
        prediction = _predicted(opened, compute=new or measured is not None, store=True)
        expected = _expected(opened, prediction)
    files = measured, out_file, plot, pages.file(".json")
    told = turn, place, (prediction, expected)
    _close(opened, *told, source, trial, files, columns, dry_run=dry_run, undo=undo)


def _of_campaign(settings: dict[str, str]) -> tuple[dict[str, str], Numbers]:
    """The settings of the scenario, and those of `campaign.`, which must be known."""
    found: Numbers = {}
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
    from ..hardware.controller_files import check_format
    from ..hardware.journal import Journal

    if out_file is not None:
        check_format(out_file, number)
    elif not dry_run:
        raise ValueError("--out is missing; without it, only --dry-run")
    if measured is not None and undo is not None:
        raise ValueError("--measured and --undo exclude each other: undo first, then measure again")
    if measured and out_file and measured.resolve() == out_file.resolve():
        raise ValueError(f"--out {out_file} is the record of --measured; choose another file")
    new = not Journal(state).exists
    if new and (measured is not None or undo is not None):
        raise FileNotFoundError(
            f"{state} holds no campaign; start one without --measured and --undo"
        )
    return new


def _bind(journal: Journal) -> None:
    """Bind the entries of a campaign of before, and say so; one without its head stays as it is."""
    live = journal.live()  # raises where entries have been bound before
    journal.bind()
    if "files" not in live[0]:  # else the first call was stopped just before it wrote the head
        say(
            f"note: nothing said which entries belong to {journal.path}, which is older than that; "
            "those that are there do from now on"
        )


def _say_source(recipe: Mapping[str, Value]) -> tuple[list[str], str]:
    """Print and return the sentences on what a campaign belongs to, and on what has changed."""
    from ..scenarios.campaign_source import said_of_change, said_of_source

    said, changed = said_of_source(recipe), said_of_change(recipe, UNCHANGED)
    for line in said:
        say(line)
    if changed:
        warn(f"warning: {changed}")
    return said, changed


def _say_otherwise(journal: Journal) -> None:
    """Warn where this call computes in another precision than the last, or in other versions."""
    from ..runtime.provenance import differences, environment

    lines = differences(journal.last_known().get("environment", {}), environment())
    if told := [line for line in lines if line.startswith(("precision", "versions"))]:
        warn(f"warning: this call computes otherwise than the last of {journal.path}: "
             f"{'; '.join(told)}")  # fmt: skip


def _say_not_kept(opened: Opened) -> None:
    """Tell which options of a call without a trial are forgotten after it: it stores nothing."""
    from ..runtime.provenance import differences

    before, given = opened.campaign.journal.last_known()["recipe"], dict[str, None]()
    for line in differences(before, opened.recipe):
        name = line.partition(": ")[0]
        owner, _, rest = name.partition(".")
        if owner == "rules":
            rest = "largest_correction" if rest == "correction" else rest
            given[f"--set campaign.{rest}"] = None
        elif owner in ("settings", "predict"):
            given[f"--set {rest or 'campaign.predict'}"] = None
        elif owner != "stop" and rest != "given":  # which only spells the path of one file
            options = {"scheme": "--scheme", "parameters": "--params"}
            given[options.get(owner, "--scenario")] = None
    if given:
        warn(
            f"warning: only a trial or --undo stores {', '.join(given)}, and this call has none: "
            "give it again with --measured"
        )


def _predicted(opened: Opened, *, compute: bool, store: bool) -> Prediction | None:
    """The prediction of the campaign, kept or computed; where there can be none, says why."""
    from ..hardware.prediction import kept, key_of, next_step, of_campaign

    if not opened.recipe.get("predict", True):
        return None
    journal, configuration = opened.campaign.journal, opened.campaign.configuration_hash
    if not compute:
        return kept(journal.path, configuration, key_of(opened.subject))
    try:
        return of_campaign(
            journal.path, opened.subject, next_step(journal.live()),
            expected=opened.scenario.trials, configuration=configuration, store=store,
        )  # fmt: skip
    except ValueError as error:
        say(f"note: nothing is predicted: {error}")
        return None


def _expected(opened: Opened, prediction: Prediction | None) -> Expected | None:
    """What the campaign expects of its next trial, None where nothing is predicted."""
    try:
        return None if prediction is None else opened.campaign.expected(opened.subject.machine)
    except ValueError as error:  # a trial is damaged, which a later one need not be compared with
        say(f"note: nothing is predicted by the trials so far: {error}")
        return None


def _turn(
    opened: Opened, record, prediction: Prediction | None, out_file: Path | None, **how
) -> tuple[Turn, Place | None]:
    """The turn that a measured trial makes, and where it lies on what was expected of it.

    A trial that ended early lies nowhere on it, since its error is that of a part. The findings are
    printed. Raises Refused where the checks refuse the trial.
    """
    from ..hardware.campaign import refuse
    from ..hardware.prediction import next_step
    from ..scenarios.campaigns import need_recorded

    now = opened.campaign
    if how.get("learn", True):
        need_recorded(opened.scenario.machine, now, record)
    turn = now.turn(record, **how, expected=_expected(opened, prediction))
    place = None
    if prediction is not None and turn.record.weight is None:
        step = next_step(now.journal.live())
        place = _place(prediction, step, turn.metrics, turn.expected)
        if turn.expected is None and place is not None and place.level == "clear":
            turn.findings.extend(now.of_other_sign(turn.record, opened.subject.machine))
        turn = turn._replace(predicted=prediction.at(step))
    predicted, finding = against_prediction(now, turn, prediction, place)
    turn.findings.extend(finding)
    largest = ", ".join(f"{value:.6g}" for value in turn.metrics["max_error"])
    unit = now.task.unit
    rms = f"RMS error {turn.metrics['error']:.6g} {unit}".rstrip()
    say(f"trial {turn.trial}: {rms}, largest {largest} {unit}".rstrip())
    if predicted:
        say(predicted)
    if record.ignored:
        say(f"not used: {', '.join(record.ignored)}")
    for kind, text in turn.findings:
        if kind != "refusal":
            (warn if kind == "warning" else say)(f"{kind}: {text}")
    try:
        refuse(turn.findings)
    except ValueError as error:
        back = step_back(now, out_file)
        raise Refused(f"{error}. Nothing was learned or written{back}") from None
    return turn, place


def _played(path: Path | None, schedules, task, trial: int, number: str) -> None:
    """Print the next schedules of the machine, and write them to the path, if it is not None."""
    import numpy as np

    from ..hardware.controller_files import write_schedules
    from ..learning.playback import unit_of

    peaks = ", ".join(
        f"{name} up to {np.max(np.abs(schedule)):.6g} {unit_of(name, task)}".strip()
        for name, schedule in schedules.items()
    )
    say(f"next: trial {trial}, {peaks}")
    if path is None:
        say("dry run: nothing was written")
        return
    try:
        write_schedules(path, schedules, task, trial=trial, number=number)
    except OSError as error:
        then = "the campaign is stored; a call without --measured and --undo writes this file, or "
        then += "that of another --out"
        raise OSError(error.errno, f"{error.strerror}; {then}", str(path)) from None
    say(f"written: {path}")


def _close(
    opened: Opened,
    turn: Turn | None,
    place: Place | None,
    predicted: tuple[Prediction | None, Expected | None],
    source: list[str],
    trial: int,
    files: tuple[Path | None, Path | None, Path | None, Path | None],
    columns: dict[str, str],
    *,
    dry_run: bool,
    undo: int | None,
) -> None:
    """Print the verdict and the next command; write the figure and the numbers, if asked for.

    An undo in a dry run is judged by the trials that would be left, which can be read.
    """
    from ..scenarios.campaign_source import belongs_to, for_verdict
    from ..schemes.scheme import trials_of_step

    measured, out_file, plot, json_file = files
    prediction = predicted[0]
    now, journal = opened.campaign, opened.campaign.journal
    if dry_run and undo is not None:
        live = [m for m in journal.behind() if m["trial"] <= undo]
    else:
        live = journal.live() if journal.exists else []
    unit = now.task.unit
    by = for_verdict(opened.recipe, trials_of_step(now.scheme, now.task))
    said = verdict(live, turn, prediction, unit, **by, state=journal.path, out_file=out_file)
    if dry_run:  # a file of that name may hold the input of an earlier trial
        how = "without" if out_file else "with --out NEXT in place of"
        following = f"{how} --dry-run, the same call writes the input of trial {trial}"
    else:
        following = next_command(journal.path, trial, measured, out_file, columns)
    step = "" if dry_run else coming(live, predicted, trial, unit)
    for line in (*([step] if step else []), *said, following):
        say(line)
    numbers: Numbers = {
        "source": belongs_to(opened.recipe),
        "said": source,
        "next_trial": trial,
        "verdict": said,
        "next": following,
    }
    if turn is not None:
        findings = [one._asdict() for one in turn.findings]
        numbers |= {"trial": turn.trial, "metrics": turn.metrics, "findings": findings}
    if place is not None:
        numbers["predicted"] = place._asdict()
    paths = stored(None if dry_run else json_file, numbers)
    if plot is not None and live and not dry_run:
        figure = _figure(journal, journal.log(), live, predicted)
        paths = [_save(figure, plot, now, live), *paths]
    written(paths)
