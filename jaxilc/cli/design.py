"""`jaxilc design` and `jaxilc learn-law`: a learning law for the machine of a plant file."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

import typer

from ..outcomes.request import Request
from .completion import of_list, schemes_from
from .console import between
from .groups import add
from .options import (
    DESIGN,
    Pages,
    Resume,
    Seed,
    Set,
    Spread,
    Trials,
    file_to_write,
    folder_to_write,
    left,
)
from .present import tell
from .start import prefer

LAWS = ("p-type", "pd-type", "p-type-notch", "model-inverse", "norm-optimal", "learned")
INSTEAD = "outcomes.learn_law({}=...) in Python does it"


@dataclasses.dataclass(frozen=True)
class ForMachine:
    """The machine that a law is for, and how the law is judged."""

    plant_file: Annotated[
        str, typer.Argument(metavar="FILE", help="Plant file, TOML or JSON; see `jaxilc init`.")
    ]
    scheme: Annotated[
        str | None,
        typer.Option(
            help="Scheme of the file whose feedback is taken.", autocompletion=schemes_from
        ),
    ] = None
    margin: Annotated[
        float, typer.Option(help="Least distance of |Q (1 - L P)| from 1, on every machine.")
    ] = 0.05
    trials: Trials = None
    machines: Annotated[int, typer.Option(help="Machines that judge.")] = 257
    spread: Spread = None
    seed: Seed = 0
    set_: Set = None


@dataclasses.dataclass(frozen=True)
class LawWritten(Pages):
    """The plant file that is left, the folder of the state, and where else results go."""

    out_dir: Annotated[
        Path | None,
        typer.Option(
            "--state",
            help="Folder for the state; out/COMMAND-NAME if not given.",
            callback=folder_to_write,
        ),
    ] = None
    out_file: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="FILE",
            help="Plant file to write; beside the one given, as axis.design.toml or "
            "axis.learned.toml, if not given.",
            callback=file_to_write,
        ),
    ] = None
    force: Annotated[bool, typer.Option("--force", help="Replace that file, and its state.")] = (
        False
    )
    resume: Resume = False


def register(app: typer.Typer) -> None:
    """Add the commands to the command line."""
    add(app, design, DESIGN)
    add(app, learn_law, DESIGN, "learn-law")


def design(
    what: ForMachine,
    written: LawWritten,
    law: Annotated[
        list[str] | None,
        typer.Option(
            help="Law to try; repeatable. All if not given.", autocompletion=of_list(*LAWS)
        ),
    ] = None,
    steps: Annotated[int, typer.Option(help="Steps of each tuning at most.")] = 30,
    record: Annotated[
        list[str] | None,
        typer.Option(
            metavar="FILE",
            help="Trial without learning, with columns e or y and r; repeatable. It tells in what "
            "the error repeats.",
        ),
    ] = None,
) -> None:
    """Which learning law for this machine, with which weights, is it safe, and what will it reach.

    It tries several laws: safe weights by the frequency response of all machines,
    tuned by gradient, one of them by its taps (see `learn-law`), and judged on machines
    that were not used. The best one is written to a plant file that every other command
    takes. With --record it says whether the error repeats from trial to trial, in a
    period or in the position, and writes the law that follows beside it.

    Example: jaxilc design axis.toml
    """
    _tell("design", what, written, laws=law or (), steps=steps, record=record or ())


def learn_law(
    what: ForMachine,
    written: LawWritten,
    taps: Annotated[
        str, typer.Option(metavar="L,Q", help="Odd numbers of taps of L and of Q.")
    ] = "61,31",
    limit: Annotated[
        float | None, typer.Option(help="Largest |u| that is learned; none if not given.")
    ] = None,
    steps: Annotated[
        int, typer.Option(help="Steps through learning; 0 for the frequency response alone.")
    ] = 60,
    start: Annotated[str | None, left("--start", INSTEAD.format("start"))] = None,
    segments: Annotated[str, left("--segments", INSTEAD.format("segments"))] = "",
    decentralised: Annotated[bool, left("--decentralised", INSTEAD.format("coupled"))] = False,
    trained_on: Annotated[int | None, left("--trained-on", INSTEAD.format("trained_on"))] = None,
    objective: Annotated[str | None, left("--objective", INSTEAD.format("objective"))] = None,
    risk: Annotated[str | None, left("--risk", INSTEAD.format("risk"))] = None,
) -> None:
    """Learn the update law itself, the taps of L and Q, and prove it safe before it is written.

    The taps come from gradients through the learning of many machines. A law that
    is not safe on every machine of a dense family is taken back, or not written. Of
    several channels the taps are matrices.

    Example: jaxilc learn-law axis.toml --taps 61,31
    """
    of_author = {"start": start, "trained_on": trained_on, "objective": objective, "risk": risk}
    _tell(
        "learn_law",
        what,
        written,
        taps=_numbers("taps", taps, int, "two odd numbers, as in 61,31", 2),
        segments=_numbers("segments", segments, float, "times in seconds, as in 0.2,0.5"),
        coupled=not decentralised,
        limit=limit,
        steps=steps,
        **{name: value for name, value in of_author.items() if value is not None},
    )


def _tell(command: str, what: ForMachine, written: LawWritten, **how: Any) -> None:
    """Ask for a law, and print sentences on the way to it."""
    prefer("float64")  # what is proved of a law holds in it
    schemes = () if what.scheme is None else (what.scheme,)
    set_ = tuple(what.set_ or ())
    tell(
        command,
        Request(what.plant_file, schemes, set_, trials=what.trials, spread=what.spread),
        written,
        folder=written.out_dir,
        margin=what.margin,
        machines=what.machines,
        seed=what.seed,
        out=written.out_file,
        force=written.force,
        resume=written.resume,
        say=between,
        **how,
    )


def _numbers(
    option: str, text: str, kind: Callable[[str], float], allowed: str, count: int | None = None
) -> tuple[float, ...]:
    """Numbers with commas between. Raises ValueError for other text, and for another count."""
    with suppress(ValueError):
        found = tuple(kind(part) for part in text.split(",") if part.strip())
        if count in (None, len(found)):
            return found
    raise ValueError(f"--{option} {text!r} is not allowed; allowed are {allowed}")
