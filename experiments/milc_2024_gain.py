"""MILC 2024: the force gain that gives the motor's position loop the printed bandwidth of 50 Hz."""

import numpy as np
import scipy.optimize

import jaxilc
from jaxilc.scenarios.milc_2024 import DT, nominal_drive, position_gain
from jaxilc.schemes import PID, OnOutputs
from jaxilc.signals import Task
from jaxilc.theory import frequency

GRID = np.linspace(30.0, 80.0, 501)  # [Hz]
PRINTED = 50.0  # [Hz]


def bandwidth(antiresonance: float, force_gain: float) -> float:
    """-3 dB of the motor's position loop [Hz]."""
    drive = nominal_drive(antiresonance, force_gain)
    gain, rest = position_gain(drive), Task(np.zeros((3, 2)), dt=DT, inputs=1)
    loop = frequency.linear_loop(jaxilc.Machine(drive), OnOutputs(PID(kp=gain), (0,)), rest)
    closed = gain * np.abs(np.asarray(frequency.response(loop, GRID, DT))[:, 0, 0])
    below = np.argmax(closed < np.sqrt(0.5))
    return float(
        np.interp(-np.sqrt(0.5), -closed[below - 1 : below + 1], GRID[below - 1 : below + 1])
    )


def force_gain(antiresonance: float) -> float:
    """That of the printed bandwidth [N/V], the smaller of the two that have it."""
    return scipy.optimize.brentq(
        lambda g: bandwidth(antiresonance, g) - PRINTED, 60.0, 120.0, xtol=0.01
    )
