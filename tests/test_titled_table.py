"""Titles of tables on a terminal."""

from __future__ import annotations

from rich.console import Console

from jaxilc.titled_table import Table

TITLE = "Voice-coil motor for noncircular turning\nsettled error \\[µm] by trial, published value in brackets"


def test_a_title_is_not_folded_to_the_width_of_its_table():
    table = Table("trial", "pid", title=TITLE)
    table.add_row("1", "20.4")
    console = Console(width=100)
    with console.capture() as shown:
        console.print(table)
    lines = [line.rstrip() for line in shown.get().splitlines()]
    assert lines[:2] == ["Voice-coil motor for noncircular turning", "settled error [µm] by trial, published value in brackets"]
    assert len(lines) == 7
    assert all(len(line) == len("┃ trial ┃ pid  ┃") for line in lines[2:])
    assert table.title == TITLE  # which a report reads
