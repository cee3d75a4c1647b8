"""Repeats of a motion from files: columns of text, and arrays in .npz and .mat files.

The error of each trial is read. A file has one or several trials:

    text        a column e, or e_0, e_1 ... for several trials; or y and r, whose difference it is
    .npz, .mat  an array e with a row, or a column, for each trial; or y and r
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..pytree.closest import listed
from ..pytree.in_short import in_short
from ..pytree.ranges import require
from ..storage.columns import name_and_unit, numbers_in, read_columns
from ..storage.mat_files import MatValue, read_mat
from ..storage.sealed import Damaged, read_arrays
from .record_files import STEP_TOLERANCE, place_of_time, seconds_in

LARGEST = 256_000_000  # bytes of a file
SHORTER = 0.01  # share by which trials may differ in length; all are cut to the shortest


class Repeats(NamedTuple):
    """The errors of M trials with the same input.

    e: (M, N) errors
    dt: sample time [s]
    unit: of the error, "" where no file tells one
    names: of the trials
    position: (N,) where the first one was: its output, or else its reference; None if not read
    """

    e: np.ndarray
    dt: float
    unit: str
    names: tuple[str, ...]
    position: np.ndarray | None = None
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
    dt: sample time [s] of all files, whatever times they have
    without: sample time [s] of files without times
    Raises ValueError naming the file for what is missing or no number, for units or sample times
    that differ, and for trials whose lengths differ by more than 1 %.
    """
    for name, value in (("dt", dt), ("without", without)):
        if value is not None:
            require("read_repeats", name, value, "(0, inf)")
    trials, units, steps, names, places = [], [], [], [], []
    for path in map(Path, paths):
        signals = _signals_of(path, time, columns, dt, (error, output, reference))
        e = signals.errors(error, output, reference)
        step = without if signals.dt is None else signals.dt
        if step is None:
            raise ValueError(f"{path} has no times {time!r}; name them with --time, or give --dt")
        trials += list(e)
        names += [path.stem if len(e) == 1 else f"{path.stem} {j + 1}" for j in range(len(e))]
        units.append(signals.unit)
        _one_unit(path, units)
        places += [x[0] for x in map(signals.of, (output, reference)) if x is not None]
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
    position = places[0][: e.shape[1]] if places and len(places[0]) >= e.shape[1] else None
    return Repeats(e, steps[0], next(filter(None, units), ""), tuple(names), position)


# How it is done
# --------------------------------------------------------------------------------------------------


class _Signals(NamedTuple):
    """The signals of one file.

    found: arrays by name, (N,) or of several trials
    dt: sample time [s], None where the file tells none
    unit: of the error, "" where the file tells none
    """

    path: Path
    found: Mapping[str, MatValue]
    dt: float | None
    unit: str = ""

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
    if path.suffix.lower() not in (".npz", ".mat"):
        return _columns_of(path, time, columns, dt, names)
    found: Mapping[str, MatValue]
    if path.suffix.lower() == ".mat":
        found = read_mat(path, LARGEST)
    else:
        try:
            found = read_arrays(path, checked=False)
        except Damaged as damage:
            raise ValueError(str(damage)) from None
    if dt is None and time in found:
        dt = _step(path, np.ravel(np.asarray(found[time])).astype(float))
    return _Signals(path, found, dt)


def _step(path: Path, times: np.ndarray) -> float:
    """The sample time of uniform times; raises ValueError where they are not."""
    steps = np.diff(times)
    middle = float(np.median(steps)) if len(steps) else 0.0
    if not middle > 0 or np.any(np.abs(steps / middle - 1) > STEP_TOLERANCE):
        raise ValueError(f"{path}: its times are not uniform (to {STEP_TOLERANCE:.0%})")
    return float(f"{np.mean(steps):.12g}")


def _one_unit(path: Path, units: Iterable[str | None]) -> str:
    """The unit of errors, "" where none is told; raises ValueError for several."""
    told = {re.sub("[µμ]", "u", unit): unit for unit in units if unit}
    if len(told) > 1:
        raise ValueError(
            f"{path}: the errors are in {', '.join(told.values())}; allowed is one unit of all "
            "outputs and references, and nothing is converted"
        )
    return next(iter(told.values()), "")


def _columns_of(
    path: Path, time: str, columns: Sequence[str], dt: float | None, names: tuple[str, str, str]
) -> _Signals:
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
    if at is not None and dt is None and len(values) > 1:
        times = values[:, at]
        dt = _step(path, times * seconds_in(path, header[at], None, times))
    error, *others = names
    used = found.get(error) or [i for name in others for i in found.get(name, ())]
    unit = _one_unit(path, (name_and_unit(header[i])[1] for i in used))
    return _Signals(path, {name: values[:, i].T for name, i in found.items()}, dt, unit)
