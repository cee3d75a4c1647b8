"""Identification fits a plant to the record of an experiment (Cao 2019, section II-B)."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import jax
import numpy as np

from ..plants import Plant, ProcessModel
from ..plants.process_model import LONGEST_DELAY
from ..pytree.ranges import SEEDS, require
from .many_starts import from_many_starts
from .problem import checked_record, free_elements, need_samples, problem_of
from .records import Record
from .verdict import Identified, judged

MOST = 50  # largest number of poles, pairs or zeros; a record can determine far fewer
REWEIGHTINGS = 5  # iterations of the weights of several outputs


def identify(
    record: Record,
    plant: Plant | None = None,
    *,
    poles: int = 1,
    pairs: int = 1,
    zeros: int = 1,
    delay: int = 0,
    free: Sequence[str] | None = None,
    fit_share: float = 0.7,
    starts: int = 256,
    seed: int = 0,
) -> Identified:
    """Fit a plant to a record by prediction-error least squares through the simulator.

        minimise over theta, bias:  sum_k |y[k] - bias - y_sim[k](theta)|^2
        covariance = sigma^2 (J^T J)^-1,  sigma^2: variance of the residual

    The prediction is the output that the plant gives from rest under the recorded input (an
    output-error model). With white Gaussian noise on the output, such as that of an encoder in
    open loop, the estimate is that of maximum likelihood. J holds the exact derivatives of the
    simulated output, by forward differentiation. Several outputs are weighted by the inverse of
    their residual standard deviations, which are found by iteration; this is maximum likelihood
    where the noises of the outputs are independent.

    record: the experiment
    plant: the plant to start from; None for a ProcessModel with the given numbers of `poles`, of
        complex `pairs` of poles and of `zeros` (1, 1, 1 is Cao 2019, eq. 6), started automatically
    delay: dead time of this ProcessModel in whole samples, beyond the one sample that every plant
        here has; it is fixed, see `grow` for its choice
    free: leaves of the plant, or elements of them, that are fitted; None for all
    fit_share: (0, 1], share of the record that is fitted; the rest validates the fit, and is
        simulated without a break
    starts: number of structures drawn, with rates log-uniform between 1 / duration and half the
        Nyquist frequency; the best are refined; take more for several lightly damped pairs
    seed: seed of these draws

    The confidence intervals are Student's t times the standard deviation on each side, to first
    order in the parameters. Needs float64.
    Raises ValueError for a record that is not finite, does not fit the plant, is too short for the
    parameters or holds no information (constant output or input), and for a value outside its
    range.
    """
    # In float32 the rounding errors of the simulation are larger than an encoder's noise.
    if not jax.config.jax_enable_x64:
        raise ValueError(
            "identify: precision = 'float32' is not one of 'float64'; call jaxilc.setup() first"
        )
    record = checked_record(record)
    require("identify", "fit_share", fit_share, "(0, 1]")
    require("identify", "seed", seed, SEEDS, whole=True)
    given = plant is not None
    if not given:
        for name, value in (("poles", poles), ("pairs", pairs), ("zeros", zeros)):
            require("identify", name, value, f"[0, {MOST}]", whole=True)
        require("identify", "starts", starts, "[1, inf)", whole=True)
        require("identify", "delay", delay, f"[0, {LONGEST_DELAY}]", whole=True)
        order = poles + 2 * pairs
        require("identify", "zeros", zeros, f"[0, {order})", note=", the order")
        if free is not None:
            raise ValueError(
                f"identify: free = {list(free)} names leaves of a plant, but no plant is given"
            )
        need_samples(round(fit_share * len(record.y)) * record.y.shape[1], 2 + zeros + order)
        plant = ProcessModel(1.0, np.ones(zeros), np.ones(poles), np.ones(pairs), np.ones(pairs))
    elif delay:
        raise ValueError(
            f"identify: delay = {delay} is for a ProcessModel that is started automatically; the "
            "plant given has its own"
        )
    problem = problem_of(later(record, delay), plant, free_elements(plant, free), fit_share)
    found = (
        problem.solve(problem.start(plant)) if given else from_many_starts(problem, starts, seed)
    )
    for _ in range(REWEIGHTINGS if plant.n_y > 1 else 0):
        spread = np.std(problem.residual(found.theta)[: problem.samples], axis=0)
        problem = problem._replace(scale=np.maximum(spread, 1e-12 * problem.scale))
        found = problem.solve(found.theta)
    result = judged(problem, found)
    if not delay:
        return result
    return result._replace(plant=dataclasses.replace(result.plant, delay=delay * record.dt))


def later(record: Record, delay: int) -> Record:
    """The record with its input delayed by whole samples, from rest.

    A plant of this delay answers the input as the plant without it answers the delayed input. So
    every delay is fitted by the same compiled programs.
    """
    u = np.asarray(record.u)
    of_each = u.reshape(record.trials, -1, u.shape[1])
    N = of_each.shape[1]
    if not 0 <= delay < N:
        raise ValueError(
            f"identify: delay = {delay} samples is outside its allowed range [0, {N}), the "
            "length of the record"
        )
    moved = np.pad(of_each, ((0, 0), (delay, 0), (0, 0)))[:, :N]
    return record._replace(u=moved.reshape(u.shape))
