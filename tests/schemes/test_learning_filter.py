"""The general linear law by its taps, against a loop in NumPy and against P-type learning."""

import jax
import jax.numpy as jnp
import jax.test_util
import numpy as np
import pytest

from jaxilc import Task
from jaxilc.filters import SwitchableFilter
from jaxilc.learning.over_trials import measured_trial
from jaxilc.schemes import Filtered, LearningFilter, PIDType
from jaxilc.schemes.learning_filter import correlated
from jaxilc.theory.law import law_of

N = 24
TASK = Task(np.sin(np.arange(N + 1) / 4.0), dt=1e-3)
LAW = LearningFilter((0.3, -0.2, 0.5, 0.1, 0.05), keep=(0.2, 0.7, -0.1), lead=2)


@pytest.mark.thorough
def test_theory_reads_its_taps():
    law = law_of(LAW, TASK)
    np.testing.assert_array_equal(law.L.powers, [5, 4, 3, 2, 1])
    np.testing.assert_allclose(law.L.taps[:, 0, 0], np.asarray(LAW.L)[::-1])
    np.testing.assert_array_equal(law.keep.powers, [1, 0, -1])
    np.testing.assert_allclose(law.keep.taps[:, 0, 0], np.asarray(LAW.keep)[::-1])
    assert law.invariant.held


RANDOM = np.random.default_rng(4)
SCHEDULED = LearningFilter(
    RANDOM.standard_normal((2, 5, 3, 2)),
    keep=RANDOM.standard_normal((2, 3, 3, 3)),
    lead=1,
    starts=(10,),
)


@pytest.mark.thorough
@pytest.mark.parametrize("law", [LAW, SCHEDULED], ids=["numbers", "matrices and segments"])
def test_it_is_the_sum_over_its_taps(law):
    n_u, n_y = law.L.shape[2:] or (1, 1)
    L, keep = np.reshape(law.L, (-1, 5, n_u, n_y)), np.reshape(law.keep, (-1, 3, n_u, n_u))
    task = Task(RANDOM.standard_normal((N + 1, n_y)), dt=1e-3, inputs=n_u)
    u, y = RANDOM.standard_normal((N, n_u)), RANDOM.standard_normal((N + 1, n_y))
    e, mirrored = np.asarray(task.reference) - y, np.concatenate([u[:1], u, u[-1:]])
    expected = np.zeros((N, n_u))
    for k in range(N):
        s = sum(k >= start for start in law.starts)
        expected[k] = sum(keep[s, i] @ mirrored[k + i] for i in range(3))
        for i in range(5):
            at = k + 1 + law.lead + i - 2
            expected[k] += L[s, i] @ e[at] if 0 <= at <= N else 0.0
    law.check(task)
    found = law.learn(law.initial_memory(task), measured_trial(task, y, u)).u
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-13)


def test_a_program_may_hold_a_law_that_is_scheduled():
    """Its taps are then constants of the program, as in an exported law."""
    task = Task(RANDOM.standard_normal((N + 1, 2)), dt=1e-3, inputs=3)
    u, y = RANDOM.standard_normal((N, 3)), RANDOM.standard_normal((N + 1, 2))
    memory, trial = SCHEDULED.initial_memory(task), measured_trial(task, y, u)
    held = jax.jit(lambda trial: SCHEDULED.learn(memory, trial).u)(trial)
    np.testing.assert_allclose(held, SCHEDULED.learn(memory, trial).u, rtol=1e-12, atol=1e-13)


@pytest.mark.thorough
def test_derivatives_are_those_of_the_sum():
    random = np.random.default_rng(5)
    for shape, order in (((7,), 1), ((7, 2, 3), 2)):
        taps = jnp.asarray(random.standard_normal(shape))
        signal = jnp.asarray(random.standard_normal((30, 3)))
        jax.test_util.check_grads(correlated, (taps, signal), order=order, atol=1e-5, rtol=1e-5)


@pytest.mark.thorough(but=["190"])
@pytest.mark.parametrize("late", [30, 190])
def test_a_law_that_is_scheduled_is_no_law_of_every_sample(late):
    task = Task(np.sin(np.arange(201) / 10), dt=1e-3)
    taps = ((0.1, 0.2, 0.1), (0.1, 0.2, 0.1 + 1e-6))
    scheduled, switched = (
        LearningFilter(taps, starts=(late,)),
        SwitchableFilter((60.0, 150.0), (late * 1e-3,), 0.006, order=1, padding=4),
    )
    for law in (scheduled, Filtered(PIDType(gamma_p=1e-9), switched)):
        assert not law_of(law, task).invariant.held
    assert law_of(LearningFilter(taps[0]), task).invariant.held


BEYOND = f"less than the trial of N = {N}"


@pytest.mark.parametrize(
    ("L", "values", "said"),
    [
        ((1.0, 2.0), {}, r"L has shape \(2,\); allowed is an odd number"),
        ((), {}, r"L has shape \(0,\)"),
        ((1.0,), {"keep": ((1.0,),) * 2}, r"keep has shape \(2, 1\)"),
        (((1.0,), (2.0,)), {}, r"taps of 2 segments, but starts = \(\) make 1"),
        (((1.0,), (2.0,)), {"starts": (0,)}, "samples above 0 that rise"),
        (((1.0,), (2.0,), (1.0,)), {"starts": (5, 5)}, "samples above 0 that rise"),
        (np.ones((3, 2, 2)), {}, r"allowed are matrices of \(1, 1\)"),
        (((1.0,), (2.0,)), {"starts": (N,)}, f"starts reaches over {N} samples"),
        ((1.0,), {"lead": N}, BEYOND),
        ((1.0,), {"keep": np.ones(2 * N + 1)}, BEYOND),
    ],
)
def test_what_does_not_fit_is_named(L, values, said):
    with pytest.raises(ValueError, match=said):
        LearningFilter(L, **values).check(TASK)
