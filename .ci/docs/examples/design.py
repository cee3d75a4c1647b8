"""Which law suits an uncertain machine: designed, or learned by its taps."""

import numpy as np

import jaxilc
from jaxilc import Machine, Task, Uniform
from jaxilc.design import *
from jaxilc.plants import StateSpace
from jaxilc.schemes import PID, PIDType, WithFeedback

jaxilc.setup()
machine = Machine(StateSpace([[0.8]], [[0.2]], [[1.0]], dt=1e-3))
task = Task(np.sin(np.linspace(0, 2 * np.pi, 101)), dt=1e-3, unit="mm")
gain = {"plant.B": Uniform(0.8, 1.2, relative=True)}

# %% Design, Designed, Recommended (slow)
designed = Design(machine, task, 6, gain, laws=("p-type",), machines=8, steps=2).run("out")
print(isinstance(designed, Designed), isinstance(designed.chosen, Recommended))
print(designed.chosen.verdict.candidate.name)
# True True
# p-type

# %% LearnedLaw, Learned (slow)
learned = LearnedLaw(machine, task, 6, gain, taps=(5, 3), machines=8, steps=2).run("taps")
print(isinstance(learned, Learned), bool(learned.refused))
# True False

# %% feedback_among
print(feedback_among({"ilc": WithFeedback(PIDType(gamma_p=1.0), PID(kp=1.0))}))
# PID(kp=1., ki=0., kd=0., tau=0., limit=None, form='position', kv=None, ka=None)
