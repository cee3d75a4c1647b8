"""No number changes by the layout of a batch, and XLA uses the layout that it is given."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from jaxilc.learning import Machine, learn
from jaxilc.plants import DifferenceEquation
from jaxilc.schemes import CFDLMFAILC, FFDLMFAILC
from jaxilc.signals import Task
from jaxilc.signals.rows import for_carry, for_scan

SINE = Task(np.sin(2 * np.pi * np.arange(51) / 50), dt=1e-3)
GAINS = jnp.linspace(0.4, 0.6, 4)
X = jnp.asarray(np.random.default_rng(0).normal(size=(3, 5, 2)))


def learned(gain, scheme):
    return learn(Machine(DifferenceEquation([0.5], gain[None], dt=SINE.dt)), scheme, SINE, 6)


def through(x, place=lambda x: x):
    """Run a loop over trials around a scan over samples, as `learn` does; x: (5, 2)."""

    def trial(memory, _):
        total, seen = lax.scan(
            lambda s, row: (jnp.sin(s + row), s * row), jnp.zeros(2), place(memory)
        )
        return 0.5 * memory + seen, total

    return jnp.sum(lax.scan(trial, x, None, length=3)[1] ** 2)


def placed(x):
    return through(x, lambda memory: for_scan(for_carry(memory)))


@pytest.mark.thorough(but=["hessian", "vmap of jvp of vmap", "checkpoint"])
@pytest.mark.parametrize(
    "transform",
    [
        jax.jit, jax.grad, jax.jacfwd, jax.hessian, jax.vmap,
        lambda f: jax.vmap(jax.grad(f)),
        lambda f: jax.grad(lambda x: jax.vmap(f)(x).sum()),
        lambda f: jax.vmap(lambda x: jax.vmap(lambda t: jax.jvp(f, (x,), (t,))[1])(X)),
        lambda f: jax.grad(lambda x: jax.checkpoint(jax.vmap(f))(x).sum()),
    ],
    ids=[
        "jit", "grad", "jacfwd", "hessian", "vmap", "vmap of grad", "grad of vmap",
        "vmap of jvp of vmap", "checkpoint",
    ],
)  # fmt: skip
def test_every_transformation_gives_the_same_numbers(transform):
    of_one = transform in (jax.jit, jax.grad, jax.jacfwd, jax.hessian)
    at = X[0] if of_one else X
    np.testing.assert_allclose(
        jax.jit(transform(placed))(at), jax.jit(transform(through))(at), rtol=1e-13
    )


def test_only_arrays_of_rows_are_placed_and_trees_keep_their_shape():
    tree = {"rows": X[0], "number": jnp.ones(()), "vector": jnp.ones(4), "none": None}
    for place in (for_carry, for_scan):
        assert jax.tree.structure(place(tree)) == jax.tree.structure(tree)
        assert str(jax.make_jaxpr(place)(tree)).count("by_sample") == 1


@pytest.mark.thorough
@pytest.mark.parametrize("scheme", [CFDLMFAILC(), FFDLMFAILC()], ids=["cfdl", "ffdl"])
def test_a_batch_goes_from_trial_to_trial_with_its_samples_side_by_side(scheme):
    batch = jax.jit(jax.vmap(lambda b: learned(b, scheme).metrics.rms))
    program = batch.lower(GAINS).compile().as_text()
    carry = re.findall(
        rf"f64\[4,{SINE.N},1\]\{{([\d,]+)\}}",
        " ".join(line for line in program.splitlines() if " while(" in line),
    )
    assert carry
    assert set(carry) == {"2,0,1"}  # from minor to major: the axis of the samples is the slowest
