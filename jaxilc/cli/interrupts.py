"""Ctrl-C ends the program within seconds, whatever it does at that moment.

Python sees an interrupt between two of its own instructions only: not while a program is compiled
or runs, which may take a minute. And a process that ends waits for such threads, or fails in them.
So a thread watches for the signal itself. The command has a moment to say how to go on; then the
process ends. Files are whole at each moment, so that nothing is lost.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from contextlib import suppress

MOMENT = 2.0  # [s] for the command to end by itself
CODE = 130
SAID = (
    "stopped; files that were written are whole: the same command starts again, or with --resume "
    "goes on (sweep, tune, pareto)"
)
_seen = threading.Event()
_watching: list[threading.Thread] = []


def heed() -> None:
    """Watch for Ctrl-C from now on; only the main thread of a program can."""
    if threading.current_thread() is not threading.main_thread() or os.name == "nt":
        return
    if signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        return  # ignored, as by what a shell starts in the background, or a host's own
    if _watching:
        return
    seen, told = os.pipe()
    os.set_blocking(told, False)
    signal.set_wakeup_fd(told, warn_on_full_buffer=False)
    _watching.append(threading.Thread(target=_watch, args=(seen,), daemon=True))
    _watching[0].start()


def leave() -> None:
    """End the process now, where it was Ctrl-C that ended the command; else do nothing."""
    if _seen.wait(0.1 if _watching else 0.0):
        _end()


def _watch(seen: int) -> None:
    while os.read(seen, 1)[0] != signal.SIGINT:
        pass
    _seen.set()
    time.sleep(MOMENT)
    _end()


def _end() -> None:
    with suppress(Exception):
        sys.stdout.flush()
        print(SAID, file=sys.stderr, flush=True)
    os._exit(CODE)
