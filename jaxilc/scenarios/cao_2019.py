"""Cao 2019: a voice-coil motor for noncircular turning under model-free adaptive ILC.

Cao, Hou, Zhao, Zhang: Model Free Adaptive Iterative Learning Control for Tool Feed System in
Noncircular Turning, IEEE Access 7 (2019). Lengths in mm, input in V, errors shown in µm.
"""

from __future__ import annotations

from ..learning.machine import Machine
from ..plants import voice_coil
from ..pytree.ranges import require
from ..schemes import CFDLMFAILC, CFDLMFAPC, FFDLMFAILC, PFDLMFAILC, PID, PIDType, WithFeedback
from ..signals import references
from ..signals.task import Task
from ..uncertainty import Uniform
from .published import NOTHING, Fit, Published
from .scenario import Scenario

TABLE_1 = {
    "cfdl-mfailc": {20: 18.0, 30: 11.0, 40: 5.5, 50: 2.5, 60: 1.5, 70: 0.5, 80: 0.3},
    # "no change" after 60
    "ffdl-mfailc": {20: 13.0, 30: 2.5, 40: 0.5, 50: 0.2, 60: 0.15, 70: 0.15, 80: 0.15},
}

# The trials to which phi0 was fitted; the others test the fit.
FITTED = {"cfdl-mfailc": (20, 40, 60, 80), "ffdl-mfailc": (20, 40, 60)}
FITTED_MFAPC = Fit(("phi0",), "its four rows", among=True)
ON_PRINTED_PLANT = (("plant", "printed"),)
PID_READING = "ki multiplied by the sample time"
MFAILC_READING = "eq. 29's plant; second half of the trial; reset `sign`"
MFAPC_READING = (
    "gains take the plant's sign; lam read as lam / P; "
    "of 16 readings the one nearest to the four rows"
)


def _fit(scheme: str, trial: int, quantity: str = "settled_error") -> Fit:
    names = ("phi0",) if scheme == "cfdl-mfailc" else tuple(f"phi0[{i}]" for i in range(4))
    to = f"its rows of Table 1 at trials {', '.join(map(str, FITTED[scheme]))}"
    return Fit(names, to, quantity == "settled_error" and trial in FITTED[scheme])


def _row(
    scheme: str,
    trial: int | None,
    quantity: str,
    value: float,
    source: str,
    reading: str,
    fitted: Fit,
) -> Published:
    return Published(
        scheme, trial, quantity, value, source, ON_PRINTED_PLANT, reading, fitted=fitted
    )


PUBLISHED = (
    *(
        _row(s, j, "settled_error", v, "Table 1", MFAILC_READING, _fit(s, j))
        for s, rows in TABLE_1.items()
        for j, v in rows.items()
    ),
    _row(
        "cfdl-mfailc",
        35,
        "max_error",
        10.0,
        "section IV-A",
        "over the whole trial, its start included",
        _fit("cfdl-mfailc", 35, "max_error"),
    ),
    *(
        _row("ilc-mfapc", j, "settled_error", v, "section IV-D", MFAPC_READING, FITTED_MFAPC)
        for j, v in {10: 8.0, 15: 1.5, 20: 0.3, 30: 0.3}.items()
    ),
    _row("pid", None, "max_error", 30.0, "section IV-C", PID_READING, NOTHING),
    _row("pid", None, "settled_error", 23.0, "section IV-C", PID_READING, NOTHING),
)

CHOSEN = (
    "phi0 of CFDL- and FFDL-MFAILC is not printed: one number was fitted to 4 rows of Table 1 and "
    "judged on 3, four numbers to 3 rows "
    "and judged on 2 (experiments/cao_2019_start_values.py); PFDL-MFAILC is not in the paper and "
    "has FFDL's weights",
    "steady-state error is read as max |e| over the second half of the trial",
    "the estimate is reset where its sign turns (mode `sign`); Cao 2019 prints no reset",
    "PID is read in position form with ki multiplied by the sample time",
    "ILC-MFAPC: the learning gains are given the plant's sign, lam = 2 is read as lam / P, phi0 = "
    "-0.00064 is fitted to its rows",
)


def cao_2019(plant: str = "exact", reference: str = "sinusoid", frequency: float = 0.5) -> Scenario:
    """The simulations of Cao 2019, section IV: 1 mm at 0.5 Hz, 1 ms, one period in each trial.

    plant: `exact` (eq. 7), `printed` (eq. 29) or `dai_2014_printed`
    reference: `sinusoid`, or `piston`, the middle-convex varying-oval piston of eq. 28, whose
        ellipse turns at `frequency` / 2
    frequency: frequency of the tool's motion [Hz]
    Raises ValueError for another plant or reference, or a frequency that does not fit the sample
    time.
    """
    dt = 1e-3
    require("cao-2019", "frequency", frequency, "[0.01, 50]", " Hz")
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
            raise ValueError(
                f"cao-2019: reference = {reference!r} is not one of 'sinusoid', 'piston'"
            )
    return Scenario(
        name="cao-2019",
        title="Voice-coil motor for noncircular turning, MFAILC (Cao 2019)",
        machine=Machine(voice_coil(plant)),
        task=Task(reference=r, dt=dt, unit="mm", input_unit="V"),
        schemes={
            "pid": PID(kp=-11.3, ki=-0.028),
            "cfdl-mfailc": CFDLMFAILC(
                lam=1.0, eta=0.9, mu=1.0, rho=1.0, phi0=-0.0682, reset="sign"
            ),
            "pfdl-mfailc": PFDLMFAILC(
                lam=1.2, eta=1.0, mu=1.1, rho=0.98, phi0=(-0.0682, 0.0), reset="sign"
            ),
            "ffdl-mfailc": FFDLMFAILC(
                lam=1.2,
                eta=1.0,
                mu=1.1,
                rho=0.98,
                phi0=(0.753, -0.0547, -0.0811, 0.498),
                reset="sign",
            ),
            "ilc-mfapc": WithFeedback(
                learning=PIDType(gamma_p=-0.2, gamma_i=0.0, gamma_d=-1.0),
                feedback=CFDLMFAPC(P=10, lam=20.0, eta=0.9, mu=1.0, phi0=-0.00064),
            ),
        },
        trials=80,
        uncertainty=motor_uncertainty(plant),
        published=PUBLISHED if (reference, frequency) == ("sinusoid", 0.5) else (),
        chosen=CHOSEN,
        tolerance=5.0,
        shown_unit="µm",
        shown_scale=1e3,
        show_trials=(1, 2, 5, 10, 15, 20, 30, 40, 50, 60, 70, 80),
    )


def motor_uncertainty(plant: str) -> dict[str, Uniform]:
    """An uncertainty of ±10 % on the parameters that identification leaves uncertain.

    Of the rounded difference equations only the gain is varied, since with a change of 10 % in a
    coefficient of `a` it would be another motor.
    """
    names = (
        ("plant.gain", "plant.zero", "plant.poles[0]", "plant.poles[1]", "plant.poles[2]")
        if plant == "exact"
        else ("plant.b",)
    )
    return {name: Uniform(0.9, 1.1, relative=True) for name in names}
