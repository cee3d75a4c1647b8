"""The pendulum is compared with the differential equation that it follows by Euler steps."""

import jax.numpy as jnp
import numpy as np
import scipy.integrate

from jaxilc.plants import Pendulum, linearised, motion

PENDULUM = Pendulum(mass=0.4, damping=0.2, inertia=0.01, length=0.25, gravity=9.7)
INERTIA, WEIGHT = 0.01 + 0.4 * 0.25**2, 9.7 * 0.4 * 0.25


def torque(t):
    return 1.2 * np.sin(3 * t)


def test_it_tends_to_its_differential_equation_by_the_first_power_of_the_sample_time():
    def rates(t, x):
        return x[1], (torque(t) - 0.2 * x[1] - WEIGHT * np.sin(x[0])) / INERTIA

    exact = scipy.integrate.solve_ivp(rates, (0, 2), (0, 0), rtol=1e-10, atol=1e-12).y[0, -1]
    assert abs(exact) > 0.5, "the weight shall be nonlinear"
    off = []
    for N in (1000, 2000):
        dt = 2 / N
        u = jnp.asarray(torque(dt * np.arange(N)))[:, None]
        off.append(float(motion(PENDULUM, u, dt)[-1, 0]) - exact)
    assert 1.9 < off[0] / off[1] < 2.1


def test_upright_it_is_unstable_by_its_weight():
    """Beside the upright position, which is at rest if gravity points up, the speed grows."""
    upright = Pendulum(mass=0.4, damping=0.2, inertia=0.01, length=0.25, gravity=-9.7)
    A = np.asarray(linearised(upright, jnp.zeros((1, 1)), 1e-3).A[0])
    fast = (-0.2 + np.sqrt(0.2**2 + 4 * INERTIA * WEIGHT)) / (2 * INERTIA)
    np.testing.assert_allclose(np.max(np.linalg.eigvals(A)), 1 + 1e-3 * fast, rtol=1e-12)
