"""JAX's private parts are used in one module; without them the numbers are the same."""

import ast
import itertools
import warnings
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from sweep_case import PLAN, TASK

import jaxilc
from jaxilc.learning import over_trials
from jaxilc.runtime import jax_internals

UNSTABLE = ("jax._src", "jax.extend", "jax.interpreters", "jax.experimental", "jax.lib")


@pytest.fixture
def fresh():
    """Before and after a test, forget what was found of this JAX and what was compiled with it."""

    def forget():
        jax_internals._found.cache_clear()
        over_trials._program.cache_clear()

    forget()
    yield
    forget()


@pytest.mark.thorough
def test_unstable_parts_of_jax_are_imported_in_one_module_only():
    root = Path(jaxilc.__file__).parent
    for file in root.rglob("*.py"):
        names = set()
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Import):
                names |= {name.name for name in node.names}
            if isinstance(node, ast.ImportFrom) and not node.level:
                names |= {f"{node.module}.{name.name}" for name in node.names}
        unstable = {
            name for name in names if f"{name}.".startswith(tuple(f"{u}." for u in UNSTABLE))
        }
        assert not unstable or file == root / "runtime" / "jax_internals.py", f"{file}: {unstable}"


def learned():
    """Return the result of three machines at once, and a gradient through their learning."""
    law, machines = PLAN.schemes["learning"], jax.tree.map(np.asarray, PLAN.machine)
    gains = np.array([0.8, 1.0, 1.1])

    def one(law, gain):
        machine = jaxilc.pytree.replaced(machines, {"plant.gain": gain * machines.plant.gain})
        return jaxilc.learn(machine, law, TASK, 4)

    def whole(law):
        every = jax.vmap(one, (None, 0))(law, gains)
        return every.rms.sum(), (every.metrics, every.final)

    return jax.tree.leaves(jax.jit(jax.value_and_grad(whole, has_aux=True))(law))


def test_without_them_the_numbers_are_the_same(fresh, monkeypatch):
    """The version of JAX here needs no fallback: it is one that the package knows well enough."""
    with_them = learned()
    assert jax_internals.why_not() is None
    jax_internals._found.cache_clear()
    over_trials._program.cache_clear()
    monkeypatch.setenv(jax_internals.SWITCH, "off")
    without = learned()
    assert jax_internals.why_not() == "JAXILC_JAX_INTERNALS is off"
    for one, other in zip(with_them, without, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-14)


@pytest.mark.thorough(but=["_try_out"])
@pytest.mark.parametrize(
    "part", ["_rows_primitive", "_product_primitive", "_ruled_primitive", "_try_out"]
)
def test_another_jax_is_warned_of_once(fresh, monkeypatch, part):
    def unknown(*_):
        raise AttributeError("module 'jax.interpreters' has no attribute 'mlir'")

    monkeypatch.setattr(jax_internals, part, unknown)
    with pytest.warns(
        RuntimeWarning, match=rf"JAX {jax.__version__} .*no attribute 'mlir'"
    ) as said:
        machine_learned = jaxilc.learn(PLAN.machine, PLAN.schemes["learning"], TASK, 2)
    assert len(said) == 1
    assert np.all(np.isfinite(machine_learned.rms))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        jaxilc.learn(PLAN.machine, PLAN.schemes["feedback"], TASK, 2)


@pytest.mark.thorough(but=["batched1-9"])
@pytest.mark.parametrize(("batched", "rows"), [((0, None), 3), ((None, 0), 9), ((1, 0), 3)])
def test_derivatives_of_a_product_by_columns(batched, rows):
    """Value, derivatives in both modes and second ones are those of `matrix @ vector`.

    Batches are nested: the inner one over operands as named, the outer one over the matrix alone.
    """
    rng = np.random.default_rng(7)
    matrix, vector = (
        rng.normal(size=size if axis is None else (*size[:axis], 5, *size[axis:]))
        for size, axis in zip([(rows, 4), (4,)], batched, strict=True)
    )
    matrices = rng.normal(size=(2, *matrix.shape))
    moved = rng.normal(size=matrices.shape), rng.normal(size=vector.shape)

    def found(product):
        def whole(matrices, vector):
            inner = jax.vmap(product, batched)
            return jnp.sum(jax.vmap(inner, (0, None))(matrices, vector) ** 3)

        @jax.jit
        def every(at, moved):
            slope = jax.grad(whole, (0, 1))
            along = (jax.jvp(f, at, moved)[1] for f in (whole, slope))
            return whole(*at), slope(*at), *along

        return every((matrices, vector), moved)

    ours, theirs = map(found, (jax_internals.product_by_columns, jnp.matmul))
    for one, other in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12)


def test_a_product_by_columns_where_jax_follows_what_differs_between_devices(monkeypatch):
    """The slope of a matrix that all devices share is the sum over all of them."""
    matrix, vectors = jnp.arange(6.0).reshape(3, 2), jnp.arange(1.0, 9.0).reshape(4, 2)
    mesh = jax.sharding.Mesh(np.array(jax.devices()[:2]), ("machines",))
    shares = jax.sharding.PartitionSpec("machines")

    def whole(matrix, product):
        def on_device(matrix, share):
            return jax.vmap(lambda vector: product(matrix, vector))(share)

        specs = (jax.sharding.PartitionSpec(), shares)
        spread = jax.shard_map(on_device, mesh=mesh, in_specs=specs, out_specs=shares)
        return jnp.sum(spread(matrix, vectors) ** 2)

    ours, theirs = (
        jax.jit(jax.grad(whole), static_argnums=1)(matrix, product)
        for product in (jax_internals.product_by_columns, jnp.matmul)
    )
    np.testing.assert_allclose(ours, theirs, rtol=1e-12)
    monkeypatch.setattr(jax_internals, "_found", lambda: (None, "off"))
    plain = jax_internals.product_by_columns(matrix, vectors[1])
    np.testing.assert_array_equal(plain, matrix @ vectors[1])


@pytest.mark.thorough
def test_a_rule_for_a_slope_stays_in_second_derivatives_of_loops():
    """The derivatives of a loop are those that its rule stands for, also on several devices.

    The function is the identity in g; the rule says that it is g e. JAX's own rules are lost in
    the part of a loop that is known before going back, so that this fails with them.
    """
    ruled = jax_internals.with_slope(lambda g, e: g, lambda at, by: by[0] * at[1] + at[0] * by[1])
    mesh = jax.sharding.Mesh(np.array(jax.devices()[:2]), ("machines",))
    shares = jax.sharding.PartitionSpec("machines")

    def whole(w, product):
        def on_device(w, x):
            def tick(sums, now):
                value = product(sums, w * now)
                return value * (1 + 0 * w), value

            return lax.scan(tick, x[0] * w, x)[1]

        specs = (jax.sharding.PartitionSpec(), shares)
        spread = jax.shard_map(on_device, mesh=mesh, in_specs=specs, out_specs=shares)
        return jnp.sum(spread(w, jnp.array([[1.0, 1.2], [0.9, 0.8]]).reshape(-1)) ** 2)

    def by_hand(g, e):  # the value g, with the derivative of g e
        return g * e + lax.stop_gradient(g - g * e)

    for outer, inner in itertools.product((jax.grad, jax.jacfwd), repeat=2):
        # Without jit each operation of a loop over devices is compiled by itself.
        found = (jax.jit(outer(inner(partial(whole, product=p)))) for p in (ruled, by_hand))
        ours, theirs = (second(1.1) for second in found)
        np.testing.assert_allclose(ours, theirs, rtol=1e-12)
        refused = partial(whole, product=lambda g, e: jax_internals.once(g, "only once") * e)
        with pytest.raises(ValueError, match="only once"):
            jax.eval_shape(inner(refused), 1.1)


@pytest.mark.thorough(but=["types1"])
@pytest.mark.parametrize("types", [("float32", "float64"), ("float64", "float32"), ("c16", "f8")])
def test_slopes_of_a_product_by_columns_have_the_types_of_its_operands(types):
    operands = [jnp.ones(shape, kind) for shape, kind in zip([(3, 2), 2], types, strict=True)]

    def slopes(product):
        whole = jax.grad(lambda *of: jnp.sum(jnp.abs(product(*of)) ** 2), (0, 1))
        return jax.jit(whole)(*operands)

    ours, theirs = map(slopes, (jax_internals.product_by_columns, jnp.matmul))
    for slope, other, operand in zip(ours, theirs, operands, strict=True):
        assert slope.dtype == operand.dtype
        np.testing.assert_allclose(slope, other, rtol=1e-6)
