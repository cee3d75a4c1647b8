"""The learning law of a scheme, filters included, as matrices and as what it makes of an impulse.

    u_{j+1} = keep u_j + L e_j,    keep(z) = sum_p keep_p z^p,    L(z) = sum_p L_p z^p

u is what is learned and played back, and e is the error of the trial that played it. The matrices
are of one trial; the taps keep_p and L_p are those far from its ends. Every law is taken from the
scheme's own `learn` and `feedforward`, by linearisation; an adaptive law is thereby frozen at its
start. P-type learning of lead m and gain gamma has the single tap gamma of L at p = 1 + m, since
u[k] is learned from e[k+1+m].
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..schemes import Scheme
from ..schemes.scheme import Memory, with_all_parts
from ..signals.task import Task
from .condition import Premise, premise, share_alike
from .loop import on_circle
from .trials import learned_shape, next_learned, shortened

LONG = (4096, 16384)  # samples of the trial in which the taps are looked at, and if that is short
FORGOTTEN = 1e-12  # share of the largest tap that counts as nothing
NEGLIGIBLE = 1e-13  # share of the largest tap that all taps left out at one end may add up to
ALIKE = 1e-9  # relative difference between two places of the trial that rounding explains
ENDS = 10.0  # the most that an end of the trial changes, in units of the taps that reach beyond it
INVARIANT_LAW = "learning law the same throughout the trial"


class Taps(NamedTuple):
    """M(z) = sum_p taps_p z^p, with whole numbers p = powers (K,) and taps (K, n, m)."""

    powers: np.ndarray | jax.Array
    taps: np.ndarray | jax.Array


class Law(NamedTuple):
    """The taps of a learning law, and how far they may be trusted.

    keep, L:   `Taps`
    departure: largest difference from the taps at another place of the trial, relative
    tail:      size of the last tap, relative
    """

    keep: Taps
    L: Taps
    departure: float
    tail: float

    @property
    def invariant(self) -> Premise:
        """The premise that the taps are those of every sample far from the ends."""
        found = (
            f"taps differ by {self.departure:.1e} over the trial; {self.tail:.1e} of the largest "
            "is left after half of it"
        )
        held = self.departure <= share_alike(ALIKE) and self.tail <= FORGOTTEN**0.5
        return premise(INVARIANT_LAW, held, found)

    @property
    def causal(self) -> bool:
        """Whether u_{j+1}[k] follows from u_j up to k and e_j up to k + 1, by its taps."""
        return bool(np.all(self.keep.powers <= 0) and np.all(self.L.powers <= 1))

    def cut_off(self, scheme: Scheme, task: Task) -> bool:
        """Whether the law of this trial is that of the taps, with zeros beyond its ends.

        As the law is linear, it is enough to look at a random trial.
        """
        random = np.random.default_rng(5)
        u = random.standard_normal((task.N, _width(scheme, task)))
        e = random.standard_normal((task.N, task.outputs))
        expected = _convolved(self.keep, u) + _convolved(self.L, e, 1)
        off = np.max(np.abs(np.asarray(pushed(scheme, task, u, e)) - expected))
        return bool(off <= share_alike(ALIKE) * np.max(np.abs(expected), initial=1e-300))


def law_of(scheme: Scheme, task: Task) -> Law:
    """The law of a scheme with a feedforward. Raises ValueError for a scheme that learns none.

    Its taps are read in the middle of a long trial, and compared with those at another place there,
    and with all that the law does in the trial of the task. That shows a law that is scheduled, but
    not a change so near an end that the taps beyond the end could explain it. Where they have not
    died out, as those of a filter of a low cutoff, the trial is made longer.
    """
    for samples in LONG:
        law, longer = _law_in(scheme, task, samples)
        if law.invariant.held or not law.tail > NEGLIGIBLE or samples > longer.N:
            break
    return law


def _law_in(scheme: Scheme, given: Task, samples: int) -> tuple[Law, Task]:
    """The law, with taps that are read in a trial of so many samples, if it admits that; and it."""
    task = _long(scheme, given, samples)
    width, N = _width(scheme, task), task.N
    middle, beside = N // 2, N // 2 + max(N // 8, 1)
    at = [tuple(map(np.asarray, _impulses(scheme, task, place))) for place in (middle, beside)]
    (keep, L), moved, shift = at[0], at[1], beside - middle
    size = max(_size(keep), _size(L)) or 1.0
    lag = middle - np.arange(N)
    of_keep = _trimmed(lag, keep.reshape(N, width, -1))
    of_error = _trimmed(lag + 1, L.reshape(N, width, -1))
    departures = [
        _size(one[: N - shift] - other[shift:]) / size
        for one, other in zip(at[0], moved, strict=True)
    ]
    for late, taps in enumerate((of_keep, of_error)):
        off, own = _scheduled(scheme, given, taps, late), _size(taps.taps)
        if late and not own:  # of windows elsewhere: all of what is learned there is a departure
            departures.append(float(off > 0))
        else:
            departures.append(off / (own if late or own > FORGOTTEN else 1.0))
    tail = max(_size(rows[[0, -1]]) for rows in (keep, L)) / size
    return Law(of_keep, of_error, float(max(departures)), float(tail)), task


def _scheduled(scheme: Scheme, task: Task, taps: Taps, late: int) -> float:
    """By how much the law of this trial departs from its taps, beyond what the ends explain.

    late: 0 for the taps on what was played, 1 for those on the error
    """
    random = np.random.default_rng(7)
    seen = [np.zeros((task.N, _width(scheme, task))), np.zeros((task.N, task.outputs))]
    seen[late] = random.uniform(-1, 1, seen[late].shape)
    off = np.abs(np.asarray(pushed(scheme, task, *seen)) - _convolved(taps, seen[late], late))
    sizes, reach = np.sum(np.abs(taps.taps), axis=(1, 2)), np.abs(taps.powers - late)
    within = np.cumsum(np.bincount(np.minimum(reach, task.N), sizes, task.N + 1))
    beyond, k = np.maximum(within[-1] - within, 0.0), np.arange(task.N)
    return _size(np.maximum(off - ENDS * beyond[np.minimum(k, k[::-1])][:, None], 0.0))


def _size(values) -> float:
    return float(np.max(np.abs(values), initial=0.0))


class LawMatrices(NamedTuple):
    """u_{j+1} = keep u_j + L e_j + const. over one trial: keep (N n_w, N n_w), L (N n_w, N n_y)."""

    keep: np.ndarray
    L: np.ndarray


def learning_law(scheme: Scheme, task: Task, memory: Memory = None) -> LawMatrices:
    """The learning law of a scheme with a feedforward over one trial, as matrices.

    It is found by linearising the scheme's own `learn` and `feedforward`. A law that adapts
    (MFAILC) is frozen at what it knows; `linear_law` tells whether a law does.

    memory: what the scheme knows; None for its start

    Raises ValueError for a scheme that learns no feedforward.
    """
    _width(scheme, task)
    memory = scheme.initial_memory(task) if memory is None else memory
    return LawMatrices(*map(np.asarray, _matrices(scheme, task, memory)))


class LawResponse(NamedTuple):
    """The frequency responses keep (F, n_w, n_w) and L (F, n_w, n_y), the lead included."""

    keep: jax.Array
    L: jax.Array


def law_response(scheme: Scheme, task: Task, frequencies) -> LawResponse:
    """keep and L at frequencies (F,) [Hz]. Raises as `law_of`."""
    law, z = law_of(scheme, task), on_circle(frequencies, task.dt)
    return LawResponse(*(at_points(part, z) for part in (law.keep, law.L)))


def law_on(scheme: Scheme, task: Task, frequencies) -> tuple[np.ndarray, np.ndarray]:
    """(F,) keep and L of a law with one channel, at frequencies (F,) [Hz]. Raises as `law_of`."""
    keep, L = (np.asarray(part)[:, 0, 0] for part in law_response(scheme, task, frequencies))
    return keep, L


def traced_response(scheme: Scheme, task: Task, frequencies) -> LawResponse:
    """keep and L at frequencies (F,) [Hz], as a pure function of the scheme that has derivatives.

    They are taken from impulses in the middle of one trial of the task, so that a law whose taps
    reach beyond half of the trial is cut off there; `law_of` tells whether that is so. Raises
    ValueError for a scheme that learns no feedforward.
    """
    N, middle, f = task.N, task.N // 2, jnp.asarray(frequencies)
    lags, found = middle - np.arange(N), []
    width = _width(scheme, task), task.outputs
    for late, rows in enumerate(_impulses(scheme, task, middle)):
        taps = rows.reshape(N, -1, width[late]).astype(complex)
        powers = jnp.exp(2j * jnp.pi * task.dt * jnp.outer(f, jnp.asarray(lags + late)))
        found.append(jnp.tensordot(powers, taps, axes=1))
    return LawResponse(*found)


def at_points(of: Taps, z) -> jax.Array:
    """(F, n, m) M(z) at the points z (F,)."""
    return jnp.tensordot(z[:, None] ** of.powers, jnp.asarray(of.taps, complex), axes=1)


# How it is done
# --------------------------------------------------------------------------------------------------


def _width(scheme: Scheme, task: Task) -> int:
    shape = learned_shape(scheme, task)
    if shape is None:
        raise ValueError(f"{type(scheme).__name__} learns no feedforward input")
    return shape[1]


def _long(scheme: Scheme, task: Task, samples: int) -> Task:
    """The task made as long as that, if it is shorter and the scheme admits another length."""
    if any(part.scheme.of_one_length for part in with_all_parts(scheme, task)):
        return task
    longer = shortened(task, max(samples, task.N))
    try:
        scheme.check(longer)
    except ValueError:
        return task
    return longer


@partial(jax.jit, static_argnames="place")
def _impulses(scheme, task, place):
    """(N, n_w n_w) and (N, n_w n_y): what is learned from an impulse at one place of the trial.

    The first is for an impulse of what was played, the second for an impulse of the error.
    """
    widths, push = (_width(scheme, task), task.outputs), _change(scheme, task)

    def answers(argument):
        channels = widths[argument]
        rows = [jnp.zeros((channels, task.N, width)) for width in widths]
        rows[argument] = rows[argument].at[:, place].set(jnp.eye(channels))
        return jnp.moveaxis(jax.vmap(push)(*rows), 0, -1).reshape(task.N, -1)

    return answers(0), answers(1)


@jax.jit
def _matrices(scheme, task, memory):
    scheme = scheme.prepared(task)
    u, e = jnp.zeros(learned_shape(scheme, task)), jnp.zeros((task.N, task.outputs))
    keep, L = jax.jacfwd(partial(next_learned, scheme, task, memory), argnums=(0, 1))(u, e)
    return keep.reshape(u.size, u.size), L.reshape(u.size, e.size)


@jax.jit
def pushed(scheme, task, u, e):
    """(N, n_w) what is learned from a change of what was played and of the error."""
    return _change(scheme, task)(u, e)


def _change(scheme: Scheme, task: Task):
    """From a change of what was played (N, n_w) and of the error (N, n_y) to what is learned."""
    scheme = scheme.prepared(task)
    following = partial(next_learned, scheme, task, scheme.initial_memory(task))
    still = jnp.zeros((task.N, _width(scheme, task))), jnp.zeros((task.N, task.outputs))
    return jax.linearize(following, *still)[1]


def _convolved(of: Taps, signal, late: int = 0):
    """(N, n) sum_p taps_p signal[k + p - late], zero beyond the ends."""
    N, found = len(signal), np.zeros((len(signal), of.taps.shape[1]))
    for p, tap in zip(of.powers - late, of.taps, strict=True):
        if abs(p) < N:
            found[max(-p, 0) : N - max(p, 0)] += signal[max(p, 0) : N - max(-p, 0)] @ tap.T
    return found


def _trimmed(powers, taps) -> Taps:
    """The taps without those at both ends that are zero, or that add up to next to nothing."""
    size = np.max(np.abs(taps), axis=tuple(range(1, taps.ndim)))
    nothing = NEGLIGIBLE * np.max(size, initial=0.0)
    kept = (np.cumsum(size) > nothing) & (np.cumsum(size[::-1])[::-1] > nothing)
    return Taps(np.asarray(powers)[kept], taps[kept])
