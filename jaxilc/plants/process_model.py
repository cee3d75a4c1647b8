"""The process model of system identification: gain, zeros, real poles and pairs of poles."""

from __future__ import annotations

import jax
import jax.core
import jax.numpy as jnp
import numpy as np

from ..pytree.fields import Leaf, leaf, pytree, scalar
from .linear import StateSpace, zoh
from .plant import Plant


@pytree
class ProcessModel(Plant):
    """A stable transfer function by its physical parameters (Cao 2019, eq. 6, of any order).

        G(s) = gain prod_i (1 - s / zeros_i)
               / (prod_i (1 + s / poles_i) prod_i (1 + 2 zeta_i s / w_i + (s / w_i)^2))

    gain:  () DC gain [unit of y per unit of u]
    zeros: (m,) [rad/s], real and not 0; a positive one is in the right half-plane, non-minimum
           phase
    poles: (n,) [rad/s], positive, so that they are stable; m < n + 2 q, so that u[k] acts on y[k+1]
           at the earliest
    frequencies, dampings: (q,) natural frequency w [rad/s] and damping ratio zeta of each pair of
                  poles, both positive

    A pair is complex for a damping below 1 and two real poles above. At 1 it is the double pole
    that Cao 2019, eq. 7 has at 474 rad/s. There (frequency, damping) stays regular: the denominator
    is a smooth function of both, with independent derivatives. Written as two entries of `poles`,
    the derivatives by both would be equal, and no fit could tell them apart.

    Raises ValueError where the shapes do not fit, a zero is 0 or the model is not strictly proper.
    """

    gain: Leaf = scalar(default=1.0)
    zeros: Leaf = leaf(default=())
    poles: Leaf = leaf(default=(), interval="(0, inf)")
    frequencies: Leaf = leaf(default=(), interval="(0, inf)")
    dampings: Leaf = leaf(default=(), interval="(0, inf)")

    def __post_init__(self):
        for name in ("zeros", "poles", "frequencies", "dampings"):
            if not np.ndim(getattr(self, name)):
                raise ValueError(
                    f"ProcessModel: {name} has shape (); allowed is one dimension, such as (1,)"
                )
        if self.frequencies.shape != self.dampings.shape:
            raise ValueError(
                f"ProcessModel: frequencies {self.frequencies.shape} and dampings "
                f"{self.dampings.shape} must have one shape (q,)"
            )
        if self.zeros.shape[-1] >= self.order:
            raise ValueError(
                f"ProcessModel: {self.zeros.shape[-1]} zeros over {self.order} poles; allowed are "
                "fewer zeros than poles"
            )
        if not isinstance(self.zeros, jax.core.Tracer) and np.any(np.asarray(self.zeros) == 0):
            raise ValueError(
                "ProcessModel: zeros = 0 makes the DC gain 0; allowed is any other value"
            )

    @property
    def order(self) -> int:
        return self.poles.shape[-1] + 2 * self.frequencies.shape[-1]

    @property
    def all_poles(self) -> jax.Array:
        """(n + 2 q,) complex poles [rad/s], in the left half-plane.

        Those of a pair are -frequency (damping -+ sqrt(damping^2 - 1)).
        """
        w, zeta = jnp.asarray(self.frequencies), jnp.asarray(self.dampings)
        apart = w * jnp.sqrt((zeta - 1.0) * (zeta + 1.0) + 0j)
        return jnp.concatenate(
            [
                -jnp.asarray(self.poles) + 0j,
                jnp.stack([-zeta * w + apart, -zeta * w - apart], axis=-1).reshape(-1),
            ]
        )

    def regrouped(self) -> ProcessModel:
        """The same transfer function in the one form that identification reports.

        A pair of damping >= 1 is two real poles, and can exchange one of them for one of `poles`
        without any change of G. Here such pairs are made of the real poles nearest to each other in
        ratio, and zeros, poles and pairs are sorted. It is not for use inside `jit`.
        """
        w, zeta = np.asarray(self.frequencies), np.asarray(self.dampings)
        real = zeta >= 1
        faster = w[real] * (zeta[real] + np.sqrt(zeta[real] ** 2 - 1))
        single = sorted([*np.asarray(self.poles), *faster, *(w[real] ** 2 / faster)])
        pairs = list(zip(w[~real], zeta[~real], strict=True))
        for _ in faster:
            i = int(np.argmin(np.diff(np.log(single))))
            a, b = single.pop(i), single.pop(i)
            pairs.append((np.sqrt(a * b), (a + b) / (2 * np.sqrt(a * b))))
        frequencies, dampings = np.reshape(sorted(pairs), (-1, 2)).T
        return ProcessModel(self.gain, np.sort(self.zeros), np.array(single), frequencies, dampings)

    def sampled(self, dt: float) -> StateSpace:
        """Exact zero-order hold of the cascade of lags that `continuous` is."""
        A, B, C = self._cascade()
        A_d, B_d = zoh(A, B, dt)
        return StateSpace(A_d, B_d, C, dt=dt)

    def continuous(self) -> StateSpace:
        """A cascade of lags of unit DC gain, whose states all have the size of the input."""
        return StateSpace(*self._cascade())

    def _cascade(self) -> tuple[jax.Array, jax.Array, jax.Array]:
        """A, B, C of the cascade of lags.

        Its last state w has the derivatives w^(k) = C0 A^k x for k < order, since C0 A^k B = 0 for
        k < order - 1. So the numerator acts on it as C = gain C0 prod_i (I - A / zeros_i). This is
        exact, whether or not poles coincide.
        """
        n, order, dtype = (
            self.poles.shape[-1],
            self.order,
            jnp.result_type(self.gain, self.poles, self.frequencies),
        )
        A, B = jnp.zeros((order, order), dtype), jnp.zeros((order, 1), dtype)
        rates = [*self.poles, *jnp.repeat(jnp.asarray(self.frequencies), 2)]
        for i, rate in enumerate(rates):
            pair, second = divmod(i - n, 2)
            if i < n:
                A = A.at[i, i].set(-rate)
            elif second:  # of a pair with states v, x: v' = w (input - x - 2 damping v), x' = w v
                A = A.at[i - 1, i].set(-rate)
            else:
                A = A.at[i, i].set(-2.0 * self.dampings[pair] * rate)
            A, B = (A.at[i, i - 1].set(rate), B) if i else (A, B.at[0, 0].set(rate))
        C = jnp.zeros((1, order), dtype).at[0, -1].set(self.gain)
        for i in range(self.zeros.shape[-1]):
            C = C - C @ A / self.zeros[i]
        return A, B, C
