"""Taps of a learning law found by the frequency responses of a family, within a second.

The error of a trial that the responses predict (`responses.Family.rms`) is differentiable by the
taps. L-BFGS minimises the mean over the machines of its logarithm, with that of half as many trials
at a smaller weight, under

    |keep - L P| <= below    at each frequency, on each machine

as a penalty. Ends of the trial, limits and saturation are not in it: from here a `Tuning` goes on.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize

from ..signals.task import Task
from .responses import Family
from .window import Filters, Window

EARLY = 0.1  # weight of the error of half as many trials
STRICT = 50.0, 5.0  # weights of the mean square excess, and of the largest one
STEPS = 600
NEAR = 0.97  # largest |keep - L P| with which an error is predicted; the excess counts beyond it


def by_response(
    family: Family,
    window: Window,
    start: Filters,
    task: Task,
    trials: int,
    below: float,
    *,
    steps: int = STEPS,
) -> Filters:
    """The taps of least predicted error.

    start: from which the search begins
    trials: number of the trial whose error counts
    below: bound on |keep - L P|
    steps: of L-BFGS at most
    """
    value_and_slope = _loss_of(family, window, start, task, trials, below)

    def numbers(z):
        value, slope = value_and_slope(z)
        return float(value), np.asarray(slope, float)

    z = np.zeros(window.of_L.shape[1] + window.of_keep.shape[1])
    options = {"maxiter": steps, "maxfun": 2 * steps, "maxcor": 30}
    found = scipy.optimize.minimize(numbers, z, jac=True, method="L-BFGS-B", options=options)
    return moved(window, start, found.x if np.all(np.isfinite(found.x)) else z)


def moved(window: Window, start: Filters, z) -> Filters:
    """The taps after steps z along the directions of the window, first those of L."""
    count = window.of_L.shape[1]
    return Filters(start.L + window.of_L @ z[:count], start.keep + window.of_keep @ z[count:])


def sizes_of(family: Family, window: Window, filters: Filters, dt: float) -> np.ndarray:
    """(S, F) |keep - L P| of taps on the machines and lines of a family."""
    of_L, of_keep = window.responses(family.frequencies, dt)
    return np.abs(of_keep @ filters.keep - (of_L @ filters.L) * family.P)


def _loss_of(family, window, start, task, trials, below):
    """The loss of steps z, with its slope, compiled."""
    of_L, of_keep = window.responses(family.frequencies, task.dt)
    P, error, noise = jnp.asarray(family.P), family.error, family.noise
    counted = {trials: 1.0, max(2, (trials + 1) // 2): EARLY} if trials > 2 else {trials: 1.0}

    def loss(z):
        filters = moved(window, start, z)
        keep, LP = of_keep @ filters.keep, (of_L @ filters.L) * P
        left = keep - LP
        square = left.real**2 + left.imag**2
        size = jnp.sqrt(square + 1e-12)
        within = left * jnp.minimum(1.0, NEAR / size)
        rest = (1 - keep) / (1 - within)
        learned = _square(LP) / (1 - jnp.minimum(square, NEAR**2)) * noise**2
        total = 0.0
        for trial, weight in counted.items():
            share = rest + within ** (trial - 1) * (1 - rest)
            rms = jnp.sum(_square(share) * error**2 + learned, axis=1)
            total += weight * 0.5 * jnp.mean(jnp.log(rms))
        over = jax.nn.relu(size - below)
        worst = jnp.sqrt(jnp.sum(jnp.max(over, axis=1) ** 2) + 1e-12)
        return total + STRICT[0] * jnp.mean(jnp.sum(over**2, axis=1)) + STRICT[1] * worst

    return jax.jit(jax.value_and_grad(loss))


def _square(z):
    return z.real**2 + z.imag**2
