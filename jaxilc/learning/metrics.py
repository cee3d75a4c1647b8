"""What a trial is judged by: its metrics while it runs, those of a record, and further quantities.

Which metrics there are stands in `known_metrics`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ..signals.task import Task, Trial
from .known_metrics import GATHERED, METRICS, Gathering, Metrics


class Tally(NamedTuple):
    """What metrics are made of, gathered sample by sample while a trial runs. A second pass over
    the record would take as much time again.

    gathered: for each of `GATHERED`, (n_y,) or (n_u,) the largest absolute value so far, or the sum
    of squares
    """

    gathered: tuple[jax.Array, ...]

    @classmethod
    def start(cls, e, inputs: int, settled: bool) -> Tally:
        """e: (n_y,) error of sample 0, which no input can reach. It counts only in metrics of the
        settled window, where that begins with sample 0.
        """
        none = {"e": jnp.zeros_like(e), "u": jnp.zeros_like(e, shape=inputs)}
        first = {"largest": jnp.abs(e), "root mean square": e * e}
        return cls(
            tuple(
                first[how.of] if how.settled and settled and how.signal == "e" else none[how.signal]
                for _, how in GATHERED
            )
        )

    def add(self, e, u, settled) -> Tally:
        """The tally with one more sample.

        e: (n_y,) error of the sample;  u: (n_u,) input that led to it;  settled: () whether the
        sample lies in the settled window
        """
        signals, added = {"e": e, "u": u}, []
        for (_, how), so_far in zip(GATHERED, self.gathered, strict=True):
            x = signals[how.signal]
            more = jnp.maximum(so_far, jnp.abs(x)) if how.of == "largest" else so_far + x * x
            added.append(jnp.where(settled, more, so_far) if how.settled else more)
        return Tally(tuple(added))

    def metrics(self, trial: Trial, task: Task) -> Metrics:
        """The metrics of the trial that was gathered, with their derivative by its signals."""
        e, u = trial.e, trial.u
        found, finite = {}, jnp.all(jnp.isfinite(e[0]))
        gathered = _of_signals(self.gathered, e, u, task.settled)
        for (name, how), value in zip(GATHERED, gathered, strict=True):
            if how.of == "root mean square":
                value = _root(value / len(_rows(how, e, u, task.settled)))
                # squares of all samples: where their sum is finite, each sample is finite
                finite = finite if how.settled else finite & jnp.all(jnp.isfinite(value))
            found[name] = value
        return Metrics(**found, finite=finite)


def _rows(how: Gathering, e, u, settled: slice):
    """The rows of e (N+1, n_y) or u (N, n_u) that count. u[k] leads to e[k+1]."""
    if how.signal == "e":
        return e[settled] if how.settled else e[1:]
    start, stop, _ = settled.indices(len(e))
    return u[max(start - 1, 0) : stop - 1] if how.settled else u


@partial(jax.custom_jvp, nondiff_argnums=(3,))
def _of_signals(gathered: tuple, e, u, settled: slice) -> tuple:
    """What was gathered of e (N+1, n_y) and u (N, n_u), with a derivative by these signals as a
    whole. Differentiated sample by sample, a gradient would store every intermediate value.
    """
    return gathered


@_of_signals.defjvp
def _of_signals_jvp(settled, signals, tangents):
    (gathered, e, u), (_, de, du) = signals, tangents

    def slope(how: Gathering):
        x, dx = _rows(how, e, u, settled), _rows(how, de, du, settled)
        if how.of == "root mean square":
            return 2.0 * _dot(x, dx)
        # by its index: the value in the tally may be rounded differently from the same error here,
        # and then equals none of them
        largest = jnp.argmax(jnp.abs(x), axis=0)
        return _dot(jnp.where(jnp.arange(len(x))[:, None] == largest, jnp.sign(x), 0.0), dx)

    return gathered, tuple(slope(how) for _, how in GATHERED)


def _dot(a, b):
    """(n,) sum of a b over time. A sum over time of a product would be added up one by one."""
    return jnp.einsum("kn,kn->n", a, b)


def measure(trial: Trial, task: Task) -> Metrics:
    """The metrics of one trial. A sample at which |e| or |u| is not finite makes the metrics that
    it enters not finite.
    """
    e, u = lax.stop_gradient((trial.e, trial.u))

    def gathered(how: Gathering):
        x = _rows(how, e, u, task.settled)
        return jnp.max(jnp.abs(x), axis=0) if how.of == "largest" else _dot(x, x)

    return Tally(tuple(gathered(how) for _, how in GATHERED)).metrics(trial, task)


@dataclasses.dataclass(frozen=True)
class Keep:
    """A `save` for `learn`: a dictionary of signals and further metrics of each trial.

    Two that are equal share a compiled program.
    signals: names of fields of `Trial`
    quantities: (name, function of a trial) pairs. A function that shall be differentiated takes
    `largest` in place of `jnp.max`.
    """

    signals: tuple[str, ...] = ()
    quantities: tuple[tuple[str, Callable[[Trial], jax.Array]], ...] = ()

    @classmethod
    def of(cls, quantities: Mapping[str, Callable[[Trial], jax.Array]], *signals: str) -> Keep:
        """Raises ValueError for a quantity named as one of the metrics or a signal."""
        for name in quantities:
            if name in (*(metric.name for metric in METRICS), *Trial._fields, "e"):
                raise ValueError(
                    f"quantity = {name!r} is a metric that every trial has; choose another name"
                )
        return cls(signals, tuple(quantities.items()))

    def __call__(self, trial: Trial) -> dict[str, jax.Array]:
        return {name: getattr(trial, name) for name in self.signals} | {
            name: of(trial) for name, of in self.quantities
        }


def largest(x, axis: int | None = None) -> jax.Array:
    """The largest value of x, or those along an axis, with a derivative that goes by its place.

    Where several values are equal, the first of them has the derivative. The derivative of
    `jnp.max` asks instead which of the values equal the largest. In a compiled program they may
    have been computed twice and rounded differently, so that none does, and a part of the
    derivative is zero without a warning.
    """
    x, axis = (jnp.ravel(x), 0) if axis is None else (jnp.asarray(x), axis)
    place = jnp.argmax(lax.stop_gradient(x), axis=axis, keepdims=True)
    # by a choice and a sum: a gather has a scatter as its derivative, of which XLA's partitioner
    # dies where x lies on many devices
    return jnp.sum(
        jnp.where(lax.broadcasted_iota(place.dtype, x.shape, axis % x.ndim) == place, x, 0.0),
        axis=axis,
    )


def best_trial(rms) -> np.ndarray:
    """(J,) the trial with the smallest error among the first j = 1..J. Where it stays behind j,
    learning has turned: the error has grown again.

    rms: (J, n_y). The output with the largest error counts; a trial that is not finite is never the
    best.
    """
    errors = np.max(np.nan_to_num(np.asarray(rms, float), nan=np.inf), axis=1)
    better = errors < np.concatenate([[np.inf], np.minimum.accumulate(errors)[:-1]])
    return 1 + np.maximum.accumulate(np.where(better, np.arange(len(errors)), 0))


class Repeatability(NamedTuple):
    """How alike repeated runs are.

    mean: (n_y,) of the rms errors [unit of y]
    spread: (n_y,) the largest less the smallest of them [unit of y]
    share: (n_y,) spread / mean
    """

    mean: jax.Array
    spread: jax.Array
    share: jax.Array


def repeatability(rms) -> Repeatability:
    """How well the same input leads to the same error in each run, which learning presumes.

    Li 2020, section 6.1, found a spread of 0.0003 mm over 10 runs.
    rms: (J, n_y) or (J,) root mean square errors of J >= 2 runs without learning between them, such
    as `History.rms` of pure feedback
    Raises ValueError for fewer runs.
    """
    rms = jnp.asarray(rms)
    if rms.ndim not in (1, 2) or len(rms) < 2:
        raise ValueError(
            f"repeatability: rms has shape {rms.shape}; allowed are (J,) and (J, n_y) with J >= 2"
        )
    mean, spread = jnp.mean(rms, axis=0), jnp.max(rms, axis=0) - jnp.min(rms, axis=0)
    return Repeatability(mean, spread, spread / mean)


def total_variation(signal) -> jax.Array:
    """(n,) sum_k |x[k+1] - x[k]| of a (N, n) signal."""
    return jnp.sum(jnp.abs(jnp.diff(signal, axis=0)), axis=0)


def chattering(trial: Trial) -> jax.Array:
    """(n_u,) total variation of u per second [unit of u per s].

    For a smooth u it is about the mean of |u'|; for one that switches it is far larger.
    """
    return total_variation(trial.u) / (trial.u.shape[0] * trial.dt)


def root_mean_square(signal) -> jax.Array:
    """(n,) root mean square of a (N, n) signal. Where it is zero, its gradient is zero, not NaN."""
    return _root(jnp.mean(signal**2, axis=0))


def _root(mean):
    return jnp.where(mean > 0, jnp.sqrt(jnp.where(mean > 0, mean, 1.0)), 0.0 * mean)
