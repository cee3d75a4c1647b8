"""What a shell completes on the command line, without waiting for JAX."""

from __future__ import annotations

from collections.abc import Callable

import typer

from ..scenarios.catalogue import SCHEMES
from ..storage.reading import read_tree


def scenarios_from(incomplete: str) -> list[str]:
    """Scenarios that begin so; where there is none, the shell completes the name of a file."""
    return [name for name in SCHEMES if name.startswith(incomplete)]


def schemes_from(ctx: typer.Context, incomplete: str) -> list[str]:
    """Schemes that begin so, of the scenario or the file that the command names."""
    # While an option waits for its value, arguments are not yet read.
    scenario = ctx.params.get("scenario") or next(iter(ctx.args), "")
    return [
        name for name in SCHEMES.get(scenario) or _of_file(scenario) if name.startswith(incomplete)
    ]


def of_list(*words: str) -> Callable[[str], list[str]]:
    """A completion that offers the words that begin so."""
    return lambda incomplete: [word for word in words if word.startswith(incomplete)]


def _of_file(path: str) -> list[str]:
    """The names of the schemes in a scenario's file, none where it cannot be read."""
    try:
        return list(read_tree(path)["schemes"])
    except (OSError, ValueError, KeyError, TypeError):
        return []  # the file is not there, or not yet finished
