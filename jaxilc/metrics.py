"""What a trial is judged by."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from .signals import Task, Trial


class Metrics(NamedTuple):
    """Figures of one trial, over the samples the input can reach (k = 1..N); errors in the unit of y, effort in that of u.

    max_error: (n_y,) max |e|;  rms: (n_y,) root mean square of e;  settled_error: (n_y,) max |e| in the settled window
    effort: (n_u,) root mean square of u;  finite: () whether they all are, and every y and u
    """

    max_error: jax.Array
    rms: jax.Array
    settled_error: jax.Array
    effort: jax.Array
    finite: jax.Array


def measure(trial: Trial, task: Task) -> Metrics:
    """The metrics of one trial. A sample at which |e| or |u| is not finite makes the figures it enters not finite."""
    e = jnp.abs(trial.e)
    rms, effort = _root_mean_square(e[1:]), _root_mean_square(trial.u)
    return Metrics(
        max_error=jnp.max(e[1:], axis=0),
        rms=rms,
        settled_error=jnp.max(e[task.settled], axis=0),
        effort=effort,
        finite=jnp.all(jnp.isfinite(rms)) & jnp.all(jnp.isfinite(effort)) & jnp.all(jnp.isfinite(e)),
    )


def _root_mean_square(signal):
    """(n,) of a (N, n) signal; the gradient where it is zero is zero, not NaN."""
    mean = jnp.mean(signal**2, axis=0)
    return jnp.where(mean > 0, jnp.sqrt(jnp.where(mean > 0, mean, 1.0)), 0.0 * mean)
