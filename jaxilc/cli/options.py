"""The arguments and options that several commands share, and the checks of their values.

This module does not import JAX, so that `--help` and the completion of a shell are fast.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from ..learning.known_metrics import TUNED
from .completion import of_list, scenarios_from, schemes_from
from .terms import OBJECTIVES, RISKS

# What one wants, in the order of `jaxilc --help`; each command belongs to one of these groups.
SIMULATE = "Simulate"
DESIGN = "Design"
PROVE = "Prove"
MACHINE = "Learn on a real machine"
PAPERS = "Published results"


def file_to_write(path: Path | None) -> Path | None:
    """The path of a file for results.

    Raises ValueError, before anything is computed, if no file can be written there.
    """
    if path is not None and (path.is_dir() or not _may_write(path)):
        raise ValueError(f"{path} cannot be written; allowed is a file in a folder that can")
    return path


def folder_to_write(path: Path | None) -> Path | None:
    """The path of a folder for results.

    Raises ValueError, before anything is computed, if no folder can be made there.
    """
    if path is not None and (not _may_write(path) or (path.exists() and not path.is_dir())):
        raise ValueError(
            f"{path} cannot be a folder for results; allowed is one that can be made or written to"
        )
    return path


def _may_write(path: Path) -> bool:
    """Whether the path is writable; if it does not exist, whether the nearest folder above is."""
    there = next(p for p in (path.absolute(), *path.absolute().parents) if p.exists())
    return os.access(there, os.W_OK) and (there == path.absolute() or there.is_dir())


def seed_in_range(seed: int) -> int:
    """The seed; raises ValueError for one that the random generators do not accept."""
    from ..pytree.ranges import SEEDS, Interval, brief

    if not Interval.parse(SEEDS).contains(seed):
        raise ValueError(f"--seed {brief(seed)} is outside its allowed range {SEEDS}")
    return seed


def figures_as(text: str | None) -> str | None:
    """Choose how figures are written; raises ValueError, before anything is computed."""
    from ..storage.figure_format import choose

    try:
        choose(text)
    except ValueError as error:
        raise ValueError(str(error).replace("figures =", "--figures")) from None
    return text


def at_least(low: int, **given: int | None) -> None:
    """Check that the numbers of options are at least `low`.

    given: numbers by the name of the option, with `_` for `-`; None for an option not given
    Raises ValueError naming the first option whose number is below `low`.
    """
    for name, value in given.items():
        if value is not None and value < low:
            option = name.replace("_", "-")
            raise ValueError(f"--{option} {value} is outside its allowed range [{low}, inf)")


# What is simulated
# --------------------------------------------------------------------------------------------------

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
        "--params",
        metavar="FILE",
        help="Parameters that `tune` wrote, or the folder of a `sweep --grid` for its best point; "
        "--set goes on top of them.",
    ),
]
GridAxes = Annotated[
    list[str] | None,
    typer.Option(
        "--grid",
        metavar="PATH=VALUES",
        help="An axis of a grid: LOW:HIGH:COUNT, LOW:HIGH:COUNTlog or values with commas, for what "
        "--set can set, or trials; PATH/PATH is one axis of two; repeatable.",
    ),
]
MetricName = Annotated[
    str | None,
    typer.Option(
        "--metric",
        help=f"Metric that tables show and --tolerance limits: {', '.join(TUNED)} or one of the "
        "scenario, such as contour_max; its own if not given.",
        autocompletion=of_list(*TUNED),
    ),
]
Seed = Annotated[
    int, typer.Option(help="Seed of noise and of drawn machines.", callback=seed_in_range)
]
Precision = Annotated[
    str, typer.Option(help="float64 or float32.", autocompletion=of_list("float64", "float32"))
]

# Machines that are drawn
# --------------------------------------------------------------------------------------------------

Machines = Annotated[
    int, typer.Option("--machines", "--samples", help="Machines, the nominal one included.")
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

# Tuning
# --------------------------------------------------------------------------------------------------

Weights = Annotated[
    str, typer.Option(metavar="A,B,C", help="Leaves or elements to tune: lam,phi0[0].")
]
Bounds = Annotated[
    list[str] | None,
    typer.Option(metavar="A=LOW:HIGH", help="Narrower than a leaf allows; repeatable."),
]
TERMS = f"Sum of WEIGHT*NAME[:NUMBER][@METRIC], NAME of {OBJECTIVES}."
OverMachines = Annotated[str, typer.Option("--risk", help=f"Over the machines: {RISKS}.")]
TunedOn = Annotated[
    int,
    typer.Option("--machines", "--samples", help="Machines to tune on, the nominal one included."),
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

# A law for the machine of a plant file
# --------------------------------------------------------------------------------------------------

PlantFile = Annotated[
    Path, typer.Argument(metavar="FILE", help="Plant file, TOML or JSON; see `jaxilc init`.")
]
FeedbackOf = Annotated[
    str | None,
    typer.Option(
        "--scheme",
        help="Scheme of the file whose feedback is taken.",
        autocompletion=schemes_from,
    ),
]
Margin = Annotated[
    float, typer.Option(help="Least distance of |Q (1 - L P)| from 1, on every machine.")
]
JudgedOn = Annotated[int, typer.Option("--machines", help="Machines that judge.")]
Force = Annotated[bool, typer.Option("--force", help="Replace that file, and its state.")]
OutPlant = Annotated[
    Path | None,
    typer.Option(
        "--out",
        metavar="FILE",
        help="Plant file to write; beside the one given, as axis.design.toml or axis.learned.toml, "
        "if not given.",
        callback=file_to_write,
    ),
]
StateFolder = Annotated[
    Path | None,
    typer.Option(
        help="Folder for the state; out/COMMAND-NAME if not given.", callback=folder_to_write
    ),
]

# Columns of a file that was measured
# --------------------------------------------------------------------------------------------------

TimeColumn = Annotated[str, typer.Option("--time", help="Column of the time.")]
InputColumn = Annotated[str, typer.Option("--input", help="Column of the input.")]
OutputColumn = Annotated[str, typer.Option("--output", help="Column of the output.")]

# Files that are written
# --------------------------------------------------------------------------------------------------

OutFolder = Annotated[
    Path | None,
    typer.Option(
        "--out",
        help="Folder for all results; out/COMMAND-SCENARIO if not given.",
        callback=folder_to_write,
    ),
]
Replace = Annotated[
    bool, typer.Option("--replace", help="Replace the run of other settings in the folder.")
]
FigureFormat = Annotated[
    str | None,
    typer.Option(
        "--figures",
        metavar="FORMAT",
        help="Format and style of figures: png, svg or pdf; print or dark; both as svg,dark.",
        callback=figures_as,
    ),
]
Resume = Annotated[bool, typer.Option("--resume", help="Go on with what is in the folder.")]
Json = Annotated[
    Path | None,
    typer.Option("--json", help="Write every printed number to this file.", callback=file_to_write),
]
Report = Annotated[
    Path | None,
    typer.Option(
        "--report", help="Write one self-contained HTML page to this file.", callback=file_to_write
    ),
]
