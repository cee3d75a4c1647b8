"""The results of a command: what it prints, folders, and files of numbers and of parameters."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from .console import out

if TYPE_CHECKING:
    from rich.table import Table

    from ..outcomes.verdict import Verdict


def show(tables: Iterable[Table] = (), lines: Iterable[str] = ()) -> None:
    """Print tables, and lines below them."""
    for table in tables:
        out.print(table)
    for line in lines:
        out.print(line, highlight=False)


def tell(verdict: Verdict) -> None:
    """Print a verdict; the next command stays one line, so that it can be copied."""
    show(lines=verdict.said)
    for line in verdict.lines[len(verdict.said) :]:
        out.print(line, highlight=False, soft_wrap=True)


def folder_of(folder: Path | None, default: str) -> Path:
    """The folder for results, created if needed; out/DEFAULT where none was asked for."""
    folder = folder or Path("out") / default
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def written(
    paths: list[Path],
    json_file: Path | None,
    numbers: dict | list,
    verdict: Verdict | None = None,
) -> None:
    """Write the file of `--json`, if given, and print which files were written, and the verdict.

    numbers: results; a dictionary gets the entries `verdict` and `next` too
    verdict: sentences that end the output of the command
    """
    from ..storage.sealed import write_json

    if json_file is not None:
        if verdict is not None and isinstance(numbers, dict):
            numbers = numbers | verdict.as_json()
        json_file.parent.mkdir(parents=True, exist_ok=True)
        write_json(json_file, numbers)
        paths = [*paths, json_file]
    if paths:
        out.print("written: " + ", ".join(map(str, paths)), highlight=False, soft_wrap=True)
    if verdict is not None:
        tell(verdict)
