"""What a terminal shows: text as it stands, whatever is in it, and tables that fit its width."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from typing import Any

import rich.console
import rich.table
from rich.console import ConsoleOptions, RenderResult
from rich.text import Text

from ..storage.printable import printable

WHOLE = 0.6  # of the width: a column that is wider than this is folded in any case


class Console(rich.console.Console):
    """A console of rich that takes no text for markup.

    Titles, names and paths are the user's, and are shown as they are.
    """

    def __init__(self, **options: Any):
        super().__init__(markup=False, emoji=False, **options)

    def render_str(self, text: str, **options: Any) -> Text:
        return super().render_str(printable(text), **options)


class Table(rich.table.Table):
    """A table of rich in which nothing is cut off, under a title that may be wider than the table.

    Title, headers and cells are text as it stands, for every console. Where the columns do not fit
    beside each other without a word being broken, the table is printed in several parts, one below
    the other, and each part begins with the first column.
    """

    def __init__(self, *headers: str, title: str = "", **options: Any):
        super().__init__(title=_plain(title) if title else None, **options)
        for header in headers:
            self.add_column(header)

    def add_column(self, header: Any = "", *args: Any, whole: bool = False, **options: Any) -> None:
        """whole: other columns are folded before this one"""
        options = {"overflow": "fold", "no_wrap": whole} | options
        super().add_column(_plain(header), *args, **options)

    def add_row(self, *cells: Any, **options: Any) -> None:
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
        sizes = [self._measure_column(console, options, column) for column in self.columns]
        fits = sum(size.minimum + 1 for size in sizes) + 1 <= options.max_width
        groups: list[list[int]] = [[*range(len(sizes))]]
        if not fits and len(sizes) > 1:
            groups = [[0]]
            for i in range(1, len(sizes)):
                width = sum(sizes[k].maximum + 1 for k in (*groups[-1], i)) + 1
                if width > options.max_width and len(groups[-1]) > 1:
                    groups.append([0])
                groups[-1].append(i)
        for group in groups:
            part = copy.copy(self)
            part.title, part.columns = None, []
            for place, i in enumerate(group):
                column = copy.copy(self.columns[i])
                column._index = place
                column.no_wrap &= sizes[i].maximum <= WHOLE * options.max_width
                part.columns.append(column)
            yield part


def _plain(cell: Any) -> Any:
    return Text(printable(cell)) if isinstance(cell, str) else cell
