"""`jaxilc identify`: a plant from a recorded experiment or a measured frequency response."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from .completion import of_list
from .console import err, out
from .options import (
    DESIGN,
    FigureFormat,
    InputColumn,
    Json,
    OutputColumn,
    Report,
    TimeColumn,
    at_least,
    file_to_write,
    folder_to_write,
)
from .results import folder_of, written
from .verdicts.next_command import Verdict

if TYPE_CHECKING:
    from ..figures.page import Live

CLOSED = (
    "note: a loop was closed in these trials, so that the noise of the output is in the input; the "
    "intervals hold only if this noise is white"
)
ENOUGH = 90.0  # [%] of the output that a fit explains, from which on no other start is tried
NO_LAW = "No filtered P-type law was found that learns on the fitted plant: the file has no scheme."


def _place_to_write(path: Path | None) -> Path | None:
    """The path of a plant file, or of a folder, that can be written."""
    return file_to_write(path) if _is_plant_file(path) else folder_to_write(path)


def _is_plant_file(path: Path | None) -> bool:
    return path is not None and path.suffix == ".toml"


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command(rich_help_panel=DESIGN)(identify)


def identify(
    record: Annotated[
        Path | None,
        typer.Argument(
            metavar="RECORD",
            help="Columns of time, input, output; or of a frequency response; or a .mat file.",
        ),
    ] = None,
    state: Annotated[
        Path | None,
        typer.Option(
            "--state", help="Folder of a campaign, whose trials are the record, in place of one."
        ),
    ] = None,
    poles: Annotated[int | None, typer.Option(help="Real poles; 1 if not given.")] = None,
    pairs: Annotated[
        int | None, typer.Option(help="Pairs of poles, real or complex; 1 if not given.")
    ] = None,
    zeros: Annotated[
        int | None, typer.Option(help="Real zeros, of either sign; 1 if not given.")
    ] = None,
    delay: Annotated[
        int | None,
        typer.Option(help="Dead time in samples; chosen by --auto, fitted to a response, else 0."),
    ] = None,
    auto: Annotated[
        bool, typer.Option("--auto", help="Choose poles, pairs, zeros and delay by a table.")
    ] = False,
    time_name: TimeColumn = "t",
    time_unit: Annotated[
        str | None,
        typer.Option(
            help="s, ms or us; from the heading if not given.",
            autocompletion=of_list("s", "ms", "us"),
        ),
    ] = None,
    input_name: InputColumn = "u",
    output_name: OutputColumn = "y",
    columns: Annotated[
        str | None,
        typer.Option(metavar="A,B,C", help="Names of the columns of a file without a header."),
    ] = None,
    dt: Annotated[
        float | None,
        typer.Option(help="Sample time in s, of a file without times or of a response's hold."),
    ] = None,
    resample: Annotated[
        float | None, typer.Option(metavar="DT", help="New sample time in s, for uneven times.")
    ] = None,
    averages: Annotated[
        int | None, typer.Option(help="Averages of the coherence of a frequency response.")
    ] = None,
    out_dir: Annotated[
        Path | None,
        typer.Option(
            "--out",
            help="Plant file FILE.toml to write; or folder for figures, out/identify otherwise.",
            callback=_place_to_write,
        ),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace a plant file.")] = False,
    json_file: Json = None,
    report: Report = None,
    figures: FigureFormat = None,
) -> None:
    """A plant from a recorded experiment or a measured frequency response, with its reliability.

    A frequency response is known by its header: frequency, then re and im, or magnitude and phase,
    each with its unit, or complex text; std, variance or coherence if there is one.
    With --out axis.toml it also writes a plant file that every other command takes.
    With --state the record is what a campaign of `jaxilc next` has measured; the plant
    file is then that of the campaign, with the fitted plant in it.

    Example: jaxilc identify record.csv --auto --out axis.toml
    """
    counts = {"poles": poles, "pairs": pairs, "zeros": zeros}
    for name, value in counts.items():
        if auto and value is not None:
            raise ValueError(f"--{name} {value} is not allowed with --auto, which chooses it")
    at_least(0, delay=delay)
    at_least(1, averages=averages)
    plant_file = out_dir if _is_plant_file(out_dir) else None
    if plant_file is not None and plant_file.exists() and not force:
        raise FileExistsError(f"{plant_file} exists already; add --force to replace it")
    if state is not None:
        for_files = {"dt": dt, "resample": resample, "columns": columns, "averages": averages}
        wrong = [f"--{name}" for name, value in for_files.items() if value is not None]
        if record is not None or wrong:
            raise ValueError(f"{', '.join(wrong) or 'RECORD'} and --state exclude each other")
        _of_campaign(state, counts, delay, auto, out_dir, json_file, report)
        return
    if record is None:
        raise ValueError("RECORD is missing; give a file, or --state and the folder of a campaign")
    from .asked import begin

    begin("float64")
    names = [name.strip() for name in columns.split(",")] if columns else []
    reading = {"time": time_name, "input": input_name, "output": output_name}
    asked = Request(
        {} if auto else {name: 1 if value is None else value for name, value in counts.items()},
        delay,
        dt,
        averages,
        reading | {"time_unit": time_unit, "columns": names, "resample": resample},
    )
    is_response = _is_response(record, names)
    if is_response and plant_file is not None and dt is None:
        raise ValueError(
            "--out FILE.toml of a frequency response needs --dt, the sample time of its hold"
        )
    fitted = (_of_response if is_response else _of_record)(record, asked)
    _written(record, asked, fitted, plant_file, out_dir, json_file, report)


def _is_response(path: Path, names: list[str]) -> bool:
    """Whether the file is a frequency response, which its header tells."""
    from ..identification.frequency_response import is_frequency_response
    from ..identification.twincat import is_twincat

    if names or path.suffix.lower() == ".mat" or is_twincat(path):
        return False
    return is_frequency_response(path)


def _written(record: Path, asked, fitted, plant_file, out_dir, json_file, report) -> None:
    """Figures, plant file, numbers and report; the verdict and the next command are printed."""
    from .. import figures
    from ..figures.report import command_report
    from ..identification.sentences import verdict
    from .live import unexplored

    found = fitted.found
    folder = folder_of(None if plant_file else out_dir, "identify")
    paths = [figures.save(axes, folder / name) for name, axes in fitted.axes.items()]
    lines, has_law = verdict(found, fitted.dt), True
    if plant_file is not None:
        of_law, has_law = _plant_file(plant_file, fitted, str(record))
        lines.append(of_law)
        paths.append(plant_file)
    said = Verdict(tuple(lines), *_next(record, asked, fitted, plant_file, has_law))
    page = command_report(
        report,
        "identify",
        fitted.tables,
        unexplored(paths),
        verdict=said,
        asked=fitted.structure,
        live=_live(report, fitted.measured, found, fitted.dt, fitted.units),
    )
    numbers = {
        name: {"value": value, "low": low, "high": high}
        for name, value, low, high in found.summary()
    }
    sound = {"white": bool(found.white), "converged": bool(found.converged), **fitted.structure}
    written([*paths, *page], json_file, numbers | sound, said)


def _live(
    page: Path | None, measured, found, dt: float | None, units: tuple[str, str]
) -> list[Live | None]:
    """A record beside its model and the Bode diagram, or a response and the one fitted to it."""
    if page is None:
        return []
    from ..figures.experiments import response_figure, response_fit_figure, validation_figure
    from ..figures.page import live

    if found.of_response:
        return [live(response_fit_figure.described(measured, found))]
    by_name: dict[str, Any] = {"input_unit": units[0], "output_unit": units[1]}
    shown = [live(validation_figure.described(measured, found, unit=units[1], **by_name))]
    try:
        bode = None if dt is None else live(response_figure.described(found, dt, **by_name))
    except ValueError:  # it is no ProcessModel of one input and one output
        bode = None
    return [*shown, bode]


def _plant_file(path: Path, fitted, source: str) -> tuple[str, bool]:
    """Write the plant file; what its law was chosen for, and whether there is one."""
    from ..scenarios.identified_file import write_plant_file

    path.parent.mkdir(parents=True, exist_ok=True)
    law = write_plant_file(
        path,
        fitted.found,
        fitted.measured,
        dt=fitted.dt,
        source=source,
        units=fitted.units,
        force=True,
    )
    if law is None:
        return NO_LAW, False
    return (
        f"{path}: P-type learning with gamma_p = {law.gamma_p:g}, lead = {law.lead} and a cutoff "
        f"of {law.cutoff:g} Hz; sup |Q (1 - L P)| = {law.worst:.3f} at worst of {law.machines} "
        f"machines. `jaxilc run {path}` simulates it.",
        True,
    )


def _next(record: Path, asked, fitted, plant_file: Path | None, has_law: bool) -> tuple[str, str]:
    """What to do next, in words, and the command."""
    if plant_file is not None:
        what = "a law that is tuned and judged" if has_law else "a law for it"
        return what, f"jaxilc design {shlex.quote(str(plant_file))}"
    from ..identification.orders import not_significant

    found = fitted.found
    again = f"jaxilc identify {shlex.quote(str(record))}{asked.options()}"
    doubted = not (found.white and found.converged) or not_significant(found)
    if doubted and asked.structure:
        return "structures compared", f"{again} --auto"
    chosen = " ".join(f"--{name} {value}" for name, value in fitted.structure.items())
    sampled = " --dt DT" if found.of_response and asked.dt is None else ""
    what = "a plant file for all other commands"
    return what, f"{again} {chosen}{sampled} --out axis.toml"


# The fits to a file
# --------------------------------------------------------------------------------------------------


class Request(NamedTuple):
    """What was asked for.

    structure: poles, pairs and zeros; empty: chosen by a table
    delay: dead time in samples; None: chosen, or none
    dt: sample time [s]
    averages: number of averages of a coherence
    reading: further options of `read_record_file`
    """

    structure: dict[str, Any]
    delay: int | None
    dt: float | None
    averages: int | None
    reading: dict[str, Any]

    def options(self) -> str:
        """The options on reading as they are typed, each after a blank."""
        reading = self.reading
        usual = {"time": "t", "input": "u", "output": "y"}
        given = {name: of for name, of in reading.items() if of and of != usual.get(name)}
        given |= {"columns": ",".join(reading["columns"])} if reading["columns"] else {}
        given |= {"dt": self.dt, "averages": self.averages}
        return "".join(
            f" --{name.replace('_', '-')} {shlex.quote(format(of))}"
            for name, of in given.items()
            if of is not None
        )


class Fitted(NamedTuple):
    """What was found.

    measured: the record or the response
    found: the identification
    dt: sample time [s], None where it is not known
    tables: tables that were printed
    axes: figures by the name of their file
    units: units of input and output
    structure: the structure that was fitted, with the delay where it is whole
    """

    measured: Any
    found: Any
    dt: float | None
    tables: list
    axes: dict[str, Any]
    units: tuple[str, str]
    structure: dict[str, Any]


def _of_record(path: Path, asked: Request) -> Fitted:
    """The fit to a record, after the table of orders where the structure is to be chosen."""
    from .. import figures, identification
    from ..identification.record_files import read_record_file
    from ..identification.resampling import RESAMPLED
    from ..plants import ProcessModel
    from .tables import orders_table

    if asked.averages is not None:
        raise ValueError(f"--averages {asked.averages} is for a frequency response; {path} is none")
    read = read_record_file(path, dt=asked.dt, **asked.reading)
    if asked.reading["resample"] is not None:
        out.print(RESAMPLED.format(dt=asked.reading["resample"]), highlight=False)
    record, tables, structure, delay = read.record, [], asked.structure, asked.delay or 0
    if not structure:
        if asked.delay is None:
            orders = identification.orders_and_delays(record)
        else:
            orders = identification.compare_orders(record, delay=delay)
        best = identification.best_order(orders)
        structure, delay = _structure(best), best.delay
        tables.append(orders_table(orders, best, record.dt))
        out.print(tables[0])
    found = identification.identify(record, **structure, delay=delay)
    tables.append(_printed(str(path), found))
    units = (read.input_units[0], read.output_units[0])
    axes = {
        "record.png": figures.record_figure(record, input_unit=units[0], output_unit=units[1]),
        "validation.png": figures.validation_figure(
            record, found, output_unit=units[1], unit=units[1]
        ),
    }
    if isinstance(found.plant, ProcessModel) and found.plant.n_u == found.plant.n_y == 1:
        axes["response.png"] = figures.response_figure(
            found, record.dt, input_unit=units[0], output_unit=units[1]
        )
    structure = structure | {"delay": delay} if delay else structure
    return Fitted(record, found, record.dt, tables, axes, units, structure)


def _of_response(path: Path, asked: Request) -> Fitted:
    """The fit to a frequency response, after the table of orders as for a record."""
    from .. import figures, identification
    from .tables import orders_table

    for name, value in asked.reading.items():
        if name in ("time_unit", "columns", "resample") and value:
            option = name.replace("_", "-")
            raise ValueError(f"--{option} is for a record in time; {path} is a frequency response")
    if asked.delay is not None and asked.dt is None:
        raise ValueError(f"--delay {asked.delay} counts samples of a response: give --dt, too")
    measured = identification.read_frequency_response(path, averages=asked.averages)
    fixed = None if asked.delay is None else asked.delay * (asked.dt or 0.0)
    tables, structure = [], asked.structure
    if not structure:
        orders = identification.compare_response_orders(measured, dt=asked.dt, delay=fixed)
        best = identification.best_order(orders)
        structure = _structure(best)
        tables.append(orders_table(orders, best, asked.dt))
        out.print(tables[0])
    found = identification.identify_response(measured, **structure, dt=asked.dt, delay=fixed)
    tables.append(_printed(str(path), found))
    axes = {"response.png": figures.response_fit_figure(measured, found)}
    structure = structure if asked.delay is None else structure | {"delay": asked.delay}
    return Fitted(measured, found, asked.dt, tables, axes, ("", ""), structure)


def _structure(best) -> dict[str, Any]:
    return {"poles": best.poles, "pairs": best.pairs, "zeros": best.zeros}


def _printed(what: str, found):
    from .tables import identification_table

    table = identification_table(what, found.summary())
    out.print(table)
    return table


# The fit to the trials of a campaign
# --------------------------------------------------------------------------------------------------


def _of_campaign(
    state: Path,
    counts: dict[str, int | None],
    delay: int | None,
    auto: bool,
    out_dir: Path | None,
    json_file: Json,
    report: Report,
) -> None:
    """Fit a plant to the trials of a campaign, print it, and write it into a plant file.

    counts: numbers of poles, pairs and zeros; without any, those of the campaign's own plant
    delay: dead time in samples; None: that of the campaign's own plant
    auto: whether the structure is chosen by a table
    out_dir: plant file to write, or folder for figures
    """
    from .asked import begin

    begin("float64")
    from .. import figures, identification
    from ..figures.report import command_report
    from ..hardware.as_record import record_of
    from ..identification.sentences import NOT_WHITE, sentence
    from ..scenarios.campaigns import Given, open_campaign
    from .tables import orders_table

    opened = open_campaign(state, Given(), new=False)
    measured = record_of(opened.campaign, opened.scenario.machine)
    record, tables = measured.record, []
    numbers = ", ".join(map(str, measured.trials))
    source = f"{len(measured.trials)} of {measured.measured} trials of {state}: {numbers}"
    if auto:
        late = _delay_of(opened.scenario.machine.plant, record.dt) if delay is None else delay
        orders = identification.compare_orders(record, delay=late)
        best = identification.best_order(orders)
        found = best.found
        tables.append(orders_table(orders, best, record.dt))
        out.print(tables[0])
    else:
        found = _fitted(record, opened.scenario.machine.plant, counts, delay)
    tables.append(_printed(source, found))
    lines = [] if found.white else [NOT_WHITE]
    lines += map(sentence, identification.not_significant(found))
    lines += [CLOSED] * measured.closed
    unit = opened.campaign.task.unit
    lines.append(
        f"verdict: the plant of these trials explains {float(min(found.fit)):.4g} % of their "
        f"output; the residual is {float(max(found.residual_std)):.3g} {unit}".rstrip()
    )
    plant_file = out_dir if out_dir is not None and out_dir.suffix == ".toml" else None
    folder = folder_of(None if plant_file else out_dir, "identify")
    paths = [figures.save(figures.validation_figure(record, found), folder / "validation.png")]
    if plant_file is not None:
        paths.append(_write(plant_file, opened, found, source))
        lines.append(_after(plant_file, state, opened))
    for line in lines:
        out.print(line, highlight=False, soft_wrap=True)
    units = opened.campaign.task.input_unit, unit
    live = _live(report, record, found, record.dt, units)
    page = command_report(report, "identify", tables, (), lines=lines, asked=counts, live=live)
    rows = {n: {"value": v, "low": low, "high": high} for n, v, low, high in found.summary()}
    sound: dict[str, Any] = {"white": bool(found.white), "converged": bool(found.converged)}
    used = {"trials": list(measured.trials), "closed_loop": measured.closed, "verdict": lines}
    written([*paths, *page], json_file, rows | sound | used)


def _delay_of(plant, dt: float) -> int:
    """The dead time of a plant in whole samples; 0 of a plant that has none."""
    return round(getattr(plant, "delay", 0.0) / dt)


def _fitted(record, plant, counts: dict[str, int | None], delay: int | None):
    """The fit of the structure that was asked for, or else of that of the campaign's plant.

    A ProcessModel is fitted from its own values. Where the result explains little, the campaign's
    plant is no start, and many others are tried.
    """
    from .. import identification
    from ..plants import ProcessModel

    structure: dict[str, Any] = {
        name: 1 if value is None else value for name, value in counts.items()
    }
    own = delay is None and all(value is None for value in counts.values())
    if isinstance(plant, ProcessModel) and own:
        found = identification.identify(record, plant)
        if min(found.fit) >= ENOUGH:
            return found
        structure = {
            "poles": len(plant.poles),
            "pairs": len(plant.frequencies),
            "zeros": len(plant.zeros),
        }
    late = _delay_of(plant, record.dt) if delay is None else delay
    return identification.identify(record, **structure, delay=late)


def _write(path: Path, opened, found, source: str) -> Path:
    """Write the plant file of the campaign with the fitted plant, or a new one for a scenario."""
    from ..scenarios.identified_file import write_refitted

    recipe = opened.recipe
    own = Path(recipe["scenario"])
    if "file" not in recipe or own.suffix != ".toml":
        raise ValueError(
            f"the campaign belongs to {recipe['scenario']}, which is no plant file in TOML; the "
            "fitted plant is above, and --out FOLDER takes its figure"
        )
    noise = float(max(found.residual_std)) if found.white else None
    path.parent.mkdir(parents=True, exist_ok=True)
    return write_refitted(path, own, found, fitted_to=source, noise=noise)


def _after(path: Path, state: Path, opened) -> str:
    """What to do with the new plant file: whether the campaign can go on with it."""
    from ..scenarios.campaigns import Given, open_campaign

    file, folder = shlex.quote(str(path)), shlex.quote(str(state))
    try:
        open_campaign(state, Given(plant_file=path), new=False)
    except ValueError as error:
        err.print(f"warning: {error}", highlight=False, soft_wrap=True)
        name = shlex.quote(opened.recipe["scheme"])
        return (
            "next: the scheme of the new file is another one, so start a campaign with it: jaxilc "
            f"next --state FOLDER --plant-file {file} --scheme {name} --out next.csv"
        )
    return (
        f"next: go on with the new file: jaxilc next --state {folder} --plant-file {file} "
        "--measured TRIAL --out next.csv; its uncertainty is what is predicted from then on"
    )
