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
# # From a record to a verdict
#
# An engineer has an axis and wants an answer: which learning law, with which weights, is it safe,
# what will it reach? Five commands lead there. The axis here is a program of its own, in SciPy; it
# knows nothing of `jaxilc`, and `jaxilc` knows it by its files alone.

# %%
import csv
import json
import os
import shlex
import shutil
import sys
import tempfile
import tomllib
from pathlib import Path
from unittest import mock

import numpy as np
import scipy.signal
from IPython.display import Image, display

from jaxilc.cli import main
from jaxilc.signals.references import s_curve

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


# %% [markdown]
# ## The axis
#
# A position loop of 25 Hz, damping 0.7, with 3 % less gain than its drawing says and an encoder
# noise of 0.5 µm, at 1 kHz.

# %%
DT, NOISE = 1e-3, 5e-4
rng = np.random.default_rng(7)
W = 2 * np.pi * 25
AXIS = scipy.signal.cont2discrete(([0.97 * W**2], [1, 2 * 0.7 * W, W**2]), DT, method="zoh")


def play(u):
    """The measured positions of the axis [mm] while it plays set points u [mm]."""
    y = scipy.signal.lfilter(AXIS[0].ravel(), AXIS[1], np.append(u, u[-1]))
    return y + NOISE * rng.standard_normal(len(y))


def write(path, header, *columns):
    with open(path, "w", newline="") as file:
        csv.writer(file).writerows([header, *zip(*columns, strict=True)])


# %% [markdown]
# ## 1. Record an experiment
#
# A random sequence of set points, and what the encoder says.

# %%
u = np.repeat(rng.choice([-0.5, 0.5], 60), 20)
y = play(u)[:-1]
write("record.csv", ["t [s]", "u [mm]", "y [mm]"], DT * np.arange(len(u)), u, y)

# %% [markdown]
# ## 2. Identify the plant
#
# The order is given here; `--auto` would choose it by a table. The plant file holds the numbers,
# their intervals as uncertainty, a task and a first law.

# %%
jaxilc("identify record.csv --poles 0 --pairs 1 --zeros 0 --out axis.toml")
print(Path("axis.toml").read_text())

# %% [markdown]
# ## 3. The task, and what may change
#
# A move of 10 mm and back within limits of velocity, acceleration and jerk. The noise of the
# encoder is stated too, so that predictions know it. The intervals of the fit are those of one
# record; an axis that warms up and carries other loads differs by more, here 5 %.

# %%
r = s_curve([0, 10, 0], velocity=150, acceleration=3e3, jerk=3e5, dwell=0.05, dt=DT)
write("move.csv", ["t", "r"], DT * np.arange(len(r)), r)
plant = Path("axis.toml").read_text().partition("\n[uncertainty]")[0]
law = Path("axis.toml").read_text().partition("\n[schemes")[2]
five = '{ distribution = "uniform", low = 0.95, high = 1.05, relative = true }'
_ = Path("axis.toml").write_text(
    f"""{plant}
[uncertainty]
"plant.gain" = {five}
"plant.frequencies" = {five}

[machine.sensor]
noise = {NOISE}

[task]
dt = {DT}
unit = "mm"
input_unit = "mm"
reference = {{ csv = "move.csv" }}

[schemes{law}"""
)

# %% [markdown]
# ## 4. Is the first law safe?

# %%
jaxilc("filter axis.toml --report filter.json")
display(Image("out/filter-axis/ilc.png"))

# %% [markdown]
# ## 5. Design a law
#
# One law and few steps here; without these options six kinds of laws are tried and tuned longer.

# %%
jaxilc("design axis.toml --law p-type --steps 5 --machines 65 --report design.json")
display(Image("out/design-axis/design.png"))
print(Path("axis.design.toml").read_text()[:1500])

# %% [markdown]
# ## 6. Learn on the axis
#
# The controller plays a file, the encoder is recorded, and `next` makes the next file. Each trial
# stands beside the band in which it is predicted: the first two by the plant file, the later ones
# by the trials so far.

# %%
jaxilc("next --state campaign --scenario axis.design.toml --out next.csv")
for _trial in range(6):
    u = np.loadtxt("next.csv", delimiter=",", skiprows=1, usecols=2)[:-1]
    y = play(u)
    write("trial.csv", ["t [s]", "u [mm]", "y [mm]"], DT * np.arange(len(y)), np.append(u, 0), y)
    jaxilc("next --state campaign --measured trial.csv --out next.csv")

# %%
jaxilc("trials --state campaign --report trials.json --plot trials.png")
display(Image("trials.png"))

# %% [markdown]
# ## The verdict
#
# What the plant file predicted before the axis moved came true, on an axis that `jaxilc` has never
# seen but through its files.

# %%
told = json.loads(Path("trials.json").read_text())
errors = np.array([row["rms_error"] for row in told["trials"] if row["event"] == "trial"])
low, high = (np.array(told["predicted"]["rms"][end])[: len(errors)] for end in ("low", "high"))
for trial, (least, error, most) in enumerate(zip(low, errors, high, strict=True), 1):
    print(f"trial {trial}: rms {error:.3g} mm, predicted {least:.3g} to {most:.3g} mm")
assert np.sum((errors < low) | (errors > high)) <= 1, "one in twenty may lie outside"
assert errors[-1] < errors[0] / 2000

margin = json.loads(Path("design.json").read_text())["proof"]["margin"]
f = np.linspace(0.5, 499.5, 2000)
z = np.exp(2j * np.pi * f * DT)
P = np.polyval(AXIS[0].ravel(), z) / np.polyval(AXIS[1], z)
(law,) = tomllib.loads(Path("axis.design.toml").read_text())["schemes"].values()
gain, lead = law["scheme"]["gamma_p"], law["scheme"]["lead"]
Q = 1 / (1 + (np.tan(np.pi * f * DT) / np.tan(np.pi * law["filter"]["cutoff"] * DT)) ** 4)
true = np.max(np.abs(Q * (1 - gain * z ** (1 + lead) * P)))
print(f"|Q (1 - L P)| of the true axis: {true:.3f}; the design promised {1 - margin:.3f} at most")
assert true <= 1 - margin

# %%
os.chdir(home)
shutil.rmtree(folder)
