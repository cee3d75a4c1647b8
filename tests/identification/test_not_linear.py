"""What is not linear in a drive of NumPy is named, with its number, and of a linear one nothing."""

import math

import numpy as np
import pytest

from jaxilc.identification import Record, friction_of, grow, identify, suspicions
from jaxilc.identification.not_linear import NEXT, Answers, sentences
from jaxilc.identification.problem import Coordinates
from jaxilc.outcomes.identifying import RIGID
from jaxilc.plants import ProcessModel

DT, N, FINE, W, ZETA = 1e-3, 2500, 5, 90.0, 0.4


def moved(kind, seed=0):
    """Return the record of a mass on a spring that its input pulls, by steps of NumPy."""
    rng, t = np.random.default_rng(seed), np.arange(N) * DT
    f, phase = rng.uniform(0.5, 25.0, 10), rng.uniform(0, 6.28, 10)
    u = np.sum(np.sin(2 * np.pi * f[:, None] * t + phase[:, None]), axis=0)
    u, y, x, v, gap = u / np.max(np.abs(u)), np.zeros(N), 0.0, 0.0, 0.0
    for k in range(N):
        acting, y[k] = u[k], x
        if kind == "gain by amplitude":
            acting -= 0.25 * acting**3
        elif kind == "saturation":
            acting = min(max(acting, -0.6), 0.6)
        elif kind == "backlash":
            gap = acting = min(max(gap, acting - 0.03), acting + 0.03)
        elif kind == "gain by position":
            acting *= 1 + 0.2 * x
        elif kind == "gain by time":
            acting *= 1 + 0.15 * (k / N - 0.5)
        for _ in range(FINE):
            rub = 0.05 * np.tanh(v / 0.05) if kind == "friction" else 0.0
            v += DT / FINE * (W * W * (acting - rub - x) - 2 * ZETA * W * v)
            x += DT / FINE * v
    y = np.round(y / 0.02) * 0.02 if kind == "rounding" else y + 1e-3 * rng.standard_normal(N)
    return Record(u[:-1, None], y[:, None], DT)


@pytest.mark.parametrize(
    ("kind", "number"),
    [
        ("friction", 0.05), ("backlash", 0.03), ("gain by amplitude", -0.25), ("saturation", 0.6),
        ("gain by time", 0.15), ("rounding", 0.02), ("gain by position", None),
    ],
)  # fmt: skip
def test_what_is_not_linear_is_named_with_its_number(kind, number):
    record = moved(kind)
    found = identify(record, poles=0, pairs=1, zeros=0)
    first, *_ = told = suspicions(record, [found.plant])
    assert first.name == kind
    if number is not None:
        assert first.value == pytest.approx(number, rel=0.2)
    assert first.rms < float(found.residual_std[0]) * np.sqrt(1 - 0.9 * first.share)
    said = sentences(told, float(found.residual_std[0]), 2)
    assert kind in said[0]
    assert NEXT[kind] in said[-1]


def test_of_a_linear_drive_and_of_several_channels_nothing_is_suspected():
    record = moved("linear")
    found = identify(record, poles=0, pairs=1, zeros=0)
    assert suspicions(record, [found.plant]) == []
    other = moved("saturation")
    left = 1e-4 * np.random.default_rng(1).standard_normal(N)
    alone = Answers(4, other.y[:, 0] + left, np.eye(1, N)[0])  # of a linear plant
    assert suspicions(other, [found.plant])
    assert suspicions(other, [found.plant, alone]) == []
    twice = record._replace(y=np.hstack([record.y, record.y]))
    assert suspicions(twice, [found.plant]) == []


@pytest.mark.thorough
def test_more_poles_do_not_imitate_what_is_not_linear():
    """Poles grew to 24 in 40 s, 20 of them undamped at the lines of the multisine."""
    grown = grow(moved("gain by position", seed=1), longest=5)
    assert grown.chosen.order <= 4
    assert grown.suspicions[0].name == "gain by position"
    assert grown.suspicions[0].rms < 0.2 * min(one.rms for one in grown.tried)


def test_a_positive_number_stays_positive_however_far_the_search_goes():
    """A damping went to 0 and was refused by the plant; the identification ended in a traceback."""
    of = Coordinates.of(ProcessModel(1.0, (), (), (50.0,), (0.1,)), ("dampings[0]",))
    assert of.to_values(np.array([-1e6, 0.0]))[0] > 0


def test_a_drive_on_a_spring_is_no_mass_with_friction():
    """So a command that finds friction does not tell a mass from such a record."""
    record = moved("friction")
    found = friction_of(record.u[:, 0], record.y[:-1, 0], DT)
    assert found.fit < RIGID
    assert found.coulomb.low < 0


# Mass and friction of the electro-mechanical positioning system, from a simulation by NumPy
# --------------------------------------------------------------------------------------------------

MASS, VISCOUS, COULOMB, OFFSET = 95.1089, 203.5034, 20.3935, -3.1648  # as printed of EMPS
INNER, SAMPLES = 10, 10_000
PER_VOLT, KP, KV = 35.15, 160.18, 243.45


def simulated(seed=0):
    """Return force and position of a cascade of position and speed, with an encoder's noise."""
    rng, t = np.random.default_rng(seed), np.arange(SAMPLES) * DT
    wanted = 0.06 * np.sin(2 * np.pi * 0.3 * t) + 0.03 * np.sin(2 * np.pi * 0.8 * t)
    noise = (1e-7 * rng.standard_normal(SAMPLES)).tolist()
    q = v = before = 0.0
    force, position = np.zeros(SAMPLES), np.zeros(SAMPLES)
    for k in range(SAMPLES):
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


def test_the_step_of_an_encoder_does_not_hide_the_mass():
    """At steps of 20 um or more the mass of 2 was outside in 35 to 40 of 40 records."""
    t, size, w = np.arange(4000) * 1e-3, [0.05, 0.02, 0.01], np.array([3.1, 8.2, 13.2])
    rng = np.random.default_rng(0)
    for step in (2e-5, 1e-4):
        turns = np.outer(t, w) + rng.uniform(0, 6, 3)
        later = turns + 5e-4 * w
        x, v, a = np.sin(turns) @ size, np.cos(later) @ (size * w), -np.sin(later) @ (size * w**2)
        force = 2 * a + 5 * v + 3 * np.sign(v) + 0.02 * rng.standard_normal(len(t))
        x = np.round(x / step) * step
        mass = friction_of(force, x, 1e-3).mass
        assert mass.low < 2 < mass.high
        assert mass.high - mass.low < 0.05
        mass = friction_of(force, x, 1e-3, cutoff=60.0).mass
        assert mass.low < 2 < mass.high, "of a cutoff that lets the step through"


def test_the_largest_cutoff_is_allowed_with_all_its_digits():
    dt = 3e-4
    t = dt * np.arange(3000)
    force = -49 * np.sin(7 * (t + dt / 2)) + np.sign(np.cos(7 * t))
    assert friction_of(force, np.sin(7 * t), dt, cutoff=0.4 / dt).mass.value == pytest.approx(
        1, 1e-2
    )


def test_a_motion_that_goes_one_way_is_refused():
    t = np.arange(500) * DT
    with pytest.raises(ValueError, match="does not move both ways"):
        friction_of(np.ones(500), t, DT, cutoff=20.0)


def test_a_record_too_short_for_its_filter_is_refused():
    t = np.arange(200) * DT
    with pytest.raises(ValueError, match="samples in motion and apart from its reversals"):
        friction_of(np.sin(40 * t), np.sin(40 * t), DT, cutoff=20.0)
