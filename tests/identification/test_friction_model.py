"""Mass and friction of the electro-mechanical positioning system, from a simulation by NumPy."""

import math

import numpy as np
import pytest

from jaxilc.identification import friction_of

MASS, VISCOUS, COULOMB, OFFSET = 95.1089, 203.5034, 20.3935, -3.1648  # as printed of EMPS
DT, INNER, N = 1e-3, 10, 10_000
PER_VOLT, KP, KV = 35.15, 160.18, 243.45


def simulated(seed=0):
    """Return force and position of a cascade of position and speed, with an encoder's noise."""
    rng, t = np.random.default_rng(seed), np.arange(N) * DT
    wanted = 0.06 * np.sin(2 * np.pi * 0.3 * t) + 0.03 * np.sin(2 * np.pi * 0.8 * t)
    noise = (1e-7 * rng.standard_normal(N)).tolist()
    q = v = before = 0.0
    force, position = np.zeros(N), np.zeros(N)
    for k in range(N):
        seen = q + noise[k]
        speed, before = (seen - before) / DT if k else 0.0, seen
        volt = KV * (KP * (wanted[k] - seen) - speed)
        force[k] = PER_VOLT * max(-10.0, min(10.0, volt))
        position[k] = seen
        for _ in range(INNER):
            rub = VISCOUS * v + COULOMB * math.tanh(v / 1e-4) + OFFSET
            v += DT / INNER * (force[k] - rub) / MASS
            q += DT / INNER * v
    return force, position


def test_mass_and_friction_lie_within_their_intervals():
    true = {"mass": MASS, "viscous": VISCOUS, "coulomb": COULOMB, "offset": OFFSET}
    for seed in range(2):
        signals = simulated(seed)
        for cutoff in (20.0, 40.0):
            found = friction_of(*signals, DT, cutoff=cutoff)
            for name, value in true.items():
                of = getattr(found, name)
                assert of.low < value < of.high, (cutoff, name)
                assert of.value == pytest.approx(value, rel=0.02), (cutoff, name)


def test_a_motion_that_goes_one_way_is_refused():
    t = np.arange(500) * DT
    with pytest.raises(ValueError, match="does not move both ways"):
        friction_of(np.ones(500), t, DT, cutoff=20.0)


def test_a_record_too_short_for_its_filter_is_refused():
    t = np.arange(200) * DT
    with pytest.raises(ValueError, match="samples in motion and apart from its reversals"):
        friction_of(np.sin(40 * t), np.sin(40 * t), DT, cutoff=20.0)
