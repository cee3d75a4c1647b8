"""The command line: a command reads its options, calls the library, and prints the result.

Python sees Ctrl-C between two of its own instructions only: not while a program is compiled or
runs, which may take a minute. And a process that ends waits for such threads, or fails in them. So
a thread watches for the signal itself, from before the modules of the commands are imported. The
command has a moment to say how to go on; then the process ends. Files are whole at each moment, so
that nothing is lost.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from types import FrameType
from typing import Any

__all__ = ["app", "main"]
MOMENT = 2.0  # [s] for the command to end by itself
INTERRUPTED = 130  # exit code
STOPPED = (
    "stopped; files that were written are whole: sweep, tune, pareto, design and learn-law go on "
    "with --resume, the other commands start again"
)
_seen = threading.Event()
_watching: list[threading.Thread] = []


def __getattr__(name: str) -> Any:
    """The program `app`, whose modules take half a second to import."""
    if name != "app":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from .entry import app

    return app


def main() -> None:
    """Run the command line, as `entry.main`; Ctrl-C ends it in one line at any moment."""
    try:
        _heed()
        from .entry import main as run

        run()
    except SystemExit:
        raise
    except BaseException:  # as which an interrupt ends depends on where it came
        leave()
        raise


def leave() -> None:
    """End the process now, where it was Ctrl-C that ended the command; else do nothing."""
    if _seen.wait(0.1 if _watching else 0.0):
        _end()


def _heed() -> None:
    """Watch for Ctrl-C from now on; only the main thread of a program can."""
    if threading.current_thread() is not threading.main_thread() or os.name == "nt" or _watching:
        return
    if signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        return  # ignored, as by what a shell starts in the background, or a host's own
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # until somebody watches
    try:
        seen, told = os.pipe()
        os.set_blocking(told, False)
        signal.set_wakeup_fd(told, warn_on_full_buffer=False)
        signal.signal(signal.SIGINT, _interrupted)
        sys.unraisablehook = partial(_unless_interrupted, sys.unraisablehook)
        _watching.append(threading.Thread(target=_watch, args=(seen,), daemon=True))
        _watching[0].start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _interrupted(_: int, frame: FrameType | None) -> None:
    """Raise KeyboardInterrupt; but end at once where a module is imported, such as one in C.

    NumPy and JAX do not survive an error while they begin.
    """
    while frame is not None:
        if frame.f_globals.get("__name__") == "importlib._bootstrap":
            _end()
        frame = frame.f_back
    raise KeyboardInterrupt


def _unless_interrupted(
    tell: Callable[[sys.UnraisableHookArgs], object], told: sys.UnraisableHookArgs
) -> None:
    """Tell what nobody can catch, as before, but for an interrupt, of which `_watch` tells."""
    if told.exc_type is not KeyboardInterrupt:
        tell(told)


def _watch(seen: int) -> None:
    while os.read(seen, 1)[0] != signal.SIGINT:
        pass
    _seen.set()
    time.sleep(MOMENT)
    _end()


def _end() -> None:
    with suppress(Exception):
        sys.stdout.flush()
        print(STOPPED, file=sys.stderr, flush=True)
    os._exit(INTERRUPTED)
