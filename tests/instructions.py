"""The tests act as on an older processor: `ISA=AVX2 pytest`, or `ISA=SSE4_2 pytest`.

Instructions that came later are not used, so other programs run, and rounding differs. On
processors other than x86-64 nothing changes.
"""

import os
import platform
import subprocess
import sys

# For each ISA the name that OpenBLAS has for such a processor, and how NumPy's names of what came
# later begin.
ISAS = {
    "AVX2": ("Haswell", ("X86_V4", "AVX512")),
    "SSE4_2": ("Prescott", ("X86_V4", "X86_V3", "AVX", "F16C", "FMA", "XOP")),
}
DISPATCHED = """
from numpy._core._multiarray_umath import __cpu_dispatch__, __cpu_features__
print(*[name for name in __cpu_dispatch__ if __cpu_features__[name]])
"""


def limited() -> str:
    """Limit NumPy and OpenBLAS to the ISA that the environment names; return XLA's option for it.

    Both read the environment when they are loaded. NumPy accepts only names that it uses here.
    """
    isa = os.environ.get("ISA", "")
    if not isa or platform.machine() not in ("x86_64", "AMD64"):
        return ""
    if isa not in ISAS:
        raise SystemExit(f"ISA = {isa!r} is not one of {', '.join(ISAS)}")
    if "NPY_DISABLE_CPU_FEATURES" not in os.environ:  # where pytest starts, not in its workers
        if "numpy" in sys.modules:
            raise SystemExit("ISA comes too late: NumPy is loaded already")
        core, later = ISAS[isa]
        used = subprocess.check_output([sys.executable, "-c", DISPATCHED], text=True).split()
        os.environ["NPY_DISABLE_CPU_FEATURES"] = " ".join(n for n in used if n.startswith(later))
        os.environ["OPENBLAS_CORETYPE"] = core
    return f" --xla_cpu_max_isa={isa}"
