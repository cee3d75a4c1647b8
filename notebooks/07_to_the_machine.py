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
# # From simulation to the machine
#
# On a real machine the loop runs through files: the controller plays a table, records the trial,
# and `jaxilc` makes the next table of it. The scheme is the one that was simulated. A *campaign* is
# a folder that remembers what was learned from each trial; it checks each measured trial before it
# learns, writes atomically, and can go back to any earlier trial.
#
# Here the "machine" is another program that we only know by its files: a plant of other parameters,
# with noise. On the command line the same is
#
#     jaxilc next --state x-axis --scenario axis.toml --scheme ilc --out next-1.csv
#     jaxilc next --state x-axis --measured trial-1.csv --out next-2.csv

# %%
import csv
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import control
import jax
import numpy as np

import jaxilc
from jaxilc import Campaign, Machine, Sensor, Task, load_scenario, plants
from jaxilc.figures import campaign_figure
from jaxilc.hardware import read_measured, write_schedules
from jaxilc.schemes import Feedforward, Scheme, WithFeedback

# %matplotlib inline
# ruff: noqa: B018
jaxilc.setup()

folder = Path(tempfile.mkdtemp())

# %% [markdown]
# ## The axis, as we believe it to be
#
# A plant file in TOML: model, limits, task, scheme. A model is not needed for learning as such;
# here it served to choose the gain, the lead of four samples and the cutoff of 60 Hz in simulation.

# %%
(folder / "axis.toml").write_text("""
[plant]
kind = "transfer_function"
num = [4000.0]
den = [1.0, 80.0, 4000.0]
[machine.actuator]
limit = 10.0
[task]
dt = 0.001
unit = "mm"
input_unit = "V"
[task.reference]
function = "s_curve"
positions = [0.0, 1.0, 0.0]
velocity = 20.0
acceleration = 600.0
jerk = 3e4
duration = 0.25
[schemes.ilc]
class = "WithFeedback"
feedback = { class = "PID", kp = 1.0, ki = 20.0 }
[schemes.ilc.learning]
class = "Filtered"
scheme = { class = "PIDType", gamma_p = 0.6, gamma_d = 10.0, lead = 4 }
filter = { class = "ZeroPhaseButterworth", cutoff = 60.0 }
""")
axis = load_scenario(folder / "axis.toml")
scheme, task = axis.schemes["ilc"], axis.task

# %% [markdown]
# ## The machine at the other end
#
# It reads the table, adds it to what its own PI feedback gives to the plant, and writes a trace:
# time, reference, output, input, each with its unit. Its gain is 15 % higher than ours and its
# damping 25 % lower, and its encoder is noisy.

# %%
real = Machine(
    plants.from_control(control.tf([4600.0], [1.0, 60.0, 4000.0])),
    axis.machine.actuator,
    Sensor(resolution=1e-4, noise=5e-5),
)
their_loop = WithFeedback(Scheme(), scheme.feedback)


@jax.jit
def their_trial(u, key):
    memory = their_loop.initial_memory(task)._replace(learning=Feedforward(u))
    trial = jaxilc.run_trial(real, their_loop, task, memory, key)
    return trial.y, trial.u


def machine_plays(table, trace, number):
    with open(table, newline="") as file:
        header, *rows = csv.reader(file)
    played = dict(zip(header, np.array(rows, float).T, strict=True))
    y, u = their_trial(played["feedforward [V]"][:-1, None], jax.random.key(number))
    u = np.append(np.asarray(u)[:, 0], 0.0)
    columns = np.stack([played["t [s]"], played["r [mm]"], np.asarray(y)[:, 0], u], axis=1)
    np.savetxt(
        trace, columns, fmt="%.17g", delimiter=",", header="t [s],r [mm],y [mm],u [V]", comments=""
    )


# %% [markdown]
# ## Twenty trials

# %%
campaign = Campaign.start(folder / "x-axis", scheme, task, actuator=axis.machine.actuator)
write_schedules(folder / "next-1.csv", campaign.schedules(), task, trial=1)
for j in range(1, 21):
    machine_plays(folder / f"next-{j}.csv", folder / f"trial-{j}.csv", j)
    measured = read_measured(folder / f"trial-{j}.csv", task, campaign.recordable())
    turn = campaign.turn(measured)
    # `keep` refuses what the checks refuse: saturation, an input beyond the limit, a gap
    campaign.keep(turn)
    write_schedules(folder / f"next-{j + 1}.csv", turn.schedules, task, trial=j + 1)
    if j in (1, 2, 5, 10, 15, 20):
        print(
            f"trial {j:2d}: RMS error {1e3 * turn.metrics['error']:8.3f} µm",
            "; ".join(f.text for f in turn.findings),
        )
errors = [row["rms_error"] for row in campaign.journal.log() if row["event"] == "trial"]
assert errors[-1] < errors[0] / 10

# %% [markdown]
# The first table is zero, so trial 1 is the machine under its feedback alone.
#
# ## A trial that is wrong
#
# Somebody hands in trial 3 again. It is refused: its data were learned from already.

# %%
try:
    campaign.turn(read_measured(folder / "trial-3.csv", task, campaign.recordable()))
except ValueError as error:
    print(error)

# %% [markdown]
# A trace of another unit, or of another sample time, is refused too; nothing is converted or
# resampled.

# %%
text = (folder / "trial-20.csv").read_text()
(folder / "metres.csv").write_text(text.replace("y [mm]", "y [m]"))
try:
    read_measured(folder / "metres.csv", task)
except ValueError as error:
    print(str(error).removeprefix(f"{folder}/"))

# %% [markdown]
# ## Going back
#
# Undo to any earlier trial; the log keeps what was undone.

# %%
campaign.undo(18)
machine_plays(folder / "next-19.csv", folder / "trial-19-again.csv", 100)
again = campaign.turn(read_measured(folder / "trial-19-again.csv", task, campaign.recordable()))
campaign.keep(again)
print(f"trial {again.trial} again: RMS error {1e3 * again.metrics['error']:.3f} µm")
top, bottom = campaign_figure(campaign.journal.log(), unit="mm", input_unit="V")
top.figure

# %% [markdown]
# ## The same by hand
#
# Without the campaign's folder and checks, three calls: `scheme.initial_memory`, `feedforward`,
# `next_memory`. They must give the same table.

# %%
memory = scheme.initial_memory(task)
for j in range(1, 19):
    record = read_measured(folder / f"trial-{j}.csv", task)
    _, signals = jaxilc.learning.replay(scheme, task, memory, record.y, axis.machine.actuator)
    memory = jaxilc.next_memory(
        scheme, task, memory, record.y, record.u, feedback=signals["feedback"]
    )
by_hand = np.asarray(jaxilc.feedforward(scheme, task, memory))
np.testing.assert_allclose(by_hand, campaign.schedules(18)["feedforward"], rtol=1e-9, atol=1e-12)
print("largest learned input:", np.round(np.max(np.abs(by_hand)), 4), "V")

# %% [markdown]
# ## The set-point of a closed drive
#
# The commonest case of a CNC: the drive is closed, and only its set-point can be changed. One
# recorded move is enough for the plant file, which `jaxilc init --set-point` writes. `u` starts as
# the reference, so the first trial has the error of the drive as it is, and not the stroke.

# %%
drive = Machine(plants.from_control(control.tf([5685.0], [1.0, 90.0, 5685.0])), None, real.sensor)
s = np.clip(np.arange(401) / 200, 0, 1)
move = Task(5 * (10 * s**3 - 15 * s**4 + 6 * s**5), dt=0.002, unit="mm", input_unit="mm")


@jax.jit
def drive_plays(u, key):
    return jaxilc.run_trial(drive, Scheme(), move, Feedforward(u), key).y


def record(path, u, number):
    y = np.asarray(drive_plays(u, jax.random.key(number)))
    columns = np.column_stack([move.time, np.append(u, u[-1:], axis=0), y])
    np.savetxt(path, columns, delimiter=",", header="t [s],set [mm],pos_act [mm]", comments="")


record(folder / "move.csv", np.asarray(move.reference)[:-1], 0)
way = ["--record", folder / "move.csv", "--input", "set", "--output", "pos_act"]
jaxilc_itself = Path(sys.executable).with_name("jaxilc")
subprocess.run([jaxilc_itself, "init", "--set-point", *way, folder / "drive.toml"], check=True)
set_point = load_scenario(folder / "drive.toml")
law, task = set_point.schemes["ilc"], set_point.task
campaign, errors = Campaign.start(folder / "set-point", law, task), []
for j in range(1, 7):
    record(folder / "trial.csv", campaign.schedules()["u"], j)
    names = {"u": "set", "y": "pos_act"}
    turn = campaign.turn(read_measured(folder / "trial.csv", task, campaign.recordable(), names))
    campaign.keep(turn)
    errors.append(turn.metrics["error"])
print("RMS errors [mm]:", np.round(errors, 4))
assert errors[-1] < errors[0] / 20

# %%
shutil.rmtree(folder)
