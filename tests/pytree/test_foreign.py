"""A pytree of another library can be a part of a plant and of a scheme.

The example is a network such as those of equinox, which registers its own classes with JAX. Its
weights have names, and can be replaced, drawn, tuned and differentiated.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import ALGEBRA, DIFFERENCES, DT

from jaxilc.learning import Machine, learn
from jaxilc.plants import Plant
from jaxilc.pytree import child, get_at, interval_at, kind_at, leaf, named_leaves, pytree, replaced
from jaxilc.pytree import settable as settable_of
from jaxilc.schemes import PIDType, Scheme
from jaxilc.schemes.scheme import Wrapper
from jaxilc.signals import Task
from jaxilc.sweeps import Sweep
from jaxilc.tuning import Tuning
from jaxilc.tuning.objectives import Final
from jaxilc.uncertainty import Uniform

N = 20
TASK = Task(np.sin(2 * np.pi * np.arange(N + 1) / N), dt=DT)


def registered(*names):
    """Register a class with JAX by the names of its fields, as equinox does."""
    keys = [jax.tree_util.GetAttrKey(name) for name in names]

    def flatten(tree):
        return [(key, getattr(tree, key.name)) for key in keys], None

    def register(cls):
        def unflatten(_, values):
            made = object.__new__(cls)
            for name, value in zip(names, values, strict=True):
                setattr(made, name, value)
            return made

        jax.tree_util.register_pytree_with_keys(cls, flatten, unflatten)
        return cls

    return register


@registered("weight", "bias")
class Linear:
    """The layer is weight x + bias.

    It is built from its sizes, so its constructor accepts no fields.
    """

    def __init__(self, n_in, n_out, seed):
        rng = np.random.default_rng(seed)
        self.weight = jnp.asarray(0.1 * rng.standard_normal((n_out, n_in)))
        self.bias = jnp.zeros(n_out)

    def __call__(self, x):
        return self.weight @ x + self.bias


@registered("layers", "activation", "slope")
class MLP:
    """The network has layers with an activation between them.

    The activation is a function among the leaves, as in equinox.
    """

    def __init__(self, width, activation=jnp.tanh, slope=1.0):
        self.layers = [Linear(1, width, 1), Linear(width, 1, 2)]
        self.activation, self.slope = activation, slope

    def __call__(self, x):
        first, second = self.layers
        return second(self.activation(self.slope * first(x)))


class Positional:
    """The class is registered without keys, so its children are known by their numbers."""

    def __init__(self, *values):
        self.values = values


jax.tree_util.register_pytree_node(
    Positional, lambda p: (p.values, None), lambda _, values: Positional(*values)
)


@pytree
class Bent(Plant):
    """The plant is y[k+1] = u[k] + law(u[k]), with a law that was learned from data."""

    law: Any = child()

    def initial_state(self):
        return jnp.zeros(1)

    def step(self, x, u, dt):
        return u + self.law(u)

    def output(self, x):
        return x


@pytree
class Shaped(Wrapper):
    """The scheme learns from e + net(e), sample by sample."""

    scheme: Scheme = child()
    net: MLP = child()

    def shown(self, trial):
        return {"scheme": trial._replace(y=trial.y - jax.vmap(self.net)(trial.e))}


MACHINE = Machine(Bent(MLP(3)))
SCHEME = Shaped(PIDType(gamma_p=0.5), MLP(2))
NAMES = ["layers[0].weight", "layers[0].bias", "layers[1].weight", "layers[1].bias", "slope"]


def test_its_float_leaves_have_names():
    assert list(named_leaves(MACHINE)) == [f"plant.law.{name}" for name in NAMES]
    assert list(settable_of(MACHINE)) == list(named_leaves(MACHINE))
    assert all(jnp.issubdtype(x.dtype, jnp.floating) for x in jax.tree.leaves(MACHINE))
    assert (
        get_at(MACHINE, "plant.law.layers[1].weight[0][2]")
        == MACHINE.plant.law.layers[1].weight[0, 2]
    )
    assert str(interval_at(MACHINE, "plant.law.slope")) == "(-inf, inf)"
    assert kind_at(MACHINE, "plant.law.layers[0].bias") == ("leaf", Any)
    assert kind_at(MACHINE, "plant.law") == ("child", Any)
    numbered = Bent(Positional(jnp.ones(2), 3.0))
    assert list(named_leaves(numbered)) == ["law[0]", "law[1]"]
    assert get_at(replaced(numbered, {"law[0][1]": 5.0, "law[1]": 4.0}), "law[0]")[1] == 5.0


def test_what_is_replaced_keeps_its_shape_and_the_rest():
    changes = {
        "plant.law.layers[0].bias[2]": 7.0,
        "plant.law.slope": 2,
        "plant.law.layers[1].bias": [1.0],
    }
    after = replaced(MACHINE, changes)
    np.testing.assert_array_equal(after.plant.law.layers[0].bias, [0.0, 0.0, 7.0])
    assert after.plant.law.slope == 2.0
    assert after.plant.law.slope.dtype == jnp.float64
    assert after.plant.law.layers[0].weight is MACHINE.plant.law.layers[0].weight
    assert jax.tree.structure(after) == jax.tree.structure(MACHINE)
    for value, message in (
        ([1.0, 2.0], r"Linear: bias has shape \(2,\); allowed is \(3,\)"),
        ("x", "Linear: bias = 'x' is not a number"),
    ):
        with pytest.raises(ValueError, match=message):
            replaced(MACHINE, {"plant.law.layers[0].bias": value})
    for path in (
        "plant.law.layers[2].bias",
        "plant.law.layers[0].weigth",
        "plant.law.layers[0][0]",
    ):
        with pytest.raises(KeyError, match=r"layers|weigth"):
            replaced(MACHINE, {path: 1.0})


@pytest.mark.thorough
def test_it_learns_and_its_gradient_is_that_of_differences():
    def last_error(net, plant):
        schemes = Shaped(SCHEME.scheme, net), Machine(Bent(plant))
        return learn(schemes[1], schemes[0], TASK, 4).rms[-1, 0]

    nets = SCHEME.net, MACHINE.plant.law
    assert last_error(*nets) < 0.5 * learn(MACHINE, SCHEME, TASK, 1).rms[0, 0]
    slopes = jax.grad(last_error, argnums=(0, 1))(*nets)
    h = 1e-5
    for i, path in ((0, "layers[1].weight[0][1]"), (1, "layers[0].weight[2][0]")):
        moved = []
        for side in (h, -h):
            both = list(nets)
            both[i] = replaced(nets[i], {path: get_at(nets[i], path) + side})
            moved.append(last_error(*both))
        slope = get_at(slopes[i], path)
        np.testing.assert_allclose(slope, (moved[0] - moved[1]) / (2 * h), **DIFFERENCES)
        assert abs(slope) > 1e-6


@pytest.mark.thorough
def test_its_weights_are_drawn_and_tuned_by_name():
    uncertainty = {
        "plant.law.layers[1].weight": Uniform(0.8, 1.2, relative=True),
        "plant.law.layers[1].bias[0]": Uniform(-0.1, 0.1),
    }
    sweep = Sweep(MACHINE, {"own": SCHEME}, TASK, 3, uncertainty, samples=4, lanes=2)
    found = sweep.run()["rms"].sel(scheme="own")
    alone = learn(sweep.machine_of(2), SCHEME, TASK, 3).rms
    np.testing.assert_allclose(found[2], alone[:, 0], **ALGEBRA)
    problem = Tuning(
        MACHINE,
        SCHEME,
        TASK,
        3,
        {"net.layers[1].weight": (-1.0, 1.0), "net.slope": None},
        uncertainty,
        Final("rms", floor=0.01),
        samples=4,
        held_out=3,
        steps=4,
        lanes=2,
    )
    tuned = problem.run()
    assert tuned.after < tuned.before
    assert set(tuned.values) == {
        "net.layers[1].weight[0][0]",
        "net.layers[1].weight[0][1]",
        "net.slope",
    }
    assert jax.tree.structure(tuned.scheme) == jax.tree.structure(SCHEME)


def test_without_a_plant_of_the_package_nothing_is_different():
    """A bare array is a part too, and one of its elements is replaced."""

    @pytree
    class Bare(Scheme):
        table: Any = child()
        gain: jax.Array = leaf(default=1.0)

    own = Bare(jnp.arange(3.0))
    assert list(settable_of(own)) == ["table", "gain"]
    np.testing.assert_array_equal(replaced(own, {"table[1]": 5.0}).table, [0.0, 5.0, 2.0])
