"""Timing of programs against each other, and the computer on which they run.

Numbers are compared first. On a computer with other users, two runs of one program may differ more
in time than two programs, so contenders take turns, and a ratio is the median over the turns.
Besides the wall time, the processor time of all threads is measured, which does not include waiting
for a core.
"""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable, Iterable, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxilc.pytree.ranges import require
from jaxilc.runtime.provenance import environment

OURS = "jaxilc"
TOLERANCE = {"float64": 1e-8, "float32": 2e-2}  # share of the largest number of its kind


class Row(NamedTuple):
    """The times of one contender.

    plants, trials: plants and trials that it ran; a slow contender runs a part of them
    difference: largest difference from ours, as a share of the largest number of its kind;
        None where nothing was compared
    compile_seconds: excess time of the first call over a later one, plus the time to build the
        program [s]
    seconds, cpu_seconds: (turns,) wall time and processor time of each turn [s]
    peak_bytes: RAM that the first call used, None where that is unknown
    steps: number of sample-steps of a turn
    """

    name: str
    plants: int
    trials: int
    difference: float | None
    compile_seconds: float
    seconds: tuple[float, ...]
    cpu_seconds: tuple[float, ...]
    peak_bytes: int | None
    steps: int

    @property
    def best(self) -> float:
        """The wall time per sample-step in the best turn [ns]."""
        return 1e9 * min(self.seconds) / self.steps

    @property
    def median(self) -> float:
        """The wall time per sample-step in the median turn [ns]."""
        return 1e9 * float(np.median(self.seconds)) / self.steps

    @property
    def cpu(self) -> float:
        """The processor time of all threads per sample-step in the best turn [ns]."""
        return 1e9 * min(self.cpu_seconds) / self.steps

    def ratios(self, ours: Row, clock: str = "seconds") -> np.ndarray:
        """(turns,) the time of this contender divided by that of `ours`, for the same work.

        clock: `seconds` or `cpu_seconds`
        """
        mine, theirs = (np.array(getattr(row, clock)) / row.steps for row in (self, ours))
        return mine / theirs


class Entry(NamedTuple):
    """A contender: the function that it runs, its part of the problem, and its build time [s]."""

    call: Callable[[], Any]
    plants: int
    trials: int
    samples: int
    built: float = 0.0


def in_turns(
    entries: Mapping[str, Entry],
    *,
    repeats: int,
    agreement: Callable[[Mapping[str, Any]], Mapping[str, float | None]] | None = None,
) -> dict[str, Row]:
    """Run each contender once, compare their numbers, then time all in turns.

    agreement: function that compares the results and returns how far each of them differs; None:
        `agreement_with_ours`
    Raises ArithmeticError where numbers differ, and ValueError for repeats < 1.
    """
    require("bench", "repeats", repeats, "[1, inf)")
    results, firsts, peaks = {}, {}, {}
    for name, entry in entries.items():
        peak, start = _Peak(), time.perf_counter()
        results[name] = entry.call()
        firsts[name] = time.perf_counter() - start
        peaks[name] = peak.bytes()
    off = (agreement or agreement_with_ours)(results)
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


def agreement_with_ours(results: Mapping[str, np.ndarray]) -> dict[str, float]:
    """How far each result differs from ours; raises ArithmeticError where one differs too much."""
    return {
        name: need_agreement(name, difference(result, results[OURS]), limit())
        for name, result in results.items()
    }


def need_agreement(name: str, off: float, allowed: float) -> float:
    """The difference `off` of a contender; raises ArithmeticError for more than is allowed."""
    if not off <= allowed:
        raise ArithmeticError(
            f"bench: {name} differs from jaxilc by {off:.2g} of the largest value; "
            f"allowed is {allowed:g}"
        )
    return off


def limit() -> float:
    """The difference that is allowed in the present precision."""
    return TOLERANCE["float64" if jax.config.jax_enable_x64 else "float32"]


def difference(part: np.ndarray, whole: np.ndarray) -> float:
    """The largest difference of a part (S', J', n') from the first entries of a whole (S, J, n).

    Each of the n' differences is divided by the largest value of its kind. The result is NaN if any
    difference is NaN.
    """
    whole = whole[tuple(slice(size) for size in part.shape)]
    largest = np.max(np.abs(whole), axis=(0, 1))
    return float(np.max(np.abs(part - whole) / np.where(largest > 0, largest, 1.0)))


class Cost(NamedTuple):
    """A straight line through times of one kind: seconds = start + slope x.

    residual: largest residual, as a share of the largest time
    """

    start: float
    slope: float
    residual: float


def cost(sizes: Iterable[int], seconds: Iterable[float]) -> Cost:
    """Fit a straight line to the times measured at two sizes or more."""
    x, t = np.array(list(sizes), float), np.array(list(seconds), float)
    slope, start = np.polyfit(x, t, 1)
    return Cost(
        float(start), float(slope), float(np.max(np.abs(start + slope * x - t)) / np.max(t))
    )


def as_json(rows: Mapping[str, Row]) -> dict[str, Any]:
    """The rows as dictionaries, with nanoseconds per sample-step and ratios to ours."""
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
    """The peak of the resident memory from now on, beyond what is in use now.

    Linux records this peak and allows a process to reset it; on other systems it is unknown.
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


# The computer
# --------------------------------------------------------------------------------------------------

INSTRUCTIONS = {"avx512f": "AVX-512", "avx2": "AVX2", "avx": "AVX", "sse2": "SSE2"}  # widest first
RIVALS = ("scipy", "control", "numba")
CPUINFO = Path("/proc/cpuinfo")


def cores() -> int:
    """The number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def computer() -> dict[str, Any]:
    """The processor and its widest instruction set, its load, and the versions of the programs.

    Linux tells the instruction set of x86-64; elsewhere the kind of the processor stands there.
    """
    try:
        lines = CPUINFO.read_text().split("\n\n")[0].splitlines()
    except OSError:
        lines = []
    fields = {name.strip(): text.strip() for name, _, text in (x.partition(":") for x in lines)}
    flags, kind = fields.get("flags", "").split(), platform.machine()
    return {
        "processor": fields.get("model name") or platform.processor() or kind,
        "instructions": next((name for f, name in INSTRUCTIONS.items() if f in flags), kind),
        "cores": cores(),
        **environment(*(name for name in RIVALS if find_spec(name))),
        "load": [round(x, 1) for x in getattr(os, "getloadavg", tuple)()],
    }


def in_words(machine: Mapping[str, Any]) -> str:
    """Three lines on the result of `computer`: the processor, ours, and the other programs."""
    cores, devices, versions = machine["cores"], machine["devices"], machine["versions"]
    others = (f"{name} {versions[name]}" for name in ("numpy", *RIVALS) if name in versions)
    return (
        f"{machine['processor']}, {machine['instructions']}, {cores} core{'s' * (cores != 1)}\n"
        f"jaxilc: jax {versions['jax']} on {devices} {machine['backend'].upper()} "
        f"device{'s' * (devices != 1)}, {machine['precision']}\n"
        f"others: {', '.join(others)}"
    )
