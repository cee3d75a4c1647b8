"""The voice-coil linear motor with its drive, as Cao 2019 and Dai 2014 identified it."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from ..pytree.aliases import Leaf, Tree
from ..pytree.fields import leaf, pytree, scalar
from ..pytree.ranges import need_one_of
from .linear import DifferenceEquation, StateSpace, zoh
from .plant import Plant

CAO_2019_EQ_29 = ((2.2386, -1.6246, 0.385), (0.0018, -0.0036, -0.0025))  # a, b
DAI_2014_EQ_24 = ((2.236, -1.6246, 0.385), (0.0018, -0.0036, -0.0025))


@pytree
class VoiceCoil(Plant):
    """Motor and drive from voltage [V] to position [mm] (Cao 2019, eq. 6 and 7).

        G(s) = gain (s - zero) (1 + lead s) / ((s + poles_1)(s + poles_2)(s + poles_3))

    gain:  () [mm/(V s^2)]
    zero:  () [rad/s]; a positive one makes the plant non-minimum phase
    poles: (3,) [rad/s]; positive ones are stable
    lead:  () [s]; zero, but for a motor behind a rounded difference equation, see `held`

    The DC gain is -4.798 mm/V, although the first sample of the response to a positive step is
    positive. Raises ValueError for another number of poles.
    """

    input_names = ("voltage",)
    output_names = ("position",)

    gain: Leaf = scalar(default=7437.7769)
    zero: Leaf = scalar(default=928.2)
    poles: Leaf = leaf(default=(474.0, 474.0, 6.404), interval="(0, inf)")
    lead: Leaf = scalar(default=0.0)

    def __post_init__(self) -> None:
        if self.poles.shape != (3,):
            raise ValueError(f"VoiceCoil: poles has shape {self.poles.shape}; allowed is (3,)")

    def sampled(self, dt: float) -> DifferenceEquation:
        """Exact zero-order hold as a difference equation.

        The poles map to exp(-p dt). The numerator follows from the first three Markov parameters
        h_i = C A^(i-1) B, since b(z) = a(z) h(z).
        """
        p1, p2, p3 = self.poles[0], self.poles[1], self.poles[2]
        A, B, C = self._cascade()
        A_d, B_d = zoh(A, B, dt)
        h = [C @ B_d[:, 0], C @ A_d @ B_d[:, 0], C @ A_d @ A_d @ B_d[:, 0]]
        z1, z2, z3 = jnp.exp(-p1 * dt), jnp.exp(-p2 * dt), jnp.exp(-p3 * dt)
        a = jnp.stack([z1 + z2 + z3, -(z1 * z2 + z2 * z3 + z3 * z1), z1 * z2 * z3])
        b = jnp.stack([h[0], h[1] - a[0] * h[0], h[2] - a[0] * h[1] - a[1] * h[0]])
        return DifferenceEquation(a, b, dt=dt)

    def continuous(self) -> StateSpace:
        """Two lags and a lag that carries the zero, one after the other."""
        A, B, C = self._cascade()
        return StateSpace(A, B, C[None])

    def _cascade(self) -> Tree:
        """A (3, 3), B (3, 1), C (3,): well scaled, and nothing is singular where poles coincide.

        The output of the cascade is p1 p2 p3 / prod(s + p). The zeros act on it as
        (1 - lead zero) x3' - zero x3 + lead x3''.
        """
        p1, p2, p3 = self.poles[0], self.poles[1], self.poles[2]
        A = jnp.array([[-p1, 0.0, 0.0], [p2, -p2, 0.0], [0.0, p3, -p3]])
        B = jnp.array([[1.0], [0.0], [0.0]]) * p1
        rate = jnp.array([0.0, p3, -p3])
        C = (1 - self.lead * self.zero) * rate + self.lead * (rate @ A)
        C = C.at[2].add(-self.zero) * self.gain / (p1 * p2 * p3)
        return A, B, C


def held(a: tuple[float, ...], b: tuple[float, ...], dt: float) -> VoiceCoil:
    """The motor whose zero-order hold is a difference equation with real poles and zeros.

        y[k] = a_1 y[k-1] + a_2 y[k-2] + a_3 y[k-3] + b_1 u[k-1] + b_2 u[k-2] + b_3 u[k-3]

    Each of its partial fractions is held by itself: r / (s + p) becomes r (1 - z_p) / p / (z - z_p)
    with z_p = exp(-p dt). Rounding of b leaves a second zero, far beyond the sample rate.
    """
    z = np.sort(np.roots([1.0, *np.negative(a)]))
    p = -np.log(z) / dt
    others = [np.delete(np.arange(3), i) for i in range(3)]
    shares = [np.polyval(b, z[i]) / np.prod(z[i] - z[rest]) for i, rest in enumerate(others)]
    terms = [shares[i] * p[i] / (1 - z[i]) * np.poly(-p[rest]) for i, rest in enumerate(others)]
    numerator = np.sum(terms, axis=0)
    far, zero = sorted(np.roots(numerator))
    return VoiceCoil(gain=-far * numerator[0], zero=zero, poles=p, lead=-1 / far)


def voice_coil(form: str = "exact") -> VoiceCoil:
    """The motor of Cao 2019 in one of three forms.

    exact:            eq. 7
    printed:          its difference equation 29 at 1 ms, whose rounding moves the DC gain from
                      -4.798 to -4.3
    dai_2014_printed: Dai 2014, eq. 24, where 2.236 stands for 2.2386, which moves the DC gain to
                      -1.19

    Raises ValueError for another form.
    """
    printed = {"printed": CAO_2019_EQ_29, "dai_2014_printed": DAI_2014_EQ_24}
    need_one_of("voice_coil", "form", form, ["exact", *printed])
    return held(*printed[form], dt=1e-3) if form in printed else VoiceCoil()
