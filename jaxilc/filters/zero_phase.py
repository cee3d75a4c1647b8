"""Zero-phase filters for whole trials: the robustness filter Q of iterative learning control.

A recursive filter has to assume how a signal goes on beyond the ends of the trial, and that decides
on learning there. The odd extension of scipy's `filtfilt` pins the end values and passes more than
it is given: of 323 random servo loops with |Q (1 - L P)| < 0.97 at every frequency, P-type learning
with a lead grew at the ends on 131. Mirrored at its ends, a signal never comes out larger where
|Q| <= 1.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from ..pytree.aliases import Leaf
from ..pytree.fields import leaf, pytree, static
from ..pytree.needs import known
from ..pytree.ranges import require
from ..runtime.lanes import over_samples


class Filter:
    """A map of a (N, n) signal of sample time dt [s] to one of the same shape.

    It works channel by channel, and without phase shift.
    """

    in_words = "Filter (ZeroPhaseIIR(b, a) or another of jaxilc.filters)"

    def __call__(self, signal, dt):
        raise NotImplementedError

    def check(self, samples: int, dt: float) -> None:
        """Raises ValueError where the filter cannot serve trials of so many samples at this dt."""


@pytree
class ZeroPhaseFIR(Filter):
    """Q(z) = taps_0 + sum_i taps_i (z^i + z^-i), symmetric by construction.

    Beyond its ends the signal keeps its end values.

    taps: (m+1,) centre tap first; taps_0 + 2 sum taps_i = 1 for unit DC gain
    """

    taps: Leaf = leaf(default=(0.5, 0.25))

    def check(self, samples: int, dt: float) -> None:
        if self.taps.ndim != 1 or len(self.taps) > samples:
            raise ValueError(
                f"ZeroPhaseFIR: taps has shape {self.taps.shape}; allowed is (m+1,) with m < N = "
                f"{samples}"
            )

    def __call__(self, signal, dt):
        reach = self.taps.shape[0] - 1
        padded = jnp.pad(signal, ((reach, reach), (0, 0)), mode="edge")
        kernel = jnp.concatenate([self.taps[:0:-1], self.taps])
        of_channel = lambda channel: jnp.convolve(channel, kernel, mode="valid")  # noqa: E731
        return jax.vmap(of_channel, in_axes=1, out_axes=1)(padded)


@pytree
class ZeroPhaseButterworth(Filter):
    """Butterworth low-pass run forward and backward, so of squared magnitude and zero phase.

        Q = 1 / (1 + (tan(pi f dt) / tan(pi cutoff dt))^(2 order))

    cutoff:  () [Hz], -6 dB of the whole; differentiable
    order:   of one pass, any order >= 1 (second-order sections)
    padding: samples of odd extension at each end, as scipy's `sosfiltfilt` takes `padlen` (its
             default is 3 (order + 1)); None mirrors the signal at its ends, see `mirrored`
    """

    cutoff: Leaf = leaf(interval="(0, inf)")
    order: int = static(default=2, interval="[1, 100]", whole=True)
    padding: int | None = static(default=None, interval="[0, inf)", whole=True, optional=True)

    def check(self, samples: int, dt: float) -> None:
        need_cutoff("ZeroPhaseButterworth", self.cutoff, dt)
        need_padding(self, samples)

    def __call__(self, signal, dt):
        if self.padding is None:
            with np.errstate(divide="ignore"):
                octaves = np.log(np.tan(half_angles(len(signal))))  # -inf at rest
            below = jnp.log(jnp.tan(jnp.pi * self.cutoff * dt)) - octaves
            # 1 / (1 + ratio^(2 order)) without a power that could overflow
            return mirrored(signal, jax.nn.sigmoid(2 * self.order * below))
        one_pass = partial(butterworth_pass, self.cutoff, dt, self.order)
        return forward_and_backward(one_pass, signal, self.padding)


@pytree
class ZeroPhaseBandStop(Filter):
    """Butterworth band-stop filter, run forward and backward on a signal mirrored at its ends.

        F = 1 / (1 + (B x / (x^2 - x_l x_h))^(2 order)),   x = tan(pi f dt),   B = x_h - x_l

    with x_l and x_h at the edges `low` and `high`. F is 0 at one frequency between the edges, 1 at
    rest and at the Nyquist frequency, and 1/2 (-6 dB) at both edges. As `ErrorFiltered` it keeps a
    law from learning around a resonance.

    low, high: () edges [Hz], 0 < low < high < 1 / (2 dt); differentiable
    order:     of one pass

    Raises ValueError for edges that do not rise; `check` raises it for edges from the Nyquist
    frequency on.
    """

    low: Leaf = leaf(interval="(0, inf)")
    high: Leaf = leaf(interval="(0, inf)")
    order: int = static(default=2, interval="[1, 100]", whole=True)

    def __post_init__(self):
        if known(self) and not np.all(np.asarray(self.low) < np.asarray(self.high)):
            raise ValueError(
                f"ZeroPhaseBandStop: high = {self.high} Hz; allowed is more than low = "
                f"{self.low} Hz"
            )

    def check(self, samples: int, dt: float) -> None:
        need_cutoff("ZeroPhaseBandStop", self.high, dt, "high")

    def __call__(self, signal, dt):
        return mirrored(signal, self.response(half_angles(len(signal)), dt))

    def response(self, angles, dt) -> jax.Array:
        """F at pi f dt = angles (F,).

        Sine and cosine stand in place of the tangent, which is infinite at the Nyquist frequency,
        and logarithms in place of the power, which could overflow.
        """
        low, high = (jnp.tan(jnp.pi * edge * dt) for edge in (self.low, self.high))
        sin, cos = jnp.sin(angles), jnp.maximum(jnp.cos(angles), 0.0)
        band = jnp.log(sin * cos)  # -inf at rest
        distance = jnp.abs(sin**2 - low * high * cos**2)
        distance = jnp.maximum(distance, jnp.finfo(distance.dtype).tiny)
        return jax.nn.sigmoid(2 * self.order * (jnp.log(distance) - jnp.log(high - low) - band))


# Li 2020, section 4: printed as a fourth-order Butterworth at 10 Hz, for
# `ZeroPhaseIIR(**PRINTED_LI_2020)`. See there.
PRINTED_LI_2020 = {"b": (0.0, 0.00018896, 0.00017992), "a": (1.0, -2.8531, 2.7167, -0.8633)}


@pytree
class ZeroPhaseIIR(Filter):
    """A given recursive filter run forward and backward (Li 2020, eq. 10 and 11).

        a_0 y[k] = b_0 x[k] + ... + b_m x[k-m] - a_1 y[k-1] - ... - a_n y[k-n]

    It does as scipy's `filtfilt`; the whole is |B/A|^2 at zero phase.

    b:       (m+1,) coefficients
    a:       (n+1,) coefficients, poles inside the unit circle
    padding: samples of odd extension at each end (`filtfilt` takes 3 max(m+1, n+1)), where both
             passes start in the steady state of their first sample; None mirrors the signal at its
             ends, see `mirrored`

    Transfer functions lose digits beyond order 6: `ZeroPhaseButterworth` designs by second-order
    sections.

    The coefficients printed in Li 2020 (`PRINTED_LI_2020`) need care. They are of third order, not
    fourth: a Butterworth by impulse invariance at cutoff / sample rate = 0.0117, so 10 Hz at 855
    Hz, whereas the paper's samples are 2 ms, where it is 5.85 Hz. And sum(a) = 0.0003 has one digit
    left after rounding: the DC gain of a pass is 1.23, so 1.51 forward and backward. A robustness
    filter multiplies what was learned by that in every trial; dividing b by 1.23 repairs it.

    Raises ValueError for empty coefficients, a_0 = 0, or a pole on or outside the unit circle.
    """

    b: Leaf = leaf()
    a: Leaf = leaf()
    padding: int | None = static(default=None, interval="[0, inf)", whole=True, optional=True)

    def __post_init__(self):
        for name in ("b", "a"):
            if getattr(self, name).ndim != 1 or not getattr(self, name).size:
                raise ValueError(
                    f"ZeroPhaseIIR: {name} has shape {getattr(self, name).shape}; allowed is (n+1,)"
                )
        if known(self):
            if self.a[0] == 0:
                raise ValueError("ZeroPhaseIIR: a[0] = 0; allowed is any other number")
            radius = np.max(np.abs(np.roots(self.a)), initial=0.0)
            if radius >= 1:
                raise ValueError(
                    f"ZeroPhaseIIR: a = {self.a} has a pole of magnitude {radius:.6g}; allowed is "
                    "below 1"
                )

    def check(self, samples: int, dt: float) -> None:
        need_padding(self, samples)

    def __call__(self, signal, dt):
        both = jnp.asarray(self.b), jnp.asarray(self.a)
        if self.padding is None:
            z = jnp.exp(2j * half_angles(len(signal)))
            above, below = (jnp.polyval(c[::-1].astype(z.dtype), 1 / z) for c in both)
            return mirrored(signal, jnp.abs(above / below) ** 2)
        order = max(map(len, both)) - 1
        b, a = (jnp.pad(c / self.a[0], (0, order + 1 - len(c))) for c in both)
        # register i of the transposed direct form, at rest under a constant input of 1
        rest = jnp.cumsum((b - a * jnp.sum(b) / jnp.sum(a))[:0:-1])[::-1]

        def one_pass(x):
            def tick(registers, now):
                y = b[0] * now + (registers[0] if order else 0.0)
                shifted = jnp.concatenate([registers[1:], jnp.zeros_like(registers[:1])])
                return shifted + b[1:, None] * now - a[1:, None] * y, y

            return over_samples(tick, rest[:, None] * x[0], x)[1]

        return forward_and_backward(one_pass, signal, self.padding)


def need_cutoff(owner: str, cutoff: Leaf, dt: float, name: str = "cutoff") -> None:
    """Raises ValueError unless all cutoffs [Hz] that are known are below half the sample rate."""
    if known(cutoff):
        below, note = f"(0, {float(0.5 / dt)})", f", Nyquist at dt = {dt:g} s"
        require(owner, name, cutoff, below, " Hz", many=True, note=note)


def need_padding(q, samples: int) -> None:
    """Raises ValueError if a filter's odd extension is longer than the trial itself."""
    if q.padding is not None and q.padding >= samples:
        name = type(q).__name__
        raise ValueError(
            f"{name}: padding = {q.padding} is outside its allowed range [0, {samples - 1}] for N "
            f"= {samples}"
        )


def half_angles(samples: int) -> np.ndarray:
    """(N+1,) pi f dt of the frequencies at which `mirrored` takes its response.

    They go from 0 to half of the Nyquist angle pi, and no rounding puts the last one beyond it,
    where the tangent would be negative.
    """
    return np.pi / 2 * (np.arange(samples + 1) / samples)


def mirrored(signal, response) -> jax.Array:
    """The (N, n) signal through a zero-phase filter, mirrored at its ends for ever.

    response: (N+1,) Q, real, at the frequencies i / (2 N dt)

    In the basis of cosines (DCT-II) it is the multiplication by Q: a symmetric matrix whose
    eigenvalues are values of Q, so that nothing comes out larger where |Q| <= 1. A constant passes
    by Q(0).
    """
    both = jnp.fft.rfft(jnp.concatenate([signal, signal[::-1]]), axis=0)
    return jnp.fft.irfft(both * response[:, None], n=2 * len(signal), axis=0)[: len(signal)]


def forward_and_backward(one_pass, signal, edge: int) -> jax.Array:
    """A causal filter run over the (N, n) signal and back, with odd extension at each end."""
    extended = jnp.pad(signal, ((edge, edge), (0, 0)), mode="reflect", reflect_type="odd")
    forward = one_pass(extended)
    both = one_pass(forward[::-1])[::-1]
    return both[edge : both.shape[0] - edge]


def butterworth_pass(cutoff, dt, order: int, signal) -> jax.Array:
    """A causal Butterworth low-pass over a (N, n) signal, from rest at its first sample.

    The bilinear transform with prewarping, K = tan(pi cutoff dt), by the states of integrators: of
    a pole pair at -cos t +- i sin t

        h = K / (1 + K D) (x - s_2 - D s_1),   v = s_1 + h,     y = s_2 + K v,   D = K + 2 cos t
                                               s_1' = v + h,   s_2' = y + K v

    and h = K / (1 + K) (x - s), y = s + h, s' = y + h of a real pole. They pass a constant as it
    is, where b0 b1 b2 a1 a2 lose cutoff^2 dt^2 to rounding: in float32 all of it.
    """
    K = jnp.tan(jnp.pi * cutoff * dt)
    signal = jnp.asarray(signal, jnp.result_type(signal, K))
    angles = np.pi * np.arange(order - 1, 0, -2) / (2 * order)
    dampings = [K + 2.0 * np.cos(angle) for angle in angles]
    gains, of_real = [K / (1.0 + K * D) for D in dampings], K / (1.0 + K)

    def tick(states, x):
        (pairs, last), following = states, []
        for (s1, s2), D, gain in zip(pairs, dampings, gains, strict=True):
            h = gain * (x - s2 - D * s1)
            v = s1 + h
            rise = K * v
            x = s2 + rise
            following.append((v + h, x + rise))
        if order % 2:
            h = of_real * (x - last)
            x = last + h
            last = x + h
        return (following, last), x

    at_rest = [(jnp.zeros_like(signal[0]), signal[0]) for _ in dampings]
    return over_samples(tick, (at_rest, signal[0]), signal)[1]
