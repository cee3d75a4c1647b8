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
# # It repeats in position
#
# Cogging, the pitch of a screw and friction by place repeat where the machine is, not when. A map
# over the position that was learned at one speed serves others.

# %%
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from scipy.optimize import minimize_scalar

import jaxilc
from jaxilc import Machine, Task, learn, theory
from jaxilc.hardware import read_map, write_map
from jaxilc.identification import pitch_of
from jaxilc.plants import ByPosition, Harmonics, PositionMap, ProcessModel, Splines
from jaxilc.schemes import BasisFunctions, JoinedBasis, PolynomialBasis, PositionBasis

jaxilc.setup()

SERVO = ProcessModel(1.0, (), (), (2 * np.pi * 30,), (0.7,))  # a closed drive of 30 Hz, in mm
COGGING = PositionMap(Harmonics(pitch=12.0, orders=(1, 2)), weights=(0.3, 0.1, 0.05, 0.08))
STAGE = Machine(ByPosition(SERVO, force=COGGING))


def across(speed, stroke=48.0):
    """There and back, at this speed [mm/s] in the mean and pi / 2 of it in the middle."""
    s = np.clip(1e-3 * np.arange(5001) * speed / stroke, 0, 2)
    assert s[-1] == 2  # it is back
    return Task(stroke / 2 * (1 - np.cos(np.pi * s)), dt=1e-3, unit="mm")


# %% [markdown]
# ## The pitch, from a record

# %%
x = across(30).reference[:, 0]
still = learn(STAGE, BasisFunctions(PolynomialBasis((0,)), SERVO, start=[1.0]), across(30), 1)
found = pitch_of(x, still.final.e[:, 0], least=5, most=20)
print(f"pitch {found.pitch:.2f} mm, harmonics {np.round(found.amplitudes, 2)} mm")
assert abs(found.pitch - 12) < 0.1

# %% [markdown]
# ## One map, other speeds
#
# Two bases side by side: what the motion itself needs, and what the place needs. The record tells
# the pitch from what the servo makes of the force, a little late; the pitch with which learning
# leaves least is nearer to the true one.


# %%
def law_of(pitch):
    place = PositionBasis(Harmonics(pitch, orders=(1, 2, 3)))
    both = JoinedBasis((PolynomialBasis((0, 1, 2)), place))
    return place, BasisFunctions(both, SERVO, start=np.eye(9)[0])


def left(pitch):
    return float(learn(STAGE, law_of(pitch)[1], across(30), trials=6).rms[-1, 0])


near = (found.pitch - 0.1, found.pitch + 0.1)
pitch = minimize_scalar(left, bounds=near, method="bounded", options={"xatol": 1e-5}).x
print(f"pitch {pitch:.4f} mm leaves {1e3 * left(pitch):.2f} µm, not {1e3 * left(found.pitch):.2f}")
assert abs(pitch - 12) < 0.2 * abs(found.pitch - 12)

# %%
place, law = law_of(pitch)
learned = learn(STAGE, law, across(30), trials=6)
print(*(f"{1e3 * value:.2f}" for value in learned.rms[:, 0]), "µm at 30 mm/s")
for speed in (20, 50, 80):
    there = float(learn(STAGE, law, across(speed), trials=6).rms[-1, 0])
    taken = float(learn(STAGE, law, across(speed), trials=1, memory=learned.memory).rms[0, 0])
    print(f"{speed} mm/s: {1e3 * taken:.2f} µm with this map, {1e3 * there:.2f} learned there")
    assert taken < there

# %%
by_place = place.map(learned.memory.theta[3:])
at = np.linspace(0, 48, 400)
fig, ax = plt.subplots()
ax.plot(at, -COGGING.at(at), label="what the machine lacks")
ax.plot(at, by_place.at(at), "--", label="learned")
ax.set(xlabel="position [mm]", ylabel="added to the input [mm]", ylim=(None, 0.4))
ax.legend(loc="upper center", ncols=2)
plt.show()
assert np.max(np.abs(by_place.at(at) + COGGING.at(at))) < 0.05

# %% [markdown]
# ## What a motion does not visit
#
# With bins in place of waves, a short motion tells nothing of the far ones; they keep what was
# learned.

# %%
bins = BasisFunctions(PositionBasis(Splines(0.0, 48.0, count=9)), SERVO)
visited = theory.visits(STAGE, bins, across(30, stroke=20.0))
print([bool(told) for told in visited.told], f"rate {visited.rate:.2f}")
assert not visited.told[-1]
assert visited.rate < 1

# %% [markdown]
# ## To the machine
#
# As a table for LinuxCNC; `.csv`, `.st` and `.h` are for TwinCAT and C.

# %%
with tempfile.TemporaryDirectory() as folder:
    written = write_map(Path(folder) / "x.comp", by_place, np.linspace(0, 48, 97))
    again = read_map(Path(folder) / "x.comp")
print(again.forward[:4])
assert np.array_equal(again.forward, written.forward)
