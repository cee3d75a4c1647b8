"""Maps over the position, against SciPy's splines and against a plant stepped in plain NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refusals import refused
from scipy.integrate import solve_ivp
from scipy.interpolate import BSpline

from jaxilc.plants import (
    ByPosition,
    Cogging,
    EndEffect,
    Harmonics,
    PositionMap,
    Splines,
    StateSpace,
    motion,
)

DT, WAVES = 1e-3, ("cos", "sin")
at = jax.jit(lambda functions, x: functions.at(x))
PLANT = StateSpace([[0.0, 1.0], [-40.0, -2.0]], [[0.0], [50.0]], [[1.0, 0.0]], x0=(0.1, 0.0))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_splines_are_those_of_scipy_and_add_up_to_one(degree):
    one = Splines(-1.0, 3.0, 9, degree=degree)
    x = np.linspace(-1.0, 3.0, 98)  # on no knot but the ends
    found = np.asarray(at(one, x))
    knots = -1.0 + 4.0 / (9 - degree) * np.arange(-degree, 9 + 1)
    wanted = BSpline.design_matrix(np.clip(x, -1, 3 - 1e-12), knots, degree).toarray()
    inner = slice(0, -1) if degree == 0 else slice(None)
    np.testing.assert_allclose(found[inner], wanted[inner], atol=1e-9)
    np.testing.assert_allclose(found.sum(axis=1), 1.0, rtol=1e-12)
    np.testing.assert_array_equal(at(one, x + 6.0)[-1], found[-1])  # beyond its end it holds
    turn = Splines(0.0, 2.0, 8, degree=degree, closed=True)
    np.testing.assert_allclose(at(turn, x), at(turn, x + 6.0), atol=1e-12)
    np.testing.assert_allclose(np.asarray(at(turn, x)).sum(axis=1), 1.0, rtol=1e-12)


@pytest.mark.thorough
def test_harmonics_are_waves_whose_pitch_has_a_slope():
    x = np.linspace(0, 1, 7)
    found = Harmonics(0.3, (0, 2)).at(x)
    angle = 4 * np.pi * x / 0.3
    np.testing.assert_allclose(found, np.stack([np.ones(7), np.cos(angle), np.sin(angle)], 1))
    combs = Harmonics((0.3, 0.2), (0, 2))
    two = [found, np.asarray(Harmonics(0.2, (2,)).at(x))]
    np.testing.assert_allclose(combs.at(x), np.hstack(two), rtol=1e-12)
    assert combs.names == ("constant", *(f"{w} 2 of pitch {n}" for n in (1, 2) for w in WAVES))
    slope = jax.grad(lambda p: Harmonics(p, (2,)).at(0.2)[1])(0.3)
    assert slope == pytest.approx(-4 * np.pi * 0.2 / 0.09 * np.cos(4 * np.pi * 0.2 / 0.3))


@pytest.mark.thorough
def test_the_plant_is_driven_by_its_maps():
    """The same plant, sample by sample in plain NumPy."""
    bins = np.array([1.0, 2.0, 0.5, -1.0, 0.3, 0.1, -0.2, 0.7])
    force = PositionMap(Splines(-1.0, 1.0, 4, degree=1), bins, turning=0.2)
    ripple = PositionMap(Harmonics(0.4, (1,)), (0.2, -0.1))
    error = PositionMap(Harmonics(0.3, (1,)), (0.01, 0.02))
    plant = ByPosition(PLANT, force, ripple, error, backlash=0.03)
    u = 3 * np.sin(np.arange(400) / 30)
    found = np.asarray(motion(plant, jnp.asarray(u)[:, None], DT))[:, 0]
    held = PLANT.sampled(DT)
    A, B = np.asarray(held.A), np.asarray(held.B)[:, 0]
    x, before = np.array([0.1, 0.0]), 0.1

    def lead(x):
        return x + 0.01 * np.cos(2 * np.pi * x / 0.3) + 0.02 * np.sin(2 * np.pi * x / 0.3)

    after = lead(0.1)
    wanted = [after]
    for k in range(400):
        seen, v = x[0], (x[0] - before) / DT
        for _ in range(2):
            s = np.tanh(v / 0.2)
            of_way = (1 + s) / 2 * bins[:4] + (1 - s) / 2 * bins[4:]
            f = np.interp(seen, np.linspace(-1, 1, 4), of_way)
            share = 1 + 0.2 * np.cos(5 * np.pi * seen) - 0.1 * np.sin(5 * np.pi * seen)
            then = A @ x + B * (share * u[k] + f)
            seen, v = (x[0] + then[0]) / 2, (then[0] - x[0]) / DT
        before, x = x[0], then
        new = lead(x[0])
        after = min(max(after, new - 0.015), new + 0.015)
        wanted.append(after)
    np.testing.assert_allclose(found, wanted, atol=1e-10)
    assert np.ptp(wanted) > 0.3


@pytest.mark.parametrize("backlash", [0.0, 0.01])
def test_the_slope_by_a_backlash_is_that_of_larger_ones(backlash):
    u = 3 * np.sin(np.arange(200) / 30)[:, None]

    @jax.jit
    def moved(b):
        return motion(ByPosition(PLANT, backlash=b), jnp.asarray(u), DT)[:, 0]

    expected = (moved(backlash + 1e-9) - moved(backlash)) / 1e-9
    np.testing.assert_allclose(jax.jacfwd(moved)(backlash), expected, atol=1e-6)
    assert {-0.5, 0.5} <= set(np.round(np.asarray(expected), 3))


@pytest.mark.thorough
def test_forces_are_right_to_second_order():
    """Halved sample times, against an integration in continuous time."""
    bins = np.array([1.0, 0.2, -1.0, 0.5])
    force = PositionMap(Harmonics(0.2, (1, 3)), bins)
    friction = PositionMap(Harmonics(1.0, (0,)), (-2.0, 2.0), turning=0.5)
    ripple = PositionMap(Harmonics(0.4, (1,)), (0.2, -0.1))
    plant = ByPosition(ByPosition(PLANT, force, ripple), friction)
    held, T = 12 * np.sin(np.arange(25)), 0.02

    def slope(t, x):
        angle = 2 * np.pi * x[0] * np.array([1, 3]) / 0.2
        f = bins[::2] @ np.cos(angle) + bins[1::2] @ np.sin(angle)
        u = held[min(int(t / T), 24)] - 2 * np.tanh(x[1] / 0.5)
        turn = 5 * np.pi * x[0]
        share = 1 + 0.2 * np.cos(turn) - 0.1 * np.sin(turn)
        return PLANT.A @ x + PLANT.B[:, 0] * (share * u + f)

    y, x = [0.1], np.array([0.1, 0.0])
    for k in range(25):
        span = (k * T, (k + 1 - 1e-9) * T)
        x = solve_ivp(slope, span, x, rtol=1e-9, atol=1e-12).y[:, -1]
        y.append(x[0])
    off = []
    for parts in (10, 20, 40):
        u = jnp.asarray(np.repeat(held, parts))[:, None]
        found = np.asarray(motion(plant, u, T / parts))[::parts, 0]
        off.append(np.max(np.abs(found - y)))
    assert np.ptp(y) > 0.2
    assert np.all(np.log2(np.divide(off[:-1], off[1:])) > 1.8), off


def test_cogging_and_end_effect_stand_in_for_maps_and_forces_add_up():
    cogging, end = Cogging(2.0, 0.3, 0.4), EndEffect(stroke=0.2, drop=0.3, buffer_stiffness=9.0)
    waves = PositionMap(Harmonics(0.3, (1,)), (-2.0 * np.sin(0.4), -2.0 * np.cos(0.4)))
    u = jnp.asarray(np.sin(np.arange(200) / 20))[:, None]
    one = motion(ByPosition(ByPosition(PLANT, end, ripple=end), cogging), u, DT)
    other = motion(ByPosition(ByPosition(PLANT, waves), end, ripple=end), u, DT)
    away = motion(ByPosition(PLANT, cogging), u, DT)
    assert np.max(np.abs(one - away)) > 1e-3
    # the ripple acts on what the map outside of it adds, so the two orders differ by that alone
    inside = motion(ByPosition(ByPosition(PLANT, cogging), end, ripple=end), u, DT)
    np.testing.assert_allclose(other, inside, atol=1e-10)


REFUSED = {
    r"orders = \(1, 1\); allowed are different whole": lambda: Harmonics(0.3, (1, 1)),
    r"pitch has shape \(0,\); allowed are \(\) and": lambda: Harmonics(()),
    "low = 2 is not below high = 1": lambda: Splines(2.0, 1.0, 8),
    "count = 3; allowed is more than degree = 3": lambda: Splines(0.0, 1.0, 3),
    r"weights has shape \(3,\); allowed is \(4,\)": lambda: PositionMap(
        Harmonics(0.3, (1,)), (1.0, 2.0, 3.0), turning=0.1
    ),
    "position = 1 of a plant with 1 inputs and 1 outputs": lambda: ByPosition(PLANT, position=1),
}
test_what_does_not_fit_is_said = refused(REFUSED)
