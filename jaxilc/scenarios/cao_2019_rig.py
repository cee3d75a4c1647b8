"""Cao 2019, section V: the laboratory rig, CFDL-MFAILC against PID at five frequencies.

The machine is the physical motor with its drive, not the identified model, since in the experiment
the loop gains are positive. Lengths in mm, input in V, errors shown in µm.
"""

from __future__ import annotations

import dataclasses

from ..filters.zero_phase import ZeroPhaseButterworth
from ..learning.machine import Actuator, Machine, Sensor
from ..plants import StribeckFriction, voice_coil_motor
from ..pytree.ranges import require
from ..schemes import CFDLMFAILC, PID, Filtered, WithFeedback
from ..signals import references
from ..signals.task import Task
from ..uncertainty import Uniform
from .published import NOTHING, Published
from .scenario import Scenario

TABLE_2 = {
    0.1: (4.0, 10.0),
    0.2: (7.0, 15.0),
    0.3: (9.0, 19.0),
    0.4: (12.0, 23.0),
    0.5: (16.0, 28.0),
}  # Hz: CFDL, PID [µm]
PID_READING = "10 V command the printed top speed of 3.44 m/s"
CFDL_READING = "over the printed PID, with a 6 Hz zero-phase filter; without them it diverges"

PUBLISHED = tuple(
    Published(
        scheme,
        trial,
        "settled_error",
        value,
        "Table 2",
        (("frequency", frequency),),
        reading,
        fitted=NOTHING,
    )
    for frequency, (learned, plain) in TABLE_2.items()
    for scheme, trial, value, reading in (
        ("cfdl-mfailc", 80, learned, CFDL_READING),
        ("pid", None, plain, PID_READING),
    )
)

CHOSEN = (
    "the drive's scale is not printed: 10 V is read as the printed top speed of 3.44 m/s",
    "friction is not printed: 20 N Coulomb, 30 N static",
    "CFDL-MFAILC by itself diverges on a velocity-controlled drive, whose position integrates: it "
    "learns here over the printed PID, with "
    "a zero-phase filter of 6 Hz; the printed rig may have iterated within each sample instead "
    "(its Simulink For-iterator block)",
)


def cao_2019_rig(frequency: float = 0.5) -> Scenario:
    """The experiments of Cao 2019: 1 mm, 1 ms, trials of 10 s, with friction.

    The encoder has steps of 0.1 µm, the converter 16 bits for ±10 V.

    frequency: frequency of the sinusoid [Hz], with a whole number of periods in 10 s
    Raises ValueError for a frequency outside [0.01, 5].
    """
    require("cao-2019-rig", "frequency", frequency, "[0.01, 5]", " Hz")
    motor = dataclasses.replace(
        voice_coil_motor(),
        command_scale=3.44 / 10.0,
        holding_gain=0.0,
        friction=StribeckFriction(coulomb_force=20.0, static_force=30.0, transition_velocity=2e-3),
    )
    pid = PID(kp=0.29, ki=0.006)
    learning = CFDLMFAILC(lam=1.5, eta=1.0, mu=1.0, rho=1.0, phi0=1.0, reset="sign")
    return Scenario(
        name="cao-2019-rig",
        title=f"Voice-coil motor on the laboratory rig at {frequency:g} Hz (Cao 2019)",
        machine=Machine(
            motor, Actuator(limit=10.0, resolution=20.0 / 2**16), Sensor(resolution=1e-4)
        ),
        task=Task(
            reference=references.sinusoid(1.0, frequency, duration=10.0, dt=1e-3),
            dt=1e-3,
            unit="mm",
            input_unit="V",
        ),
        schemes={
            "pid": pid,
            "cfdl-mfailc": WithFeedback(
                Filtered(learning, ZeroPhaseButterworth(6.0, padding=300)), pid
            ),
        },
        trials=80,
        uncertainty={
            name: Uniform(0.9, 1.1, relative=True)
            for name in (
                "plant.mass",
                "plant.command_scale",
                "plant.friction.coulomb_force",
                "plant.speed_gain",
            )
        },
        published=PUBLISHED,
        chosen=CHOSEN,
        tolerance=5.0,
        shown_unit="µm",
        shown_scale=1e3,
        show_trials=(1, 2, 3, 5, 10, 20, 40, 80),
    )
