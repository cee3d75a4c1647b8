"""What the commands of the command line share: consoles, options, and how a scenario is asked for and results are left behind."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated, NoReturn

import typer
from rich.console import Console

PIPED_WIDTH = 160  # columns where there is no terminal to ask
out = Console(width=None if sys.stdout.isatty() else PIPED_WIDTH)
err = Console(stderr=True)

ScenarioName = Annotated[str, typer.Argument(metavar="SCENARIO", help="Of `jaxilc list`, or your own, a TOML or JSON file.")]
Schemes = Annotated[list[str] | None, typer.Option("--scheme", help="Scheme to use; repeatable. All if not given.")]
OneScheme = Annotated[str, typer.Option("--scheme", help="Scheme to use.")]
Trials = Annotated[int | None, typer.Option(help="Trials J; the scenario's own if not given.")]
Seed = Annotated[int, typer.Option(help="Seed of noise and of drawn machines.")]
Set = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="PATH=VALUE", help="Set a leaf, a static field or an option of the scenario; repeatable."),
]
Params = Annotated[Path | None, typer.Option("--params", metavar="FILE", help="Parameters that `tune` wrote; --set goes on top of them.")]
Spread = Annotated[float | None, typer.Option(help="Half-width of all relative uncertainties: 0.2 is 20 %.")]
Sampling = Annotated[str, typer.Option(help="monte-carlo, latin-hypercube, sobol or corners.")]
Json = Annotated[Path | None, typer.Option("--json", help="Write every printed figure to this file.")]
Report = Annotated[Path | None, typer.Option("--report", help="Write one self-contained HTML page to this file.")]
Precision = Annotated[str, typer.Option(help="float64 or float32.")]


def begin(precision: str) -> None:
    """Start JAX, with compiled programs kept from one start to the next."""
    from .runtime import keep_programs, setup

    setup(precision=precision)
    keep_programs()


def chosen_scenario(name: str, schemes: list[str] | None, trials: int | None, settings: list[str] | None, params: Path | None = None):
    """The scenario as asked for: its options, then the parameter file, then the settings. ValueError names what is allowed."""
    import dataclasses

    from . import scenarios
    from .parameters import with_parameters
    from .plant_files import load_scenario

    values = {}
    for setting in settings or []:
        path, equals, value = setting.partition("=")
        if not equals:
            raise ValueError(f"--set {setting!r} is not PATH=VALUE")
        values[path.strip()] = value.strip()
    known = scenarios.options(name) if name in scenarios.SCENARIOS else {}
    chosen = load_scenario(name, {path: value for path, value in values.items() if path in known})
    chosen = chosen if params is None else with_parameters(chosen, params)
    chosen = chosen.with_values({path: value for path, value in values.items() if path not in known})
    if trials is not None:
        if trials < 1:
            raise ValueError(f"--trials {trials} is outside its allowed range [1, inf)")
        chosen = dataclasses.replace(chosen, trials=trials)
    return chosen.select(tuple(schemes or ()))


def spread_of(chosen, spread: float | None):
    """The scenario's uncertainty, as wide as asked for."""
    from .uncertainty import with_spread

    return chosen.uncertainty if spread is None else with_spread(chosen.uncertainty, spread)


def folder_of(folder: Path | None, default: str) -> Path:
    """The folder for results, made."""
    folder = folder or Path("out") / default
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def written(paths: list[Path], json_file: Path | None, numbers: dict | list) -> None:
    """Write the numbers, if that was asked for, and say what was written."""
    if json_file is not None:
        json_file.parent.mkdir(parents=True, exist_ok=True)
        json_file.write_text(json.dumps(numbers, indent=1, allow_nan=True) + "\n")
        paths = [*paths, json_file]
    if paths:
        out.print("written: " + ", ".join(map(str, paths)), highlight=False, soft_wrap=True)


def progress_bar(field: str):
    """A progress bar that also shows a field of its tasks; silent where there is no terminal."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn(f"{{task.fields[{field}]}}"))
    return Progress(*columns, TimeElapsedColumn(), TimeRemainingColumn(), console=err, disable=not err.is_terminal)


def stopped(store: Path) -> NoReturn:
    """Say how to go on after Ctrl-C, and end."""
    err.print(f"stopped; {store} holds what is done: the same command with --resume goes on", highlight=False)
    sys.exit(130)
