"""Many machines and many settings, as one labelled dataset."""

import numpy as np

import jaxilc
from jaxilc import Machine, Task, Uniform
from jaxilc.plants import StateSpace
from jaxilc.schemes import PIDType
from jaxilc.sweeps import *

jaxilc.setup()
machine = Machine(StateSpace([[0.8]], [[0.2]], [[1.0]], dt=1e-3))
task = Task(np.sin(np.linspace(0, 2 * np.pi, 101)), dt=1e-3, unit="mm")
schemes = {"p": PIDType(gamma_p=1.0)}
gain = {"plant.B": Uniform(0.5, 1.5, relative=True)}

# %% Sweep
sweep = Sweep(machine, schemes, task, trials=6, uncertainty=gain, machines=32)
dataset = sweep.run()
print(dict(dataset.rms.sizes))
# {'scheme': 1, 'sample': 32, 'trial': 6}

# %% summarise, SchemeSummary
for row in summarise(dataset, tolerance=0.02):
    print(isinstance(row, SchemeSummary), f"{row.yield_share:.0%} within 0.02 mm")
# True 72% within 0.02 mm

# %% open_dataset
sweep.run("kept.zarr")
print(float(abs(open_dataset("kept.zarr").rms - dataset.rms).max()))
# 0.0

# %% best_points, BestPoint, at_best, point_of
grid = {"p.gamma_p": "0.5:4:8"}
over = Sweep(machine, schemes, task, 6, uncertainty=gain, machines=8, grid=grid).run()
best = best_points(over, tolerance=0.02)
print(isinstance(best[0], BestPoint), best[0].point)
print(dict(at_best(over, best).rms.sizes), point_of(over, best[0].point))
# True {'p.gamma_p': 1.0}
# {'scheme': 1, 'sample': 8, 'trial': 6} {'p.gamma_p': 1.0}

# %% run_schemes, history_dataset
one, histories = run_schemes(machine, schemes, task, trials=6)
print(list(one)[:4], history_dataset(histories, task).rms.equals(one.rms))
# ['r', 'y', 'e', 'u'] True

# %% ChunkFailed, UnlikeWorkers
print(issubclass(ChunkFailed, Exception), issubclass(UnlikeWorkers, Exception))
# True True
