"""Zero-phase filters for whole trials: the robustness filter Q of iterative learning control."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from .pytree import known, leaf, pytree, static


class Filter:
    """Maps a (N, n) signal of sample time dt [s] to one of the same shape, channel by channel, without phase shift."""

    def __call__(self, signal, dt):
        raise NotImplementedError

    def check(self, samples: int, dt: float) -> None:
        """Raises ValueError where the filter cannot serve trials of so many samples at this sample time."""


@pytree
class ZeroPhaseFIR(Filter):
    """Q(z) = taps_0 + sum_i taps_i (z^i + z^-i), symmetric by construction; beyond its ends the signal keeps its end values.

    taps: (m+1,) centre tap first; taps_0 + 2 sum taps_i = 1 for unit DC gain
    """

    taps: jax.Array = leaf((0.5, 0.25))

    def check(self, samples: int, dt: float) -> None:
        if self.taps.ndim != 1 or len(self.taps) > samples:
            raise ValueError(f"ZeroPhaseFIR: taps has shape {self.taps.shape}; allowed is (m+1,) with m < N = {samples}")

    def __call__(self, signal, dt):
        reach = self.taps.shape[0] - 1
        padded = jnp.pad(signal, ((reach, reach), (0, 0)), mode="edge")
        kernel = jnp.concatenate([self.taps[:0:-1], self.taps])
        return jax.vmap(lambda channel: jnp.convolve(channel, kernel, mode="valid"), in_axes=1, out_axes=1)(padded)


@pytree
class ZeroPhaseButterworth(Filter):
    """Butterworth low-pass run forward and backward, so of squared magnitude and zero phase.

    cutoff: () [Hz], -6 dB of the whole; differentiable.  order: of one pass, any order >= 1 (second-order sections)
    padding: samples of odd extension at each end, None for three filter lengths as scipy's `sosfiltfilt` takes them
    """

    cutoff: jax.Array = leaf(interval="(0, inf)")
    order: int = static(2, "[1, inf)", whole=True)
    padding: int | None = static(None, "[0, inf)", whole=True, optional=True)

    @property
    def edge(self) -> int:
        """Samples of odd extension at each end."""
        return 3 * (self.order + 1) if self.padding is None else self.padding

    def check(self, samples: int, dt: float) -> None:
        if known(self) and np.any(np.asarray(self.cutoff) >= 0.5 / dt):
            raise ValueError(
                f"ZeroPhaseButterworth: cutoff = {self.cutoff} Hz is outside its allowed range (0, {0.5 / dt:g}), Nyquist at dt = {dt:g} s"
            )
        if not 0 <= self.edge < samples:
            raise ValueError(
                f"ZeroPhaseButterworth: padding = {self.edge} is outside its allowed range [0, {samples - 1}] for N = {samples}"
            )

    def __call__(self, signal, dt):
        sections = butterworth_sections(self.cutoff, dt, self.order)
        extended = odd_extension(signal, self.edge)
        forward = run_sections(sections, extended)
        both = run_sections(sections, forward[::-1])[::-1]
        return both[self.edge : both.shape[0] - self.edge]


def butterworth_sections(cutoff, dt, order: int):
    """(order/2 rounded up, 5) rows b0 b1 b2 a1 a2 of a Butterworth low-pass, each section of unit DC gain.

    Bilinear transform with prewarping, K = tan(pi cutoff dt); a pole pair at -cos t +- i sin t becomes
        K^2 (1 + z^-1)^2 / ((1 + 2 K cos t + K^2) + 2 (K^2 - 1) z^-1 + (1 - 2 K cos t + K^2) z^-2)
    """
    K = jnp.tan(jnp.pi * cutoff * dt)
    rows = []
    for i in range(order // 2):
        damping = 2.0 * np.cos(np.pi * (order - 1 - 2 * i) / (2 * order))
        scale = 1.0 + damping * K + K**2
        rows.append(jnp.stack([K**2, 2.0 * K**2, K**2, 2.0 * (K**2 - 1.0), 1.0 - damping * K + K**2]) / scale)
    if order % 2:
        zero = jnp.zeros_like(K)
        rows.append(jnp.stack([K, K, zero, K - 1.0, zero]) / (1.0 + K))
    return jnp.stack(rows)


def odd_extension(signal, samples: int):
    """The signal reflected through its end points by so many samples at each end (scipy's odd_ext)."""
    if samples == 0:
        return signal
    left = 2.0 * signal[:1] - signal[samples:0:-1]
    right = 2.0 * signal[-1:] - signal[-2 : -samples - 2 : -1]
    return jnp.concatenate([left, signal, right])


def run_sections(sections, signal):
    """A cascade of second-order sections over a (N, n) signal, started in the steady state of its first sample."""
    settled, level = [], signal[0]
    for b0, b1, b2, a1, a2 in sections:
        gain = (b0 + b1 + b2) / (1.0 + a1 + a2)
        settled.append(((gain - b0) * level, (b2 - a2 * gain) * level))
        level = gain * level

    def tick(states, x):
        following = []
        for (b0, b1, b2, a1, a2), (s1, s2) in zip(sections, states, strict=True):
            y = b0 * x + s1
            following.append((b1 * x - a1 * y + s2, b2 * x - a2 * y))
            x = y
        return following, x

    return lax.scan(tick, settled, signal)[1]
