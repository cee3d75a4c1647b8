"""These tests check the titles of tables on a terminal."""

from __future__ import annotations

import re

import numpy as np
import pytest
from made_datasets import sweep_of
from rich.console import Console

from jaxilc.identification import Grown
from jaxilc.identification.grown import Tried
from jaxilc.identification.grown_response import LineModel
from jaxilc.identification.problem import Parts, Projected
from jaxilc.outcomes.certifying import _of_all
from jaxilc.outcomes.identifying import grown_response_table, grown_table
from jaxilc.outcomes.outcome import Console as Plain
from jaxilc.outcomes.outcome import Table
from jaxilc.outcomes.sweeping import grid_numbers, grid_table
from jaxilc.scenarios import load
from jaxilc.storage.reading import printable
from jaxilc.sweeps import best_points

TITLE = (
    "Voice-coil motor for noncircular turning\n"
    "settled error [µm] by trial, published value in brackets"
)


def printed(table, width):
    console = Console(width=width)
    with console.capture() as shown:
        console.print(table)
    return shown.get()


def test_a_title_is_not_folded_to_the_width_of_its_table():
    table = Table("trial", "pid", title=TITLE)
    table.add_row("1", "20.4")
    shown = printed(table, 100)
    lines = [line.rstrip() for line in shown.splitlines()]
    assert lines[:2] == [
        "Voice-coil motor for noncircular turning",
        "settled error [µm] by trial, published value in brackets",
    ]
    assert len(lines) == 7
    assert all(len(line) == len("┃ trial ┃ pid  ┃") for line in lines[2:])
    assert str(table.title) == TITLE  # a report reads this title


def test_a_table_that_is_too_wide_goes_on_below():
    """A table that is too wide continues in further parts below.

    Every part has the first column, no cell is cut, and each other column appears once.
    """
    names = [f"scheme-number-{i}" for i in range(9)]
    table = Table("trial", *names, title=TITLE)
    table.add_row("1", *(f"cell {i}" for i in range(9)))
    shown = printed(table, 80)
    lines = shown.splitlines()
    assert max(map(len, lines)) <= 80
    assert "…" not in shown
    headers = [line.replace("┃", " ").split() for line in lines if "┃" in line]
    assert [header[0] for header in headers] == ["trial"] * len(headers)
    assert [name for header in headers for name in header[1:]] == names
    assert [f"cell {i}" in shown for i in range(9)] == [True] * 9
    assert len(table.columns) == 10  # a report reads these columns


def test_a_word_is_not_broken_where_another_column_can_give_way():
    table = Table("entry", "rms error", "max error", "effort", "file", "what was seen")
    table.add_row("1", "0.7071", "1", "0", "measured-trial.csv", "a warning of many words " * 3)
    shown = printed(table, 60)
    assert "measured-trial.csv" in shown
    assert max(map(len, shown.splitlines())) == 60


def test_a_column_that_is_whole_is_not_folded():
    table = Table(title="one")
    table.add_column("--set", whole=True)
    table.add_column("value")
    table.add_row("machine.plant.a.long.path.of.a.parameter", "many words " * 9)
    shown = printed(table, 80)
    assert "machine.plant.a.long.path.of.a.parameter" in shown
    assert max(map(len, shown.splitlines())) <= 80


HOSTILE = "[bold]x[/nothing] :x: \x1b[31mred\x07 \u202ereversed\ud800 [mm] $y$"
AS_IT_STANDS = "[bold]x[/nothing] :x: \\x1b[31mred\\x07 \\u202ereversed\\ud800 [mm] $y$"


@pytest.mark.parametrize("terminal", [False, True])
def test_text_of_the_user_is_shown_as_it_stands(terminal):
    """Text of the user is shown unchanged, on every console.

    Neither markup, nor emoji codes, nor control sequences of the terminal take effect. This holds
    in tables, their headers and titles, and in single lines.
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


def test_the_chosen_order_is_marked_in_every_part_of_a_table():
    """At 80 columns the mark was a column of its own, below the orders of which it is one."""
    at = Projected(*[np.zeros(1)] * 4, 0.0)
    orders = [
        LineModel(Parts(np.zeros((q, 2))), at, 0.1, 1.0, -9.0 - q, 1.0, (0.5, 0.9), 0.1, 94.3, 0.2)
        for q in (1, 2)
    ]
    tried = [Tried(2 * q, 0, q, 2, True, 3, 9, 0.0123, -1e4 * q, 99.9) for q in (1, 2)]
    grown = Grown(None, tuple(tried), tried[1], ())  # ty: ignore[invalid-argument-type]
    for table in (grown_response_table(orders, orders[1]), grown_table(grown)):
        shown = printed(table, 80)
        rows = [line for line in shown.splitlines() if line.startswith("│")]
        parts = shown.count("┏")
        assert parts > 1
        assert [row.startswith("│   * 4 │") for row in rows] == [False, True] * parts
    assert "the fit here counts all lines alike" in str(
        grown_response_table(orders, orders[1]).title
    )


def test_a_share_of_no_trials_is_left_blank():
    shares = (float("nan"), 0.0, 5e-5, 0.25)
    assert [_of_all(x) for x in shares] == ["", "nowhere", "< 0.01 %", "25.00 %"]


@pytest.mark.parametrize(("error", "near"), [(2.0, "100.0%"), (float("inf"), "–")])
def test_no_point_is_within_twice_an_error_that_diverged(error, near):
    row = {"own": {"a": 1.0}, "error": error, "near": 1.0, "diverged": 1.0}
    numbers = {"figure": "rms", "unit": "", "grid": {"axes": {"a": 3}, "best": {"law": row}}}
    assert re.search(rf" {near} +│ +100.0% ", printed(grid_table(numbers), 100))


def test_a_shared_axis_has_the_names_and_values_of_each_scheme():
    errors = np.array([[4.0, 1.0], [2.0, 9.0]])[:, :, None, None, None]
    axes = {"a.lam": [0.5, 12.0], "trials": [1]}
    dataset = sweep_of(errors, ("a", "b"), "settled_error", **axes)
    dataset = dataset.assign_coords({"b.mu": ("a.lam", [3.0, 30.0])})
    numbers = grid_numbers(load("cao-2019"), best_points(dataset), dataset)
    table = grid_table(numbers | {"figure": "settled error", "unit": "mm"})
    assert [str(column.header) for column in table.columns[:3]] == [
        "scheme", "a.lam / b.mu", "trials",
    ]  # fmt: skip
    cells = [[str(cell) for cell in column.cells] for column in table.columns[:3]]
    assert cells == [["a", "b"], ["12", "3"], ["1", "1"]]
    assert numbers["grid"]["best"]["b"]["point"] == {"a.lam": 0.5, "trials": 1}
