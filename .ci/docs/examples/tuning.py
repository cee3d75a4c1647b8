"""Weights by gradient through learning, the worst machine, and trade-offs."""

import numpy as np

import jaxilc
from jaxilc import Machine, Task, Uniform, learn
from jaxilc.plants import StateSpace
from jaxilc.schemes import PIDType
from jaxilc.tuning import *
from jaxilc.tuning.objectives import Effort, Final

jaxilc.setup()
machine = Machine(StateSpace([[0.8]], [[0.2]], [[1.0]], dt=1e-3))
task = Task(np.sin(np.linspace(0, 2 * np.pi, 101)), dt=1e-3, unit="mm")
law = PIDType(gamma_p=1.0)
gain = {"plant.B": Uniform(0.8, 1.2, relative=True)}

# %% Tuning, Tuned
few = {"machines": 4, "held_out": 4, "steps": 10}
problem = Tuning(machine, law, task, 6, ["gamma_p"], gain, objective=Final("rms"), **few)
tuned = problem.run()
print(isinstance(tuned, Tuned), f"gamma_p = {tuned.values['gamma_p']:.1f}")
# True gamma_p = 1.1


# %% worst_case_search
def last(machine):
    """The rms error of the last trial."""
    return learn(machine, law, task, 6).rms[-1, 0]


worst = worst_case_search(last, machine, gain, starts=2, steps=8)
print({name: f"{value:.2f}" for name, value in worst.values.items()})
# {'plant.B': '0.80'}

# %% monte_carlo_search
print(monte_carlo_search(last, machine, gain, 16).loss <= worst.loss)
# True

# %% pareto
points = pareto(problem, Final("rms"), Effort(), shares=(0.2, 0.8))
print(len(points))
# 1
