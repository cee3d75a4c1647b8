"""Functions whose programs compose with the transformations of JAX."""

import dataclasses
import logging

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import case

from jaxilc.learning import learn
from jaxilc.native import compiled, operations, why_not
from jaxilc.native.run import differs
from jaxilc.pytree.named_paths import replaced
from jaxilc.runtime import jax_internals

LAM, B = jnp.array([0.5, 0.6]), 1 + 0.01 * jnp.arange(-8, 9)
machine, scheme, task = case("p_type")


def rms(machine, scheme):
    return learn(machine, scheme, task, 4).rms


def by_weights(function):
    """The errors by a gain of the scheme and by one of the plant, relative."""

    def errors(gain, b):
        one = replaced(machine, {"plant.b": machine.plant.b * b})
        return function(one, replaced(scheme, {"gamma_p": scheme.gamma_p * gain}))

    return errors


def last(function):
    return lambda *at: by_weights(function)(*at)[-1, 0]


def both(function):
    """By two nested batches, 34 machines; and values with slopes of 17."""
    over = jax.vmap(jax.vmap(by_weights(function), (None, 0)), (0, None))
    slopes = jax.vmap(jax.value_and_grad(last(function), argnums=(0, 1)), (None, 0))
    return jax.jit(lambda: (jnp.concatenate(over(LAM, B)), slopes(0.7, B)))()


@pytest.fixture(scope="module")
def wanted():
    return both(rms)


def test_a_compiled_function_composes_with_jit_vmap_and_grad(caplog, wanted):
    caplog.set_level(logging.INFO, "jaxilc")
    found = both(compiled(rms, machine, scheme))
    assert caplog.text.count("a program for this processor") == 3  # forward for two batches, back
    assert differs(found, wanted) is None
    assert any(np.any(x != y) for x, y in zip(*map(jax.tree.leaves, (found, wanted)), strict=True))


def test_it_does_so_without_primitives_and_where_the_batch_is_inside_the_slope(monkeypatch, wanted):
    monkeypatch.setattr(jax_internals, "_found", lambda: (None, "off"))
    fast = compiled(rms, machine, scheme)
    of_all = jax.vmap(last(fast), (None, 0))
    slope = jax.jit(jax.grad(lambda gain: jnp.sum(of_all(gain, B))))(0.7)
    errors, (_, (slopes, _)) = wanted
    np.testing.assert_allclose(slope, np.sum(slopes), rtol=1e-9)
    np.testing.assert_allclose(by_weights(fast)(LAM[0], B[3]), errors[3], rtol=1e-9)


def test_a_wrong_program_is_told_while_jax_traces_and_xla_computes(monkeypatch, caplog):
    wrong = dataclasses.replace(operations.INSTRUCTIONS["sub"], text={"f": "fadd"})
    monkeypatch.setitem(operations.INSTRUCTIONS, "sub", wrong)
    over = [
        jax.jit(jax.vmap(by_weights(f), (None, 0))) for f in (compiled(rms, machine, scheme), rms)
    ]
    np.testing.assert_array_equal(*(f(1.0, B) for f in over))
    assert "XLA computes instead" in caplog.text


def test_where_jax_computes_on_another_device_no_program_is_made(monkeypatch, caplog):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    caplog.set_level(logging.INFO, "jaxilc")
    assert compiled(lambda x: 2 * x, 1.0)(3.0) == 6
    assert "compiled: JAX computes on gpu" in caplog.text
    assert why_not(machine, scheme, task) == "JAX computes on gpu"


def test_arguments_are_those_of_the_example_in_shape_and_type():
    fast = compiled(lambda x, n: {"y": x * n}, np.ones(3), 2)
    np.testing.assert_array_equal(fast(np.arange(3.0), 4)["y"], [0, 4, 8])  # by XLA
    assert compiled(lambda: jnp.ones(2).sum())() == 2
    with pytest.raises(ValueError, match=r"compiled: arguments\[0\] = float64\[2\] is not float64"):
        fast(np.ones(2), 2)
    with pytest.raises(ValueError, match=r"compiled: arguments = .* as in the example"):
        fast(np.ones(3))
