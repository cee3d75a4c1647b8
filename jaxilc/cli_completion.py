"""What `jaxilc list` prints and a shell completes. It stands here as text: neither waits for JAX, nor for a scenario to be planned."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import typer

from .storage.reading import read_tree


class Listed(NamedTuple):
    """A scenario as `jaxilc list` shows it. trials: J;  samples: N"""

    title: str
    schemes: tuple[str, ...]
    trials: int
    samples: int


LISTED = {
    "cao-2019": Listed(
        "Voice-coil motor for noncircular turning, MFAILC (Cao 2019)",
        ("pid", "cfdl-mfailc", "pfdl-mfailc", "ffdl-mfailc", "ilc-mfapc"),
        trials=80,
        samples=2000,
    ),
    "cao-2019-rig": Listed("Voice-coil motor on the laboratory rig at 0.5 Hz (Cao 2019)", ("pid", "cfdl-mfailc"), 80, 10_000),
    "dai-2014": Listed("Voice-coil motor under predictive MFAC at 0.5 Hz (Dai 2014)", ("pid", "cfdl-mfapc"), 1, 8000),
    "li-2020": Listed(
        "CNC axis along a butterfly, simulation (Li 2020)",
        ("feedback", "feedforward", "p-type", "higher-order", "fixed-filter", "switchable", "stop", "ladder", "series"),
        trials=40,
        samples=9998,
    ),
    "milc-2024": Listed("Flexible ball-screw drive, direct and multivariable norm-optimal ILC (MILC 2024)", ("dilc", "milc"), 11, 4000),
    "xu-2024": Listed(
        "Piezo fast tool servo, adaptive sliding mode and iterative learning (Xu 2024)", ("pid", "smc", "asmc", "ilc-asmc"), 10, 5000
    ),
}
SCHEMES = {name: listed.schemes for name, listed in LISTED.items()}


def scenarios_from(incomplete: str) -> list[str]:
    """Scenarios that begin so; none leaves the shell to complete a file."""
    return [name for name in SCHEMES if name.startswith(incomplete)]


def schemes_from(ctx: typer.Context, incomplete: str) -> list[str]:
    """Schemes of the scenario that stands in the command, or of the file that does, that begin so."""
    scenario = ctx.params.get("scenario") or next(iter(ctx.args), "")  # while an option waits for its value, arguments stay unread
    return [name for name in SCHEMES.get(scenario) or _of_file(scenario) if name.startswith(incomplete)]


def of_list(*words: str) -> Callable[[str], list[str]]:
    """Completes these words."""
    return lambda incomplete: [word for word in words if word.startswith(incomplete)]


def _of_file(path: str) -> list[str]:
    try:
        return list(read_tree(path)["schemes"])
    except (OSError, ValueError, KeyError, TypeError):  # not there, or not finished: nothing to complete
        return []
