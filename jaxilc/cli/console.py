"""The messages of the command line: how many are printed, and where; and how JAX starts.

Results go to standard output, everything else to standard error.
"""

from __future__ import annotations

import codecs
import functools
import io
import logging
import os
import sys
import time
from collections import defaultdict
from pathlib import Path

from ..outcomes.outcome import Console

PIPED_WIDTH = 160  # columns of output that does not go to a terminal, where COLUMNS tells none
WORTH_A_LINE = 0.05  # seconds of compiling or loading a program from which on it is logged
PLAIN = {"∞": "inf", "µ": "u", "μ": "u", "−": "-", "–": "-", "±": "+-", "°": "deg", "²": "^2",
         "√": "sqrt ", "ω": "omega"}  # fmt: skip
# Events of jax.monitoring.
COMPILED = "/jax/core/compile/backend_compile_duration"
FOUND = "/jax/compilation_cache/cache_hits"

# A stream that the shell closed (`>&-`) takes what is printed, as /dev/null does; no file that is
# opened later stands in its place.
for name in ("stdin", "stdout", "stderr"):
    if getattr(sys, name) is None:
        mode = "r" if name == "stdin" else "w"
        setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_RDWR), mode))


def _plain(error: UnicodeError) -> tuple[str, int]:
    """Plain letters for signs that an encoding lacks, and where to go on."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    return "".join(PLAIN.get(c, "?") for c in error.object[error.start : error.end]), error.end


# A terminal or a pipe without these signs, such as one of Windows, gets plain letters: what was
# computed is not lost for a sign that cannot be printed.
codecs.register_error("jaxilc", _plain)
for stream in (sys.stdout, sys.stderr):
    if isinstance(stream, io.TextIOWrapper):
        stream.reconfigure(errors="jaxilc")

if not os.environ.get("COLUMNS", "").strip("0"):  # none told, or 0, at which rich prints nothing
    os.environ.pop("COLUMNS", None)
wide = not (sys.stdout.isatty() or os.environ.get("COLUMNS", "").isdecimal())
out = Console(width=PIPED_WIDTH if wide else None)
err = Console(stderr=True)


def say(text: str) -> None:
    """Print a text in one line."""
    out.print(text, soft_wrap=True)


def warn(text: str) -> None:
    """Print a text on standard error, in one line."""
    err.print(text, soft_wrap=True)


def between(text: str) -> None:
    """Print a text while a progress bar is shown: above the bar, where both are in a terminal."""
    (warn if out.is_terminal and err.is_terminal else say)(text)


log = logging.getLogger("jaxilc")
counted: defaultdict[str, float] = defaultdict(float)


def speak(*, quiet: bool, verbose: bool) -> None:
    """Set how much is printed: warnings and errors only, or a log in addition; both are refused."""
    if quiet and verbose:
        raise ValueError("--quiet and --verbose exclude each other")
    out.quiet = quiet
    log.handlers = [logging.StreamHandler(sys.stderr)] if verbose else []
    log.setLevel(logging.INFO if verbose else logging.WARNING)
    log.propagate = False
    for handler in log.handlers:
        handler.setFormatter(logging.Formatter("%(asctime)s.%(msecs)03d %(message)s", "%H:%M:%S"))
    counted.clear()
    counted["started"] = time.perf_counter()


def tracebacks() -> bool:
    """Whether an error is shown with its traceback."""
    return log.isEnabledFor(logging.INFO) or bool(os.environ.get("JAXILC_TRACEBACK"))


def log_jax(programs: Path | None) -> None:
    """Log versions and devices, and from now on programs that take long to compile."""
    if not log.isEnabledFor(logging.INFO):
        return
    import jax

    from ..runtime.provenance import environment

    found = environment()
    versions = ", ".join(f"{name} {version}" for name, version in found["versions"].items())
    log.info("%s", versions)
    others = (f"{name}: {value}" for name, value in found.items() if name != "versions")
    log.info("%s", ", ".join(others))
    log.info(
        "devices: %s; XLA_FLAGS: %s",
        ", ".join(map(str, jax.devices())),
        os.environ.get("XLA_FLAGS", ""),
    )
    log.info("compiled programs are kept in %s", programs or "no folder")
    _follow()


def stage_ends(stage: str) -> None:
    """Note the end of a stage of sweeps: of `start` for the first one, of `run` for the last."""
    if stage != "start" or not counted[stage]:
        counted[stage] = time.perf_counter()


def ended() -> None:
    """Log the time that the command took, and how much of it was compiling and computing."""
    if log.isEnabledFor(logging.INFO):
        if counted["computing"] and counted["run"]:
            log.info("%s", _shares(time.perf_counter()))
        took = time.perf_counter() - counted["started"]
        log.info(
            "%.2f s, of them %.2f s for %d programs, %d found compiled",
            took,
            counted["s"],
            counted["programs"],
            counted["found"],
        )


def _shares(now: float) -> str:
    """The time of a sweep in compiled code, and the rest of its time by what it was."""
    computing, compiling = counted["computing"], counted["compiling"]
    rest = {
        "start": counted["start"] - counted["started"],
        "compiling": compiling,
        "files": counted["run"] - counted["start"] - compiling - computing,
        "figures": now - counted["run"],
    }
    whole = now - counted["started"]
    others = ", ".join(f"{stage} {seconds:.2f} s" for stage, seconds in rest.items())
    return f"{computing:.2f} s in compiled code, {computing / whole:.0%} of {whole:.2f} s; {others}"


@functools.cache
def _follow() -> None:
    """Count programs and log slow ones; cached, since listeners stay for the whole process."""
    from jax import monitoring

    from ..runtime.start import COMPILING, COMPUTING

    of_sweeps = {COMPILING: "compiling", COMPUTING: "computing"}

    def compiled(event: str, duration_secs: float, **about: object) -> None:
        if event in of_sweeps:
            counted[of_sweeps[event]] += duration_secs
        if event == COMPILED:
            counted["programs"] += 1
            counted["s"] += duration_secs
            if duration_secs >= WORTH_A_LINE:
                log.info("%s: %.2f s", about.get("fun_name", "a program"), duration_secs)

    def found(event: str, **_: object) -> None:
        counted["found"] += event == FOUND

    monitoring.register_event_duration_secs_listener(compiled)
    monitoring.register_event_listener(found)


# How JAX starts for a command
# --------------------------------------------------------------------------------------------------


_preferred = {"precision": "float64"}


def prefer(precision: str) -> None:
    """Set the precision of what is computed, float64 or float32; raises ValueError for another."""
    if precision not in ("float64", "float32"):
        raise ValueError(f"precision = {precision!r} is not one of 'float64', 'float32'")
    _preferred["precision"] = precision


def begin() -> None:
    """Start JAX, with a cache of compiled programs that is kept on the disk."""
    from ..runtime.start import keep_programs, setup

    setup(precision=_preferred["precision"])
    log_jax(keep_programs())
