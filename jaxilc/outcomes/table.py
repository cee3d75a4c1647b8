"""Output to a terminal: text without interpretation, and tables that fit the width."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from typing import Any

import rich.console
import rich.table
from rich.console import ConsoleOptions, RenderResult
from rich.text import Text

from ..storage.printable import printable

WHOLE = 0.6  # share of the width; a column that is wider than this is always folded
NARROWEST = 4  # least width of a column, with the space beside the text


class Console(rich.console.Console):
    """A console of rich that never interprets text as markup.

    Titles, names and paths come from the user, and are shown unchanged.
    """

    def __init__(self, **options: Any):
        super().__init__(markup=False, emoji=False, **options)

    def render_str(self, text: str, **options: Any) -> Text:
        return super().render_str(printable(text), **options)


class Table(rich.table.Table):
    """A table of rich that is never truncated, with a title that may be wider than the table.

    Title, headers and cells are shown unchanged on every console. Where the columns do not fit
    beside each other without breaking a word, the table is printed in several parts, one below the
    other, and each part begins with the first column.
    """

    def __init__(self, *headers: str, title: str = "", **options: Any):
        super().__init__(title=_plain(title) if title else None, **options)
        for header in headers:
            self.add_column(header)

    def add_column(self, header: Any = "", *args: Any, whole: bool = False, **options: Any) -> None:
        """Add a column.

        whole: whether other columns are folded before this one
        """
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
    """Widths of columns that fit the room: the widest are reduced, each down to its least width.

    Where even the least widths do not fit, the widest columns become narrower than that.

    room: width that all columns share
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


def _plain(cell: Any) -> Any:
    return Text(printable(cell)) if isinstance(cell, str) else cell
