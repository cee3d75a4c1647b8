"""The command line that compares: `jaxilc certify` with theory, `jaxilc identify` with a record,
`jaxilc reproduce` with print.
"""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import Annotated

import typer

from .completion import scenarios_from
from .options import (
    Json,
    Params,
    Precision,
    Report,
    Sampling,
    ScenarioName,
    Schemes,
    Seed,
    Set,
    Spread,
    Trials,
    begin,
    chosen_scenario,
    err,
    folder_of,
    folder_to_write,
    out,
    progress_bar,
    spread_of,
    written,
)

NEEDED = 3  # trials for the premises of a bound, which are on increments between increments


def register(app: typer.Typer) -> None:
    """Add the commands to the command line."""
    app.command()(certify)
    app.command()(identify)
    app.command()(reproduce)


def certify(
    scenario: ScenarioName,
    scheme: Schemes = None,
    trials: Trials = None,
    samples: Annotated[int, typer.Option(help="Machines, the nominal one included.")] = 64,
    seed: Seed = 0,
    spread: Spread = None,
    sampling: Sampling = "monte-carlo",
    set_: Set = None,
    params: Params = None,
    out_dir: Annotated[
        Path | None,
        typer.Option(
            "--out",
            help="Folder for the figures; out/certify-SCENARIO if not given.",
            callback=folder_to_write,
        ),
    ] = None,
    json_file: Json = None,
    report: Report = None,
    precision: Precision = "float64",
) -> None:
    """What theory claims of each machine in the long run, and what it predicts of J trials, beside
    simulation; premises of the bounds.

    Example: jaxilc certify cao-2019 --scheme cfdl-mfailc --trials 200 --samples 256
    """
    begin(precision)
    from .. import figures
    from ..figures.report import command_report
    from ..schemes import FFDLMFAILC
    from ..theory import certify as of_machines
    from ..theory import premises
    from ..theory.bounds import need_room
    from ..uncertainty import draw
    from . import tables

    chosen = chosen_scenario(scenario, scheme, trials, set_, params)
    uncertainty = spread_of(chosen, spread)
    drawn = draw(chosen.machine, uncertainty, samples, seed=seed, sampling=sampling)
    learning = {name: s for name, s in chosen.schemes.items() if s.learns}
    if not learning:
        raise ValueError(
            f"certify: none of {', '.join(chosen.schemes)} learns; there is nothing to certify"
        )
    for name, one in learning.items():
        if not isinstance(one, FFDLMFAILC):
            continue
        need_room(chosen.task, chosen.trials)
        if chosen.trials < NEEDED:
            raise ValueError(
                f"--trials {chosen.trials} is outside its allowed range [{NEEDED}, inf) of {name}, whose bounds are checked"
            )
    paths, shown, numbers, lines = [], [], {}, []
    with progress_bar("scheme") as bar:
        schemes = bar.add_task("certify", total=len(learning), scheme="")
        for i, (name, one) in enumerate(learning.items()):
            bar.update(schemes, completed=i, scheme=name)
            start = time.perf_counter()
            common = (chosen.machine, one, chosen.task, chosen.trials, uncertainty, drawn)
            found = of_machines(*common)
            seconds = time.perf_counter() - start
            shares = premises(*common) if isinstance(one, FFDLMFAILC) else None
            numbers[name] = tables.certificate_figures(found, shares, seconds)
            shown += tables.certificate_tables(name, chosen.trials, numbers[name])
            lines.append(
                tables.certificate_sentence(
                    name, chosen.trials, numbers[name], chosen.shown_scale, chosen.shown_unit
                )
            )
            axes = figures.certificate(
                found, scale=chosen.shown_scale, unit=chosen.shown_unit, title=name
            )
            paths.append(
                figures.save(axes, folder_of(out_dir, f"certify-{chosen.name}") / f"{name}.png")
            )
        bar.update(schemes, completed=len(learning))
    for table in shown:
        out.print(table)
    for line in lines:
        out.print(line, highlight=False, markup=False, soft_wrap=True)
    asked = {"samples": samples, "seed": seed, "sampling": sampling}
    wide = dataclasses.replace(chosen, uncertainty=uncertainty)
    pictures = [
        (f"{name}: error by trial, predicted and simulated", path)
        for name, path in zip(learning, paths, strict=True)
    ]
    page = command_report(
        report, "certify", shown, pictures, scenario=wide, lines=lines, asked=asked
    )
    written(
        [*paths, *page],
        json_file,
        {"scenario": scenario, "trials": chosen.trials, "samples": samples, "schemes": numbers},
    )
    broken = [name for name, row in numbers.items() if row["contradicted"]]
    if broken:
        err.print(
            f"{', '.join(broken)}: simulation contradicts what was claimed: please report this",
            highlight=False,
        )
        raise typer.Exit(1)


def identify(
    record: Annotated[
        Path,
        typer.Argument(
            metavar="RECORD", help="Text file of columns with a header: time, input, output."
        ),
    ],
    poles: Annotated[int, typer.Option(help="Real poles.")] = 1,
    pairs: Annotated[int, typer.Option(help="Pairs of poles, real or complex.")] = 1,
    zeros: Annotated[int, typer.Option(help="Real zeros, of either sign.")] = 1,
    time_name: Annotated[str, typer.Option("--time", help="Column of the time [s].")] = "t",
    input_name: Annotated[str, typer.Option("--input", help="Column of the input.")] = "u",
    output_name: Annotated[str, typer.Option("--output", help="Column of the output.")] = "y",
    out_dir: Annotated[
        Path | None,
        typer.Option(
            "--out",
            help="Folder for the figures; out/identify if not given.",
            callback=folder_to_write,
        ),
    ] = None,
    json_file: Json = None,
    report: Report = None,
) -> None:
    """A plant from a recorded experiment: parameters with 95 % intervals, fit, validation figure.

    Example: jaxilc identify record.csv --poles 1 --pairs 1 --zeros 1
    """
    begin("float64")
    from .. import figures, identification
    from ..figures.report import command_report
    from ..identification.records import read_record
    from . import tables

    measured = read_record(record, time=time_name, input=input_name, output=output_name)
    found = identification.identify(measured, poles=poles, pairs=pairs, zeros=zeros)
    rows = found.summary()
    table = tables.identification_table(str(record), rows)
    lines = [
        "the residual is not white: another structure may fit better, and the intervals are too narrow"
    ] * (not found.white)
    out.print(table)
    for line in lines:
        out.print(line, highlight=False)
    folder = folder_of(out_dir, "identify")
    paths = [figures.save(figures.record_figure(measured), folder / "record.png")]
    paths.append(
        figures.save(figures.validation_figure(measured, found), folder / "validation.png")
    )
    numbers = {name: {"value": value, "low": low, "high": high} for name, value, low, high in rows}
    page = command_report(
        report,
        "identify",
        [table],
        paths,
        lines=lines,
        asked={"poles": poles, "pairs": pairs, "zeros": zeros},
    )
    written(
        [*paths, *page],
        json_file,
        numbers | {"white": bool(found.white), "converged": bool(found.converged)},
    )


def reproduce(
    scenario: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[SCENARIO]...",
            help="Scenarios; all if none is given.",
            autocompletion=scenarios_from,
        ),
    ] = None,
    json_file: Json = None,
    report: Report = None,
    precision: Precision = "float64",
) -> None:
    """Every published number beside ours: ratio, verdict, how the paper was read, what was fitted,
    why it is open.

    Example: jaxilc reproduce cao-2019 dai-2014 --json out/reproduce.json
    """
    begin(precision)
    from ..figures.report import command_report
    from ..scenarios import reproduction
    from . import tables

    numbers = [row.as_dict() for row in reproduction.reproduce(scenario or ())]
    table = tables.reproduction_table(numbers)
    out.print(table)
    written(command_report(report, "reproduce", [table]), json_file, numbers)
