"""`jaxilc identify`: a plant from a recorded experiment."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from .completion import of_list
from .console import out
from .options import DESIGN, Json, Report, file_to_write, folder_to_write
from .results import folder_of, written

NOT_WHITE = (
    "the residual is not white: another structure may fit better, and the intervals are too narrow"
)
NO_LAW = (
    "no filtered P-type law was found that learns on the fitted plant; the plant file has no scheme"
)


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
            metavar="[RECORD]", help="Text file of columns with a header: time, input, output."
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
    auto: Annotated[
        bool, typer.Option("--auto", help="Choose poles, pairs and zeros by a table of orders.")
    ] = False,
    time_name: Annotated[str, typer.Option("--time", help="Column of the time.")] = "t",
    time_unit: Annotated[
        str | None,
        typer.Option(
            help="s, ms or us; from the heading if not given.",
            autocompletion=of_list("s", "ms", "us"),
        ),
    ] = None,
    input_name: Annotated[str, typer.Option("--input", help="Column of the input.")] = "u",
    output_name: Annotated[str, typer.Option("--output", help="Column of the output.")] = "y",
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
) -> None:
    """A plant from a recorded experiment: parameters with 95 % intervals, fit, validation figure.

    With --out axis.toml it also writes a plant file that every other command takes.
    With --state the record is what a campaign of `jaxilc next` has measured; the plant
    file is then that of the campaign, with the fitted plant in it.

    Example: jaxilc identify record.csv --poles 1 --pairs 1 --zeros 1 --out axis.toml
    """
    given = {"poles": poles, "pairs": pairs, "zeros": zeros}
    for name, value in given.items():
        if auto and value is not None:
            raise ValueError(f"--{name} {value} is not allowed with --auto, which chooses it")
    structure: dict[str, Any] = {
        name: 1 if value is None else value for name, value in given.items()
    }
    plant_file = out_dir if _is_plant_file(out_dir) else None
    if plant_file is not None and plant_file.exists() and not force:
        raise FileExistsError(f"{plant_file} exists already; add --force to replace it")
    if state is not None:
        from .reidentify import reidentify

        if record is not None:
            raise ValueError("RECORD and --state exclude each other")
        reidentify(state, given, auto, out_dir, json_file, report, not_white=NOT_WHITE)
        return
    if record is None:
        raise ValueError("RECORD is missing; give a file, or --state and the folder of a campaign")
    from .asked import begin

    begin("float64")
    from .. import figures, identification
    from ..figures.report import command_report
    from ..identification.records import column_units, read_record
    from .tables import identification_table, orders_table

    measured = read_record(
        record, time=time_name, input=input_name, output=output_name, time_unit=time_unit
    )
    tables = []
    if auto:
        orders = identification.compare_orders(measured)
        best = identification.best_order(orders)
        structure = {"poles": best.poles, "pairs": best.pairs, "zeros": best.zeros}
        tables.append(orders_table(orders, best))
        out.print(tables[0])
    found = identification.identify(measured, **structure)
    rows = found.summary()
    tables.append(identification_table(str(record), rows))
    lines = ([] if found.white else [NOT_WHITE]) + identification.not_significant(found)
    out.print(tables[-1])
    for line in lines:
        out.print(line, highlight=False)
    folder = folder_of(None if plant_file else out_dir, "identify")
    drawn = {
        "record.png": figures.record_figure(measured),
        "validation.png": figures.validation_figure(measured, found),
    }
    paths = [figures.save(axes, folder / name) for name, axes in drawn.items()]
    if plant_file is not None:
        units = column_units(record, input_name, output_name)
        paths += [_plant_file(plant_file, found, measured, str(record), units)]
    page = command_report(report, "identify", tables, paths, lines=lines, asked=structure)
    numbers = {name: {"value": value, "low": low, "high": high} for name, value, low, high in rows}
    sound = {"white": bool(found.white), "converged": bool(found.converged), **structure}
    written([*paths, *page], json_file, numbers | sound)


def _plant_file(path: Path, found, measured, source: str, units) -> Path:
    """Write the plant file, and print what its law was chosen for."""
    from ..scenarios.identified_file import write_plant_file

    path.parent.mkdir(parents=True, exist_ok=True)
    law = write_plant_file(path, found, measured, source=source, units=units, force=True)
    if law is None:
        line = NO_LAW
    else:
        line = (
            f"{path}: P-type learning with gamma_p = {law.gamma_p:g}, lead = {law.lead} and a "
            f"cutoff of {law.cutoff:g} Hz; sup |Q (1 - L P)| = {law.worst:.3f} at worst of "
            f"{law.machines} machines"
        )
    out.print(line, highlight=False, soft_wrap=True)
    return path
