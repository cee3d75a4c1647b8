"""A plant over a whole trial: against its own steps and central differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import ALGEBRA, DIFFERENCES, DT, PLANTS

from jaxilc.plants import Plant, StateSpace, linearised, motion
from jaxilc.pytree import leaf, pytree

N = 12


moved, linear_form = (jax.jit(of, static_argnums=2) for of in (motion, linearised))


def stepped(plant, u):
    plant = jax.jit(lambda plant: plant.sampled(DT))(plant)
    step = jax.jit(lambda x, u: plant.step(x, u, DT))
    x, y = plant.initial_state(), []
    for k in range(len(u) + 1):
        y.append(np.asarray(plant.output(x)))
        x = step(x, u[k]) if k < len(u) else x
    return np.stack(y)


@pytest.mark.thorough(but=["arx"])
@pytest.mark.parametrize("name", ["fast_tool_servo_nonlinear", "mimo", "arx"])
def test_motion_is_what_the_steps_make(name):
    plant = PLANTS[name]
    u = jnp.asarray(np.random.default_rng(1).standard_normal((N, plant.n_u)))
    np.testing.assert_allclose(moved(plant, u, DT), stepped(plant, u), **ALGEBRA)


@pytest.mark.thorough
def test_linear_form_is_the_derivative_of_the_motion():
    plant = PLANTS["fast_tool_servo_nonlinear"]
    random = np.random.default_rng(2)
    u, du = (jnp.asarray(random.standard_normal((N, 1))) for _ in range(2))
    small = moved(linear_form(plant, u, DT), du, DT)
    h = 1e-6
    differences = (moved(plant, u + h * du, DT) - moved(plant, u - h * du, DT)) / (2 * h)
    np.testing.assert_allclose(small, differences, rtol=DIFFERENCES["rtol"], atol=1e-7)


def test_of_a_linear_plant_it_is_the_plant_at_each_sample():
    plant = StateSpace([[0.9, 0.1], [-0.2, 0.8]], [[0.01], [0.1]], [[1.0, 0.5]], (0.3, -1.0), dt=DT)
    found = linearised(plant, jnp.ones((N, 1)), DT)
    for here, there in ((found.A, plant.A), (found.B, plant.B), (found.C, plant.C)):
        np.testing.assert_allclose(here, np.broadcast_to(there, (N, *there.shape)), **ALGEBRA)


def test_a_plant_in_single_precision_moves_in_that_of_its_input():
    plant, u = PLANTS["arx"], np.random.default_rng(4).standard_normal((N, 1))
    single = jax.tree.map(jnp.float32, plant)
    double = jax.tree.map(jnp.float64, single)
    for of in (motion, lambda *given: linearised(*given).B):
        wanted = of(double, u, DT)
        assert of(single, np.float32(u), DT).dtype == jnp.float32
        np.testing.assert_allclose(of(single, u.tolist(), DT), wanted, rtol=1e-6)
        found = of(single, u, DT)
        assert found.dtype == wanted.dtype
        np.testing.assert_array_equal(found, wanted)


@pytree
class Scheduled(Plant):
    """A gain that is looked up by the number of the sample."""

    gains: np.ndarray = leaf()

    def initial_state(self):
        return jnp.zeros((), int), jnp.zeros(1)

    def step(self, x, u, dt):
        return x[0] + 1, 0.5 * x[1] + self.gains[x[0]] * u

    def output(self, x):
        return x[1]


def test_a_table_of_the_samples_is_looked_up():
    gains = np.random.default_rng(3).standard_normal(N)
    u = jnp.ones((N, 1))
    found = linearised(Scheduled(gains), u, DT)
    np.testing.assert_allclose(found.B[:, 1, 0], gains, **ALGEBRA)
    np.testing.assert_allclose(motion(found, u, DT), motion(Scheduled(gains), u, DT), **ALGEBRA)
