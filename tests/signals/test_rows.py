"""Rows of signals, against NumPy's indices; derivatives by row are those of whole arrays."""

from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxilc.runtime.lanes import rows_scanned
from jaxilc.signals.rows import advance, ahead_of, by_row, delay

rng = np.random.default_rng(5)
N, n = 7, 2


class Weights(NamedTuple):
    gain: Any
    start: Any
    limit: Any = None
    count: int = 3


def law(weights, u, parts, e):
    """Return two results of a kind that laws have: a quotient, a limit, a choice by size."""
    a, b = parts
    u = u + weights.gain * a * e / (1.0 + a**2 + b**2)
    if weights.limit is not None:
        u = jnp.clip(u, -weights.limit, weights.limit)
    return u, {"phi": jnp.where(jnp.abs(a) > 0.3, a * b * weights.count, weights.start)}


A, B = rng.normal(size=(2, N, n))
ROWS = (rng.normal(size=(N, n)), (A, B), np.ones((N, n)))
WEIGHTS = {
    "scalars": Weights(jnp.array(0.7), jnp.array(-0.2)),
    "a number for each channel, and a limit": Weights(
        jnp.array([0.7, 1.3]), jnp.array([0.1, 0.2]), jnp.array(0.8)
    ),
}


def loss(function, gain, start, u, a, weights=WEIGHTS["scalars"]):
    weights = weights._replace(gain=gain, start=start)
    found = function(weights, u, (a, ROWS[1][1]), ROWS[2])
    return sum(jnp.sum(jnp.sin(x)) for x in jax.tree.leaves(found))


def slopes(function, weights):
    def of(*values):
        return loss(function, *values, weights=weights)

    at = weights.gain, weights.start, ROWS[0], ROWS[1][0]
    every = tuple(range(4))
    many = tuple(jnp.stack([x, 1.1 * x, 0.3 * x]) for x in map(jnp.asarray, at))
    along = tuple(jnp.cos(x) for x in map(jnp.asarray, at))
    return {
        "value": of(*at),
        "backward": jax.grad(of, argnums=every)(*at),
        "forward": jax.jvp(of, at, along),
        "a batch backward": jax.vmap(jax.grad(of, argnums=every))(*many),
        "a batch forward": jax.vmap(lambda *x: jax.jvp(of, x, along))(*many),
        "gradient by one weight": jax.grad(of)(*at),
        "second derivative": jax.hessian(of)(*at),
        "shared weights": jax.grad(
            lambda gain: jnp.sum(jax.vmap(lambda u: of(gain, at[1], u, at[3]))(many[2]))
        )(at[0]),
    }


@pytest.mark.parametrize("which", WEIGHTS)
def test_slopes_are_those_of_whole_arrays(which):
    weights = WEIGHTS[which]
    of_rows, of_arrays = (jax.jit(lambda f=f: slopes(f, weights))() for f in (by_row(law), law))
    chex.assert_trees_all_close(of_rows, of_arrays, rtol=1e-12, atol=1e-13)


def test_the_function_itself_is_called_with_whole_arrays():
    seen = []

    @by_row
    def f(weights, x):
        """The text of f."""
        seen.append(jnp.shape(x))
        return weights * x

    np.testing.assert_array_equal(f(2.0, ROWS[0]), 2.0 * ROWS[0])
    assert seen == [(N, n)]
    jax.grad(lambda w: jnp.sum(f(w, ROWS[0])))(2.0)
    assert set(seen) == ({(N, n), (n,)} if rows_scanned() else {(N, n)})
    assert f.__doc__ == "The text of f."


def test_one_sample_and_results_without_a_slope():
    f = by_row(lambda w, x: (w * x, x > 0, jnp.zeros_like(x)))
    found = jax.grad(lambda w: jnp.sum(f(w, jnp.ones((1, 1)))[0]))(3.0)
    assert found == 1.0


@pytest.mark.parametrize("samples", [0, 1, 4, 5, 9])
def test_rows_from_outside_the_trial_are_zero(samples):
    signal = np.random.default_rng(samples).normal(size=(6, 2))
    rows, zero = dict(enumerate(signal)), np.zeros(2)
    before = [rows.get(k - samples, zero) for k in range(5)]
    np.testing.assert_array_equal(delay(signal[:-1], samples), before)
    after = [rows.get(k + samples, zero) for k in range(5)]
    np.testing.assert_array_equal(advance(signal, samples), after)


@pytest.mark.parametrize("preview", [1, 2, 7])
def test_the_last_row_is_held_after_the_trial(preview):
    signal = np.random.default_rng(preview).normal(size=(5, 2))
    ahead = [[signal[min(k + i, 4)] for i in range(preview)] for k in range(5)]
    np.testing.assert_array_equal(ahead_of(signal, preview), ahead)
