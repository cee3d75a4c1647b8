"""How much memory a compiled program takes, and how much there is."""

from __future__ import annotations

import os
from pathlib import Path

import jax


def program_bytes(run, *arguments) -> int:
    """Bytes that a jitted function takes on all devices for its arguments, results and what lies between; it is compiled, not run.

    Calling it later with arguments of these shapes does not compile it again.
    """
    found = run.lower(*arguments).compile().memory_analysis()  # of one device
    return jax.device_count() * (found.argument_size_in_bytes + found.output_size_in_bytes + found.temp_size_in_bytes)


def host_bytes() -> int | None:
    """Bytes of memory that are free or can be made free, under the limit of the control group (SLURM, containers); None if unknown."""
    found = [_system()]
    try:
        group = Path("/sys/fs/cgroup")
        found.append(int((group / "memory.max").read_text()) - int((group / "memory.current").read_text()))
    except (OSError, ValueError):  # no control group, or one without a limit
        pass
    known = [size for size in found if size is not None]
    return min(known) if known else None


def device_bytes() -> int | None:
    """Bytes free on all devices together where they have memory of their own; None on a CPU, and if unknown."""
    stats = [device.memory_stats() for device in jax.devices() if device.platform != "cpu"]
    if not stats or not all(stats):
        return None
    return sum(s["bytes_limit"] - s["bytes_in_use"] for s in stats)


def _system() -> int | None:
    try:
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return 1024 * int(line.split()[1])
    except OSError:
        pass
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_AVPHYS_PAGES")
    except (AttributeError, OSError, ValueError):
        return None


def shown(size: float) -> str:
    """A size as text, in the unit that fits."""
    for unit in ("B", "kB", "MB"):
        if size < 1000:
            return f"{size:.3g} {unit}"
        size /= 1000
    return f"{size:.3g} GB"
