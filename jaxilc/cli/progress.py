"""Progress bars, which are shown in terminals only, and stopping a long computation.

How long commands took on this computer is kept, so that the time left is known before a part is
done.
"""

from __future__ import annotations

import hashlib
import importlib
import json
import os
import sys
import threading
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from . import console

if TYPE_CHECKING:
    import numpy as np
    import xarray as xr

    from ..sweeps import Sweep

T = TypeVar("T")

WRITTEN = ("--out", "--json", "--report", "--figures", "--seed")  # take no time of their own
KEPT = 200  # commands
# Seconds of a command the first time, measured on an axis as `init` writes it (`identify`: 5000
# samples): two cores, nothing compiled.
USUAL = {"run": 4.0, "certify": 10.0, "identify": 6.0, "filter": 10.0, "export": 12.0,
         "worst-case": 7.0, "tune": 8.0, "design": 62.0, "learn-law": 66.0}  # fmt: skip
WORTH_KEEPING = 1.0  # seconds from which on the duration of a command is kept
# Packages that a command needs when its sweep or tuning is computed.
AFTERWARDS = ("xarray", "zarr", "matplotlib.figure", "matplotlib.backends.backend_agg")


def progress_bar(
    *, transient: bool = False, expected: float | None = None, usual: float | None = None
):
    """A progress bar that shows the field `now` of its tasks; nothing is shown without a terminal.

    A task takes one line; the bar is as long as the terminal leaves room for.

    expected, usual: seconds that all took the last time here, or takes elsewhere, for the time left
    """
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )
    from rich.table import Column
    from rich.text import Text

    class Left(TimeRemainingColumn):
        max_refresh = 0.0  # it falls each second

        def render(self, task):
            if task.finished or task.time_remaining is not None or not (expected or usual):
                return super().render(task)
            left = (expected or 0.0) - (task.elapsed or 0.0)
            told = f"about {left:.0f} s left" if left > 1.0 else "longer than before"
            told = told if expected else f"often {usual:.0f} s"
            return Text(told, style="progress.remaining", no_wrap=True)

    columns = (
        TextColumn("{task.description}"),
        BarColumn(bar_width=None, table_column=Column(ratio=1)),
        MofNCompleteColumn(),
        TextColumn("{task.fields[now]}"),
    )
    return Progress(
        *columns, TimeElapsedColumn(), Left(), expand=True, transient=transient,
        console=console.err, disable=console.out.quiet or not console.err.is_terminal,
    )  # fmt: skip


@contextmanager
def working(command: str) -> Generator[Callable[..., None]]:
    """A context with the progress bar of a command, which is gone when the command prints.

    It begins before JAX is loaded, so that something is seen within the first second. It yields a
    function of what is done now, and of the parts that are done and in total. The time left follows
    from these, and before that from the same command, or that command on the same scenario.
    """
    start = time.perf_counter()
    keys = [key_of([command, *sys.argv[1:end]]) for end in (None, 3)]
    known = [seconds for seconds in map(taken, keys) if seconds is not None]
    last, usual = next(iter(known), None), USUAL.get(command)
    with progress_bar(transient=True, expected=last, usual=usual) as bar:
        one = bar.add_task(command, total=None, now="starting")

        def told(now: str, done: float | None = None, total: float | None = None) -> None:
            bar.update(one, now=now, completed=done, total=total)

        yield told
    seconds = time.perf_counter() - start
    if seconds > WORTH_KEEPING:
        for key in keys:
            remember(key, seconds)


def run_sweep(
    plan: Sweep,
    store: Path,
    *,
    resume: bool,
    progress: Callable[..., str] = lambda *_: "",
    results: Callable[..., object] = lambda *_: None,
    cluster: str | None,
) -> xr.Dataset:
    """Run a sweep, as `Sweep.run`, with a progress bar for each scheme.

    It shows what `progress` returns when a chunk is computed and again when it is stored, or then
    the speed where that is empty. Ctrl-C ends the command with exit code 130, and a chunk that no
    worker could compute ends it with exit code 1.
    """
    from ..sweeps.cluster import ChunkFailed

    console.stage_ends("start")
    start, counted = time.perf_counter(), 0
    with progress_bar() as bar:
        bars = {
            name: bar.add_task(name, total=plan.population.size * plan.axes.size, now="")
            for name in plan.schemes
        }

        def told(name: str, done: int, fresh: int) -> None:
            rate = f"{counted / (time.perf_counter() - start):.2g} steps/s"
            bar.update(bars[name], completed=done, now=progress(name, done, fresh) or rate)

        def computed(name: str, values: Mapping[str, np.ndarray]) -> None:
            nonlocal counted
            counted += (values["finite"] | values["diverged"]).sum() * plan.task.N
            results(name, values)
            if now := progress(name, 0, 0):
                bar.update(bars[name], now=now)

        try:
            run = partial(plan.run, results=computed, cluster=cluster)
            dataset = run_search(run, store, resume=resume, progress=told)
        except ImportError as error:
            if cluster is None:
                raise
            raise ValueError(f"--dask: {error}") from None
        except ChunkFailed as error:
            console.warn(f"error: {error}")
            console.warn(f"{store} holds what is done: the same command with --resume goes on")
            sys.exit(1)
    console.stage_ends("run")
    return dataset


def run_search(
    search: Callable[..., T],
    state: Path,
    *,
    resume: bool,
    progress: Callable[..., object],
    meanwhile: Sequence[Callable[[], object]] = (),
) -> T:
    """Run a sweep, or one or several tunings, as `outcomes.tuning.run_search`.

    What the command needs afterwards is done meanwhile. Ctrl-C ends it with exit code 130.
    """
    works = (lambda: [*map(importlib.import_module, AFTERWARDS)], *meanwhile)

    def do_works() -> None:
        for work in works:
            with suppress(Exception):  # it comes again where the result is needed
                work()

    later = threading.Thread(target=do_works)

    def told(*step: object) -> None:
        progress(*step)
        # From now on the devices compute; and what stores results is imported, which ends in an
        # error where two threads import it at once.
        if later.ident is None:
            later.start()

    try:
        found = search(state, resume=resume, progress=told)
        if later.ident is not None:
            later.join()
    except KeyboardInterrupt:
        kept = f"{state} holds what is done: the same command with --resume goes on"
        console.warn(f"stopped; {kept if state.exists() else 'nothing was done yet'}")
        sys.exit(130)
    return found


# How long commands took on this computer
# --------------------------------------------------------------------------------------------------


def durations_file() -> Path | None:
    """The file of durations, in the user's cache or JAXILC_CACHE; None where that is `off`."""
    chosen = os.environ.get("JAXILC_CACHE", "")
    if chosen == "off":
        return None
    with suppress(RuntimeError):  # a user without a home folder
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jaxilc"
        return Path(chosen or cache) / "durations.json"
    return None


def key_of(arguments: Sequence[str]) -> str:
    """A short name for what a command computes, whatever files it writes."""
    words, skipped = [], False
    for word in arguments:
        if skipped or word.partition("=")[0] in WRITTEN:
            skipped = not skipped and "=" not in word
        else:
            words.append(word)
    return hashlib.sha256(json.dumps(words).encode()).hexdigest()[:16]


def taken(key: str) -> float | None:
    """The seconds that it took the last time; None if it was never run, or nothing is kept."""
    return _known().get(key)


def remember(key: str, seconds: float) -> None:
    """Keep the seconds that it took; where no file can be written, nothing is kept."""
    from ..storage.sealed import write_json

    path, known = durations_file(), _known()
    if path is None:
        return
    known.pop(key, None)
    known[key] = round(seconds, 2)
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, dict(list(known.items())[-KEPT:]))


def _known() -> dict[str, float]:
    """All durations; none where the file is missing or is not what was written."""
    path = durations_file()
    if path is None:
        return {}
    try:
        found = json.loads(path.read_bytes())
        return {str(key): float(seconds) for key, seconds in found.items()}
    except (OSError, ValueError, TypeError, AttributeError):
        return {}
