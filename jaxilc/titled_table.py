"""Tables for a terminal."""

from __future__ import annotations

import copy

import rich.table
from rich.console import Console, ConsoleOptions, RenderResult


class Table(rich.table.Table):
    """A table of rich under its title, which is as wide as it needs to be: rich folds it to the width of the table."""

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        if self.title:
            yield console.render_str(self.title, style="table.title") if isinstance(self.title, str) else self.title
        bare = copy.copy(self)
        bare.title = None
        yield from rich.table.Table.__rich_console__(bare, console, options)
