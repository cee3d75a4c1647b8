"""Progress bars, which are shown in terminals only, and stopping a long computation."""

from __future__ import annotations

import importlib
import sys
import threading
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn, TypeVar

from . import console, durations

if TYPE_CHECKING:
    from ..outcomes.sweeping import Swept
    from ..sweeps import Sweep

T = TypeVar("T")


# Packages that a command needs when its sweep or tuning is computed.
WORTH_KEEPING = 1.0  # seconds from which on the duration of a command is kept
AFTERWARDS = ("xarray", "zarr", "matplotlib.figure", "matplotlib.backends.backend_agg")


def progress_bar(
    field: str,
    *,
    transient: bool = False,
    expected: float | None = None,
    usual: float | None = None,
):
    """A progress bar that also shows a field of its tasks; nothing is shown without a terminal.

    transient: whether the bar is removed at the end
    expected: seconds that all of it took the last time; the time left before a part is done
    usual: seconds that all of it takes elsewhere, told where no time is known here
    """
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )
    from rich.text import Text

    class Left(TimeRemainingColumn):
        max_refresh = 0.0  # it falls each second

        def render(self, task):
            if task.finished or task.time_remaining is not None or not (expected or usual):
                return super().render(task)
            left = (expected or 0.0) - (task.elapsed or 0.0)
            told = f"about {left:.0f} s left" if left > 1.0 else "longer than the last time"
            return Text(told if expected else f"often {usual:.0f} s", style="progress.remaining")

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn(f"{{task.fields[{field}]}}"),
    )
    return Progress(
        *columns, TimeElapsedColumn(), Left(), transient=transient, console=console.err,
        disable=console.out.quiet or not console.err.is_terminal,
    )  # fmt: skip


@contextmanager
def working(command: str) -> Generator[Callable[..., None]]:
    """A context with the progress bar of a command, which is gone when the command prints.

    It begins before JAX is loaded, so that something is seen within the first second. It yields a
    function of what is done now, as a text, and of `done` and `total`, the parts of the work. The
    time left follows from the parts that are done, and before that from how long the same command
    took the last time, or that command on the same scenario with other options.
    """
    start = time.perf_counter()
    keys = [durations.key_of([command, *sys.argv[1:end]]) for end in (None, 3)]
    known = [seconds for seconds in map(durations.expected, keys) if seconds is not None]
    last, usual = next(iter(known), None), durations.USUAL.get(command)
    with progress_bar("now", transient=True, expected=last, usual=usual) as bar:
        one = bar.add_task(command, total=None, now="starting")

        def told(now: str, done: float | None = None, total: float | None = None) -> None:
            bar.update(one, now=now, completed=done, total=total)

        yield told
    seconds = time.perf_counter() - start
    if seconds > WORTH_KEEPING:
        for key in keys:
            durations.remember(key, seconds)


def thread_for_later(*works: Callable[[], object]) -> threading.Thread:
    """A thread that imports what a command needs afterwards, and does other works; not started.

    An error is not reported: it comes again where the result is needed.
    """

    def run():
        for work in (lambda: [*map(importlib.import_module, AFTERWARDS)], *works):
            with suppress(Exception):
                work()

    return threading.Thread(target=run)


def stopped(store: Path) -> NoReturn:
    """Print how to continue after Ctrl-C, and end with exit code 130."""
    console.warn(f"stopped; {store} holds what is done: the same command with --resume goes on")
    sys.exit(130)


def run_sweep(plan: Sweep, store: Path, *, resume: bool, cluster: str | None) -> Swept:
    """Run a sweep with a progress bar for each scheme.

    Ctrl-C ends the command with exit code 130, and a chunk that no worker could compute ends it
    with exit code 1.
    """
    from ..outcomes.sweeping import Swept
    from ..sweeps.cluster import ChunkFailed

    console.stage_ends("start")
    start = time.perf_counter()
    counted: dict[str, int] = {}
    of_a_machine = plan.trials * plan.task.N
    later = thread_for_later()
    with progress_bar("rate") as bar:
        bars = {
            name: bar.add_task(name, total=plan.population.size * plan.axes.size, rate="")
            for name in plan.schemes
        }

        def progress(name: str, done: int, fresh: int) -> None:
            if fresh and later.ident is None:  # from now on the devices compute
                later.start()
            counted[name] = counted.get(name, 0) + fresh
            rate = sum(counted.values()) * of_a_machine / (time.perf_counter() - start)
            bar.update(bars[name], completed=done, rate=f"{rate:.2g} steps/s")

        try:
            dataset = plan.run(store, resume=resume, progress=progress, cluster=cluster)
            if later.ident is not None:
                later.join()
        except KeyboardInterrupt:
            stopped(store)
        except ImportError as error:
            if cluster is None:
                raise
            raise ValueError(f"--dask: {error}") from None
        except ChunkFailed as error:
            console.warn(f"error: {error}")
            console.warn(f"{store} holds what is done: the same command with --resume goes on")
            sys.exit(1)
    console.stage_ends("run")
    return Swept(dataset, time.perf_counter() - start, sum(counted.values()) * of_a_machine)


def run_search(
    search: Callable[..., T],
    state: Path,
    *,
    resume: bool,
    progress: Callable[..., object],
    meanwhile: Sequence[Callable[[], object]] = (),
) -> T:
    """Run one or several tunings, as `outcomes.tuning.run_search`.

    What the command needs afterwards is done meanwhile. Ctrl-C ends it with exit code 130.
    """
    later = thread_for_later(*meanwhile)

    def told(*step: object) -> None:
        progress(*step)
        if later.ident is None:  # from now on the devices compute
            later.start()

    try:
        found = search(state, resume=resume, progress=told)
        if later.ident is not None:
            later.join()
    except KeyboardInterrupt:
        stopped(state)
    return found
