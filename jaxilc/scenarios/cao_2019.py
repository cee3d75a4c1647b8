"""Cao 2019: a voice-coil motor for noncircular turning under model-free adaptive ILC.

Cao, Hou, Zhao, Zhang: Model Free Adaptive Iterative Learning Control for Tool Feed System in
Noncircular Turning, IEEE Access 7 (2019). Lengths in mm, input in V, errors shown in µm.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..learning.machine import Machine
from ..learning.metrics import largest
from ..plants import voice_coil
from ..pytree.aliases import Leaf
from ..pytree.ranges import need_one_of, require
from ..schemes import (
    CFDLMFAILC,
    CFDLMFAPC,
    FFDLMFAILC,
    PFDLMFAILC,
    PID,
    PIDType,
    Scheme,
    WithFeedback,
)
from ..signals import references
from ..signals.task import Task
from ..uncertainty import Uniform
from .published import Readings, printed
from .scenario import Quantity, Scenario


class Reading(NamedTuple):
    """A reading of section IV, and the start values of the estimates fitted under it.

    settled_from: eighths of the trial after which its errors count as settled
    windows: quantity by scheme whose steady-state error is read off from another sample on, and
        the eighths of the trial after which it is
    reset: reset of the estimates of MFAILC, see `reset_estimate`
    lam: lam of ILC-MFAPC
    phi0: start value by scheme [mm/V]
    """

    settled_from: int
    windows: dict[str, tuple[str, int]]
    reset: str
    lam: float
    phi0: dict[str, Leaf]


READINGS = Readings("cao-2019", Reading)
# What identification leaves uncertain, by 10 %.
MOTOR_UNCERTAINTY = {
    name: Uniform(0.9, 1.1, relative=True)
    for name in ("plant.gain", "plant.zero", *(f"plant.poles[{i}]" for i in range(3)))
}


def cao_2019(
    plant: str = "printed",
    reference: str = "sinusoid",
    frequency: float = 0.5,
    reading: str = "stroke",
) -> Scenario:
    """The simulations of Cao 2019, section IV: 1 mm at 0.5 Hz, 1 ms, one period in each trial.

    plant: `printed` (eq. 29, which the paper simulates), `exact` (eq. 7) or `dai_2014_printed`
    reference: `sinusoid`, or `piston`, the middle-convex varying-oval piston of eq. 28, whose
        ellipse turns at `frequency` / 2
    frequency: frequency of the tool's motion [Hz]
    reading: `stroke`, 0.5 (1 - cos) mm whose settled part begins after 5/8 of the trial, or
        `amplitude`, a sine of amplitude 1 mm whose settled part is the second half; each has its
        own start values of the estimates, and its own reset
    Raises ValueError for another plant, reference or reading, or a frequency that does not fit the
    sample time.
    """
    require("cao-2019", "frequency", frequency, "[0.01, 50]", " Hz")
    of, other = READINGS[reading], (reference, frequency) != ("sinusoid", 0.5)
    unprinted = {"published": (), "conclusions": ()} if other else {}
    return Scenario(
        **printed("cao-2019", reading, **unprinted),
        machine=Machine(voice_coil(plant)),
        task=task_of(reference, frequency, reading),
        schemes=schemes_of(of),
        uncertainty=MOTOR_UNCERTAINTY,
        tolerance=5.0,
        shown_unit="µm",
        shown_scale=1e3,
        show_trials=(1, 2, 5, 10, 15, 20, 30, 40, 50, 60, 70, 80),
        quantities={
            name: Quantity(partial(largest_from, eighths=n)) for name, n in of.windows.values()
        },
    )


def task_of(reference: str, frequency: float, reading: str) -> Task:
    """The motion of the tool, see `cao_2019`."""
    dt, settle = 1e-3, None
    need_one_of("cao-2019", "reference", reference, ("sinusoid", "piston"))
    if reference == "piston":
        r = references.noncircular(
            duration=round(4 / frequency / dt) * dt, dt=dt, spindle_speed=frequency / 2,
            feed=0.5, ellipticity=(0.4, 0.6), bulge=0.1, length=1.0,
        )  # fmt: skip
    else:
        duration = round(1 / frequency / dt) * dt
        motion = {"amplitude": (1.0, {}), "stroke": (0.5, {"phase": -np.pi / 2, "offset": 0.5})}
        size, form = motion[reading]
        r = references.sinusoid(size, frequency, duration=duration, dt=dt, **form)
        if reading == "stroke":
            settle = (READINGS[reading].settled_from / 8 * duration, duration)
    return Task(reference=r, dt=dt, settle=settle, unit="mm", input_unit="V")


def schemes_of(of: Reading) -> dict[str, Scheme]:
    """The schemes of section IV with the printed weights, and what a reading adds to them."""
    weights: dict[str, Leaf] = {"lam": 1.2, "eta": 1.0, "mu": 1.1, "rho": 0.98}
    return {
        "pid": PID(kp=-11.3, ki=-0.028),
        "cfdl-mfailc": CFDLMFAILC(
            lam=1.0, eta=0.9, mu=1.0, rho=1.0, phi0=of.phi0["cfdl-mfailc"], reset=of.reset
        ),
        "pfdl-mfailc": PFDLMFAILC(phi0=of.phi0["pfdl-mfailc"], reset=of.reset, **weights),
        "ffdl-mfailc": FFDLMFAILC(phi0=of.phi0["ffdl-mfailc"], reset=of.reset, **weights),
        "ilc-mfapc": WithFeedback(
            learning=PIDType(gamma_p=-0.2, gamma_i=0.0, gamma_d=-1.0),
            feedback=CFDLMFAPC(P=10, lam=of.lam, eta=0.9, mu=1.0, phi0=of.phi0["ilc-mfapc"]),
        ),
    }


def largest_from(trial, *, eighths: int) -> jax.Array:
    """The largest error after so many eighths of the trial."""
    return largest(jnp.abs(trial.e[trial.u.shape[0] * eighths // 8 :, 0]))
