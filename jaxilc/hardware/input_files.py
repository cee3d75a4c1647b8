"""Files with what a machine plays in its next trial: CSV, MATLAB or a C header.

CSV and MATLAB hold the time t and the reference r beside the schedules, with their units: in the
header of a CSV file, `t [s], r [mm], u [V]`, and in the struct `units` of a .mat file. Several
channels are u0, u1, ... in CSV, and columns in the other formats.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ..learning.playback import unit_of
from ..signals.task import Task
from ..storage.files import atomically

FORMATS = (".csv", ".mat", ".h")


def write_schedules(
    path: str | Path,
    schedules: Mapping[str, np.ndarray],
    task: Task,
    *,
    trial: int,
    number: str = "double",
) -> None:
    """Write the schedules in the format of the file's name: .csv, .mat or .h.

    The file is written completely or not at all, and numbers keep every digit. CSV and MATLAB also
    hold t and r, which have N+1 rows; in CSV a schedule of N rows repeats its last row.

    schedules: (rows, channels) by name, as `playback.schedules` returns them
    trial: number of the trial in which they are played
    number: type of the numbers in a C header, `double` or `float`
    Raises ValueError for another format.
    """
    check_format(path, number)
    if Path(path).suffix == ".mat":
        atomically(path, lambda file: _save_mat(file, schedules, task, trial))
        return
    as_text = Path(path).suffix == ".csv"
    text = _as_text(schedules, task) if as_text else _as_header(schedules, task, trial, number)
    atomically(path, lambda file: file.write(text.encode()))


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
        f"/* What the machine plays in trial {trial}, written by jaxilc. "
        "Row k holds from k dt to (k+1) dt. */",
        "",
        "#ifndef JAXILC_NEXT_H",
        "#define JAXILC_NEXT_H",
        "",
        f"#define JAXILC_TRIAL {trial}",
        f"#define JAXILC_SAMPLES {task.N}",
        f"#define JAXILC_SAMPLE_TIME {float(task.dt)!r} /* s */",
        "",
    ]
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
