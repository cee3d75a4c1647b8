"""What a trial is judged by."""

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


class Metrics(NamedTuple):
    """Figures of one trial, over the samples the input can reach (k = 1..N); errors in the unit of
    y, effort in that of u.

    max_error: (n_y,) max |e|;  rms: (n_y,) root mean square of e;  settled_error: (n_y,) max |e| in
    the settled window
    effort: (n_u,) root mean square of u;  finite: () whether they all are, and every y and u
    """

    max_error: jax.Array
    rms: jax.Array
    settled_error: jax.Array
    effort: jax.Array
    finite: jax.Array


class Tally(NamedTuple):
    """What metrics are made of, gathered sample by sample while a trial runs: a second pass over
    the record would cost as much again.

    max_error, settled_error: (n_y,) largest |e| so far;  squares: (n_y,) sum of e^2;  effort:
    (n_u,) sum of u^2
    """

    max_error: jax.Array
    squares: jax.Array
    settled_error: jax.Array
    effort: jax.Array

    @classmethod
    def start(cls, e, inputs: int, settled: bool) -> Tally:
        """e: (n_y,) error of sample 0, which no input can reach: it counts only where it is
        settled.
        """
        none = jnp.zeros_like(e)
        return cls(none, none, jnp.abs(e) if settled else none, jnp.zeros_like(e, shape=inputs))

    def add(self, e, u, settled) -> Tally:
        """The error (n_y,) of a sample, the input (n_u,) that led to it, and whether () the sample
        is settled.
        """
        size = jnp.abs(e)
        late = jnp.where(settled, jnp.maximum(self.settled_error, size), self.settled_error)
        return Tally(
            jnp.maximum(self.max_error, size), self.squares + e * e, late, self.effort + u * u
        )

    def metrics(self, trial: Trial, task: Task) -> Metrics:
        """The metrics of the trial that was gathered, with their derivative by its signals."""
        e, N = trial.e, len(trial.u)
        found = _of_signals(self, e, trial.u, task.settled)
        rms, effort = _root(found.squares / N), _root(found.effort / N)
        finite = (
            jnp.all(jnp.isfinite(e[0])) & jnp.all(jnp.isfinite(rms)) & jnp.all(jnp.isfinite(effort))
        )
        return Metrics(found.max_error, rms, found.settled_error, effort, finite)


@partial(jax.custom_jvp, nondiff_argnums=(3,))
def _of_signals(tally: Tally, e, u, settled: slice) -> Tally:
    """The tally of e (N+1, n_y) and u (N, n_u). Differentiated whole: sample by sample, a gradient
    would store every running figure.
    """
    return tally


@_of_signals.defjvp
def _of_signals_jvp(settled, signals, tangents):
    (tally, e, u), (_, de, du) = signals, tangents

    def of_largest(e, de):
        # by its index: the value in the tally may be rounded otherwise than the same error here,
        # and then equals none of them
        largest = jnp.argmax(jnp.abs(e), axis=0)
        return _dot(jnp.where(jnp.arange(len(e))[:, None] == largest, jnp.sign(e), 0.0), de)

    return tally, Tally(
        of_largest(e[1:], de[1:]),
        2.0 * _dot(e[1:], de[1:]),
        of_largest(e[settled], de[settled]),
        2.0 * _dot(u, du),
    )


def _dot(a, b):
    """(n,) sum of a b over time. A sum over time of a product would be added up one by one."""
    return jnp.einsum("kn,kn->n", a, b)


def measure(trial: Trial, task: Task) -> Metrics:
    """The metrics of one trial. A sample at which |e| or |u| is not finite makes the figures it
    enters not finite.
    """
    e, u = lax.stop_gradient((trial.e, trial.u))
    size = jnp.abs(e)
    whole = Tally(
        jnp.max(size[1:], axis=0),
        _dot(e[1:], e[1:]),
        jnp.max(size[task.settled], axis=0),
        _dot(u, u),
    )
    return whole.metrics(trial, task)


@dataclasses.dataclass(frozen=True)
class Keep:
    """A `save` for `learn`: a dictionary of signals and further figures of each trial. Equal ones
    share a compiled program.

    signals: names of fields of `Trial`;  quantities: (name, function of a trial) pairs. One that
    shall be differentiated takes `largest` in place of `jnp.max`.
    """

    signals: tuple[str, ...] = ()
    quantities: tuple[tuple[str, Callable[[Trial], jax.Array]], ...] = ()

    @classmethod
    def of(cls, quantities: Mapping[str, Callable[[Trial], jax.Array]], *signals: str) -> Keep:
        """Raises ValueError for a quantity named as one of the metrics or a signal."""
        for name in quantities:
            if name in (
                *Metrics._fields,
                "diverged",
                "diverged_at",
                "grown_from",
                "best_trial",
                *Trial._fields,
                "e",
            ):
                raise ValueError(
                    f"quantity = {name!r} is a figure that every trial has; choose another name"
                )
        return cls(signals, tuple(quantities.items()))

    def __call__(self, trial: Trial) -> dict[str, jax.Array]:
        return {name: getattr(trial, name) for name in self.signals} | {
            name: of(trial) for name, of in self.quantities
        }


def largest(x, axis: int | None = None) -> jax.Array:
    """The largest value of x, or those along an axis, with a derivative that goes by its place; the
    first place where several are equal.

    The derivative of `jnp.max` asks which of the values equal the largest. In a compiled program
    they may have been computed twice and rounded differently, so that none does, and a part of the
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
    """(J,) the trial with the smallest error among the first j = 1..J: where it stays behind,
    learning has turned.

    rms: (J, n_y), the largest output counts; a trial that is not finite is never the best
    """
    errors = np.max(np.nan_to_num(np.asarray(rms, float), nan=np.inf), axis=1)
    better = errors < np.concatenate([[np.inf], np.minimum.accumulate(errors)[:-1]])
    return 1 + np.maximum.accumulate(np.where(better, np.arange(len(errors)), 0))


class Repeatability(NamedTuple):
    """mean: (n_y,) of the figures;  spread: (n_y,) largest less smallest, in their unit;  share:
    (n_y,) spread / mean
    """

    mean: jax.Array
    spread: jax.Array
    share: jax.Array


def repeatability(rms) -> Repeatability:
    """How far one input leads to one error: the premise of learning (Li 2020, section 6.1: a spread
    of 0.0003 mm over 10 runs).

    rms: (J, n_y) or (J,) root mean square errors of J >= 2 runs without learning between them, as
    `History.rms` of pure feedback
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
    """(n_u,) total variation of u per second [unit of u per s]: for a smooth u about the mean of
    |u'|, for a switching one far above.
    """
    return total_variation(trial.u) / (trial.u.shape[0] * trial.dt)


def root_mean_square(signal) -> jax.Array:
    """(n,) of a (N, n) signal; the gradient where it is zero is zero, not NaN."""
    return _root(jnp.mean(signal**2, axis=0))


def _root(mean):
    return jnp.where(mean > 0, jnp.sqrt(jnp.where(mean > 0, mean, 1.0)), 0.0 * mean)
