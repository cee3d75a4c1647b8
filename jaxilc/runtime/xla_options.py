"""The options of XLA that make loops fast, given only where this version of XLA knows them.

An option that XLA or LLVM does not know ends the process without an exception. Only the entries of
`--xla_backend_extra_options` that begin with `xla_` are ignored there.
"""

from __future__ import annotations

import os
import subprocess
import sys
import warnings

import jaxlib

WHOLE_LOOPS = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1000000000"
# LLVM unrolls a loop over the 8 or 16 machines of a tile before it could vectorise it, so the code
# remains scalar. This option keeps the loop.
LANES_VECTORISED = ",-unroll-full-max-count=4"
# XLA writes the results of a sample one after another, and loads and computes anew what they share.
# LLVM finds this if it looks back further than its usual 6 instructions. FFDL-MFAILC then took 0.92
# of the time, its gradient 0.86, other gradients 0.92 to 1, and compiling a gradient 1.04.
LOADS_SHARED = ",-available-load-scan-limit=1000"
# The newer code generator of XLA takes a third longer to compile than the older one, whose programs
# are as fast. JAX 0.12 has the newer one only.
OLDER_GENERATOR = ",xla_cpu_disable_new_fusion_emitters=true"
# XLA uses registers of 256 bits even if a processor has wider ones.
WIDE_REGISTERS = " --xla_cpu_prefer_vector_width=512"
# Options of one program, which compiles in half the time and runs up to twenty times as long.
QUICKLY: dict[str, str | bool] = {"xla_backend_optimization_level": "0"}
TRIED = ((0, 10, 0), (0, 12, 0, 1))  # first and last version of jaxlib that accepts all these
_COMPUTES = "import jax; jax.jit(lambda x: x + 1)(0.0)"


def chosen(given: str, *, accelerated: bool) -> str:
    """The options for fast loops.

    given: the options that XLA_FLAGS has already
    accelerated: whether JAX could use an accelerator, which would read the options of LLVM, too
    Where XLA does not know all of them, only `WHOLE_LOOPS` or nothing remains, and a RuntimeWarning
    reports this.
    """
    of_cpu = LANES_VECTORISED + LOADS_SHARED + OLDER_GENERATOR
    wide = "" if "xla_cpu_prefer_vector_width" in given else WIDE_REGISTERS
    wanted = WHOLE_LOOPS if accelerated else WHOLE_LOOPS + of_cpu + wide
    options = known(wanted, WHOLE_LOOPS)
    if options != wanted:
        warnings.warn(
            f"jaxlib {jaxlib.__version__} does not know all options that jaxilc gives to XLA; "
            "loops run slower",
            RuntimeWarning,
            stacklevel=3,
        )
    return options


def known(*choices: str) -> str:
    """The first of several texts of options that XLA knows; empty where it knows none.

    A version of jaxlib that was not tried is asked by a process of its own, which takes a second.
    """
    return next((options for options in choices if _tried() or _accepted(options)), "")


def _tried() -> bool:
    version = tuple(int(part) for part in jaxlib.__version__.split(".") if part.isdigit())
    return "dev" not in jaxlib.__version__ and TRIED[0] <= version <= TRIED[1]


def _accepted(options: str) -> bool:
    """Whether a process with these options can compute."""
    try:
        asked = subprocess.run(
            [sys.executable or "", "-c", _COMPUTES],
            env=os.environ | {"XLA_FLAGS": options, "JAX_PLATFORMS": "cpu"},
            capture_output=True,
            timeout=60,
        )
    except (OSError, subprocess.SubprocessError):
        return False
    return asked.returncode == 0
