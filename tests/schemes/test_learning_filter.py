"""The general linear law by its taps, against a loop in NumPy and against P-type learning."""

import numpy as np
import pytest

from jaxilc import Machine, Task, learn
from jaxilc.learning.over_trials import measured_trial
from jaxilc.plants import StateSpace
from jaxilc.schemes import LearningFilter, PIDType
from jaxilc.theory.law import law_of

N = 24
TASK = Task(np.sin(np.arange(N + 1) / 4.0), dt=1e-3)
LAW = LearningFilter((0.3, -0.2, 0.5, 0.1, 0.05), keep=(0.2, 0.7, -0.1), lead=2)


def test_it_is_the_sum_over_its_taps():
    random = np.random.default_rng(3)
    u, y = random.standard_normal(N), random.standard_normal(N + 1)
    trial = measured_trial(TASK, y, u)
    e, mirrored = np.asarray(TASK.reference)[:, 0] - y, np.r_[u[0], u, u[-1]]
    expected = np.zeros(N)
    for k in range(N):
        expected[k] = np.asarray(LAW.keep) @ mirrored[k : k + 3]
        for i, tap in enumerate(np.asarray(LAW.L)):
            at = k + 1 + 2 + i - 2
            expected[k] += tap * e[at] if 0 <= at <= N else 0.0
    found = LAW.learn(LAW.initial_memory(TASK), trial).u[:, 0]
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-14)


def test_theory_reads_its_taps():
    law = law_of(LAW, TASK)
    np.testing.assert_array_equal(law.L.powers, [5, 4, 3, 2, 1])
    np.testing.assert_allclose(law.L.taps[:, 0, 0], np.asarray(LAW.L)[::-1])
    np.testing.assert_array_equal(law.keep.powers, [1, 0, -1])
    np.testing.assert_allclose(law.keep.taps[:, 0, 0], np.asarray(LAW.keep)[::-1])
    assert law.invariant.held


def test_one_tap_is_p_type_learning():
    machine = Machine(StateSpace([[0.8]], [[0.2]], [[1.0]], dt=1e-3))
    one, other = (
        learn(machine, scheme, TASK, trials=6).rms
        for scheme in (LearningFilter((0.0, 0.6, 0.0), lead=1), PIDType(gamma_p=0.6, lead=1))
    )
    np.testing.assert_allclose(one, other, rtol=1e-12)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"L": (1.0, 2.0)}, r"L has shape \(2,\); allowed is an odd number"),
        ({"L": ()}, r"L has shape \(0,\)"),
        ({"L": (1.0,), "keep": ((1.0,),)}, r"keep has shape \(1, 1\)"),
    ],
)
def test_taps_of_a_wrong_shape_are_named(values, said):
    with pytest.raises(ValueError, match=said):
        LearningFilter(**values)


def test_taps_longer_than_the_trial_are_named():
    for law in (LearningFilter((1.0,), lead=N), LearningFilter((1.0,), keep=np.ones(2 * N + 1))):
        with pytest.raises(ValueError, match=f"less than the trial of N = {N}"):
            law.check(TASK)
