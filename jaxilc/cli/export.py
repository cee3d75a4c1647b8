"""`jaxilc export`: a learning law as a program for a controller, with its certificate."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from ..outcomes.request import Request
from .completion import of_list, scenarios_from
from .groups import add
from .options import MACHINE, Machines, Pages, Params, Schemes, Seed, Set, folder_to_write
from .present import tell


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    add(app, export, MACHINE)


def export(
    pages: Pages,
    source: Annotated[
        str | None,
        typer.Argument(
            metavar="SCENARIO",
            help="Of `jaxilc list`, or your own, a TOML or JSON file.",
            autocompletion=scenarios_from,
        ),
    ] = None,
    format_: Annotated[
        str,
        typer.Option(
            "--format",
            help="c, fmu, hal (LinuxCNC) or st (Structured Text).",
            autocompletion=of_list("c", "fmu", "hal", "st"),
        ),
    ] = "c",
    out_dir: Annotated[
        Path,
        typer.Option(
            "--out", metavar="FOLDER", help="Where it is written.", callback=folder_to_write
        ),
    ] = Path("law"),
    check: Annotated[
        Path | None,
        typer.Option(
            "--check",
            metavar="FOLDER",
            help="Prove that code, vectors and certificate of a folder belong together.",
        ),
    ] = None,
    state: Annotated[
        Path | None,
        typer.Option("--state", metavar="FOLDER", help="Start with what a campaign has learned."),
    ] = None,
    limit: Annotated[
        float | None,
        typer.Option(help="Largest |input|, never exceeded; the machine's own if not given."),
    ] = None,
    number: Annotated[
        str, typer.Option(help="double or float.", autocompletion=of_list("double", "float"))
    ] = "double",
    scheme: Schemes = None,
    machines: Machines = 64,
    seed: Seed = 0,
    set_: Set = None,
    params: Params = None,
) -> None:
    """A learning law as a program for a controller, with its guard and certificate.

    The law is the traced program itself: C99 without allocation, an FMU, a
    component of LinuxCNC or a function block in Structured Text. Its guard goes
    back to the last good input where `next` refuses a trial.

    Example: jaxilc export axis.design.toml --limit 10 --out law
    """
    if check is not None:
        tell("check_export", check, pages, bar=False)
        return
    asked = None
    if source is not None:
        asked = Request(source, tuple(scheme or ()), tuple(set_ or ()), params)
    how: dict[str, Any] = {"format": format_, "state": state, "limit": limit, "number": number}
    how |= {"machines": machines, "seed": seed, "folder": out_dir}
    tell("export", asked, pages, **how)
