"""Cao 2019: a voice-coil motor for noncircular turning under model-free adaptive iterative learning control.

Cao, Hou, Zhao, Zhang: Model Free Adaptive Iterative Learning Control for Tool Feed System in Noncircular Turning,
IEEE Access 7 (2019). Lengths in mm, input in V, errors shown in µm.
"""

from __future__ import annotations

from .. import references
from ..machine import Machine
from ..plants import voice_coil
from ..schemes import CFDLMFAILC, FFDLMFAILC, PFDLMFAILC, PID
from ..signals import Task
from ..uncertainty import Uniform
from .scenario import Published, Scenario

TABLE_1 = {
    "cfdl-mfailc": {20: 18.0, 30: 11.0, 40: 5.5, 50: 2.5, 60: 1.5, 70: 0.5, 80: 0.3},
    "ffdl-mfailc": {20: 13.0, 30: 2.5, 40: 0.5, 50: 0.2, 60: 0.15, 70: 0.15, 80: 0.15},
}

PUBLISHED = (
    *(Published(s, j, "settled_error", v, "Table 1") for s, rows in TABLE_1.items() for j, v in rows.items()),
    Published("cfdl-mfailc", 35, "max_error", 10.0, "section IV-A"),
    Published("pid", None, "max_error", 30.0, "section IV-C"),
    Published("pid", None, "settled_error", 23.0, "section IV-C"),
)

CHOSEN = (
    "phi0 of CFDL, PFDL and FFDL is not printed: -0.065, (-0.065, 0) and (0.5, 0, -0.06, 0) were chosen by hand so that the "
    "tables are met in shape on the printed plant; all other weights are printed",
    "steady-state error is read as max |e| over the second half of the trial",
    "PID is read in position form with ki multiplied by the sample time",
    "estimates are reset as in Dai 2014, eq. 12 (mode `book`); Cao 2019 prints no reset",
    "PFDL-MFAILC is not in the paper; it has the weights of FFDL",
)


def cao_2019(plant: str = "exact", reference: str = "sinusoid", frequency: float = 0.5) -> Scenario:
    """The simulations of Cao 2019, section IV: 1 mm at 0.5 Hz, 1 ms, one period a trial.

    plant: `exact` (eq. 7), `printed` (eq. 29) or `dai_2014_printed`
    reference: `sinusoid`, or `piston`, the middle-convex varying-oval piston of eq. 28, whose ellipse turns at `frequency` / 2
    frequency: of the tool's motion [Hz]
    Raises ValueError for another plant or reference, or a frequency that does not fit the sample time.
    """
    dt = 1e-3
    if not 0 < frequency <= 50:
        raise ValueError(f"cao-2019: frequency = {frequency:g} Hz is outside its allowed range (0, 50]")
    match reference:
        case "sinusoid":
            r = references.sinusoid(1.0, frequency, duration=round(1 / frequency / dt) * dt, dt=dt)
        case "piston":
            r = references.noncircular(
                duration=round(4 / frequency / dt) * dt,
                dt=dt,
                spindle_speed=frequency / 2,
                feed=0.5,
                ellipticity=(0.4, 0.6),
                bulge=0.1,
                length=1.0,
            )
        case _:
            raise ValueError(f"cao-2019: reference = {reference!r} is not one of 'sinusoid', 'piston'")
    return Scenario(
        name="cao-2019",
        title="Voice-coil motor for noncircular turning, MFAILC (Cao 2019)",
        machine=Machine(voice_coil(plant)),
        task=Task(reference=r, dt=dt, unit="mm", input_unit="V"),
        schemes={"pid": PID(kp=-11.3, ki=-0.028), "cfdl-mfailc": CFDLMFAILC(), "pfdl-mfailc": PFDLMFAILC(), "ffdl-mfailc": FFDLMFAILC()},
        trials=80,
        uncertainty=_uncertainty(plant),
        published=PUBLISHED if (reference, frequency) == ("sinusoid", 0.5) else (),
        chosen=CHOSEN,
        tolerance=5.0,
        shown_unit="µm",
        shown_scale=1e3,
        show_trials=(1, 2, 5, 10, 20, 30, 40, 50, 60, 70, 80),
    )


def _uncertainty(plant: str) -> dict[str, Uniform]:
    """±10 % on what identification leaves uncertain; the rounded difference equations only allow their gain to move, since a change
    of 10 % in a coefficient of `a` would be another motor."""
    names = ("plant.gain", "plant.zero", "plant.poles[0]", "plant.poles[1]", "plant.poles[2]") if plant == "exact" else ("plant.b",)
    return {name: Uniform(0.9, 1.1, relative=True) for name in names}
