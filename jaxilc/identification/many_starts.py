"""The search for the best fit of a ProcessModel from many drawn structures."""

from __future__ import annotations

import dataclasses
import functools
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
import scipy

from ..learning.machine import Machine
from ..plants import ProcessModel
from ..runtime.capacity import check_size
from ..runtime.tiles import tiled
from .problem import Minimum, Problem
from .records import output_from_rest

REFINED = 16  # number of starts, those with the best fit, that are refined


def from_many_starts(problem: Problem, starts: int, seed: int) -> Minimum:
    """The best fit from many drawn structures.

    Each structure is scored by the least squares of its numerator and bias, and the best ones are
    refined. The best fit of these is regrouped (an overdamped pair becomes two real poles, see
    `ProcessModel.regrouped`) and refined to the tolerances.
    """
    # Bytes for the numbers drawn, and for the products of all pairs of the simulated signals.
    each = 8 * (100 + 8 * len(problem.names) ** 2)
    check_size("identify", each, starts=starts)
    shape, task = cast(ProcessModel, problem.plant), problem.task
    drawn = drawn_plants(shape, (1 / task.duration, 0.5 * np.pi / task.dt), starts, seed)
    fitted = np.arange(len(problem.record.y)) < problem.samples
    products = np.asarray(
        _products()((problem.task, problem.record.u, problem.record.y, fitted), drawn)
    )
    scored = [_numerator(product) for product in products]
    best = [
        i
        for i in sorted(range(starts), key=lambda i: scored[i][0])[:REFINED]
        if np.isfinite(scored[i][0])
    ]
    begin = [
        problem.start(with_numerator(jax.tree.map(lambda leaf, i=i: leaf[i], drawn), scored[i][1]))
        for i in best
    ]
    winner = min(
        (problem.solve(theta, ftol=1e-4, max_nfev=30) for theta in begin),
        key=lambda found: found.cost,
    )
    return problem.solve(problem.start(problem.plant_at(winner.theta).regrouped()))


def drawn_plants(
    shape: ProcessModel, rates: tuple[float, float], starts: int, seed: int
) -> ProcessModel:
    """Plants with drawn denominators, stacked over `starts`.

    The rates of the poles are log-uniform between the two given [rad/s], the dampings log-uniform
    in [0.05, 2]. All zeros of a plant are put at the geometric mean of its rates, which
    `_inner_products` starts from.

    shape: a plant with as many poles, pairs and zeros
    """
    m, n, q = shape.zeros.shape[0], shape.poles.shape[0], shape.frequencies.shape[0]
    unit = scipy.stats.qmc.LatinHypercube(n + 2 * q, rng=seed).random(starts)
    slowest, fastest = rates
    drawn = slowest * (fastest / slowest) ** unit[:, : n + q]
    zeros = np.repeat(np.exp(np.mean(np.log(drawn), axis=1, keepdims=True)), m, axis=1)
    return ProcessModel(
        np.ones(starts), zeros, drawn[:, :n], drawn[:, n:], 0.05 * 40 ** unit[:, n + q :]
    )


@functools.cache
def _products():
    """The function `_inner_products` for many plants, made on first use, when devices are known."""
    return tiled(_inner_products)


def _inner_products(common, plant: ProcessModel):
    """(m+3, m+3) inner products of 1, the outputs w_0 .. w_m and y over the fitted samples.

    w_k is simulated with the numerator (1 - s / a)^k, where a is the m-fold zero of the plant
    given: a numerator of order m is a linear combination of these, so that it can be found by
    linear least squares.
    """
    task, u, y, fitted = common
    outputs = [
        output_from_rest(Machine(dataclasses.replace(plant, zeros=plant.zeros[:k])), task, u)[:, 0]
        for k in range(plant.zeros.shape[0] + 1)
    ]
    columns = jnp.stack([jnp.ones_like(y[:, 0]), *outputs, y[:, 0]]) * fitted
    return columns @ columns.T


def _numerator(products):
    """The least sum of squares over bias and numerator, and the (m+1,) numerator weights."""
    if not np.all(np.isfinite(products)):
        return np.inf, None
    size = np.sqrt(np.maximum(np.diag(products)[:-1], np.finfo(float).tiny))
    weights = (
        np.linalg.lstsq(products[:-1, :-1] / np.outer(size, size), products[:-1, -1] / size)[0]
        / size
    )
    return float(products[-1, -1] - weights @ products[:-1, -1]), weights[1:]


def with_numerator(plant: ProcessModel, weights) -> ProcessModel:
    """The plant with the numerator sum_k weights_k (1 - s / a)^k.

    A ProcessModel has no complex zeros. In place of a complex pair it gets two real zeros that are
    moved apart by the imaginary part: two equal ones would have equal derivatives and stay equal.
    """
    roots = np.polynomial.polynomial.polyroots(weights)
    a = plant.zeros[0] if len(roots) else 1.0
    return dataclasses.replace(plant, gain=np.sum(weights), zeros=a * (1 - roots.real - roots.imag))
