"""The integrators against the matrix exponential and scipy's, and the order of each."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
from cases import ALGEBRA

from jaxilc.plants.integration import RK4_RADIUS, exponential_runge_kutta, propagator, runge_kutta

A = np.array([[0.0, 1.0, 0.0], [-40.0, -2.0, 3.0], [0.0, -1.0, -8.0]])
B = np.array([[0.0, 0.3], [1.0, 0.0], [0.5, 2.0]])
U, START, DURATION = np.array([0.7, -1.1]), np.array([0.4, -1.0, 0.3]), 1.0


def bend(x):
    """Return a smooth f that is as large as the linear part."""
    return jnp.stack([0.0 * x[0], -20.0 * jnp.sin(2 * x[0]) - x[1] * x[1], jnp.tanh(x[1])])


def exponential(x, h, n, A=A, B=B, f=bend, u=U):
    linear = propagator(A, B, h)
    return jax.lax.fori_loop(0, n, lambda _, x: exponential_runge_kutta(linear, f, x, u, h), x)


def classical(x, h, n, A=A, B=B, f=bend, u=U):
    return jax.lax.fori_loop(
        0, n, lambda _, x: runge_kutta(lambda x: A @ x + B @ u + f(x), x, h), x
    )


@pytest.mark.thorough
def test_the_linear_part_is_exact():
    block = np.block([[A, (B @ U)[:, None]], [np.zeros((1, 4))]])

    @jax.jit
    def step(h):
        return exponential_runge_kutta(propagator(A, B, h), jnp.zeros_like, START, U, h)

    for h in (1e-3, 0.1, 3.0):
        expected = (scipy.linalg.expm(block * h) @ np.append(START, 1.0))[:3]
        np.testing.assert_allclose(step(h), expected, **ALGEBRA)


@pytest.mark.thorough
@pytest.mark.parametrize("method", [exponential, classical])
def test_the_order_is_four(method):
    def rates(t, x):
        return A @ x + B @ U + [0.0, -20.0 * np.sin(2 * x[0]) - x[1] ** 2, np.tanh(x[1])]

    expected = scipy.integrate.solve_ivp(
        rates, (0.0, DURATION), START, "DOP853", rtol=1e-13, atol=1e-14
    ).y[:, -1]
    steps, run = 2 ** np.arange(5, 9), jax.jit(method)
    error = [np.max(np.abs(run(START, DURATION / n, n) - expected)) for n in steps]
    assert error[-1] > 1e-12, "rounding would hide the order"
    np.testing.assert_allclose(np.polyfit(np.log(steps), np.log(error), 1)[0], -4.0, atol=0.25)


@pytest.mark.thorough
def test_the_stiffness_of_the_linear_part_does_not_limit_the_step():
    """A pole of 1e6 1/s acts beside a slow pendulum, at steps of 10 ms."""
    stiff = np.array([[0.0, 1.0, 0.0], [-9.0, -0.5, 1.0], [0.0, 0.0, -1e6]])
    push, held = np.array([[0.0], [0.0], [1e6]]), np.array([2.0])

    def f(x):
        return jnp.stack([0.0 * x[0], 9.0 * (x[0] - jnp.sin(x[0])), 0.0 * x[0]])

    def rates(t, x):
        return stiff @ x + push @ held + [0.0, 9.0 * (x[0] - np.sin(x[0])), 0.0]

    h, n = 0.01, 200
    methods = exponential, classical
    both = jax.jit(lambda x: [method(x, h, n, stiff, push, f, held) for method in methods])
    found, lost = both(START)
    expected = scipy.integrate.solve_ivp(
        rates, (0.0, h * n), START, "Radau", rtol=1e-10, atol=1e-12
    ).y[:, -1]
    np.testing.assert_allclose(found, expected, rtol=1e-7)
    assert not np.all(np.isfinite(lost))


@pytest.mark.thorough
def test_what_is_faster_than_the_step_is_stable_but_not_accurate_under_f():
    """For x' = -a x + 1 with the 1 in f, x settles at 1/a. With e = exp(-a h) the method settles at

    h/6 (e + 4 sqrt(e) + 1) / (1 - e).
    """
    h, none = 0.01, jnp.zeros(1)

    @jax.jit
    def settled(a):
        return exponential(none, h, 3000, -a[None, None], jnp.zeros((1, 1)), jnp.ones_like, none)

    for a, agree in ((20.0, True), (1e4, False)):
        x = settled(jnp.array(a))
        e = np.exp(-a * h)
        np.testing.assert_allclose(x, h / 6 * (e + 4 * np.sqrt(e) + 1) / (1 - e), rtol=1e-10)
        assert (abs(x[0] * a - 1) < 1e-6) == agree


def test_the_classical_method_damps_every_stable_pole_within_its_radius():
    angle = np.linspace(np.pi / 2, np.pi, 181)

    def growth(radius):
        pole = np.outer(radius, np.exp(1j * angle))
        return np.abs(runge_kutta(lambda x: pole * x, np.ones_like(pole), 1.0))

    assert np.max(growth(np.linspace(0.01, RK4_RADIUS, 200))) <= 1 + 1e-12
    assert np.max(growth([1.02 * RK4_RADIUS])) > 1, "the radius could be larger"
