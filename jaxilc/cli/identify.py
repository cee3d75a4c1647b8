"""`jaxilc identify`: a plant from a recorded experiment or a measured frequency response."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import typer

from .completion import of_list
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
    given = {"poles": poles, "pairs": pairs, "zeros": zeros}
    for name, value in given.items():
        if auto and value is not None:
            raise ValueError(f"--{name} {value} is not allowed with --auto, which chooses it")
    at_least(0, delay=delay)
    at_least(1, averages=averages)
    plant_file = out_dir if _is_plant_file(out_dir) else None
    if plant_file is not None and plant_file.exists() and not force:
        raise FileExistsError(f"{plant_file} exists already; add --force to replace it")
    if state is not None:
        from .reidentify import reidentify

        for_files = {"dt": dt, "resample": resample, "columns": columns, "averages": averages}
        wrong = [f"--{name}" for name, value in for_files.items() if value is not None]
        if record is not None or wrong:
            raise ValueError(f"{', '.join(wrong) or 'RECORD'} and --state exclude each other")
        reidentify(state, given, delay, auto, out_dir, json_file, report)
        return
    if record is None:
        raise ValueError("RECORD is missing; give a file, or --state and the folder of a campaign")
    from .asked import begin

    begin("float64")
    from .identified import Asked, of_record, of_response

    names = [name.strip() for name in columns.split(",")] if columns else []
    reading = {"time": time_name, "input": input_name, "output": output_name}
    asked = Asked(
        {} if auto else {name: 1 if value is None else value for name, value in given.items()},
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
    fitted = (of_response if is_response else of_record)(record, asked)
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
    from .live import of_fit, unexplored

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
        live=of_fit(report, fitted),
    )
    numbers = {
        name: {"value": value, "low": low, "high": high}
        for name, value, low, high in found.summary()
    }
    sound = {"white": bool(found.white), "converged": bool(found.converged), **fitted.structure}
    written([*paths, *page], json_file, numbers | sound, said)


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
