"""Least squares with bounds and many starts, against closed forms, a solver, and learning runs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from cases import ARX, DT

from jaxilc.identification import fit
from jaxilc.learning import Machine, learn
from jaxilc.plants import DifferenceEquation
from jaxilc.schemes import CFDLMFAILC
from jaxilc.signals import Task

NAMES = ("a", "b", "c")
DESIGN = np.random.default_rng(0).normal(size=(12, 3))
DATA = DESIGN @ np.array([0.7, 3.0, -0.02]) + 0.1 * np.random.default_rng(1).normal(size=12)
# The first range is searched linearly, the others by the logarithm, of which one is negative.
WIDE = {"a": (-5.0, 5.0), "b": (0.1, 50.0), "c": (-1.0, -1e-4)}


def linear(values):
    return jnp.asarray(DESIGN) @ jnp.stack([values[name] for name in NAMES]) - DATA


@pytest.fixture(scope="module")
def found():
    return fit(linear, WIDE, starts=20, refine=3)


def test_linear_least_squares_within_wide_bounds(found):
    expected, (squares,), *_ = np.linalg.lstsq(DESIGN, DATA)
    assert all(low < x < high for (low, high), x in zip(WIDE.values(), expected, strict=True))
    assert list(found.values) == list(NAMES)
    assert all(type(value) is float for value in found.values.values())
    np.testing.assert_allclose(list(found.values.values()), expected, rtol=1e-6)
    np.testing.assert_allclose(found.residuals, DESIGN @ expected - DATA, atol=1e-7)
    # a convex problem has one minimum, from every start
    np.testing.assert_allclose(found.refined, 0.5 * squares, rtol=1e-9)
    np.testing.assert_allclose(found.jacobian, DESIGN, rtol=1e-6)


def test_costs_of_the_starts_and_of_the_refined(found):
    assert (found.costs.shape, found.refined.shape) == ((20,), (3,))
    for costs in (found.costs, found.refined):
        np.testing.assert_array_equal(costs, np.sort(costs))
    np.testing.assert_allclose(found.refined[0], 0.5 * np.sum(found.residuals**2), rtol=1e-12)
    assert found.refined[-1] < found.costs[0]


def test_linear_least_squares_on_the_bounds():
    """Where the minimum without bounds lies outside, scipy's solver ends at the same values."""
    ranges = {"a": (-5.0, 0.5), "b": (0.1, 2.0), "c": (-1.0, -1e-4)}
    result = fit(linear, ranges, starts=20, refine=3)
    low, high = np.array(list(ranges.values())).T
    expected = scipy.optimize.lsq_linear(DESIGN, DATA, (low, high), method="bvls")
    assert set(expected.active_mask) != {0}
    np.testing.assert_allclose(list(result.values.values()), expected.x, rtol=1e-4)
    np.testing.assert_allclose(result.refined[0], expected.cost, rtol=1e-5)
    assert all(low <= result.values[name] <= high for name, (low, high) in ranges.items())


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_range_of_one_sign_is_searched_by_its_logarithm(sign):
    """Over eight decades there is one start in each of 64 equal parts of the logarithm."""

    def decades_from_target(values):
        return (jnp.log10(sign * values["x"]) + 2.3)[None]

    ends = sorted((sign * 1e-4, sign * 1e4))
    result = fit(decades_from_target, {"x": tuple(ends)}, starts=64, refine=2)
    np.testing.assert_allclose(result.values["x"], sign * 10**-2.3, rtol=1e-6)
    middles = -4 + 8 * (np.arange(64) + 0.5) / 64
    np.testing.assert_allclose(
        np.sqrt(2 * result.costs), np.sort(np.abs(middles + 2.3)), atol=8 / 64 + 1e-12
    )


@pytest.mark.parametrize("ends", [(-3.0, 5.0), (0.0, 8.0), (-8.0, 0.0)])
def test_a_range_with_zero_is_searched_evenly(ends):
    low = ends[0]
    result = fit(lambda values: (values["x"] - low)[None], {"x": ends}, starts=64, refine=1)
    np.testing.assert_allclose(
        np.sqrt(2 * result.costs), 8 * (np.arange(64) + 0.5) / 64, atol=8 / 128 + 1e-12
    )
    assert low <= result.values["x"] < low + 1e-3


def bumpy(values):
    """Return residuals of many minima, about 2 pi / 5 apart; they are 0 only at (0.8, -0.4)."""
    off = jnp.stack([values["x"] - 0.8, values["y"] + 0.4])
    return jnp.concatenate([0.8 * off, 2.0 * jnp.sin(2.5 * off)])


@pytest.mark.thorough
def test_many_starts_find_the_global_minimum_among_many():
    ranges = {"x": (-5.0, 5.0), "y": (-5.0, 5.0)}
    many = fit(bumpy, ranges, starts=1000, refine=8)
    np.testing.assert_allclose([many.values["x"], many.values["y"]], [0.8, -0.4], atol=1e-6)
    assert many.refined[0] < 1e-12
    few = [fit(bumpy, ranges, starts=2, refine=1, seed=seed).refined[0] for seed in range(3)]
    assert max(few) > 0.1, "if any start led there, this problem would show nothing"


def test_a_fit_is_repeatable_and_does_not_depend_on_the_tiles():
    ranges = {"x": (-5.0, 5.0), "y": (-5.0, 5.0)}
    one, other = (fit(bumpy, ranges, starts=10, refine=1, seed=3, lanes=lanes) for lanes in (8, 3))
    np.testing.assert_allclose(one.costs, other.costs, rtol=1e-12)
    np.testing.assert_allclose(list(one.values.values()), list(other.values.values()), rtol=1e-9)
    assert not np.allclose(fit(bumpy, ranges, starts=10, refine=1, seed=4).costs, one.costs)


def test_starts_that_are_not_finite_count_as_infinitely_bad():
    def gap(values):
        x = values["x"]
        return jnp.where(x < 0.6, jnp.nan, jnp.stack([x - 0.7, 0.1 * x]))

    result = fit(gap, {"x": (0.0, 1.0)}, starts=20, refine=3)
    np.testing.assert_allclose(result.values["x"], 0.7 / 1.01, rtol=1e-6)
    assert np.sum(result.costs > 1e9) == 12


def test_large_residuals_are_still_finite():
    """With errors in nanometres the sum of squares is large, but the problem is well posed."""

    def large(values):
        return 1e6 * jnp.stack([values["x"] - 3.0, values["x"] - 1.0])

    result = fit(large, {"x": (-5.0, 5.0)}, starts=4, refine=1)
    np.testing.assert_allclose(result.values["x"], 2.0, rtol=1e-6)


# Each sample of y depends on the input of one sample only, so a learning run is computed quickly.
# The error curve over the trials determines the start value and the weight of the scheme.
TASK = Task(0.5 - 0.5 * np.cos(2 * np.pi * np.arange(21) / 20), dt=DT)
MACHINE = Machine(DifferenceEquation(*ARX, dt=DT))


def error_curve(phi0, lam):
    """Return the logarithm of the RMS error of trials 2 to 7 under CFDL-MFAILC."""
    return jnp.log(learn(MACHINE, CFDLMFAILC(phi0=phi0, lam=lam, mu=0.05), TASK, 7).rms[1:, 0])


@pytest.mark.thorough
def test_start_value_and_weight_are_recovered_from_the_error_curve_they_gave():
    truth = {"phi0": 0.23, "lam": 0.4}
    curve = error_curve(**truth)
    assert np.ptp(curve) > 0.2
    ranges = {"phi0": (0.05, 1.0), "lam": (0.1, 10.0)}
    result = fit(lambda values: error_curve(**values) - curve, ranges, starts=32, refine=3)
    np.testing.assert_allclose(list(result.values.values()), list(truth.values()), rtol=1e-5)
    assert result.refined[0] < 1e-12
    for name, column in zip(truth, result.jacobian.T, strict=True):
        assert np.all(np.isfinite(column)), name
        assert np.any(column != 0), name


def test_the_search_runs_through_jit_and_its_caller_stays_pure():
    """The residuals get tracers by name, and all names at once."""
    seen = []

    def residuals(values):
        seen.append({name: isinstance(value, jax.core.Tracer) for name, value in values.items()})
        return jnp.stack([values["p"] - 1.0, values["q"] - 2.0])

    result = fit(residuals, {"p": (-5.0, 5.0), "q": (-5.0, 5.0)}, starts=4, refine=1)
    assert result.values == pytest.approx({"p": 1.0, "q": 2.0}, abs=1e-6)
    assert all(call == {"p": True, "q": True} for call in seen)
    assert len(seen) <= 6, "traced a handful of times, not at each start"


@pytest.mark.parametrize("ends", [(1.0, 1.0), (2.0, -1.0), (np.nan, 1.0)])
def test_an_empty_range_is_named(ends):
    with pytest.raises(ValueError, match=r"range .* of second is empty") as caught:
        fit(lambda values: values["first"][None], {"first": (0.0, 1.0), "second": ends})
    assert f"({ends[0]:g}, {ends[1]:g})" in str(caught.value)


def test_nothing_finite_is_an_error():
    with pytest.raises(ValueError, match="none of 5 starts") as caught:
        fit(lambda values: jnp.log(-values["gain"])[None], {"gain": (1.0, 2.0)}, starts=5)
    assert "gain" in str(caught.value)
