"""How much RAM something takes, how much there is, and an error for what would not fit."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import jax

try:
    import resource
except ImportError:  # Windows limits processes in other ways
    resource = None

GROUPS = Path("/sys/fs/cgroup")
OF_PROCESS = Path("/proc/self")
OF_GROUP_1 = ("memory.limit_in_bytes", "memory.usage_in_bytes")
OF_GROUP_2 = ("memory.max", "memory.current")
SPARE = 256 * 2**20  # bytes of address space that compilers, threads and libraries may still take


def check_size(what: str, need: Callable[..., float], **counts: float) -> None:
    """Raises ValueError where something needs more bytes than there are.

    need: how many bytes, a function of the counts by their names, linear in each of them
    The message says of each count how large it may be while the others stay as they are.
    """
    room = host_bytes()
    if room is None or need(**counts) <= room:
        return
    given = " and ".join(f"{name} = {count:.15g}" for name, count in counts.items())
    fits = {name: _fitting(need, counts, name, room) for name in counts}
    some = [f"{name} = {fit:.15g}" for name, fit in fits.items() if fit >= 1]
    taken = f"{given} take {shown(need(**counts))} of memory, where {shown(room)} are available"
    instead = f"{' or '.join(some)} would fit" if some else "not even 1 would fit"
    raise ValueError(f"{what}: {taken}; {instead}")


def check_program(what: str, instead: str, run, *arguments, devices: int | None = None) -> None:
    """Raises ValueError where a jitted function does not fit in RAM. It is compiled, not run.

    instead: what would fit, for the message;  devices: how many it runs on, None for all
    """
    host, on_devices = host_bytes(), device_bytes()
    room = host if on_devices is None else on_devices
    need = 0 if room is None else program_bytes(run, *arguments, devices=devices)
    if room is not None and need > room:
        available = f"where {shown(room)} are available"
        raise ValueError(f"{what} takes {shown(need)} of memory, {available}; {instead}")


def program_bytes(run, *arguments, devices: int | None = None) -> int:
    """Bytes that a jitted function takes on its devices. It is compiled, not run.

    They hold its arguments, its results and what it computes on the way. Calling it later with
    arguments of these shapes does not compile it again.
    devices: how many it runs on, None for all
    """
    found = run.lower(*arguments).compile().memory_analysis()  # of one device
    devices = jax.device_count() if devices is None else devices
    signals = found.argument_size_in_bytes + found.output_size_in_bytes
    return devices * (signals + found.temp_size_in_bytes)


def host_bytes() -> int | None:
    """Bytes of RAM that are free or can be made free, None if unknown.

    The limits of the process (ulimit -v) and of its control groups (SLURM, containers) count.
    """
    known = [size for size in (_system(), *_of_process(), *_of_groups()) if size is not None]
    return max(0, min(known)) if known else None


def device_bytes() -> int | None:
    """Bytes that are free on all devices together, where they have RAM of their own.

    None on a CPU, and if unknown.
    """
    stats = [device.memory_stats() for device in jax.devices() if device.platform != "cpu"]
    if not stats or not all(stats):
        return None
    return sum(s["bytes_limit"] - s["bytes_in_use"] for s in stats)


def shown(size: float) -> str:
    """A size as text, in the unit that fits."""
    for unit in ("B", "kB", "MB"):
        if size < 1000:
            return f"{size:.3g} {unit}"
        size /= 1000
    return f"{size:.3g} GB"


def _fitting(need: Callable[..., float], counts: Mapping[str, float], name: str, room: int) -> int:
    """The largest value of one count that fits."""
    none, one = (need(**{**counts, name: count}) for count in (0, 1))
    return math.floor((room - none) / (one - none)) if none < room and one > none else 0


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


def _of_process() -> Iterator[int]:
    """Bytes that the limits of this process leave: of its address space, and of its data."""
    if resource is None:
        return
    for limit, field in ((resource.RLIMIT_AS, "VmSize"), (resource.RLIMIT_DATA, "VmData")):
        allowed = resource.getrlimit(limit)[0]
        if allowed != resource.RLIM_INFINITY:
            left = max(0, allowed - _status(field))
            yield left - min(SPARE, left // 4)


def _status(field: str) -> int:
    """Bytes that a line of /proc/self/status tells; 0 where there is no such line."""
    try:
        lines = (OF_PROCESS / "status").read_text().splitlines()
        return next(1024 * int(line.split()[1]) for line in lines if line.startswith(f"{field}:"))
    except (OSError, StopIteration, ValueError):
        return 0


def _of_groups() -> Iterator[int]:
    """Bytes that each control group of this process leaves, and each group above it."""
    try:
        lines = (OF_PROCESS / "cgroup").read_text().splitlines()
    except OSError:
        return
    for line in lines:
        _, controllers, path = line.split(":", 2)
        if controllers and "memory" not in controllers.split(","):
            continue
        root = GROUPS / controllers if controllers else GROUPS  # of version 1, or of version 2
        limit, used = OF_GROUP_1 if controllers else OF_GROUP_2
        group = root / path.lstrip("/")
        for folder in (group, *(above for above in group.parents if above.is_relative_to(root))):
            try:
                left = int((folder / limit).read_text()) - int((folder / used).read_text())
                yield left + _reclaimable(folder)
            except (OSError, ValueError):  # no such group here, or one without a limit
                continue


def _reclaimable(group: Path) -> int:
    """Bytes of cached files that were not read lately: a group short of RAM gives them back."""
    try:
        rows = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
        return int(rows.get("total_inactive_file", rows.get("inactive_file", 0)))
    except (OSError, ValueError):
        return 0
