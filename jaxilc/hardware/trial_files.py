"""Measured trials from files in CSV or MATLAB format.

A text file of columns has a header that declares units, `t [s], r [mm], y [mm], u [V]`; several
channels are y0, y1, ... Row k belongs to t[k]: y is measured at t[k], then u acts until t[k+1]. So
the u of the last row is not used and may be empty. A .mat file has variables of the same
names, with several channels as columns, and a struct `units` with a field for each.

What `identification.read_record` reads is read here too: times in ms, us or ns, decimal commas,
columns without a header, a count of samples in place of the time, exports of TwinCAT Scope, and
structures of MATLAB with Time and Data. Where a file declares no unit, the name of the column
does: `pos_act [mm]`.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from ..identification.record_files import (
    SAMPLE,
    SECONDS,
    STEP_TOLERANCE,
    is_twincat,
    name_and_unit_of_time,
    place_of_time,
    read_mat_signals,
    read_twincat,
)
from ..learning.playback import unit_of
from ..pytree.aliases import Leaf
from ..pytree.in_short import in_short
from ..pytree.ranges import brief
from ..schemes import FFDLMFAILC, AtSamples, KeepUnmeasured, PIDType, Scheme
from ..schemes.weights import weighed
from ..signals.task import Task, Trial
from ..storage.columns import (
    missing,
    name_and_unit,
    need_one,
    need_unit,
    numbers_in,
    plain_unit,
    read_columns,
)
from ..storage.mat_files import ROOM, Other, read_mat
from .checks import AS_PLAYED, LEARNED, Finding, kind, shifted, spaced
from .journal import ENDED

RATE_TOLERANCE = 1e-3  # share of the sample time by which the median step may differ
# Options of the command line that name columns, as `names` does.
OPTIONS = {"t": "--time", "u": "--input", "y": "--output", "r": "--set campaign.reference"}
REFERENCE_TOLERANCE = 1e-4  # share of the reference's range by which r may differ


Shapes: TypeAlias = Mapping[str, tuple[int, int]]  # (rows, channels) of signals by name


class Measured(NamedTuple):
    """A trial as a machine recorded it, with the task's length, sample time and units.

    y: (N+1, n_y) output
    u: (N, n_u) input, None where the file has none
    others: further signals that were asked for, by name
    samples: number of samples of a trial that ended early, see `read_measured`; else None
    """

    y: np.ndarray
    u: np.ndarray | None
    others: dict[str, np.ndarray]
    ignored: tuple[str, ...]
    source: str
    samples: int | None = None
    __repr__ = in_short

    @property
    def end(self) -> int:
        """The number of the last sample that was measured."""
        return len(self.y) - 1 if self.samples is None else self.samples


class _File(NamedTuple):
    """The contents of a file.

    columns: (rows, channels) values and unit by name; the unit is None where it is not declared
    places: place of each row in the file, for messages
    """

    columns: dict[str, tuple[np.ndarray, str | None]]
    places: list[str]
    ignored: tuple[str, ...]


def read_measured(
    path: str | Path,
    task: Task,
    others: Shapes | None = None,
    names: Mapping[str, str] | None = None,
    columns: Sequence[str] = (),
    *,
    short: bool = False,
) -> Measured:
    """A measured trial of the task, from a .mat file or a text file of columns.

    Columns are separated by commas, semicolons or tabs. The file needs t and y; it may hold r,
    which must be the task's, u, and the signals `others`.

    others: shape (rows, channels) of further signals, by name
    names: what the file calls a signal, such as {"y": "position"}; with commas between the names
        of several channels; None: as they are called here
    columns: names of the columns of a text file without a header; without t among them, each row
        is a sample, and a column `sample` counts them
    short: whether the trial may have ended early. Its signals have the length of the task all the
        same: after the end, y is the reference, and the input and the other signals are NaN, until
        `completed` knows them
    Raises ValueError naming file, place and signal: for a column that is missing or there twice,
    for a unit that is not declared or not the task's, for a value that is not finite, for a gap or
    an uneven step of the time, for another sample time or length (nothing is resampled), and for
    another reference.
    """
    shapes = {
        "t": (task.N + 1, 1),
        "y": (task.N + 1, task.outputs),
        "r": (task.N + 1, task.outputs),
        "u": (task.N, task.inputs),
        **(others or {}),
    }  # of a whole trial
    names = names or {}
    found = _read(path, shapes, names, columns, task.dt)
    last = len(found.columns["t"][0]) - 1
    if not short or last >= task.N:
        return _checked(path, task, shapes, found, names)
    if last < 1:
        raise ValueError(f"{path} has {last + 1} samples; a trial that ended early needs two")
    left = task.N - last
    part = dataclasses.replace(task, reference=task.reference[: last + 1], settle=None)
    shapes = {name: (rows - left, n) for name, (rows, n) in shapes.items()}
    measured = _checked(path, part, shapes, found, names)

    def filled(values):
        return np.pad(values, ((0, left), (0, 0)), constant_values=np.nan)

    return measured._replace(
        y=np.concatenate([measured.y, np.asarray(task.reference)[last + 1 :]]),
        u=None if measured.u is None else filled(measured.u),
        others={name: filled(values) for name, values in measured.others.items()},
        samples=last,
    )


def _checked(
    path: str | Path, task: Task, shapes: Shapes, found: _File, names: Mapping[str, str]
) -> Measured:
    """The trial that a file holds; raises ValueError as `read_measured`."""
    N = task.N
    for name, (values, unit) in found.columns.items():
        _check_unit(path, name, names.get(name, name), unit, unit_of(name, task))
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


def _read(
    path: str | Path, shapes: Shapes, names: Mapping[str, str], columns: Sequence[str], dt: float
) -> _File:
    """The contents of a file, whose time is in seconds, and whose units may be those of `names`."""
    called, units = {}, {}
    for name in shapes:
        whole = names.get(name, name)
        bare, unit = name_and_unit(whole)
        called[name], units[name] = (bare, unit) if unit is not None else (whole, None)
    if Path(path).suffix == ".mat":
        found = _read_mat(path, shapes, called, units)
    elif not columns and is_twincat(path):
        found = _read_scope(path, shapes, called)
    else:
        found = _read_text(path, shapes, called, columns, dt)
    for name, (values, unit) in found.columns.items():
        unit = unit or units[name]
        if name == "t" and (unit is None or unit in SECONDS):  # the step tells a wrong unit
            values, unit = values * SECONDS[unit or "s"], "s"
        found.columns[name] = values, unit
    return found


def _read_scope(path: str | Path, shapes: Shapes, called: Mapping[str, str]) -> _File:
    """The contents of an export of TwinCAT Scope, whose channels share the times of y."""
    columns: dict[str, tuple[np.ndarray, str | None]] = {}
    places: list[str] = []
    for name, (_, channels) in shapes.items():
        if name == "t":
            continue
        spelled = called[name].split(",")
        if channels > 1 and len(spelled) == 1:
            spelled = [f"{called[name]}{i}" for i in range(channels)]
        try:
            signals = read_twincat(path, [one.strip() for one in spelled])
        except ValueError as error:
            if name == "y" or called[name] != name or "has no channel" not in str(error):
                raise
            continue
        rows = min(len(one.values) for one in signals)
        values = np.stack([one.values[:rows] for one in signals], axis=1)
        columns[name] = values, signals[0].unit or None
        if name == "y":
            columns["t"], places = (signals[0].times[:rows, None], "s"), signals[0].places
    return _File(columns, places, ())


def _read_text(
    path: str | Path, shapes: Shapes, called: Mapping[str, str], given: Sequence[str], dt: float
) -> _File:
    header, lines = read_columns(path, given)
    most = 2 * shapes["t"][0] + 1000
    rows = list(itertools.islice(lines, most + 1))
    if len(rows) > most:
        raise ValueError(
            f"{path} has more than {most} rows of data; this task needs N + 1 = {shapes['t'][0]}"
        )
    headings = [name_and_unit(cell) for cell in header]
    names, units = [name for name, _ in headings], [unit for _, unit in headings]
    columns, used = {}, set()

    def values_in(at: Sequence[int]) -> np.ndarray:
        used.update(at)
        return np.array([numbers_in(row, at) for _, row in rows], float).reshape(-1, len(at))

    if (time := place_of_time(called["t"], header)) is not None:
        columns["t"] = values_in([time]), name_and_unit_of_time(header[time])[1]
    elif SAMPLE in names:
        columns["t"] = dt * values_in([names.index(SAMPLE)]), "s"
    elif given:
        columns["t"] = dt * np.arange(float(len(rows)))[:, None], "s"
    for name, (_, channels) in shapes.items():
        at = None if name in columns else _channels(path, name, channels, names, called[name])
        if at is None:
            continue
        for i in at:
            need_one(path, names, i)
        if len({plain_unit(units[i] or "") for i in at}) > 1:
            several = ", ".join(str(units[i]) for i in at)
            raise ValueError(
                f"{path}: the channels of {name} have the units {several}; allowed is one"
            )
        columns[name] = values_in(at), units[at[0]]
    return _File(
        columns,
        [f"line {line}" for line, _ in rows],
        tuple(n for i, n in enumerate(names) if i not in used),
    )


def _channels(path, name: str, channels: int, names: list[str], called: str) -> list[int] | None:
    """The columns of the channels of a signal; None where it is missing and not required.

    called: what the file calls it; a signal with another name than here is required
    """
    spelled = [
        [f"{called}{i}", f"{called}_{i}"] + [called] * (channels == 1) for i in range(channels)
    ]
    if "," in called:
        spelled = [[one.strip()] for one in called.split(",")]
        if len(spelled) != channels:
            raise ValueError(
                f"{path}: {OPTIONS[name]} {brief(called)} names {len(spelled)} columns; allowed "
                f"are the {channels} channels of {name} in this task"
            )
    at = [next((names.index(s) for s in ways if s in names), None) for ways in spelled]
    found = [i for i in at if i is not None]
    if len(found) == channels:
        return found
    if name in ("t", "y") or found or called != name:
        wanted = spelled[at.index(None)][-1 if channels == 1 else 0]
        raise ValueError(missing(path, wanted, names, OPTIONS.get(name, "")))
    return None


def _read_mat(
    path: str | Path, shapes: Shapes, called: Mapping[str, str], declared: Mapping[str, str | None]
) -> _File:
    needed = 8 * sum(rows * channels for rows, channels in shapes.values())
    contents = read_mat(path, ROOM + 32 * needed)  # the file may hold many other variables
    units = contents.get("units")
    if units is None and declared["y"] is not None:
        units = {called[name]: unit for name, unit in declared.items()}
        units[called["t"]] = declared["t"] or "s"
    if not isinstance(units, dict):
        raise ValueError(f"{path} has no struct 'units'; declare them there: units.y = 'mm'")
    columns: dict[str, tuple[np.ndarray, str | None]] = {}
    for name in sorted(shapes, key=lambda name: name == "t"):  # whose times y may have
        rows, channels = shapes[name]
        variable = called[name]
        if isinstance(contents.get(variable), dict) or "." in variable:
            signal = read_mat_signals(path, called["t"], [variable], None, None)[0]
            contents[variable] = signal.values[:, None]
            columns.setdefault("t", (signal.times[:, None], "s"))
        if variable not in contents:
            if name not in columns and (name in ("t", "y") or variable != name):
                raise ValueError(missing(path, variable, contents, OPTIONS[name], "variable"))
            continue
        values = contents[variable]
        unit = units.get(variable)
        allowed = f"allowed are real numbers in {channels} columns"
        if not isinstance(values, np.ndarray):
            said = values.said if isinstance(values, Other) else "no array"
            raise ValueError(f"{path}: {name} is {said}; {allowed}")
        if channels == 1 and values.ndim == 2 and 1 in values.shape:
            values = values.reshape(-1, 1)
        if values.ndim != 2 or values.shape[1] != channels or len(values) > 2 * rows + 1000:
            raise ValueError(f"{path}: {name} has shape {values.shape}; {allowed}")
        if not isinstance(unit, str | None):
            raise ValueError(
                f"{path}: units.{name} is {unit.said if isinstance(unit, Other) else 'no text'}"
            )
        columns[name] = values.astype(float), unit
    ignored = tuple(n for n in contents if n not in (*called.values(), "units"))
    return _File(columns, [f"sample {k}" for k in range(len(columns["t"][0]))], ignored)


def _check_unit(path, name: str, called: str, declared: str | None, wanted: str) -> None:
    if declared is None and wanted:
        needed = f"'{called} [{wanted}]'"
        way = f" in the file, or {OPTIONS[name]} {needed}" if name in OPTIONS else ""
        raise ValueError(f"{path}: {called} declares no unit; this task needs {needed}{way}")
    need_unit(path, name, declared or "", wanted)


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
            f"{path} is sampled at {median:.6g} s but the task at {dt:.6g} s; "
            "nothing is resampled: record it at the task's"
        )
    uneven = np.abs(steps / dt - 1) > STEP_TOLERANCE
    if np.any(uneven):
        k = int(np.argmax(uneven))
        missing = round(steps[k] / dt) - 1
        what = f"a gap of {missing} samples" if missing > 0 else f"a step of {steps[k]:.6g} s"
        raise ValueError(
            f"{path}, {places[k + 1]}: {what} before t = {t[k + 1]:.9g} s; "
            f"allowed are steps of dt = {dt:.6g} s"
        )
    if len(t) != task.N + 1:
        raise ValueError(
            f"{path} has {len(t)} samples; this task needs N + 1 = {task.N + 1}, "
            "neither more nor fewer; --set campaign.short_trial=true accepts fewer"
        )
    drift = t[-1] - t[0] - task.N * dt
    if abs(drift) > dt / 2:
        raise ValueError(
            f"{path}: the clock drifts by {drift:.3g} s over the trial; "
            f"allowed is half a sample, {dt / 2:.3g} s"
        )


def _check_reference(path, r, places, task: Task) -> None:
    wanted = np.asarray(task.reference)
    allowed = REFERENCE_TOLERANCE * np.ptp(wanted)
    off = np.max(np.abs(r - wanted), axis=1)
    if np.any(off > allowed):
        k = int(np.argmax(off))
        unit = spaced(task.unit)
        raise ValueError(
            f"{path}, {places[k]}: r is {off[k]:.3g}{unit} away from the task's reference; "
            f"allowed is {allowed:.3g}{unit}{shifted(r, wanted, allowed)}"
        )


# Trials that the machine ended early
# --------------------------------------------------------------------------------------------------


def completed(
    measured: Measured, commanded: Leaf, signals: dict[str, Leaf], played: Mapping[str, Leaf]
) -> tuple[Measured, Leaf, dict[str, Leaf]]:
    """The trial, its input and the signals of the scheme, all of the length of the task.

    What was commanded, computed and played stands in place of what was not measured.
    """
    known, others, u = {**signals, **played}, measured.others, measured.u
    if measured.samples is not None:
        others = {n: np.where(np.isnan(x), known[n], x) for n, x in others.items()}
        u = u if u is None else np.where(np.isnan(u), commanded, u)
    if "feedback" in others:
        signals = {**signals, "feedback": others["feedback"]}
    return measured._replace(u=u, others=others), commanded if u is None else u, signals


def ended(record: Trial, measured: Measured) -> Trial:
    """The record; of a trial that ended early, samples after the end have the weight zero."""
    if measured.samples is None:
        return record
    there = (np.arange(len(record.r)) <= measured.samples).astype(float)
    W = jnp.asarray(np.broadcast_to(there[:, None], record.r.shape))
    return jax.device_get(weighed(record, W))


def keeping(scheme: Scheme, *, begun: bool) -> Scheme:
    """The scheme; its `PIDType` leaves what was not measured: neither adds its sum nor forgets.

    A filter around it is given there what it was given before, and smooths over the end. Within
    `AtSamples`, whose weights are zero beside its windows, it learns as from a whole trial. MFAILC
    keeps there what it has of the trials before; where there are none, it begins with the reference
    as its output, which is no error.

    begun: whether a whole trial was learned from before
    """
    laws = (PIDType, FFDLMFAILC) if begun else (PIDType,)
    return jax.tree.map(
        lambda x: KeepUnmeasured(x) if isinstance(x, laws) else x,
        scheme,
        is_leaf=lambda x: isinstance(x, (*laws, AtSamples)),
    )


def told_of_end(
    measured: Measured, played: Mapping[str, Leaf], following: Mapping[str, Leaf], task: Task
) -> list[Finding]:
    """A note on a trial that ended early, with how far the law changes the rest of schedules."""
    if measured.samples is None:
        return []
    said = []
    for name in (name for name in played if kind(name) in LEARNED):
        rest = slice(measured.samples + len(played[name]) - task.N, None)
        change = float(np.max(np.abs(following[name][rest] - played[name][rest]), initial=0.0))
        if change > AS_PLAYED * np.max(np.abs(following[name])):
            said.append(f"{name} by up to {change:.3g}{spaced(unit_of(name, task))}")
    text = f"{ENDED} after {measured.samples} of {task.N} samples; the rest is not learned from, "
    how = f"but filter or law changes {', '.join(said)} there" if said else "but played as it was"
    return [Finding("note", text + how)]


def stored(record: Trial) -> dict[str, jax.Array]:
    """The arrays of a record as the journal keeps them; `weight` is there for one that ended early.

    Such a trial is no record of the machine to its end, so no plant is fitted to it.
    """
    arrays = {"y": record.y, "u": record.u} | {
        f"signals {name}": signal for name, signal in record.signals.items()
    }
    return arrays if record.weight is None else arrays | {"weight": record.weight}
