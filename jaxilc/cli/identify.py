"""`jaxilc identify`: a plant from a recorded experiment or a measured frequency response."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from .groups import add
from .options import (
    DESIGN,
    InputColumn,
    OutputColumn,
    Pages,
    TimeColumn,
    at_least,
    file_to_write,
    folder_to_write,
    left,
)
from .present import tell


def _place_to_write(param: typer.CallbackParam, path: Path | None) -> Path | None:
    """The path of a plant file, or of a folder, that can be written."""
    return (file_to_write if _is_plant_file(path) else folder_to_write)(param, path)


def _is_plant_file(path: Path | None) -> bool:
    return path is not None and path.suffix == ".toml"


def _count(zeros: str | None) -> int | str | None:
    """The number of zeros, or `any`."""
    if zeros is None or zeros == "any":
        return zeros
    if not zeros.isdecimal():
        raise ValueError(f"--zeros {zeros} is neither a whole number nor `any`")
    return int(zeros)


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    add(app, identify, DESIGN)


def identify(
    pages: Pages,
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
        str | None,
        typer.Option(
            metavar="N|any", help="Real zeros, or `any`, real and complex ones; 1 if not given."
        ),
    ] = None,
    delay: Annotated[
        int | None,
        typer.Option(help="Dead time in samples; chosen by --auto, fitted to a response, else 0."),
    ] = None,
    auto: Annotated[
        bool, typer.Option("--auto", help="Choose poles, zeros and delay: complex zeros, too.")
    ] = False,
    time_name: TimeColumn = "t",
    time_unit: Annotated[
        str | None, left("--time-unit", "the unit in the heading of the times does it")
    ] = None,
    input_name: InputColumn = "u",
    output_name: OutputColumn = "y",
    columns: Annotated[
        str | None,
        typer.Option(metavar="A,B,C", help="Names of the columns of a file without a header."),
    ] = None,
    dt: Annotated[
        float | None,
        typer.Option(
            help="Sample time in s: of a file without times, of a response's hold; new for others."
        ),
    ] = None,
    validate: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="A second record, of the same columns, which judges."),
    ] = None,
    resample: Annotated[float | None, left("--resample", "--dt DT does it")] = None,
    averages: Annotated[
        int | None,
        left("--averages", "reading={'averages': N} in Python, of jaxilc.outcomes, does it"),
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
) -> None:
    """A plant from a recorded experiment or a measured frequency response, with its reliability.

    A frequency response is known by its header: frequency, then re and im, or magnitude and phase,
    each with its unit, or complex text; std, variance or coherence if there is one.
    With --out axis.toml it also writes a plant file that every other command takes.
    With --state the record is what a campaign of `jaxilc next` has measured; the plant
    file is then that of the campaign, with the fitted plant in it.

    Example: jaxilc identify record.csv --auto --out axis.toml
    """
    counts = {"poles": poles, "pairs": pairs, "zeros": _count(zeros)}
    for name, value in counts.items():
        if auto and value is not None:
            raise ValueError(f"--{name} {value} is not allowed with --auto, which chooses it")
    at_least(0, delay=delay)
    at_least(1, averages=averages)
    plant_file = out_dir if _is_plant_file(out_dir) else None
    if plant_file is not None and plant_file.exists() and not force:
        raise FileExistsError(f"{plant_file} exists already; add --force to replace it")
    places: dict[str, Any] = {
        "plant_file": plant_file,
        "folder": None if plant_file is not None else out_dir,
    }
    if state is not None:
        if zeros == "any":
            raise ValueError("--zeros any is for a RECORD; with --state it is a number")
        for_files = {"dt": dt, "resample": resample, "columns": columns, "averages": averages}
        for_files["validate"] = validate
        wrong = [f"--{name}" for name, value in for_files.items() if value is not None]
        if record is not None or wrong:
            raise ValueError(f"{', '.join(wrong) or 'RECORD'} and --state exclude each other")
        how: dict[str, Any] = {"counts": counts, "delay": delay, "auto": auto}
        tell("identify_campaign", state, pages, **how, **places)
        return
    if record is None:
        raise ValueError("RECORD is missing; give a file, or --state and the folder of a campaign")
    reading = {
        "structure": {}
        if auto
        else {name: 1 if value is None else value for name, value in counts.items()},
        "delay": delay,
        "dt": dt,
        "averages": averages,
        "time": time_name,
        "input": input_name,
        "output": output_name,
        "time_unit": time_unit,
        "columns": [name.strip() for name in columns.split(",")] if columns else [],
        "resample": resample,
    }
    tell("identify", record, pages, reading=reading, validate=validate, **places)
