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
from ..storage.files import atomically
from ..storage.reading import read_columns

STEP_TOLERANCE = (
    0.01  # of the sample time, by which a step of a record's time may differ from the others
)


class Record(NamedTuple):
    """An experiment. u: (N, n_u) input held over each sample;  y: (N+1, n_y) output, y[0] before
    u[0];  dt: sample time [s]
    """

    u: jax.Array | np.ndarray
    y: jax.Array | np.ndarray
    dt: float


def excite(machine: Machine, u, dt: float, *, key: jax.Array | None = None) -> Record:
    """The open-loop experiment: play u back on the machine, from rest, and record it through its
    encoder.

    u: (N, n_u) or (N,), for instance `references.m_sequence`;  dt: [s];  key: of the noise, None is
    a fixed one; may be vmapped The record holds the input as the actuator applied it (limits,
    converter); an input disturbance stays unseen, as it would.
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
) -> Record:
    """A record from a text file of columns with a header, separated by commas, semicolons or tabs;
    lengths and units are the user's.

    Row k holds t[k], u[k], y[k]: y is measured at t[k], then u acts until t[k+1]. The last row's u
    is not used.
    time, input, output: names of the columns; several names for several inputs or outputs
    Raises ValueError naming file, line and column: a column that is missing, a value that is no
    number or not finite, a time that does not increase or not by equal steps (to 1 %), fewer than 2
    rows.
    """
    inputs, outputs = (
        [names] if isinstance(names, str) else list(names) for names in (input, output)
    )
    values, lines = _table(path, [time, *inputs, *outputs])
    steps = np.diff(values[:, 0])
    if len(steps) < 1:
        raise ValueError(
            f"read_record: {path} has {len(values)} rows of data; allowed are at least 2"
        )
    if np.any(steps <= 0):
        k = int(np.argmax(steps <= 0))
        raise ValueError(
            f"read_record: {path}, line {lines[k + 1]}: {time} = {values[k + 1, 0]:.9g} s does not increase from {values[k, 0]:.9g} s"
        )
    uneven = np.abs(steps / np.median(steps) - 1) > STEP_TOLERANCE
    if np.any(uneven):
        k = int(np.argmax(uneven))
        raise ValueError(
            f"read_record: {path}, line {lines[k + 1]}: {time} steps by {steps[k]:.6g} s where the sample time is "
            f"dt = {np.median(steps):.6g} s; allowed is a deviation of {STEP_TOLERANCE:.0%}"
        )
    n = 1 + len(inputs)
    return Record(values[:-1, 1:n], values[:, n:], float(f"{np.mean(steps):.12g}"))


def write_record(
    path: str | Path, record: Record, *, time: str = "t", input: str = "u", output: str = "y"
) -> None:
    """The record as `read_record` reads it; several inputs become u_0, u_1, ..., likewise outputs.
    The last row repeats the last u.
    """
    u, y = as_columns("write_record", "u", record.u), as_columns("write_record", "y", record.y)
    header = [time]
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


def _table(path, names) -> tuple[np.ndarray, list[int]]:
    """(rows, names) values of the columns, and the line of each row."""
    header, rows = read_columns(path)
    missing = [name for name in names if name not in header]
    if missing:
        raise ValueError(
            f"read_record: {path} has no column {missing[0]!r}; present are {', '.join(header) or 'none'}"
        )
    at, values, lines = [header.index(name) for name in names], [], []
    for line, row in rows:
        values.append(
            [
                _number(path, line, name, row[i].strip() if i < len(row) else "")
                for name, i in zip(names, at, strict=True)
            ]
        )
        lines.append(line)
    return np.array(values, float).reshape(-1, len(names)), lines


def _number(path, line, name, text) -> float:
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise ValueError(
            f"read_record: {path}, line {line}: {name} = {text!r} is not a finite number"
        )
    return value


def as_columns(function, name, values) -> np.ndarray:
    """(rows, channels), finite."""
    values = np.asarray(values, dtype=float)
    values = values[:, None] if values.ndim == 1 else values
    if values.ndim != 2:
        raise ValueError(
            f"{function}: {name} has shape {values.shape}; allowed are (rows,) and (rows, channels)"
        )
    if not np.all(np.isfinite(values)):
        raise ValueError(
            f"{function}: {name} is not finite at sample {int(np.argmin(np.isfinite(values).all(axis=1)))}"
        )
    return values


def task_of(plant: Plant, u, dt: float) -> Task:
    return Task(np.zeros((len(u) + 1, plant.n_y)), dt=dt, inputs=u.shape[1])


@jax.jit
def played(machine: Machine, task: Task, u, key) -> Trial:
    """The trial that plays u back: the plain Scheme has nothing but a feedforward table."""
    return run_trial(machine, Scheme(), task, Feedforward(u), key)
