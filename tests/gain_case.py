"""For tests, this module holds learning and tuning problems with a closed form.

The plant is a static gain under P-type ILC.
"""

import dataclasses

import jax
import numpy as np

from jaxilc.learning import Machine
from jaxilc.plants import StateSpace
from jaxilc.schemes import PIDType
from jaxilc.signals import Task
from jaxilc.tuning import Tuning
from jaxilc.tuning.objectives import Final
from jaxilc.uncertainty import Uniform

N = 20
TASK = Task(np.sin(2 * np.pi * np.arange(N + 1) / N), dt=1e-3)
# The plant is y[k+1] = u[k], so e_j = (1 - gamma g)^(j-1) r with the gain g.
STATIC = Machine(StateSpace([[0.0]], [[1.0]], [[1.0]], dt=1e-3))
GAINS = {"plant.B": Uniform(0.6, 1.2, relative=True)}
PROBLEM = Tuning(
    STATIC,
    PIDType(gamma_p=0.4),
    TASK,
    3,
    ["gamma_p"],
    GAINS,
    Final("rms", floor=0.1),
    machines=4,
    held_out=3,
    steps=8,
    validate_every=3,
    lanes=2,
)


class Killed(Exception):
    """What ends a tuning from outside."""


def kill_after(step):
    """Return a `progress` that kills a tuning after a step."""

    def progress(done, losses, best):
        if done == step:
            raise Killed

    return progress


def assert_same_tuned(one, other):
    """Check that two results of a tuning have the same numbers; their schemes follow from these."""
    for field in dataclasses.fields(one):
        if field.name != "scheme":
            jax.tree.map(
                np.testing.assert_array_equal, getattr(one, field.name), getattr(other, field.name)
            )
