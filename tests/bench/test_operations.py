"""The operations of a learning process are counted as by hand, and each kind takes some time."""

from collections import Counter

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from jaxilc import Machine, Task, learn
from jaxilc.bench import operations
from jaxilc.bench.derivatives import Learning, machines_of
from jaxilc.plants import StateSpace
from jaxilc.schemes import GradientILC, PIDType
from jaxilc.tuning.objectives import Final

N, J = 7, 3


def counted(f, *arguments):
    return operations.counted(jax.make_jaxpr(f)(*arguments).jaxpr)


def test_loops_sums_and_matrix_products_are_counted_as_by_hand():
    def trial(x, row):
        return jnp.sin(x) / row + 2.0, None

    def run(x, rows, A):
        x = lax.scan(lambda x, _: lax.scan(trial, x, rows), x, None, length=J)[0]
        return jnp.sum(A @ x)

    found = counted(run, jnp.ones(4), jnp.ones(N), jnp.ones((5, 4)))
    products, summed = 5 * (4 + 3), 5
    expected = {"sin": 4 * N * J, "division": 4 * N * J, "simple": 4 * N * J + products + summed}
    assert found == Counter(expected)


def test_of_branches_the_dearest_counts_and_an_open_loop_counts_once():
    def run(x):
        x = lax.cond(x[0] > 0, lambda x: x * x * x, lambda x: x, x)
        return lax.while_loop(lambda x: x[0] < 1, lambda x: x + x, x)

    comparison, dearest, loop = 1, 2 * 5, 5 + 1
    assert counted(run, jnp.ones(5))["simple"] == comparison + dearest + loop


def test_a_trial_costs_what_its_plant_and_its_law_cost():
    """What is computed once does not count, and a plant of twice the order costs what it adds."""
    task = Task(np.sin(np.arange(41) / 5), dt=1e-3)

    def of(order):
        A = 0.1 * np.eye(order)
        plant = StateSpace(A, np.ones((order, 1)), np.ones((1, order)), dt=1e-3)
        return (
            operations.of_a_trial(
                lambda trials: learn(Machine(plant), PIDType(0.1), task, trials).metrics
            )["simple"]
            / task.N
        )

    def step(n):  # A x, + B u, C x
        return n * (2 * n - 1) + 2 * n + 2 * n - 1

    assert of(6) - of(3) == pytest.approx(step(6) - step(3), rel=0.1)


def test_a_scheme_that_checks_its_numbers_is_counted():
    """`GradientILC` looks at the size of its step, which a trace has no number for."""
    task = Task(np.sin(np.arange(21) / 5), dt=1e-3)
    plant = StateSpace([[0.5]], [[1.0]], [[1.0]], dt=1e-3)
    batch = machines_of(Machine(plant), {}).drawn(0, 1, nominal=True)
    learning = Learning(Machine(plant), GradientILC(plant), task, 3, {}, Final("rms"), {}, batch)
    assert learning.operations()["simple"] > 20


@pytest.mark.parametrize("kind", [*operations.KINDS, "exp", "tanh"])
def test_every_kind_takes_some_time(kind, monkeypatch):
    monkeypatch.setattr(operations, "PASSES", 3)
    operations.seconds_of.cache_clear()
    try:
        assert 0 < operations.seconds_of(kind) < 1e-3
        few = operations.cost(Counter({kind: 10}), devices=2)
        assert few == pytest.approx(5 * operations.seconds_of(kind))
    finally:
        operations.seconds_of.cache_clear()
