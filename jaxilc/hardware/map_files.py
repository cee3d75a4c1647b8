"""Files with a map over the position, for LinuxCNC, TwinCAT and any program in C.

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
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..plants import PositionMap
from ..pytree.aliases import Value
from ..pytree.in_short import in_short
from ..storage.files import atomically

FORMATS = (".comp", ".csv", ".st", ".h")
MOST = 256  # lines that LinuxCNC keeps
NUMBER = re.compile(r"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")


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
    if path.suffix not in FORMATS:
        raise ValueError(f"write_map: {path} is none of the formats {', '.join(FORMATS)}")
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
    literals = {name: map(_literal, of.tolist()) for name, of in table._asdict().items()}
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
    atomically(path, lambda file: file.write(text.encode()))
    return table


def _literal(x: float) -> str:
    """A number with a point, as IEC 61131-3 asks of a real literal: 1.0e-05, and not 1e-05."""
    return re.sub(r"^(-?\d+)e", r"\1.0e", repr(x))


def read_map(path: str | Path) -> MapTable:
    """The table of a file that `write_map` wrote. Raises ValueError for what is no such table."""
    path = Path(path)
    if path.suffix not in FORMATS:
        raise ValueError(f"read_map: {path} is none of the formats {', '.join(FORMATS)}")
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
