"""A pendulum swung up, held upright and let down again: the example of gILC (Volckaert 2013).

gILC is the software of Volckaert, Diehl and Swevers for iterative learning control of nonlinear
systems, with IPOPT as its solver. The plant and its model are the difference equation of its Python
examples, the model with a mass that is 1 % too small and a damping that is 5 % too large. Upright
the pendulum is unstable, so the input of the first trial, by the model alone, lets it fall.
"""

from __future__ import annotations

import numpy as np

from ..learning.machine import Machine
from ..plants import Pendulum
from ..pytree.aliases import Leaf
from ..schemes import TwoStep
from ..signals.task import Task
from ..uncertainty import Uniform
from .double_mass import error_norm
from .published import printed
from .scenario import Quantity, Scenario

SAMPLE_TIME = 1 / 500
WAIT, ACCELERATE, MOVE, HOLD = 190, 30, 500, 500  # samples of each part of the motion
ANGLE = np.pi  # at which it is held [rad]
LIMIT = 2.0  # of the torque in the second example [N m]


def swing() -> np.ndarray:
    """(2000, 1) angle [rad]: up, held, and down, by a speed of straight ramps."""
    ramp, cruise = np.linspace(0.0, 1.0, ACCELERATE), np.ones(MOVE)
    up = np.concatenate([ramp, cruise, ramp[::-1]])
    speed = np.concatenate([np.zeros(WAIT), up, np.zeros(HOLD), -up, np.zeros(WAIT)])
    angle = np.cumsum(speed)
    return ANGLE * (angle / np.max(angle))[:, None]


def pendulum() -> Scenario:
    """The first two Python examples of gILC, without and with a limit of the torque."""
    model = Pendulum(mass=0.495, damping=0.105)
    weights: dict[str, Leaf] = {"w_y": 1e8, "w_alpha": 1e-10, "w_q": 1e8, "w_s": 1e-10}
    return Scenario(
        **printed("pendulum"),
        machine=Machine(Pendulum()),
        task=Task(swing(), dt=SAMPLE_TIME, unit="rad", input_unit="N m"),
        schemes={
            "two-step": TwoStep(model, **weights),
            "two-step-limited": TwoStep(model, **weights, limit=LIMIT),
        },
        uncertainty={
            "plant.mass": Uniform(0.98, 1.02, relative=True),
            "plant.damping": Uniform(0.9, 1.1, relative=True),
        },
        shown_unit="rad",
        show_trials=(1, 2, 3, 4, 5),
        quantities={"error_norm": Quantity(error_norm)},
        judged_by="error_norm",
    )
