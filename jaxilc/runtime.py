"""How JAX is started. Call `setup()` first thing in a script or notebook; the command line does."""

from __future__ import annotations

import os
import warnings

import jax

_WHOLE_LOOPS = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1000000000"


def setup(*, precision: str = "float64", devices: int | None = None) -> None:
    """Choose the precision and make every CPU core a device, with loops compiled whole.

    precision: `float64` or `float32`;  devices: CPU devices, None for one per core
    XLA otherwise dispatches every small operation of a loop by itself, several times slower; options already present in
    XLA_FLAGS are left alone, and other backends ignore these. Must run before JAX computes anything: if it did not, the
    precision still takes effect and a RuntimeWarning says that the rest could not.
    Raises ValueError for another precision or devices < 1.
    """
    if precision not in ("float64", "float32"):
        raise ValueError(f"setup: precision = {precision!r} is not one of 'float64', 'float32'")
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    devices = cores if devices is None else devices
    if devices < 1:
        raise ValueError(f"setup: devices = {devices} is outside its allowed range [1, inf)")
    jax.config.update("jax_enable_x64", precision == "float64")
    # XLA's pool has a thread per core. A batched LAPACK call on every device at once then waits for workers that all wait likewise;
    # threads to spare are what prevents it. XLA reads this name.
    os.environ.setdefault("NPROC", str(2 * max(cores, devices)))
    flags = os.environ.get("XLA_FLAGS", "")
    if "xla_backend_extra_options" not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {_WHOLE_LOOPS}".strip()
    if "xla_force_host_platform_device_count" not in flags and jax.config.jax_num_cpu_devices != devices:
        try:
            jax.config.update("jax_num_cpu_devices", devices)
        except RuntimeError:
            warnings.warn(
                "jaxilc.setup() came after JAX had started: cores and loop compilation stay as they are. Call it before any computation.",
                RuntimeWarning,
                stacklevel=2,
            )
