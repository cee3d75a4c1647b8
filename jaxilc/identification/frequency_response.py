"""Measured frequency responses from text files of columns.

The header says what the columns are; names are read without regard to capitals, and a unit stands
in brackets (`phase [deg]`, `phase (deg)`), behind an underscore (`phase_deg`) or in a line below
the header.

    frequency    f, freq, frequency, w, omega; in Hz, kHz or rad/s
    response     re and im; or magnitude (mag, gain, amplitude, abs) and phase (angle, arg);
                 or one column of complex text (response, frf, G, H, P), such as 1.2+0.3j
    scatter      std, variance or coherence (coh, mscohere), with the number of averages behind it
                 in brackets, as `coherence [16 averages]`; none is allowed

A magnitude needs its unit, `abs` (or any unit of output per input) or `dB`, and so do a phase,
`deg` or `rad`, and a frequency: each of them is used both ways, and a mistake would not be seen.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..pytree.closest import listed
from ..pytree.ranges import brief, require
from ..storage.columns import numbers_in, read_columns
from ..storage.reading import quoted
from ..theory.on_lines import MeasuredResponse
from .record_files import name_and_any_unit

# The names of each kind of column, in lower case.
NAMES = {
    "frequency": ("f", "freq", "frequency", "frequencies", "w", "omega", "ω"),
    "re": ("re", "real"),
    "im": ("im", "imag", "imaginary"),
    "magnitude": ("magnitude", "mag", "gain", "amplitude", "abs"),
    "phase": ("phase", "angle", "arg"),
    "complex": ("response", "frf", "complex", "g", "h", "p"),
    "std": ("std", "standard deviation", "sigma"),
    "variance": ("variance", "var"),
    "coherence": ("coherence", "coh", "mscohere"),
}
HERTZ = {"hz": 1.0, "khz": 1e3, "rad/s": 1 / (2 * np.pi)}
RADIANS = {"deg": np.pi / 180, "°": np.pi / 180, "degree": np.pi / 180, "degrees": np.pi / 180}
RADIANS["rad"] = 1.0
NOT_LINEAR = ("db", "%", *RADIANS)
FEWEST = 2  # lines
OF_AVERAGES = re.compile(r"(\d{1,9}) averages")
SUFFIXES = ("hz", "khz", "db", "abs", "deg", "rad")


class _Column(NamedTuple):
    """A column: its place, its heading, and its unit in lower case, or None."""

    at: int
    heading: str
    unit: str | None


def is_frequency_response(path: str | Path) -> bool:
    """Whether the header of a text file is one of a frequency response: it has a frequency.

    Raises as `read_columns`, but not for a file without a header.
    """
    try:
        header, _ = read_columns(path)
    except ValueError as error:
        if "has no header" in str(error):
            return False
        raise
    kinds = [_kind_and_unit(heading)[0] for heading in header]
    return "frequency" in kinds and any(kind in kinds for kind in ("re", "magnitude", "complex"))


def read_frequency_response(path: str | Path, *, averages: int | None = None) -> MeasuredResponse:
    """A frequency response from a text file of columns; the module says which.

    The standard deviation of a line follows from its coherence c over n averages as

        std = |G| sqrt((1 - c) / (c (n - 1)))        (Bendat, Piersol 2010, section 9.2)

    where G is the response from cross and input spectra, and c is the squared one, between 0 and
    1. Of n averages n - 1 are left beside G, so that the mean of std^2 is right for few, too. It is
    that of the complex number, sqrt(2) times that of its magnitude. A line at 0 Hz is left out. A
    column `std` goes before `variance`, and this before `coherence`; re and im go before magnitude
    and phase, and these before complex text.

    averages: number n >= 2 of independent averages; None for the one in the heading of the
        coherence. Without either, std is known up to a factor
    Raises ValueError naming file, line and column: for a column that is missing or there twice, a
    unit that is missing or not known, a value that is not a finite number or outside its range,
    frequencies that do not increase, and fewer than 2 lines.
    """
    header, rows = read_columns(path)
    columns = _columns(path, header)
    read = _Reader(path, list(rows))
    f = read.numbers(columns["frequency"]) * _factor(path, columns["frequency"], HERTZ, "f [Hz]")
    response = _response(read, columns)
    averages = _averages(path, columns.get("coherence"), averages)
    std, coherence = _std(read, columns, response, averages)
    read.refuse(f < 0, columns["frequency"], "a negative frequency")
    falls = np.append(False, np.diff(f) <= 0)
    said = "not above the line before; sort the lines and keep one of each frequency"
    read.refuse(falls, columns["frequency"], said)
    above = f > 0
    if np.sum(above) < FEWEST:
        raise ValueError(
            f"{path} has {np.sum(above)} lines above 0 Hz; allowed are at least {FEWEST}"
        )
    known = coherence is None or averages is not None
    of_lines = None if coherence is None else coherence[above]
    n = np.inf if coherence is None or averages is None else averages
    return MeasuredResponse(f[above], response[above], std[above], of_lines, known, n)


# How it is done
# --------------------------------------------------------------------------------------------------


class _Reader(NamedTuple):
    """The rows of a file, with their lines."""

    path: str | Path
    rows: list[tuple[int, list[str]]]

    def numbers(self, column: _Column) -> np.ndarray:
        found = np.array([numbers_in(row, [column.at])[0] for _, row in self.rows])
        self.refuse(~np.isfinite(found), column, "not a finite number; leave the line out")
        return found

    def complex_numbers(self, column: _Column) -> np.ndarray:
        cells = [row[column.at : column.at + 1] for _, row in self.rows]
        found = np.array([*map(_complex, cells)], complex)
        said = "not a finite complex number, such as 1.2+0.3j"
        self.refuse(~np.isfinite(found), column, said)
        return found

    def refuse(self, wrong: np.ndarray, column: _Column, what: str) -> None:
        """Raises ValueError for the first row (rows,) of a column that is wrong."""
        if not np.any(wrong):
            return
        line, row = self.rows[int(np.argmax(wrong))]
        text = row[column.at].strip() if column.at < len(row) else ""
        seen = quoted(self.path, brief(text))
        raise ValueError(f"{self.path}, line {line}: {column.heading} = {seen} is {what}")


def _kind_and_unit(heading: str) -> tuple[str | None, str | None]:
    """The kind of a column, None if it is of no use, and its unit in lower case."""
    name, unit = name_and_any_unit(heading.strip().lower(), SUFFIXES)
    return next((kind for kind, names in NAMES.items() if name in names), None), unit


def _columns(path, header: list[str]) -> dict[str, _Column]:
    """The columns by their kind, checked to be a response."""
    found: dict[str, _Column] = {}
    for at, heading in enumerate(header):
        kind, unit = _kind_and_unit(heading)
        if kind in found:
            raise ValueError(
                f"{path}: {heading!r} and {found[kind].heading!r} are both a {kind}; allowed is one"
            )
        if kind:
            found[kind] = _Column(at, heading, unit)
    present = quoted(path, listed(header))
    if "frequency" not in found:
        raise ValueError(
            f"{path} has no frequency; write a heading `f [Hz]` or `w [rad/s]`. Present are "
            f"{present}"
        )
    for pair in (("re", "im"), ("magnitude", "phase")):
        one = [kind for kind in pair if kind in found]
        if len(one) == 1 and "complex" not in found:
            other = pair[1 - pair.index(one[0])]
            raise ValueError(f"{path} has {one[0]} but no {other}; present are {present}")
    if not found.keys() & {"re", "magnitude", "complex"}:
        raise ValueError(
            f"{path} has no response; write `re` and `im`, or `magnitude [abs]` (or [dB]) and "
            f"`phase [deg]` (or [rad]). Present are {present}"
        )
    return found


def _factor(path, column: _Column, units: dict[str, float], example: str) -> float:
    """The factor of a unit; raises ValueError where there is none, or one that is not known."""
    if column.unit not in units:
        what = "has no unit" if not column.unit else f"has the unit {column.unit!r}"
        raise ValueError(
            f"{path}: the column {column.heading!r} {what}; write one of {', '.join(units)} into "
            f"its heading, such as `{example}`"
        )
    return units[column.unit]


def _response(read: _Reader, columns: dict[str, _Column]) -> np.ndarray:
    """(rows,) the complex response."""
    if "re" in columns and "im" in columns:
        return read.numbers(columns["re"]) + 1j * read.numbers(columns["im"])
    if not ("magnitude" in columns and "phase" in columns):
        return read.complex_numbers(columns["complex"])
    magnitude, phase = columns["magnitude"], columns["phase"]
    radians = _factor(read.path, phase, RADIANS, "phase [deg]")
    if not magnitude.unit or magnitude.unit in NOT_LINEAR[1:]:
        raise ValueError(
            f"{read.path}: the column {magnitude.heading!r} does not say what it is; write "
            "`magnitude [dB]`, or `magnitude [abs]` for output per input"
        )
    size = read.numbers(magnitude)
    if magnitude.unit == "db":
        # beyond 10^15 the numbers would be no response of a machine
        read.refuse(np.abs(size) > 300, magnitude, "beyond 300 dB")
        size = 10 ** (size / 20)
    read.refuse(size < 0, magnitude, "negative; is it in dB? Write `[dB]`")
    return size * np.exp(1j * radians * read.numbers(phase))


def _averages(path, coherence: _Column | None, given: int | None) -> int | None:
    """The number of averages that is given, or else that of the heading of a coherence."""
    found = OF_AVERAGES.fullmatch((coherence and coherence.unit) or "")
    own = int(found[1]) if found else None
    if coherence and given is not None and own not in (None, given):
        raise ValueError(
            f"{path}: averages = {given} is not that of the heading {coherence.heading!r}; allowed "
            "is one number"
        )
    return own if given is None else given


def _std(
    read: _Reader, columns: dict[str, _Column], response, averages
) -> tuple[np.ndarray, np.ndarray | None]:
    """(rows,) the standard deviation of each line, 0 where the file does not tell it; coherence."""
    require("read_frequency_response", "averages", averages, "[2, inf)", whole=True, optional=True)
    for kind in ("std", "variance"):
        if kind in columns:
            column = columns[kind]
            if column.unit in NOT_LINEAR:
                raise ValueError(
                    f"{read.path}: the column {column.heading!r} is in {column.unit}; allowed is "
                    "the unit of the response, output per input"
                )
            values = read.numbers(column)
            read.refuse(values < 0, column, "negative")
            return (values if kind == "std" else np.sqrt(values)), None
    if "coherence" not in columns:
        return np.zeros(len(response)), None
    column = columns["coherence"]
    c = read.numbers(column)
    said = "outside (0, 1]; leave the line out, and take the squared coherence"
    read.refuse((c <= 0) | (c > 1), column, said)
    return np.abs(response) * np.sqrt((1 - c) / (c * ((averages or 2) - 1))), c


def _complex(cell: list[str]) -> complex:
    """The number of a cell such as 1.2+0.3j, 1.2 + 0.3i or (1.2+0.3j); NaN where there is none."""
    plain = "".join(cell).replace(" ", "").lower().strip("()").replace("i", "j")
    try:
        return complex(plain)
    except ValueError:
        return complex(np.nan, np.nan)
