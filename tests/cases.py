"""Every plant and every scheme once, by name; listing one here gives it every test of test_conformance.py."""

import numpy as np

from jaxilc.filters import ZeroPhaseButterworth, ZeroPhaseFIR
from jaxilc.machine import Machine
from jaxilc.plants import DifferenceEquation, ProcessModel, StateSpace, VoiceCoilMotor, voice_coil
from jaxilc.schemes import (
    CFDLMFAC,
    CFDLMFAILC,
    CFDLMFAPC,
    FFDLMFAC,
    FFDLMFAILC,
    PFDLMFAC,
    PFDLMFAILC,
    PID,
    Filtered,
    OnOutputs,
    OnReference,
    PIDType,
    WithFeedback,
)
from jaxilc.signals import Task

# The three tolerance tiers: rounding, central differences, and chance in units of one standard error.
ALGEBRA = {"rtol": 1e-10, "atol": 1e-12}
DIFFERENCES = {"rtol": 2e-6, "atol": 1e-8}
SIGMAS = 6.0

DT = 1e-3
PRINTED = ((2.2386, -1.6246, 0.385), (0.0018, -0.0036, -0.0025))  # Cao 2019, eq. 29
ARX = ((1.6, -0.65), (0.06, 0.03))  # stable, with its zero at -0.5: minimum phase

PLANTS = {
    "voice_coil_exact": voice_coil(),
    "voice_coil_printed": voice_coil("printed"),
    "voice_coil_dai": voice_coil("dai_2014_printed"),
    "arx": DifferenceEquation(*ARX, dt=DT),
    "continuous": StateSpace([[0.0, 1.0], [-4e3, -80.0]], [[0.0], [4e3]], [[1.0, 0.0]], x0=(0.02, -1.0)),
    "discrete": StateSpace([[0.9, 0.1], [-0.2, 0.8]], [[0.01], [0.1]], [[1.0, 0.5]], dt=DT),
    "mimo": StateSpace([[-50.0, 20.0], [5.0, -90.0]], [[50.0, 5.0], [-10.0, 80.0]], [[1.0, 0.1], [0.2, 1.0]]),
    # an inactive limit has no gradient, so the motor goes without; a slow current loop takes one substep a sample
    "motor": VoiceCoilMotor(current_gain=30.0, substep=1e-3, current_limit=None, voltage_limit=None, speed_limit=None),
    "process_model": ProcessModel(gain=-4.8, zeros=(900.0,), poles=(6.4,), frequencies=(470.0,), dampings=(0.9,)),
    "motor_and_table": StateSpace([[0.9, 0.1], [0.3, 0.6]], [[0.2], [0.0]], [[1.0, 0.0], [0.0, 1.0]], dt=DT),
}

_CFDL = {"phi0": -0.065, "lam": 0.02, "mu": 0.05, "rho": 0.9}
_PFDL = {"phi0": (-0.065, 0.02), "lam": 0.02, "mu": 0.05, "rho": (0.9, 0.7)}
_FFDL = {"phi0": (0.5, -0.1, -0.06, 0.03), "lam": 0.02, "mu": 0.05, "rho": (0.9, 0.6, 0.8, 0.7)}
_MFAILC = {"cfdl": (CFDLMFAILC, _CFDL), "pfdl": (PFDLMFAILC, _PFDL), "ffdl": (FFDLMFAILC, _FFDL)}

SCHEMES = {
    "pid_position": PID(kp=-8.0, ki=-40.0, kd=-2e-3),
    "pid_increment": PID(kp=-8.0, ki=-40.0, kd=-2e-3, form="increment"),
    "pid_position_limited": PID(kp=-8.0, ki=-400.0, kd=-2e-3, tau=2e-3, limit=6.0),
    "pid_increment_limited": PID(kp=-8.0, ki=-400.0, kd=-2e-3, tau=2e-3, limit=6.0, form="increment"),
    "p_type": PIDType(gamma_p=-1.0),
    "pd_type": PIDType(gamma_p=-1.0, gamma_d=-3.0, lead=2),
    "pid_type_leaky_limited": PIDType(gamma_p=-1.0, gamma_i=-0.05, gamma_d=-3.0, leak=0.05, limit=1.7, lead=3),
    **{f"{name}_{mode}": law(**weights, reset=mode) for name, (law, weights) in _MFAILC.items() for mode in ("book", "sign", "none")},
    **{f"{name}_lead_limited": law(**weights, reset="sign", lead=2, limit=2.0) for name, (law, weights) in _MFAILC.items()},
    "cfdl_mfac": CFDLMFAC(lam=0.3, phi0=-0.1, reset="sign"),
    "pfdl_mfac": PFDLMFAC(lam=0.3, phi0=(-0.1, 0.02), rho=(0.9, 0.6), reset="sign"),
    "ffdl_mfac": FFDLMFAC(lam=0.3, phi0=(0.5, -0.1, -0.1, 0.02), rho=(0.9, 0.6, 0.8, 0.7), reset="none"),
    "cfdl_mfapc": CFDLMFAPC(lam=3.0, phi0=-0.1, P=5, reset="sign"),
    "cfdl_mfapc_moves": CFDLMFAPC(lam=3.0, phi0=-0.1, P=5, P_u=3, n_p=2, theta0=(0.8, 0.1), reset="sign", reference="constant"),
    "ilc_mfapc": WithFeedback(PIDType(gamma_p=-0.2, gamma_d=-1.0), CFDLMFAPC(lam=3.0, phi0=-0.1, P=5, reset="sign")),
    "p_type_on_reference": OnReference(PIDType(gamma_p=0.4, lead=1), CFDLMFAPC(lam=3.0, phi0=-0.1, P=4, reset="sign")),
    "p_type_over_pid": WithFeedback(PIDType(gamma_p=-1.0, lead=2), PID(kp=-4.0, ki=-40.0, kd=-2e-3)),
    "p_type_fir": Filtered(PIDType(gamma_p=-1.0), ZeroPhaseFIR((0.4, 0.2, 0.1))),
    "p_type_butterworth": Filtered(PIDType(gamma_p=-1.0), ZeroPhaseButterworth(80.0)),
    "cfdl_butterworth": Filtered(CFDLMFAILC(**_CFDL), ZeroPhaseButterworth(80.0, order=3)),
    "ffdl_fir": Filtered(FFDLMFAILC(**_FFDL), ZeroPhaseFIR((0.6, 0.2))),
    "p_type_on_table": OnOutputs(PIDType(gamma_p=0.5, lead=1), (1,)),
}

# what runs: every scheme on a plant of its shape, and every plant under a scheme
_PLANT_OF = {"p_type_on_table": "motor_and_table"}
_SCHEME_OF = {"motor_and_table": OnOutputs(PID(kp=0.5, kd=1e-4), (0,))}
CASES = {name: (PLANTS[_PLANT_OF.get(name, "voice_coil_printed")], scheme) for name, scheme in SCHEMES.items()} | {
    name: (plant, _SCHEME_OF.get(name, PIDType(gamma_p=-0.5 if "coil" in name else 0.5))) for name, plant in PLANTS.items()
}


def task_for(plant, N=32):
    """A smooth bump, a little higher for each further output."""
    bump = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(N + 1) / N)
    return Task(np.stack([(1 + 0.3 * i) * bump for i in range(plant.n_y)], axis=1), dt=DT, inputs=plant.n_u)


def case(name, N=32):
    """(machine, scheme, task) of a case."""
    plant, scheme = CASES[name]
    return Machine(plant), scheme, task_for(plant, N)
