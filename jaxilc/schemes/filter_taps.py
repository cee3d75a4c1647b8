"""The taps of a linear filter, causal or not, from a system, an inverse, a filter or a list.

This is host code: it is run once, when a scheme is made, and not within a compiled program.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..filters import Filter, Inverse, SwitchableFilter, ZeroPhaseFIR
from ..filters.inversion import CIRCLE
from ..filters.zeros_and_poles import Factors, factors
from ..plants import StateSpace
from ..pytree.ranges import as_numbers, brief

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


def taps_of(given: Any, name: str, *, dt: float | None, tolerance: float, most: int) -> FilterTaps:
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


def is_operator(given: Any) -> bool:
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


def _of_list(given: Any, name: str) -> FilterTaps:
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
            f"{name}: {what} is designed for dt = {own:g} s but dt = {dt:g} s; allowed is dt = "
            f"{own:g}"
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


def _answers(given: Filter, samples: int, reach: int, dt: float):
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
