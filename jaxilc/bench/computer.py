"""The computer and the programs with which times are measured."""

from __future__ import annotations

import os
import platform
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from ..runtime.provenance import environment

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
    told = {name.strip(): text.strip() for name, _, text in (x.partition(":") for x in lines)}
    flags, kind = told.get("flags", "").split(), platform.machine()
    return {
        "processor": told.get("model name") or platform.processor() or kind,
        "instructions": next((name for f, name in INSTRUCTIONS.items() if f in flags), kind),
        "cores": cores(),
        **environment(*(name for name in RIVALS if find_spec(name))),
        "load": [round(x, 1) for x in getattr(os, "getloadavg", tuple)()],
    }


def in_words(found: Mapping[str, Any]) -> str:
    """Three lines on the result of `computer`: the processor, ours, and the other programs."""
    cores, devices, versions = found["cores"], found["devices"], found["versions"]
    others = (f"{name} {versions[name]}" for name in ("numpy", *RIVALS) if name in versions)
    return (
        f"{found['processor']}, {found['instructions']}, {cores} core{'s' * (cores != 1)}\n"
        f"jaxilc: jax {versions['jax']} on {devices} {found['backend'].upper()} "
        f"device{'s' * (devices != 1)}, {found['precision']}\n"
        f"others: {', '.join(others)}"
    )
