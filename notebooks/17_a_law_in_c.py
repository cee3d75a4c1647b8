# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # From a record to a C program that learns
#
# A controller has no Python. `jaxilc export` prints the learning law as C99, with a guard, a test
# program and the certificate that was found for it. Here it learns, in ten trials, on an axis that
# is a C program of its own, compiled apart: neither knows the other's model.

# %%
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from unittest import mock

import matplotlib.pyplot as plt
import numpy as np

from jaxilc.cli import main

# %matplotlib inline
home, folder = Path.cwd(), Path(tempfile.mkdtemp())
os.chdir(folder)


def jaxilc(words: str) -> None:
    """Run a command as a terminal would, in this process."""
    with mock.patch.object(sys, "argv", ["jaxilc", *shlex.split(words)]):
        code = None
        try:
            main()
        except SystemExit as ended:
            code = ended.code
    assert not code, f"jaxilc {words}: exit code {code}"


def compiled(name: str, *sources: str) -> str:
    """Build a program of C files, with warnings as errors, and return how to call it."""
    strict = ["-std=c99", "-O1", "-ffp-contract=off", "-Wall", "-Wextra", "-pedantic", "-Werror"]
    subprocess.run(["cc", *strict, "-o", name, *sources, "-lm"], check=True)
    return f"./{name}"


# %% [markdown]
# ## The axis
#
# A position loop of 25 Hz with a damping of 0.7, in ten steps of Euler a sample of 2 ms, some dry
# friction, and noise of the encoder.

# %%
Path("axis.h").write_text("void axis_rest(void);\ndouble axis_step(double u);\n")
Path("axis.c").write_text("""#include "axis.h"
#include <math.h>

static double x, v, noise = 0.37;

void axis_rest(void) { x = 0.0; v = 0.0; }

/* The position [mm] that is measured after a sample with the set point u [mm]. */
double axis_step(double u)
{
    const double w = 2.0 * 3.14159265358979 * 25.0;
    for (int i = 0; i < 10; ++i) {
        x += 2e-4 * v;
        v += 2e-4 * (w * w * (0.97 * u - x) - 1.4 * w * v - 20.0 * tanh(v / 2.0));
    }
    noise = fmod(noise * 997.0 + 0.123, 1.0);
    return x + 1e-3 * (noise - 0.5);
}
""")
Path("record.c").write_text("""#include "axis.h"
#include <stdio.h>

int main(void)
{
    double u;
    axis_rest();
    double y = axis_step(0.0);
    while (scanf("%lf", &u) == 1) {
        printf("%.9g\\n", y);
        y = axis_step(u);
    }
    return 0;
}
""")
record = compiled("record", "record.c", "axis.c")

# %% [markdown]
# ## A record, a plant file, a law
#
# Random set points are recorded, and the plant is identified. The task is a smooth move there and
# back; the law is P-type with a lead and a zero-phase filter.

# %%
DT = 2e-3
u = np.repeat(np.random.default_rng(7).choice([-0.5, 0.5], 60), 15)
ran = subprocess.run([record], input="\n".join(map(str, u)), text=True, capture_output=True)
y = np.array(ran.stdout.split(), float)
rows = "".join(f"{k * DT:.3f},{a},{b}\n" for k, (a, b) in enumerate(zip(u, y, strict=True)))
Path("record.csv").write_text("t [s],u [mm],y [mm]\n" + rows)
jaxilc("identify record.csv --poles 0 --pairs 1 --zeros 0 --out axis.toml")

plant = Path("axis.toml").read_text().partition("\n[task]")[0].partition("\n[uncertainty]")[0]
N = 200
r = 5.0 * (1 - np.cos(2 * np.pi * np.arange(N + 1) / N))
Path("move.csv").write_text("t,r\n" + "".join(f"{k * DT:.3f},{x}\n" for k, x in enumerate(r)))
_ = Path("axis.toml").write_text(f"""{plant}
[uncertainty]
"plant.gain" = {{ distribution = "uniform", low = 0.95, high = 1.05, relative = true }}

[machine.actuator]
limit = 15.0

[task]
dt = {DT}
unit = "mm"
input_unit = "mm"
reference = {{ csv = "move.csv" }}

[schemes.ilc]
class = "Filtered"
scheme = {{ class = "PIDType", gamma_p = 0.6, lead = 4 }}
filter = {{ class = "ZeroPhaseButterworth", cutoff = 40.0, order = 2 }}
""")

# %% [markdown]
# ## The law in C, and its proof
#
# The test program plays the vectors that came with the law and compares each number to the last
# bit. `--check` proves that code, vectors and certificate belong together.

# %%
jaxilc("export axis.toml --machines 8 --out law")
print(subprocess.check_output([compiled("law_test", "law/law.c", "law/law_test.c")], text=True))
jaxilc("export --check law")

# %% [markdown]
# ## Ten trials
#
# The controller's loop: begin, a sample at a time, end.

# %%
Path("loop.c").write_text("""#include "axis.h"
#include "law/law.h"
#include <math.h>
#include <stdio.h>

int main(void)
{
    static law l;
    static double r[LAW_SAMPLES + 1];
    for (int k = 0; k <= LAW_SAMPLES; ++k) {
        r[k] = 5.0 * (1.0 - cos(2.0 * 3.14159265358979 * k / LAW_SAMPLES));
    }
    law_start(&l);
    for (int trial = 0; trial < 10; ++trial) {
        double sum = 0.0, y = 0.0, u;
        axis_rest();
        law_begin(&l);
        for (int k = 0; k < LAW_SAMPLES; ++k) {
            law_sample(&l, k, &y, &u);
            y = axis_step(u);
            sum += (r[k + 1] - y) * (r[k + 1] - y);
        }
        const int code = law_end(&l, &y);
        printf("%.9g %d\\n", sqrt(sum / LAW_SAMPLES), code);
    }
    return 0;
}
""")
told = subprocess.check_output([compiled("loop", "loop.c", "axis.c", "law/law.c")], text=True)
rms, codes = np.array([line.split() for line in told.splitlines()], float).T
for trial, error in enumerate(rms, 1):
    print(f"trial {trial}: rms {error:.3g} mm")
assert not codes.any(), "the guard refused a trial"
assert rms[-1] < rms[0] / 100

# %%
plt.semilogy(range(1, 11), rms, "o-")
plt.xlabel("trial")
plt.ylabel("rms error [mm]")
plt.show()

# %%
os.chdir(home)
shutil.rmtree(folder)
