"""Tasks, samples, trials, references, paths and G-code."""

import numpy as np

import jaxilc
from jaxilc.signals import Limit, Sample, Task, Trial, contour_error

jaxilc.setup()

# %% Task
task = Task(np.sin(np.linspace(0, 2 * np.pi, 501)), dt=1e-3, unit="mm", input_unit="V")
print(task.reference.shape, f"{task.dt} s")
# (501, 1) 0.001 s

# %% Sample
now = Sample(r=task.reference[0], ahead=task.reference[1], y=np.zeros(1), row=None, dt=1e-3)
print(now.r - now.y)  # what a feedback sees at one instant
# [0.]

# %% Trial
trial = Trial(r=task.reference, y=0.9 * task.reference, u=np.zeros((500, 1)), dt=1e-3)
print(f"largest error {abs(trial.e).max():.2f} mm")
# largest error 0.10 mm

# %% Limit
reached = Limit(signal=trial.y, bound=0.8)  # a signal and what it must stay within
print(bool((abs(reached.signal) > reached.bound).any()))
# True

# %% contour_error
circle = np.stack([np.cos(t := np.linspace(0, 2 * np.pi, 401)), np.sin(t)], axis=1)
late = np.roll(circle, 3, axis=0)  # three samples behind, but on the path
off = contour_error(late, circle, window=8).max()
print(f"{abs(circle - late).max():.3f} of error, {off:.3f} off the path")
# 0.047 of error, 0.000 off the path
