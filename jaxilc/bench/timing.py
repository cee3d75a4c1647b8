"""How programs are timed against each other: numbers compared first, then turn by turn.

On a machine that is also used otherwise, times of one run differ more than the programs do:
contenders take turns, a ratio is the median over the turns, and the processor time of all threads,
which waiting for a core does not enter, stands beside the clock's.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

OURS = "jaxilc"
TOLERANCE = {"float64": 1e-8, "float32": 2e-2}  # of the largest figure of its kind


class Row(NamedTuple):
    """What one contender took.

    plants, trials: it ran (a slow one runs a part);  difference: largest from ours, as a share of
    the largest figure of its kind
    compile_seconds: the first call beyond a later one, with building it;  seconds, cpu_seconds: of
    each turn, by the clock and of the processors;  peak_bytes: None where unknown;  steps:
    sample-steps of a turn
    """

    name: str
    plants: int
    trials: int
    difference: float
    compile_seconds: float
    seconds: tuple[float, ...]
    cpu_seconds: tuple[float, ...]
    peak_bytes: int | None
    steps: int

    @property
    def best(self) -> float:
        """ns per sample-step in the best turn."""
        return 1e9 * min(self.seconds) / self.steps

    @property
    def median(self) -> float:
        """ns per sample-step in the median turn."""
        return 1e9 * float(np.median(self.seconds)) / self.steps

    @property
    def cpu(self) -> float:
        """Processor ns per sample-step, of all threads together, in the best turn."""
        return 1e9 * min(self.cpu_seconds) / self.steps

    def ratios(self, ours: Row, clock: str = "seconds") -> np.ndarray:
        """Turn by turn, how many times what we took this contender took, for the same work. clock:
        `seconds` or `cpu_seconds`
        """
        return (
            np.array(getattr(self, clock))
            / self.steps
            / (np.array(getattr(ours, clock)) / ours.steps)
        )


class Entry(NamedTuple):
    """A contender: what it runs and how much of the whole."""

    call: Callable[[], np.ndarray]
    plants: int
    trials: int
    samples: int
    built: float = 0.0


def cores() -> int:
    """Cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def machine() -> dict[str, Any]:
    """Where and under what load it is measured."""
    return {
        "cores": cores(),
        "devices": jax.device_count(),
        "backend": jax.default_backend(),
        "load": [round(x, 1) for x in os.getloadavg()],
    }


def in_turns(entries: Mapping[str, Entry], *, repeats: int) -> dict[str, Row]:
    """Run each once, compare the numbers with ours, then time them turn by turn.

    Raises ArithmeticError for other numbers, ValueError for repeats < 1.
    """
    if repeats < 1:
        raise ValueError(f"bench: repeats = {repeats} is outside its allowed range [1, inf)")
    results, firsts, peaks = {}, {}, {}
    for name, entry in entries.items():
        peak, start = _Peak(), time.perf_counter()
        results[name] = entry.call()
        firsts[name] = time.perf_counter() - start
        peaks[name] = peak.bytes()
    limit = TOLERANCE["float64" if jax.config.jax_enable_x64 else "float32"]
    off = {name: difference(result, results[OURS]) for name, result in results.items()}
    for name, value in off.items():
        if not value <= limit:
            raise ArithmeticError(
                f"bench: {name} differs from jaxilc by {value:.2g} of the largest figure; allowed is {limit:g}"
            )
    turns: dict[str, list[tuple[float, float]]] = {name: [] for name in entries}
    for _ in range(repeats):
        for name, entry in entries.items():
            start, cpu = time.perf_counter(), time.process_time()
            entry.call()
            turns[name].append((time.perf_counter() - start, time.process_time() - cpu))
    seconds = {name: tuple(zip(*times, strict=True)) for name, times in turns.items()}
    return {
        name: Row(
            name,
            entry.plants,
            entry.trials,
            off[name],
            entry.built + max(firsts[name] - min(seconds[name][0]), 0.0),
            *seconds[name],
            peaks[name],
            entry.plants * entry.trials * entry.samples,
        )
        for name, entry in entries.items()
    }


def difference(part: np.ndarray, whole: np.ndarray) -> float:
    """Largest difference of a part (S', J', n) from the first of the whole (S, J, n), each of the n
    over its largest; NaN if any is.
    """
    whole = whole[: part.shape[0], : part.shape[1]]
    largest = np.max(np.abs(whole), axis=(0, 1))
    return float(np.max(np.abs(part - whole) / np.where(largest > 0, largest, 1.0)))


class Cost(NamedTuple):
    """seconds = start + slope x, fitted over sizes of one kind; residual: the largest, as a share
    of the largest time.
    """

    start: float
    slope: float
    residual: float


def cost(sizes: Iterable[int], seconds: Iterable[float]) -> Cost:
    """Fit a line through the times measured at two sizes or more."""
    x, t = np.array(list(sizes), float), np.array(list(seconds), float)
    slope, start = np.polyfit(x, t, 1)
    return Cost(
        float(start), float(slope), float(np.max(np.abs(start + slope * x - t)) / np.max(t))
    )


def as_json(rows: Mapping[str, Row]) -> dict[str, Any]:
    """What was measured and what follows from it."""
    ours = rows[OURS]
    return {
        name: row._asdict()
        | {
            "ns_best": row.best,
            "ns_median": row.median,
            "ns_cpu": row.cpu,
            "ratio": row.ratios(ours).tolist(),
            "cpu_ratio": row.ratios(ours, "cpu_seconds").tolist(),
        }
        for name, row in rows.items()
    }


class _Peak:
    """Largest resident memory from here on, beyond what there is now. Linux keeps it and lets it be
    set back.
    """

    def __init__(self):
        try:
            with open("/proc/self/clear_refs", "w") as file:
                file.write("5")
            self.before = self._status("VmRSS")
        except OSError:
            self.before = None

    def bytes(self) -> int | None:
        return None if self.before is None else max(self._status("VmHWM") - self.before, 0)

    @staticmethod
    def _status(name: str) -> int:
        with open("/proc/self/status") as file:
            return next(1024 * int(line.split()[1]) for line in file if line.startswith(name))
