"""Cao 2019, section V: the laboratory rig, CFDL-MFAILC against PID at five frequencies.

The machine is the physical motor with its drive, not the identified model, since in the experiment
the loop gains are positive. Lengths in mm, input in V, errors shown in µm.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from ..filters.zero_phase import ZeroPhaseButterworth
from ..learning.machine import Actuator, Disturbance, Machine, Sensor
from ..plants import StribeckFriction, voice_coil_motor
from ..pytree.ranges import require
from ..schemes import CFDLMFAILC, PID, Filtered, Scheme, WithFeedback
from ..signals import references
from ..signals.task import Task
from ..uncertainty import Uniform
from .published import Readings, printed
from .scenario import Scenario

LAM, ETA, MU, RHO, PHI0 = 1.5, 1.0, 1.0, 1.0, 1.0  # printed


# By reading, the constant voltage at the input of the drive [V], fitted, and then four steps of the
# 16-bit converter; or none.
OFFSETS = Readings("cao-2019-rig", lambda offset: offset)


def cao_2019_rig(
    frequency: float = 0.5, reading: str = "within-samples", passes: float = 2.0
) -> Scenario:
    """The experiments of Cao 2019: 1 mm, 1 ms, trials of 10 s, with friction.

    The encoder has steps of 0.1 µm, the converter 16 bits for ±10 V.

    frequency: frequency of the sinusoid [Hz], with a whole number of periods in 10 s
    reading: `over-trials`, CFDL-MFAILC learns from trial to trial over PID, behind a filter; or
        `within-samples`, its iterations run within each sample, and the drive has an offset
    passes: steps of eq. 12 within a sample, under `within-samples`; 2 are chosen among 1, 2 and 3,
        and the paper prints 80. The scheme is then a P controller of 0.4 `passes` V/mm
    Raises ValueError for a frequency outside [0.01, 5], another reading, or passes that are
        not whole numbers in [1, 1000].
    """
    require("cao-2019-rig", "frequency", frequency, "[0.01, 5]", " Hz")
    require(
        "cao-2019-rig", "passes", passes if passes % 1 else int(passes), "[1, 1000]", whole=True
    )
    offset = OFFSETS[reading]
    motor = dataclasses.replace(
        voice_coil_motor(),
        command_scale=3.44 / 10.0,
        holding_gain=0.0,
        friction=StribeckFriction(coulomb_force=20.0, static_force=30.0, transition_velocity=2e-3),
    )
    pid = PID(kp=0.29, ki=0.006)
    r = references.sinusoid(1.0, frequency, duration=10.0, dt=1e-3)
    drift = Disturbance(input=np.full((len(r) - 1, 1), offset)) if offset else None
    return Scenario(
        **printed(
            "cao-2019-rig",
            reading,
            title=f"Voice-coil motor on the laboratory rig at {frequency:g} Hz (Cao 2019)",
        ),
        machine=Machine(
            motor, Actuator(limit=10.0, resolution=20.0 / 2**16), Sensor(resolution=1e-4), drift
        ),
        task=Task(reference=r, dt=1e-3, unit="mm", input_unit="V"),
        schemes={"pid": pid, "cfdl-mfailc": cfdl_mfailc(reading, pid, passes)},
        uncertainty={
            name: Uniform(0.9, 1.1, relative=True)
            for name in (
                "plant.mass",
                "plant.command_scale",
                "plant.friction.coulomb_force",
                "plant.speed_gain",
            )
        },
        tolerance=5.0,
        shown_unit="µm",
        shown_scale=1e3,
        show_trials=(1, 2, 3, 5, 10, 20, 40, 80),
    )


def cfdl_mfailc(reading: str, pid: PID, passes: float) -> Scheme:
    """CFDL-MFAILC with the printed weights under a reading.

    Within a sample e does not change, and neither does the estimate, by less than 0.1 % for the
    errors of the rig; the steps of eq. 12 then add up to rho phi / (lam + phi^2) e each.
    """
    if reading == "within-samples":
        return PID(kp=passes * RHO * PHI0 / (LAM + PHI0**2))
    law = CFDLMFAILC(lam=LAM, eta=ETA, mu=MU, rho=RHO, phi0=PHI0, reset="sign")
    return WithFeedback(Filtered(law, ZeroPhaseButterworth(6.0, padding=300)), pid)
