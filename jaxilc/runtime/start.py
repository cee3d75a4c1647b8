"""The start of JAX: scripts, notebooks and the command line call `setup()` first."""

from __future__ import annotations

import hashlib
import os
import platform
import warnings
from collections.abc import Callable
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path

import jax

from ..pytree.ranges import need_one_of, require
from .jax_internals import arrays_by_precision, sealed_programs
from .xla_options import chosen

NATIVE = "JAXILC_NATIVE"
SETTINGS = ("auto", "on", "off")
# Events that a sweep records with `jax.monitoring`, each with its seconds, for `--verbose`.
COMPILING = "/jaxilc/sweep/compiling"  # the programs were compiled, or loaded
COMPUTING = "/jaxilc/sweep/computing"  # the devices computed a chunk
WORTH = 5e7  # sample-steps that take XLA about as long as to compile them here, once for all
_chosen: dict[str, str] = {}  # the precision of the last `setup` of this process


def setup(
    *, precision: str = "float64", devices: int | None = None, native: bool | None = None
) -> None:
    """Choose the precision and make every CPU core a device, with loops compiled as a whole.

    precision: `float64` or `float32`
    devices: number of CPU devices; None: one for each core
    native: whether learning is compiled for this processor where it can be (see `native`); None:
        as the environment variable JAXILC_NATIVE says: `on`, `off`, or, as where it is not set,
        `auto`: where that saves more time than it takes

    Without `setup` XLA dispatches every small operation of a loop separately, which is several
    times slower. Options that XLA_FLAGS contains already are not changed. If JAX has an
    accelerator, only options are set that the accelerator ignores. Products of matrices in float32
    are then computed in float32 (`jax_default_matmul_precision`, where it was not set): JAX would
    let a GPU or TPU round each factor to 11 or 8 bits. `setup` must run before JAX computes
    anything. Otherwise only the precision takes effect, and a RuntimeWarning reports this.
    JAX 0.11.1, whose loops take time quadratic in the number of samples, is reported likewise.
    Raises ValueError for another precision, devices < 1, or another value of JAXILC_NATIVE.
    """
    need_one_of("setup", "precision", precision, ("float64", "float32"))
    devices = cores() if devices is None else devices
    require("setup", "devices", devices, "[1, 4096]", whole=True)
    if jax.__version__ == "0.11.1":
        warnings.warn(
            "JAX 0.11.1 takes time quadratic in the samples of a trial (jax issue 40101); "
            "0.11.0 and 0.11.2 do not",
            RuntimeWarning,
            stacklevel=2,
        )
    if native is not None:
        os.environ[NATIVE] = "on" if native else "off"
    _native_setting()
    _chosen["precision"] = precision
    if jax.config.jax_enable_x64 != (precision == "float64"):
        jax.config.update("jax_enable_x64", precision == "float64")
        jax.clear_caches()  # programs may hold arrays of the other precision
        arrays_by_precision()
    if precision == "float32" and _accelerated() and not jax.config.jax_default_matmul_precision:
        jax.config.update("jax_default_matmul_precision", "highest")
    # XLA's pool has a thread per core. If every device makes a batched LAPACK call at once, all
    # threads wait for each other; additional threads prevent this. XLA reads this variable.
    os.environ.setdefault("NPROC", str(2 * max(cores(), devices)))
    flags = os.environ.get("XLA_FLAGS", "")
    too_late = False
    if "xla_backend_extra_options" not in flags:
        too_late = _started()
        options = chosen(flags, accelerated=_accelerated())
        os.environ["XLA_FLAGS"] = f"{flags} {options}".strip()
    if (
        "xla_force_host_platform_device_count" not in flags
        and jax.config.jax_num_cpu_devices != devices
    ):
        try:
            jax.config.update("jax_num_cpu_devices", devices)
        except RuntimeError:
            too_late = True
    if too_late:
        warnings.warn(
            "jaxilc.setup() came after JAX had started: cores and loop compilation stay as they "
            "are, and loops run several times slower. Call it before any computation.",
            RuntimeWarning,
            stacklevel=2,
        )


def cores() -> int:
    """The number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def warn_of_single() -> None:
    """Warns where JAX computes in single precision, its default, and nobody has called `setup`."""
    if not _chosen and not jax.config.jax_enable_x64:
        warnings.warn(
            "jaxilc.setup() was not called: JAX computes in float32, so the numbers are not those "
            "of the command. Call it before any computation.",
            RuntimeWarning,
            stacklevel=4,
        )


def native_unwanted(steps: Callable[[], float]) -> str | None:
    """The reason why learning is not to be compiled for this processor; None where it is to be.

    steps: gives machines x trials x samples, of all calls together; asked where they decide
    Raises ValueError for another setting.
    """
    setting = _native_setting()
    if setting == "off":
        return f"{NATIVE} is off"
    if jax.default_backend() != "cpu":
        return f"JAX computes on {jax.default_backend()}"
    if setting == "on":
        return None
    if not find_spec("llvmlite"):
        return "llvmlite is not installed: pip install jaxilc[native]"
    if (few := steps()) < WORTH:
        return f"{few:.2g} sample-steps, where fewer than {WORTH:.0e} are not worth compiling"
    return None


def _native_setting() -> str:
    given = os.environ.get(NATIVE) or "auto"
    need_one_of("", NATIVE, given, SETTINGS)
    return given


def keep_programs() -> Path | None:
    """Keep compiled programs on disk for the next start; the result is their folder or None.

    The folder is below the cache folder of the user (XDG_CACHE_HOME, else ~/.cache), one for each
    kind of processor, since several computers may share a home. The environment variable
    JAXILC_CACHE names another folder; with `off` nothing is kept, and the result is None. A folder
    that was already given to JAX is not changed. In the others, a program that was damaged or
    exchanged is compiled again.
    """
    chosen = os.environ.get("JAXILC_CACHE", "")
    if chosen == "off":
        return None
    given = jax.config.jax_compilation_cache_dir
    try:
        folder = Path(
            given or chosen or _users_cache() / "jaxilc" / f"{platform.machine()}-{_processor()}"
        )
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError, ValueError):
        # keep nothing: there is no home, it cannot be written to, or the name is not a folder
        return None
    if not given:
        sealed_programs()
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    return folder


def _users_cache() -> Path:
    """The cache folder of the user; raises RuntimeError for a user without a home folder."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")


def _accelerated() -> bool:
    """Whether JAX could use another backend than that of the CPU."""
    return jax.config.jax_platforms != "cpu" and bool(entry_points(group="jax_plugins"))


def _started() -> bool:
    """Whether JAX has started its backends, after which the number of devices is fixed."""
    devices = jax.config.jax_num_cpu_devices
    try:
        jax.config.update("jax_num_cpu_devices", 2 if devices == 1 else 1)
    except RuntimeError:
        return True
    jax.config.update("jax_num_cpu_devices", devices)
    return False


def _processor() -> str:
    """A name for the kind of processor, since programs are compiled for its instructions."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        known = next(line for line in lines if line.startswith(("flags", "Features")))
    except (OSError, StopIteration):
        known = platform.processor()
    return hashlib.sha256(known.encode()).hexdigest()[:8]
