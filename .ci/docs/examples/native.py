"""Programs for the processor at hand."""

import numpy as np

import jaxilc
from jaxilc.native import why_not
from jaxilc.plants import StateSpace
from jaxilc.schemes import PIDType

jaxilc.setup()

# %% why_not
P = jaxilc.Machine(StateSpace([[0.8]], [[0.2]], [[1.0]], dt=1e-3))
print(why_not(P, PIDType(gamma_p=1.0), jaxilc.Task(np.ones(21), dt=1e-3)))  # nothing is in the way
# None
