"""The options of the commands for a real machine."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .completion import of_list, scenarios_from, schemes_from
from .options import Params, file_to_write

Folder = Annotated[Path, typer.Option("--state", help="Folder of the campaign.")]
Measured = Annotated[
    Path | None,
    typer.Option(
        "--measured", metavar="TRIAL", help="Measured trial, .csv or .mat; none starts a campaign."
    ),
]
ReferenceColumn = Annotated[
    str, typer.Option("--reference", help="Column of the reference, which need not be there.")
]
Next = Annotated[
    Path | None,
    typer.Option(
        "--out", metavar="NEXT", help="What the machine plays next: .csv, .mat or .h (C)."
    ),
]
ScenarioName = Annotated[
    str | None,
    typer.Option(
        "--scenario",
        metavar="NAME|FILE",
        help="Scenario or plant file to start from.",
        autocompletion=scenarios_from,
    ),
]
PlantFile = Annotated[Path | None, typer.Option(help="Plant file (TOML or JSON) to start from.")]
SchemeName = Annotated[
    str | None,
    typer.Option(
        "--scheme", help="Scheme; not needed where only one learns.", autocompletion=schemes_from
    ),
]
NextParams = Params
NoPredict = Annotated[
    bool,
    typer.Option(
        "--no-predict", help="Predict no errors of trials by the plant file, from now on."
    ),
]
Predict = Annotated[bool, typer.Option("--predict", help="Predict them again, from now on.")]
Plot = Annotated[
    Path | None,
    typer.Option(
        "--plot",
        metavar="FIGURE",
        help="Plot errors, prediction and the last trial to this file.",
        callback=file_to_write,
    ),
]
Limit = Annotated[
    float | None, typer.Option(help="Largest |input| played; the machine's own if not given.")
]
Correction = Annotated[
    float | None,
    typer.Option("--largest-correction", help="Largest departure of a learned reference."),
]
Share = Annotated[
    float | None,
    typer.Option("--saturation", help="Share of samples at the limit that is accepted."),
]
Repeatability = Annotated[
    float | None, typer.Option(help="Largest RMS difference of two trials of one schedule.")
]
Growth = Annotated[
    float | None, typer.Option(help="Share by which the RMS error may grow without a warning.")
]

AcceptSaturation = Annotated[
    bool, typer.Option("--accept-saturation", help="Learn in spite of saturation.")
]
StopOnGrowth = Annotated[
    bool, typer.Option("--stop-on-growth", help="Refuse a trial whose error grew.")
]
NoLearn = Annotated[
    bool,
    typer.Option("--no-learn", help="Look at the trial only; the same schedule is played again."),
]
ReplayedInput = Annotated[
    bool, typer.Option("--replayed-input", help="Without u: the scheme's over the measured y.")
]
ShortTrial = Annotated[
    bool, typer.Option("--short-trial", help="The trial may have ended early: learn from its part.")
]
Undo = Annotated[
    int | None,
    typer.Option(metavar="J", help="Go back to what was known after trial J, 0 for the start."),
]
Number = Annotated[
    str,
    typer.Option(
        help="Numbers of a C header: double or float.", autocompletion=of_list("double", "float")
    ),
]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Check and report; write nothing.")]
