"""Distributions of uncertain numbers, and populations of machines."""

import jaxilc
from jaxilc import LogUniform, Machine, Normal, Population, Uniform
from jaxilc.plants import StateSpace
from jaxilc.uncertainty import draw

jaxilc.setup()
machine = Machine(StateSpace([[0.8]], [[0.2]], [[1.0]], dt=1e-3))

# %% Uniform, LogUniform, Normal
for gain in (Uniform(0.8, 1.2), LogUniform(0.5, 2.0), Normal(1.0, 0.1)):
    print(draw(machine, {"plant.B[0][0]": gain}, 4)["plant.B[0][0]"].round(2))
# [0.2  1.05 0.91 0.82]
# [0.2  1.21 0.73 0.53]
# [0.2  1.04 0.94 0.83]

# %% Population
print(Population(machine, {"plant.B": Uniform(0.8, 1.2, relative=True)}, count=64).count)
# 64
