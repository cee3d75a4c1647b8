"""What "diverged" and "grown" mean, in one place, for one learning process and for many.

    diverged   a trial with anything that is not finite, or with an error |e| beyond CEILING times
    the peak of the reference in any
               output: no machine survives it, and in single precision it may be a few trials from
               infinity, in double precision many
    grown      none of the trials diverged, and yet the last one's error is more than 1 + GROWTH
    times that of the best: learning has
               turned (semi-convergence), from the trial on after which the error never was below
               that again

Peaks and errors are compared once a trial, so both are the same in single and in double precision,
but for rounding at the limit.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from ..signals.task import Task
from .metrics import Metrics

CEILING = 1e3  # times the peak of the reference: largest error of a trial that has not diverged
GROWTH = 0.5  # relative rise above the best trial's error that counts as growing again


class Course(NamedTuple):
    """How J trials went. diverged: (J,) whether each one did;  diverged_at: () the first that did,
    0 if none
    grown_from: () the trial from which on the error stays above 1 + GROWTH times the least, 0 if it
    does not, or if a trial diverged
    """

    diverged: jax.Array
    diverged_at: jax.Array
    grown_from: jax.Array


def course(metrics: Metrics, task: Task, first: Any = 1) -> Course:
    """metrics: of J trials of the task;  first: the number of the first of them. Growth is of the
    rms error, the largest output's.
    """
    diverged = ~metrics.finite | jnp.any(metrics.max_error > CEILING * peak(task), axis=-1)
    errors = jnp.where(diverged, jnp.inf, jnp.max(metrics.rms, axis=-1))
    since = grown_from(errors)
    return Course(
        diverged,
        jnp.where(jnp.any(diverged), jnp.argmax(diverged) + first, 0),
        jnp.where(since > 0, since - 1 + first, 0),
    )


def peak(task: Task) -> jax.Array:
    """(n_y,) largest |r| of each output; that of all outputs for one that shall stay at zero, and 1
    if they all shall.
    """
    largest = jnp.max(jnp.abs(jnp.asarray(task.reference)), axis=0)
    overall = jnp.max(largest)
    return jnp.where(largest > 0, largest, jnp.where(overall > 0, overall, 1.0))


def grown_from(errors, growth: float = GROWTH) -> Any:
    """(...) the trial, counted from 1, from which on errors (..., J) stay above 1 + growth times
    the least of them to the end, else 0.

    errors: >= 0, infinite where a trial diverged: what diverged has not grown
    """
    trials, worst = errors.shape[-1], errors.max(axis=-1)
    near_the_best = errors <= (1.0 + growth) * errors.min(axis=-1, keepdims=True)
    after = trials - near_the_best[..., ::-1].argmax(
        axis=-1
    )  # trials up to the last one that is near the best
    return (after + 1) * ((after < trials) & (worst < float("inf")))
