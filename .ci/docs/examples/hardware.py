"""A real machine: measured trials, what is refused, and the journal."""

from pathlib import Path

import numpy as np

import jaxilc
from jaxilc import Task
from jaxilc.hardware import *
from jaxilc.plants import Harmonics, PositionMap
from jaxilc.schemes import PIDType

jaxilc.setup()
task = Task(np.sin(np.linspace(0, 2 * np.pi, 101)), dt=1e-3, unit="mm", input_unit="V")
law = PIDType(gamma_p=1.0)

# %% Campaign, Rules
campaign = Campaign.start("campaign", law, task, rules=Rules(limit=4.0))
print(campaign.rules.limit)
# 4.0

# %% Journal
print([entry["event"] for entry in Journal(Path("campaign")).log()])
# ['start']

# %% Measured, read_measured
rows = [f"{k / 1e3:.3f},{y:.9g}" for k, y in enumerate(0.9 * task.reference[:, 0])]
Path("trial.csv").write_text("t [s],y [mm]\n" + "\n".join(rows))
measured = read_measured("trial.csv", task)
print(isinstance(measured, Measured), measured.y.shape, measured.u)
# True (101, 1) None

# %% Turn, Finding
turn = campaign.turn(Measured(measured.y, np.zeros((100, 1)), {}, (), "trial.csv"))
print(isinstance(turn, Turn), turn.trial, [isinstance(one, Finding) for one in turn.findings])
# True 1 []

# %% write_schedules
write_schedules("next.csv", turn.schedules, task, trial=2)

# %% write_map, read_map, MapTable
learned = PositionMap(Harmonics(pitch=12.0, orders=(1,)), weights=(0.0, 0.02))
write_map("x.comp", learned, [0.0, 3.0, 6.0, 9.0])  # for LinuxCNC
again = read_map("x.comp")
print(isinstance(again, MapTable), again.forward.round(3) + 0.0)
# True [ 0.    0.02  0.   -0.02]
