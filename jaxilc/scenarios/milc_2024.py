"""MILC 2024: a flexible ball-screw drive under direct and multivariable norm-optimal ILC.

Multivariable Iterative Learning Control Design for Precision Control of Flexible Feed Drives,
Sensors 24 (2024), section 5. Lengths in mm, input in V, errors shown in µm. The paper counts trials
from 0; its trial 10 is the eleventh here.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..filters.inversion import inverse, output_ratio
from ..learning.machine import Actuator, Machine, Sensor
from ..learning.metrics import largest, root_mean_square
from ..plants import (
    BallScrewDrive,
    FrictionTable,
    LeadError,
    StateSpace,
    StribeckFriction,
    direct_model,
    multivariable_model,
)
from ..pytree.aliases import Leaf
from ..pytree.ranges import need_one_of
from ..schemes import PID, MultivariableILC, NormOptimal, OnOutputs, WithFeedback
from ..signals import references
from ..signals.task import Task
from ..uncertainty import Uniform
from .published import Readings, printed
from .scenario import Quantity, Scenario

DT = 1 / 4000
POSITION_GAIN = 180.0  # K_pp [1/s]
WEIGHTS: dict[str, Leaf] = {"w_q": 2e6, "w_r": 1e-4, "w_s": 20.0}
PITCH = {"x": 10.0, "z": 12.0}  # [mm]
PULSE = 52e-6 / (2 * np.pi)  # step of the motor's encoder [revolutions]
TABLE_STEP = 0.25e-3  # step of the linear encoder [mm]

REST, DURATION = 0.025, 1.0  # of the path [s]
LARGEST_COMMAND = 500.0  # velocity that the input can command [mm/s], chosen


class Reading(NamedTuple):
    """A reading of section 5.

    stroke: of the path [mm]
    velocity, acceleration, jerk: limits of the path [mm/s], [mm/s^2], [mm/s^3]
    dwell: rest between the strokes [s]
    unit: of the input, its velocity for a volt [mm/s]; it decides how the printed weights act
    antiresonance: of the drive [Hz]
    force_gain: the one that makes the motor's position loop 50 Hz wide, -3 dB [N/V]
    noise: standard deviation of the noise on the machine table [mm]
    """

    stroke: float
    velocity: float
    acceleration: float
    jerk: float
    dwell: float
    unit: float
    antiresonance: float
    force_gain: float
    noise: float


READINGS = Readings("milc-2024", Reading)


def nominal_drive(antiresonance: float, force_gain: float, unit: float = 50.0) -> BallScrewDrive:
    """The drive as the model describes it.

    antiresonance: frequency of the antiresonance [Hz]
    force_gain: gain from the command to the force [N/V]
    unit: velocity for a volt of the input [mm/s]
    """
    table_mass = 30.0
    stiffness = table_mass * (2 * jnp.pi * antiresonance) ** 2
    return BallScrewDrive(
        motor_mass=30.0, table_mass=table_mass, stiffness=stiffness,
        damping=2 * 0.03 * jnp.sqrt(stiffness * table_mass), motor_damping=20.0, table_damping=20.0,
        force_gain=force_gain, force_limit=1500.0, current_bandwidth=350.0, command_scale=unit,
    )  # fmt: skip


def real_machine(drive: BallScrewDrive, noise: float, pitch: float = 10.0) -> Machine:
    """The machine with the drive and the effects that its model leaves out.

    noise: standard deviation of the noise on the machine table [mm]
    pitch: pitch of the screw [mm]
    """
    friction = StribeckFriction(coulomb_force=20.0, static_force=26.0, transition_velocity=1e-3)
    compensated = dataclasses.replace(friction, coulomb_force=0.9 * 20.0, static_force=0.9 * 26.0)
    motor_step = PULSE * pitch
    plant = dataclasses.replace(
        drive,
        table_mass=1.1 * drive.table_mass,
        encoder_step=motor_step,
        table_friction=friction,
        lead_error=LeadError(amplitude=2e-6, period=1e-3 * pitch),
        compensation=FrictionTable.of(compensated, np.linspace(-0.2, 0.2, 81)),
    )
    sensor = Sensor(resolution=(motor_step, TABLE_STEP), noise=noise * jnp.array([1 / 3, 1.0]))
    limit = LARGEST_COMMAND / drive.command_scale
    return Machine(plant, Actuator(limit=limit, resolution=2 * limit / 2**16), sensor)


def position_gain(drive: BallScrewDrive) -> float:
    """The gain C_P of the position loop [V/mm]."""
    return POSITION_GAIN / float(drive.command_scale)


@jax.jit
def linear_model(drive: BallScrewDrive) -> StateSpace:
    """The drive as a linear model for the model-based schemes, at 4 kHz.

    It is compiled as one program, since operation by operation there would be ninety programs.
    """
    return drive.linear(DT)


def direct_ilc(drive: BallScrewDrive) -> WithFeedback:
    """DILC learns from the error of the table, with the position loop on the motor."""
    gain = position_gain(drive)
    learning = NormOptimal(direct_model(gain, linear_model(drive)), **WEIGHTS)
    return WithFeedback(OnOutputs(learning, (1,)), OnOutputs(PID(kp=gain), (0,)))


def multivariable_ilc(drive: BallScrewDrive) -> MultivariableILC:
    """MILC learns control and reference from both errors."""
    gain, model = position_gain(drive), linear_model(drive)
    learning = NormOptimal(multivariable_model(gain, model), **WEIGHTS)
    return MultivariableILC(
        learning, PID(kp=gain), prefilter=inverse(output_ratio(drive.mechanics(), DT))
    )


def path(of: Reading) -> np.ndarray:
    """(N+1,) the reference of a reading [mm]: a rest, then a stroke forward and back.

    The prefilter needs the rest to start early.
    """
    move = references.s_curve(
        [0.0, of.stroke, 0.0], velocity=of.velocity, acceleration=of.acceleration, jerk=of.jerk,
        dwell=of.dwell, dt=DT, duration=2.0,
    )  # fmt: skip
    return np.concatenate([np.zeros(round(REST / DT)), move])[: round(DURATION / DT) + 1]


def milc_2024(axis: str = "x", reading: str = "short-stroke") -> Scenario:
    """The experiments of MILC 2024, section 5: a trial with feedback only, then ten more, 4 kHz.

    axis: `x` with a screw of 10 mm pitch, or `z` with one of 12 mm
    reading: `long-stroke`, 10 mm at 69 mm/s, or `short-stroke`, 5 mm at 192 mm/s and another unit
        of the input, which meets the largest errors too
    Raises ValueError for another axis or reading.
    """
    need_one_of("milc-2024", "axis", axis, PITCH)
    of = READINGS[reading]
    drive, r = nominal_drive(of.antiresonance, of.force_gain, of.unit), path(of)
    return Scenario(
        **printed("milc-2024", reading),
        machine=real_machine(drive, of.noise, PITCH[axis]),
        task=Task(reference=np.stack([r, r], axis=1), dt=DT, inputs=1, unit="mm", input_unit="V"),
        schemes={"dilc": direct_ilc(drive), "milc": multivariable_ilc(drive)},
        uncertainty={
            f"plant.{name}": Uniform(0.9, 1.1, relative=True)
            for name in ("stiffness", "table_mass", "motor_mass", "force_gain")
        },
        tolerance=1.0,
        shown_unit="µm",
        shown_scale=1e3,
        show_trials=(1, 2, 3, 4, 6, 8, 11),
        quantities={
            "table_rms": Quantity(table_rms),
            "table_max": Quantity(table_max),
            "motor_rms": Quantity(partial(motor_rms, gain=position_gain(drive))),
            "feedback_effort": Quantity(feedback_effort, "V", 1.0),
        },
        judged_by="table_rms",
    )


def table_rms(trial) -> jax.Array:
    """Root mean square error of the table."""
    return root_mean_square(trial.e[1:, 1:])[0]


def table_max(trial) -> jax.Array:
    """Largest error of the table."""
    return largest(jnp.abs(trial.e[1:, 1]))


def motor_rms(trial, *, gain) -> jax.Array:
    """Root mean square of the position loop's error r_j - y_M: its input divided by its gain."""
    return feedback_effort(trial) / gain


def feedback_effort(trial) -> jax.Array:
    """Root mean square of the feedback's share of the input."""
    return root_mean_square(trial.signals["feedback"])[0]
