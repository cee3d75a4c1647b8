"""Signals from .mat files of MATLAB, version 5 to 7.

What is read, for a signal `u` with its times:

    arrays              variables t, u and y, as vectors of one length
    a structure         fields t, u and y of one structure
    times of its own    a structure u with the fields Time and Data, as of a timeseries; or time and
                        signals.values, Simulink's "structure with time" of one signal

An object, such as a timeseries itself or a Simulink.SimulationData.Dataset, is stored in a form of
MATLAB's own (MCOS), and a file of version 7.3 is HDF5. Neither can be read here. MATLAB turns them
into structures:

    u = struct('Time', u.Time, 'Data', u.Data); save('record.mat', 'u', 'y', '-v7')
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..pytree.closest import listed
from ..storage.mat_files import Other, read_mat
from .resampling import Signal
from .time_column import seconds_in

LARGEST = 256_000_000  # bytes of a file, packed or unpacked
EXPORT = "{0} = struct('Time', {0}.Time, 'Data', {0}.Data); save('record.mat', '{0}', ..., '-v7')"


def read_mat_signals(
    path: str | Path, time: str, names: list[str], unit: str | None, dt: float | None
) -> list[Signal]:
    """The signals with these names; a name may be a path, such as `log.u`.

    time: name of the times of arrays
    unit: unit of the times, None for seconds
    dt: sample time of arrays without times [s]
    Raises ValueError naming file and signal for what is missing or cannot be read; where it is an
    object or a file of version 7.3, with the line of MATLAB that exports it.
    """
    try:
        content = read_mat(path, LARGEST)
    except ValueError as error:
        if "version 7.3" not in str(error):
            raise
        raise ValueError(
            f"read_record: {path} is a MATLAB file of version 7.3 (HDF5), which is not read; save "
            f"it again: save('record.mat', {', '.join(map(repr, names))}, '-v7')"
        ) from None
    return [_signal(path, content, time, name, unit, dt) for name in names]


def _signal(path, content, time: str, name: str, unit, dt) -> Signal:
    level, value = _found(path, content, name)
    own = _own_times(value) if isinstance(value, dict) else None
    if isinstance(value, dict):
        if own is None:
            raise ValueError(
                f"read_record: {path}: {name} is a structure of {', '.join(value) or 'nothing'}; "
                "allowed are the fields Time and Data, or time and signals.values"
            )
        times, values = (_vector(path, f"{name}.{part}", of) for part, of in own)
    else:
        values = _vector(path, name, value)
        key = next((k for k in _spellings(time) if k in level), None)
        if key is None and dt is None:
            raise ValueError(
                f"read_record: {path} has no times {time!r} beside {name}; present are "
                f"{listed(level)}. Name them with --time, or give --dt (dt)"
            )
        times = np.arange(len(values)) * (dt or 0.0)
        if key is not None:
            times = _vector(path, key, level[key])
    if len(times) != len(values):
        raise ValueError(
            f"read_record: {path}: {name} has {len(values)} values and {len(times)} times"
        )
    for what, of in (("its times", times), (name, values)):
        if not np.all(np.isfinite(of[:-1])):
            k = int(np.argmin(np.isfinite(of)))
            raise ValueError(f"read_record: {path}, row {k + 1}: {what} is not a finite number")
    scale = 1.0 if dt is not None and own is None else seconds_in(path, time, unit, times)
    return Signal(times * scale, values, [f"row {k + 1}" for k in range(len(values))])


def _found(path, content: dict[str, Any], name: str) -> tuple[dict[str, Any], Any]:
    """The structure (or file) that holds a signal, and the signal."""
    level, *rest = [content]
    for part in name.split("."):
        if part not in level and level is content:  # within the only structure that has it
            holders = [of for of in content.values() if isinstance(of, dict) and part in of]
            level = holders[0] if len(holders) == 1 else level
        if part not in level:
            raise ValueError(
                f"read_record: {path} has no variable {name!r}; present are "
                f"{listed(level)}; --input (input) and --output (output) name others"
            )
        rest.append((level, level[part]))
        level = level[part] if isinstance(level[part], dict) else {}
    return rest[-1]


def _own_times(value: dict[str, Any]) -> tuple[tuple[str, Any], tuple[str, Any]] | None:
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


def _vector(path, name: str, value: Any) -> np.ndarray:
    """A vector of numbers, whatever its orientation."""
    if isinstance(value, Other):
        said = value.said
        if "object" in said:
            said = f"an object of MATLAB, which is not read; in MATLAB: {EXPORT.format(name)}"
        raise ValueError(f"read_record: {path}: {name} is {said}")
    if not isinstance(value, np.ndarray):
        raise ValueError(f"read_record: {path}: {name} is no array of numbers")
    plain = np.squeeze(np.asarray(value, float))
    if plain.ndim != 1:
        raise ValueError(
            f"read_record: {path}: {name} has the shape {value.shape}; allowed is a vector"
        )
    return plain


def _spellings(time: str) -> tuple[str, ...]:
    return (time, "time", "Time", "tout") if time == "t" else (time,)
