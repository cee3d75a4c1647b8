"""Records of experiments from files: text of columns, exports of scopes, .mat files.

text            columns with a header (`storage.columns`); t, u and y are their names
TwinCAT Scope   its text export, see `twincat`
halsampler      LinuxCNC's sampler writes columns without a header and without a time, separated
                by blanks; with its option -t the number of the sample comes first. Names and
                sample time are given: columns = ["sample", "u", "y"], dt = 0.001. A line
                `overrun` says that samples were lost there
MATLAB          .mat files, see `mat_record`
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..pytree.ranges import brief, require
from ..storage.columns import missing, name_and_unit, numbers_in, read_columns
from ..storage.reading import quoted
from .mat_record import read_mat_signals
from .records import Record
from .resampling import Signal, resampled
from .time_column import STEP_TOLERANCE, place_of_time, seconds_in
from .twincat import is_twincat, read_twincat

SAMPLE = "sample"  # name of a column of numbers of samples
LOST = "overrun"  # line of halsampler


class RecordFile(NamedTuple):
    """The record of a file, and the units of inputs and outputs, "" where it tells none.

    resampled: new sample time [s]; None where the record is taken as it is
    """

    record: Record
    input_units: tuple[str, ...]
    output_units: tuple[str, ...]
    resampled: float | None = None


def read_record(
    path: str | Path,
    *,
    time: str = "t",
    input: str | Sequence[str] = "u",
    output: str | Sequence[str] = "y",
    time_unit: str | None = None,
    columns: Sequence[str] = (),
    dt: float | None = None,
    resample: float | None = None,
) -> Record:
    """A record from a file, as `read_record_file` reads it together with its units."""
    return read_record_file(
        path,
        time=time,
        input=input,
        output=output,
        time_unit=time_unit,
        columns=columns,
        dt=dt,
        resample=resample,
    ).record


def read_record_file(
    path: str | Path,
    *,
    time: str = "t",
    input: str | Sequence[str] = "u",
    output: str | Sequence[str] = "y",
    time_unit: str | None = None,
    columns: Sequence[str] = (),
    dt: float | None = None,
    resample: float | None = None,
) -> RecordFile:
    """A record from a text file of columns, an export of TwinCAT Scope, or a .mat file.

    A heading is a name, or a name with a unit such as `y [mm]`. The time is converted to seconds
    from the unit in its heading (`t [ms]`, `time (ms)`, `t_ms`) or from `time_unit`; nothing else
    is converted. Row k holds t[k], u[k], y[k]: y is measured at t[k], then u acts until t[k+1]. The
    last row's u is not used and may be empty.

    time, input, output: names of the columns; several names for several inputs or outputs
    time_unit: s, ms, us or ns; None for the unit in the heading, or seconds if it has none
    columns: names of the columns of a text file that has no header
    dt: sample time [s] of a file without a time, where a column `sample` counts samples; a file
        with other times is resampled
    resample: new sample time [s], see `resampled`; None: the record is taken as it is
    Raises ValueError naming file, line and column for a column that is missing, a value that is not
    a finite number, a time that does not increase or, without `resample`, whose steps are not equal
    (to 1 %), for a time without a unit whose steps are 0.1 or more, such as milliseconds, and for
    fewer than 2 rows.
    """
    for name, value in (("dt", dt), ("resample", resample)):
        if value is not None:
            require("read_record", name, value, "(0, inf)")
    inputs, outputs = (
        [names] if isinstance(names, str) else list(names) for names in (input, output)
    )
    names, timed = [*inputs, *outputs], False
    if Path(path).suffix.lower() == ".mat":
        signals = read_mat_signals(path, time, names, time_unit, dt)
    elif not columns and is_twincat(path):
        signals, timed = read_twincat(path, names), True
    else:
        signals, timed = _text_signals(path, time, inputs, outputs, time_unit, list(columns), dt)
    for one in signals:
        _check_increasing(path, time, one)
    if resample is None and dt is not None and timed and not _has_step(signals, dt):
        resample = dt
    of_inputs, of_outputs = signals[: len(inputs)], signals[len(inputs) :]
    if resample is None:
        record = _as_it_is(path, time, of_inputs, of_outputs)
    else:
        record = Record(*resampled(path, of_inputs, of_outputs, resample), float(resample))
    return RecordFile(
        record,
        tuple(one.unit for one in of_inputs),
        tuple(one.unit for one in of_outputs),
        resample,
    )


# How it is done
# --------------------------------------------------------------------------------------------------


def _check_increasing(path, time: str, one: Signal) -> None:
    """Raises ValueError for fewer than 2 rows, and for times that do not increase."""
    if len(one.times) < 2:
        raise ValueError(
            f"read_record: {path} has {len(one.times)} rows of data; allowed are at least 2"
        )
    steps = np.diff(one.times)
    if np.any(steps <= 0):
        k = int(np.argmax(steps <= 0))
        raise ValueError(
            f"read_record: {path}, {one.places[k + 1]}: {time} = {one.times[k + 1]:.9g} s "
            f"does not increase from {one.times[k]:.9g} s"
        )


def _has_step(signals: Sequence[Signal], dt: float) -> bool:
    """Whether all signals have the same times, with this step."""
    first = signals[0].times
    return all(
        len(one.times) == len(first) and np.allclose(one.times, first, rtol=0, atol=0.01 * dt)
        for one in signals
    ) and bool(np.all(np.abs(np.diff(first) / dt - 1) <= STEP_TOLERANCE))


def _as_it_is(path, time: str, inputs: list[Signal], outputs: list[Signal]) -> Record:
    """The record of signals that have one uniform time; raises ValueError where they have not."""
    signals = [*inputs, *outputs]
    rows, first = min(len(one.times) for one in signals), signals[0]
    steps = np.diff(first.times)
    middle = float(np.median(steps))
    for one in signals:
        if np.any(np.abs(one.times[:rows] - first.times[:rows]) > STEP_TOLERANCE * middle):
            step = max(float(np.median(np.diff(of.times))) for of in signals)
            raise ValueError(
                f"read_record: {path}: its signals have different times; export them with one "
                f"sample time, or add --dt {step:.6g} (dt)"
            )
    uneven = np.abs(steps / middle - 1) > STEP_TOLERANCE
    if np.any(uneven):
        k = int(np.argmax(uneven))
        raise ValueError(
            f"read_record: {path}, {first.places[k + 1]}: {time} steps by {steps[k]:.6g} s "
            f"where the sample time is dt = {middle:.6g} s; allowed is a deviation of "
            f"{STEP_TOLERANCE:.0%}, or --dt {middle:.6g} (dt)"
        )
    u, y = (np.stack([one.values[:rows] for one in of], axis=1) for of in (inputs, outputs))
    return Record(u[:-1], y, float(f"{np.mean(steps[: rows - 1]):.12g}"))


def _text_signals(path, time, inputs, outputs, unit, columns, dt) -> tuple[list[Signal], bool]:
    """The signals of a text file of columns, and whether it has times of its own."""
    header, rows = read_columns(path, columns)
    names = [time, *inputs, *outputs]
    place = place_of_time(time, header)
    counted = place is None and dt is not None
    if counted:
        place = header.index(SAMPLE) if SAMPLE in header else None
    elif place is None:
        place = _place(path, time, header, "time")
    at = [-1 if place is None else place]
    for option, of in (("input", inputs), ("output", outputs)):
        at += [_place(path, name, header, option) for name in of]
    values, lines = _numbers(path, names, at, rows, len(inputs))
    if counted:
        values[:, 0] = (values[:, 0] - values[:1, 0]) * (dt or 0.0)
    elif len(values) > 1 and place is not None:
        values[:, 0] *= seconds_in(path, header[place], unit, values[:, 0])
    places = [f"line {line}" for line in lines]
    signals = [
        Signal(values[:, 0], values[:, i], places, name_and_unit(header[at[i]])[1] or "")
        for i in range(1, len(names))
    ]
    return signals, not counted


def _numbers(path, names, at: list[int], rows, inputs: int) -> tuple[np.ndarray, list[int]]:
    """(rows, columns) the values of time, inputs, outputs, and the line of each row.

    at: places of the columns; -1 for a time that is the number of the row
    """
    values, lines, wrong = [], [], ""
    for line, row in rows:
        if wrong:
            raise ValueError(wrong)
        if row[0].strip() == LOST:
            raise ValueError(
                f"read_record: {path}, line {line}: `{LOST}` of halsampler: samples were lost "
                "here. Take one part of the file, or give sampler a larger depth"
            )
        found = numbers_in(row, at)
        if at[0] < 0:
            found[0] = len(values)
        for i in np.flatnonzero(~np.isfinite(found)):
            text = row[at[i]].strip() if at[i] < len(row) else ""
            wrong = wrong or (
                f"read_record: {path}, line {line}: {names[i]} = {quoted(path, brief(text))} is "
                "not a finite number"
            )
            if text or not 0 < i <= inputs:  # the last row may have no input
                raise ValueError(wrong)
        values.append(found)
        lines.append(line)
    return np.array(values, float).reshape(-1, len(names)), lines


def _place(path, name: str, header: list[str], option: str) -> int:
    """The index of a column, found by its whole heading or its heading without the unit.

    option: the argument that names this column, for the message
    """
    for headings in (header, [name_and_unit(heading)[0] for heading in header]):
        if name in headings:
            return headings.index(name)
    raise ValueError("read_record: " + missing(path, name, header, f"--{option} ({option})"))
