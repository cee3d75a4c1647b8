"""Files that a controller reads: what it plays in the next trial, and a map over the position.

What a machine plays is CSV, MATLAB or a C header. CSV and MATLAB hold the time t and the reference
r beside the schedules, with their units: in the header of a CSV file, `t [s], r [mm], u [V]`, and
in the struct `units` of a .mat file. Several channels are u0, u1, ... in CSV, and columns in the
other formats.

A map over the position is for LinuxCNC, TwinCAT and any program in C:

.comp   LinuxCNC, with COMP_FILE_TYPE = 1: in each line the commanded position, and what is added to
        it on the way forward and backward (its forward_trim and reverse_trim)
.csv    position, forward, backward, with a header
.st     constants in Structured Text, for TwinCAT and other IEC 61131-3 controllers
.h      the same three arrays in C

Of LinuxCNC, its source tells (`usrmotLoadComp` in src/emc/usr_intf/usrmotintf.cc,
`EMCMOT_SET_JOINT_COMP` in src/emc/motion/command.c, `compute_screw_comp` and `output_to_hal` in
control.c there): motor_pos_cmd = pos_cmd + trim and pos_fb = motor_pos_fb - trim. With
COMP_FILE_TYPE = 1 the second and third numbers are the trims. With 0, the default, they are where
the axis came to, and the trim is nominal - forward, so this file would be read wrongly. Between
two lines a trim is a straight line, before the first and after the last one it stays. At rest the
trim stays. Where the direction changes, it moves with half of the joint's limits of speed
and acceleration. Trims are kept in single precision; the reading ends at a line without three
numbers, and lines beyond 256 are reported and left out.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..learning.playback import unit_of
from ..plants import PositionMap
from ..pytree.aliases import Value
from ..pytree.in_short import in_short
from ..signals.task import Task
from ..storage.files import atomically, write_file

FORMATS = (".csv", ".mat", ".h")  # of what a machine plays


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
    write_file(path, text)


def check_format(path: str | Path, number: str = "double") -> None:
    """Raises ValueError for a file that `write_schedules` cannot write."""
    if Path(path).suffix not in FORMATS:
        raise ValueError(f"{path} is none of the formats {', '.join(FORMATS)}")
    if number not in ("double", "float"):
        raise ValueError(f"number = {number!r} is not one of 'double', 'float'")
    if not Path(path).absolute().parent.is_dir():
        raise ValueError(f"{path}: the folder does not exist")
    if Path(path).is_dir():
        raise ValueError(f"{path} is a folder; choose another name of the file")


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


MAP_FORMATS = (".comp", ".csv", ".st", ".h")
MOST = 256  # lines that LinuxCNC keeps
NUMBER = re.compile(r"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")


# A map over the position
# --------------------------------------------------------------------------------------------------


class MapTable(NamedTuple):
    """A map as a table: each (n,), positions in rising order."""

    position: np.ndarray
    forward: np.ndarray
    backward: np.ndarray
    __repr__ = in_short


def write_map(path: str | Path, learned: PositionMap, positions: Value) -> MapTable:
    """Write a map at given positions, in the format of the file's name: .comp, .csv, .st or .h.

    The file is written completely or not at all, and numbers keep every digit. Between the
    positions a controller takes a straight line. For LinuxCNC the map is one of the position, as
    learned `OnReference`.

    learned: the map, such as `PositionBasis.map` returns it
    positions: (n,) two or more, rising

    Raises ValueError for another format, for positions that do not rise, for more than 256 of them
    in a .comp file, and for a folder that does not exist.
    """
    path, x = Path(path), np.asarray(positions, float)
    if path.suffix not in MAP_FORMATS:
        raise ValueError(f"write_map: {path} is none of the formats {', '.join(MAP_FORMATS)}")
    if not path.absolute().parent.is_dir():
        raise ValueError(f"write_map: {path}: the folder does not exist")
    if x.ndim != 1 or len(x) < 2 or not np.all(np.isfinite(x)) or np.any(np.diff(x) <= 0):
        raise ValueError(
            f"write_map: positions of shape {x.shape}; allowed are (n,), n >= 2, finite and rising"
        )
    if path.suffix == ".comp" and len(x) > MOST:
        raise ValueError(
            f"write_map: {len(x)} positions for {path.name}; LinuxCNC keeps no more than {MOST}"
        )
    fast = 0.0 if learned.turning is None else 1e3 * float(np.asarray(learned.turning))
    table = MapTable(x, *(np.asarray(learned.at(x, way * fast), float) for way in (1, -1)))
    if not all(np.all(np.isfinite(column)) for column in table):
        raise ValueError("write_map: the map has values that are not finite; allowed are numbers")
    rows = [" ".join(map(repr, row)) for row in np.column_stack(table).tolist()]
    literals = {name: map(_real, of.tolist()) for name, of in table._asdict().items()}
    arrays = {name: ", ".join(of) for name, of in literals.items()}
    match path.suffix:
        case ".comp":  # a comment would end the reading
            text = "\n".join([*rows, ""])
        case ".csv":
            text = "\n".join(
                [",".join(MapTable._fields), *(row.replace(" ", ",") for row in rows), ""]
            )
        case ".st":
            text = "VAR_GLOBAL CONSTANT\n" + "".join(
                f"    map_{name} : ARRAY[0..{len(x) - 1}] OF LREAL := [{values}];\n"
                for name, values in arrays.items()
            )
            text += "END_VAR\n"
        case _:
            text = f"#ifndef JAXILC_MAP_H\n#define JAXILC_MAP_H\n\n#define JAXILC_MAP {len(x)}\n"
            text += "".join(
                f"static const double jaxilc_map_{name}[JAXILC_MAP] = {{{values}}};\n"
                for name, values in arrays.items()
            )
            text += "\n#endif\n"
    write_file(path, text)
    return table


def _real(x: float) -> str:
    """A number with a point, as IEC 61131-3 asks of a real literal: 1.0e-05, and not 1e-05."""
    return re.sub(r"^(-?\d+)e", r"\1.0e", repr(x))


def read_map(path: str | Path) -> MapTable:
    """The table of a file that `write_map` wrote. Raises ValueError for what is no such table."""
    path = Path(path)
    if path.suffix not in MAP_FORMATS:
        raise ValueError(f"read_map: {path} is none of the formats {', '.join(MAP_FORMATS)}")
    text = path.read_text(encoding="utf-8")
    if path.suffix in (".comp", ".csv"):
        lines = text.splitlines()[path.suffix == ".csv" :]
        rows = [NUMBER.findall(line) for line in lines]
    else:
        lists = re.findall(r"=\s*[\[{]([^\]}]*)[\]}];", text)
        columns = [NUMBER.findall(one) for one in lists]
        even = len({len(one) for one in columns}) == 1
        rows = list(zip(*columns, strict=True)) if even and len(columns) == 3 else []
    if len(rows) < 2 or any(len(row) != 3 for row in rows):
        raise ValueError(f"read_map: {path.name} has no rows of {', '.join(MapTable._fields)}")
    return MapTable(*np.array(rows, float).T)
