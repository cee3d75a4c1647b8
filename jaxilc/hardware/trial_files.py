"""Files between the package and a machine: a measured trial in, from CSV or MATLAB; the next input
out, as CSV, MATLAB or C.

A table of text has a header that declares units, `t [s], r [mm], y [mm], u [V]`; several channels
are y0, y1, ... Row k holds what
belongs to t[k]: y is measured there, then u acts until t[k+1], so the last row's u means nothing
and may be empty. A .mat file has variables of the same names, several channels as columns, and a
struct `units` with a field for each.
"""

from __future__ import annotations

import itertools
import re
import unicodedata
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..learning.playback import unit_of
from ..signals.task import Task
from ..storage.files import atomically
from ..storage.mat_files import ROOM, Other, read_mat
from ..storage.reading import read_columns

STEP_TOLERANCE = 0.01  # of the sample time, by which a single step may differ
RATE_TOLERANCE = 1e-3  # of the sample time, by which the median step may differ
REFERENCE_TOLERANCE = 1e-4  # of the reference's range
FORMATS = (".csv", ".mat", ".h")
_HEADER = re.compile(r"^([^\[\]]+?)\s*(?:\[([^\[\]]*)\])?$")


class Measured(NamedTuple):
    """A trial as a machine recorded it, of the task's length, sample time and units.

    y: (N+1, n_y);  u: (N, n_u), None where the file has none;  others: further signals asked for,
    by name
    ignored: columns that mean nothing here;  source: the file
    """

    y: np.ndarray
    u: np.ndarray | None
    others: dict[str, np.ndarray]
    ignored: tuple[str, ...]
    source: str


class _File(NamedTuple):
    """columns: name -> (rows, channels) values, unit (None: not declared);  places: of each row,
    for messages;  ignored: names
    """

    columns: dict[str, tuple[np.ndarray, str | None]]
    places: list[str]
    ignored: tuple[str, ...]


def read_measured(
    path: str | Path, task: Task, others: Mapping[str, tuple[int, int]] | None = None
) -> Measured:
    """A measured trial of the task, from a .mat file or a text file of columns (commas, semicolons
    or tabs).

    Needs t and y; takes r, which must be the task's, u, and `others`, name -> (rows, channels), if
    they are there.
    Raises ValueError naming file, place and signal: a column missing, a unit not declared or not
    the task's, a value that is not finite, a gap or an uneven step of the time, another sample time
    or length (nothing is resampled), another reference.
    """
    N = task.N
    shapes = {
        "t": (N + 1, 1),
        "y": (N + 1, task.outputs),
        "r": (N + 1, task.outputs),
        "u": (N, task.inputs),
        **(others or {}),
    }
    found = _read_mat(path, shapes) if Path(path).suffix == ".mat" else _read_text(path, shapes)
    for name, (values, unit) in found.columns.items():
        _check_unit(path, name, unit, unit_of(name, task))
        short = shapes[name][0] == N
        bad = ~np.isfinite(
            values[:-1] if short and len(values) == len(found.places) else values
        ).all(axis=1)
        if np.any(bad):
            raise ValueError(
                f"{path}, {found.places[int(np.argmax(bad))]}: {name} is not a finite number"
            )
    _check_time(path, found.columns["t"][0][:, 0], found.places, task)
    signals = {}
    for name, (values, _) in found.columns.items():
        rows = shapes[name][0]
        if len(values) not in (rows, N + 1):
            raise ValueError(f"{path}: {name} has {len(values)} rows; this task needs {rows}")
        signals[name] = values[:rows]
    if "r" in signals:
        _check_reference(path, signals["r"], found.places, task)
    besides = {name: values for name, values in signals.items() if name not in ("t", "r", "y", "u")}
    return Measured(signals["y"], signals.get("u"), besides, found.ignored, str(path))


def _read_text(path, shapes) -> _File:
    header, lines = read_columns(path)
    header = [_HEADER.match(cell) for cell in header]
    most = 2 * shapes["t"][0] + 1000
    rows = list(itertools.islice(lines, most + 1))
    if len(rows) > most:
        raise ValueError(
            f"{path} has more than {most} rows of data; this task needs N + 1 = {shapes['t'][0]}"
        )
    names, units = [m[1] if m else "" for m in header], [m[2] if m else None for m in header]
    columns, used = {}, set()
    for name, (_, channels) in shapes.items():
        at = _channels(path, name, channels, names)
        if at is None:
            continue
        used.update(at)
        if len({_plain(units[i] or "") for i in at}) > 1:
            raise ValueError(
                f"{path}: the channels of {name} have the units {', '.join(str(units[i]) for i in at)}; allowed is one"
            )
        values = [[_number(row[i].strip() if i < len(row) else "") for i in at] for _, row in rows]
        columns[name] = np.array(values, float).reshape(-1, channels), units[at[0]]
    return _File(
        columns,
        [f"line {line}" for line, _ in rows],
        tuple(n for i, n in enumerate(names) if i not in used),
    )


def _channels(path, name: str, channels: int, names: list[str]) -> list[int] | None:
    """Where the channels of a signal stand; None where it is not there and need not be."""
    spelled = [[f"{name}{i}", f"{name}_{i}"] + [name] * (channels == 1) for i in range(channels)]
    at = [next((names.index(s) for s in ways if s in names), None) for ways in spelled]
    found = [i for i in at if i is not None]
    if len(found) == channels:
        return found
    if name in ("t", "y") or found:
        missing = spelled[at.index(None)][-1 if channels == 1 else 0]
        raise ValueError(
            f"{path} has no column {missing!r}; present are {', '.join(names) or 'none'}"
        )
    return None


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return np.nan


def _read_mat(path, shapes) -> _File:
    needed = 8 * sum(rows * channels for rows, channels in shapes.values())
    contents = read_mat(path, ROOM + 32 * needed)  # it may hold much besides
    units = contents.get("units")
    if not isinstance(units, dict):
        raise ValueError(f"{path} has no struct 'units'; declare them there: units.y = 'mm'")
    columns = {}
    for name, (rows, channels) in shapes.items():
        if name not in contents:
            if name in ("t", "y"):
                raise ValueError(
                    f"{path} has no variable {name!r}; present are {', '.join(contents)}"
                )
            continue
        values, unit, allowed = (
            contents[name],
            units.get(name),
            f"allowed are real numbers in {channels} columns",
        )
        if not isinstance(values, np.ndarray):
            raise ValueError(
                f"{path}: {name} is {values.said if isinstance(values, Other) else 'no array'}; {allowed}"
            )
        if channels == 1 and values.ndim == 2 and 1 in values.shape:
            values = values.reshape(-1, 1)
        if values.ndim != 2 or values.shape[1] != channels or len(values) > 2 * rows + 1000:
            raise ValueError(f"{path}: {name} has shape {values.shape}; {allowed}")
        if not isinstance(unit, str | None):
            raise ValueError(
                f"{path}: units.{name} is {unit.said if isinstance(unit, Other) else 'no text'}"
            )
        columns[name] = values.astype(float), unit
    ignored = tuple(n for n in contents if n not in (*shapes, "units"))
    return _File(columns, [f"sample {k}" for k in range(len(columns["t"][0]))], ignored)


def _plain(unit: str) -> str:
    """A unit's spelling: the two micro signs are one, and "-" or "1" is no unit."""
    unit = unicodedata.normalize("NFKC", unit).strip()
    return "" if unit in ("-", "1") else unit


def _check_unit(path, name: str, declared: str | None, wanted: str) -> None:
    if declared is None and wanted:
        raise ValueError(f"{path}: {name} declares no unit; this task needs '{name} [{wanted}]'")
    if _plain(declared or "") != _plain(wanted):
        raise ValueError(
            f"{path}: {name} is in {declared!r}; this task needs {wanted!r}, and nothing is converted"
        )


def _check_time(path, t, places, task: Task) -> None:
    dt, steps = task.dt, np.diff(t)
    if len(steps) < 1:
        raise ValueError(f"{path} has {len(t)} rows of data; this task needs N + 1 = {task.N + 1}")
    if np.any(steps <= 0):
        k = int(np.argmax(steps <= 0))
        raise ValueError(
            f"{path}, {places[k + 1]}: t = {t[k + 1]:.9g} s does not increase from {t[k]:.9g} s"
        )
    median = float(np.median(steps))
    if abs(median / dt - 1) > RATE_TOLERANCE:
        raise ValueError(
            f"{path} is sampled at {median:.6g} s but the task at {dt:.6g} s; nothing is resampled: record it at the task's"
        )
    uneven = np.abs(steps / dt - 1) > STEP_TOLERANCE
    if np.any(uneven):
        k = int(np.argmax(uneven))
        missing = round(steps[k] / dt) - 1
        what = f"a gap of {missing} samples" if missing > 0 else f"a step of {steps[k]:.6g} s"
        raise ValueError(
            f"{path}, {places[k + 1]}: {what} before t = {t[k + 1]:.9g} s; allowed are steps of dt = {dt:.6g} s"
        )
    if len(t) != task.N + 1:
        raise ValueError(
            f"{path} has {len(t)} samples; this task needs N + 1 = {task.N + 1}, neither more nor fewer"
        )
    drift = t[-1] - t[0] - task.N * dt
    if abs(drift) > dt / 2:
        raise ValueError(
            f"{path}: the clock drifts by {drift:.3g} s over the trial; allowed is half a sample, {dt / 2:.3g} s"
        )


def _check_reference(path, r, places, task: Task) -> None:
    wanted = np.asarray(task.reference)
    allowed = REFERENCE_TOLERANCE * np.ptp(wanted)
    off = np.max(np.abs(r - wanted), axis=1)
    if np.any(off > allowed):
        k = int(np.argmax(off))
        shifted = [
            s
            for s in range(1, 4)
            for a, b in ((r[s:], wanted[:-s]), (r[:-s], wanted[s:]))
            if np.max(np.abs(a - b)) <= allowed
        ]
        hint = f"; it is that reference shifted by {shifted[0]} samples" if shifted else ""
        raise ValueError(
            f"{path}, {places[k]}: r is {off[k]:.3g} {task.unit} away from the task's reference; allowed is {allowed:.3g} {task.unit}{hint}"
        )


# Writing
# --------------------------------------------------------------------------------------------------


def write_schedules(
    path: str | Path,
    schedules: Mapping[str, np.ndarray],
    task: Task,
    *,
    trial: int,
    number: str = "double",
) -> None:
    """What `playback.schedules` gives, in the format of the file's name: .csv, .mat or .h. Written
    whole or not at all.

    trial: the one it is for;  number: of a C header, `double` or `float`. CSV and MATLAB hold t and
    r too, and so N+1 rows; those that are (N, n) repeat their last row in CSV. Numbers keep every
    digit. Raises ValueError for another format.
    """
    check_format(path, number)
    match Path(path).suffix:
        case ".csv":
            atomically(path, lambda file: file.write(_as_text(schedules, task).encode()))
        case ".mat":
            atomically(path, lambda file: _save_mat(file, schedules, task, trial))
        case _:
            atomically(
                path, lambda file: file.write(_as_header(schedules, task, trial, number).encode())
            )


def check_format(path: str | Path, number: str = "double") -> None:
    """Raises ValueError for a file that `write_schedules` cannot write."""
    if Path(path).suffix not in FORMATS:
        raise ValueError(f"{path} is none of the formats {', '.join(FORMATS)}")
    if number not in ("double", "float"):
        raise ValueError(f"number = {number!r} is not one of 'double', 'float'")
    if not Path(path).absolute().parent.is_dir():
        raise ValueError(f"{path}: the folder does not exist")


def _as_text(schedules, task: Task) -> str:
    columns = {"t": task.time[:, None], "r": np.asarray(task.reference)} | dict(schedules)
    header, values = [], []
    for name, signal in columns.items():
        unit, several = unit_of(name, task), signal.shape[1] > 1
        header += [f"{name}{i if several else ''} [{unit}]" for i in range(signal.shape[1])]
        values.append(np.vstack([signal, signal[-1:]]) if len(signal) == task.N else signal)
    rows = np.hstack(values).tolist()
    return "\n".join([",".join(header), *(",".join(map(repr, row)) for row in rows)]) + "\n"


def _save_mat(file, schedules, task: Task, trial: int) -> None:
    from scipy.io import savemat

    signals = {"t": task.time[:, None], "r": np.asarray(task.reference)} | {
        _identifier(name): t for name, t in schedules.items()
    }
    units = {_identifier(name): unit_of(name, task) for name in ("t", "r", *schedules)}
    savemat(file, {**signals, "units": units, "trial": float(trial), "dt": task.dt})


def _as_header(schedules, task: Task, trial: int, number: str) -> str:
    lines = [
        f"/* What the machine plays in trial {trial}, written by jaxilc. Row k holds from k dt to (k+1) dt. */",
        "",
    ]
    lines += [
        "#ifndef JAXILC_NEXT_H",
        "#define JAXILC_NEXT_H",
        "",
        f"#define JAXILC_TRIAL {trial}",
        f"#define JAXILC_SAMPLES {task.N}",
    ]
    lines += [f"#define JAXILC_SAMPLE_TIME {task.dt!r} /* s */", ""]
    for name, schedule in schedules.items():
        sizes = f"[{len(schedule)}]" + (f"[{schedule.shape[1]}]" if schedule.shape[1] > 1 else "")
        lines.append(f"/* {name} [{unit_of(name, task) or '-'}], trial {trial} */")
        rows = [", ".join(_literal(v, number) for v in row) for row in schedule]
        rows = [f"{{{row}}}" for row in rows] if schedule.shape[1] > 1 else rows
        lines += [
            f"static const {number} jaxilc_{_identifier(name)}{sizes} = {{",
            *(f"  {row}," for row in rows),
            "};",
            "",
        ]
    return "\n".join([*lines, "#endif", ""])


def _literal(value: float, number: str) -> str:
    return f"{np.float32(value)!s}f" if number == "float" else repr(float(value))


def _identifier(name: str) -> str:
    return re.sub(r"\W+", "_", name).strip("_")
