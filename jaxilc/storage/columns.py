"""Columns of numbers from text files, as machines, scopes and spreadsheets write them.

What is understood, in this order:

    comments    lines that begin with `#` or `%` anywhere, and with `;` above the header
    header      the first line that is no comment; where that line holds numbers only, the last
                comment above it, if it has as many cells (so `numpy.savetxt` writes its header)
    units       a line below the header that holds units and no number, such as `s;V;mm`, or
                their names, such as `second,Volt,Volt`
    separators  the one of a first line such as `sep=;`; else semicolon, tab or comma, whichever
                the header has first in this order, else blanks
    decimals    a point; or a comma, where the separator is not a comma (German spreadsheets and
                scopes). A file that has both is refused: a comma could also group thousands.
"""

from __future__ import annotations

import csv
import io
import math
import re
import unicodedata
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TypeVar

from ..pytree.closest import listed
from ..pytree.ranges import brief
from .reading import LARGEST_TABLE, quoted, read_text

T = TypeVar("T")
Rows = Iterator[tuple[int, list[str]]]
LONGEST_LINE = 1_000_000  # characters
SEPARATORS = ";\t,"
COMMENTS = "#%"
_UNITS = (
    "s ms us µs μs ns Hz kHz rad/s V mV kV A mA N kN Nm m mm um µm μm nm rad mrad deg ° rpm 1/min "
    "m/s mm/s m/min m/s^2 mm/s^2 m/s² dB abs % inc counts - g bar"
)
# Units that make a line below the header one of units. A unit in brackets does so too.
KNOWN_UNITS = frozenset(_UNITS.split())
# Names of units, as oscilloscopes write them below their header.
NAMED_UNITS = {
    f"{name}{plural}": unit
    for name, unit in (
        *(("second", "s"), ("sec", "s"), ("millisecond", "ms"), ("microsecond", "us")),
        *(("volt", "V"), ("millivolt", "mV"), ("ampere", "A"), ("amp", "A"), ("hertz", "Hz")),
    )
    for plural in ("", "s")
}
_HEADING = re.compile(r"^([^\[\]]+?)\s*(?:\[([^\[\]]*)\])?$")
_IN_ROUND = re.compile(r"^(.+?)\s*\(([^()]*)\)$")
_SEPARATOR = re.compile(r"^sep=(.)$", re.IGNORECASE)  # the first line that spreadsheets understand
_DECIMAL_COMMA = re.compile(r"^[+-]?\d*,\d+(?:[eE][+-]?\d+)?$|^[+-]?\d+,(?:[eE][+-]?\d+)?$")
_DECIMAL_POINT = re.compile(r"^[+-]?\d*\.\d*(?:[eE][+-]?\d+)?$")
_BLANKS = re.compile(r"[^\s\[(]+(?:\s*\[[^\]]*\]|\s*\([^)]*\))?|\([^)]*\)|\[[^\]]*\]")


def read_columns(path: str | Path, names: Sequence[str] = ()) -> tuple[list[str], Rows]:
    """The header of a text file of columns, and its rows that are not empty, with line numbers.

    The rows are an iterator; decimal commas in them are points. The units of a line below the
    header are appended to the headings that have none: `y` and `mm` give `y [mm]`.

    names: headings for a file without a header
    Raises as `read_text`; ValueError for an empty file, for names where the file has a header of
    its own, and, also during the iteration, for a line that is not a row of these columns.
    """
    lines = _Lines(path, read_text(path, LARGEST_TABLE))
    header, first = _header(lines, names)
    if header and names and [*names] != header:
        raise ValueError(
            f"{path} has a header, {quoted(path, listed(header))}; allowed are names of columns "
            "(--columns) for a file without one only"
        )
    header = header or [*names]
    if not header:
        raise ValueError(f"{path} is empty; allowed is a line of headings with numbers below it")
    return header, _checked_rows(lines, header, first)


def is_number(cell: str) -> bool:
    """Whether a cell holds a number, with a decimal point or a decimal comma."""
    return _number(cell, None) is not None or bool(_DECIMAL_COMMA.match(cell.strip()))


def name_and_unit(heading: str) -> tuple[str, str | None]:
    """The name and the unit in the heading of a column, such as `y [mm]`.

    Round brackets hold a unit where it is known, as in `y (mm)`, and are else part of the name.
    The unit is None where the heading has none, such as `y`. The name is empty where the heading
    has neither of these forms.
    """
    if (found := _IN_ROUND.match(heading)) and found[2].strip() in KNOWN_UNITS:
        return found[1], found[2].strip()
    found = _HEADING.match(heading)
    return (found[1], found[2]) if found else ("", None)


def plain_unit(unit: str) -> str:
    """A unit in one spelling: µm is "um" or has either micro sign; "-" or "1" is no unit."""
    unit = unicodedata.normalize("NFKC", unit).strip()
    return {"-": "", "1": "", "um": "μm", "°": "deg"}.get(unit, unit)


def need_unit(path: str | Path, name: str, declared: str, wanted: str) -> None:
    """Raises ValueError for a column in another unit than that of the task."""
    if plain_unit(declared) != plain_unit(wanted):
        raise ValueError(
            f"{path}: {name} is in {declared!r}; this task needs {wanted!r}, "
            "and nothing is converted"
        )


def missing(
    path: str | Path, name: str, present: Iterable[str], option: str = "", what: str = "column"
) -> str:
    """The message that a file has no such column, or no such variable.

    option: what gives the name of another one, if anything does
    """
    other = f"; {option} names another" if option else ""
    return f"{path} has no {what} {brief(name)}; present are {quoted(path, listed(present))}{other}"


def need_one(path: str | Path, headings: Sequence[str], at: int) -> None:
    """Raises ValueError where other columns have the heading, or the name, of the column `at`."""
    count = sum(heading == headings[at] for heading in headings)
    if count > 1:
        raise ValueError(
            f"{path} has {count} columns {quoted(path, brief(headings[at]))}; allowed is one of a "
            "signal: rename the others"
        )


def numbers_in(row: list[str], at: Sequence[int]) -> list[float]:
    """The numbers of a row in the columns `at`; NaN for a cell that is missing or not a number."""
    return [_number(row[i], math.nan) if i < len(row) else math.nan for i in at]


# How it is done
# --------------------------------------------------------------------------------------------------


class _Lines:
    """The rows of a text, cell by cell, without its comments.

    comment: the last comment above the first row, without its mark
    number: number of the line that was read last
    separator: what separates cells; None: blanks
    """

    def __init__(self, path: str | Path, text: str):
        self.path, self.number, self.comment, self.begun = path, 0, "", False
        self.lines = io.StringIO(text, newline="")
        self.separator: str | None = None
        self.reader: Iterator[list[str]] | None = None

    def _plain(self) -> Iterator[str]:
        """The lines that are no comments; blank ones are passed on."""
        for line in self.lines:
            self.number += 1
            if len(line) > LONGEST_LINE:
                raise ValueError(
                    f"{self.path}, line {self.number} has {len(line):,} characters; allowed are "
                    f"{LONGEST_LINE:,}"
                )
            bare = line.lstrip()
            if bare[:1] in (*COMMENTS, *(() if self.begun else ";")) and bare[:1]:
                self.comment = bare.lstrip(COMMENTS + "; ").strip()
            else:
                self.begun = self.begun or bool(bare)
                yield line

    def first(self) -> str:
        """The first line that is neither blank nor a comment; it also sets the separator."""
        lines = (line for line in self._plain() if line.strip())
        line = next(lines, "")
        if said := _SEPARATOR.match(line.rstrip("\r\n")):
            self.separator = said[1]
            return next(lines, "")
        self.separator = next((d for d in SEPARATORS if d in line), None)
        return line

    def split(self, line: str) -> list[str]:
        """The cells of one line."""
        if self.separator is None:
            return _BLANKS.findall(line)
        return [cell.strip() for cell in next(csv.reader([line], delimiter=self.separator), [])]

    def rows(self) -> Rows:
        """The further rows that are not empty."""
        found: Iterator[list[str]] = (line.split() for line in self._plain())
        if self.separator is not None:
            found = csv.reader(self._plain(), delimiter=self.separator)
        while True:
            try:
                row = next(found, None)
            except csv.Error as error:
                raise ValueError(f"{self.path}, line {self.number}: {error}") from None
            if row is None:
                return
            if any(cell.strip() for cell in row):
                yield self.number, row


def _header(lines: _Lines, names: Sequence[str]) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """The headings, and the rows that were read in order to find them."""
    line = lines.first()
    cells = lines.split(line)
    if not cells:
        return [], []
    if all(map(is_number, filter(None, cells))):
        above = lines.split(lines.comment)
        header = above if len(above) == len(cells) and not any(map(is_number, above)) else []
        if not header and not names:
            raise ValueError(
                f"{lines.path} has no header: its line {lines.number} holds {len(cells)} numbers. "
                "Name the columns in their order with --columns (columns), such as --columns t,u,y"
            )
        return header, [(lines.number, cells)]
    second = next(((n, row) for n, row in lines.rows()), None)
    if second is None or not _are_units(second[1]):
        return cells, [second] if second else []
    units = [cell.strip().strip("[]()") for cell in second[1]]
    units = [NAMED_UNITS.get(unit.lower(), unit) for unit in units]
    units += [""] * (len(cells) - len(units))
    return [
        heading if name_and_unit(heading)[1] is not None or not unit else f"{heading} [{unit}]"
        for heading, unit in zip(cells, units, strict=False)
    ], []


def _are_units(row: list[str]) -> bool:
    """Whether a row below the header holds units: no number, and at least one that is known."""
    cells = [cell.strip() for cell in row if cell.strip()]
    if any(map(is_number, cells)):
        return False
    known = {*KNOWN_UNITS, *NAMED_UNITS}
    return any(
        known & {cell, cell.lower()} or cell[:1] + cell[-1:] in ("[]", "()") for cell in cells
    )


def _checked_rows(lines: _Lines, header: list[str], first: list[tuple[int, list[str]]]) -> Rows:
    """The rows with decimal points, none of them longer than the header."""
    comma, point = 0, 0  # lines on which a decimal comma and a decimal point were seen first
    for rows in (iter(first), lines.rows()):
        for number, row in rows:
            if lines.separator != ",":
                cells = [cell.strip() for cell in row]
                with_comma = [bool(_DECIMAL_COMMA.match(cell)) for cell in cells]
                comma = comma or number * any(with_comma)
                point = point or number * any(map(_DECIMAL_POINT.match, cells))
                if comma and point:
                    raise ValueError(
                        f"{lines.path} has decimal commas (line {comma}) and decimal points (line "
                        f"{point}); allowed is one of them, since a comma could group thousands"
                    )
                row = [
                    cell.replace(",", ".") if decimal else cell
                    for cell, decimal in zip(row, with_comma, strict=True)
                ]
            if any(cell.strip() for cell in row[len(header) :]):
                said = f"{len(row)} cells where the header has {len(header)}"
                if lines.separator == ",":
                    said += "; are these decimal commas? Separate the columns by semicolons or "
                    said += "tabs then"
                raise ValueError(f"{lines.path}, line {number}: {said}")
            yield number, row


def _number(cell: str, other: T) -> float | T:
    """The number in a cell, with a decimal point; where it holds none, the other value."""
    try:
        return float(cell)
    except ValueError:
        return other
