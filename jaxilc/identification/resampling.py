"""Signals with times of their own, put onto one uniform grid."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

RESAMPLED = (
    "resampled to {dt:g} s: outputs by linear interpolation between their samples, inputs by the "
    "mean over each new sample of the value that was held"
)
FINEST = 0.1  # of the median step of the record, the smallest new sample time
FEWEST = 10  # new samples
LONGEST_GAP = 10  # median steps without a sample that are bridged


class Signal(NamedTuple):
    """A signal as a file has it.

    times: (rows,) times [s]
    values: (rows,) values; of an input the last one may be NaN
    places: place of each row in the file, for messages
    unit: unit, "" where the file has none
    """

    times: np.ndarray
    values: np.ndarray
    places: list[str]
    unit: str = ""


def resampled(
    path, inputs: list[Signal], outputs: list[Signal], dt: float
) -> tuple[np.ndarray, np.ndarray]:
    """u (N, n_u) and y (N+1, n_y) on a grid of step dt, from the first common time on.

    An input is held from each of its times to the next, and its new value is the mean of that over
    the new sample, so that the area under it is kept. An output is interpolated linearly: it is
    sampled, not filtered, since the model is sampled in the same way and has no aliasing to match.

    Raises ValueError naming file and place for a gap, and for a step that does not suit the record.
    """
    signals = [*inputs, *outputs]
    steps = [np.diff(one.times) for one in signals]
    middle = max(float(np.median(of)) for of in steps)
    start = max(one.times[0] for one in signals)
    end = min(
        [one.times[-1] for one in outputs]
        + [one.times[-1] + float(np.median(np.diff(one.times))) for one in inputs]
    )
    low, high = FINEST * middle, (end - start) / FEWEST
    if not low <= dt <= high:
        raise ValueError(
            f"read_record: --dt {dt:g} (resample) is outside its allowed range "
            f"[{low:.3g}, {high:.3g}] s for {path}, whose median step is {middle:.6g} s"
        )
    for one, of in zip(signals, steps, strict=True):
        k = int(np.argmax(of))
        if of[k] > max(LONGEST_GAP * np.median(of), dt):
            raise ValueError(
                f"read_record: {path}, {one.places[k + 1]}: {of[k]:.6g} s without a sample, where "
                f"the median step is {np.median(of):.6g} s; cut the record there, since nothing is "
                "known of the gap"
            )
    grid = start + dt * np.arange(int(np.floor((end - start) / dt * (1 + 1e-12))) + 1)
    u = [np.diff(_integral(one, grid)) / dt for one in inputs]
    y = [np.interp(grid, one.times, one.values) for one in outputs]
    return np.stack(u, axis=1), np.stack(y, axis=1)


def _integral(held: Signal, grid) -> np.ndarray:
    """The integral over time of a signal that is held from each of its times to the next."""
    known = np.isfinite(held.values)
    times, values = held.times[known], held.values[known]
    last = float(np.median(np.diff(times)))
    area = np.concatenate([[0.0], np.cumsum(values * np.append(np.diff(times), last))])
    return np.interp(grid, np.append(times, times[-1] + last), area)
