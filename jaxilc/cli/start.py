"""How JAX starts for a command."""

from __future__ import annotations

from .console import log_jax

_preferred = {"precision": "float64"}


def prefer(precision: str) -> None:
    """Set the precision of what is computed: float64 or float32.

    Raises ValueError for another one.
    """
    if precision not in ("float64", "float32"):
        raise ValueError(f"precision = {precision!r} is not one of 'float64', 'float32'")
    _preferred["precision"] = precision


def begin() -> None:
    """Start JAX, with a cache of compiled programs that is kept on the disk."""
    from ..runtime.start import keep_programs, setup

    setup(precision=_preferred["precision"])
    log_jax(keep_programs())
