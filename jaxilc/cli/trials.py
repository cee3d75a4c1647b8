"""`jaxilc trials`: the log of a campaign on a real machine, its figure, and its verdict."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from .campaign_options import Folder, Plot
from .console import err, out
from .options import MACHINE, FigureFormat, Json, Report
from .results import written
from .titled_table import Table
from .verdicts.next_command import Verdict

if TYPE_CHECKING:
    from ..figures.live_axes import Live
    from ..hardware.campaign import Campaign
    from ..hardware.journal import Journal
    from ..hardware.prediction import Prediction

UNCHANGED = (
    "while scheme, task and actuator are the same: learning goes on as before, and what is "
    "predicted follows the file as it is now"
)


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command(rich_help_panel=MACHINE)(trials)


def trials(
    state: Folder,
    table: Annotated[Path | None, typer.Option("--csv", help="Write the log to this file.")] = None,
    plot: Plot = None,
    figures: FigureFormat = None,
    json_file: Json = None,
    report: Report = None,
) -> None:
    """The log of a campaign: every trial with its metrics, undone ones included.

    Example: jaxilc trials --state x-axis --csv log.csv --plot log.png
    """
    from ..figures.report import command_report
    from ..hardware.journal import Journal
    from ..hardware.log_file import units, write_log
    from ..scenarios.campaign_source import said_of_change, said_of_source
    from . import campaign_lines

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
        files.append(save_figure(plot, now, rows, live, prediction, units(journal)))
    for line in said:
        out.print(line, highlight=False, soft_wrap=True)
    if changed:
        err.print(f"warning: {changed}", highlight=False, soft_wrap=True)
    unit = units(journal)[0]
    verdict = campaign_lines.verdict(live, None, prediction, unit, 0.02) if live else []
    following = campaign_lines.next_command(state, len(live) or 1, _last_file(live), None)
    for line in (*verdict, following) if live else ():
        out.print(line, highlight=False, soft_wrap=True)
    if report is not None:
        found = _verdict(verdict, following) if live else Verdict(())
        asked = {"campaign": "; ".join(said)} if said else {}
        shown = _explored(now, (rows, live, prediction), units(journal))
        files += command_report(report, "trials", [log], verdict=found, live=shown, asked=asked)
    numbers = {
        "source": source_numbers(recipe),
        "changed": changed,
        "trials": rows,
        "predicted": None if prediction is None else _as_numbers(live, prediction),
        "verdict": verdict,
        "next": following if live else "",
    }
    written(files, json_file, numbers)


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
    from ..figures import live_campaign
    from ..figures.campaign import bands_by_trial
    from ..hardware.campaign import TRIAL

    rows, live, prediction = found
    bands = None if prediction is None or not live else bands_by_trial(live, prediction)
    shown = []
    if any(row["event"] == "trial" for row in rows):
        shown.append(live_campaign.errors(rows, unit=units[0], bands=bands))
    if now is not None and len(live) > 1:
        measured = {m["trial"]: now.journal.arrays(m, TRIAL) for m in live[1:]}
        shown.append(live_campaign.signals(now.task, measured))
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
    from ..hardware.kept_prediction import kept

    return kept(journal.path, str(known.get("configuration_hash")))


def _opened(state: Path) -> Campaign | None:
    """The campaign with its task, None where its plant file does not give it any more."""
    from ..scenarios.campaigns import Given, open_campaign
    from .asked import begin

    begin("float64")
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
    prediction: Prediction | None,
    units: tuple[str, str] = ("", ""),
) -> Path:
    """Write the figure of a campaign, and return its file.

    now: the campaign; None: the figure then shows no trial in time
    live: manifests that count
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
    bands = None if prediction is None or not live else bands_by_trial(live, prediction)
    axes = campaign_figure(rows, unit=unit, input_unit=input_unit, bands=bands, last=last)
    return figures.save(axes, path)


def source_numbers(recipe: dict[str, Any]) -> dict[str, Any]:
    """What a campaign belongs to, for the file of `--json`."""
    from ..scenarios.campaign_source import belongs_to

    return belongs_to(recipe) if recipe else {}


def _places(live: list[dict[str, Any]], prediction: Prediction):
    """Each trial that counts with its place on the prediction, by the serial of its entry."""
    from ..hardware.journal import METRICS
    from ..hardware.prediction import place_of, steps

    for manifest, step in zip(live[1:], steps(live), strict=True):
        metrics = manifest[METRICS]
        largest = max(metrics.get("max_error") or [0.0])
        yield manifest["serial"], place_of(prediction, step, metrics["error"], largest)


def _as_numbers(live: list[dict[str, Any]], prediction: Prediction) -> dict[str, Any]:
    bands = {
        name: {end: values.tolist() for end, values in getattr(prediction, name)._asdict().items()}
        for name in ("rms", "largest")
    }
    places = [
        {"serial": serial, **place._asdict()}
        for serial, place in _places(live, prediction)
        if place
    ]
    return {"machines": prediction.machines, **bands, "trials": places}


def _predicted(live: list[dict[str, Any]], prediction: Prediction | None) -> dict[int, str]:
    """The predicted RMS error of each trial that counts, as text, by the serial of its entry."""
    if prediction is None or prediction.certain:
        return {}
    marks = {"within": "", "slight": " (outside)", "clear": " (far outside)"}
    return {
        serial: f"{place.rms[0]:.3g} to {place.rms[1]:.3g}{marks[place.level]}"
        for serial, place in _places(live, prediction)
        if place
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
