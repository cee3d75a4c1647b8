"""Recorded experiments: played on a machine, or read from a file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from ..learning.machine import Machine
from ..learning.within_trial import run_trial
from ..plants import Plant
from ..schemes import Scheme
from ..schemes.scheme import Feedforward
from ..signals.task import Task, Trial
from ..storage.columns import name_and_unit, numbers_in, read_columns
from ..storage.files import atomically
from .time_column import name_and_unit_of_time, place_of_time, seconds_in

# Share of the sample time by which a step of a record's time may differ from the others.
STEP_TOLERANCE = 0.01


class Record(NamedTuple):
    """The record of an experiment.

    u: (N, n_u) input, held over each sample
    y: (N+1, n_y) output; y[0] is measured before u[0] acts
    dt: sample time [s]
    """

    u: jax.Array | np.ndarray
    y: jax.Array | np.ndarray
    dt: float


def excite(machine: Machine, u, dt: float, *, key: jax.Array | None = None) -> Record:
    """Run an open-loop experiment: the machine plays u from rest, its encoder records the output.

    The record holds the input as the actuator applied it, with limits and converter. A disturbance
    at the input is not recorded, as on a real machine.

    u: (N, n_u) or (N,), for instance `references.m_sequence`
    dt: sample time [s]
    key: key of the noise, None for a fixed one; may be batched by `vmap`
    Raises ValueError for an input that is not finite or does not fit the plant.
    """
    u = as_columns("excite", "u", u)
    task = task_of(machine.plant, u, dt)
    machine.check(task)
    trial = played(machine, task, u, jax.random.key(0) if key is None else key)
    return Record(trial.u, trial.y, dt)


def read_record(
    path: str | Path,
    *,
    time: str = "t",
    input: str | Sequence[str] = "u",
    output: str | Sequence[str] = "y",
    time_unit: str | None = None,
) -> Record:
    """A record from a text file of columns with a header.

    Columns are separated by commas, semicolons or tabs. A heading is a name, or a name with a unit
    such as `y [mm]`. The time is converted to seconds from the unit in its heading (`t [ms]`,
    `time (ms)`, `t_ms`) or from `time_unit`; nothing else is converted. Row k holds t[k], u[k],
    y[k]: y is measured at t[k], then u acts until t[k+1]. The last row's u is not used and may be
    empty.

    time, input, output: names of the columns; several names for several inputs or outputs
    time_unit: s, ms, us or ns; None for the unit in the heading, or seconds if it has none
    Raises ValueError naming file, line and column for a column that is missing, a value that is not
    a finite number, a time that does not increase or whose steps are not equal (to 1 %), for a time
    without a unit whose steps are 0.1 or more, such as milliseconds, and for fewer than 2 rows.
    """
    inputs, outputs = (
        [names] if isinstance(names, str) else list(names) for names in (input, output)
    )
    values, lines = _columns(path, time, inputs, outputs, time_unit)
    steps = np.diff(values[:, 0])
    if len(steps) < 1:
        raise ValueError(
            f"read_record: {path} has {len(values)} rows of data; allowed are at least 2"
        )
    if np.any(steps <= 0):
        k = int(np.argmax(steps <= 0))
        raise ValueError(
            f"read_record: {path}, line {lines[k + 1]}: {time} = {values[k + 1, 0]:.9g} s "
            f"does not increase from {values[k, 0]:.9g} s"
        )
    uneven = np.abs(steps / np.median(steps) - 1) > STEP_TOLERANCE
    if np.any(uneven):
        k = int(np.argmax(uneven))
        raise ValueError(
            f"read_record: {path}, line {lines[k + 1]}: {time} steps by {steps[k]:.6g} s "
            f"where the sample time is dt = {np.median(steps):.6g} s; "
            f"allowed is a deviation of {STEP_TOLERANCE:.0%}"
        )
    n = 1 + len(inputs)
    return Record(values[:-1, 1:n], values[:, n:], float(f"{np.mean(steps):.12g}"))


def column_units(path: str | Path, *names: str) -> tuple[str, ...]:
    """The units that the headings of columns name, such as `mm` of `y [mm]`; "" where none is.

    Raises ValueError for a column that is missing.
    """
    header, _ = read_columns(path)
    return tuple(name_and_unit(header[_place(path, name, header)])[1] or "" for name in names)


def write_record(
    path: str | Path, record: Record, *, time: str = "t", input: str = "u", output: str = "y"
) -> None:
    """Write a record as `read_record` reads it, with the time in seconds.

    Several inputs become the columns u_0, u_1, ..., and likewise several outputs. The last row
    repeats the last u.
    """
    u, y = as_columns("write_record", "u", record.u), as_columns("write_record", "y", record.y)
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


def _columns(path, time, inputs, outputs, unit) -> tuple[np.ndarray, list[int]]:
    """(rows, columns) the values of time [s], inputs, outputs, and the line of each row."""
    header, rows = read_columns(path)
    names = [time, *inputs, *outputs]
    place = place_of_time(time, header)
    first = _place(path, time, header) if place is None else place
    at = [first, *(_place(path, name, header) for name in names[1:])]
    values, lines, wrong = [], [], ""
    for line, row in rows:
        if wrong:
            raise ValueError(wrong)
        found = numbers_in(row, at)
        for i in np.flatnonzero(~np.isfinite(found)):
            text = row[at[i]].strip() if at[i] < len(row) else ""
            wrong = wrong or (
                f"read_record: {path}, line {line}: {names[i]} = {text!r} is not a finite number"
            )
            if text or not 0 < i <= len(inputs):  # the last row may have no input
                raise ValueError(wrong)
        values.append(found)
        lines.append(line)
    found = np.array(values, float).reshape(-1, len(names))
    if len(found) > 1:
        found[:, 0] *= seconds_in(path, header[first], unit, found[:, 0])
    return found, lines


def _place(path, name: str, header: list[str]) -> int:
    """The index of a column, found by its whole heading or its heading without the unit."""
    for headings in (header, [name_and_unit(heading)[0] for heading in header]):
        if name in headings:
            return headings.index(name)
    present = ", ".join(header) or "none"
    raise ValueError(f"read_record: {path} has no column {name!r}; present are {present}")


def as_columns(function, name, values) -> np.ndarray:
    """The values as (rows, channels); raises ValueError where they are not finite."""
    values = np.asarray(values, dtype=float)
    values = values[:, None] if values.ndim == 1 else values
    if values.ndim != 2:
        raise ValueError(
            f"{function}: {name} has shape {values.shape}; allowed are (rows,) and (rows, channels)"
        )
    if not np.all(np.isfinite(values)):
        k = int(np.argmin(np.isfinite(values).all(axis=1)))
        raise ValueError(f"{function}: {name} is not finite at sample {k}")
    return values


def task_of(plant: Plant, u, dt: float) -> Task:
    """The task of an experiment: its length and sample time, with a reference of zero."""
    return Task(np.zeros((len(u) + 1, plant.n_y)), dt=dt, inputs=u.shape[1])


@jax.jit
def played(machine: Machine, task: Task, u, key) -> Trial:
    """The trial that plays u back; the plain Scheme has only its feedforward."""
    return run_trial(machine, Scheme(), task, Feedforward(u), key)
