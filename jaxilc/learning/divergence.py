"""What "diverged" and "grown" mean, in one place, for one learning process and for many.

    diverged   a trial with a signal that is not finite, or with an error |e| of more than CEILING
               times the peak of the reference in any output. No machine survives such a trial. From
               there, single precision may be a few trials from infinity, double precision many.
    grown      none of the trials diverged, and yet the error of the last one is more than
               1 + GROWTH times that of the best one: learning has turned (semi-convergence). It
               has grown from the first trial on after which the error was never below that level
               again.

Peaks and errors are compared once a trial. So both words mean the same in single and in double
precision, except for rounding at the limit.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from ..signals.task import Task
from .known_metrics import Metrics

CEILING = 1e3  # times the peak of the reference: largest error of a trial that has not diverged
GROWTH = 0.5  # relative rise above the best trial's error that counts as growing again


class Course(NamedTuple):
    """How J trials went.

    diverged: (J,) whether each trial diverged
    diverged_at: () number of the first trial that diverged, 0 if none did
    grown_from: () number of the trial from which on the error stays above 1 + GROWTH times the
    least, 0 if it does not stay there, or if a trial diverged
    """

    diverged: jax.Array
    diverged_at: jax.Array
    grown_from: jax.Array


def course(metrics: Metrics, task: Task, first: Any = 1) -> Course:
    """How J trials of a task went. Growth is that of the rms error of the output with the largest.

    metrics: of the J trials;  first: the number of the first of them
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
    """(n_y,) largest |r| of each output.

    An output that shall stay at zero has the largest |r| of all outputs, and 1 if all of them shall
    stay at zero.
    """
    largest = jnp.max(jnp.abs(jnp.asarray(task.reference)), axis=0)
    overall = jnp.max(largest)
    return jnp.where(largest > 0, largest, jnp.where(overall > 0, overall, 1.0))


def grown_from(errors, growth: float = GROWTH) -> Any:
    """(...) the trial, counted from 1, from which on the errors stay above 1 + growth times the
    least of them until the last trial; 0 if they do not.

    errors: (..., J) >= 0, infinite where a trial diverged; what diverged has not grown
    """
    trials, worst = errors.shape[-1], errors.max(axis=-1)
    near_the_best = errors <= (1.0 + growth) * errors.min(axis=-1, keepdims=True)
    # how many trials there are up to the last one that is near the best
    after = trials - near_the_best[..., ::-1].argmax(axis=-1)
    return (after + 1) * ((after < trials) & (worst < float("inf")))
