"""What a terminal shows: text as it stands, whatever is in it, and tables under their titles."""

from __future__ import annotations

import copy
from typing import Any

import rich.console
import rich.table
from rich.console import ConsoleOptions, RenderResult
from rich.text import Text

from ..storage.printable import printable


class Console(rich.console.Console):
    """A console of rich that takes no text for markup: titles, names and paths are the user's, and
    shown as they are.
    """

    def __init__(self, **options: Any):
        super().__init__(markup=False, emoji=False, **options)

    def render_str(self, text: str, **options: Any) -> Text:
        return super().render_str(printable(text), **options)


class Table(rich.table.Table):
    """A table of rich under its title, which is as wide as it needs to be: rich folds it to the
    width of the table.

    Title, headers and cells are text as it stands, for every console.
    """

    def __init__(self, *headers: str, title: str = "", **options: Any):
        super().__init__(*headers, title=_plain(title) if title else None, **options)

    def add_column(self, header: Any = "", *args: Any, **options: Any) -> None:
        super().add_column(_plain(header), *args, **options)

    def add_row(self, *cells: Any, **options: Any) -> None:
        super().add_row(*map(_plain, cells), **options)

    def __rich_console__(
        self, console: rich.console.Console, options: ConsoleOptions
    ) -> RenderResult:
        if self.title:
            yield Text(str(self.title), style="table.title")
        bare = copy.copy(self)
        bare.title = None
        yield from rich.table.Table.__rich_console__(bare, console, options)


def _plain(cell: Any) -> Any:
    return Text(printable(cell)) if isinstance(cell, str) else cell
