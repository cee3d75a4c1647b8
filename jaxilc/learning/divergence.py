"""The definitions of "diverged" and "grown", for one learning process and for many.

    diverged   a trial has a signal that is not finite, or an error |e| of more than CEILING times
               the peak of the reference in any output. Such a trial would damage a real machine.
               After it, the signals may become infinite within a few trials in single precision,
               and only after many in double precision.
    grown      none of the trials diverged, but the error of the last trial is more than 1 + GROWTH
               times that of the best trial (semi-convergence). It has grown from the first trial
               on after which the error was never below that level again.

Errors are compared as they are: where references of different size take turns, growth tells of the
references and not of learning.

Peaks and errors are compared once a trial. So both words mean the same in single and in double
precision, except for rounding at the limit, and for an input from 1.8e19 on, whose square is not
finite in single precision: choose a larger unit of u.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp

from ..pytree.aliases import Array, Tree, Value
from ..signals.task import Task
from .known_metrics import Metrics

CEILING = 1e3  # largest error of a trial that has not diverged, in peaks of the reference
GROWTH = 0.5  # relative increase above the error of the best trial that counts as growth


class Course(NamedTuple):
    """Which of J trials diverged, and from which trial on the error has grown.

    diverged: (J,) whether each trial diverged
    diverged_at: () number of the first trial that diverged, 0 if none did
    grown_from: () number of the trial from which on the error stays above 1 + GROWTH times the
        least error; 0 if it does not stay there, or if a trial diverged
    """

    diverged: Array
    diverged_at: Array
    grown_from: Array


def course(metrics: Metrics, task: Task, first: Tree = 1, every: int = 1) -> Course:
    """The `Course` of J trials of a task.

    Growth is that of the rms error of the output with the largest rms error.

    every: number of trials of a learning step of which the first alone plays what was learned, see
        `Scheme.experiments`; the error of the others counts as that of the first
    """
    diverged = ~metrics.finite | jnp.any(metrics.max_error > CEILING * peak(task), axis=-1)
    errors = jnp.where(diverged, jnp.inf, jnp.max(metrics.rms, axis=-1))
    since = grown_from(errors if every == 1 else of_learned(errors, first, every))
    return Course(
        diverged,
        jnp.where(jnp.any(diverged), jnp.argmax(diverged) + first, 0),
        jnp.where(since > 0, since - 1 + first, 0),
    )


def of_learned(errors: Array, first: Tree, every: int) -> Array:
    """(J,) the error of the trial of each step that played what was learned; inf is kept.

    Before the first of these trials, the errors are those of that one.
    """
    j = jnp.arange(len(errors))
    off = (first - 1 + j) % every
    at = jnp.where(j >= off, j - off, j - off + every)
    held = errors[jnp.minimum(at, len(errors) - 1)]
    return jnp.where(jnp.isfinite(errors), held, errors)


def peak(task: Task) -> Array:
    """The largest |r| of each output, as (n_y,).

    For an output whose reference is zero it is the largest |r| of all outputs, and 1 if the
    references of all outputs are zero.
    """
    largest = jnp.max(jnp.abs(jnp.asarray(task.reference)), axis=0)
    overall = jnp.max(largest)
    return jnp.where(largest > 0, largest, jnp.where(overall > 0, overall, 1.0))


def grown_from(errors: Value, growth: float = GROWTH) -> Tree:
    """The trial from which on the errors stay above 1 + growth times the least error, as (...).

    Trials are counted from 1. The result is 0 if the last error is not above that level, and if a
    trial diverged.

    errors: (..., J) >= 0, infinite where a trial diverged
    """
    trials, worst = errors.shape[-1], errors.max(axis=-1)
    near_the_best = errors <= (1.0 + growth) * errors.min(axis=-1, keepdims=True)
    # number of trials up to the last one whose error is near that of the best
    after = trials - near_the_best[..., ::-1].argmax(axis=-1)
    return (after + 1) * ((after < trials) & (worst < float("inf")))
