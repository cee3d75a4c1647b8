"""The path of several axes in a TOML or JSON file, as the reference of a task.

    reference = { path = "circle", radius = 10.0, turns = 1.0, feed = 50.0, ... }
    reference = { path = "nurbs", points = [[0, 0], ...], degree = 3, knots = [], weights = [] }
    reference = { path = "butterfly", width = 20.0 }
    reference = { path = "points", file = "contour.csv", join = "lines", corner = 0.05 }
    reference = { path = "gcode", file = "part.ngc", rapid = 100.0, corner = "stop" }

Every path has `acceleration` and `jerk`, one number for the vector or one for each axis, and
`rest`, the time at rest before and after it. Every path but a program has `feed`. Lengths are in
the unit of the task, times in s. A path is measured from its start, since a plant starts at zero.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np
import scipy

from ..plants import Plant
from ..pytree.aliases import Value
from ..pytree.ranges import brief, require
from ..signals import paths
from ..signals.gcode import read_gcode
from ..signals.segments import FARTHEST, SHORTEST, Straight
from ..signals.tool_path import Dwell, Move, follow
from ..storage.columns import missing, name_and_unit, need_unit, numbers_in, read_columns
from ..storage.reading import quoted, read_text
from .specification import Table, at_place, list_of_numbers, number, numbers, one_of, text, whole

UNITS = "lengths in the `unit` of the task, times in s, feeds in that unit per s"
LARGEST_PROGRAM = 16_000_000  # bytes
_number = functools.partial(number, units=UNITS)
_positive = functools.partial(_number, allowed="(0, inf)")
MILLIMETRE = {"mm": 1.0, "": 1.0, "µm": 1e3, "um": 1e3, "m": 1e-3}  # in units of the task
POINTS = 100_000  # of a file, at most
Limits: TypeAlias = dict[str, np.ndarray]  # of acceleration and jerk
AXES = ("x", "y", "z")


class Setting(NamedTuple):
    """What a reference is read for.

    folder: folder of the file
    plant: the plant of the task
    names: names of its outputs; empty where they have none
    unit: unit of the task
    dt: sample time [s]
    notes: list to which texts on how paths are followed are appended
    """

    folder: Path
    plant: Plant
    names: tuple[str, ...]
    unit: str
    dt: float
    notes: list[str]

    @property
    def axes(self) -> tuple[str, ...]:
        """The names of the outputs, x, y and z where they have none."""
        return self.names or AXES[: self.plant.n_y]


def planned_path(values: Value, where: str, setting: Setting) -> np.ndarray:
    """(N+1, d) the reference along the path that a table describes.

    Raises ValueError naming the key, or file and line, that is wrong.
    """
    table = Table(values, where)
    kind = table.take("path", one_of(PATHS))
    limits = {
        name: table.take(name, lambda v, at: _limit(v, at, len(setting.axes)))
        for name in ("acceleration", "jerk")
    }
    rest = table.take("rest", functools.partial(_number, allowed="[0, inf)"), 0.0)
    reference, said = PATHS[kind](table, setting, limits)
    hold = np.ceil(rest / setting.dt - 1e-9)
    if not len(reference) + 2 * hold <= paths.LONGEST:
        raise ValueError(
            f"{table.at('rest')} = {rest:g} s makes the path longer than the {paths.LONGEST} "
            f"samples of dt = {setting.dt:g} s that are allowed"
        )
    reference = np.pad(reference - reference[0], ((int(hold), int(hold)), (0, 0)), mode="edge")
    seconds = (len(reference) - 1) * setting.dt
    setting.notes.append(f"the {kind} path takes {seconds:.6g} s; {said}")
    return reference


def _circle(table: Table, setting: Setting, limits: Limits) -> tuple[np.ndarray, str]:
    radius = table.take("radius", _number)
    turns = table.take("turns", functools.partial(_number, allowed="[0.01, 1000]"), 1.0)
    _need_axes(table, setting, 2)
    return _curve(table, setting, limits, lambda: (paths.circle(radius), (0.0, 2 * np.pi * turns)))


def _butterfly(table: Table, setting: Setting, limits: Limits) -> tuple[np.ndarray, str]:
    width = table.take("width", _number)
    _need_axes(table, setting, 2)
    return _curve(table, setting, limits, lambda: (paths.butterfly(width), (0.0, 1.0)))


def _nurbs(table: Table, setting: Setting, limits: Limits) -> tuple[np.ndarray, str]:
    points = table.take("points", numbers)
    degree = table.take("degree", whole, 3)
    if points.ndim != 2:
        raise ValueError(f"{table.at('points')} has shape {points.shape}; allowed is (n, d)")
    require("", table.at("degree"), degree, f"[1, {max(len(points) - 1, 1)}]", whole=True)
    inner = np.linspace(0.0, 1.0, max(len(points) - degree + 1, 2))
    clamped = np.concatenate([np.zeros(degree), inner, np.ones(degree)])
    knots = table.take("knots", list_of_numbers, clamped)
    weights = table.take("weights", list_of_numbers, None)
    if len(knots) != len(points) + degree + 1:
        raise ValueError(
            f"{table.at('knots')} has {len(knots)} numbers; {len(points)} points of degree "
            f"{degree} need {len(points) + degree + 1}"
        )
    if np.any(np.diff(knots) < 0) or not knots[degree] < knots[-degree - 1]:
        raise ValueError(
            f"{table.at('knots')} = {brief(knots.tolist())} must not fall, and must rise"
        )
    _need_axes(table, setting, points.shape[1])
    interval = (float(knots[degree]), float(knots[-degree - 1]))
    return _curve(table, setting, limits, lambda: (paths.nurbs(points, knots, weights), interval))


def _curve(
    table: Table, setting: Setting, limits, make: Callable[[], tuple]
) -> tuple[np.ndarray, str]:
    """The reference along a curve of `signals.paths`."""
    feed = table.take("feed", _number)
    table.done()
    with at_place(table.where, owner="plan"), _lengths_in(setting.unit or "mm"):
        curve, interval = make()
        made = paths.plan(curve, interval, feed=feed, dt=setting.dt, **limits)
    return made.reference, (
        f"{made.arc[-1]:.6g} {setting.unit} at up to {np.max(made.speed):.4g} {setting.unit}/s "
        f"(feed {feed:g})"
    )


def _points(table: Table, setting: Setting, limits: Limits) -> tuple[np.ndarray, str]:
    file = setting.folder / table.take("file", text)
    join = table.take("join", one_of(("lines", "spline")), "lines")
    points = _points_of(file, setting.axes, setting.unit)
    if join == "spline":
        return _curve(table, setting, limits, lambda: _spline(points, file))
    feed = table.take("feed", _number)
    corner = table.take("corner", _corner, None)
    table.done()
    # Joints that are no corners are smoothed within 0.001 mm.
    scale = MILLIMETRE.get(setting.unit, 1.0)
    moves = [Move(Straight(a, b), feed / scale) for a, b in itertools.pairwise(points / scale)]
    return _followed(moves, corner, setting, limits, table.where, scale)


def _gcode(table: Table, setting: Setting, limits: Limits) -> tuple[np.ndarray, str]:
    file = setting.folder / table.take("file", text)
    rapid = table.take("rapid", _positive, None)
    corner = table.take("corner", _corner, None)
    table.done()
    if setting.unit not in MILLIMETRE:
        raise ValueError(
            f"{table.where}: a program has lengths in mm, and the task has the unit "
            f"{setting.unit!r}; allowed are {', '.join(unit for unit in MILLIMETRE if unit)}"
        )
    scale = MILLIMETRE[setting.unit]
    program = read_text(file, LARGEST_PROGRAM)
    try:
        steps = read_gcode(program, setting.axes, rapid=None if rapid is None else rapid / scale)
    except ValueError as error:
        raise ValueError(f"{table.where}: {file}, {quoted(file, str(error))}") from None
    return _followed(steps, corner, setting, limits, f"{table.where}: {file}", scale)


def _followed(
    steps: Sequence[Move | Dwell], corner, setting: Setting, limits, where: str, scale: float
) -> tuple[np.ndarray, str]:
    """The reference along moves, and in words how corners are passed.

    steps: with lengths in mm, or in the unit of the task if that is no length
    corner, limits: in the unit of the task, of which a mm has `scale`
    """
    in_mm = {name: np.asarray(limit) / scale for name, limit in limits.items()}
    tolerance = None if corner is None else corner / scale
    unit = setting.unit
    with at_place(where, owner="plan"), _lengths_in("mm" if unit in MILLIMETRE else unit):
        made = follow(steps, corner=tolerance, dt=setting.dt, **in_mm)
    stops = f"{made.stops} stop{'s' * (made.stops != 1)} on the way"
    rounded = (
        'none rounded (corner = "stop")'
        if corner is None
        else f"{made.rounded} corner{'s' * (made.rounded != 1)} rounded within "
        f"{corner:g} {unit}".rstrip()
    )
    said = f"{made.length * scale:.6g} {unit}, {stops}, {rounded}".replace(" ,", ",")
    return made.reference * scale, said


@contextlib.contextmanager
def _lengths_in(unit: str) -> Generator[None]:
    """A ValueError of a plan from within, which takes lengths for mm, names the unit they have."""
    try:
        yield
    except ValueError as error:
        raise ValueError(str(error).replace(" mm", f" {unit}")) from None


def _spline(points: np.ndarray, file: Path) -> tuple:
    """A cubic spline through the points over the length of their chords; closed if they are."""
    if len(points) < 4:
        raise ValueError(f"{file} has {len(points)} points; a spline needs 4 at least")
    chords = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
    closed = bool(np.all(points[0] == points[-1]))
    kind = "periodic" if closed else "not-a-knot"
    spline = scipy.interpolate.CubicSpline(chords, points, bc_type=kind)
    return spline, (0.0, float(chords[-1]))


def _points_of(file: Path, axes: Sequence[str], unit: str) -> np.ndarray:
    """(M, d) the points of a file of columns named as the axes; one given twice counts once."""
    header, rows = read_columns(file)
    names, units = zip(*map(name_and_unit, header), strict=True)
    for axis in axes:
        if axis not in names:
            raise ValueError(missing(file, axis, header))
        if unit and (declared := units[names.index(axis)]):
            need_unit(file, axis, declared, unit)
    at = [names.index(axis) for axis in axes]
    found: list[np.ndarray] = []
    for line, row in rows:
        point = np.array(numbers_in(row, at))
        if not np.all(np.abs(point) <= FARTHEST):
            raise ValueError(
                f"{file}, line {line}: {quoted(file, brief(row))} has no number up to "
                f"{FARTHEST:g} for each axis"
            )
        if not found or np.max(np.abs(point - found[-1])) > SHORTEST:
            found.append(point)
        if len(found) > POINTS:
            raise ValueError(f"{file} has more than {POINTS} points; allowed are up to {POINTS}")
    if len(found) < 2:
        raise ValueError(f"{file} has {len(found)} different points; needed are 2 at least")
    return np.array(found)


def _limit(value: Value, where: str, d: int) -> np.ndarray:
    limit = numbers(value, where, UNITS, "(0, inf)")
    if limit.shape not in ((), (d,)):
        raise ValueError(
            f"{where} = {brief(value)} is not one number, or one for each of the {d} axes"
        )
    return limit


def _corner(value: Value, where: str) -> float | None:
    """The tolerance of rounding; None for "stop"."""
    if value == "stop":
        return None
    if isinstance(value, str):
        raise ValueError(f'{where} = {brief(value)} is not "stop", or a tolerance as a number')
    return _positive(value, where, note=', or "stop"')


def _need_axes(table: Table, setting: Setting, d: int) -> None:
    if len(setting.axes) != d:
        raise ValueError(
            f"{table.where}: a path of {d} axes for {len(setting.axes)} outputs "
            f"({', '.join(setting.axes)}); needed is one axis for each output"
        )


PATHS: dict[str, Callable[[Table, Setting, Limits], tuple[np.ndarray, str]]] = {
    "circle": _circle,
    "nurbs": _nurbs,
    "butterfly": _butterfly,
    "points": _points,
    "gcode": _gcode,
}
