"""Records of experiments from files: text of columns, exports of scopes, .mat files.

text            columns with a header (`storage.columns`); t, u and y are their names
TwinCAT Scope   its text export, see `read_twincat`
halsampler      LinuxCNC's sampler writes columns without a header and without a time, separated
                by blanks; with its option -t the number of the sample comes first. Names and
                sample time are given: columns = ["sample", "u", "y"], dt = 0.001. A line
                `overrun` says that samples were lost there
arrays          .mat files, see `read_mat_signals`, and .npz files with arrays of these names

Of repeats of a motion the error of each trial is read (`read_repeats`). A file has one or several:

text            a column e, or e_0, e_1 ... for several trials; or y and r, whose difference it is
TwinCAT Scope   a channel e; or y and r
.npz, .mat      an array e with a row, or a column, for each trial; or y and r
"""

from __future__ import annotations

import csv
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np

from ..pytree.closest import listed
from ..pytree.in_short import in_short
from ..pytree.ranges import brief, require
from ..storage.columns import (
    LARGEST_TABLE,
    is_number,
    missing,
    name_and_unit,
    need_one,
    numbers_in,
    plain_unit,
    read_columns,
)
from ..storage.files import atomically
from ..storage.mat_files import MatValue, Other, read_mat
from ..storage.reading import quoted, read_text
from ..storage.sealed import Damaged, read_arrays
from .records import Record, as_columns

Named: TypeAlias = tuple[str, MatValue]
SAMPLE = "sample"  # name of a column of numbers of samples
LOST = "overrun"  # line of halsampler
MOST_ROUNDED = 1.45  # longest step over the shortest one, where the times may be rounded ones


class RecordFile(NamedTuple):
    """The record of a file, and the units of inputs and outputs, "" where it tells none.

    resampled: new sample time [s]; None where the record is taken as it is
    own: sample time of the record [s] where the new one is another by more than 1 %
    """

    record: Record
    input_units: tuple[str, ...]
    output_units: tuple[str, ...]
    resampled: float | None = None
    own: float | None = None


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
    """A record from a text file of columns, an export of TwinCAT Scope, a .mat or .npz file.

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
    Raises ValueError naming file, line and column for a column that is missing or there twice, a
    value that is not a finite number, a time that does not increase or, without `resample`, whose
    steps are not equal (to 1 %), for a time without a unit whose steps are 0.1 or more, such as
    milliseconds, and for fewer than 2 rows.
    """
    for name, value in (("dt", dt), ("resample", resample)):
        require("read_record", name, value, "(0, inf)", optional=True)
    inputs, outputs = (
        [names] if isinstance(names, str) else list(names) for names in (input, output)
    )
    names = [*inputs, *outputs]
    if is_arrays(path):
        signals = read_mat_signals(path, time, names, time_unit, dt)
    elif not columns and is_twincat(path):
        signals = read_twincat(path, names)
    else:
        signals = _text_signals(path, time, inputs, outputs, time_unit, list(columns), dt)
    for one in signals:
        _check_increasing(path, time, one)
    for name, one in zip(outputs, signals[len(inputs) :], strict=True):
        if not np.isfinite(one.values[-1]):
            raise ValueError(
                f"read_record: {path}, {one.places[-1]}: {name} is not a finite number"
            )
    timed = any(one.timed for one in signals)
    if resample is None and dt is not None and timed and not _has_step(signals, dt):
        resample = dt
    of_inputs, of_outputs = signals[: len(inputs)], signals[len(inputs) :]
    own = [_own_step(one.times) for one in signals if resample is not None]
    others = [step for step in own if abs(step / (resample or step) - 1) > STEP_TOLERANCE]
    if resample is None:
        record = _as_it_is(path, time, of_inputs, of_outputs)
    else:
        record = Record(*resampled(path, of_inputs, of_outputs, resample), float(resample))
    return RecordFile(
        record,
        tuple(one.unit for one in of_inputs),
        tuple(one.unit for one in of_outputs),
        resample,
        max(others, default=None),
    )


def write_record(
    path: str | Path, record: Record, *, time: str = "t", input: str = "u", output: str = "y"
) -> None:
    """Write a record as `read_record` reads it, with the time in seconds.

    Several inputs become the columns u_0, u_1, ..., and likewise several outputs. The last row
    repeats the last u.
    Raises ValueError for a record that is not finite, and for one of several experiments.
    """
    u, y = as_columns("write_record", "u", record.u), as_columns("write_record", "y", record.y)
    require("write_record", "dt", record.dt, "(0, inf)")
    if len(y) != len(u) + 1 or record.trials != 1:
        raise ValueError(
            f"write_record: u has {len(u)} rows and y {len(y)}, of trials = {record.trials}; "
            "allowed is one more row in y than in u, of one experiment"
        )
    header = [time if name_and_unit_of_time(time)[1] else f"{time} [s]"]
    for name, signal in ((input, u), (output, y)):
        header += (
            [name] if signal.shape[1] == 1 else [f"{name}_{i}" for i in range(signal.shape[1])]
        )
    rows = np.hstack([np.arange(len(y))[:, None] * record.dt, np.vstack([u, u[-1:]]), y])
    atomically(
        path,
        lambda file: np.savetxt(
            file, rows, fmt="%.17g", delimiter=",", header=",".join(header), comments=""
        ),
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
        again = "Cut the file where its clock began again" if steps[k] else "Keep one row of a time"
        raise ValueError(
            f"read_record: {path}, {one.places[k + 1]}: {time} = {one.times[k + 1]:.15g} s does "
            f"not increase from {one.times[k]:.15g} s; allowed are times that increase. {again}; "
            f"{COUNTED}"
        )


def _own_step(times: np.ndarray) -> float:
    """The median step, or the mean one where the steps are its rounding to few digits.

    Times that are rounded stay within one unit of the grid; those that wander or have gaps do not,
    and their mean is no sample time.
    """
    steps, at, k = np.diff(times), times - times[0], np.arange(len(times))
    mean, middle = float(np.polyfit(k, at, 1)[0]), float(np.median(steps))
    away = at - mean * k
    even = np.max(steps) < MOST_ROUNDED * np.min(steps) and np.ptp(away) < 1.01 * np.ptp(steps)
    return mean if even and abs(mean / middle - 1) > STEP_TOLERANCE else middle


def _mean_step(times: np.ndarray) -> float:
    """The mean step, to the digits that the times tell: those of an absolute clock are rounded."""
    mean = float(times[-1] - times[0]) / (len(times) - 1)
    known = 2 * np.spacing(np.max(np.abs(times))) / (len(times) - 1)
    rounded = [float(f"{mean:.{digits}g}") for digits in range(1, 13)]
    return next((one for one in rounded if abs(one - mean) <= known), rounded[-1])


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
            step = max(_own_step(of.times) for of in signals)
            raise ValueError(
                f"read_record: {path}: its signals have different times; export them with one "
                f"sample time, or add --dt {step:.6g} (dt)"
            )
    uneven = np.abs(steps / middle - 1) > STEP_TOLERANCE
    if np.any(uneven):
        k, dt = int(np.argmax(uneven)), _own_step(first.times)
        raise ValueError(
            f"read_record: {path}, {first.places[k + 1]}: {time} steps by {steps[k]:.6g} s "
            f"where the sample time is dt = {dt:.6g} s; allowed is a deviation of "
            f"{STEP_TOLERANCE:.0%}, or --dt {dt:.6g} (dt)"
        )
    u, y = (np.stack([one.values[:rows] for one in of], axis=1) for of in (inputs, outputs))
    return Record(u[:-1], y, _mean_step(first.times[:rows]))


def _text_signals(path, time, inputs, outputs, unit, columns, dt) -> list[Signal]:
    """The signals of a text file of columns."""
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
    units = [name_and_unit(header[i])[1] or "" for i in at]
    return [
        Signal(values[:, 0], values[:, i], places, units[i], not counted)
        for i in range(1, len(names))
    ]


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
            if i == 0:
                wrong += f"; allowed are numbers of s, ms, us or ns. Else {COUNTED}"
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
            need_one(path, headings, headings.index(name))
            return headings.index(name)
    raise ValueError("read_record: " + missing(path, name, header, f"--{option} ({option})"))


# Onto one grid
# --------------------------------------------------------------------------------------------------

RESAMPLED = (
    "resampled to {dt:g} s: outputs by linear interpolation between their samples, inputs by the "
    "mean over each new sample of the value that was held"
)
FINEST = 0.1  # of the median step of the record, the smallest new sample time
FEWEST = 10  # new samples
LONGEST_GAP = 10  # median steps without a sample that are bridged


class Signal(NamedTuple):
    """A signal as a file has it.

    times: (rows,) times [s]
    values: (rows,) values; of an input the last one may be NaN
    places: place of each row in the file, for messages
    unit: unit, "" where the file has none
    timed: whether the file has the times
    """

    times: np.ndarray
    values: np.ndarray
    places: list[str]
    unit: str = ""
    timed: bool = True


def resampled(
    path, inputs: list[Signal], outputs: list[Signal], dt: float
) -> tuple[np.ndarray, np.ndarray]:
    """u (N, n_u) and y (N+1, n_y) on a grid of step dt, from the first common time on.

    An input is held from each of its times to the next, and its new value is the mean of that over
    the new sample, so that the area under it is kept. An output is interpolated linearly: it is
    sampled, not filtered, since the model is sampled in the same way and has no aliasing to match.

    Raises ValueError naming file and place for a gap, and for a step that does not suit the record.
    """
    signals = [*inputs, *outputs]
    steps = [np.diff(one.times) for one in signals]
    middle = max(float(np.median(of)) for of in steps)
    start = max(one.times[0] for one in signals)
    end = min(
        [one.times[-1] for one in outputs]
        + [one.times[-1] + float(np.median(np.diff(one.times))) for one in inputs]
    )
    low, high = FINEST * middle, (end - start) / FEWEST
    if not low <= dt <= high:
        raise ValueError(
            f"read_record: --dt {dt:g} (resample) is outside its allowed range "
            f"[{low:.3g}, {high:.3g}] s for {path}, whose median step is {middle:.6g} s"
        )
    for one, of in zip(signals, steps, strict=True):
        k = int(np.argmax(of))
        if of[k] > max(LONGEST_GAP * np.median(of), dt):
            raise ValueError(
                f"read_record: {path}, {one.places[k + 1]}: {of[k]:.6g} s without a sample, where "
                f"the median step is {np.median(of):.6g} s; cut the record there, since nothing is "
                "known of the gap"
            )
    grid = start + dt * np.arange(int(np.floor((end - start) / dt * (1 + 1e-12))) + 1)
    u = [np.diff(_integral(one, grid)) / dt for one in inputs]
    y = [np.interp(grid, one.times, one.values) for one in outputs]
    return np.stack(u, axis=1), np.stack(y, axis=1)


def _integral(held: Signal, grid) -> np.ndarray:
    """The integral over time of a signal that is held from each of its times to the next."""
    values = held.values[np.isfinite(held.values)]
    end = held.times[-1] + float(np.median(np.diff(held.times)))
    times = np.append(held.times, end)[: len(values) + 1]
    return np.interp(grid, times, np.append(0.0, np.cumsum(values * np.diff(times))))


# The column of the time
# --------------------------------------------------------------------------------------------------

SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
OTHER_NAMES = {"sec": "s", "seconds": "s", "msec": "ms", "µs": "us", "μs": "us"}
# From this mean step on, a time without a unit is doubted: a drive is sampled faster than 10 Hz.
DOUBTFUL = 0.1
# Share of the sample time by which a step of a record's time may differ from the others.
STEP_TOLERANCE = 0.01
COUNTED = (
    "rows that are one sample time apart are counted with --dt and a --time that is no column of "
    "the file (dt, time)"
)
_WITH_UNIT = re.compile(r"^(.+?)\s*(?:\[([^\[\]]*)\]|\(([^()]*)\))$")


def name_and_unit_of_time(heading: str) -> tuple[str, str | None]:
    """The name and the unit of a heading: `t [ms]`, `t (ms)` and `t_ms` are ("t", "ms").

    The unit is None where there is none. A suffix is a unit only if it is one of time.
    """
    name, unit = name_and_any_unit(heading, (*SECONDS, *OTHER_NAMES))
    return name, None if unit is None else OTHER_NAMES.get(unit, unit)


def name_and_any_unit(heading: str, suffixes: Collection[str]) -> tuple[str, str | None]:
    """The name and the unit of a heading, in brackets of both kinds or as one of some suffixes."""
    if found := _WITH_UNIT.match(heading):
        return found[1], (found[2] if found[2] is not None else found[3]).strip()
    name, _, suffix = heading.rpartition("_")
    return (name, suffix) if name and suffix in suffixes else (heading, None)


def place_of_time(name: str, header: list[str]) -> int | None:
    """The index of the column of the time, or None.

    It is found by its whole heading, or by its heading without the unit. The name `t` also stands
    for `time`, and capitals do not matter.
    """
    if name in header:
        return header.index(name)
    wanted = {name.lower(), "time"} if name == "t" else {name.lower()}
    for i, heading in enumerate(header):
        if name_and_unit_of_time(heading)[0].lower() in wanted:
            return i
    return None


def seconds_in(path, heading: str, unit: str | None, times: np.ndarray) -> float:
    """Seconds in one unit of the time column.

    unit: unit that was given, None for that of the heading
    Raises ValueError for a unit that is not known, a given unit that is not that of the heading,
    and a time without a unit whose mean step would be 0.1 s or more.
    """
    named = name_and_unit_of_time(heading)[1]
    if unit is not None and unit not in SECONDS:
        raise ValueError(f"time_unit = {unit!r} is not one of {', '.join(SECONDS)}")
    if unit is not None and named not in (None, unit):
        raise ValueError(
            f"read_record: {path}: the heading {heading!r} has another unit than --time-unit {unit}"
        )
    unit = unit or named
    if unit is not None:
        if unit not in SECONDS:
            raise ValueError(
                f"read_record: {path}: the unit {unit!r} of {heading!r} is not one of "
                f"{', '.join(SECONDS)}; --time-unit has no effect on a heading with a unit"
            )
        return SECONDS[unit]
    step = (times[-1] - times[0]) / max(len(times) - 1, 1)
    if len(times) > 1 and step >= DOUBTFUL:
        raise ValueError(
            f"read_record: {path}: {heading} steps by {step:.6g} and has no unit; in seconds that "
            f"would be {1 / step:.3g} samples a second, in milliseconds {1e3 / step:.3g}. Write "
            f"its unit into the heading, as `{heading} [ms]`, of a variable of a .mat or .npz file "
            f"as {heading}_ms; or tell it by --time-unit (time_unit)"
        )
    return 1.0


# Files of arrays
# --------------------------------------------------------------------------------------------------

LARGEST = 256_000_000  # bytes of a file, packed or unpacked
EXPORT = "{0} = struct('Time', {0}.Time, 'Data', {0}.Data); save('record.mat', '{0}', ..., '-v7')"


def read_mat_signals(
    path: str | Path, time: str, names: list[str], unit: str | None, dt: float | None
) -> list[Signal]:
    """The signals of these names in a .npz or .mat file.

    A .mat file is of version 5 to 7; a name may be a path in it, `log.u`.

    arrays              variables t, u and y, as vectors of one length
    a structure         fields u and y of one structure, and t there or beside it
    times of its own    a structure u with the fields Time and Data, as of a timeseries; or time and
                        signals.values, Simulink's "structure with time" of one signal

    An object of MATLAB, such as a timeseries itself, and a file of version 7.3 (HDF5) cannot be
    read; in MATLAB u = struct('Time', u.Time, 'Data', u.Data) makes a structure of it.

    unit: unit of the times, None for seconds
    dt: sample time of arrays without times [s]
    Raises ValueError naming file and signal for what is missing or cannot be read; where it is an
    object or a file of version 7.3, with the line of MATLAB that exports it.
    """
    content = _arrays(path, [time, *names])
    return [_mat_signal(path, content, time, name, unit, dt) for name in names]


def is_arrays(path: str | Path) -> bool:
    """Whether a file is one of arrays by name, which its ending tells."""
    return Path(path).suffix.lower() in (".npz", ".mat")


def _arrays(path: str | Path, names: Sequence[str]) -> dict[str, MatValue]:
    """The content of a .npz or .mat file by name; names: for the message of what to save again."""
    try:
        if Path(path).suffix.lower() == ".mat":
            return read_mat(path, LARGEST)
        return dict(read_arrays(path, checked=False))
    except Damaged as damage:
        raise ValueError(str(damage)) from None
    except ValueError as error:
        if "version 7.3" not in str(error):
            raise
        again = ", ".join(map(repr, dict.fromkeys(name.partition(".")[0] for name in names)))
        raise ValueError(
            f"read_record: {path} is a MATLAB file of version 7.3 (HDF5), which is not read; save "
            f"it again with those of its variables that count: save('record.mat', {again}, '-v7')"
        ) from None


def _mat_signal(
    path: str | Path,
    content: dict[str, MatValue],
    time: str,
    name: str,
    unit: str | None,
    dt: float | None,
) -> Signal:
    level, value = _found(path, content, name)
    timed = True
    if isinstance(value, dict):
        own = _own_times(value)
        if own is None:
            raise ValueError(
                f"read_record: {path}: {name} is a structure of {', '.join(value) or 'nothing'}; "
                "allowed are the fields Time and Data, or time and signals.values"
            )
        times, values = (_vector(path, f"{name}.{part}", of) for part, of in own)
    else:
        values = _vector(path, name, value)
        spellings = (time, "time", "Time", "tout") if time == "t" else (time,)
        if not any(k in level for k in spellings):
            level = level | content  # the times of the file
        key = next((k for k in spellings if k in level), None)
        timed = key is not None
        if key is not None:
            times = _vector(path, key, level[key])
        elif dt is not None:
            times = np.arange(len(values)) * dt
        else:
            raise ValueError(
                f"read_record: {path} has no times {time!r} beside {name}; present are "
                f"{listed(level)}. Name them with --time, or give --dt (dt)"
            )
    if len(times) != len(values):
        raise ValueError(
            f"read_record: {path}: {name} has {len(values)} values and {len(times)} times"
        )
    for what, of in (("the time", times), (name, values[:-1])):
        if not np.all(np.isfinite(of)):
            k = int(np.argmin(np.isfinite(of)))
            raise ValueError(f"read_record: {path}, row {k + 1}: {what} is not a finite number")
    scale = seconds_in(path, time, unit, times) if timed else 1.0
    places = [f"row {k + 1}" for k in range(len(values))]
    return Signal(times * scale, values, places, timed=timed)


def _found(
    path: str | Path, content: dict[str, MatValue], name: str
) -> tuple[dict[str, MatValue], MatValue]:
    """The structure (or file) that holds a signal, and the signal."""
    value: MatValue = content
    for part in name.split("."):
        level = value if isinstance(value, dict) else {}
        if part not in level and level is content:  # within the only structure that has it
            holders = [of for of in content.values() if isinstance(of, dict) and part in of]
            level = holders[0] if len(holders) == 1 else level
        if part not in level:
            raise ValueError(
                f"read_record: {path} has no variable {name!r}; present are "
                f"{listed(level)}; --input (input) and --output (output) name others"
            )
        value = level[part]
    return level, value


def _own_times(value: dict[str, MatValue]) -> tuple[Named, Named] | None:
    """The times and the data of a structure that has both, each with the name of its field."""
    fields = {key.lower(): key for key in value}
    if "time" not in fields:
        return None
    time = fields["time"]
    signals = value.get("signals")
    if isinstance(signals, dict) and "values" in signals:
        return (time, value[time]), ("signals.values", signals["values"])
    data = fields.get("data", fields.get("values"))
    return None if data is None else ((time, value[time]), (data, value[data]))


def _vector(path: str | Path, name: str, value: MatValue) -> np.ndarray:
    """A vector of numbers, whatever its orientation."""
    if isinstance(value, Other):
        said = value.said
        if "object" in said:
            said = f"an object of MATLAB, which is not read; in MATLAB: {EXPORT.format(name)}"
        raise ValueError(f"read_record: {path}: {name} is {said}")
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "biuf":
        raise ValueError(f"read_record: {path}: {name} is no array of numbers")
    plain = np.squeeze(np.asarray(value, float))
    if plain.ndim != 1:
        raise ValueError(
            f"read_record: {path}: {name} has the shape {value.shape}; allowed is a vector"
        )
    return plain


# Exports of TwinCAT Scope
# --------------------------------------------------------------------------------------------------

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
    r"""The channels with these names, or with these names of symbols such as `MAIN.position`.

        Name<TAB>my scope                     the scope: name, file, start and end of the export
        File<TAB>C:\my scope.csv
        (blank lines)
        Name<TAB>torque<TAB>Name<TAB>position   the channels, key and value: Name, SymbolComment,
        SampleTime[ms]<TAB>1<TAB>SampleTime[ms]<TAB>1    Data-Type, SampleTime[ms], SymbolName,
        Unit<TAB>(None)<TAB>Unit<TAB>mm (Length)         Unit and others; some have Name only
        (blank line)
        0<TAB>-1,0379<TAB>0<TAB>0,25          pairs of time [ms] and value
        EOF                                   where this was asked for

    The key `Name` stands above each column of times. With the option "Timelines: for each sample
    time", channels of one sample time share a column: Name, a, b, Name, c. The separator is what
    stands behind the first `Name`: a tab, semicolon, comma or colon; not a blank, since keys and
    names have blanks within. A decimal mark is a comma or a point. With "Full timestamp" the times
    are ticks of 100 ns since 1601. Channels of longer sample times end in earlier rows, or repeat
    their last time and value ("Interpolation: fill with previous value").

    Raises ValueError naming the file: for a channel that is missing, a value that is not a number,
    and times whose step is not the sample time that the header tells.
    """
    export = _export(path)
    return [_channel(path, export, name) for name in names]


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


def _channel(path, export: _Export, name: str) -> Signal:
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


# Repeats of a motion
# --------------------------------------------------------------------------------------------------

SHORTER = 0.01  # share by which trials may differ in length; all are cut to the shortest


class Repeats(NamedTuple):
    """The errors of M trials with the same input.

    e: (M, N) errors
    dt: sample time [s]
    unit: of the error, "" where no file tells one
    names: of the trials
    position: (N,) where the first one was: its output, or else its reference; None if not read
    place: unit of the position, "" where its file tells that of the error alone; None: that of the
        error
    """

    e: np.ndarray
    dt: float
    unit: str
    names: tuple[str, ...]
    position: np.ndarray | None = None
    place: str | None = None
    __repr__ = in_short


def read_repeats(
    paths: Sequence[str | Path],
    *,
    error: str = "e",
    output: str = "y",
    reference: str = "r",
    time: str = "t",
    columns: Sequence[str] = (),
    dt: float | None = None,
    without: float | None = None,
) -> Repeats:
    """The errors of all trials in these files, in their order.

    error: name of the error; where a file has none, it is reference - output
    time: name of the times; a file without them needs `dt`
    columns: names of the columns of text without a header
    dt: sample time [s] of all files; of one that has times it must be theirs, to 1 %
    without: sample time [s] of files without times
    Raises ValueError naming the file for what is missing or no number, for units or sample times
    that differ, and for trials whose lengths differ by more than 1 %.
    """
    for name, value in (("dt", dt), ("without", without)):
        require("read_repeats", name, value, "(0, inf)", optional=True)
    trials, units, steps, names = [], [], [], []
    positions: list[tuple[np.ndarray, str | None]] = []
    for path in map(Path, paths):
        signals = _signals_of(path, time, columns, dt, (error, output, reference))
        e = signals.errors(error, output, reference)
        step = without if signals.dt is None else signals.dt
        if step is None:
            raise ValueError(f"{path} has no times {time!r}; name them with --time, or give --dt")
        trials += list(e)
        names += [path.stem if len(e) == 1 else f"{path.stem} {j + 1}" for j in range(len(e))]
        own = signals.unit_of(*([error] if error in signals.found else [output, reference]))
        units.append(own)
        _one_unit(path, units)
        for name in (output, reference):
            if (x := signals.of(name)) is not None:
                place = signals.units.get(name, [""])[0] or ""
                apart = error in signals.found and bool(own or place)
                positions.append((x[0], place if apart else None))
        steps.append(step)
    if not trials:
        raise ValueError("no record is given; needed are M >= 2 repeats of one motion")
    uneven = [one for one in steps if abs(one / steps[0] - 1) > STEP_TOLERANCE]
    if uneven:
        raise ValueError(
            f"the trials have different sample times, {steps[0]:.6g} s and {uneven[0]:.6g} s"
        )
    lengths = [len(one) for one in trials]
    if min(lengths) < (1 - SHORTER) * max(lengths):
        raise ValueError(
            f"the trials have {min(lengths)} to {max(lengths)} samples; repeats of one motion have "
            "the same length: give those of one motion, cut alike"
        )
    e = np.stack([one[: min(lengths)] for one in trials])
    unit, (position, place) = next(filter(None, units), ""), (positions or [(None, None)])[0]
    if position is None or len(position) < e.shape[1]:
        return Repeats(e, steps[0], unit, tuple(names))
    return Repeats(e, steps[0], unit, tuple(names), position[: e.shape[1]], place)


class _Signals(NamedTuple):
    """The signals of one file.

    found: arrays by name, (N,) or of several trials
    dt: sample time [s], None where the file tells none
    units: of the columns of each name; no name where the file tells none
    """

    path: Path
    found: Mapping[str, MatValue]
    dt: float | None
    units: Mapping[str, Sequence[str | None]] = {}

    def unit_of(self, *names: str) -> str:
        """The one unit of some signals, "" where none is told; raises ValueError for several."""
        return _one_unit(self.path, [unit for name in names for unit in self.units.get(name, ())])

    def of(self, name: str) -> np.ndarray | None:
        """(trials, N) a signal, None where the file does not have it.

        Raises ValueError for what is no array of finite numbers.
        """
        if name not in self.found:
            return None
        value = np.asarray(self.found[name])
        if value.ndim not in (1, 2) or value.dtype.kind not in "fiu" or not value.size:
            raise ValueError(f"{self.path}: {name} is no array of (trials, samples)")
        rows = np.atleast_2d(value.astype(float))
        rows = rows if rows.shape[0] <= rows.shape[1] else rows.T
        if not np.all(np.isfinite(rows)):
            k = int(np.argmin(np.isfinite(rows).all(axis=0)))
            raise ValueError(f"{self.path}: {name} is not a finite number at sample {k}")
        return rows

    def errors(self, error: str, output: str, reference: str) -> np.ndarray:
        """(trials, N) the errors; raises ValueError where the file has none."""
        e, y, r = map(self.of, (error, output, reference))
        if e is not None:
            return e
        if y is None or r is None:
            raise ValueError(
                f"{self.path} has neither {error!r} nor {output!r} and {reference!r}; `jaxilc "
                f"potential --error NAME` takes another column; present are {listed(self.found)}"
            )
        if y.shape[1] != r.shape[1] or len(r) not in (1, len(y)):
            raise ValueError(
                f"{self.path}: {output} is {y.shape}, {reference} is {r.shape}; allowed is one "
                "reference for all trials, or one for each"
            )
        return r - y


def _signals_of(
    path: Path, time: str, columns: Sequence[str], dt: float | None, names: tuple[str, str, str]
) -> _Signals:
    """The signals of a file of any kind; names: of error, output and reference."""
    if not is_arrays(path):
        of_scope = not columns and is_twincat(path)
        return _of_scope(path, dt, names) if of_scope else _columns_of(path, time, columns, dt)
    found = _arrays(path, [time, *names])
    at = place_of_time(time, [*found])
    if at is not None:
        heading = [*found][at]
        dt = _step(path, heading, _vector(path, heading, found[heading]), dt)
    return _Signals(path, found, dt)


def _of_scope(path: Path, dt: float | None, names: Sequence[str]) -> _Signals:
    """The signals of an export of TwinCAT Scope; raises ValueError where their times differ."""
    export = _export(path)
    keys = ("Name", "SymbolName")
    channels = [
        name for row in keys for name in export.channels.get(row, []) if name not in ("", *keys)
    ]
    signals = {name: _channel(path, export, name) for name in names if name in channels}
    found = dict.fromkeys(channels, np.zeros(0))
    steps = [_step(path, "t [s]", one.times, dt) for one in signals.values()]
    count = min((len(one.times) for one in signals.values()), default=0)
    for name, one in signals.items():
        away = one.times[:count] - next(iter(signals.values())).times[:count]
        if np.any(np.abs(away) > STEP_TOLERANCE * steps[0]):
            raise ValueError(
                f"{path}: {', '.join(signals)} have different times; export them with one sample "
                "time"
            )
        found[name] = one.values[:count]
    units = {name: [one.unit] for name, one in signals.items()}
    return _Signals(path, found, steps[0] if steps else dt, units)


def _step(path: Path, heading: str, times: np.ndarray, given: float | None) -> float:
    """The sample time that is given, if it is that of the times, or else that of uniform times.

    Raises ValueError where it is not, or they are not, and as `seconds_in`.
    """
    times = times * seconds_in(path, heading, None, times)
    steps = np.diff(times)
    middle = float(np.median(steps)) if len(steps) else 0.0
    if given is not None and middle > 0:
        own = _own_step(times)
        if not abs(own / given - 1) <= STEP_TOLERANCE:
            raise ValueError(
                f"{path}: its times {heading} step by {own:.6g} s, and --dt (dt) is {given:.6g} s; "
                f"allowed is a deviation of {STEP_TOLERANCE:.0%}, or a file without times"
            )
        return given
    if not middle > 0 or np.any(np.abs(steps / middle - 1) > STEP_TOLERANCE):
        raise ValueError(f"{path}: its times are not uniform (to {STEP_TOLERANCE:.0%})")
    return _mean_step(times)


def _one_unit(path: Path, units: Iterable[str | None]) -> str:
    """The unit of errors, "" where none is told; raises ValueError for several."""
    told = {plain_unit(unit): unit for unit in units if unit}
    if len(told) > 1:
        raise ValueError(
            f"{path}: the errors are in {', '.join(told.values())}; allowed is one unit of all "
            "outputs and references, and nothing is converted"
        )
    return next(iter(told.values()), "")


def _columns_of(path: Path, time: str, columns: Sequence[str], dt: float | None) -> _Signals:
    """The signals of a text file; the columns e_0, e_1 ... are trials of e."""
    header, rows = read_columns(path, list(columns))
    table = [numbers_in(row, range(len(header))) for _, row in rows]
    values = np.array(table, float).reshape(-1, len(header))
    found: dict[str, list[int]] = {}
    for i, heading in enumerate(header):
        name = name_and_unit(heading)[0] or heading
        for one in {name, re.sub(r"_\d+$", "", name)}:
            found.setdefault(one, []).append(i)
    at = place_of_time(time, header)
    if at is not None and len(values) > 1:
        dt = _step(path, header[at], values[:, at], dt)
    units = {name: [name_and_unit(header[i])[1] for i in of] for name, of in found.items()}
    return _Signals(path, {name: values[:, of].T for name, of in found.items()}, dt, units)
