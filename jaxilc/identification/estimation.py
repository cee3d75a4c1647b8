"""Identification fits a plant to the record of an experiment (Cao 2019, section II-B)."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple, TypeAlias, cast

import jax
import jax.numpy as jnp
import numpy as np
import scipy

from ..learning.machine import Machine
from ..plants import ModalModel, Plant, ProcessModel
from ..plants.process_model import LONGEST_DELAY
from ..pytree.aliases import Numbers
from ..pytree.in_short import in_short
from ..pytree.ranges import SEEDS, require
from ..runtime.capacity import check_size
from ..runtime.tiles import tiled
from .problem import (
    SAMPLES_PER_PARAMETER,
    Minimum,
    Problem,
    checked_record,
    free_elements,
    minimum,
    need_samples,
    problem_of,
)
from .records import Record, as_columns, output_from_rest
from .verdict import (
    WHITE,
    Estimate,
    Identified,
    autoregression,
    fit_of,
    judged,
    of_least_bic,
    whiteness_of,
)

MOST = 50  # largest number of poles, pairs or zeros; a record can determine far fewer
LITTLE = 0.02  # of what is left: a loop or a start that explains less is none
MOVING = 50.0  # of the criterion, by which a start in motion must explain more than one at rest
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
    from_rest: bool | None = None,
) -> Identified:
    """Fit a plant to a record by prediction-error least squares through the simulator.

        minimise over theta, bias:  sum_k |y[k] - bias - y_sim[k](theta)|^2
        covariance = sigma^2 (J^T J)^-1,  sigma^2: variance of the residual

    The prediction is the output that the plant gives under the recorded input (an output-error
    model), from rest or, of a ProcessModel or a ModalModel, from a state that is fitted, too: what
    it adds is a sum of the free motions of the poles. With white Gaussian noise on the output, such
    as that of an encoder in open loop, the estimate is that of maximum likelihood. J holds the
    exact derivatives of the simulated output, by forward differentiation. Several outputs are
    weighted by the inverse of their residual standard deviations, which are found by iteration;
    this is maximum likelihood where the noises of the outputs are independent.

    plant: the plant to start from; None for a ProcessModel with the given numbers of `poles`, of
        complex `pairs` of poles and of `zeros` (1, 1, 1 is Cao 2019, eq. 6), started automatically
    delay: dead time of this ProcessModel in whole samples, beyond the one sample that every plant
        here has; it is fixed, see `grow` for its choice
    free: leaves of the plant, or elements of them, that are fitted; None for all
    fit_share: (0, 1], share of the record that is fitted; the rest validates the fit, and is
        simulated without a break
    starts: number of structures drawn, with rates log-uniform between 1 / duration and half the
        Nyquist frequency; the best are refined; take more for several lightly damped pairs
    from_rest: whether the machine rests at an input of 0 when the record begins; None: unless the
        record clearly shows the motion of another start. Several experiments begin at rest

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
        plant = with_as_many("identify", poles, pairs, zeros)
        require("identify", "starts", starts, "[1, inf)", whole=True)
        require("identify", "delay", delay, f"[0, {LONGEST_DELAY}]", whole=True)
        if free is not None:
            raise ValueError(
                f"identify: free = {list(free)} names leaves of a plant, but no plant is given"
            )
        need_samples(round(fit_share * len(record.y)) * record.y.shape[1], 2 + zeros + plant.order)
    elif delay:
        raise ValueError(
            f"identify: delay = {delay} is for a ProcessModel that is started automatically; the "
            "plant given has its own"
        )
    problem = problem_of(later(record, delay), plant, free_elements(plant, free), fit_share)
    problem = problem._replace(from_rest=from_rest is not False, late=delay)
    if not problem.from_rest:
        if not has_start(problem):
            raise ValueError(
                "identify: from_rest = False is for one experiment, with a ProcessModel or a "
                f"ModalModel; this is a {type(plant).__name__}, and there are {record.trials}"
            )
        need_samples(*beyond_start(problem))
    search = functools.partial(from_many_starts, starts=starts, seed=seed)
    found = minimum(problem, problem.start(plant)) if given else search(problem)
    may_move = from_rest is None and long_enough_to_move(problem)
    if may_move and np.any(whiteness_of(problem.residual(found.theta)[: problem.samples]) < WHITE):
        near = [found.theta]
        if not given and np.any(record.u[0]):  # where a machine often rests
            at_first = record._replace(u=record.u - record.u[0])
            near.append(search(problem._replace(record=later(at_first, delay))).theta)
        problem, found = better_of_starts(problem, found, near)
    for _ in range(REWEIGHTINGS if plant.n_y > 1 else 0):
        spread = np.std(problem.residual(found.theta)[: problem.samples], axis=0)
        problem = problem._replace(scale=np.maximum(spread, 1e-12 * problem.scale))
        found = minimum(problem, found.theta)
    result = judged(problem, found)
    if not delay:
        return result
    return result._replace(plant=dataclasses.replace(result.plant, delay=delay * record.dt))


def has_start(problem: Problem) -> bool:
    """Whether the free motions of the plant of a record are known, and it is one experiment."""
    return problem.record.trials == 1 and isinstance(problem.plant, ProcessModel | ModalModel)


def beyond_start(problem: Problem) -> tuple[int, int]:
    """The samples after the dead time, and the parameters with what a start in motion adds."""
    order, n_y = cast(ProcessModel, problem.plant).order, problem.plant.n_y
    return (problem.samples - problem.past) * n_y, len(problem.names) + (1 + order) * n_y


def long_enough_to_move(problem: Problem) -> bool:
    """Whether a start in motion is known of a plant, and its record is long enough to tell one."""
    if not has_start(problem):
        return False
    samples, parameters = beyond_start(problem)
    return samples >= SAMPLES_PER_PARAMETER * parameters


def better_of_starts(
    problem: Problem, at_rest: Minimum, near: Sequence[Numbers]
) -> tuple[Problem, Minimum]:
    """The fit with a start in motion, if it explains clearly more, else the one from rest.

    near: where the search for the former begins
    """
    free = problem._replace(from_rest=False)
    found = [minimum(free, free.start(free.plant_at(theta))) for theta in near]
    moving = min(found, key=lambda one: one.cost)
    better = clearly_in_motion(problem.residual(at_rest.theta), free, moving.theta)
    return (free, moving) if better else (problem, at_rest)


def clearly_in_motion(residual: Numbers, free: Problem, theta: Numbers) -> bool:
    """Whether free motions leave clearly less than a start at rest, by the criterion.

    Slow noise looks like a slow motion, so both residuals are whitened, as that with free motions.

    residual: of the start at rest;  free: the problem of the other one, at theta
    """
    left, from_rest = (of[: free.samples] / free.scale for of in (free.residual(theta), residual))
    if np.sum(left**2) > (1 - LITTLE) * np.sum(from_rest**2):
        return False
    whitening = [np.append(1.0, -autoregression(one)[0]) for one in left.T]

    def criterion(of: Numbers, parameters: int) -> float:
        white = [scipy.signal.lfilter(a, 1.0, e) for a, e in zip(whitening, of.T, strict=True)]
        return information(np.transpose(white), parameters)

    return criterion(left, free.parameters_of_start(theta)) < criterion(from_rest, 0) - MOVING


def with_as_many(function: str, poles: int, pairs: int, zeros: int) -> ProcessModel:
    """A plant with so many poles, pairs and zeros, all 1; raises ValueError for impossible ones."""
    for name, value in (("poles", poles), ("pairs", pairs), ("zeros", zeros)):
        require(function, name, value, f"[0, {MOST}]", whole=True)
    require(function, "zeros", zeros, f"[0, {poles + 2 * pairs})", note=", the order")
    return ProcessModel(1.0, np.ones(zeros), np.ones(poles), np.ones(pairs), np.ones(pairs))


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


# The best of many drawn structures
# --------------------------------------------------------------------------------------------------

REFINED = 16  # number of starts, those with the best fit, that are refined


def from_many_starts(problem: Problem, starts: int, seed: int) -> Minimum:
    """The best fit from many drawn structures, scored by least squares of numerator and bias."""
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
        with_numerator(jax.tree.map(lambda leaf, i=i: leaf[i], drawn), scored[i][1])
        for i in sorted(range(starts), key=lambda i: scored[i][0])[:REFINED]
        if np.isfinite(scored[i][0])
    ]
    return best_refined(problem, best)


def best_refined(problem, plants: Sequence[ProcessModel]) -> Minimum:
    """The best of the minima near some plants, refined to the tolerances.

    Before that it is regrouped: an overdamped pair becomes two real poles, see
    `ProcessModel.regrouped`.
    """
    begin = (problem.start(plant) for plant in plants)
    near = [minimum(problem, theta, ftol=1e-4, max_nfev=30) for theta in begin]
    best = problem.plant_at(min(near, key=lambda found: found.cost).theta)
    return minimum(problem, problem.start(best.regrouped()))


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


# The choice of an order
# --------------------------------------------------------------------------------------------------

Structure: TypeAlias = tuple[int, int, int]  # poles, pairs, zeros
# Orders 1 to 4. A pair may have two real poles.
STRUCTURES = ((1, 0, 0), (0, 1, 0), (0, 1, 1), (1, 1, 0), (1, 1, 1), (0, 2, 0), (0, 2, 1))
SMALLEST = 1e-9  # of the output's standard deviation; a smaller residual is rounding


class Order(NamedTuple):
    """The fit of one structure.

    poles, pairs, zeros: numbers of real poles, pairs of poles and zeros
    parameters: number of fitted numbers, with the bias, and with the delay where it is not 0
    rms: root mean square of the residual over the fitted part [unit of y]
    bic: Bayesian information criterion, see `information`
    validation_fit: fit over the validation part [%]
    delay: dead time in samples, of a fit to a record
    """

    poles: int
    pairs: int
    zeros: int
    parameters: int
    rms: float
    bic: float
    validation_fit: float
    found: Identified
    delay: int = 0
    __repr__ = in_short


def compare_orders(
    record: Record,
    *,
    structures: Sequence[Structure] = STRUCTURES,
    delay: int = 0,
    starts: int = 64,
    seed: int = 0,
    each: Callable[[Structure], object] = lambda structure: None,
) -> list[Order]:
    """Fits of several structures to a record of one input and one output, in the order given.

    delay: dead time of all of them in samples
    starts, seed: as for `identify`; the first 70 % of the record are fitted
    each: called with each structure before it is fitted
    A structure of too many parameters for the record is left out, except the first one.
    Raises ValueError as `identify` does.
    """
    found = []
    fit_of_each = functools.partial(identify, record, delay=delay, starts=starts, seed=seed)
    enough = functools.partial(long_enough, record)
    for structure, fit in fitted_to_each(structures, enough, fit_of_each, each):
        y = np.asarray(record.y).reshape(len(fit.simulated), -1)[: fit.samples]
        residual = (y - fit.simulated[: fit.samples])[:, 0]
        number = len(fit.parameters) + (delay > 0)
        bic = information(residual, number, SMALLEST * float(np.std(y)))
        rms, validation = float(np.sqrt(np.mean(residual**2))), float(fit.validation_fit[0])
        found.append(Order(*structure, number, rms, bic, validation, fit, delay))
    return found


def fitted_to_each(
    structures: Sequence[Structure],
    enough: Callable[[int], bool],
    fit: Callable[..., Identified],
    each: Callable[[Structure], object],
) -> Iterator[tuple[Structure, Identified]]:
    """The structures with their fits, without those, except the first, of too many parameters."""
    for i, (poles, pairs, zeros) in enumerate(structures):
        if not i or enough(2 + poles + 2 * pairs + zeros):
            each((poles, pairs, zeros))
            yield (poles, pairs, zeros), fit(poles=poles, pairs=pairs, zeros=zeros)


def long_enough(record: Record, parameters: int) -> bool:
    """Whether the fitted part of a record has enough samples for so many parameters."""
    return round(0.7 * len(record.y)) >= SAMPLES_PER_PARAMETER * parameters


def information(residual, parameters: int, smallest: float = 0.0) -> float:
    """The Bayesian information criterion of a fit with Gaussian residuals (Schwarz 1978).

        BIC = n sum_i ln(sum e_i^2 / n) + p ln n    over the outputs i

    residual: (n,) or (n, n_y);  parameters: p
    smallest: root mean square below which a residual is rounding
    """
    n = len(residual)
    mean = np.mean(np.asarray(residual) ** 2, axis=0)
    log = np.log(np.maximum(mean, max(smallest**2, np.finfo(float).tiny)))
    return n * float(np.sum(log)) + parameters * float(np.log(n))


def best_order(orders: Sequence[Order]) -> Order:
    """The structure of the smallest BIC. A fit that did not converge is taken only if all did not.

    Raises ValueError for no structures.
    """
    if not orders:
        raise ValueError("best_order: orders = () is empty; allowed is at least one")
    return min(orders, key=lambda order: (not order.found.converged, order.bic))


def not_significant(found: Identified) -> list[str]:
    """Sentences on the poles and zeros of a ProcessModel that the record does not show.

    A zero or a pole makes no difference where its 95 % interval, taken of its reciprocal, contains
    0, since 1 - s / zero and 1 + s / pole are then 1. A zero and a real pole cancel where their
    intervals, of places in s, overlap.
    """
    if not isinstance(found.plant, ProcessModel):
        return []
    said, places = [], {}
    for name, (value, low, high) in found.parameters.items():
        kind = name.partition("[")[0]
        if kind not in ("zeros", "poles", "frequencies"):
            continue
        half = (high - low) / 2
        # of the reciprocal, to first order, the half-width is half / value^2
        if not half < abs(value):
            what = {"zeros": "zero", "poles": "pole", "frequencies": "pair of poles"}[kind]
            said.append(
                f"the {what} {name} = {value:.4g} rad/s is not significant: the 95 % interval of "
                "its reciprocal contains 0; leave it out"
            )
        elif kind != "frequencies":
            places[name] = (-high, -low) if kind == "poles" else (low, high)
    for zero, (low, high) in places.items():
        for pole, (left, right) in places.items():
            of_both = zero.startswith("zeros") and pole.startswith("poles")
            if of_both and low <= right and left <= high:
                said.append(
                    f"the zero {zero} and the pole {pole} are not significant: their 95 % "
                    "intervals overlap, so that they may cancel; leave both out"
                )
    return said


# A second record judges a plant
# --------------------------------------------------------------------------------------------------

MUCH = 2.0  # rms error over that of the record that was fitted, from which on a plant is doubted


class Validation(NamedTuple):
    """How well a plant predicts a record.

    simulated: (N+1, n_y) the output of the plant, with the bias that makes the mean residual 0
    fit: (n_y,) 100 (1 - |y - simulated| / |y - mean y|) [%]
    rms: (n_y,) rms error of prediction [unit of y]
    """

    simulated: np.ndarray
    fit: np.ndarray
    rms: np.ndarray
    __repr__ = in_short


def validated(record: Record, plant: Plant, share: float = 0.0) -> Validation:
    """How well a plant predicts a record, or the last part of it, from rest or from a motion.

    share: [0, 1), first part of the record, which is not judged; the bias is then that of it
    Raises ValueError for a record that does not fit the plant.
    """
    record = checked_record(record)
    first = free_elements(plant, None)[:1]
    problem = problem_of(record, plant, first, share or 1.0)
    residual, free = problem.residual(problem.start(plant)), problem._replace(from_rest=False)
    if long_enough_to_move(free) and clearly_in_motion(residual, free, free.start(plant)):
        residual = free.residual(free.start(plant))
    late = slice(problem.samples if share else 0, None)
    fit = fit_of(record.y[late], residual[late])
    rms = np.sqrt(np.mean(residual[late] ** 2, axis=0))
    return Validation(record.y - residual, fit, rms)


# Records of a closed loop
# --------------------------------------------------------------------------------------------------

OWN, LAGS = 60, 20  # past samples of the input, and of the residual, that predict the input
SAMPLES, MOST_LOOKED_AT = 5, 20_000  # for each parameter at least, and of a record at most
CHANCE = 1e-5  # with which an open loop is taken for a closed one, where the input is random
FORESEEN, LINES = 0.005, 0.85  # share its past leaves, power in a quarter of its spectrum: no noise
ANSWERED = 0.2  # of what is left of such an input: a feedback that explains less is none
MISSED = 1e-3  # chance of what the past of the input tells of e, below which a plant is missed
ROUNDS = 3  # of the plant and its noise in turn
SHARE = 0.1  # of the samples: length of F at most
LONGEST = 400  # samples


def feedback_seen(record: Record, residual, *, late: int = 0) -> bool:
    """Whether the input answers the residual of a fit, so that a loop is closed (Granger's test).

    The input is predicted from its own past, then from the residual too. In an open loop the second
    prediction is hardly better, also where the model is not the plant: what it misses is made of
    the past of the input. Of an input that hardly is random, such as a multisine, it tells what
    lies further back, too: on simulated machines up to 7 % of what was left, where a feedback told
    60 % and more. The residual of the same sample tells a loop that is closed without a delay, but
    it is made of that input, too, where the output answers within the sample.

    residual: (N+1, 1) recorded output minus the simulated one; one input and one output
    late: samples that pass at least until the input answers; 1 leaves out the same sample
    """
    u = as_columns("feedback_seen", "u", record.u)[:MOST_LOOKED_AT, 0]
    e = np.asarray(residual, float)[: len(u), 0]
    parameters = 1 + OWN + LAGS
    freedom = len(u) - OWN - parameters
    if freedom < SAMPLES * parameters:
        return False
    windows = np.lib.stride_tricks.sliding_window_view
    own = np.column_stack([np.ones(len(u) - OWN), windows(u[:-1], OWN)])
    answered = windows(e[OWN - LAGS + 1 - late : len(e) - late], LAGS)
    Q, R = np.linalg.qr(np.column_stack([own, answered, u[OWN:]]))  # no direction is cut off
    of_both = R[own.shape[1] :, -1]
    first, then = np.sum(of_both**2), of_both[-1] ** 2
    size = np.sum((u - np.mean(u)) ** 2)
    if not first > 1e-12 * size:
        return False  # an input that predicts itself, such as a sum of a few sinusoids
    power = np.abs(np.fft.rfft(Q[:, own.shape[1] :] @ of_both * np.hanning(len(Q)))) ** 2
    of_lines = np.sum(np.sort(power)[-len(power) // 4 :]) > LINES * np.sum(power)
    least = ANSWERED if of_lines or first < FORESEEN * size else LITTLE
    if then > (1 - least) * first:
        return False
    return chance_of(first, then, freedom) < CHANCE


def with_noise(record: Record, found: Identified) -> Identified:
    """A fit again, together with the noise that it left: an autoregression of its residual.

        A y = A P u + e,    A = 1 - sum_j a_j z^-j    which makes the residual of `found` white

    So nothing of the past of the noise is left that the input of a closed loop could tell, and the
    fit is not biased where plant and noise have such a form (Ljung 1999, section 13.4); e is then
    white, and the past of the input does not tell it, as it tells what a plant misses: `white` says
    whether both hold. Of the result it and the intervals are those of e, the rest is that of
    y - P u. A fit whose residual needs no such noise is returned.

    record: one input, one output;  found: the fit to it
    """
    record, n = checked_record(record), found.samples
    left, bias = record.y - found.simulated, found.parameters["bias"].value
    a, std = whitening_of(left[:n, 0]), found.residual_std / np.linalg.norm(left[:n])
    if found.white and len(a) == 1:
        return found
    for _ in range(ROUNDS):
        late = 0 if found.from_rest else len(a) - 1  # rows before it have an unknown past
        of_both = (record.u, record.y - bias)
        u, y = (scipy.signal.lfilter(a, 1.0, one, axis=0)[late:] for one in of_both)
        share = (n - late) / len(y)
        again = record._replace(u=u, y=y)
        found = identify(again, found.plant, fit_share=share, from_rest=found.from_rest)
        own = Estimate(*(bias + of / np.sum(a) for of in found.parameters["bias"]))
        simulated, bias = validated(record, found.plant).simulated, own.value
        left = record.y - simulated
        a = whitening_of(left[:n, 0])
    e = (y - found.simulated)[LAGS : n - late, 0]
    past = np.lib.stride_tricks.sliding_window_view(u[: n - late - 1, 0], LAGS)
    _, R = np.linalg.qr(np.column_stack([np.ones(len(e)), past, e]))
    missed = chance_of(np.sum(R[1:, -1] ** 2), R[-1, -1] ** 2, len(e) - 1 - LAGS) < MISSED
    return found._replace(
        parameters=found.parameters | {"bias": own},
        samples=n,
        simulated=simulated,
        fit=fit_of(record.y[:n], left[:n]),
        validation_fit=fit_of(record.y[n:], left[n:]),
        residual_std=std * np.linalg.norm(left[:n]),
        white=found.white and not missed,
    )


def whitening_of(residual) -> np.ndarray:
    """The numbers 1, -a_1, -a_2, ... of the autoregression of least BIC; of white noise only 1."""
    return np.append(1.0, -of_least_bic(autoregression(residual)[1], len(residual)))


def chance_of(first: float, then: float, freedom: int) -> float:
    """The chance that LAGS numbers which tell nothing leave as little of a sum of squares."""
    ratio = (first - then) / LAGS / (max(then, 1e-15 * first) / freedom)
    return float(scipy.stats.f.sf(ratio, LAGS, freedom))


def of_reference(record: Record, reference) -> Record:
    """The record with the part of its input that the reference made, in place of the input.

        u_r = F r,    F: an impulse response by least squares

    With a feedback the input answers the noise of the output, and a fit to u is biased where that
    noise is not white. A fit from u_r to y is not in long records, whatever noise, feedback and
    plant are: what the feedback added is noise of the output (Van den Hof and Schrama 1993). Of N
    samples and n numbers F, a share n / N of the noise in u stays in u_r.

    reference: (N,) recorded reference
    Raises ValueError for a reference that does not move.
    """
    u, r = (as_columns("of_reference", "u", one)[:, 0] for one in (record.u, reference))
    if not np.ptp(r) > 0:
        raise ValueError(
            "identify: the reference does not move, so that nothing but noise excites the loop; "
            "record a motion, or add an excitation to the reference"
        )
    taps = int(min(LONGEST, SHARE * len(u)))
    first = np.concatenate([r[:1], np.zeros(taps - 1)])
    past = scipy.linalg.toeplitz(r - r[0], first - r[0] * (np.arange(taps) == 0))
    past = np.column_stack([past, np.ones(len(u))])
    found, *_ = np.linalg.lstsq(past, u, rcond=1e-8)
    return record._replace(u=(past @ found)[:, None])
