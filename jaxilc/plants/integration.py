"""One step of an ordinary differential equation, for plants that are not linear."""

from __future__ import annotations

from typing import NamedTuple

import jax

from ..pytree.aliases import Array, Function, Leaf, Tree
from ..signals.task import product
from .linear import zoh

# Runge-Kutta 4 damps every stable pole within this |pole| h: the stability region's smallest radius
# in the left half-plane is 2.616.
RK4_RADIUS = 2.6


def runge_kutta(rates: Function, x: Tree, h: Leaf) -> Tree:
    """One step of length h [s] by the classical Runge-Kutta method of order 4.

    rates: x -> dx/dt
    """

    def moved(by: float, k: Tree) -> Tree:
        return jax.tree.map(lambda a, b: a + by * b, x, k)

    k1 = rates(x)
    k2 = rates(moved(h / 2, k1))
    k3 = rates(moved(h / 2, k2))
    k4 = rates(moved(h, k3))
    return jax.tree.map(
        lambda a, k1, k2, k3, k4: a + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4), x, k1, k2, k3, k4
    )


class Propagator(NamedTuple):
    """The linear part of a plant over a step of the integrator, and over half of it.

    Each is exp(A h) (n, n) and what an input held over the step adds (n, n_u).
    """

    whole: tuple[Array, Array]
    half: tuple[Array, Array]


def propagator(A: Array, B: Array, h: float) -> Propagator:
    """The linear part of x' = A x + B u + f(x), computed once for steps of length h [s].

    A: (n, n)
    B: (n, n_u)
    """
    return Propagator(zoh(A, B, h), zoh(A, B, h / 2))


def exponential_runge_kutta(linear: Propagator, f: Function, x: Tree, u: Array, h: float) -> Tree:
    """One step of x' = A x + B u + f(x) with u held, by Lawson's (1967) method of order 4.

        E = exp(A h), z(s) the solution of the linear part from x at time s
        k1 = f(x)
        k2 = f(z(h/2) + h/2 E^(1/2) k1)
        k3 = f(z(h/2) + h/2 k2)
        k4 = f(z(h) + h E^(1/2) k3)
        x' = z(h) + h/6 (E k1 + 2 E^(1/2) (k2 + k3) + k4)

    It is a Runge-Kutta method, exact where f is zero.

    linear: `propagator(A, B, h)`
    f:      (n,) -> (n,) all that is not linear
    x:      (n,)
    u:      (n_u,)

    The stiffness of A does not limit h; that of f does, as for Runge-Kutta 4. But a pole -a of A
    much faster than h answers an f of its own with h/6 f in place of f / a. What is stiff should
    therefore be driven by u, or by the rest of x, not by f.
    """
    (E, F), (E2, F2) = linear
    middle, end = product(E2, x) + product(F2, u), product(E, x) + product(F, u)
    k1 = f(x)
    k2 = f(middle + h / 2 * product(E2, k1))
    k3 = f(middle + h / 2 * k2)
    k4 = f(end + h * product(E2, k3))
    return end + h / 6 * (product(E, k1) + 2 * product(E2, k2 + k3) + k4)
