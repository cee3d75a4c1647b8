"""Derivatives of compiled, batched programs are compared with central differences.

This is a small part of `experiments/gradients_under_attack.py`.

The other tests compile their programs without optimisation. That hides programs that compute one
number twice with different rounding. The programs here are compiled as users get them.
"""

import gradients_under_attack as attack
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from cases import case
from jax.flatten_util import ravel_pytree

from jaxilc import tiled
from jaxilc.learning.metrics import largest
from jaxilc.tuning import Tuning
from jaxilc.tuning.objectives import Effort, EveryTrial, Final, Growth, Holding, InputRate, TrialsTo
from jaxilc.tuning.risks import CVaR, Worst
from jaxilc.uncertainty import Uniform

SHIPPED = {"xla_backend_optimization_level": 3}


def compiled(f):
    return jax.jit(f, compiler_options=SHIPPED)


@pytest.mark.parametrize(("metric", "way"), [("max_error", "tiled"), ("settled_error", "vmap")])
def test_no_derivative_of_a_largest_error_is_lost_where_c_is_batched(metric, way):
    """When the largest error was found by comparing for equality, 23 of the 24 derivatives were
    exactly zero in one case, and 14 in the other.
    """
    one = attack.configurations()["order 1"]
    x, d = one.batch(np.random.default_rng(1))
    along = attack.derivative(one, metric, "last")
    ways = {
        "tiled": lambda batch: tiled(lambda _, machine: along(machine))((), batch),
        "vmap": jax.vmap(along),
    }
    slopes = np.asarray(compiled(ways[way])(jax.tree.map(jnp.asarray, (x, d))))
    expected = attack.differences(one, x, d)[metric, "last"]
    assert not np.any(expected.kink)
    assert np.all(slopes != 0)
    assert not np.any(expected.wrong(slopes))


def test_the_attack_sees_a_wrong_derivative_and_takes_either_side_of_a_kink():
    left, right = np.array([1.0, 1.0, 1.0, -1.0]), np.array([1.0, 1.0, 1.0, 1.0])
    at = attack.Differences(
        left, right, allowed=np.full(4, 1e-5), kink=left != right, shrunk=left != right
    )
    np.testing.assert_array_equal(
        at.wrong(np.array([1.0, 0.0, 1.0001, 1.0])), [False, True, True, False]
    )
    np.testing.assert_array_equal(
        at.wrong(np.array([np.nan, -1.0, 1.0, 0.0])), [True, True, False, True]
    )


def test_switching_boundaries_and_cutoffs_through_learning():
    """Every cutoff, every switching time and the width have a correct derivative.

    They are taken after five trials.
    """
    one = attack.configurations()["switching"]
    at = {name: np.asarray(attack.get_at(one.subject, name)) for name in one.leaves}
    flat, unravel = ravel_pytree(at)
    d = jax.vmap(unravel)(jnp.diag(flat))
    x = jax.tree.map(lambda leaf: np.broadcast_to(leaf, (len(flat), *leaf.shape)), at)
    expected = attack.differences(one, x, d)

    def last(x):
        metrics = one.history(x).metrics
        return {name: jnp.sum(getattr(metrics, name)[-1]) for name in ("max_error", "rms")}

    def along(x, d):
        slopes = jax.jacrev(last)(x).items()
        return {of: sum(jnp.vdot(by[name], d[name]) for name in d) for of, by in slopes}

    for metric, slopes in jax.jit(jax.vmap(along))(x, d).items():
        assert np.all(np.abs(expected[metric, "last"].left) > 1e-6), "each of them matters"
        assert not np.any(expected[metric, "last"].wrong(np.asarray(slopes))), metric


BOUNDS = {
    "scheme.gamma_p": None,
    "filter.cutoff": (10.0, 300.0),
    "filter.times[0]": (0.0075, 0.011),
    "filter.times[1]": (0.017, 0.023),
    "filter.width": (0.001, 0.007),
}
ROBUST = {
    "worst": (Worst(), "reverse", Holding(2) + 0.5 * Growth("max_error") + Final("rms")),
    "cvar": (
        CVaR(0.6),
        "forward",
        EveryTrial("max_error") + TrialsTo(0.3) + 0.1 * Effort(2.0) + 0.2 * InputRate(50.0),
    ),
}


@pytest.mark.thorough(but=["cvar"])
@pytest.mark.parametrize("name", ROBUST)
def test_the_loss_of_a_robust_tuning_has_the_slope_of_its_differences(name):
    """The gradient of the loss of a robust tuning is that of finite differences.

    Risk, objective and bounds of the weights are taken together, as the optimiser gets them. A
    descent step at rate 1 moves the weights by the gradient.

    Five plants and three starts run on two devices. The derivative of a sort is a scatter, and
    XLA's partitioner crashed on a scatter over them.
    """
    risk, mode, objective = ROBUST[name]
    machine, scheme, task = case("p_type_switchable")
    problem = Tuning(
        machine,
        scheme,
        task,
        3,
        BOUNDS,
        {"plant.b": Uniform(0.8, 1.2, relative=True)},
        objective,
        risk,
        machines=5,
        optimiser=optax.sgd(1.0),
        mode=mode,
        clip=np.inf,
    )
    (init, step, _), z, h = problem._programs, problem._weights.starts(1, 0.0, 0)[0], 1e-6
    direction = np.random.default_rng(3).standard_normal(len(z))
    starts = jnp.stack([z, z + h * direction, z - h * direction])
    moved, _, record = step(starts, init(starts))
    _, after, before = np.asarray(record.loss)
    assert not np.any(record.dropped)
    np.testing.assert_allclose(
        np.dot(z - moved[0], direction), (after - before) / (2 * h), rtol=2e-6
    )


N, MACHINES = 60, 32


def test_largest_keeps_every_part_of_its_derivative():
    """`largest` keeps every part of its derivative, where `jnp.max` loses some.

    The error is a sum of products. It is computed twice, and rounded differently the second time.
    """
    rng = np.random.default_rng(0)
    r, R = rng.standard_normal(N), rng.standard_normal((N, 3))
    c = rng.standard_normal((MACHINES, 3))

    def error(c):
        x = jnp.asarray(R)
        return c[0] * x[:, 0] + c[1] * x[:, 1] + c[2] * x[:, 2] - r

    for f in (lambda e: jnp.abs(e), lambda e: e, lambda e: e**2):
        slopes = jax.jit(jax.vmap(jax.grad(lambda c, f=f: largest(f(error(c))))))(c)
        shipped = compiled(jax.vmap(jax.grad(lambda c, f=f: largest(f(error(c))))))(c)
        e = c @ R.T - r
        place = np.argmax(f(e), axis=1)
        outer = jax.vmap(jax.grad(f))(jnp.asarray(e[np.arange(MACHINES), place]))
        np.testing.assert_allclose(slopes, outer[:, None] * R[place], rtol=1e-10)
        np.testing.assert_allclose(shipped, outer[:, None] * R[place], rtol=1e-10)


def test_largest_is_the_largest():
    x = np.random.default_rng(1).standard_normal((4, 5, 3))
    of = jax.jit(largest, static_argnums=1)
    for axis in (None, 0, 1, -1):
        np.testing.assert_array_equal(of(x, axis), np.max(x, axis=axis))
    assert np.isnan(of(np.array([1.0, np.nan, 2.0]), None))
    np.testing.assert_array_equal(jax.jit(jax.grad(largest))(jnp.ones(3)), [1.0, 0.0, 0.0])
