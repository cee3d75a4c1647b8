"""For tests, this module holds a small sweep.

It has noise, two schemes, and a number of machines that is not a multiple of the chunk.
"""

import numpy as np

from jaxilc import Machine, Sensor, Sweep, Task, Uniform
from jaxilc.plants import voice_coil
from jaxilc.schemes import CFDLMFAILC, PID

TASK = Task(reference=np.sin(2 * np.pi * np.arange(61) / 60), dt=1e-3, unit="mm", input_unit="V")
PLAN = Sweep(
    Machine(voice_coil(), sensor=Sensor(noise=1e-4)),
    {"learning": CFDLMFAILC(), "feedback": PID(kp=-5.0)},
    TASK,
    trials=4,
    uncertainty={
        "plant.gain": Uniform(0.8, 1.2, relative=True),
        "plant.poles[2]": Uniform(5.0, 8.0),
    },
    machines=11,
    seed=7,
    keep=("e", "u"),
    chunk=4,
    lanes=2,
)
