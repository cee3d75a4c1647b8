"""What the numbers of a result depend on, and where two such descriptions differ."""

from __future__ import annotations

from importlib.metadata import version
from typing import Any

import jax

from .recipe import describe as describe  # of what a configuration is made


def differences(found: Any, wanted: Any, path: str = "") -> list[str]:
    """Where two configurations differ, one line each: `seed: 1 there, 2 here`."""
    if isinstance(found, dict) and isinstance(wanted, dict):
        names = sorted(found.keys() | wanted.keys())
        return [
            line
            for n in names
            for line in differences(found.get(n), wanted.get(n), f"{path}.{n}" if path else n)
        ]
    return [] if found == wanted else [f"{path}: {found} there, {wanted} here"]


def environment(*packages: str) -> dict[str, Any]:
    """What the numbers depend on besides the parameters: versions, also of further `packages`,
    backend, devices, precision.
    """
    return {
        "versions": {
            name: version(name) for name in ("jaxilc", "jax", "jaxlib", "numpy", *packages)
        },
        "backend": jax.default_backend(),
        "devices": jax.device_count(),
        "precision": "float64" if jax.config.jax_enable_x64 else "float32",
    }
