"""`jaxilc bench`: the speed of jaxilc compared with that of other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .completion import scenarios_from
from .console import err, out
from .options import SPEED, Json, Precision
from .results import written

CONTESTS, OF_SCENARIO = "1,16,1024", "64"  # numbers of plants where none are given


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command(rich_help_panel=SPEED)(bench)


def bench(
    plants: Annotated[
        str | None,
        typer.Option(
            help="Numbers of plants, with commas between them; "
            f"if not given, {CONTESTS}, or {OF_SCENARIO} of a scenario."
        ),
    ] = None,
    trials: Annotated[int, typer.Option(help="Trials J.")] = 80,
    samples: Annotated[int, typer.Option(help="Samples N of a trial.")] = 2000,
    schemes: Annotated[
        str, typer.Option(help="cfdl, ffdl, with opponents; noilc, ilc-asmc, alone; with commas.")
    ] = "cfdl,ffdl",
    gradients: Annotated[
        bool, typer.Option("--gradients/--no-gradients", help="Whether gradients are timed too.")
    ] = True,
    scenario: Annotated[
        list[str] | None,
        typer.Option(
            help="Time only the schemes of this scenario or file that learn, alone and in its own "
            "size; repeatable, or with commas.",
            autocompletion=scenarios_from,
        ),
    ] = None,
    long: Annotated[
        int,
        typer.Option(
            help="Samples of one long trial of one plant, by steps and in blocks; 0 for none."
        ),
    ] = 100_000,
    repeats: Annotated[int, typer.Option(help="Turns; contenders take turns.")] = 5,
    json_file: Json = None,
    precision: Precision = "float64",
) -> None:
    """Our speed beside NumPy, Numba, C, SciPy and python-control, for the same numbers.

    A gradient is that of a tuning; its time is given in runs without one. Opponents compute in
    float64, whatever the precision.

    Example: jaxilc bench --plants 1024 --json out/bench.json
    """
    from ..runtime.start import setup

    setup(precision=precision)
    from ..bench.programme import Programme, Show, measure
    from .asked import chosen_scenario
    from .bench_tables import alone_table, contest_table, cost_table
    from .verdicts.speed import bench_verdict

    names = _names(scenario or [])
    chosen = [chosen_scenario(name, None, None, None) for name in names]
    numbers = measure(
        Programme(
            _numbers(plants or (OF_SCENARIO if chosen else CONTESTS)),
            trials,
            samples,
            [name.strip() for name in schemes.split(",")],
            long,
            repeats,
            gradients,
            chosen,
        ),
        Show(
            note=lambda text: out.print(text, highlight=False),
            rows=lambda *shown: out.print(contest_table(*shown)),
            costs=lambda *shown: out.print(cost_table(*shown)),
            alone=lambda *shown: out.print(alone_table(*shown)),
            begins=_begins,
        ),
    )
    before, after = (numbers[name]["load"] for name in ("machine", "machine_after"))
    out.print(f"load of the machine: {before} before, {after} after", highlight=False)
    verdict = bench_verdict(numbers["rows"], names)
    written([], json_file, numbers, verdict)


def _begins(text: str) -> None:
    """Print on a terminal what is timed next."""
    if err.is_terminal and not out.quiet:
        err.print(f"{text} ...", style="dim", highlight=False)


def _names(given: list[str]) -> list[str]:
    """The names of scenarios in the values of an option; the name of a file may have commas."""
    names = []
    for text in given:
        names += [text] if Path(text).is_file() else [name.strip() for name in text.split(",")]
    return names


def _numbers(text: str) -> list[int]:
    """Whole numbers from a text such as `1,16`; raises ValueError for any other text."""
    try:
        numbers = [int(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if not numbers or min(numbers) < 1:
        raise ValueError(
            f"--plants {text!r} is not whole numbers from 1 on, with commas between them"
        )
    return numbers
