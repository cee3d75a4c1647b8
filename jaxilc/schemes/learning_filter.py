"""Learning by two filters of finite length, causal or not: the general linear law by its taps."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ..filters import Filter, Inverse, SwitchableFilter, ZeroPhaseFIR
from ..filters.inversion import CIRCLE, Factors, factors
from ..plants import StateSpace
from ..pytree.aliases import Array, Function, Leaf, Tree, Value
from ..pytree.fields import leaf, pytree, static
from ..pytree.needs import known, need_channels
from ..pytree.ranges import as_numbers, brief, require
from ..signals.task import Task, Trial
from .scheme import Feedforward, Scheme, limited, need_square

ROUNDING = 100.0  # in units of the last place: smaller shares of the largest tap are no tap
ALIKE = 1e-9  # relative difference between two places of a trial that rounding explains


class FilterTaps(NamedTuple):
    """(F x)[k] = sum_i taps_i x[k + first + i], the taps in the order of time.

    first: shift of the first tap in samples, negative for the past
    taps:  (n,)
    dt:    sample time that they belong to [s]; None where they are of any
    """

    first: int
    taps: np.ndarray
    dt: float | None


def taps_of(
    given: Value, name: str, *, dt: float | None, tolerance: float, most: int
) -> FilterTaps:
    """The taps of a filter, until they have fallen below a share of the largest.

    given: an odd number of taps with the one without a shift in the middle, or a single number; a
        system of one input and one output as `filters.factors` takes it, also an improper one; or a
        `Filter` that does the same at every sample
    name: what messages call it
    dt: sample time [s], where `given` has none
    tolerance, most: as in `learning_filter`

    A system is expanded on the unit circle (its Laurent series): poles within it give taps on the
    past, poles outside give taps on the future, and so do zeros beyond the number of poles.

    Raises ValueError where `given` is none of these, where it does not decay, because a pole lies
    on the unit circle, and where more than `most` taps are needed.
    """
    if not is_operator(given):
        return _of_list(given, name)
    tolerance = max(tolerance, ROUNDING * float(np.finfo(float).eps))
    if isinstance(given, Filter):
        found = _of_filter(given, name, dt, tolerance, most)
    else:
        found = _of_system(factors(given, dt), name, tolerance, most)
    found = shortened(found, tolerance)
    if len(found.taps) > most:
        raise _too_many(name, most, tolerance)
    return found


def is_operator(given: Value) -> bool:
    """Whether it is a filter or a system, which acts from x[k] to (F x)[k], and no list of taps."""
    import control

    systems = StateSpace | Factors | control.StateSpace | control.TransferFunction
    return isinstance(given, Filter | systems)


def shortened(found: FilterTaps, tolerance: float) -> FilterTaps:
    """Without the taps at both ends that are below a share of the largest one."""
    size = np.abs(found.taps)
    kept = np.flatnonzero(size > tolerance * np.max(size))
    if not len(kept):
        return FilterTaps(0, np.zeros(1), found.dt)
    return found._replace(first=found.first + int(kept[0]), taps=found.taps[kept[0] : kept[-1] + 1])


# How it is done
# --------------------------------------------------------------------------------------------------


def _of_list(given: Value, name: str) -> FilterTaps:
    values = as_numbers(given)
    if values is None:
        raise ValueError(
            f"{name} = {brief(given)} is a {type(given).__name__}; allowed are taps, a StateSpace, "
            "a system of python-control, and a filter of jaxilc.filters, such as stable_inverse(P)"
        )
    taps = np.atleast_1d(np.asarray(values, float))
    if taps.ndim != 1 or not len(taps) % 2 or not np.all(np.isfinite(taps)):
        raise ValueError(
            f"{name} = {brief(given)} has shape {np.shape(values)}; allowed is an odd number of "
            "finite taps (2 n + 1,), the one without a shift in the middle"
        )
    return FilterTaps(-(len(taps) // 2), taps, None)


def _of_system(P: Factors, name: str, tolerance: float, most: int) -> FilterTaps:
    """The Laurent series, by the transform of the response on the circle.

    The response is taken at more and more points, until the taps have died out half way round.
    """
    distance = np.abs(np.abs(P.poles) - 1)
    for pole in P.poles[distance < CIRCLE]:
        raise ValueError(
            f"{name}: its taps do not decay, because the pole z = {pole:.6g} lies on the unit "
            f"circle; allowed is a distance of {CIRCLE:g}. A pole that a zero cancels is left out "
            "by control.minreal"
        )
    points = 2 ** int(np.ceil(np.log2(64 + 4 * (len(P.poles) + len(P.zeros)))))
    while True:
        z = np.exp(2j * np.pi * np.arange(points) / points)
        above, below = (
            np.prod(z[:, None] - roots[None, :], axis=1) for roots in (P.zeros, P.poles)
        )
        taps = np.fft.fftshift(np.fft.fft(P.gain * above / below).real) / points
        size, edge = np.abs(taps), points // 8
        if max(np.max(size[:edge]), np.max(size[-edge:])) <= tolerance * np.max(size):
            return FilterTaps(-(points // 2), taps, P.dt)
        if points > 4 * most:
            raise _too_many(name, most, tolerance, float(np.min(distance)))
        points *= 2


def _of_filter(
    given: Filter, name: str, dt: float | None, tolerance: float, most: int
) -> FilterTaps:
    """The answers to an impulse at two places of a long trial, which must be the same."""
    what = type(given).__name__
    own = given.dt if isinstance(given, Inverse) else None
    if own and dt and abs(own - dt) > 1e-9 * dt:
        raise ValueError(
            f"{name}: {what} is designed for dt = {own:.10g} s but dt = {dt:.10g} s; allowed "
            f"is dt = {own:.10g}"
        )
    if not (own or dt or isinstance(given, ZeroPhaseFIR)):
        raise ValueError(f"{name}: {what} needs dt, the sample time [s]; allowed is (0, inf)")
    if isinstance(given, SwitchableFilter):
        raise _varies(name, what)
    samples = 3 * most + 1
    given.check(samples, own or dt or 1.0)
    taps, other = np.asarray(_answers(given, samples, most, own or dt or 1.0))
    tolerance = max(tolerance, ROUNDING * float(np.finfo(taps.dtype).eps))
    size, edge = np.abs(taps), max(most // 8, 1)
    if not max(np.max(size[:edge]), np.max(size[-edge:])) <= tolerance * np.max(size):
        raise _too_many(name, most, tolerance)
    if np.max(np.abs(taps - other)) > ALIKE * np.max(size):
        raise _varies(name, what)
    taps = np.where(size > tolerance * np.max(size), taps, 0.0)
    return FilterTaps(-most, np.asarray(taps, float), own or dt)


def _answers(given: Filter, samples: int, reach: int, dt: float) -> Array:
    """(2, 2 reach + 1) the taps, seen from an impulse after `reach` samples and after twice that.

    (F x)[k] = sum_p taps_p x[k + p] answers an impulse at K with taps_p at k = K - p.
    """
    impulses = jnp.zeros((samples, 2)).at[jnp.array([reach, 2 * reach]), jnp.array([0, 1])].set(1.0)
    answer = jax.jit(lambda f, x: f(x, dt))(given, impulses)
    return jnp.stack([answer[: 2 * reach + 1, 0], answer[reach : 3 * reach + 1, 1]])[:, ::-1]


def _varies(name: str, what: str) -> ValueError:
    return ValueError(
        f"{name}: {what} is another filter at other samples of the trial; allowed is one that is "
        "the same throughout (Filtered takes it as it is)"
    )


def _too_many(name: str, most: int, tolerance: float, distance: float | None = None) -> ValueError:
    near = "" if distance is None else f", since a pole lies {distance:.3g} from the unit circle"
    return ValueError(
        f"{name}: more than most = {most} taps are needed until they fall below tolerance = "
        f"{tolerance:g} of the largest{near}; allowed are a larger most, up to the samples of the "
        "trial, and a larger tolerance"
    )


@pytree
class LearningFilter(Scheme):
    """The general linear law with a memory of one trial, by its taps (Bristow 2006, eq. 3).

        u_{j+1}[k] = sum_i keep_i u_j[k + i - m] + sum_i L_i e_j[k + 1 + lead + i - n]

    where i runs over the 2 m + 1 taps of keep and over the 2 n + 1 taps of L; the middle tap is the
    one without a shift. With the default of keep, which is 1, the law is u_{j+1} = u_j + L e_j, and
    `Filtered(LearningFilter(L), Q)` is u_{j+1} = Q (u_j + L e_j). With keep = Q and L = M the law
    is u_{j+1} = Q u_j + M e_j, for any M; the synthesis of filters finds such laws. P-type learning
    of lead m has the single tap L = gamma_p.

    Beyond the ends of the trial the error counts as zero, and u is mirrored. So symmetric taps of
    keep with |Q| <= 1 make no input larger, also at the ends.

    Taps are numbers, and each channel learns from its own error; or they are matrices, and each
    input learns from all errors. With `starts` they are scheduled: the trial is cut into segments,
    and u_{j+1}[k] follows from the taps of the segment of k.

    L:    (p,) or (p, n_u, n_y) taps of the learning filter, p = 2 n + 1, earliest error first
        [unit of u per unit of y]; with S segments (S, p) or (S, p, n_u, n_y)
    keep: (p',) or (p', n_u, n_u) taps on what was learned before, p' = 2 m + 1, earliest first;
        with S segments also (S, p') or (S, p', n_u, n_u)
    lead: samples of look-ahead of the middle tap beyond the one sample from u[k] to y[k+1]
    limit: () or (n_u,) largest |u| that is learned [unit of u]; None: no limit
    starts: first samples of the segments after the first, rising; () for one law in all samples
    dt: sample time that the taps were found for [s]; None: any

    `learning_filter` finds the taps of any L(q) and Q(q): of systems, inverses and filters.
    Raises ValueError for taps that are not an odd number, and for another number of segments;
    `check` raises it for taps of other channels, for taps, a lead or a segment that reach beyond
    the whole trial, and for another sample time.
    """

    L: Leaf = leaf()
    keep: Leaf = leaf(default=(1.0,))
    limit: Leaf | None = leaf(default=None, interval="(0, inf)", optional=True)
    lead: int = static(default=0, interval="[0, inf)", whole=True)
    starts: tuple[int, ...] = static(default=())
    dt: float | None = static(default=None, interval="(0, inf)", optional=True)
    clips = ("limit",)

    def __post_init__(self) -> None:
        for name in ("L", "keep"):
            shape, scheduled = getattr(self, name).shape, self._scheduled(name)
            segments = len(self.starts) + 1
            if len(shape) not in (1, 2, 3, 4) or not shape[scheduled] % 2:
                raise ValueError(
                    f"LearningFilter: {name} has shape {shape}; allowed is an odd number of taps, "
                    "(2 n + 1,) or as matrices (2 n + 1, n_u, n), the one without a shift in the "
                    "middle"
                )
            if scheduled and shape[0] != segments:
                raise ValueError(
                    f"LearningFilter: {name} has shape {shape}, taps of {shape[0]} segments, but "
                    f"starts = {self.starts} make {segments}"
                )
        if any(a >= b for a, b in zip((0, *self.starts), self.starts, strict=False)):
            raise ValueError(
                f"LearningFilter: starts = {self.starts}; allowed are samples above 0 that rise"
            )

    def check(self, task: Task) -> None:
        need_channels(self, task.inputs, "limit")
        if self.dt and known(task.dt) and abs(self.dt - task.dt) > 1e-9 * task.dt:
            raise ValueError(
                f"LearningFilter: dt = {self.dt:.10g} s is not that of the task, {task.dt:.10g} s; "
                "allowed are the same, and None for taps of any sample time"
            )
        for name, seen in (("L", task.outputs), ("keep", task.inputs)):
            taps = getattr(self, name)
            if taps.ndim > 2 and taps.shape[-2:] != (task.inputs, seen):
                raise ValueError(
                    f"LearningFilter: {name} has shape {taps.shape}; allowed are matrices of "
                    f"({task.inputs}, {seen}) for this task"
                )
            if taps.ndim <= 2 and name == "L":
                need_square(self, task)
        reach = self.lead + self._taps("L") // 2
        for what, samples in (
            ("lead and L reach", reach),
            ("keep reaches", self._taps("keep") // 2),
            ("the last of starts reaches", max(self.starts, default=0)),
        ):
            if samples >= task.N:
                raise ValueError(
                    f"LearningFilter: {what} over {samples} samples; allowed is less than the "
                    f"trial of N = {task.N}"
                )

    def learn(self, memory: Feedforward, trial: Trial) -> Feedforward:
        N, n, m = trial.u.shape[0], self._taps("L") // 2, self._taps("keep") // 2
        e = jnp.pad(trial.e, ((n, n + self.lead), (0, 0)))[1 + self.lead :][: N + 2 * n]
        u = jnp.pad(trial.u, ((m, m), (0, 0)), mode="symmetric")
        return Feedforward(limited(self._through("keep", u) + self._through("L", e), self.limit))

    def segments(self) -> list[LearningFilter]:
        """The law of each segment, as if it were that of all samples."""
        of_each = (
            getattr(self, name)
            if self._scheduled(name)
            else [getattr(self, name)] * (len(self.starts) + 1)
            for name in ("L", "keep")
        )
        return [
            dataclasses.replace(self, L=L, keep=keep, starts=())
            for L, keep in zip(*of_each, strict=True)
        ]

    def _scheduled(self, name: str) -> bool:
        return getattr(self, name).ndim % 2 == 0

    def _taps(self, name: str) -> int:
        """The number of taps."""
        return getattr(self, name).shape[self._scheduled(name)]

    def _through(self, name: str, signal: Array) -> Array:
        """(N, n_u) the signal through the taps of each segment."""
        taps = jnp.asarray(getattr(self, name))
        if not self._scheduled(name):
            return correlated(taps, signal)
        each = lax.map(lambda one: correlated(one, signal), taps)
        return jnp.einsum("sk,skn->kn", in_segments(self.starts, each.shape[1]), each)


def segments_of(scheme: Scheme) -> list[Scheme]:
    """The scheme with the law of each segment of its trial in all samples.

    Of a scheme whose law is not scheduled it is the scheme itself.
    """
    segments: Function | None = getattr(scheme, "segments", None)
    if segments is not None:
        return segments()
    for name in ("learning", "scheme"):
        part = getattr(scheme, name, None)
        if isinstance(part, Scheme):
            found = segments_of(part)
            return [dataclasses.replace(scheme, **{name: one}) for one in found]
    return [scheme]


def learning_filter(
    L: Value,
    Q: Value = None,
    *,
    gain: Value = 1.0,
    lead: int = 0,
    limit: Value = None,
    dt: float | None = None,
    tolerance: float = 1e-12,
    most: int = 4001,
) -> LearningFilter:
    """The law u_{j+1} = Q (u_j + gain q^lead L e_j) of any linear filters, causal or not, as taps.

    L and Q may each be
        a system of python-control, discrete or sampled at dt, also improper: `0.5 / P`
        a `StateSpace` or `filters.Factors`
        a filter of `jaxilc.filters`: `stable_inverse(P)`, `zpetc(P)`, `ZeroPhaseButterworth(40.0)`
        an odd number of taps, or one number

    Systems and filters act as the operators that they are: (L e)[k] is learned into u[k]. The
    inverse of a plant holds the advance of one sample from u[k] to y[k+1] already, so with
    `learning_filter(stable_inverse(P), gain=0.8)` a fifth of the error is left after each trial.
    Taps are those of `LearningFilter`: the middle one of L belongs to e[k+1].
    Poles of a system within the unit circle act on the past, and those outside on the future.

    lead: whole number of samples by which L looks further ahead, or back where it is negative
    limit: as in `LearningFilter`
    dt: sample time [s], where L or Q has none of its own but depends on it
    tolerance: in (0, 1); taps at the ends below this share of the largest are left out
    most: largest number of taps of each filter

    Beyond the ends of the trial the error counts as zero and u is mirrored; `Filtered` keeps the
    ends of Q as Q has them. Raises ValueError as `taps_of` does, for values out of range, and where
    L and Q are of different sample times.
    """
    owner = "learning_filter"
    require(owner, "lead", lead, f"[-{most}, {most}]", whole=True)
    require(owner, "tolerance", tolerance, "(0, 1)")
    require(owner, "most", most, "[1, 1e6]", whole=True)
    found = taps_of(L, f"{owner}: L", dt=dt, tolerance=tolerance, most=most)
    ahead = 0 if is_operator(L) else 1
    found = found._replace(first=found.first + lead + ahead)
    keep = FilterTaps(0, np.ones(1), None)
    if Q is not None:
        keep = taps_of(Q, f"{owner}: Q", dt=found.dt or dt, tolerance=tolerance, most=most)
        both = FilterTaps(
            found.first + keep.first, np.convolve(found.taps, keep.taps), found.dt or keep.dt
        )
        found = shortened(both, tolerance)
    start, end = found.first, found.first + len(found.taps) - 1
    middle = max((start + end) // 2, 1)
    of_L, of_keep = _around(found, middle), _around(keep, 0)
    return LearningFilter(
        gain * of_L, keep=of_keep, limit=limit, lead=middle - 1, dt=found.dt or keep.dt
    )


def _around(found: FilterTaps, middle: int) -> np.ndarray:
    """(2 n + 1,) the taps with the one of shift `middle` in the middle."""
    first, last = found.first - middle, found.first + len(found.taps) - 1 - middle
    reach = max(-first, last, 0)
    taps = np.zeros(2 * reach + 1)
    taps[reach + first : reach + last + 1] = found.taps
    return taps


@jax.custom_jvp
def correlated(taps: Array, signal: Array) -> Array:
    """(N, n) sum_i taps_i signal[k + i] of a signal (N + p - 1, n_in).

    taps: (p,) the same for each channel by itself, so that n = n_in; or (p, n, n_in) matrices

    The derivative is computed by Fourier transforms: with 61 taps and 2000 samples, reverse mode
    through the sum itself took four times as long (double precision, CPU). Its rounding is a share
    of the largest value, not of each.
    """
    if taps.ndim == 1:
        return jax.vmap(lambda x: jnp.correlate(x, taps, mode="valid"), 1, 1)(signal)

    def pair(of_pair: Array, x: Array) -> Array:
        return jnp.correlate(x, of_pair, mode="valid")

    of_output = jax.vmap(pair, (1, 1))
    return jnp.sum(jax.vmap(of_output, (1, None))(taps, signal), axis=1).T


@correlated.defjvp
def _correlated_jvp(primals: Tree, changes: Value) -> tuple[Tree, Tree]:
    (taps, signal), (d_taps, d_signal) = primals, changes
    return correlated(taps, signal), _by_transform(d_taps, signal) + _by_transform(taps, d_signal)


def _by_transform(taps: Array, signal: Array) -> Array:
    """As `correlated`, by Fourier transforms."""
    import scipy.fft

    p, samples = len(taps), len(signal)
    size = scipy.fft.next_fast_len(samples, real=True)
    X, T = jnp.fft.rfft(signal, size, axis=0), jnp.fft.rfft(taps[::-1], size, axis=0)
    Y = X * T[:, None] if taps.ndim == 1 else jnp.einsum("fij,fj->fi", T, X)
    # what wraps around falls on the first p - 1 samples, which are not asked for
    return jnp.fft.irfft(Y, size, axis=0)[p - 1 : samples]


def in_segments(starts: tuple[int, ...], samples: int) -> np.ndarray:
    """(S, samples) 1 where a sample belongs to a segment, else 0.

    starts: first samples of all segments but the first, rising
    """
    of_segment = np.searchsorted(np.asarray(starts, int), np.arange(samples), side="right")
    return (of_segment == np.arange(len(starts) + 1)[:, None]).astype(float)
