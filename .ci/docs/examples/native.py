"""Programs for the processor at hand."""

import dataclasses

import jax
import numpy as np

import jaxilc
from jaxilc.native import compiled, why_not
from jaxilc.plants import StateSpace
from jaxilc.schemes import PIDType

jaxilc.setup()

# %% compiled
P = jaxilc.Machine(StateSpace([[0.8]], [[0.2]], [[1.0]], dt=1e-3))
task, law = jaxilc.Task(np.ones(21), dt=1e-3), PIDType(gamma_p=1.0)
error = compiled(lambda law: jaxilc.learn(P, law, task, 4).rms[-1, 0], law)
slope = jax.jit(jax.grad(lambda gain: error(dataclasses.replace(law, gamma_p=gain))))
print(slope(1.0) < 0)  # more gain leaves less error
# True

# %% why_not
P = jaxilc.Machine(StateSpace([[0.8]], [[0.2]], [[1.0]], dt=1e-3))
print(why_not(P, PIDType(gamma_p=1.0), jaxilc.Task(np.ones(21), dt=1e-3)))  # nothing is in the way
# None
