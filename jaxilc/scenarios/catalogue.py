"""The list of the scenarios, which needs neither JAX nor planned motions."""

from __future__ import annotations

from typing import NamedTuple


class Listed(NamedTuple):
    """A scenario as `jaxilc list` shows it.

    title, trials: number J of them; the scenario has both from here, but where an option changes it
    schemes: names as in the scenario
    samples: number N of samples of a trial
    """

    title: str
    schemes: tuple[str, ...]
    trials: int
    samples: int


LISTED = {
    "cao-2019": Listed(
        "Voice-coil motor for noncircular turning, MFAILC (Cao 2019)",
        ("pid", "cfdl-mfailc", "pfdl-mfailc", "ffdl-mfailc", "ilc-mfapc"),
        trials=80, samples=2000,
    ),
    "cao-2019-rig": Listed(
        "Voice-coil motor on the laboratory rig at 0.5 Hz (Cao 2019)",
        ("pid", "cfdl-mfailc"),
        trials=80, samples=10_000,
    ),
    "dai-2014": Listed(
        "Voice-coil motor under predictive MFAC at 0.5 Hz (Dai 2014)",
        ("pid", "cfdl-mfapc"),
        trials=1, samples=8000,
    ),
    "double-mass": Listed(
        "Two masses on a spring, the tests of IterativeLearningControl2.jl",
        ("inverse-filter", "norm-optimal", "gradient", "model-free", "constrained"),
        trials=28, samples=471,
    ),
    "li-2020": Listed(
        "CNC axis along a butterfly, simulation (Li 2020)",
        ("feedback", "feedforward", "p-type", "higher-order", "fixed-filter", "switchable", "stop",
         "ladder", "series"),
        trials=40, samples=9998,
    ),
    "milc-2024": Listed(
        "Flexible ball-screw drive, direct and multivariable norm-optimal ILC (MILC 2024)",
        ("dilc", "milc"),
        trials=11, samples=4000,
    ),
    "pendulum": Listed(
        "Pendulum swung upright, two-step nonlinear ILC (gILC)",
        ("two-step", "two-step-limited"),
        trials=5, samples=1999,
    ),
    "xu-2024": Listed(
        "Piezo fast tool servo, adaptive sliding mode and iterative learning (Xu 2024)",
        ("pid", "smc", "asmc", "ilc-asmc"),
        trials=10, samples=5000,
    ),
}  # fmt: skip
SCHEMES = {name: listed.schemes for name, listed in LISTED.items()}
