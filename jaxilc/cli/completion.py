"""What a shell completes on the command line, without waiting for JAX."""

from __future__ import annotations

from collections.abc import Callable

import typer

from ..scenarios.catalogue import SCHEMES
from ..storage.reading import read_tree


def scenarios_from(incomplete: str) -> list[str]:
    """Scenarios that begin so; none leaves the shell to complete a file."""
    return [name for name in SCHEMES if name.startswith(incomplete)]


def schemes_from(ctx: typer.Context, incomplete: str) -> list[str]:
    """Schemes of the scenario that stands in the command, or of the file that does, that begin so."""
    scenario = ctx.params.get("scenario") or next(
        iter(ctx.args), ""
    )  # while an option waits for its value, arguments stay unread
    return [
        name for name in SCHEMES.get(scenario) or _of_file(scenario) if name.startswith(incomplete)
    ]


def of_list(*words: str) -> Callable[[str], list[str]]:
    """Completes these words."""
    return lambda incomplete: [word for word in words if word.startswith(incomplete)]


def _of_file(path: str) -> list[str]:
    try:
        return list(read_tree(path)["schemes"])
    except (
        OSError,
        ValueError,
        KeyError,
        TypeError,
    ):  # not there, or not finished: nothing to complete
        return []
