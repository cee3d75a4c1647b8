"""What a command found, as one object of which terminal, JSON, page and notebook are views."""

from __future__ import annotations

import dataclasses
import io
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

from .table import Console, Table
from .verdict import Verdict

if TYPE_CHECKING:
    from ..figures.page import Live
    from ..scenarios import Scenario

WIDTH = 100  # columns of an outcome as text


class Progress(Protocol):
    """A function that is told what is done now, as a text, and how many parts of the work are."""

    def __call__(
        self, now: str, done: float | None = None, total: float | None = None, /
    ) -> object: ...


def silent(now: str, done: float | None = None, total: float | None = None, /) -> None:
    """The progress of a call that shows none."""


class Figure(NamedTuple):
    """A figure that is drawn when it is needed.

    caption: what it shows, in sentences
    draw: a function that returns its axes
    live: whether the interactive figures of a page show the same
    """

    caption: str
    draw: Callable[[], Any]
    live: bool = False


def nothing_live() -> Sequence[Live | None]:
    """The interactive figures of an outcome that has none."""
    return ()


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Outcome:
    """What a command found. `print` shows it as the command does, a notebook as a page does.

    command: name of the command
    numbers: every number that is told, by keys that stay the same in all versions
    verdict: what was found in sentences, and the command to type next
    folder: where `save` writes, if no other folder is named; None for nowhere
    scenario: the scenario that was run, None for a command without one
    tables: tables, with lines between them where they belong to one of them
    details: further ones, which a page shows, and a terminal where they are asked for
    lines: sentences below the tables
    warnings: sentences on what went wrong, or is not met
    figures: figures by the names of their files
    files: functions that write a further file or store at a place, by its name
    kept: files and stores that were written while computing
    live: a function that makes the interactive figures of a page
    asked: further rows of a page, below the name of the command
    configuration: all that determines the numbers; None for that of the scenario
    failed: a sentence where the numbers contradict each other, or nothing was found; the command
        then fails
    """

    command: str
    numbers: Any
    verdict: Verdict
    folder: Path | None = None
    scenario: Scenario | None = None
    tables: Sequence[Table | str] = ()
    details: Sequence[Table | str] = ()
    lines: Sequence[str] = ()
    warnings: Sequence[str] = ()
    figures: Mapping[str, Figure] = dataclasses.field(default_factory=dict)
    files: Mapping[str, Callable[[Path], object]] = dataclasses.field(default_factory=dict)
    kept: Sequence[Path] = ()
    live: Callable[[], Sequence[Live | None]] = nothing_live
    asked: Mapping[str, object] = dataclasses.field(default_factory=dict)
    configuration: Mapping[str, object] | None = None
    failed: str = ""

    def show(self, console: Console, *, details: bool = False) -> None:
        """Print what was found in sentences, then the tables and the lines."""
        for line in self.verdict.said:
            console.print(line, highlight=False)
        for table in (*self.tables, *(self.details if details else ())):
            console.print(table, highlight=False)
        for line in self.lines:
            console.print(line, highlight=False)

    def conclude(self, console: Console) -> None:
        """Print the next command, as one line, so that it can be copied."""
        for line in self.verdict.lines[len(self.verdict.said) :]:
            console.print(line, highlight=False, soft_wrap=True)

    def as_json(self) -> Any:
        """The numbers, with the entries `verdict` and `next`."""
        return self.numbers | self.verdict.as_json()

    def save(self, folder: str | Path | None = None, progress: Progress = silent) -> list[Path]:
        """Draw and save the figures, write the further files, and return the places of all.

        folder: it is made if it is not there; None for that of the outcome
        """
        from .. import figures

        place = self.folder if folder is None else Path(folder)
        if place is None or not (self.figures or self.files):
            return [*self.kept]
        place.mkdir(parents=True, exist_ok=True)
        paths = []
        for done, (name, figure) in enumerate(self.figures.items()):
            progress(name, done, len(self.figures))
            paths.append(figures.save(figure.draw(), place / f"{name}.png"))
        for name, write in self.files.items():
            write(place / name)
            paths.append(place / name)
        return [*paths, *self.kept]

    def page(self, path: str | Path, drawn: Sequence[Path] = ()) -> Path:
        """Write one self-contained HTML page of the outcome.

        drawn: files of the figures, where they are saved already, before all other files
        """
        from ..figures.report import command_report

        files, live = {file.stem: file for file in reversed(drawn)}, self.live()
        (page,) = command_report(
            path,
            self.command,
            [table for table in (*self.tables, *self.details) if isinstance(table, Table)],
            [
                (figure.caption, files[name] if name in files else figure.draw())
                for name, figure in self.figures.items()
                if not (live and figure.live)
            ],
            scenario=self.scenario,
            configuration=self.configuration,
            lines=self._words(),
            asked=self.asked,
            verdict=self.verdict,
            live=live,
        )
        return page

    def __repr__(self) -> str:
        """The verdict, the tables and the lines as text."""
        text = io.StringIO()
        console = Console(file=text, width=WIDTH, force_jupyter=False)  # which prints beside it
        self.show(console)
        for line in self.warnings:
            console.print(line, highlight=False)
        self.conclude(console)
        return text.getvalue().rstrip()

    def _repr_html_(self) -> str:
        """The verdict, the tables, the lines and the figures, as a notebook shows them."""
        from ..figures.report import fragment

        pictures = [(figure.caption, figure.draw()) for figure in self.figures.values()]
        tables = [table for table in self.tables if isinstance(table, Table)]
        return fragment(self.verdict, tables, self._words(), pictures)

    def _words(self) -> list[str]:
        """All lines, and what went wrong."""
        between = (line for line in (*self.tables, *self.details) if isinstance(line, str))
        return [*between, *self.lines, *self.warnings]
