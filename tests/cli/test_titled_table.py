"""Titles of tables on a terminal."""

from __future__ import annotations

import re

import pytest
from rich.console import Console

from jaxilc.cli.titled_table import Console as Plain
from jaxilc.cli.titled_table import Table
from jaxilc.storage.printable import printable

TITLE = "Voice-coil motor for noncircular turning\nsettled error [µm] by trial, published value in brackets"


def test_a_title_is_not_folded_to_the_width_of_its_table():
    table = Table("trial", "pid", title=TITLE)
    table.add_row("1", "20.4")
    console = Console(width=100)
    with console.capture() as shown:
        console.print(table)
    lines = [line.rstrip() for line in shown.get().splitlines()]
    assert lines[:2] == [
        "Voice-coil motor for noncircular turning",
        "settled error [µm] by trial, published value in brackets",
    ]
    assert len(lines) == 7
    assert all(len(line) == len("┃ trial ┃ pid  ┃") for line in lines[2:])
    assert str(table.title) == TITLE  # which a report reads


HOSTILE = "[bold]x[/nothing] :x: \x1b[31mred\x07 \u202ereversed\ud800 [mm] $y$"
AS_IT_STANDS = "[bold]x[/nothing] :x: \\x1b[31mred\\x07 \\u202ereversed\\ud800 [mm] $y$"


@pytest.mark.parametrize("terminal", [False, True])
def test_text_of_the_user_is_shown_as_it_stands(terminal):
    """Neither markup nor emoji, and no code that a terminal would act on, in tables, lines and
    headers, on our consoles or another.
    """
    table = Table("header " + HOSTILE, title="title " + HOSTILE)
    table.add_row("cell " + HOSTILE)
    for console in (
        Plain(width=200, force_terminal=terminal, color_system=None),
        Console(width=200, color_system=None),
    ):
        with console.capture() as shown:
            console.print(table)
            if isinstance(console, Plain):
                console.print("line " + HOSTILE, highlight=False, soft_wrap=True)
        told = shown.get()
        if terminal and isinstance(console, Plain):
            told = re.sub("\x1b\\[[0-9;]*m", "", told)
        assert "\x1b" not in told
        for where in ("title", "header", "cell", *(["line"] if isinstance(console, Plain) else [])):
            assert f"{where} {AS_IT_STANDS}" in told


def test_printable_keeps_what_can_be_printed():
    for text in ("Förderachse 3 µm/s² – “x”", "两轴", "a\nb", "1\u202f000\u00a0mm"):
        assert printable(text) == text
    assert printable("\t\r\x9b\x00") == "\\t\\r\\x9b\\x00"
