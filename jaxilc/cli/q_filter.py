"""`jaxilc filter`: whether a Q-filter is safe, by how much, and how far one may go."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from ..outcomes.request import Request
from .groups import add
from .options import PROVE, Params, Schemes, Seed, Set, Spread, Written, left
from .present import tell

RECORDS = (".csv", ".txt", ".dat", ".frf")
INSTEAD = "outcomes.filter_{}(...) in Python does it"
MEASURED = INSTEAD.format("measured")
TAPS = 41  # of each filter that --synthesise finds


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    add(app, q_filter, PROVE, "filter")


def q_filter(
    source: Annotated[
        list[str],
        typer.Argument(
            metavar="SCENARIO|FRF.csv...",
            help="Of `jaxilc list`, a TOML or JSON file, or measured frequency responses.",
        ),
    ],
    written: Written,
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
    set_: Set = None,
    params: Params = None,
    gain: Annotated[float | None, typer.Option(help="Learning gain, for an FRF.")] = None,
    lead: Annotated[int, typer.Option(help="Lead of the learning [samples], for an FRF.")] = 0,
    cutoff: Annotated[float | None, typer.Option(help="Of the filter [Hz], for an FRF.")] = None,
    dt: Annotated[float | None, typer.Option(help="Sample time [s], for an FRF.")] = None,
    taps: Annotated[
        int | None,
        typer.Option(
            metavar="N", help="Find filters Q and L of N taps by convex optimisation too."
        ),
    ] = None,
    sampling: Annotated[str | None, left("--sampling", INSTEAD.format(""))] = None,
    order: Annotated[int | None, left("--order", MEASURED)] = None,
    sigmas: Annotated[float | None, left("--sigmas", MEASURED)] = None,
    averages: Annotated[int | None, left("--averages", MEASURED)] = None,
    synthesise: Annotated[bool, left("--synthesise", "--taps N does it")] = False,
    band: Annotated[float | None, left("--band", INSTEAD.format(""))] = None,
) -> None:
    """Is my Q-filter safe, by how much, and how far may I go?

    |Q (1 - L P)| below 1 at every frequency, for every machine of the uncertainty or every line of
    a measured response, with the largest cutoff, gain and lead that keep a margin.

    Example: jaxilc filter axis.toml --vary plant.gain=15% --vary plant.frequencies=20%
    """
    how: dict[str, Any] = {"folder": written.out_dir, "margin": margin}
    how |= {"taps": TAPS if synthesise and taps is None else taps}
    law = {"gain": gain, "cutoff": cutoff, "dt": dt}
    records = [Path(one).suffix.lower() in RECORDS for one in source]
    if all(records):
        _only_for("a scenario", scheme=scheme, vary=vary, spread=spread, set=set_, params=params)
        missing = [f"--{name}" for name, value in law.items() if value is None]
        if missing:
            raise ValueError(
                f"a measured response needs a law: {', '.join(missing)} not given; u is learned by "
                "u + gain e[k + 1 + lead] with a low-pass of --cutoff"
            )
        how |= law | {"lead": lead}
        of_author = {"order": order, "sigmas": sigmas, "averages": averages, "band": band}
    elif any(records) or len(source) > 1:
        raise ValueError(
            f"filter takes one scenario, or measured responses {', '.join(RECORDS)}; given are "
            f"{', '.join(source)}"
        )
    else:
        _only_for("a measured response", **law, averages=averages)
        how |= {"vary": vary or (), "machines": machines, "seed": seed}
        of_author = {"sampling": sampling, "band": band}
    how |= {name: value for name, value in of_author.items() if value is not None}
    if all(records):
        tell("filter_measured", source, written, **how)
    else:
        asked = Request(source[0], tuple(scheme or ()), tuple(set_ or ()), params, spread=spread)
        tell("filter_", asked, written, **how)


def _only_for(what: str, **given: object) -> None:
    """Raises ValueError for an option that belongs to the other kind of source."""
    for name, value in given.items():
        if value is not None:
            raise ValueError(f"--{name} is for {what} only")
