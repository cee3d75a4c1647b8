"""What a command does with an outcome: it prints it, writes its files, and says what is next."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from .console import err, out
from .progress import working
from .start import begin

if TYPE_CHECKING:
    from ..outcomes.outcome import Outcome
    from .options import Pages


def tell(
    command: str,
    asked: Any,
    pages: Pages,
    *,
    bar: bool = True,
    details: bool = False,
    **how: Any,
) -> None:
    """Ask a request of the library, and present the outcome.

    command: name of the function of `outcomes`
    asked: its first argument, such as a request
    bar: whether a progress bar is shown; a search with a bar of its own shows that
    details: whether the details of the outcome are printed, too
    how: further arguments of the function
    """
    name = command.strip("_").replace("_", "-")
    with working(name) if bar else nullcontext() as progress:
        begin()
        from .. import outcomes

        how |= {"progress": progress} if bar else {}
        outcome = getattr(outcomes, command)(asked, **how)
    present(outcome, pages, details=details)


def present(outcome: Outcome, pages: Pages, *, details: bool = False) -> None:
    """Print an outcome, write its files, and end with the command to type next.

    Where the outcome says that the command failed, it ends with exit code 1.
    """
    from ..outcomes.outcome import silent

    outcome.show(out, details=details)
    for line in outcome.warnings:
        err.print(line, highlight=False)
    with working("figures") if outcome.figures else nullcontext(silent) as progress:
        paths = outcome.save(progress=progress)
    if pages.page is not None:
        paths.append(outcome.page(pages.page, paths))
    written(paths, pages.numbers, outcome.as_json())
    outcome.conclude(out)
    if outcome.failed:
        err.print(outcome.failed, highlight=False)
        raise typer.Exit(1)


def written(paths: list[Path], file: Path | None, numbers: Any) -> None:
    """Write the numbers to a file, if one is asked for, and print which files were written."""
    if file is not None:
        from ..storage.sealed import write_json

        file.parent.mkdir(parents=True, exist_ok=True)
        write_json(file, numbers)
        paths = [*paths, file]
    if paths:
        for path in paths:
            out.print(f"written: {path}", highlight=False, soft_wrap=True)
