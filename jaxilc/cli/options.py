"""What the commands of the command line share: consoles, options, and how a scenario is asked for
and results are left behind.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Annotated, NoReturn

import typer

from .completion import of_list, scenarios_from, schemes_from
from .console import err, log_jax, out
from .terms import OBJECTIVES, RISKS


def file_to_write(path: Path | None) -> Path | None:
    """The path. Raises ValueError if no file can be written there, before anything is computed for
    it.
    """
    if path is not None and (path.is_dir() or not _may_write(path)):
        raise ValueError(f"{path} cannot be written; allowed is a file in a folder that can")
    return path


def seed_in_range(seed: int) -> int:
    """The seed. Raises ValueError for one that the generators refuse."""
    from ..pytree.ranges import SEEDS, Interval, brief

    if not Interval.parse(SEEDS).contains(seed):
        raise ValueError(f"--seed {brief(seed)} is outside its allowed range {SEEDS}")
    return seed


def folder_to_write(path: Path | None) -> Path | None:
    """The path. Raises ValueError if no folder can be made there, before anything is computed for
    it.
    """
    if path is not None and (not _may_write(path) or (path.exists() and not path.is_dir())):
        raise ValueError(
            f"{path} cannot be a folder for results; allowed is one that can be made or written to"
        )
    return path


def _may_write(path: Path) -> bool:
    """Whether what is there, or else the nearest folder above it, can be written to."""
    there = next(p for p in (path.absolute(), *path.absolute().parents) if p.exists())
    return os.access(there, os.W_OK) and (there == path.absolute() or there.is_dir())


ScenarioName = Annotated[
    str,
    typer.Argument(
        metavar="SCENARIO",
        help="Of `jaxilc list`, or your own, a TOML or JSON file.",
        autocompletion=scenarios_from,
    ),
]
Schemes = Annotated[
    list[str] | None,
    typer.Option(
        "--scheme", help="Scheme to use; repeatable. All if not given.", autocompletion=schemes_from
    ),
]
OneScheme = Annotated[
    str, typer.Option("--scheme", help="Scheme to use.", autocompletion=schemes_from)
]
Trials = Annotated[int | None, typer.Option(help="Trials J; the scenario's own if not given.")]
Seed = Annotated[
    int, typer.Option(help="Seed of noise and of drawn machines.", callback=seed_in_range)
]
Set = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="PATH=VALUE",
        help="Set a leaf, a static field or an option of the scenario; repeatable.",
    ),
]
Params = Annotated[
    Path | None,
    typer.Option(
        "--params", metavar="FILE", help="Parameters that `tune` wrote; --set goes on top of them."
    ),
]
Spread = Annotated[
    float | None, typer.Option(help="Half-width of all relative uncertainties: 0.2 is 20 %.")
]
Sampling = Annotated[
    str,
    typer.Option(
        help="monte-carlo, latin-hypercube, sobol or corners.",
        autocompletion=of_list("monte-carlo", "latin-hypercube", "sobol", "corners"),
    ),
]
Weights = Annotated[
    str, typer.Option(metavar="A,B,C", help="Leaves or elements to tune: lam,phi0[0].")
]
Bounds = Annotated[
    list[str] | None,
    typer.Option(metavar="A=LOW:HIGH", help="Narrower than a leaf allows; repeatable."),
]
TERMS = f"Sum of WEIGHT*NAME[:NUMBER][@FIGURE], NAME of {OBJECTIVES}."
OverMachines = Annotated[str, typer.Option("--risk", help=f"Over the machines: {RISKS}.")]
TunedOn = Annotated[
    int, typer.Option("--samples", help="Machines to tune on, the nominal one included.")
]
HeldOut = Annotated[int, typer.Option(help="Machines that choose among the steps.")]
Unseen = Annotated[int, typer.Option(help="Machines of the comparison, the nominal one included.")]
Steps = Annotated[int, typer.Option(help="Steps at most.")]
Starts = Annotated[int, typer.Option(help="Starts; the first is the weights as given.")]
Rate = Annotated[float, typer.Option(help="Of adam: 0.1 is 10 % of a weight a step.")]
Optimiser = Annotated[
    str,
    typer.Option(
        help="adam, lbfgs or least-squares.",
        autocompletion=of_list("adam", "lbfgs", "least-squares"),
    ),
]
Json = Annotated[
    Path | None,
    typer.Option("--json", help="Write every printed figure to this file.", callback=file_to_write),
]
Report = Annotated[
    Path | None,
    typer.Option(
        "--report", help="Write one self-contained HTML page to this file.", callback=file_to_write
    ),
]
Precision = Annotated[
    str, typer.Option(help="float64 or float32.", autocompletion=of_list("float64", "float32"))
]


class Refused(ValueError):
    """A measured trial, or the input that it leads to, that the checks refuse."""


def begin(precision: str) -> None:
    """Start JAX, with compiled programs kept from one start to the next."""
    from ..runtime.start import keep_programs, setup

    setup(precision=precision)
    log_jax(keep_programs())


def chosen_scenario(
    name: str,
    schemes: list[str] | None,
    trials: int | None,
    settings: list[str] | None,
    params: Path | None = None,
):
    """The scenario as asked for: its options, then the parameter file, then the settings.
    ValueError names what is allowed.
    """
    import dataclasses

    from .. import scenarios
    from ..scenarios.from_file import load_scenario
    from ..scenarios.parameters import with_parameters

    values = {}
    for setting in settings or []:
        path, equals, value = setting.partition("=")
        if not equals:
            raise ValueError(f"--set {setting!r} is not PATH=VALUE")
        values[path.strip()] = value.strip()
    known = scenarios.options(name) if name in scenarios.SCENARIOS else {}
    chosen = load_scenario(name, {path: value for path, value in values.items() if path in known})
    if not chosen.schemes:
        raise ValueError(f"{name} has no scheme; needed is a table [schemes.NAME] at least")
    if params is not None:
        chosen = with_parameters(chosen, params)
    chosen = chosen.with_values(
        {path: value for path, value in values.items() if path not in known}
    )
    if trials is not None:
        if trials < 1:
            raise ValueError(f"--trials {trials} is outside its allowed range [1, inf)")
        chosen = dataclasses.replace(chosen, trials=trials)
    chosen = chosen.select(tuple(schemes or ()))
    chosen.check()
    return chosen


def spread_of(chosen, spread: float | None):
    """The scenario's uncertainty, as wide as asked for."""
    from ..uncertainty import with_spread

    return chosen.uncertainty if spread is None else with_spread(chosen.uncertainty, spread)


def folder_of(folder: Path | None, default: str) -> Path:
    """The folder for results, made."""
    folder = folder or Path("out") / default
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def written(paths: list[Path], json_file: Path | None, numbers: dict | list) -> None:
    """Write the numbers, if that was asked for, and say what was written."""
    from ..storage.sealed import write_json

    if json_file is not None:
        json_file.parent.mkdir(parents=True, exist_ok=True)
        write_json(json_file, numbers)
        paths = [*paths, json_file]
    if paths:
        out.print("written: " + ", ".join(map(str, paths)), highlight=False, soft_wrap=True)


def progress_bar(field: str):
    """A progress bar that also shows a field of its tasks; silent where there is no terminal."""
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn(f"{{task.fields[{field}]}}", markup=False),
    )
    return Progress(
        *columns,
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=err,
        disable=out.quiet or not err.is_terminal,
    )


def stopped(store: Path) -> NoReturn:
    """Say how to go on after Ctrl-C, and end."""
    err.print(
        f"stopped; {store} holds what is done: the same command with --resume goes on",
        highlight=False,
    )
    sys.exit(130)
