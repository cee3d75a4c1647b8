"""Xu 2024: a piezo fast tool servo under PID, sliding mode, adaptive sliding mode, and learning.

Xu et al.: adaptive sliding mode control with closed-loop iterative learning for a fast tool servo
(2024), section 5. Lengths in µm, input in V, errors shown in nm. The experiments are those of the
paper; numbers that are not printed are fitted, see `printed/xu-2024.toml`.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp

from ..learning.machine import Actuator, Machine, Sensor
from ..learning.metrics import chattering
from ..plants import BoucWen, FastToolServo, PeriodicForce, fast_tool_servo
from ..pytree.aliases import Leaf
from ..pytree.ranges import need_one_of, require
from ..schemes import ASMC, PID, SMC, ExponentialPD, Scheme, WithFeedback
from ..signals import references
from ..signals.task import Task
from ..uncertainty import Uniform
from .published import Readings, file_of, printed
from .scenario import Quantity, Scenario

DT = 1e-4
MODEL: dict[str, Leaf] = {"a1": 2.413e6, "a2": 70.16, "b": 2.229e7}  # printed; µm per V
FITTED = file_of("xu-2024")["fitted"]


class Reading(NamedTuple):
    """A reading of section 5.3.

    share: share of the inverse of the reaching dynamics that is learned in a trial
    epsilon: dead zone of ASMC [µm]
    lam0: growth of the learning gain [1/s]
    """

    share: float
    epsilon: float
    lam0: float


READINGS = Readings("xu-2024", Reading)


def servo(A: float, load: float | None = None, disturbance: str = "none") -> FastToolServo:
    """The tool with a hysteresis of initial slope A [V/V], a load [N] and a periodic force.

    Its gain for small strokes is the identified one, whatever A is.
    """
    form = fast_tool_servo("full")
    periodic = PeriodicForce(
        amplitudes=(1.0, 0.6, 0.4), frequencies=(20.0, 65.0, 110.0), phases=(0.0, 1.0, 2.0)
    )
    return dataclasses.replace(
        form,
        conversion=fast_tool_servo().conversion / (1 - A),
        hysteresis=BoucWen(initial_slope=A, beta=3.5 * A, gamma=0.5 * A),
        load=load,
        periodic=periodic if disturbance == "multi" else None,
    )


def schemes_for(
    fitted: dict[str, float], of: Reading = READINGS["small-gain"]
) -> dict[str, Scheme]:
    """The paper's four controllers from the fitted numbers, and those of a reading."""
    lam1, k_n = 500.0, fitted["k_n"]
    asmc = ASMC(**MODEL, phi=fitted["phi"], Delta=fitted["Delta"], k_n=k_n, epsilon=of.epsilon)
    exponential = ExponentialPD(
        K_P=of.share * lam1 * k_n, K_D=of.share * (lam1 + k_n), lam0=of.lam0, b=MODEL["b"]
    )
    return {
        "pid": PID(kp=0.3, ki=fitted["ki"], kd=1.6e-4),
        "smc": SMC(**MODEL, eta=fitted["eta"], k_n=k_n),
        "asmc": asmc,
        "ilc-asmc": WithFeedback(exponential, asmc),
    }


def xu_2024(load: float = 0.0, disturbance: str = "none", reading: str = "large-gain") -> Scenario:
    """The experiments of Xu 2024, section 5.3: 20 µm at 40 Hz for 0.5 s, 10 kHz, ten trials.

    load: constant force on the tool [N]; 1 N in Table 2
    disturbance: `none`, or `multi`, a periodic force of three frequencies (Fig. 10)
    reading: `small-gain`, learning of 0.67 of the inverse of the reaching dynamics in a trial, or
        `large-gain`, of 1.5, which meets the rows under load too
    Raises ValueError for another disturbance or reading, and for a load beyond 5 N, which is a
    quarter of the stroke.
    """
    of = READINGS[reading]
    need_one_of("xu-2024", "disturbance", disturbance, ("none", "multi"))
    require("xu-2024", "load", load, "[-5, 5]", " N")
    names = ["stiffness", "damping", "conversion", "hysteresis.initial_slope"]
    names += ["load"] if load else []
    return Scenario(
        **printed("xu-2024", reading),
        machine=Machine(
            servo(FITTED["A"], load or None, disturbance),
            Actuator(limit=10.0, resolution=20.0 / 2**16),
            Sensor(resolution=1.2e-3),
        ),
        task=Task(
            references.sinusoid(20.0, 40.0, duration=0.5, dt=DT),
            dt=DT,
            settle=(0.1, 0.5),
            unit="µm",
            input_unit="V",
        ),
        schemes=schemes_for(FITTED, of),
        uncertainty={f"plant.{name}": Uniform(0.8, 1.2, relative=True) for name in names},
        tolerance=1000.0,
        shown_unit="nm",
        shown_scale=1e3,
        show_trials=(1, 2, 4, 6, 8, 10),
        quantities={
            "settled_rms": Quantity(settled_rms),
            "chattering": Quantity(chattering_of_input, "V/s", 1.0),
        },
    )


def settled_rms(trial) -> jax.Array:
    """Root mean square error from 0.1 s on."""
    return jnp.sqrt(jnp.mean(trial.e[round(0.1 / DT) :] ** 2))


def chattering_of_input(trial) -> jax.Array:
    """Total variation of the input per second, see `metrics.chattering`."""
    return chattering(trial)[0]
