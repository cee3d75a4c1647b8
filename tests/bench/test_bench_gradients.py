"""The gradients of the benchmark's opponents are those of jaxilc, and wrong ones are refused."""

from functools import partial

import jax
import numpy as np
import pytest
from cases import ALGEBRA

from jaxilc import bench
from jaxilc.bench import compiled_peers, gradients, timing
from jaxilc.bench.gradients import WEIGHTS, Slope
from jaxilc.learning import learn
from jaxilc.pytree.named_paths import replaced
from jaxilc.tuning.weights import Weights

try:
    ADJOINT = {threads: compiled_peers.c_adjoint(threads) for threads in (1, 2)}
    FORWARD = compiled_peers.c_program(1)
except OSError as error:
    pytest.skip(f"needs a C compiler named cc: {error}", allow_module_level=True)

TRIALS = {"cfdl": 7, "ffdl": 3}  # in blocks of three trials and of two, with a rest
# phi0 of a wrong size with small lam and mu, with which the estimate changes its sign
RESET = {"cfdl": -1e-3, "ffdl": np.array([0.5, 0.0, -1e-3, 0.1])}


@partial(jax.jit, static_argnames="trials")
def by_jax(machine, scheme, task, b, trials):
    """Return (S, 1+P) mean square errors of the last trials, and their slopes by the weights."""

    def square(weights, b):
        history = learn(replaced(machine, {"plant.b": b}), replaced(scheme, weights), task, trials)
        return history.rms[-1, 0] ** 2

    weights = {name: getattr(scheme, name) for name in WEIGHTS}
    of_each = jax.vmap(jax.value_and_grad(square), in_axes=(None, 0))
    squares, slopes = of_each(weights, b)
    rows = [squares[:, None], *(slopes[name].reshape(len(b), -1) for name in WEIGHTS)]
    return jax.numpy.concatenate(rows, axis=1)


def right(of):
    return np.asarray(by_jax(of.machine, of.scheme, of.task, of.b, of.trials))


@pytest.mark.parametrize("name", TRIALS)
def test_the_adjoint_in_c_is_the_gradient(name):
    of = bench.setting(name, 17, TRIALS[name], 29)
    expected = right(of)
    assert np.all(np.any(expected != 0, axis=0))
    for adjoint in ADJOINT.values():
        for plants in (17, 1):
            np.testing.assert_allclose(
                adjoint(of.part(plants).problem), expected[:plants], **ALGEBRA
            )


@pytest.mark.parametrize("name", TRIALS)
def test_the_adjoint_in_c_goes_through_the_branch_that_the_reset_took(name):
    of = bench.setting(name, 17, TRIALS[name], 29)
    changed = {"lam": 0.01, "mu": 1e-4, "phi0": RESET[name]}
    of = of._replace(scheme=replaced(of.scheme, changed))
    expected = right(of)
    off = np.abs(ADJOINT[1](of.problem) - expected)
    assert np.all(off <= 1e-10 * np.max(np.abs(expected), axis=0))
    one = of.part(1)
    never = one._replace(scheme=replaced(one.scheme, {"reset": "none"})).ours(lanes=1)()
    here = FORWARD(one.problem)
    assert np.max(np.abs(never - here)) > 1e-6 * np.max(here)  # a reset took place


def slope_of(name, plants, trials, samples):
    of = bench.setting(name, plants, trials, samples)
    of = of._replace(scheme=replaced(of.scheme, Weights.of(of.scheme, WEIGHTS).inside))
    return Slope.of(of, Weights.of(of.scheme, WEIGHTS))


@pytest.mark.parametrize(
    ("name", "shape"), [("cfdl", (5, 2, 8)), ("cfdl", (3, 30, 200)), ("ffdl", (3, 41, 97))]
)
def test_differences_approach_the_adjoint_and_a_larger_step_is_seen(name, shape, monkeypatch):
    of = slope_of(name, *shape)
    right = gradients.by_adjoint(ADJOINT[2])(of)
    largest = np.max(np.abs(right[..., 1:]))

    def off():
        return np.max(np.abs(gradients.by_differences(FORWARD)(of) - right)) / largest

    assert off() < 0.1 * gradients.DIFFERENCES
    monkeypatch.setattr(gradients, "STEP", 1e-2)
    assert off() > gradients.DIFFERENCES


def test_before_anything_is_learned_all_slopes_are_zero():
    of = slope_of("ffdl", 2, 1, 9)
    found = gradients.by_adjoint(ADJOINT[1])(of)
    assert found.shape == (2, 1, 9)
    np.testing.assert_allclose(found[..., 0], of.losses(np.mean(of.problem.r[1:] ** 2)))
    np.testing.assert_array_equal(found[..., 1:], 0)
    np.testing.assert_array_equal(gradients.by_differences(FORWARD)(of), found)


def test_wrong_gradients_are_refused():
    of = slope_of("cfdl", 3, 4, 20)
    right = gradients.by_adjoint(ADJOINT[1])(of)
    results = {timing.OURS: FORWARD(of.problem), "reverse": right}
    agreement = partial(gradients._agreement, of, "reverse")
    off = agreement(results | {"1 weight": right[:2, :, :2], gradients.BY_DIFFERENCES: right})
    assert all(value < 1e-12 for value in off.values())
    wrong = right.copy()
    wrong[2, 0, 4] *= 1 + 1e-6  # mu, whose slope is the smallest but one
    with pytest.raises(ArithmeticError, match="C adjoint differs from jaxilc by 1e-06"):
        agreement(results | {gradients.BY_ADJOINT: wrong})
    agreement(results | {gradients.BY_DIFFERENCES: wrong})
    wrong[0, 0, 1] *= 1.01
    with pytest.raises(ArithmeticError, match=r"allowed is 0\.0001"):
        agreement(results | {gradients.BY_DIFFERENCES: wrong})
    with pytest.raises(ArithmeticError, match="by nan"):
        agreement(results | {"reverse": np.full_like(right, np.nan)})
    for error in (1001.0, np.nan, np.inf):
        metrics = results[timing.OURS].copy()
        metrics[1, 2, 0] = error
        with pytest.raises(gradients.Diverges):
            agreement(results | {timing.OURS: metrics})
