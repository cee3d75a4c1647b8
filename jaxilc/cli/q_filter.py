"""`jaxilc filter`: whether a Q-filter is safe, by how much, and how far one may go."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .console import out
from .options import (
    PROVE,
    FigureFormat,
    Json,
    OutFolder,
    Params,
    Precision,
    Sampling,
    Schemes,
    Seed,
    Set,
    Spread,
    at_least,
)
from .results import folder_of, written

if TYPE_CHECKING:
    from ..scenarios import Scenario

RECORDS = (".csv", ".txt", ".dat", ".frf")


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command("filter", rich_help_panel=PROVE)(q_filter)


def q_filter(
    source: Annotated[
        list[str],
        typer.Argument(
            metavar="SCENARIO|FRF.csv...",
            help="Of `jaxilc list`, a TOML or JSON file, or measured frequency responses.",
        ),
    ],
    scheme: Schemes = None,
    margin: Annotated[float, typer.Option(help="1 - |Q (1 - L P)| that an offer keeps.")] = 0.1,
    vary: Annotated[
        list[str] | None,
        typer.Option(
            "--vary",
            metavar="PATH=SHARE",
            help="Instead of the file's uncertainty: plant.gain=15%; repeatable.",
        ),
    ] = None,
    spread: Spread = None,
    machines: Annotated[int, typer.Option(help="Machines drawn, beside all corners.")] = 32,
    seed: Seed = 0,
    sampling: Sampling = "latin-hypercube",
    set_: Set = None,
    params: Params = None,
    gain: Annotated[float | None, typer.Option(help="Learning gain, for an FRF.")] = None,
    lead: Annotated[int, typer.Option(help="Lead of the learning [samples], for an FRF.")] = 0,
    cutoff: Annotated[float | None, typer.Option(help="Of the filter [Hz], for an FRF.")] = None,
    order: Annotated[int, typer.Option(help="Of one pass of the filter, for an FRF.")] = 2,
    dt: Annotated[float | None, typer.Option(help="Sample time [s], for an FRF.")] = None,
    sigmas: Annotated[
        float, typer.Option(help="Scatter allowed for, in standard deviations of an FRF.")
    ] = 3.0,
    averages: Annotated[
        int | None, typer.Option(help="Averages behind the coherence of an FRF.")
    ] = None,
    synthesise: Annotated[
        bool, typer.Option("--synthesise", help="Find filters Q and L by convex optimisation.")
    ] = False,
    taps: Annotated[int, typer.Option(help="Taps of each filter that is synthesised.")] = 41,
    band: Annotated[
        float | None,
        typer.Option(
            help="Synthesis learns up to here [Hz]; twice the largest cutoff if not given."
        ),
    ] = None,
    out_dir: OutFolder = None,
    json_file: Json = None,
    figures: FigureFormat = None,
    precision: Precision = "float64",
) -> None:
    """Is my Q-filter safe, by how much, and how far may I go?

    |Q (1 - L P)| below 1 at every frequency, for every machine of the uncertainty or every line of
    a measured response, with the largest cutoff, gain and lead that keep a margin.

    Example: jaxilc filter axis.toml --vary plant.gain=15% --vary plant.frequencies=20%
    """
    from .asked import begin, chosen_scenario

    if not 0 < margin < 1:
        raise ValueError(f"--margin {margin:g} is outside its allowed range (0, 1)")
    at_least(1, machines=machines)
    begin(precision)
    records = [Path(one).suffix.lower() in RECORDS for one in source]
    asked = {"margin": margin, "taps": taps, "band": band, "synthesise": synthesise}
    if all(records):
        _only_for("a scenario", scheme=scheme, vary=vary, spread=spread, set=set_, params=params)
        from .q_filter_answers import records_answer

        law = {"gain": gain, "lead": lead, "cutoff": cutoff, "order": order, "dt": dt}
        numbers, paths = records_answer(
            source,
            law,
            asked | {"sigmas": sigmas, "averages": averages},
            partial(folder_of, out_dir, f"filter-{Path(source[0]).stem}"),
        )
    elif any(records) or len(source) > 1:
        raise ValueError(
            f"filter takes one scenario, or measured responses {', '.join(RECORDS)}; given are "
            f"{', '.join(source)}"
        )
    else:
        _only_for("a measured response", gain=gain, cutoff=cutoff, dt=dt, averages=averages)
        from .q_filter_answers import scenario_answer

        chosen = chosen_scenario(source[0], scheme, None, set_, params)
        numbers, paths = scenario_answer(
            source[0],
            _with_uncertainty(chosen, vary, spread),
            asked | {"machines": machines, "seed": seed, "sampling": sampling},
            named=scheme is not None,
            place=partial(folder_of, out_dir, f"filter-{chosen.name}"),
        )
    written(paths, json_file, {"source": source, "margin": margin, **numbers})
    for line in numbers["lines"]:
        is_command = line.startswith("Next")  # which stays one line, so that it can be copied
        out.print(line, highlight=False, markup=False, soft_wrap=is_command)


def _only_for(what: str, **given: object) -> None:
    """Raises ValueError for an option that belongs to the other kind of source."""
    for name, value in given.items():
        if value is not None:
            raise ValueError(f"--{name} is for {what} only")


def _with_uncertainty(chosen: Scenario, vary: list[str] | None, spread: float | None) -> Scenario:
    """The scenario with the uncertainty of `--vary` in place of its own, and that of `--spread`."""
    import dataclasses

    from ..uncertainty import Uniform, check
    from .asked import spread_of

    if vary:
        if spread is not None:
            raise ValueError("--vary and --spread exclude each other")
        shares = dict(_share(one) for one in vary)
        found = {name: Uniform(1 - s, 1 + s, relative=True) for name, s in shares.items()}
        check(chosen.machine, found)
        return dataclasses.replace(chosen, uncertainty=found)
    return dataclasses.replace(chosen, uncertainty=spread_of(chosen, spread))


def _share(text: str) -> tuple[str, float]:
    """PATH=SHARE, where the share is a number as 0.15 or a percentage as 15%."""
    path, _, value = text.partition("=")
    try:
        share = float(value.removesuffix("%")) / (100 if value.endswith("%") else 1)
    except ValueError:
        share = float("nan")
    if not path or not 0 < share < 1:
        raise ValueError(
            f"--vary {text!r} is not PATH=SHARE with a share in (0, 1), as 0.15 or 15%"
        )
    return path.strip().removeprefix("machine."), share
