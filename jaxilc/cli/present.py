"""What a command does with an outcome: it prints it, writes its files, and says what is next."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from .console import begin, err, out, say
from .options import Pages, Written
from .progress import working

if TYPE_CHECKING:
    from ..outcomes.outcome import Numbers, Outcome
    from ..pytree.aliases import Value


def tell(
    command: str, pages: Pages, *asked: Value, bar: bool = True, details: bool = False, **how: Value
) -> None:
    """Ask the library, and present the outcome.

    asked: first arguments of the function, such as a request
    bar: whether a progress bar is shown; a search with a bar of its own shows that
    how: further arguments of the function, which has its own values for those that are None
    """
    how = {option: value for option, value in how.items() if value is not None}
    name = command.strip("_").replace("_", "-")
    with working(name) if bar else nullcontext() as progress:
        begin()
        from .. import outcomes

        how |= {"progress": progress} if bar else {}
        how |= {"folder": pages.out_dir} if isinstance(pages, Written) else {}
        outcome = getattr(outcomes, command)(*asked, **how)
    present(outcome, pages, details=details)


def present(outcome: Outcome, pages: Pages, *, details: bool = False) -> None:
    """Print an outcome, and write its files; one that failed ends with exit code 1."""
    from ..outcomes.outcome import silent

    try:
        outcome.show(out, details=details)
        for line in outcome.warnings:
            err.print(line)
    finally:  # the files are not lost where the reader of a pipe has gone, or a figure fails
        numbers = stored(pages.file(".json"), outcome.as_json())
        with working("figures") if outcome.figures else nullcontext(silent) as progress:
            paths = outcome.save(progress=progress)
        if (page := pages.file(".html")) is not None:
            paths.append(outcome.page(page, paths))
        written([*paths, *numbers])
    outcome.conclude(out)
    if outcome.failed:
        err.print(outcome.failed)
        raise typer.Exit(1)


def stored(file: Path | None, numbers: Numbers) -> list[Path]:
    """Write the numbers to a file, if one is asked for, before anything is drawn; its place."""
    if file is None:
        return []
    from ..storage.sealed import write_json

    file.parent.mkdir(parents=True, exist_ok=True)
    write_json(file, numbers)
    return [file]


def written(paths: list[Path]) -> None:
    """Print which files were written."""
    for path in paths:
        say(f"written: {path}")
