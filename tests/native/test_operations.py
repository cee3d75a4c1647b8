"""Each operation of the table, against JAX, at the edges of its numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxilc.native import operations, program
from jaxilc.native.run import Compiled

EDGES = np.array([0.0, -0.0, 1.0, -1.0, 0.5, -2.5, 1.5, 3e-310, -3e-310, 1e300, -1e300, np.inf,
                  -np.inf, np.nan, 0.1, -7.25, 2.0**52, 1e-5])  # fmt: skip
WHOLE = np.array([0, 1, -1, 2, -7, 2**31 - 1, -(2**31), 2**40, -(2**62), 5])
X, Y = (a.ravel() for a in np.meshgrid(EDGES, EDGES))
SOME, OTHER = (np.resize(a.ravel(), len(X)) for a in np.meshgrid(WHOLE, WHOLE))
OF_TWO = {
    "add": jnp.add, "sub": jnp.subtract, "mul": jnp.multiply, "div": jnp.divide,
    "max": jnp.maximum, "min": jnp.minimum, "largest": lambda x, y: jnp.maximum(x, jnp.abs(y)),
    "largest so far": lambda x, y: jnp.maximum(jnp.abs(x), jnp.abs(y)),
    "eq": jnp.equal, "ne": jnp.not_equal,
    "lt_to": jax.lax.lt_to_p.bind, "le_to": jax.lax.le_to_p.bind,
    "lt": jnp.less, "le": jnp.less_equal, "gt": jnp.greater, "ge": jnp.greater_equal,
    "pow": jnp.power,
    "select_n": lambda x, y: jnp.where(x > y, x, y), "clamp": lambda x, y: jnp.clip(x, -1.0, y),
}  # fmt: skip
SIGNS = {
    "(-x) y": lambda x, y: -x * y, "(-x) (-y)": lambda x, y: -x * -y,
    "(-x) / y": lambda x, y: -x / y, "-(-x)": lambda x, y: jnp.negative(-x),
    "x + (-y)": lambda x, y: x + -y, "(-x) + y": lambda x, y: -x + y,
    "x - (-y)": lambda x, y: x - -y, "(-x) - y": lambda x, y: -x - y,
    "(-x) - (-y)": lambda x, y: -x - -y,
}  # fmt: skip
OF_TWO |= SIGNS
OF_ONE = {
    "neg": jnp.negative, "abs": jnp.abs, "sqrt": jnp.sqrt, "floor": jnp.floor, "ceil": jnp.ceil,
    "round": jnp.round, "sign": jnp.sign, "is_finite": jnp.isfinite, "exp": jnp.exp,
    "expm1": jnp.expm1, "log": jnp.log, "log1p": jnp.log1p, "sin": jnp.sin, "cos": jnp.cos,
    "tan": jnp.tan, "tanh": jnp.tanh, "square": jnp.square,
    "logistic": jax.nn.sigmoid, "rsqrt": jax.lax.rsqrt,
    "round_away": lambda x: jax.lax.round(x, jax.lax.RoundingMethod.AWAY_FROM_ZERO),
    "cube": lambda x: x**3, "inverse square": lambda x: x**-2,
    "to whole": lambda x: x.astype(int), "to small": lambda x: x.astype(jnp.int32),
    "to truth": lambda x: x.astype(bool), "from truth": lambda x: (x > 0).astype(float),
}  # fmt: skip
OF_WHOLE = {
    "add": jnp.add, "sub": jnp.subtract, "mul": jnp.multiply, "max": jnp.maximum,
    "min": jnp.minimum, "and": jnp.bitwise_and, "or": jnp.bitwise_or, "xor": jnp.bitwise_xor,
    "eq": jnp.equal, "lt": jnp.less, "ge": jnp.greater_equal,
    "not": lambda i, k: ~i, "neg": lambda i, k: -i, "abs": lambda i, k: jnp.abs(i),
    "div": lambda i, k: jax.lax.div(i, jnp.array(7)) + jax.lax.div(k, jnp.array(1)),
    "rem": lambda i, k: jax.lax.rem(i, jnp.array(7)),
    "unsigned div": lambda i, k: jax.lax.div(i.astype(jnp.uint32), jnp.uint32(3)),
    "unsigned rem": lambda i, k: jax.lax.rem(i.astype(jnp.uint32), jnp.uint32(3)),
    "to real": lambda i, k: i.astype(float), "to small": lambda i, k: i.astype(jnp.int32),
    "to unsigned": lambda i, k: i.astype(jnp.uint32),
    "unsigned not": lambda i, k: ~i.astype(jnp.uint32),
    "unsigned to whole": lambda i, k: i.astype(jnp.uint32).astype(int),
    "from unsigned": lambda i, k: i.astype(jnp.uint32).astype(float),
    "truths": lambda i, k: (i > k) ^ ((i > 0) & ~(k < 2) | (i == k)),
}  # fmt: skip
EXACT = {"add", "sub", "mul", "div", "max", "min", "neg", "abs", "sqrt", "floor", "ceil", "round",
         "sign", "select_n", "clamp", "square", "round_away", *SIGNS}  # fmt: skip


def flushed(x):
    """Return the numbers with a signed zero for those that are too small to be normal."""
    return np.where(np.abs(x) < np.finfo(x.dtype).tiny, np.copysign(0.0, x), x)


def thrice(signal):
    """Return a signal, its reverse and one that is moved, for three machines."""
    return np.stack([signal, signal[::-1], np.roll(signal, 7)])


def applied(functions, *batch):
    """Return what the compiled program and JAX find for functions of signals, by name."""
    wanted = jax.jit(jax.vmap(lambda *one: [f(*one) for f in functions.values()]))(*batch)

    def learning(common, one):
        def trial(carry, j):
            total, _ = jax.lax.scan(lambda s, x: (s + jnp.sum(x), None), 0.0, 0.0 * carry[0])
            return (*one, *(f(*one) for f in functions.values())), total

        carry = (*one, *(jnp.zeros(x.shape[1:], x.dtype) for x in wanted))
        found, totals = jax.lax.scan(trial, carry, jnp.arange(2))
        return found[len(one) :], totals

    compiled = Compiled(learning, (), tuple(x[0] for x in batch))((), batch)[0]
    return zip(functions, map(np.asarray, compiled), map(np.asarray, wanted), strict=True)


@pytest.fixture
def single():
    """Single precision."""
    jax.config.update("jax_enable_x64", False)
    yield
    jax.config.update("jax_enable_x64", True)


def compared(functions, *signals, near):
    """Exact ones to the last bit and sign, the others to a few last places."""
    for name, found, wanted in applied(functions, *map(thrice, signals)):
        if found.dtype.kind != "f":
            np.testing.assert_array_equal(found, wanted, err_msg=name)
            continue
        found, wanted = flushed(found), flushed(wanted)
        np.testing.assert_array_equal(np.isnan(found), np.isnan(wanted), err_msg=name)
        rtol = 0 if name in EXACT else near
        np.testing.assert_allclose(found, wanted, rtol=rtol, atol=0, err_msg=name)
        if name in EXACT:
            off = (np.signbit(found) != np.signbit(wanted)) & ~np.isnan(wanted)
            assert not off.any(), name


@pytest.mark.parametrize("functions", [OF_ONE, OF_TWO], ids=["one", "two"])
def test_an_operation_on_real_numbers_is_that_of_jax(functions):
    compared(functions, *(X, Y)[: 1 if functions is OF_ONE else 2], near=1e-14)


@pytest.mark.thorough
def test_quotients_are_rounded_once_beside_reciprocals_of_the_same_number():
    """49 times 1/49 is below 1, so that a product in place of the quotient had 0 whole turns."""
    functions = {
        "div": jnp.divide, "floor": lambda x, y: jnp.floor(x / y),
        "whole": lambda x, y: (x / y).astype(int), "reached": lambda x, y: x / y >= 1,
        "inverse": lambda x, y: 1 / y, "inverse square": lambda x, y: y**-2,
    }  # fmt: skip
    x, y = (a.ravel().astype(float) for a in np.indices((130, 65)))
    y += 1
    wanted = {
        "div": x / y, "floor": x // y, "whole": x // y, "reached": x >= y,
        "inverse": 1 / y, "inverse square": 1 / (y * y),
    }  # fmt: skip
    for name, found, _ in applied(functions, x[None], y[None]):
        np.testing.assert_array_equal(found[0], wanted[name], err_msg=name)


def test_an_operation_in_single_precision_is_that_of_jax(single):
    edges = np.where(np.abs(EDGES) == 3e-310, np.sign(EDGES) * 1e-40, EDGES)
    x, y = (a.ravel() for a in np.meshgrid(np.clip(edges, -1e30, 1e30), edges))
    x, y = x.astype(np.float32), np.clip(y, -1e30, 1e30).astype(np.float32)
    x[:2], y[1:3] = np.inf, -np.inf
    one = {name: lambda x, y, f=f: f(x) for name, f in OF_ONE.items() if name != "to whole"}
    compared(OF_TWO | one, x, y, near=2e-6)
    compared(OF_WHOLE, *(k.astype(np.int32) for k in (SOME, OTHER)), near=0)


def test_an_operation_on_whole_numbers_is_that_of_jax():
    compared(OF_WHOLE, SOME, OTHER, near=0)


@pytest.mark.parametrize("axis", [0, 1], ids=["samples", "channels"])
def test_what_puts_numbers_together_is_that_of_jax(axis):
    """Along the samples and along the channels of each of them, with all edges among them."""
    gather = {
        "sum": jnp.sum, "prod": jnp.prod, "max": jnp.max, "min": jnp.min,
        "all": lambda x, axis: jnp.all(x > 0, axis), "any": lambda x, axis: jnp.any(x > 1, axis),
    }  # fmt: skip
    run = {"cumsum": jnp.cumsum, "cumprod": jnp.cumprod, "cummax": jax.lax.cummax,
           "cummin": jax.lax.cummin}  # fmt: skip
    functions = {name: lambda x, f=f: f(x, axis=axis) for name, f in gather.items()}
    functions |= {name: lambda x, f=f: f(x, axis=axis) for name, f in run.items()}
    back = {name: getattr(jax.lax, name) for name in run}
    functions |= {f"{name} back": lambda x, f=f: f(x, axis, True) for name, f in back.items()}
    if axis == 0:
        functions |= {name: lambda x, f=f: f(x, axis=0) for name, f in
                      {"argmax": jnp.argmax, "argmin": jnp.argmin}.items()}  # fmt: skip
    calm = np.random.default_rng(3).normal(size=(32, 4))
    wild = calm.copy()
    wild[20:, 1:] = np.resize(EDGES, (12, 3))
    for name, found, wanted in applied(functions, np.vstack([thrice(calm), thrice(wild)])):
        np.testing.assert_allclose(found, wanted, rtol=1e-11, atol=1e-12, err_msg=name)


def test_a_few_numbers_become_rows_where_they_are_padded_or_joined():
    functions = {
        "padded": lambda x: x * jnp.pad(x[2:6], (3, len(x) - 7)),
        "cut": lambda x: x * jax.lax.pad(x[2:6], 1.0, [(-3, len(x) - 1, 0)]),
        "joined": lambda x: x * jnp.concatenate([x[2:6], jnp.ones(len(x) - 4)]),
    }
    for name, found, wanted in applied(functions, thrice(np.linspace(-1.0, 2.0, 32))):
        np.testing.assert_allclose(found, wanted, rtol=1e-14, err_msg=name)


def test_numbers_move_to_other_samples_and_channels_as_by_jax():
    """To places that are known beforehand, also to one more than once and beyond the end."""
    functions = {
        "turned": lambda x: x[np.arange(len(x))[::-1]],
        "both ways": lambda x: x[::-1, ::-1],
        "wider": lambda x: jnp.pad(x[2:], ((2, 0), (1, 1)))[:, 1:],
        "narrower": lambda x: jax.lax.pad(x, 1.0, [(1, -1, 0), (-1, 1, 0)]),
        "replaced": lambda x: jax.lax.dynamic_update_slice(x, 2 * x[3:30], (4, 0)),
        "set": lambda x: x.at[np.array([3, 4, 9, 99])].set(x[:4]),
        "set again": lambda x: x.at[np.array([3, 4, 3])].set(x[:3]),
        "overlapping": lambda x: jax.lax.scatter(
            x,
            np.array([[4], [6], [5]]),
            x[:12].reshape(4, 3, 2),
            jax.lax.ScatterDimensionNumbers((0, 2), (), (0,)),
        ),
        "apart": lambda x: x.at[np.arange(1, 30, 3)].set(x[:10]),
        "added": lambda x: x.at[np.array([3, 4, 3, 3, -40])].add(x[:5], mode="drop"),
        "few": lambda x: x + x[np.array([5, 1, 5])].sum(axis=0),
        "beside": lambda x: x.at[:, np.array([1, 1])].add(x),
        "wide": lambda x: jax.lax.scan(lambda s, v: (s, s + v[0] * jnp.arange(32.0)), 0.0, x)[1][
            np.array([5, 1, 5])
        ].sum(),
    }
    x = np.random.default_rng(0).normal(size=(3, 32, 2))
    for name, found, wanted in applied(functions, x):
        np.testing.assert_allclose(found, wanted, rtol=1e-14, err_msg=name)


def test_a_place_beyond_all_whole_numbers_of_single_precision_is_the_last(single):
    """4294967295 was taken for -1."""
    far, of = np.array([[2**32 - 1]], np.uint32), jax.lax.ScatterDimensionNumbers((), (0,), (0,))
    functions = {"far": lambda x: jax.lax.scatter(x, far, x[3:4], of, mode="clip")}
    x = np.random.default_rng(0).normal(size=(3, 32)).astype(np.float32)
    ((_, found, wanted),) = applied(functions, x)
    np.testing.assert_array_equal(found, wanted)


def test_a_function_of_the_numbers_at_some_places_is_left_to_xla():
    """They were set to 0."""
    with pytest.raises(program.Unknown, match="scatter of a function"):
        applied({"sines": lambda x: x.at[np.array([3, 5])].apply(jnp.sin)}, np.ones((3, 32)))


def test_a_sample_reads_a_table_and_runs_short_loops_either_way():
    """At its own sample, beyond both ends, and at another one in each machine."""
    N, few = 40, jnp.array([0.5, -0.2, 0.3])

    def learning(table, start):
        def tick(at, now):
            k, x = now
            near = jax.lax.dynamic_slice_in_dim(table, k - 3, 8)
            own = jax.lax.dynamic_index_in_dim(table, at, keepdims=False)

            def inner(s, c):
                return 0.5 * s + c * x, s

            s, seen = jax.lax.scan(inner, own, few, reverse=True)
            t, also = jax.lax.scan(inner, own, few)
            found = (near @ jnp.arange(8.0), own, s, t, *seen, *also)
            return at + jnp.where(x > 0, 2, -1), jnp.stack(found)

        def trial(signal, j):
            rows = jax.lax.scan(tick, start, (jnp.arange(N), signal))[1]
            return jnp.tanh(rows[:, 0] - signal), rows

        return jax.lax.scan(trial, table, jnp.arange(3))

    table = jnp.asarray(np.random.default_rng(0).normal(size=N))
    starts = np.array([0, 5, 39, -3, 100])
    found = Compiled(learning, table, 0)(table, starts)
    wanted = jax.jit(jax.vmap(learning, (None, 0)))(table, starts)
    for x, y in zip(found, wanted, strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-12, atol=1e-13)


def test_numbers_move_from_and_to_places_that_are_found_while_it_runs():
    """Other ones in each machine, among them places before the first and beyond the last."""

    def learning(signal, start):
        def tick(at, x):
            few, two = x * jnp.arange(1.0, 6.0), jnp.stack([at, at + 1])
            found = (
                few.at[at].get(mode="fill"), few.at[at].get(mode="clip"), *few.at[at].add(x),
                *few.at[two].add(jnp.stack([x, 2 * x])), *jax.lax.dynamic_slice(few, (at,), (2,)),
                *jax.lax.dynamic_update_slice(few, 9 * x[None], (at,)),
            )  # fmt: skip
            return at + 1, jnp.stack(found)

        def trial(signal, j):
            rows = jax.lax.scan(tick, start, signal)[1]
            return jnp.tanh(rows[:, 1] - signal), rows

        return jax.lax.scan(trial, signal, jnp.arange(2))[1]

    signal, starts = jnp.linspace(-1.0, 1.0, 16) ** 3, np.array([-8, 0, 3, 40])
    found = np.asarray(Compiled(learning, signal, 0)(signal, starts))
    wanted = np.asarray(jax.jit(jax.vmap(learning, (None, 0)))(signal, starts))
    np.testing.assert_allclose(found, wanted, rtol=1e-12, atol=1e-13)
    assert np.isnan(wanted).any()


@pytest.mark.parametrize("shape", [(4, 4), (3, 5), (5, 2)])
def test_a_small_elimination_is_that_of_lapack(shape):
    a = np.round(np.random.default_rng(0).normal(size=shape), 1)  # with equal pivots, too
    for x in (a, np.zeros(shape)):
        for found, wanted in zip(program.lu(x), jax.lax.linalg.lu(x), strict=True):
            np.testing.assert_allclose(found, wanted, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("flags", [(True, True), (True, False), (False, True), (False, False)])
def test_a_small_triangular_solve_is_that_of_lapack(flags):
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(3, 3)) + 3 * np.eye(3), rng.normal(size=(3, 3))
    left, lower = flags
    for transposed, unit in ((False, False), (True, True)):
        how = {"lower": lower, "transpose_a": transposed, "unit_diagonal": unit}
        (found,) = program.triangular_solve(a, b, left_side=left, **how)
        wanted = jax.lax.linalg.triangular_solve(a, b, left_side=left, **how)
        np.testing.assert_allclose(found, wanted, rtol=1e-12)


def test_few_whole_numbers_are_sorted_and_equal_ones_keep_their_order():
    keys = np.array([3, -1, 3, 0, -1, 2])
    sorted_by_jax = jax.lax.sort((keys, np.arange(6)), num_keys=1)
    for found, wanted in zip(program._sort(keys, np.arange(6)), sorted_by_jax, strict=True):
        np.testing.assert_array_equal(found, wanted)


def test_keys_of_random_numbers_are_taken_apart_as_other_arrays_are():
    """JAX 0.12 splits a key by an operation whose types have no `kind`."""
    keys = jax.random.split(jax.random.key(0), 3)
    found = program.written("unstack", {"axis": 0}, [keys])
    for one, key in zip(jax.core.eval_jaxpr(found.jaxpr, found.consts, keys), keys, strict=True):
        assert one == key


def test_every_operation_of_the_table_is_tried():
    tried = {*OF_ONE, *OF_TWO, *OF_WHOLE}
    made = {"integer_pow", "convert_element_type", "real", "add_any", "round_even", "copysign",
            "one_minus_square"}  # fmt: skip
    assert {*operations.INSTRUCTIONS, *operations.COMPOSED} - tried <= made
