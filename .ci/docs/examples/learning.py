"""The machine around a plant, learning over trials, and the numbers of a trial."""

import jax
import numpy as np

import jaxilc
from jaxilc.learning import *
from jaxilc.plants import StateSpace
from jaxilc.schemes import PIDType
from jaxilc.signals import Task

jaxilc.setup()
P = StateSpace([[0.8]], [[0.2]], [[1.0]], dt=1e-3)  # y[k+1] = 0.8 y[k] + 0.2 u[k]
task = Task(np.sin(np.linspace(0, 2 * np.pi, 101)), dt=1e-3, unit="mm")
law = PIDType(gamma_p=1.0)  # u'[k] = u[k] + e[k+1]
machine = Machine(P)

# %% learn, History
history = learn(machine, law, task, trials=6)
print(isinstance(history, History), [f"{rms:.3f}" for rms in history.rms[:, 0]])
# True ['0.707', '0.161', '0.045', '0.015', '0.008', '0.005']

# %% Metrics
print(Metrics._fields, history.metrics.rms.shape)
# ('max_error', 'rms', 'settled_error', 'effort', 'finite') (6, 1)

# %% Machine, Actuator, Sensor, Disturbance
real = Machine(
    P,
    actuator=Actuator(limit=1.2),
    sensor=Sensor(resolution=1e-3),
    disturbance=Disturbance(output_noise=1e-3),
)
print(f"{learn(real, law, task, trials=6).rms[-1, 0]:.3f} mm, with a limit that is too low")
# 0.005 mm, with a limit that is too low

# %% Keep
kept = learn(machine, law, task, trials=6, save=Keep(signals=("u",))).saved
print({name: array.shape for name, array in kept.items()})
# {'u': (6, 100, 1)}

# %% run_trial
trial = run_trial(machine, law, task, law.initial_memory(task), jax.random.key(0))
print(trial.y.shape, trial.u.shape)
# (101, 1) (100, 1)

# %% feedforward, next_memory
memory = law.initial_memory(task)
for _ in range(3):  # a real machine would play u
    u = feedforward(law, task, memory)
    memory = next_memory(law, task, memory, 0.9 * task.reference, u)
print(f"largest input after three trials {abs(feedforward(law, task, memory)).max():.1f}")
# largest input after three trials 0.3

# %% measured_trial, measure
found = measure(measured_trial(task, 0.9 * task.reference, np.zeros((100, 1))), task)
print(f"largest error {found.max_error[0]:.1f} mm")
# largest error 0.1 mm

# %% replay
y = np.zeros((101, 1))  # measured, where the input was not
u, signals = replay(law, task, law.initial_memory(task), y)
print(u.shape)
# (100, 1)

# %% check
check(machine, law, task)  # raises ValueError, naming what does not fit together

# %% truncated
print(
    f"{truncated(machine, law, task, 6, last=2).rms[-1, 0]:.3f}"
)  # gradients of the last two only
# 0.005

# %% Variation
uneven = Machine(P, variation=Variation(dropped=0.1))
print(f"{learn(uneven, law, task, trials=6).rms[-1, 0]:.2f} mm, with each tenth sample lost")
# 0.03 mm, with each tenth sample lost

# %% PlantChange
weaker = PlantChange(StateSpace([[0.8]], [[0.1]], [[1.0]], dt=1e-3), first=4)
changing = Machine(P, variation=Variation(change=weaker))
print([f"{rms:.3f}" for rms in learn(changing, law, task, trials=6).rms[:, 0]])
# ['0.707', '0.161', '0.045', '0.349', '0.189', '0.103']

# %% References
two = References(np.stack([task.reference, -task.reference]), first=(4,))
moved = Machine(P, variation=Variation(references=two))
print([f"{rms:.3f}" for rms in learn(moved, law, task, trials=6).rms[:, 0]])
# ['0.707', '0.161', '0.045', '1.423', '0.325', '0.092']

# %% Repeatability, repeatability
of_five = repeatability(np.array([1.0, 1.1, 0.9, 1.0, 1.05]))
print(isinstance(of_five, Repeatability), f"{of_five.mean:.2f} +- {of_five.spread:.2f}")
# True 1.01 +- 0.20

# %% best_trial
print(best_trial(history.rms))
# [1 2 3 4 5 6]

# %% root_mean_square, total_variation, chattering
print(f"{root_mean_square(trial.e)[0]:.3f} {total_variation(trial.r)[0]:.3f}", chattering(trial))
# 0.704 4.000 [0.]


# %% Watch, Watched
class Growth(Watch):
    """A watch compares each trial with the one before; `theory.BoundsWatch` is one."""


print(Watched(of_trials=False, unit="mm", text="largest step of the input").text)
# largest step of the input
