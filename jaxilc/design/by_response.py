"""Taps of a learning law found by the frequency responses of a family, within a second.

The error of a trial that the responses predict (`responses.Family.rms`) is differentiable by the
taps. L-BFGS minimises the mean over the machines of its logarithm, or another risk, with that of
half as many trials at a smaller weight, under

    |keep - L P| <= below    at each frequency, on each machine

as a penalty; of several channels |.| is the largest singular value, and the error is predicted by
matrices (`of_matrices`). Ends of the trial, limits and saturation are not in it: from here a
`Tuning` goes on, which also tells the segments of a scheduled law apart.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
import scipy.optimize

from ..learning.metrics import largest
from ..pytree.aliases import Tree
from ..schemes import Scheme
from ..signals.task import Task
from ..theory.law import law_of, learning_law
from ..tuning.risks import Mean, Risk
from .candidates import impulse_response
from .responses import Family
from .window import Filters, Window, along, leads_of

MEAN = Mean()
EARLY = 0.1  # weight of the error of half as many trials
STRICT = 50.0, 5.0  # weights of the mean square excess, and of the largest one
STEPS = 600
ENOUGH = 1e-3  # fall of the loss below which the search ends
DOUBLINGS = 5
SHARPNESS = 2.0 ** (DOUBLINGS + 1)  # of the norm of several channels
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
    risk: Risk = MEAN,
) -> tuple[Filters, float]:
    """The taps of least predicted error of a law that is not scheduled, and their loss.

    trials: number of the trial whose error counts
    below: bound on |keep - L P|;  steps: of L-BFGS at most
    risk: how the logarithms of the errors of all machines are combined
    """
    early = ((max(2, (trials + 1) // 2), EARLY),) if trials > 2 else ()
    counted = ((trials, 1.0), *early)
    no_arrays: dict[str, Tree] = {"loops": [], "drawn": {}, "population": None, "metric": ()}
    # one program serves all windows of a size: only their directions and units count here
    counting = window._replace(lead=0, starts=(), limit=None, dt=None)
    problem = family._replace(**no_arrays), counting, start
    responses = window.responses(family.frequencies, task.dt)
    z, least = np.zeros(window.number_of_steps()), np.inf
    for of in dict.fromkeys((MEAN, risk)):  # the mean, which is smooth, leads near another risk

        def numbers(z, of=of):
            value, slope = _value_and_slope(z, *problem, responses, below, counted, of)
            return float(value), np.asarray(slope, float)

        z, least = _lowest(numbers, z, steps)
    return window.moved(start, z), least


def _lowest(numbers, z, steps: int) -> tuple[np.ndarray, float]:
    """The lowest point that L-BFGS, begun anew at each kink, finds from z, and its value."""
    least, left = np.inf, steps
    while left > 0:
        options = {"maxiter": left, "maxfun": 2 * left, "maxcor": 30}
        found = scipy.optimize.minimize(numbers, z, jac=True, method="L-BFGS-B", options=options)
        if not (np.isfinite(found.fun) and np.all(np.isfinite(found.x))):
            break
        enough = found.fun > least - ENOUGH
        z, least, left = found.x, float(found.fun), left - max(int(found.nit), 1)
        if enough:
            break
    return z, least


def sizes_of(family: Family, window: Window, filters: Filters, dt: float) -> np.ndarray:
    """(S, F) |keep - L P| of taps on a family, the largest singular value, and of all segments."""
    of_L, of_keep = window.responses(family.frequencies, dt)
    L, keep = along(of_L, filters.L), along(of_keep, filters.keep)
    if window.starts:
        return np.max([family.sizes(*one) for one in zip(keep, L, strict=True)], axis=0)
    return family.sizes(keep, L)


def _loss(
    z, family: Family, window: Window, start: Filters, responses, below: float, counted, risk: Risk
):
    """The loss of steps z from the taps of a start.

    family: without its loops;  responses: those of `Window.responses`
    counted: (trial, weight) of the errors that count
    """
    filters, (of_L, of_keep) = window.moved(start, z), responses
    keep, L = along(of_keep, filters.keep), along(of_L, filters.L)
    predicted = _of_numbers if family.P.ndim == 2 else of_matrices
    size, squares = predicted(family, keep, L, tuple(j for j, _ in counted), NEAR)
    total = sum(
        weight * 0.5 * risk(jnp.log(square))
        for (_, weight), square in zip(counted, squares, strict=True)
    )
    over = jax.nn.relu(size - below)
    # `jnp.max` has NaN for its slope where the compiled program rounds `over` in two ways
    worst = jnp.sqrt(jnp.sum(largest(over, axis=1) ** 2) + 1e-12)
    return total + STRICT[0] * jnp.mean(jnp.sum(over**2, axis=1)) + STRICT[1] * worst


_value_and_slope = partial(jax.jit, static_argnames=("counted", "risk"))(jax.value_and_grad(_loss))


def _of_numbers(family: Family, keep, L, trials, near: float):
    """(S, F) |keep - L P|, and for each of some trials (S,) the predicted mean square error."""
    P, noise = jnp.asarray(family.P), family.noise
    LP = L * P
    left = keep - LP
    square = _square(left)
    size = jnp.sqrt(square + 1e-12)
    within = left * jnp.minimum(1.0, near / size)
    rest = (1 - keep) / (1 - within)
    learned = _square(LP) / (1 - jnp.minimum(square, near**2)) * noise**2
    squares = []
    for trial in trials:
        share = rest + within ** (trial - 1) * (1 - rest)
        squares.append(jnp.sum(_square(share) * family.error**2 + learned, axis=1))
    return size, squares


def of_matrices(family: Family, keep, L, trials: Sequence[int], near: float):
    """(S, F) sizes of M = keep - L P, and for some trials (S,) the predicted mean square error.

        e_j = (1 - P (1 + M + ... + M^(j-2)) L) e_1

    frequency by frequency. What does not repeat adds |P L n|^2 / (1 - |M|^2) at most.

    The size is a norm of the singular values that has a slope where two of them are equal, as they
    are where nothing is learned yet; it exceeds the largest one by n_u^(1 / SHARPNESS) at most.

    Each channel counts in units of its own largest error in the first trial.

    keep: (F, n_u, n_u), L: (F, n_u, n_y) responses of the law
    near: largest size of M with which an error is predicted; M is made smaller to it
    """
    P = jnp.asarray(family.P)
    units = 1 / jnp.maximum(jnp.max(jnp.abs(family.first_error), axis=0), 1e-300)
    M = keep - _times(L, P)
    size = _size(M)
    M = M * jnp.minimum(1.0, near / (size + 1e-12))[..., None, None]
    PL = _times(P, L)
    learned = _square(units[:, None] * PL * family.noise[:, None, :]).sum((-2, -1))
    learned = jnp.sum(learned / (1 - jnp.minimum(size, near) ** 2), axis=1)
    squares = []
    for trial in trials:
        whole, _ = _powers(M, trial - 1)
        share = jnp.eye(P.shape[-2]) - _times(_times(P, whole), L)
        left = units[:, None] * _times(share, family.error)
        squares.append(jnp.sum(_square(left), axis=(1, 2, 3)) + learned)
    return size, squares


def _size(M):
    """The norm (sum of the singular values to the power SHARPNESS)^(1 / SHARPNESS), by products."""
    A = _times(jnp.swapaxes(M.conj(), -1, -2), M)
    total = jnp.trace(A, axis1=-2, axis2=-1).real + 1e-24
    A = A / total[..., None, None]
    for _ in range(DOUBLINGS):
        A = _times(A, A)
    share = jnp.trace(A, axis1=-2, axis2=-1).real
    return jnp.sqrt(total) * share ** (1 / SHARPNESS)


def _powers(M, count: int):
    """1 + M + ... + M^(count - 1), and M^count; count >= 1"""
    one = jnp.eye(M.shape[-1])
    if count == 1:
        return jnp.broadcast_to(one, M.shape).astype(M.dtype), M
    half, power = _powers(M, count // 2)
    whole, power = half + _times(power, half), _times(power, power)
    return (one + _times(M, whole), _times(M, power)) if count % 2 else (whole, power)


def _times(A, B):
    """A B of many small matrices, six times as fast on a CPU as a batch of matrix products."""
    return jnp.sum(A[..., :, :, None] * B[..., None, :, :], axis=-2)


def _square(z):
    return z.real**2 + z.imag**2


# The taps with which a tuning begins
# --------------------------------------------------------------------------------------------------

BRIEF = 150  # steps at each lead, and after machines have joined
APART = 12  # leads closer than the number of taps divided by this count as one
SHORT, ENDS = 200, 4  # of the trial of both ends: least samples, and samples by the reach of taps
ROUNDS, JOIN = 5, 16  # of the exchange, and machines that join in each


class FirstTaps(NamedTuple):
    """The taps with which a tuning begins, of a law that is the same in all samples.

    lead:    of the middle tap of L, see `Window`
    besides: {name: (S,)} numbers of the machines that joined the family
    """

    filters: Filters
    lead: int
    besides: dict[str, np.ndarray]


def best_of_leads(
    family: Family,
    window: Callable[[int], Window],
    starts: Sequence[Scheme | None],
    task: Task,
    trials: int,
    below: float,
    risk: Risk,
) -> tuple[int, Filters]:
    """The lead with the least loss of the taps that a brief search finds, and these taps.

    Taps with which the ends of the trial are safe too come first, see `radius_in_a_trial`.

    window: of a lead, for a law that is the same in all samples
    starts: laws that the taps are taken from; None is one that learns nothing
    """
    leads = leads_of(family, task)
    for start in starts:
        if start is not None:
            L = law_of(start, task).L
            weight = np.sum(np.asarray(L.taps) ** 2, axis=(1, 2))
            leads.append(max(0, round(float(np.sum(L.powers * weight) / np.sum(weight))) - 1))
    tried: dict[int, tuple[tuple[bool, float], Filters]] = {}
    for lead in leads:
        one = window(lead).unscheduled()
        if any(abs(lead - other) <= len(one.of_L) / APART for other in tried):
            continue
        each = []
        for start in starts:
            found, loss = by_response(
                family, one, held(one, start, task), task, trials, below, steps=BRIEF, risk=risk
            )
            each.append(((radius_in_a_trial(family, one, found, task) >= 1, loss), found))
        tried[one.lead] = min(each, key=lambda pair: pair[0])
    lead = min(tried, key=lambda lead: tried[lead][0])
    return lead, tried[lead][1]


def radius_in_a_trial(
    family: Family, window: Window, filters: Filters, task: Task, machine: int = 0
) -> float:
    """Largest |eigenvalue| of the learning map of a machine, in a trial of its ends.

    The test by frequency holds far from the ends of a trial. At its end L looks for errors that do
    not exist, and a law may diverge there that is safe elsewhere. Of a scheduled law it is that of
    the last segment; of several channels it is not computed, and 0.
    """
    reach = window.lead + len(window.of_L) + len(window.of_keep)
    N = min(task.N, max(SHORT, ENDS * reach))
    if family.P.ndim > 2 or not family.loops:
        return 0.0
    if window.starts:
        window, filters = window.unscheduled(), Filters(filters.L[-1], filters.keep[-1])
    law = learning_law(window.of(filters), Task(np.zeros(N + 1), dt=task.dt))
    P = scipy.linalg.toeplitz(impulse_response(family.loops[machine], N), np.zeros(N))
    return float(np.max(np.abs(np.linalg.eigvals(law.keep - law.L @ P))))


def held(window: Window, start: Scheme | None, task: Task) -> Filters:
    """The taps of a law as far as they lie in a window; None is a law that learns nothing."""
    return window.nothing() if start is None else window.holding(law_of(start, task))


def exchanged(
    family: Family,
    joined: Callable[[dict[str, np.ndarray]], Family],
    watch: Callable[[int], Family],
    window: Window,
    first: Filters,
    task: Task,
    trials: int,
    below: float,
    most: float,
    risk: Risk,
) -> FirstTaps:
    """Taps by frequency response that keep a bound on the machines that watch, as far as possible.

    A law that keeps the bound on the machines of a family may break it on one between them, whose
    resonance lies elsewhere. So it is watched on others, of which the worst join the family, until
    none of fresh ones breaks it. Those of the gate, which judges what is found, are others again.

    joined: the family with machines of these numbers besides;  watch: those that watch in a round
    below: bound on |keep - L P| in the search;  most: on the machines that watch
    """
    found, _ = by_response(family, window, first, task, trials, below, risk=risk)
    besides: dict[str, np.ndarray] = {}
    for turn in range(ROUNDS if family.drawn else 0):
        others = watch(turn)
        sizes = np.max(sizes_of(others, window, found, task.dt), axis=1)
        worst = np.argsort(-sizes)[:JOIN]
        worst = worst[sizes[worst] > most]
        if not len(worst):
            break
        besides = {
            name: np.concatenate([besides.get(name, np.zeros(0)), np.asarray(values)[worst]])
            for name, values in others.drawn.items()
        }
        family = joined(besides)
        found, _ = by_response(family, window, found, task, trials, below, steps=BRIEF, risk=risk)
    return FirstTaps(found, window.lead, besides)
