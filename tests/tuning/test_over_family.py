"""The monotone condition over a family as a term of an objective, against NumPy and differences."""

import jax
import numpy as np
import pytest

from jaxilc import Machine, Task
from jaxilc.filters import ZeroPhaseFIR
from jaxilc.plants import ProcessModel
from jaxilc.schemes import Filtered, LearningFilter
from jaxilc.tuning import Tuning
from jaxilc.tuning.objectives import Final
from jaxilc.tuning.over_family import OverFamily, contraction_sizes

DT, N = 1e-3, 40
F = np.linspace(5.0, 480.0, 12)
RNG = np.random.default_rng(3)
P = RNG.standard_normal((3, 12)) + 1j * RNG.standard_normal((3, 12))
TASK = Task(np.sin(np.linspace(0, 3, N + 1)), dt=DT)
L, KEEP = RNG.standard_normal(5), np.array([0.1, 0.2, 0.4, 0.2, 0.1])
ALONE = LearningFilter(L, keep=KEEP, lead=2)
FILTERED = Filtered(LearningFilter(L, lead=2), ZeroPhaseFIR([0.4, 0.2, 0.1]))


def z(powers):
    return np.exp(2j * np.pi * DT * np.outer(F, powers))


def by_numpy(scheme):
    """|keep - L P| by the sums that define the law."""
    Q = z([-2, -1, 0, 1, 2]) @ KEEP
    of_L = z(3 + np.arange(-2, 3)) @ L
    return np.abs(Q - (of_L if scheme is ALONE else Q * of_L) * P)


@pytest.mark.thorough
@pytest.mark.parametrize("scheme", [ALONE, FILTERED], ids=["alone", "filtered"])
def test_the_sizes_are_those_of_the_sums_of_the_taps(scheme):
    found = contraction_sizes(scheme, TASK, F, P)
    np.testing.assert_allclose(found, by_numpy(scheme), rtol=1e-10)


@pytest.mark.thorough
@pytest.mark.parametrize("scheme", [ALONE, FILTERED], ids=["alone", "filtered"])
def test_the_term_is_just_above_the_largest_size_and_its_slope_is_that_of_differences(scheme):
    machine, term = Machine(ProcessModel(poles=[200.0])), OverFamily(F, P, below=0.9)
    weight = "L[1]" if scheme is ALONE else "scheme.L[1]"
    problem = Tuning(machine, scheme, TASK, 2, weights=[weight], objective=Final() + 3.0 * term)

    def value(x):
        return problem.loss_of(machine, {weight: x}, term)

    least = np.log(by_numpy(scheme).max() / 0.9)
    found, slope = jax.jit(jax.value_and_grad(value))(float(L[1]))
    assert least - 1e-13 <= found <= least + np.log(P.size) / term.sharpness
    far = [float(value(float(L[1]) + step)) for step in (-1e-6, 1e-6)]
    np.testing.assert_allclose(slope, (far[1] - far[0]) / 2e-6, rtol=1e-6)


def test_matrices_of_two_channels_count_by_their_largest_singular_value():
    taps, task = RNG.standard_normal((3, 2, 2)), Task(np.zeros((N + 1, 2)), dt=DT)
    plants = RNG.standard_normal((2, 12, 2, 2)) + 1j * RNG.standard_normal((2, 12, 2, 2))
    found = contraction_sizes(LearningFilter(taps), task, F, plants)
    of_L = np.tensordot(z([0, 1, 2]), taps, axes=1)
    expected = np.linalg.norm(np.eye(2) - of_L @ plants, ord=2, axis=(-2, -1))
    np.testing.assert_allclose(found, expected, rtol=1e-10)


@pytest.mark.thorough
def test_a_safe_law_costs_nothing_and_its_slope_is_a_number():
    quiet = LearningFilter([0.0, 0.0, 0.0], keep=[0.0])
    term, machine = OverFamily(F, P), Machine(ProcessModel(poles=[200.0]))
    problem = Tuning(machine, quiet, TASK, 2, weights=["L"], objective=term)
    value, slope = jax.value_and_grad(lambda x: problem.loss_of(machine, {"L[0]": x}))(0.0)
    assert value == 0
    assert slope == 0


def test_responses_that_do_not_fit_are_refused_with_their_shapes():
    with pytest.raises(ValueError, match=r"P has shape \(3, 11\).*\(S, F\)"):
        OverFamily(F, P[:, 1:])
    with pytest.raises(ValueError, match="finite"):
        OverFamily(F, np.full((1, 12), np.nan))
    with pytest.raises(ValueError, match="below"):
        OverFamily(F, P, below=0.0)
