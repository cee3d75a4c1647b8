"""The RAM that a computation takes, the RAM that is free, and an error if it does not fit.

What is counted before it is allocated is checked by `check_size`, and what only a compiler can
count by `check_program`. Both raise the error of `refused`.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import jax

from ..pytree.aliases import Tree, Value
from ..pytree.ranges import concrete

try:
    import resource
except ImportError:  # Windows has no such limits of processes
    resource = None  # type: ignore[assignment]

CACHES = Path("/sys/devices/system/cpu/cpu0/cache")
GROUPS = Path("/sys/fs/cgroup")
OF_PROCESS = Path("/proc/self")
OF_GROUP_1 = ("memory.limit_in_bytes", "memory.usage_in_bytes")
OF_GROUP_2 = ("memory.max", "memory.current")
SPARE = 256 * 2**20  # bytes of address space kept free for compilers, threads and libraries


def bytes_of(arrays: Tree) -> int:
    """The bytes of all arrays of a pytree, of which only shapes and types are read."""
    return sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(arrays))


def check_size(what: str, each: float | Callable[..., float], **counts: float) -> None:
    """Raises ValueError where a computation needs more bytes of RAM than are free.

    each: bytes for each unit of the product of the counts; or a function that gives all bytes from
        the counts, linear in each of them
    counts: the counts, such as the number of machines, by name
    For each count the message gives the largest value that fits while the others do not change.
    """
    each = concrete(each)
    counts = {name: concrete(count) for name, count in counts.items()}

    def need(**counts: float) -> float:
        return (
            each * math.prod(counts.values()) if isinstance(each, int | float) else each(**counts)
        )

    room = host_bytes()
    if room is None or need(**counts) <= room:
        return
    given = " and ".join(f"{name} = {count:.15g}" for name, count in counts.items())
    fits = {name: _fitting(need, counts, name, room) for name in counts}
    some = [f"{name} = {fit:.15g}" for name, fit in fits.items() if fit >= 1]
    instead = f"{' or '.join(some)} would fit" if some else "not even 1 would fit"
    raise refused(f"{what}: {given} take", need(**counts), room, instead)


def check_program(what: str, instead: str, lowered: jax.stages.Lowered) -> None:
    """Raises ValueError where a jitted function does not fit in RAM; it is compiled but not run."""
    on_devices = device_bytes()
    room = host_bytes() if on_devices is None else on_devices
    if room is not None and (need := program_bytes(lowered)) > room:
        raise refused(f"{what} takes", need, room, instead)


def refused(takes: str, need: float, room: float, instead: str, where: str = "") -> ValueError:
    """The error of what takes so many bytes, where only `room` of them are free.

    takes: the computation, and that it takes them;  instead: what would fit;  where: the computer
    """
    said = f"{takes} {shown(need)} of memory, where {shown(room)} are available{where}"
    return ValueError(f"{said}; {instead}")


def program_bytes(lowered: jax.stages.Lowered, *, devices: int | None = None) -> int:
    """The bytes that a jitted function takes on its devices; it is compiled but not run.

    They hold its arguments, its results and its intermediate values. A later call with arguments of
    these shapes does not compile it again.

    devices: number of devices on which it runs; None: all
    """
    found: Value = lowered.compile().memory_analysis()  # of one device
    devices = jax.device_count() if devices is None else devices
    signals = found.argument_size_in_bytes + found.output_size_in_bytes
    return devices * (signals + found.temp_size_in_bytes)


def host_bytes() -> int | None:
    """The bytes of RAM that are free or can be made free; None if unknown.

    The limits of the process (ulimit -v) and of its control groups (SLURM, containers) are
    included.
    """
    known = [size for size in (_system(), *_of_process(), *_of_groups()) if size is not None]
    return max(0, min(known)) if known else None


def cache_bytes() -> int | None:
    """The bytes of the processor's last cache, for each core that shares it; None if unknown."""
    try:
        last = max(CACHES.glob("index*"), key=lambda of: int((of / "level").read_text()))
        shared = int((last / "shared_cpu_map").read_text().replace(",", ""), 16).bit_count()
        return 1024 * int((last / "size").read_text().rstrip("K\n")) // shared
    except (OSError, ValueError, ZeroDivisionError):
        return None


def device_bytes() -> int | None:
    """The bytes that are free for what is spread evenly over all devices, where these have RAM.

    The device with the least is the first that is full. None on a CPU, and if unknown.
    """
    known = _of_devices()
    return None if known is None else len(known) * max(0, min(of - used for of, used in known))


def device_memory() -> int | None:
    """The bytes that a program may use on one device, whatever is in use at the moment.

    It is the device with the least memory. None on a CPU, and if unknown.
    """
    known = _of_devices()
    return None if known is None else min(limit for limit, _ in known)


def _of_devices() -> list[tuple[int, int]] | None:
    """The bytes that each device may use, and those in use; None on a CPU, and if unknown."""
    stats = [device.memory_stats() for device in jax.devices() if device.platform != "cpu"]
    if not stats or not all(of and of.get("bytes_limit") for of in stats):
        return None
    return [(of["bytes_limit"], of.get("bytes_in_use", 0)) for of in stats]


def shown(size: float) -> str:
    """A size as text, in bytes, kB, MB or GB."""
    for unit in ("B", "kB", "MB"):
        if size < 1000:
            return f"{size:.3g} {unit}"
        size /= 1000
    return f"{size:.3g} GB"


def _fitting(need: Callable[..., float], counts: Mapping[str, float], name: str, room: int) -> int:
    """The largest value of one count with which the computation fits."""
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
    """The bytes that the limits of this process leave free in its address space and its data."""
    if resource is None:
        return
    for limit, field in ((resource.RLIMIT_AS, "VmSize"), (resource.RLIMIT_DATA, "VmData")):
        allowed = resource.getrlimit(limit)[0]
        if allowed != resource.RLIM_INFINITY:
            left = max(0, allowed - _status(field))
            yield left - min(SPARE, left // 4)


def _status(field: str) -> int:
    """The bytes in a line of /proc/self/status; 0 where there is no such line."""
    try:
        lines = (OF_PROCESS / "status").read_text().splitlines()
        return next(1024 * int(line.split()[1]) for line in lines if line.startswith(f"{field}:"))
    except (OSError, StopIteration, ValueError):
        return 0


def _of_groups() -> Iterator[int]:
    """The bytes that each control group of this process, and each group above it, leaves free."""
    try:
        lines = (OF_PROCESS / "cgroup").read_text().splitlines()
    except OSError:
        return
    for line in lines:
        _, controllers, path = line.split(":", 2)
        if controllers and "memory" not in controllers.split(","):
            continue
        root = GROUPS / controllers if controllers else GROUPS  # version 1 or 2 of control groups
        limit, used = OF_GROUP_1 if controllers else OF_GROUP_2
        group = root / path.lstrip("/")
        for folder in (group, *(above for above in group.parents if above.is_relative_to(root))):
            try:
                left = int((folder / limit).read_text()) - int((folder / used).read_text())
                yield left + _reclaimable(folder)
            except (OSError, ValueError):  # no such group here, or one without a limit
                continue


def _reclaimable(group: Path) -> int:
    """The bytes of cached files that were not used recently; the system frees them if needed."""
    try:
        rows = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
        return int(rows.get("total_inactive_file", rows.get("inactive_file", 0)))
    except (OSError, ValueError):
        return 0
