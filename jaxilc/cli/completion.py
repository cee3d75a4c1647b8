"""Completion of the command line by a shell, without importing JAX."""

from __future__ import annotations

from collections.abc import Callable

import typer

from ..scenarios.catalogue import SCHEMES
from ..storage.reading import read_tree


def scenarios_from(incomplete: str) -> list[str]:
    """Scenarios whose name begins with this text; if none does, the shell completes a file name."""
    return [name for name in SCHEMES if name.startswith(incomplete)]


def schemes_from(ctx: typer.Context, incomplete: str) -> list[str]:
    """Schemes, of the scenario or file of the command, whose name begins with this text."""
    # While the value of an option is completed, the arguments are not yet parsed.
    scenario = ctx.params.get("scenario") or next(iter(ctx.args), "")
    return [
        name for name in SCHEMES.get(scenario) or _of_file(scenario) if name.startswith(incomplete)
    ]


def of_list(*words: str) -> Callable[[str], list[str]]:
    """A completion function that offers those of the words that begin with the text."""
    return lambda incomplete: [word for word in words if word.startswith(incomplete)]


def _of_file(path: str) -> list[str]:
    """The names of the schemes in a scenario file; an empty list where it cannot be read."""
    try:
        return list(read_tree(path)["schemes"])
    except (OSError, ValueError, KeyError, TypeError):
        return []  # the file does not exist, or is not complete
