"""`jaxilc trials`: the log of a campaign on a real machine, its figure, and its verdict.

The sentences on a campaign are those of `jaxilc next` too: the trial on its prediction, the
verdict, and what to do next.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..outcomes.table import Table
from ..outcomes.verdict import Verdict
from .console import err, out
from .groups import add
from .options import MACHINE, Pages, figure_to_write
from .present import written
from .start import begin

if TYPE_CHECKING:
    from ..figures.page import Live
    from ..hardware.calibration import Expected
    from ..hardware.campaign import Campaign, Turn
    from ..hardware.checks import Finding
    from ..hardware.journal import Journal
    from ..hardware.prediction import Place, Prediction

Folder = Annotated[Path, typer.Option("--state", help="Folder of the campaign.")]
Plot = Annotated[
    Path | None,
    typer.Option(
        "--plot",
        metavar="FIGURE",
        help="Plot errors, prediction and the last trial to this file.",
        callback=figure_to_write,
    ),
]
LITTLE = 0.02  # share by which the error falls at least in `PATIENCE` trials while it is learned
PATIENCE = 3
_LAST_NUMBER = re.compile(r"^(.*?)(\d+)(\D*)$")
UNCHANGED = (
    "while scheme, task and actuator are the same: learning goes on as before, and what is "
    "predicted follows the file as it is now"
)


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    add(app, trials, MACHINE)


def trials(
    state: Folder,
    pages: Pages,
    table: Annotated[Path | None, typer.Option("--csv", help="Write the log to this file.")] = None,
    plot: Plot = None,
) -> None:
    """The log of a campaign: every trial with its metrics, undone ones included.

    Example: jaxilc trials --state x-axis --csv log.csv --plot log.png
    """
    report = pages.page
    from ..figures.report import command_report
    from ..hardware.journal import Journal, units, write_log
    from ..scenarios.campaign_source import said_of_change, said_of_source

    journal = Journal(state)
    rows = journal.log()
    known = journal.last_known()
    recipe = known["recipe"] if "scenario" in known["recipe"] else {}
    live, prediction = _live(journal), _prediction(journal, known)
    log = _log_table(str(state), rows, _predicted(live, prediction))
    out.print(log)
    said = said_of_source(recipe) if recipe else []
    changed = said_of_change(recipe, UNCHANGED) if recipe else ""
    files = []
    if table is not None:
        files.append(write_log(table, rows))
    now = _opened(state) if live and (plot or report) else None
    if plot is not None:
        files.append(save_figure(plot, now, rows, live, (prediction, None), units(journal)))
    for line in said:
        out.print(line, highlight=False, soft_wrap=True)
    if changed:
        err.print(f"warning: {changed}", highlight=False, soft_wrap=True)
    unit = units(journal)[0]
    sentences = verdict(live, None, prediction, unit, 0.02) if live else []
    following = next_command(state, len(live) or 1, _last_file(live), None)
    for line in (*sentences, following) if live else ():
        out.print(line, highlight=False, soft_wrap=True)
    if report is not None:
        found = _verdict(sentences, following) if live else Verdict(())
        asked = {"campaign": "; ".join(said)} if said else {}
        shown = _explored(now, (rows, live, prediction), units(journal))
        files += command_report(report, "trials", [log], verdict=found, live=shown, asked=asked)
    numbers = {
        "source": source_numbers(recipe),
        "changed": changed,
        "trials": rows,
        "predicted": None if prediction is None else _as_numbers(live, prediction),
        "verdict": sentences,
        "next": following if live else "",
    }
    written(files, pages.numbers, numbers)


def _verdict(lines: list[str], following: str) -> Verdict:
    """The verdict on a campaign for its page, from the lines that are printed."""
    said = [line.removeprefix("verdict: ") for line in lines]
    what, _, command = following.partition(", then: ")
    return Verdict(tuple(line[:1].upper() + line[1:] for line in said), what, command)


def _explored(
    now: Campaign | None,
    found: tuple[list[dict[str, Any]], list[dict[str, Any]], Prediction | None],
    units: tuple[str, str],
) -> list[Live]:
    """The interactive figures of a campaign.

    now: the campaign; None: no trial is then shown in time
    found: rows of the journal, manifests that count, and what was predicted
    """
    from ..figures import browsers
    from ..figures.campaign import bands_by_trial, campaign_figure
    from ..figures.page import live as page_of
    from ..hardware.campaign import TRIAL

    rows, live, prediction = found
    bands = None if prediction is None or not live else bands_by_trial(live, prediction)
    shown = []
    if any(row["event"] == "trial" for row in rows):
        of = campaign_figure.described(rows, unit=units[0], input_unit=units[1], bands=bands)
        shown.append(page_of(of))
    if now is not None and len(live) > 1:
        measured = {m["trial"]: now.journal.arrays(m, TRIAL) for m in live[1:]}
        shown.append(browsers.measured_trials(now.task, measured))
    return shown


def _live(journal: Journal) -> list[dict[str, Any]]:
    """The manifests that count; none where the campaign must be taken back first."""
    try:
        return journal.live()
    except ValueError:
        return []


def _last_file(live: list[dict[str, Any]]) -> Path | None:
    return Path(live[-1]["source"]) if len(live) > 1 else None


def _prediction(journal: Journal, known: dict[str, Any]) -> Prediction | None:
    """The stored prediction of a campaign; nothing is computed here."""
    from ..hardware.prediction import kept

    return kept(journal.path, str(known.get("configuration_hash")))


def _opened(state: Path) -> Campaign | None:
    """The campaign with its task, None where its plant file does not give it any more."""
    from ..scenarios.campaigns import Given, open_campaign

    begin()
    try:
        return open_campaign(state, Given(), new=False).campaign
    except (ValueError, OSError) as error:
        err.print(f"warning: the figure has no reference: {error}", highlight=False, soft_wrap=True)
        return None


def save_figure(
    path: Path,
    now: Campaign | None,
    rows: list[dict[str, Any]],
    live: list[dict[str, Any]],
    predicted: tuple[Prediction | None, Expected | None],
    units: tuple[str, str] = ("", ""),
) -> Path:
    """Write the figure of a campaign, and return its file.

    now: the campaign; None: the figure then shows no trial in time
    live: manifests that count
    predicted: the prediction of the plant file, and what is expected of the next trial
    units: units of y and of u, for a campaign that is not given
    """
    from .. import figures
    from ..figures.campaign import LastTrial, bands_by_trial, campaign_figure
    from ..hardware.campaign import TRIAL

    last, unit, input_unit = None, *units
    if now is not None:
        task, unit, input_unit = now.task, now.task.unit, now.task.input_unit
        if len(live) > 1:
            signals = now.journal.arrays(live[-1], TRIAL)
            last = LastTrial(
                live[-1]["trial"], task.time, task.reference, signals["y"], signals["u"]
            )
    prediction, expected = predicted
    known = prediction is not None and live
    bands = bands_by_trial(live, prediction, expected) if known else None
    axes = campaign_figure(rows, unit=unit, input_unit=input_unit, bands=bands, last=last)
    return figures.save(axes, path)


def source_numbers(recipe: dict[str, Any]) -> dict[str, Any]:
    """What a campaign belongs to, for the file of the numbers."""
    from ..scenarios.campaign_source import belongs_to

    return belongs_to(recipe) if recipe else {}


def _places(live: list[dict[str, Any]], prediction: Prediction):
    """Each trial that counts with its place on what was expected, by the serial of its entry."""
    from ..hardware.calibration import kept
    from ..hardware.journal import METRICS
    from ..hardware.prediction import steps

    for manifest, step in zip(live[1:], steps(live), strict=True):
        yield manifest["serial"], _place(prediction, step, manifest[METRICS], kept(manifest))


def _as_numbers(live: list[dict[str, Any]], prediction: Prediction) -> dict[str, Any]:
    places = [
        {"serial": serial, **place._asdict()}
        for serial, place in _places(live, prediction)
        if place
    ]
    return {"machines": prediction.machines, **prediction.bands(), "trials": places}


def _predicted(live: list[dict[str, Any]], prediction: Prediction | None) -> dict[int, str]:
    """The predicted RMS error of each trial that counts, as text, by the serial of its entry."""
    if prediction is None:
        return {}
    marks = {"within": "", "slight": " (outside)", "clear": " (far outside)"}
    return {
        serial: f"{place.rms[0]:.3g} to {place.rms[1]:.3g}{marks[place.level]}"
        for serial, place in _places(live, prediction)
        if place and place.rms[0] < place.rms[1]
    }


def _log_table(title: str, rows: list[dict], predicted: dict[int, str]) -> Table:
    """A table with a row for each entry of the journal, and all channels of each metric.

    predicted: text on the predicted RMS error by the serial of an entry; without any, no column
    """
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
            str(row["serial"]),
            str(row["trial"]),
            f"{row['event']}{learned}{undone}",
            error,
            *([predicted.get(row["serial"], "")] if band else []),
            *metrics,
            str(row["source"]),
            row["warnings"],
        )
    return shown


# Sentences
# --------------------------------------------------------------------------------------------------


def against_prediction(
    now: Campaign, turn: Turn, prediction: Prediction | None
) -> tuple[str, list[Finding]]:
    """The sentence on what was predicted for a trial, and a finding where it lies outside.

    prediction: prediction of the campaign, None without one; both are then empty, as they are for a
        trial that ended early, whose error is that of a part
    """
    from ..hardware.checks import GROWN_BEYOND
    from ..hardware.prediction import next_step

    if prediction is None or turn.record.weight is not None:
        return "", []
    live, unit = now.journal.live(), now.task.unit
    place = _place(prediction, next_step(live), turn.metrics, turn.expected)
    if place is None:
        return "", []
    if turn.expected is None and prediction.certain:
        median = f"{_median(prediction, place):.3g} {unit}".strip()
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

    if turn.expected is not None:
        return _unexpected(now, turn, place)
    above, trial = place.distance > 0, turn.trial
    largest = place.error != "RMS error"
    error = max(turn.metrics["max_error"]) if largest else turn.metrics["error"]
    end = (place.largest if largest else place.rms)[above]
    side = f"{error / end:.3g} times the upper end of" if above else "below"
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
    state = shlex.quote(str(now.journal.path))
    what_next = "Re-identify" if not above else "Stop and look for the cause, or re-identify"
    return Finding(
        "warning",
        f"{text}. {what_next}: jaxilc identify --state {state} --out {new_plant_file(now.recipe)}",
    )


def _unexpected(now: Campaign, turn: Turn, place: Place) -> Finding:
    """The finding of a trial outside the band that the trials before gave."""
    from ..hardware.checks import Finding

    largest = place.error != "RMS error"
    error = max(turn.metrics["max_error"]) if largest else turn.metrics["error"]
    high = (place.largest if largest else place.rms)[1]
    side = f"{error / high:.3g} times the upper end of" if place.distance > 0 else "below"
    text = f"trial {turn.trial}: the {place.error} is {side} the band of the trials so far"
    if place.level == "slight":
        return Finding("note", f"{text}, as it is in one trial of ten; look at the next trials")
    changed = now.what_changed(turn.record, turn.expected)
    text += f"; suspected is {changed.text or 'a changed machine'}"
    state = shlex.quote(str(now.journal.path))
    fit = f"jaxilc identify --state {state} --out {new_plant_file(now.recipe)}"
    then = (changed.then or "look for the cause, or identify the plant again").capitalize()
    return Finding("warning", f"{text}. It is told once: the next band begins here. {then}: {fit}")


def step_back(now: Campaign) -> str:
    """How to play the best input so far again; an empty text before the first trial."""
    from ..hardware.checks import comparable

    errors = comparable(now.scheme, now.task, now.journal.live())
    if not errors:
        return ""
    best, least = min(errors, key=lambda one: one[1])
    words = ["jaxilc", "next", "--state", str(now.journal.path), "--undo", str(best - 1)]
    said = f"{least:.4g} {now.task.unit}".rstrip()
    return f"; back to the input of trial {best} ({said}): {shlex.join(words)} --out NEXT"


def new_plant_file(recipe: dict[str, Any]) -> str:
    """A name for a plant file that is fitted to the trials of a campaign: axis.toml, axis-2.toml.

    recipe: recipe of the campaign
    """
    file = recipe.get("file")
    given = Path(str(file.get("given"))) if isinstance(file, dict) else Path("axis.toml")
    found = _LAST_NUMBER.match(given.stem)
    numbered = found is not None and found[1].endswith("-") and not found[3]
    stem = f"{found[1]}{int(found[2]) + 1}" if found and numbered else f"{given.stem}-2"
    return shlex.quote(str(given.with_name(f"{stem}.toml")))


def coming(
    live: list[dict[str, Any]],
    predicted: tuple[Prediction | None, Expected | None],
    trial: int,
    unit: str,
) -> str:
    """A sentence on what is predicted for the next trial, empty without a band.

    predicted: the prediction of the plant file, and what the trials so far expect
    """
    from ..hardware.prediction import next_step

    (prediction, expected), step = predicted, next_step(live) if live else 1
    if expected is not None:
        low, _, high = (float(end[0]) for end in expected.rms)
    elif prediction is None or prediction.certain or step > prediction.trials:
        return ""
    else:
        low, _, high = (float(end[step - 1]) for end in prediction.rms)
    return f"trial {trial} is predicted to have an RMS error of {low:.3g} to {high:.3g} {unit}"


def verdict(
    live: list[dict[str, Any]],
    turn: Turn | None,
    prediction: Prediction | None,
    unit: str,
    growth: float,
    experiments: Sequence[int] = (),
    stop: float | None = None,
) -> list[str]:
    """One or two sentences on what the campaign has reached.

    live: manifests of the start and of the trials that count, see `Journal.live`
    turn: the trial of this call, None without one; it counts if it is not among the manifests
    growth: share by which an error may grow without a warning
    experiments: see `checks.experiment_numbers`; empty where no trial is an experiment
    stop: RMS error below which nothing shows that there is more to learn; None: it is not known
    """
    from ..hardware.journal import METRICS

    errors = [(m["trial"], m[METRICS]["error"]) for m in live[1:]]
    if turn is not None and (not errors or errors[-1][0] < turn.trial):
        errors.append((turn.trial, turn.metrics["error"]))
    if not errors:
        if prediction is None or prediction.certain:
            return ["no trial is measured yet"]
        low, _, high = (float(end[-1]) for end in prediction.rms)
        after = f"an RMS error of {low:.3g} to {high:.3g} {unit}".rstrip()
        last = prediction.trials
        return [f"no trial is measured yet; the plant file predicts {after} for trial {last}"]
    numbers, last = list(experiments)[: len(errors)] or [0] * len(errors), errors[-1][0]
    errors = [one for one, number in zip(errors, numbers, strict=True) if not number]
    (first, begun), (trial, error) = errors[0], errors[-1]
    if numbers[-1]:
        said = (
            f"verdict: trial {last} is experiment {numbers[-1]} between two learning steps, whose "
            f"error says nothing of them; trial {trial} had an RMS error of {error:.4g} {unit}"
        )
        return [said.rstrip()]
    best, least = min(errors, key=lambda one: one[1])
    said = f"verdict: trial {trial} has an RMS error of {error:.4g} {unit}".rstrip()
    if len(errors) > 1:
        said += f", {_share(error, begun)} of that of trial {first}"
    if stop is not None and error <= stop:
        return [
            f"{said}; what is new in each trial explains all of it (below {stop:.3g} {unit}), so "
            f"learning has ended: the input of trial {best} may be played from now on"
        ]
    if error > (1 + growth) * least:
        return [f"{said}; the best was trial {best} with {least:.4g} {unit}".rstrip()]
    before = [value for _, value in errors[:-PATIENCE]]
    if before and least > (1 - LITTLE) * min(before):
        return [
            f"{said}; it has not fallen by {LITTLE:.0%} in the last {PATIENCE} trials: learning "
            f"has ended, and the input of trial {best} may be played from now on"
        ]
    return [said]


def _share(error: float, begun: float) -> str:
    return f"{error / begun:.3g} times" if error > begun else f"{error / begun:.2%}"


def next_command(
    state: Path,
    trial: int,
    measured: Path | None,
    out_file: Path | None,
    columns: Mapping[str, str] | None = None,
) -> str:
    """What to do next: play, record, and the command that takes the record.

    trial: number of the next trial
    measured, out_file: files of this call; the names of the next ones follow them
    columns: options that name columns of the record, with their values
    """
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
    """The name of the file with the next input; its number goes on if it is that of the trial."""
    found = _LAST_NUMBER.match(path.stem)
    if found is None or int(found[2]) != trial:
        return path
    return path.with_name(f"{found[1]}{trial + 1}{found[3]}{path.suffix}")


def turn_numbers(
    live: list[dict[str, Any]], turn: Turn | None, prediction: Prediction | None
) -> dict[str, Any]:
    """The trial of a call and its prediction, for the file of the numbers."""
    from ..hardware.prediction import next_step

    if turn is None:
        return {}
    kept = live[:-1] if live and live[-1]["trial"] == turn.trial else live
    place = None
    if prediction is not None:
        place = _place(prediction, next_step(kept), turn.metrics, turn.expected)
    found: dict[str, Any] = {
        "trial": turn.trial,
        "metrics": turn.metrics,
        "findings": [f._asdict() for f in turn.findings],
    }
    return found if place is None else found | {"predicted": place._asdict()}


def _place(
    prediction: Prediction, step: int, metrics: dict[str, Any], expected: Expected | None
) -> Place | None:
    """Where a trial lies on what the trials before it expected, or else the plant file."""
    from ..hardware.prediction import place_of

    errors = metrics["error"], max(metrics.get("max_error") or [0.0])
    return place_of(prediction, step, *errors) if expected is None else expected.place(*errors)


def _median(prediction: Prediction, place: Place) -> float:
    return float(prediction.rms.median[place.step - 1])


def _range(place: Place, unit: str) -> str:
    rms, most = (" to ".join(f"{end:.3g}" for end in band) for band in (place.rms, place.largest))
    return f"RMS error {rms} {unit}".rstrip() + f", largest {most} {unit}".rstrip()
