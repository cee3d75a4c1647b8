"""Correctness and speed of `learn` on an accelerator, within a time budget.

    python experiments/benchmark/accelerator.py --minutes 8

The order: metrics and gradients against those of the CPU backend and of NumPy; the bandwidth of the
memory, by a copy; the time of one pass of an empty loop; then rows of times, the most important
first. The cost of a row is predicted from those before it. A row that does not fit into the time
that is left is named as not run, one that does not fit into the memory is named as such, and the
others go on. Rows that compute the same must have the same results, whatever their lanes and their
unrolling. When the time is up, what was measured is written, even while a program is compiled.

Written are out/experiments/benchmark/accelerator.json and .txt, a table. A row runs CFDL-MFAILC on
a motor of third order (Cao 2019, eq. 29). Its share of the bandwidth is that of the bytes that move
at least: in each trial the schedule is read and the record written, and learning reads the record
and the memory and writes the memory. A gradient moves them four times: it runs each trial forward,
again for its block, again for itself, and backward. Where a tile stays in a cache, as on a CPU, the
share may exceed 100 %.

Without an accelerator the sizes are small, and the output says that none was measured. To compare
flags of XLA, such as those of command buffers, run the script again with XLA_FLAGS and --out.
"""

import argparse
import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
import peers
import timing
from accelerator_programs import copy_rate, fitting, results, seconds_a_pass, setting, timed, use
from accelerator_rows import (
    ACCELERATOR,
    CPU,
    FAILED,
    Row,
    Sizes,
    failed,
    in_words,
    nearest,
    planned,
    predicted,
    table,
)

import jaxilc
from jaxilc.runtime import capacity, lanes, provenance

OUT = Path("out") / "experiments" / "benchmark"
REFERENCE = "reference.npz"
SPARE = 10.0  # seconds kept for writing the results
TOLERANCE = {  # largest difference from the reference, as a share of the largest value of its kind
    ("forward", "float64"): 1e-8,
    ("gradient", "float64"): 1e-6,
    ("forward", "float32"): 2e-2,
    ("gradient", "float32"): 1e-1,
}
CHECKED = {"trials": 10, "samples": 400, "machines": 48}  # of the comparison
CORES = 2  # of the CPU whose time of 1024 machines is kept


class Session:
    """The results so far, which are written after each row, and the time that is left."""

    def __init__(self, minutes: float, out: Path):
        self.end, self.out = time.monotonic() + 60 * minutes, out
        self.found: dict[str, Any] = {"minutes": minutes, "checks": [], "rows": []}
        self.firsts: dict[tuple, np.ndarray] = {}  # the first results of each kind of row
        self.waiting: list[Row] = []  # the rows that have not ended, of which one may be running
        self.running: Row | None = None
        self.child: subprocess.Popen | None = None
        self._lock = threading.Lock()
        self._watch = threading.Timer(max(self.left() + SPARE / 2, 0.1), self._time_is_up)
        self._watch.daemon = True
        self._watch.start()

    def left(self) -> float:
        return self.end - SPARE - time.monotonic()

    def add(self, kind: str, row: dict[str, Any]) -> None:
        with self._lock:
            self.found[kind].append(row)
            if kind == "rows":
                self.waiting.pop(0)
            self._write()
        print(in_words(row), flush=True)

    def finish(self) -> int:
        """Write and print the table; the result is the exit code."""
        self._watch.cancel()
        (self.out / REFERENCE).unlink(missing_ok=True)
        with self._lock:
            self._write()
            print(f"\n{table(self.found)}\nwritten: {self.out / 'accelerator.json'}", flush=True)
            return int(failed(self.found))

    def _write(self) -> None:
        for name, text in (("json", json.dumps(self.found, indent=1)), ("txt", table(self.found))):
            (self.out / f"accelerator.{name}").write_text(f"{text}\n")

    def _time_is_up(self) -> None:
        # A compiler cannot be interrupted, so the process ends here.
        if self.child is not None:
            self.child.kill()
        self.found["ended"] = "the time was up before every row had its turn"
        for row in self.waiting:
            begun = "it was still compiling or running when " if row is self.running else ""
            status = f"not run: {begun}the time was up"
            self.found["rows"].append(row._asdict() | {"status": status})
        os._exit(self.finish())


# The comparison
# --------------------------------------------------------------------------------------------------


def checked() -> dict[str, np.ndarray]:
    """The results that are compared with the reference, by what and precision."""
    found = {}
    for what, precision in TOLERANCE:
        use(precision)
        found[f"{what} {precision}"] = results(what, **CHECKED)
    return found


def reference(file: str) -> None:
    """In a process of its own, on CPU cores: the results to compare with, and a time."""
    jaxilc.setup(devices=CORES)
    found = checked()
    use("float64")
    row = Row("forward", 1024, ACCELERATOR.trials)
    times, _ = timed(row, ACCELERATOR.samples, fitting(row, ACCELERATOR.samples), 1, 1.0)
    np.savez(file, seconds=times["seconds"], **found)


def check(session: Session) -> None:
    """Compare with the CPU backend and with NumPy, and keep the time of the CPU."""
    file, patience = session.out / REFERENCE, max(session.left() / 3, 1.0)
    command = [sys.executable, __file__, "--reference", str(file)]
    session.child = subprocess.Popen(command, env=os.environ | {"JAX_PLATFORMS": "cpu"})
    ours = checked()  # at the same time
    use("float64")
    of, _ = setting(**CHECKED)
    compare(session, "NumPy", ours, {"forward float64": peers.numpy_batch(of.problem)})
    try:
        session.child.wait(timeout=patience)
        with np.load(file) as stored:
            wanted = dict(stored)
        session.found |= {"cpu_seconds_1024": float(wanted.pop("seconds")), "cpu_cores": CORES}
    except (subprocess.TimeoutExpired, OSError):
        session.child.kill()
        wanted = dict.fromkeys(ours, np.empty(0))
    compare(session, "CPU backend", ours, wanted)


def compare(session: Session, against: str, ours, wanted: dict[str, np.ndarray]) -> None:
    """A row for each wanted result; an empty one is of a reference that was not ready in time."""
    for name, values in wanted.items():
        limit = TOLERANCE[tuple(name.split())]
        off = timing.difference(ours[name], values) if values.size else np.nan
        row = {"check": name, "against": against, "allowed": limit, "held": bool(off <= limit)}
        session.add("checks", row | {"off_by": float(off) if np.isfinite(off) else None})


# The times
# --------------------------------------------------------------------------------------------------


def passes_of(row: Row, samples: int, lanes_taken: int) -> int:
    """The number of passes of the loop over samples on one device."""
    return -(-row.machines // (lanes_taken * jax.device_count())) * row.trials * samples


def result(row: Row, sizes: Sizes, session: Session) -> dict[str, Any]:
    """A row with what was measured, or with the reason why it was not."""
    try:
        return row._asdict() | _measured(row, sizes, session)
    except Exception as error:  # one row must not stop the others
        first = f"{type(error).__name__}: {error}".splitlines()[0]
        short = isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error)
        too_large = isinstance(error, ValueError) and " of memory, where " in str(error)
        status = "out of memory" if short or too_large else FAILED
        return row._asdict() | {"status": f"{status}: {first[:200]}"}


def _measured(row: Row, sizes: Sizes, session: Session) -> dict[str, Any]:
    use(row.precision, row.unroll)
    near = nearest(row, session.found["rows"])
    taken = row.lanes or lanes.usual_lanes() or _guess(row, near)
    passes = passes_of(row, sizes.samples, taken)
    seconds, left = predicted(row, taken, passes, near), session.left()
    if seconds > left:
        return {"status": f"not run: {seconds:.0f} s predicted, {max(left, 0):.0f} s left"}
    taken = row.lanes or fitting(row, sizes.samples)
    passes, rate = passes_of(row, sizes.samples, taken), 1e9 * session.found["copy_gb_a_second"]
    found, values = timed(row, sizes.samples, taken, passes, rate)
    if values is not None:
        first = session.firsts.setdefault((row.what, row.precision, row.trials), values)
        off, limit = timing.difference(values, first), TOLERANCE[row.what, row.precision]
        found["off_by"] = float(off) if np.isfinite(off) else None
        if not off <= limit:
            found["status"] = f"{FAILED}: off by {off:.1e} of other rows, allowed {limit:.0e}"
    return {"lanes": taken} | found


def _guess(row: Row, near: dict[str, Any] | None) -> int:
    """The lanes that a row may get, from the bytes of the most similar row."""
    each = 0.0 if near is None else near["bytes"] / near["lanes"]
    machines = -(-row.machines // jax.device_count())
    return lanes.lanes_for(capacity.device_memory(), each, machines)


def main(minutes: float, out: Path) -> int:
    jaxilc.setup()
    out.mkdir(parents=True, exist_ok=True)
    session, accelerated = Session(minutes, out), jax.default_backend() != "cpu"
    sizes = ACCELERATOR if accelerated else CPU
    kinds = f"{jax.device_count()} x {jax.devices()[0].device_kind}"
    session.found |= {
        "accelerator": accelerated,
        "device": f"{kinds}, JAX {jax.__version__}",
        "device_memory": capacity.device_memory(),
        "environment": provenance.environment(),
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
        "samples": sizes.samples,
        "usual_unroll": lanes.usual_unroll(),
    }
    session.waiting = planned(sizes, jax.device_count(), lanes.usual_unroll())
    check(session)
    use("float64")
    session.found |= {"copy_gb_a_second": copy_rate() / 1e9, "pass_us": 1e6 * seconds_a_pass()}
    while session.waiting:
        session.running = session.waiting[0]
        session.add("rows", result(session.running, sizes, session))
    return session.finish()


if __name__ == "__main__":
    if sys.argv[1:2] == ["--reference"]:
        reference(sys.argv[2])
        sys.exit()
    options = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    options.add_argument("--minutes", type=float, default=8.0, help="time for everything")
    options.add_argument("--out", type=Path, default=OUT, help="folder for the two files")
    sys.exit(main(**vars(options.parse_args())))
