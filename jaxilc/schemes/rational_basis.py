"""A rational feedforward as basis functions, with zeros and poles that are learned."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from ..pytree.fields import Leaf, child, leaf, pytree, static
from ..signals.task import Task
from .bases import MARGIN, ORDERS, Basis, PolynomialBasis, pushed


@pytree
class RationalBasis(Basis):
    """A rational feedforward (Bolder and Oomen 2015), u = B(theta_B) / A(theta_A) r.

        A = 1 + theta_A,1 d + theta_A,2 d^2 + ...,    d: central difference per time

    B is a polynomial basis, A has the same parameters for all inputs. u is not linear in theta. In
    each step of a law, theta is found by iterated weighting (Sanathanan and Koerner 1963): with the
    A of the step before, the columns B / A and -d^i t / A are linear in theta again, and their
    limit is where the weight 1/A and A agree. The law iterates so within each trial.

    1 / A is applied at each frequency of the reference, held before and after the trial: that is
    the inverse which stays bounded, forward in time for stable roots of A and backward for the
    others. Its gain is at most 1 / (2 `least`), so u is bounded at any theta.

    numerator: basis of B
    order: number of parameters of A
    least: () > 0, regularises 1 / A as conj(A) / (|A|^2 + least^2)
    """

    numerator: PolynomialBasis = child()
    order: int = static(default=1, interval="[1, 4]", whole=True)
    least: Leaf = leaf(default=1e-4, interval="(0, 1)")
    linear = False

    def names(self, outputs: int, inputs: int) -> tuple[str, ...]:
        poles = tuple(f"pole {ORDERS[i + 1]}" for i in range(self.order))
        return self.numerator.names(outputs, inputs) + poles

    def check(self, task: Task) -> None:
        self.numerator.check(task)

    def signal(self, theta, r, dt: float, inputs: int) -> jax.Array:
        b, a = theta[: -self.order], theta[-self.order :]
        return self._divided(self.numerator.columns(r, dt, inputs) @ b, a, dt)

    def columns(self, r, dt: float, inputs: int) -> jax.Array:
        """(N, inputs, m) the derivative of u by theta at theta = 0, where A is 1."""
        of_zeros = self.numerator.columns(r, dt, inputs)
        return jnp.concatenate(
            [of_zeros, jnp.zeros((*of_zeros.shape[:2], self.order), of_zeros.dtype)], axis=-1
        )

    def regression(self, theta, t, push, r, dt: float, inputs: int) -> tuple[jax.Array, jax.Array]:
        a = theta[-self.order :]
        of_zeros = self.numerator.columns(r, dt, inputs)
        of_zeros = pushed(push, pushed(lambda u: self._divided(u, a, dt), of_zeros))
        held, pad = self._held(t)
        unit = np.eye(self.order)
        parts = [-self._over(unit[i], held, a, dt) for i in range(self.order)]
        of_poles = jnp.stack([part[pad : pad + len(t)] for part in parts], axis=-1)
        return self._divided(t, a, dt), jnp.concatenate([of_zeros, of_poles], axis=-1)

    def _divided(self, signal, a, dt: float):
        """(K, n) the signal over A: the signal less (A - 1) / A of it, which ends at rest."""
        held, pad = self._held(signal)
        return signal - self._over(a, held, a, dt)[pad : pad + len(signal)]

    def _held(self, signal):
        """The signal with a margin on both sides in which it stays, and the width of one."""
        pad = max(len(signal) // 2, 2 * MARGIN)
        return jnp.pad(signal, ((pad, pad), (0, 0)), mode="edge"), pad

    def _over(self, top, held, a, dt: float):
        """The signal filtered by (top_1 d + top_2 d^2 + ...) / A.

        A straight line is taken off, so that the signal is periodic. The filter makes the constant
        top_1 times its slope of it, since A is 1 at frequency zero.
        """
        M = len(held)
        slope = (held[-1] - held[0]) / M
        symbols = [_symbol(i + 1, M, dt) for i in range(self.order)]
        A = 1 + sum(a[i] * symbols[i] for i in range(self.order))
        over = sum(top[i] * symbols[i] for i in range(self.order)) * jnp.conj(A)
        over = over / (jnp.abs(A) ** 2 + self.least**2)
        spectrum = jnp.fft.rfft(held - held[0] - slope * np.arange(M)[:, None], axis=0)
        return jnp.fft.irfft(spectrum * over[:, None], n=M, axis=0) + top[0] * slope / dt


def _symbol(order: int, M: int, dt: float):
    """(M//2+1,) the frequency response of the central difference of an order, for M samples."""
    w = 2 * np.pi * np.arange(M // 2 + 1) / M
    second = 2 * (np.cos(w) - 1) / dt**2
    return second ** (order // 2) * (1j * np.sin(w) / dt if order % 2 else 1.0)
