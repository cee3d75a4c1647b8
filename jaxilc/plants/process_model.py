"""The process model of system identification: gain, zeros, real poles, pairs of poles, delay."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.core
import jax.numpy as jnp
import numpy as np

from ..pytree.aliases import Array, Function, Leaf, Value
from ..pytree.fields import leaf, pytree, scalar, static
from .linear import LARGEST_ORDER, StateSpace, zoh
from .plant import Plant

LONGEST_DELAY = 1000  # samples; each is a state
ROUNDING = 1e-6  # of a sample, by which a whole number of samples may be missed


@pytree
class ProcessModel(Plant):
    """A stable transfer function by its physical parameters (Cao 2019, eq. 6, of any order).

        G(s) = gain prod_i (1 - s / zeros_i) exp(-s delay)
               / (prod_i (1 + s / poles_i) prod_i (1 + 2 zeta_i s / w_i + (s / w_i)^2))

    gain:  () DC gain [unit of y per unit of u]
    zeros: (m,) [rad/s], real and not 0; a positive one is in the right half-plane, non-minimum
           phase
    poles: (n,) [rad/s], positive, so that they are stable; m < n + 2 q, so that u[k] acts on y[k+1]
           at the earliest
    frequencies, dampings: (q,) natural frequency w [rad/s] and damping ratio zeta of each pair of
                  poles, both positive
    delay: dead time between input and output [s]; it need not be a whole number of samples

    A pair is complex for a damping below 1 and two real poles above. At 1 it is the double pole
    that Cao 2019, eq. 7 has at 474 rad/s. There (frequency, damping) stays regular: the denominator
    is a smooth function of both, with independent derivatives. Written as two entries of `poles`,
    the derivatives by both would be equal, and no fit could tell them apart.

    Raises ValueError where the shapes do not fit, a zero is 0, the model is not strictly proper or
    has more than 1000 poles; and, when it is sampled, for a delay of more than 1000 samples.
    """

    gain: Leaf = scalar(default=1.0)
    zeros: Leaf = leaf(default=())
    poles: Leaf = leaf(default=(), interval="(0, inf)")
    frequencies: Leaf = leaf(default=(), interval="(0, inf)")
    dampings: Leaf = leaf(default=(), interval="(0, inf)")
    delay: float = static(default=0.0, interval="[0, inf)")

    def __post_init__(self) -> None:
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
        if self.order > LARGEST_ORDER:
            raise ValueError(
                f"ProcessModel: poles and frequencies give {self.order} poles; allowed are at most "
                f"{LARGEST_ORDER}"
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
    def all_poles(self) -> Array:
        """(n + 2 q,) complex poles [rad/s], in the left half-plane.

        Those of a pair are -frequency (damping -+ sqrt(damping^2 - 1)).
        """
        return all_poles(self.poles, self.frequencies, self.dampings)

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
        return ProcessModel(
            self.gain, np.sort(self.zeros), np.array(single), frequencies, dampings, self.delay
        )

    def sampled(self, dt: float) -> StateSpace:
        """Exact zero-order hold of the cascade of lags, see `held_late`."""
        A, B, C = self._cascade()
        return held_late("ProcessModel", lambda t: zoh(A, B, t), C, self.delay, dt)

    def continuous(self) -> StateSpace | None:
        """A cascade of lags of unit DC gain, whose states all have the size of the input.

        None with a delay, which has no state space in continuous time.
        """
        return None if self.delay else StateSpace(*self._cascade())

    def _cascade(self) -> tuple[Array, Array, Array]:
        """A, B, C of the cascade of lags."""
        leaves = (self.gain, self.zeros, self.poles, self.frequencies, self.dampings)
        return cascade(*leaves, dtype=jnp.result_type(self.gain, self.poles, self.frequencies))


def cascade(
    gain: Leaf,
    zeros: Leaf,
    poles: Leaf,
    frequencies: Leaf,
    dampings: Leaf,
    array: Function = jnp.array,
    dtype: Value = None,
) -> tuple[Leaf, Leaf, Leaf]:
    """A (n, n), B (n, 1), C (1, n) of a cascade of lags with the transfer function of the model.

    Its last state w has the derivatives w^(k) = C0 A^k x for k < order, since C0 A^k B = 0 for
    k < order - 1. So the numerator acts on it as C = gain C0 prod_i (I - A / zeros_i). This is
    exact, whether or not poles coincide.

    array: `jnp.array`, or `np.array` for numbers of NumPy, which may be complex
    """
    n, order = len(poles), len(poles) + 2 * len(frequencies)
    rates = [*poles, *(w for w in frequencies for _ in range(2))]
    A: list[list[Leaf]] = [[0.0] * order for _ in range(order)]
    for i, rate in enumerate(rates):
        pair, second = divmod(i - n, 2)
        if i < n:
            A[i][i] = -rate
        elif second:  # of a pair with states v, x: v' = w (input - x - 2 damping v), x' = w v
            A[i - 1][i] = -rate
        else:
            A[i][i] = -2.0 * dampings[pair] * rate
        if i:
            A[i][i - 1] = rate
    B = [[rates[0] if i == 0 else 0.0] for i in range(order)]
    A, B = array(A, dtype), array(B, dtype)
    C = array([[*[0.0] * (order - 1), gain]], dtype)
    for zero in zeros:
        C = C - C @ A / zero
    return A, B, C


def all_poles(poles: Leaf, frequencies: Leaf, dampings: Leaf) -> Array:
    """The complex poles [rad/s] of lags, and of pairs by turns."""
    w, zeta = jnp.asarray(frequencies), jnp.asarray(dampings)
    apart = w * jnp.sqrt((zeta - 1.0) * (zeta + 1.0) + 0j)
    pairs = jnp.stack([-zeta * w + apart, -zeta * w - apart], axis=-1).reshape(-1)
    return jnp.concatenate([-jnp.asarray(poles) + 0j, pairs])


def samples_of(delay: float, dt: float, owner: str = "ProcessModel") -> tuple[int, float]:
    """The whole number of samples in a delay, and the rest [s], 0 where it is only rounding.

    Raises ValueError for more than 1000 samples.
    """
    samples = delay / dt
    if samples > LONGEST_DELAY + ROUNDING:
        raise ValueError(
            f"{owner}: delay = {delay:g} s is {samples:g} samples of {dt:g} s; allowed are at "
            f"most {LONGEST_DELAY}"
        )
    whole = round(samples)
    if abs(samples - whole) < ROUNDING:
        return whole, 0.0
    return int(np.floor(samples)), delay - np.floor(samples) * dt


def held_late(
    owner: str,
    held: Callable[[float], tuple[Array, Array]],
    C: Array,
    delay: float,
    dt: float,
    D: Array | None = None,
) -> StateSpace:
    """A plant behind a dead time, under an input that is held over each sample.

    With a delay of d samples and a rest f < dt, the input changes within the sample
    (Astrom, Wittenmark 1997, section 2.3):

        x[k+1] = A(dt) x[k] + B(dt - f) u[k-d] + A(dt - f) B(f) u[k-d-1]
        y[k] = C x[k] + D u[k-d-1]

    The inputs that are still needed are states. Raises ValueError as `samples_of` does.

    held: A(t) (n, n) and B(t) (n, n_u) of the plant without the delay, for a time t [s]
    D:    (n_y, n_u); None for none
    """
    whole, rest = samples_of(delay, dt, owner)
    A, B = held(dt)
    if not (whole or rest) and D is None:
        return StateSpace(A, B, C, dt=dt)
    Bs = [B]
    if rest:
        after, now = held(dt - rest)
        Bs = [now, after @ held(rest)[1]]
    n, m = B.shape
    length = m * (whole + max(len(Bs) - 1, D is not None))
    A_all = jnp.zeros((n + length, n + length), A.dtype).at[:n, :n].set(A)
    B_all = jnp.zeros((n + length, m), A.dtype)
    for i, B in enumerate(Bs, whole):  # u[k-i] stands before state n + i m, and u[k] is the input
        if i:
            A_all = A_all.at[:n, n + (i - 1) * m : n + i * m].set(B)
        else:
            B_all = B_all.at[:n].set(B)
    B_all = B_all.at[n : n + m].set(jnp.eye(m))
    shift = np.arange(n + m, n + length)
    A_all = A_all.at[shift, shift - m].set(1.0)
    C_all = jnp.pad(C, ((0, 0), (0, length)))
    if D is not None:
        C_all = C_all.at[:, n + whole * m : n + (whole + 1) * m].set(D)
    return StateSpace(A_all, B_all, C_all, dt=dt)
