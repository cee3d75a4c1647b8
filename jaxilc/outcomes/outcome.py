"""What a command found, as one object of which terminal, JSON, page and notebook are views.

This module does not import NumPy or JAX, so that commands that need neither stay fast.
"""

from __future__ import annotations

import copy
import dataclasses
import io
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, TypeAlias, TypeVar

import rich.console
import rich.table
from rich.console import ConsoleOptions, RenderableType, RenderResult
from rich.text import Text

from ..storage.reading import printable

if TYPE_CHECKING:
    from ..figures.description import Figure as Description
    from ..figures.page import Live
    from ..figures.paper import Drawing
    from ..pytree.aliases import Value
    from ..scenarios import Scenario

T = TypeVar("T")


class Verdict(NamedTuple):
    """What a command found, and what to do next.

    said: one or two sentences
    what: what the next command does, in words
    following: the next command, quoted for a shell; empty if there is none
    """

    said: tuple[str, ...]
    what: str = ""
    following: str = ""

    @property
    def lines(self) -> list[str]:
        """The lines to print."""
        head = f"Next, {self.what}: " if self.what else "Next: "
        return [*self.said, *([head + self.following] if self.following else [])]

    def as_json(self) -> dict[str, object]:
        """The entries for the file of the numbers."""
        return {"verdict": list(self.said), "next": self.following}


# Tables that fit the width of a terminal
# --------------------------------------------------------------------------------------------------


WHOLE = 0.6  # share of the width; a column that is wider than this is always folded
NARROWEST = 4  # least width of a column, with the space beside the text


class Console(rich.console.Console):
    """A console of rich that shows titles, names and paths of the user without markup."""

    def __init__(self, **options: Value):
        super().__init__(markup=False, emoji=False, highlight=False, **options)

    def render_str(self, text: str, **options: Value) -> Text:
        return super().render_str(printable(text), **options)


class Table(rich.table.Table):
    """A table of rich that is never truncated, with a title that may be wider than the table.

    Title, headers and cells are shown unchanged on every console. Where the columns do not fit
    beside each other without breaking a word, the table is printed in several parts, one below the
    other, and each part begins with the first column.

    headers: of the columns of texts;  right: of those of numbers, which stand behind them
    """

    def __init__(
        self,
        *headers: str,
        right: Iterable[str] = (),
        title: str = "",
        rows: Iterable[Iterable[str]] = (),
        show_header: bool = True,
    ):
        super().__init__(title=Text(printable(title)) if title else None, show_header=show_header)
        for header in headers:
            self.add_column(header)
        for header in right:
            self.add_column(header, justify="right")
        for row in rows:
            self.add_row(*row)

    def add_column(
        self, header: RenderableType = "", *args: Value, whole: bool = False, **options: Value
    ) -> None:
        """Add a column; other columns are folded before one that is to be whole."""
        super().add_column(_plain(header), *args, overflow="fold", no_wrap=whole, **options)

    def add_row(self, *cells: RenderableType | None, **options: Value) -> None:
        super().add_row(*map(_plain, cells), **options)

    def __rich_console__(
        self, console: rich.console.Console, options: ConsoleOptions
    ) -> RenderResult:
        if self.title:
            yield Text(str(self.title), style="table.title")
        for part in self._parts(console, options):
            yield from rich.table.Table.__rich_console__(part, console, options)

    def _parts(self, console: rich.console.Console, options: ConsoleOptions) -> Iterator[Table]:
        """Tables without a title that fit the width: one, or several with the same first column."""
        room = options.max_width - 1
        sizes = []
        for column in self.columns:
            least, most = self._measure_column(console, options, column)
            sizes.append((most if column.no_wrap and most <= WHOLE * room else least, most))
        groups: list[list[int]] = [[*range(len(sizes))]]
        if sum(least + 1 for least, _ in sizes) > room and len(sizes) > 1:
            groups = [[0]]
            for i in range(1, len(sizes)):
                wide = sum(sizes[k][1] + 1 for k in (*groups[-1], i)) > room
                if wide and len(groups[-1]) > 1:
                    groups.append([0])
                groups[-1].append(i)
        for group in groups:
            widths = _shared(room - len(group), [sizes[i] for i in group])
            part = copy.copy(self)
            part.title, part.columns = None, []
            for place, (i, width) in enumerate(zip(group, widths, strict=True)):
                column = copy.copy(self.columns[i])
                column._index, column.no_wrap = place, False
                column.width = width - self._get_padding_width(place)
                part.columns.append(column)
            yield part


def _shared(room: int, sizes: list[tuple[int, int]]) -> list[int]:
    """Widths of columns that fit the room: the widest are reduced, first down to their least width.

    sizes: for each column its least width, at which no word is broken, and its width without a fold
    """
    widths, least = [most for _, most in sizes], [low for low, _ in sizes]
    while sum(widths) > room:
        loose = [i for i, width in enumerate(widths) if width > least[i]]
        widest = max(loose or range(len(widths)), key=lambda i: widths[i])
        if widths[widest] <= NARROWEST:
            break
        widths[widest] -= 1
    return widths


def _plain(cell: T) -> T | Text:
    return Text(printable(cell)) if isinstance(cell, str) else cell


# What a command found
# --------------------------------------------------------------------------------------------------


WIDTH = 100  # columns of an outcome as text
Numbers: TypeAlias = dict[str, Any]  # what was found, as JSON, by keys that stay the same
Interactive: TypeAlias = "Description | Live | None"  # a figure of a page, described or made


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
    draw: one of `figures`, with its arguments
    live: whether the interactive figures of a page show the same
    """

    caption: str
    draw: partial[Drawing]
    live: bool = False

    def described(self) -> Description:
        """What is drawn, as a page shows it."""
        of: Value = self.draw.func
        return of.described(*self.draw.args, **self.draw.keywords)


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
    live: a function that makes or describes the interactive figures of a page; None for the figures
        that are live, described
    asked: further rows of a page, below the name of the command
    configuration: all that determines the numbers; None for that of the scenario
    failed: a sentence where the numbers contradict each other, or nothing was found; the command
        then fails
    """

    command: str
    numbers: Numbers
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
    live: Callable[[], Sequence[Interactive]] | None = None
    asked: Mapping[str, object] = dataclasses.field(default_factory=dict)
    configuration: Mapping[str, object] | None = None
    failed: str = ""

    def show(self, console: Console, *, details: bool = False) -> None:
        """Print what was found in sentences, then the tables and the lines."""
        for line in self.verdict.said:
            console.print(line)
        for table in (*self.tables, *(self.details if details else ())):
            console.print(table)
        for line in self.lines:
            console.print(line)

    def conclude(self, console: Console) -> None:
        """Print the next command, as one line, so that it can be copied."""
        for line in self.verdict.lines[len(self.verdict.said) :]:
            console.print(line, soft_wrap=True)

    def as_json(self) -> Numbers:
        """The numbers, with the entries `verdict` and `next`."""
        return self.numbers | self.verdict.as_json()

    def save(self, folder: str | Path | None = None, progress: Progress = silent) -> list[Path]:
        """Save figures and files to the folder, or the outcome's own; return the places of all."""
        from .. import figures

        place = self.folder if folder is None else Path(folder)
        if place is None or not (self.figures or self.files):
            return [*self.kept]
        place.mkdir(parents=True, exist_ok=True)
        for name, write in self.files.items():  # first, so that no figure that fails loses them
            write(place / name)
        paths = []
        for done, (name, figure) in enumerate(self.figures.items()):
            progress(name, done, len(self.figures))
            paths.append(figures.save(figure.draw(), place / f"{name}.png"))
        return [*paths, *(place / name for name in self.files), *self.kept]

    def page(self, path: str | Path, drawn: Sequence[Path] = ()) -> Path:
        """Write one self-contained HTML page, with files of figures that are drawn already."""
        from ..figures.report import command_report

        files, live = {file.stem: file for file in reversed(drawn)}, self._interactive()
        return command_report(
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

    def __repr__(self) -> str:
        """The verdict, the tables and the lines as text."""
        text = io.StringIO()
        console = Console(file=text, width=WIDTH, force_jupyter=False)  # which prints beside it
        self.show(console)
        for line in self.warnings:
            console.print(line)
        self.conclude(console)
        if self.failed:
            console.print(self.failed)
        return text.getvalue().rstrip()

    def _repr_html_(self) -> str:
        """The verdict, the tables, the lines and the figures, as a notebook shows them."""
        from ..figures.report import fragment

        pictures = [(figure.caption, figure.draw()) for figure in self.figures.values()]
        tables = [table for table in self.tables if isinstance(table, Table)]
        return fragment(self.verdict, tables, self._words(), pictures)

    def _interactive(self) -> Sequence[Interactive]:
        if self.live is not None:
            return self.live()
        return [figure.described() for figure in self.figures.values() if figure.live]

    def _words(self) -> list[str]:
        """All lines, and what went wrong."""
        between = (line for line in (*self.tables, *self.details) if isinstance(line, str))
        return [*between, *self.lines, *self.warnings, *([self.failed] if self.failed else [])]
