"""Text exports of TwinCAT Scope (Beckhoff TE13xx; Export, CSV).

    Name<TAB>my scope                        the scope: name, file, start and end of the export
    File<TAB>C:\\my scope.csv
    Starttime of export<TAB>132959733843760000<TAB>...
    Endtime of export<TAB>...
    (blank lines)
    Name<TAB>torque<TAB>Name<TAB>position    the channels, key and value: Name, SymbolComment,
    SampleTime[ms]<TAB>1<TAB>SampleTime[ms]<TAB>1      Data-Type, SampleTime[ms], SymbolName, Unit
    Unit<TAB>(None)<TAB>Unit<TAB>mm (Length)           and others; some exports have Name only
    (blank line)
    0<TAB>-1,0379<TAB>0<TAB>0,25             pairs of time [ms] and value
    EOF                                      where this was asked for

The key `Name` stands above each column of times. With the option "Timelines: for each sample time",
channels of one sample time share a column: Name, a, b, Name, c. The separator is what stands behind
the first `Name`: a tab, semicolon, comma or colon; not a blank, since keys and names have blanks
within. A decimal mark is a comma or a point. With "Full timestamp" the times are ticks of 100 ns
since 1601. Channels of longer sample times end in earlier rows, or repeat their last time and value
("Interpolation: fill with previous value").
"""

from __future__ import annotations

import csv
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..pytree.closest import listed
from ..pytree.ranges import brief
from ..storage.columns import LARGEST_TABLE, is_number, numbers_in
from ..storage.reading import read_text
from .resampling import Signal
from .time_column import STEP_TOLERANCE

END = "EOF"
OF_THE_SCOPE = ("File", "StartRecord", "EndRecord", "Starttime of export", "Endtime of export")
TICKS = 1e15  # times above this are ticks of 100 ns, since 1601; 1e15 ms are 30,000 years
MOST_HEADER = 64  # lines


class _Export(NamedTuple):
    """The header of an export: the rows of its channels by key, the times' columns, its data."""

    channels: dict[str, list[str]]
    times: list[int]
    rows: list[list[str]]
    first: int


def is_twincat(path: str | Path) -> bool:
    """Whether a text file is an export of TwinCAT Scope: `Name`, then a key of the scope."""
    text = read_text(path, LARGEST_TABLE)[:4096]
    if not text.startswith("Name") or not _separator(text):
        return False
    heads = [line.split(_separator(text))[0] for line in text.splitlines()[:MOST_HEADER]]
    return any(head.strip('"') in OF_THE_SCOPE for head in heads)


def _separator(text: str) -> str:
    """What stands behind the first key, `Name`; "" where that separates nothing."""
    behind = text[4:5]
    return "" if behind.isalnum() or behind in "\r\n\"'" else behind


def read_twincat(path: str | Path, names: list[str]) -> list[Signal]:
    """The channels with these names, or with these names of symbols such as `MAIN.position`.

    Raises ValueError naming the file: for a channel that is missing, a value that is not a number,
    and times whose step is not the sample time that the header tells.
    """
    export = _export(path)
    return [_signal(path, export, name) for name in names]


def _export(path) -> _Export:
    text = read_text(path, LARGEST_TABLE)
    separator = _separator(text)
    if separator == " ":
        raise ValueError(
            f"read_record: {path} is an export of TwinCAT Scope separated by blanks; export it "
            "with tabs or semicolons"
        )
    read = csv.reader(text.splitlines(), delimiter=separator)
    rows = [[cell.strip() for cell in row] or [""] for row in read]
    first = next((i for i, row in enumerate(rows) if is_number(row[0])), len(rows))
    heads = [i for i in range(first) if rows[i][0] == "Name"]
    if not heads or first == len(rows):
        raise ValueError(
            f"read_record: {path} is an export of TwinCAT Scope without channels or without data"
        )
    channels = {row[0]: row for row in rows[heads[-1] : first] if row[0]}
    times = [i for i, cell in enumerate(channels["Name"]) if cell == "Name"]
    end = next((i for i, row in enumerate(rows[first:], first) if row[0] == END), len(rows))
    decimal = separator != ","
    data = [[c.replace(",", ".") for c in row] if decimal else row for row in rows[first:end]]
    return _Export(channels, times, data, first + 1)


def _signal(path, export: _Export, name: str) -> Signal:
    names = export.channels["Name"]
    symbols = export.channels.get("SymbolName", [])
    places = [i for i in range(len(names)) if i not in export.times and names[i]]
    at = [i for i in places if name in (names[i], *symbols[i : i + 1])]
    if len(at) != 1:
        present = listed(names[i] for i in places)
        what = "no channel" if not at else f"{len(at)} channels"
        raise ValueError(f"read_record: {path} has {what} {brief(name)}; present are {present}")
    column = max(i for i in export.times if i < at[0])
    lines, times, values = [], [], []
    for line, row in enumerate(export.rows, export.first):
        cells = row[column : column + 1] + row[at[0] : at[0] + 1]
        if not any(cells):
            continue  # a channel of a longer sample time has ended
        found = numbers_in(cells, (0, 1))
        if not np.all(np.isfinite(found)):
            raise ValueError(
                f"read_record: {path}, line {line}: {name} = {cells} is not a time and a value"
            )
        again = times and cells[0] == times[-1] and found[1] == values[-1]
        if not again:
            lines.append(f"line {line}")
            times.append(cells[0])
            values.append(found[1])
    seconds = _seconds(times)
    _check_step(path, export, name, at[0], seconds)
    unit = (export.channels.get("Unit", [])[at[0] : at[0] + 1] or [""])[0].split(" (")[0]
    return Signal(seconds, np.array(values), lines, "" if unit == "(None)" else unit)


def _seconds(times: list[str]) -> np.ndarray:
    """The times in seconds; ticks are subtracted as whole numbers, which a float could not hold."""
    if times and float(times[0]) > TICKS:
        return np.array([int(t) - int(times[0]) for t in times]) * 1e-7
    return np.array(times, float) * 1e-3


def _check_step(path, export: _Export, name: str, at: int, seconds) -> None:
    told = export.channels.get("SampleTime[ms]", [])[at : at + 1]
    if not told or not is_number(told[0]) or len(seconds) < 2:
        return
    expected = float(told[0].replace(",", ".")) * 1e-3
    step = float(np.median(np.diff(seconds)))
    if expected > 0 and abs(step / expected - 1) > STEP_TOLERANCE:
        raise ValueError(
            f"read_record: {path}: the times of {name} step by {1e3 * step:.6g} ms where its "
            f"SampleTime[ms] is {1e3 * expected:g}; export with a column of times for each channel"
        )
