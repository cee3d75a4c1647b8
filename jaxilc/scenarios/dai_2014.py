"""Dai 2014: the voice-coil motor of Cao 2019 under predictive MFAC, against PID.

MFAC is model-free adaptive control. Lengths are in units of the reference's amplitude (1 mm), the
input in V. Nothing is learned: there is one trial of several periods, and the errors are those of
the last period but one.
"""

from __future__ import annotations

from typing import NamedTuple

from ..learning.machine import Machine
from ..plants import voice_coil
from ..pytree.aliases import Leaf
from ..schemes import CFDLMFAPC, PID
from ..signals import references
from ..signals.task import Task
from .cao_2019 import MOTOR_UNCERTAINTY
from .published import printed
from .scenario import Scenario


class Setting(NamedTuple):
    """Periods simulated; gains, prediction horizon P and weight lam as printed; phi0 as chosen."""

    periods: int
    pid: dict[str, Leaf]
    mfapc: dict[str, Leaf]


SETTINGS = {  # by frequency [Hz]
    0.5: Setting(4, {"kp": -10.0, "ki": 0.1}, {"P": 10, "lam": 45.0, "phi0": -0.12}),
    2.5: Setting(
        10, {"kp": -9.0, "ki": 0.2, "kd": 1e-3}, {"P": 250, "lam": 8700.0, "phi0": -0.238}
    ),
}


def dai_2014(plant: str = "printed", frequency: float = 0.5) -> Scenario:
    """The simulations of Dai 2014, section 3.

    plant: `printed` (Cao 2019, eq. 29), `exact` (its eq. 7) or `dai_2014_printed` (eq. 24)
    frequency: frequency of the reference, 0.5 or 2.5 [Hz]
    Raises ValueError for another plant or frequency.
    """
    if frequency not in SETTINGS:
        raise ValueError(f"dai-2014: frequency = {frequency:g} Hz is not one of 0.5, 2.5")
    dt, period = 1e-3, round(1000 / frequency) * 1e-3
    setting = SETTINGS[frequency]
    duration = setting.periods * period
    return Scenario(
        **printed(
            "dai-2014",
            title=f"Voice-coil motor under predictive MFAC at {frequency:g} Hz (Dai 2014)",
        ),
        machine=Machine(voice_coil(plant)),
        task=Task(
            reference=references.sinusoid(1.0, frequency, duration=duration, dt=dt),
            dt=dt,
            # At the end of the last period there is no further reference to preview.
            settle=(duration - 2 * period, duration - period),
            unit="mm",
            input_unit="V",
        ),
        schemes={"pid": PID(**setting.pid), "cfdl-mfapc": CFDLMFAPC(**setting.mfapc)},
        uncertainty=MOTOR_UNCERTAINTY,
        tolerance=0.03,
        shown_unit="mm",
        show_trials=(1,),
    )
