"""The switchable filter: a cutoff for each segment of the trial (Li 2020, section 5).

The segments are chosen from the reference.
"""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import scipy

from ..pytree.aliases import Leaf
from ..pytree.fields import leaf, pytree, static
from ..pytree.needs import known
from ..pytree.ranges import need_one_of, require
from .zero_phase import Filter, ZeroPhaseButterworth, need_cutoff, need_padding


@pytree
class SwitchableFilter(Filter):
    """Butterworth low-pass with a cutoff for each of S segments of the trial (Li 2020, eq. 12).

        Q u = sum_s w_s(t) Q_s u,    w_s = h_{s-1} - h_s
        h_i = 1/2 - 1/2 cos(pi clip((t - times_i) / width + 1/2, 0, 1)),    h_{-1} = 1, h_{S-1} = 0

    (The print of eq. 12 repeats the first interval.) Each Q_s is a `ZeroPhaseButterworth` over the
    whole trial, so no segment has ends of its own. The weights sum to 1: a signal that all Q_s pass
    is passed without a step. It costs as much as S filters.

    cutoff: (S,) [Hz]
    times:  (S-1,) middles of the changes, ascending [s]
    width:  () duration of a change [s]
    order, padding: as for `ZeroPhaseButterworth`, common to all

    width = 0 switches at the first sample at or after the time, with a step where the Q_s u differ.
    Its gradient in `times` and `width` is then zero, since nothing moves until a sample changes
    sides. For width > 0 the gradient is exact for the samples within the change.

    Raises ValueError for shapes that do not fit, times that do not ascend, or a width beyond the
    shortest segment.
    """

    cutoff: Leaf = leaf(interval="(0, inf)")
    times: Leaf = leaf(default=(), interval="(0, inf)")
    width: Leaf = leaf(default=0.0, interval="[0, inf)")
    order: int = static(default=2, interval="[1, 100]", whole=True)
    padding: int | None = static(default=None, interval="[0, inf)", whole=True, optional=True)

    def __post_init__(self):
        S = self.cutoff.shape[-1] if self.cutoff.ndim == 1 else 0
        if not S or self.times.shape != (S - 1,) or self.width.shape != ():
            raise ValueError(
                f"SwitchableFilter: cutoff {self.cutoff.shape}, times {self.times.shape}, width "
                f"{self.width.shape} do not fit; "
                "allowed are (S,), (S-1,) and () with S >= 1"
            )
        if known(self):
            self._need_segments(np.concatenate([[0.0], self.times]), "")

    def check(self, samples: int, dt: float) -> None:
        need_padding(self, samples)
        name, end = "SwitchableFilter", float(samples * dt)
        need_cutoff(name, self.cutoff, dt)
        if not known(self):
            return
        require(name, "times", self.times, f"(0, {end})", " s", many=True, note=", the trial")
        self._need_segments(np.concatenate([[0.0], self.times, [end]]), f" of a trial of {end:g} s")

    def weights(self, samples: int, dt: float) -> jax.Array:
        """(S, N) the share of each segment's filter at each sample; they sum to 1."""
        t, times = jnp.arange(samples) * dt, jnp.asarray(self.times)[:, None]
        # k dt is rounded: a sample that lies on a switching time shall not fall before it
        after = t >= times * (1 - 4 * jnp.finfo(t.dtype).eps) - 1e-9 * dt
        share = jnp.clip((t - times) / jnp.where(self.width > 0, self.width, 1.0) + 0.5, 0.0, 1.0)
        h = jnp.where(self.width > 0, 0.5 - 0.5 * jnp.cos(jnp.pi * share), after)
        whole = jnp.concatenate([jnp.ones_like(t)[None], h, jnp.zeros_like(t)[None]])
        return -jnp.diff(whole, axis=0)

    def __call__(self, signal, dt):
        def passed(cutoff):
            return ZeroPhaseButterworth(cutoff, self.order, self.padding)(signal, dt)

        of_segments = jax.vmap(passed)(jnp.asarray(self.cutoff))
        return jnp.einsum("sk,skn->kn", self.weights(signal.shape[0], dt), of_segments)

    def _need_segments(self, bounds, where):
        """Raises ValueError where a segment is empty, or shorter than a change."""
        name, one_another = "SwitchableFilter", ": the segments must follow one another"
        for i, (start, end) in enumerate(itertools.pairwise(map(float, bounds))):
            require(name, f"times[{i}]", end, f"({start}, inf)", " s", note=one_another)
            segment = f", the length of segment {i}{where}"
            require(name, "width", self.width, f"[0, {end - start}]", " s", note=segment)


def instantaneous_frequency(reference, dt, *, of="velocity", window=0.0, floor=0.01) -> np.ndarray:
    """Frequency of a reference at each sample, in the shape of the reference [Hz].

        f = max(0, arg sum_i g_i (conj z[k+i-1] z[k+i] + conj z[k+i] z[k+i+1]) / (2 pi dt))

    It is taken from the analytic signal z = v + i H v (Li 2020, section 5). It means something
    where one oscillation dominates. Every pair of samples counts with its power, so that the phase
    of a faint z, which is arbitrary, does not matter beside strong neighbours. Where the averaged
    power is below floor^2 of the trial's largest, nothing moves and f = 0. The Hilbert transform
    takes the trial as periodic: where its ends do not meet, about a period of the oscillation is
    wrong there.

    reference: (N+1,) or (N+1, n_y), each column by itself
    dt:        [s]
    window:    g is a Hann window of this duration [s]; 0 for two pairs
    of:        "velocity" takes v = dr/dt, which no offset or ramp disturbs; "position" takes v = r
               less its straight line
    floor:     in [0, 1), of the largest amplitude

    Raises ValueError for a value outside its range, or a reference that is not finite or too short.
    """
    r, name = np.asarray(reference, float), "instantaneous_frequency"
    if r.ndim not in (1, 2) or len(r) < 4 or not np.all(np.isfinite(r)):
        raise ValueError(
            f"{name}: reference of shape {r.shape} must be finite and have shape (N+1,) or (N+1, "
            "n_y) with N >= 3"
        )
    require(name, "dt", dt, "(0, inf)", " s")
    require(name, "window", window, f"[0, {float((len(r) - 1) * dt)}]", " s")
    require(name, "floor", floor, "[0, 1)")
    need_one_of(name, "of", of, ("velocity", "position"))
    v = np.gradient(r, dt, axis=0) if of == "velocity" else scipy.signal.detrend(r, axis=0)
    z = _analytic(v)
    pairs = np.conj(z[:-1]) * z[1:]
    nothing = np.zeros_like(pairs[:1])
    turn = np.concatenate([nothing, pairs]) + np.concatenate([pairs, nothing])
    power = np.abs(z) ** 2
    reach = min(round(window / (2 * dt)), (len(r) - 1) // 2)
    g = np.hanning(2 * reach + 3)[1:-1]
    turn, power = (
        np.apply_along_axis(np.convolve, 0, x, g / g.sum(), mode="same") for x in (turn, power)
    )
    moving = power > np.maximum(floor**2 * np.max(power, axis=0), np.finfo(float).tiny)
    return np.where(moving, np.maximum(np.angle(turn), 0.0) / (2 * np.pi * dt), 0.0)


def _analytic(v) -> np.ndarray:
    """The analytic signal v + i H v of each column, whose spectrum has no negative frequencies.

    scipy.signal.hilbert does the same, but takes longer to import than most trials to simulate.
    """
    N, one_sided = len(v), np.zeros(len(v))
    one_sided[[0, N // 2]] = 1.0  # the mean, and for even N half the sample rate
    one_sided[1 : (N + 1) // 2] = 2.0
    return np.fft.ifft(np.fft.fft(v, axis=0) * one_sided.reshape(-1, *(1,) * (v.ndim - 1)), axis=0)


def segments(
    reference,
    dt,
    *,
    cutoffs,
    threshold,
    shortest,
    width=0.0,
    order=2,
    padding=None,
    of="velocity",
    window=0.0,
    floor=0.01,
) -> SwitchableFilter:
    """The switchable filter whose cutoff is high where the reference is fast (Li 2020, section 5).

    It is fast where f(t) > threshold in any column.

    reference: (N+1,) or (N+1, n_y)
    dt:        [s]
    cutoffs:   (low, high) [Hz]; see `cutoffs_below` for what the theory has to say
    threshold: of the instantaneous frequency [Hz]
    shortest:  segments below this duration [s] are merged into their neighbours, the shortest first
    width, order, padding: of the filter
    of, window, floor: of `instantaneous_frequency`

    A reference that never crosses the threshold gives a single segment. Raises ValueError for a
    value outside its range, and as the filter's own `check` does.
    """
    frequency = instantaneous_frequency(reference, dt, of=of, window=window, floor=floor)
    N = len(frequency) - 1
    _need_pair("segments", "cutoffs", cutoffs, " Hz")
    require("segments", "threshold", threshold, "(0, inf)", " Hz")
    require("segments", "shortest", shortest, f"[0, {float(N * dt)})", " s")
    fast = np.any(frequency.reshape(N + 1, -1) > threshold, axis=1)[:N]
    starts, kinds = _merged(np.flatnonzero(np.diff(fast)) + 1, fast, shortest / dt)
    found = SwitchableFilter(
        np.where(kinds, cutoffs[1], cutoffs[0]), starts * dt, width, order, padding
    )
    found.check(N, dt)
    return found


def cutoffs_below(critical, *, shares=(0.2, 0.8)) -> tuple[float, float]:
    """(low, high) cutoffs [Hz] as shares of the critical frequency, for `segments`.

    critical: where |keep - L P| first reaches 1 [Hz]; what lies beyond must not be learned (Li
              2020, section 4). It is `learning_condition(machine, scheme, task).critical` of
              `jaxilc.theory.frequency` for the scheme *without* a filter
    shares:   (low, high), ascending. At its cutoff a zero-phase Butterworth still lets half pass,
              hence less than 1. Whether that is enough, the same condition of the filtered scheme
              says, with the higher cutoff throughout

    Raises ValueError for a value outside its range. An infinite critical frequency needs no filter.
    """
    require("cutoffs_below", "critical", critical, "(0, inf)", " Hz")
    _need_pair("cutoffs_below", "shares", shares)
    return float(shares[0] * critical), float(shares[1] * critical)


def _need_pair(owner: str, name: str, pair, unit: str = "") -> None:
    if np.shape(pair) != (2,) or not 0 < pair[0] <= pair[1]:
        raise ValueError(
            f"{owner}: {name} = {pair}{unit}; allowed is a pair (low, high) with 0 < low <= high"
        )


def _merged(starts, fast, shortest):
    """Starts (S-1,) of later segments, kinds (S,); those below `shortest` samples have joined."""
    bounds = np.concatenate([[0], starts, [len(fast)]])
    kinds = fast[bounds[:-1]]
    while len(kinds) > 1 and np.min(np.diff(bounds)) < shortest - 1e-9:
        i = int(np.argmin(np.diff(bounds)))
        # the bounds of this segment, other than the ends of the trial
        inner = slice(max(i, 1), min(i + 2, len(kinds)))
        kinds = np.delete(kinds, slice(max(i, 1), inner.stop)) if i else kinds[1:]
        bounds = np.delete(bounds, inner)
    return bounds[1:-1], kinds
