"""Dai 2014: the voice-coil motor of Cao 2019 under predictive MFAC, against PID.

MFAC is model-free adaptive control. Lengths are in units of the reference's amplitude (1 mm), the
input in V. Nothing is learned: there is one trial of several periods, and the errors are those of
the last period but one.
"""

from __future__ import annotations

from typing import Any

from ..learning.machine import Machine
from ..plants import voice_coil
from ..schemes import CFDLMFAPC, PID
from ..signals import references
from ..signals.task import Task
from .cao_2019 import motor_uncertainty
from .published import NOTHING, Fit, Published
from .scenario import Scenario

# By frequency [Hz]: periods simulated; PID gains, prediction horizon P and weight lam as printed;
# phi0 as chosen.
SETTINGS: dict[float, dict[str, Any]] = {
    0.5: {
        "periods": 4,
        "pid": {"kp": -10.0, "ki": 0.1},
        "mfapc": {"P": 10, "lam": 45.0, "phi0": -0.12},
    },
    2.5: {
        "periods": 10,
        "pid": {"kp": -9.0, "ki": -0.2, "kd": 1e-3},
        "mfapc": {"P": 250, "lam": 8700.0, "phi0": -0.238},
    },
}

PID_READING = "eq. 29's plant; ki multiplied by the sample time"
MFAPC_READING = "eq. 29's plant; the reference is previewed and goes on beyond the settled window"


def _row(scheme: str, frequency: float, value: float, source: str, reading: str) -> Published:
    fitted = Fit(("phi0",), "this row alone", among=True) if scheme == "cfdl-mfapc" else NOTHING
    options = (("plant", "printed"), ("frequency", frequency))
    searched = "experiments/dai_2014_readings.py" if scheme == "cfdl-mfapc" else ""
    return Published(
        *(scheme, None, "settled_error", value, source, options, reading),
        fitted=fitted,
        searched=searched,
    )


PUBLISHED = (
    _row("pid", 0.5, 0.023, "Fig. 3", PID_READING),
    _row("cfdl-mfapc", 0.5, 0.0165, "Fig. 5", MFAPC_READING),
    _row(
        "pid",
        2.5,
        0.061,
        "Fig. 7",
        PID_READING + ", and negative, since the printed 0.2 has the wrong sign; kd per sample",
    ),
    _row(
        "cfdl-mfapc",
        2.5,
        0.047,
        "Fig. 9",
        MFAPC_READING + "; the loop is at its stability limit, its error erratic in phi0",
    ),
)

CHOSEN = (
    "phi0 of CFDL-MFAPC is not printed: -0.12 at 0.5 Hz and -0.238 at 2.5 Hz, one number for one "
    "printed number each",
    "the forecast of the PPD starts from theta = (1, 0, 0); with P_u = 1, which the paper allows "
    "and does not state, it is not used",
    "the error is that of the settled part, as the paper reads it off at the ends of the stroke",
)


def dai_2014(plant: str = "exact", frequency: float = 0.5) -> Scenario:
    """The simulations of Dai 2014, section 3.

    plant: `exact`, `printed` (Cao 2019, eq. 29) or `dai_2014_printed` (eq. 24)
    frequency: frequency of the reference, 0.5 or 2.5 [Hz]
    Raises ValueError for another plant or frequency.
    """
    if frequency not in SETTINGS:
        raise ValueError(f"dai-2014: frequency = {frequency:g} Hz is not one of 0.5, 2.5")
    dt, period = 1e-3, round(1000 / frequency) * 1e-3
    setting = SETTINGS[frequency]
    duration = setting["periods"] * period
    return Scenario(
        name="dai-2014",
        title=f"Voice-coil motor under predictive MFAC at {frequency:g} Hz (Dai 2014)",
        machine=Machine(voice_coil(plant)),
        task=Task(
            reference=references.sinusoid(1.0, frequency, duration=duration, dt=dt),
            dt=dt,
            # At the end of the last period there is no further reference to preview.
            settle=(duration - 2 * period, duration - period),
            unit="mm",
            input_unit="V",
        ),
        schemes={"pid": PID(**setting["pid"]), "cfdl-mfapc": CFDLMFAPC(**setting["mfapc"])},
        trials=1,
        uncertainty=motor_uncertainty(plant),
        published=PUBLISHED,
        chosen=CHOSEN,
        tolerance=0.03,
        shown_unit="mm",
        show_trials=(1,),
    )
