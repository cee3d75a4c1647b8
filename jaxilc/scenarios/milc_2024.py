"""MILC 2024: a flexible ball-screw drive under direct and multivariable norm-optimal ILC.

Multivariable Iterative Learning Control Design for Precision Control of Flexible Feed Drives,
Sensors 24 (2024), section 5. Lengths in mm, input in V, errors shown in µm. The paper counts trials
from 0; its trial 10 is the eleventh here.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

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
from ..schemes import PID, MultivariableILC, NormOptimal, OnOutputs, WithFeedback
from ..signals import references
from ..signals.task import Task
from ..uncertainty import Uniform
from .published import Fit, Published
from .scenario import Quantity, Scenario

DT = 1 / 4000
POSITION_GAIN = 180.0  # K_pp [1/s]
WEIGHTS: dict[str, Any] = {"w_q": 2e6, "w_r": 1e-4, "w_s": 20.0}
PITCH = {"x": 10.0, "z": 12.0}  # [mm]
PULSE = 52e-6 / (2 * np.pi)  # step of the motor's encoder [revolutions]
TABLE_STEP = 0.25e-3  # step of the linear encoder [mm]

# Fitted to three numbers of the DILC row (experiments/milc_2024_calibration.py): 201.00, 5.39 and
# 0.55 µm.
FITTED = {"velocity": 68.71, "antiresonance": 77.28, "noise": 0.5236e-3}  # [mm/s], [Hz], [mm]
# Force gain [N/V]; gives the motor's position loop a bandwidth of 50 Hz (-3 dB) with this
# antiresonance.
FORCE_GAIN = 113.8

TABLE_1 = {
    "dilc": {
        (1, "table_rms"): 201.00,
        (1, "motor_rms"): 204.21,
        (11, "table_rms"): 0.55,
        (11, "motor_rms"): 5.39,
        (11, "table_max"): 3.57,
    },
    "milc": {
        (1, "table_rms"): 196.46,
        (1, "motor_rms"): 199.81,
        (11, "table_rms"): 0.46,
        (11, "motor_rms"): 0.40,
        (11, "table_max"): 2.06,
    },
}
FITTED_ROWS = {("dilc", 1, "table_rms"), ("dilc", 11, "table_rms"), ("dilc", 11, "motor_rms")}


IMPROVEMENT = 42.0  # of the largest error of the table by MILC over DILC, section 5.2 [%]


def _row(
    scheme: str, trial: int, quantity: str, value: float, source="Table 1", against=""
) -> Published:
    fit = Fit(
        tuple(FITTED), "three numbers of the DILC row", (scheme, trial, quantity) in FITTED_ROWS
    )
    return Published(
        scheme,
        trial,
        quantity,
        value,
        source,
        (("axis", "x"),),
        f"the paper's trial {trial - 1}",
        fitted=fit,
        against=against,
    )


PUBLISHED = (
    *(
        _row(scheme, trial, quantity, value)
        for scheme, rows in TABLE_1.items()
        for (trial, quantity), value in rows.items()
    ),
    _row("milc", 11, "table_max_improvement", IMPROVEMENT, "section 5.2", "dilc"),
)

CHOSEN = (
    "masses, stiffness, damping and force gain are not printed: 30 kg on each side, 3 % damping, "
    "a torque filter of 350 Hz and a force "
    "gain that makes the position loop 50 Hz wide, as printed; the antiresonance is fitted",
    "the path is printed as a picture: an S-curve of 10 mm and back at 6 m/s^2 and 600 m/s^3 with "
    "0.3 s of rest; its velocity is fitted",
    "the input's unit is not printed and decides how the weights act: 50 mm/s per volt",
    "noise is not printed: white, its standard deviation on the table fitted, on the motor's "
    "encoder a third of it, as their steps are",
    "the model knows the drive but for what a model leaves out: the table weighs 10 % more, "
    "friction of 20 N that the look-up table "
    "compensates to 90 %, a lead error of 2 µm a revolution, encoders and converter",
    "the motor's error under MILC is that of the learned reference (eq. 25), under DILC that of "
    "the desired path",
)


def nominal_drive(antiresonance: float, force_gain: float) -> BallScrewDrive:
    """The drive as the model describes it.

    antiresonance: frequency of the antiresonance [Hz]
    force_gain: gain from the command to the force [N/V]
    """
    table_mass = 30.0
    stiffness = table_mass * (2 * jnp.pi * antiresonance) ** 2
    return BallScrewDrive(
        motor_mass=30.0,
        table_mass=table_mass,
        stiffness=stiffness,
        damping=2 * 0.03 * jnp.sqrt(stiffness * table_mass),
        motor_damping=20.0,
        table_damping=20.0,
        force_gain=force_gain,
        force_limit=1500.0,
        current_bandwidth=350.0,
        command_scale=50.0,
    )


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
    return Machine(plant, Actuator(limit=10.0, resolution=20.0 / 2**16), sensor)


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


def path(velocity: float) -> np.ndarray:
    """The reference path: 25 ms of rest, then a stroke forward and back.

    The prefilter needs the rest to start early.

    velocity: velocity of the stroke [mm/s]
    """
    move = references.s_curve(
        [0.0, 10.0, 0.0],
        velocity=velocity,
        acceleration=6e3,
        jerk=6e5,
        dwell=0.3,
        dt=DT,
        duration=0.975,
    )
    return np.concatenate([np.zeros(100), move])


def milc_2024(axis: str = "x") -> Scenario:
    """The experiments of MILC 2024, section 5: a trial with feedback only, then ten more, 4 kHz.

    axis: `x` with a screw of 10 mm pitch, or `z` with one of 12 mm
    Raises ValueError for another axis.
    """
    if axis not in PITCH:
        raise ValueError(f"milc-2024: axis = {axis!r} is not one of 'x', 'z'")
    drive = nominal_drive(FITTED["antiresonance"], FORCE_GAIN)
    r = path(FITTED["velocity"])
    return Scenario(
        name="milc-2024",
        title="Flexible ball-screw drive, direct and multivariable norm-optimal ILC (MILC 2024)",
        machine=real_machine(drive, FITTED["noise"], PITCH[axis]),
        task=Task(reference=np.stack([r, r], axis=1), dt=DT, inputs=1, unit="mm", input_unit="V"),
        schemes={"dilc": direct_ilc(drive), "milc": multivariable_ilc(drive)},
        trials=11,
        uncertainty={
            f"plant.{name}": Uniform(0.9, 1.1, relative=True)
            for name in ("stiffness", "table_mass", "motor_mass", "force_gain")
        },
        published=PUBLISHED,
        chosen=CHOSEN,
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
