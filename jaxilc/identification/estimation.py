"""Identification: excite a machine, record it, fit a plant to the record, and say how far to trust
it (Cao 2019, section II-B).
"""

from __future__ import annotations

import dataclasses
import functools
import re
from collections.abc import Sequence
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
import scipy.special
from scipy.stats import qmc

from ..learning.machine import Machine
from ..plants import Plant, ProcessModel
from ..pytree.named_paths import get_at, interval_at, named_leaves, replaced
from ..pytree.ranges import SEEDS, Interval, require
from ..runtime.capacity import check_size
from ..runtime.tiles import tiled
from ..signals.task import Task
from .records import Record, as_columns, played, task_of

CONFIDENCE = 0.95
SAMPLES_PER_PARAMETER = (
    5  # the intervals are asymptotic; with fewer samples they would mean nothing
)
MOST = 50  # poles, pairs or zeros: what a record can tell apart is far less
LAGS = 20  # of the residual's autocorrelation
DRAWS = 4000  # of the parameters, for the intervals of the poles
REFINED = 16  # of the starts, those that fit best
REWEIGHTINGS = 5  # of several outputs


class Estimate(NamedTuple):
    """A number with its 95 % confidence interval; an infinite one where the record does not
    determine the number.
    """

    value: float
    low: float
    high: float


class PoleEstimate(NamedTuple):
    """A pole [rad/s] with 95 % intervals of its real and of its imaginary part."""

    value: complex
    real: Estimate
    imag: Estimate


class Identified(NamedTuple):
    """What identification found.

    plant: with the fitted values;  parameters: by path, and `bias`, the output at rest (`bias[i]`
    of several outputs)
    covariance: (P, P) of the parameters in this order, inf on the diagonal of one that the record
    does not determine
    poles:   of a ProcessModel; intervals from draws of the parameters, since a double pole is no
    smooth function of them
    samples: output samples 0 .. samples-1 were fitted, the others validate;  simulated: (N+1, n_y)
    the plant's output, with the bias
    fit, validation_fit: (n_y,) 100 (1 - |y - simulated| / |y - mean y|) [%], 100 is perfect;
    validation nan if all was fitted
    residual_std: (n_y,) of y - simulated over the fitted part, with the degrees of freedom that are
    left
    whiteness: (n_y,) share of the residual's autocorrelations, lags 1 .. 20, within +-1.96 /
    sqrt(samples); 0.95 expected
    white: whether all shares reach 0.8, which white noise misses once in 400 times. If not, the
    structure is too poor, or the
           noise is coloured or no noise (rounding alone): the plant may still be good, but the
           intervals are too narrow
    converged: whether the optimiser met its tolerances; a structure too rich for the record may
    creep on without end
    """

    plant: Plant
    parameters: dict[str, Estimate]
    covariance: np.ndarray
    poles: tuple[PoleEstimate, ...]
    samples: int
    simulated: np.ndarray
    fit: np.ndarray
    validation_fit: np.ndarray
    residual_std: np.ndarray
    whiteness: np.ndarray
    white: bool
    converged: bool

    def summary(self) -> list[tuple[str, float, float, float]]:
        """Rows (quantity, value, low, high) to print; low and high are nan where there is no
        interval.
        """
        rows = [(name, *estimate) for name, estimate in self.parameters.items()]
        for i, pole in enumerate(self.poles, 1):
            rows += [
                (f"pole {i}, real part", *pole.real),
                (f"pole {i}, imaginary part", *pole.imag),
            ]
        figures = {
            "fit [%]": self.fit,
            "fit of the validation part [%]": self.validation_fit,
            "residual std": self.residual_std,
        }
        figures["share of residual autocorrelations within bounds"] = self.whiteness
        several = len(self.fit) > 1
        return rows + [
            (n + f", output {i}" * several, float(v), np.nan, np.nan)
            for n, vs in figures.items()
            for i, v in enumerate(vs)
        ]


def _output(values, names, plant, task, u):
    """(N+1, n_y) the plant's output without noise, its parameters `names` set to values (P,)."""
    return played(
        Machine(replaced(plant, dict(zip(names, values, strict=True)))), task, u, jax.random.key(0)
    ).y


_simulated = jax.jit(_output, static_argnames="names")
_sensitivity = jax.jit(jax.jacfwd(_output), static_argnames="names")  # (N+1, n_y, P), exact


# The fit
# --------------------------------------------------------------------------------------------------


def identify(
    record: Record,
    plant: Plant | None = None,
    *,
    poles: int = 1,
    pairs: int = 1,
    zeros: int = 1,
    free: Sequence[str] | None = None,
    fit_share: float = 0.7,
    starts: int = 256,
    seed: int = 0,
) -> Identified:
    """Fit a plant to a record by prediction-error least squares through the simulator.

        minimise over theta, bias:  sum_k |y[k] - bias - y_sim[k](theta)|^2,    covariance = sigma^2
        (J^T J)^-1

    The prediction is the simulated output, from rest (output error): with white Gaussian noise on
    the output, as of an encoder in open loop, this is maximum likelihood. J is exact, by forward
    differentiation of the simulation. Several outputs are weighted by the inverse of their residual
    standard deviations, in turns (maximum likelihood where their noises are independent).

    plant:     None for a ProcessModel of so many `poles`, `pairs` of poles and `zeros` (1, 1, 1 is
    Cao 2019, eq. 6), whose starts
               are automatic; else any plant, fitted from its own values in the leaves or elements
               `free` (all if None)
    fit_share: (0, 1], share of the record that is fitted; the rest, simulated on without a break,
    validates
    starts:    structures drawn, log-uniformly between 1 / duration and half the Nyquist frequency,
    of which the best are refined;
               with several lightly damped pairs take more
    seed:      of these draws
    Intervals are +- Student's t times the standard deviation, to first order in the parameters.
    float64 only.
    Raises ValueError for a record that is not finite, does not fit the plant, is too short for the
    parameters, or says nothing (constant output, zero input), and for a value outside its range.
    """
    if (
        not jax.config.jax_enable_x64
    ):  # in float32 the simulation's rounding is larger than an encoder's noise
        raise ValueError(
            "identify: precision = 'float32' is not one of 'float64'; call jaxilc.setup() first"
        )
    record = _checked(record)
    require("identify", "fit_share", fit_share, "(0, 1]")
    require("identify", "seed", seed, SEEDS, whole=True)
    given = plant is not None
    if not given:
        for name, value in (("poles", poles), ("pairs", pairs), ("zeros", zeros)):
            require("identify", name, value, f"[0, {MOST}]", whole=True)
        require("identify", "starts", starts, "[1, inf)", whole=True)
        _require("zeros", zeros, zeros < poles + 2 * pairs, f"[0, {poles + 2 * pairs}), the order")
        if free is not None:
            raise ValueError(
                f"identify: free = {list(free)} names leaves of a plant, but no plant is given"
            )
        _need_samples(
            round(fit_share * len(record.y)) * record.y.shape[1], 2 + zeros + poles + 2 * pairs
        )
        plant = ProcessModel(1.0, np.ones(zeros), np.ones(poles), np.ones(pairs), np.ones(pairs))
    problem = _problem(record, plant, _free(plant, free), fit_share)
    found = (
        problem.solve(problem.start(plant)) if given else _from_many_starts(problem, starts, seed)
    )
    for _ in range(REWEIGHTINGS if plant.n_y > 1 else 0):
        spread = np.std(problem.residual(found.theta)[: problem.samples], axis=0)
        problem = problem._replace(scale=np.maximum(spread, 1e-12 * problem.scale))
        found = problem.solve(found.theta)
    return _judged(problem, found)


class _Coordinates(NamedTuple):
    """What the optimiser works on: the logarithm of a value that must be positive, the reciprocal
    of a ProcessModel's zero, which so may change sign through infinity, and any other value as it
    is, within bounds. log, reciprocal: (P,) which are which
    """

    log: np.ndarray
    reciprocal: np.ndarray
    low: np.ndarray
    high: np.ndarray

    @classmethod
    def of(cls, plant: Plant, names: tuple[str, ...]) -> _Coordinates:
        """For the elements `names` of the plant and one bias an output."""
        free = Interval(-np.inf, np.inf, False, False)
        allowed = [interval_at(plant, name) or free for name in names] + [free] * plant.n_y
        log = np.array([tuple(a) == (0.0, np.inf, False, False) for a in allowed])
        reciprocal = np.array(
            [isinstance(plant, ProcessModel) and n.startswith("zeros") for n in names]
            + [False] * plant.n_y
        )
        return cls(
            log,
            reciprocal,
            np.where(log, -np.inf, [a.low for a in allowed]),
            np.array([a.high for a in allowed]),
        )

    def from_values(self, theta):
        return self._mapped(theta, np.log)

    def to_values(self, x):
        with np.errstate(
            over="ignore", divide="ignore"
        ):  # a step too far is not finite, and the optimiser then shortens it
            return self._mapped(x, np.exp)

    def slope(self, theta):
        """(P,) d value / d coordinate."""
        return np.where(self.log, theta, np.where(self.reciprocal, -(theta**2), 1.0))

    def _mapped(self, values, function):
        mapped = np.array(values, dtype=float)
        mapped[self.log] = function(mapped[self.log])
        mapped[self.reciprocal] = 1.0 / mapped[self.reciprocal]
        return mapped


class _Minimum(NamedTuple):
    """Where the optimiser stopped, and whether by its tolerances rather than its budget of
    simulations.
    """

    theta: np.ndarray
    cost: float
    converged: bool


class _Problem(NamedTuple):
    """The least-squares problem. theta: (P,) the values of the plant's elements `names`, then the
    n_y biases; scale: (n_y,) of y
    """

    record: Record
    plant: Plant
    task: Task
    names: tuple[str, ...]
    coordinates: _Coordinates
    samples: int
    scale: np.ndarray

    def simulated(self, theta):
        """(N+1, n_y)"""
        n = len(self.names)
        return (
            np.asarray(_simulated(theta[:n], self.names, self.plant, self.task, self.record.u))
            + theta[n:]
        )

    def residual(self, theta):
        """(N+1, n_y)"""
        return self.record.y - self.simulated(theta)

    def sensitivity(self, theta):
        """(samples, n_y, P) derivatives of the simulated output, exact."""
        n, n_y = len(self.names), self.plant.n_y
        of_plant = np.asarray(
            _sensitivity(theta[:n], self.names, self.plant, self.task, self.record.u)
        )[: self.samples]
        return np.concatenate(
            [of_plant, np.broadcast_to(np.eye(n_y), (self.samples, n_y, n_y))], axis=2
        )

    def start(self, plant):
        """theta of a plant, with the biases that suit it."""
        values = [float(get_at(plant, name)) for name in self.names]
        bias = np.mean(self.residual(np.array(values + [0.0] * plant.n_y))[: self.samples], axis=0)
        if not np.all(np.isfinite(bias)):
            raise ValueError(
                f"identify: the output of the given {type(plant).__name__} does not stay finite over this record"
            )
        return np.array([*values, *bias])

    def plant_at(self, theta):
        return replaced(self.plant, dict(zip(self.names, map(float, theta), strict=False)))

    def solve(self, theta, **options):
        """The minimum that Levenberg-Marquardt steps within a trust region reach from theta."""
        to_values, scale = self.coordinates.to_values, self.scale

        def residual(x):
            return np.ravel(-self.residual(to_values(x))[: self.samples] / scale)

        def jacobian(x):
            theta = to_values(x)
            return (self.sensitivity(theta) / scale[:, None]).reshape(
                -1, len(theta)
            ) * self.coordinates.slope(theta)

        bounds = (self.coordinates.low, self.coordinates.high)
        options = {"ftol": 1e-12, "xtol": 1e-10, "gtol": 1e-12, "max_nfev": 200} | options
        found = scipy.optimize.least_squares(
            residual,
            self.coordinates.from_values(theta),
            jacobian,
            bounds,
            x_scale="jac",
            **options,
        )
        return _Minimum(to_values(found.x), found.cost, found.status > 0)


def _from_many_starts(problem: _Problem, starts: int, seed: int) -> _Minimum:
    """The best fit from many drawn structures: all are scored, the best refined, the winner
    regrouped and polished.
    """
    each = 8 * (
        100 + 8 * len(problem.names) ** 2
    )  # numbers drawn, and products of all pairs of what they simulate
    check_size("identify", lambda starts: each * starts, starts=starts)
    drawn = _draw(cast(ProcessModel, problem.plant), problem.task, starts, seed)
    fitted = np.arange(problem.task.N + 1) < problem.samples
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
        problem.start(_with_numerator(jax.tree.map(lambda leaf, i=i: leaf[i], drawn), scored[i][1]))
        for i in best
    ]
    winner = min(
        (problem.solve(theta, ftol=1e-4, max_nfev=30) for theta in begin),
        key=lambda found: found.cost,
    )
    return problem.solve(problem.start(problem.plant_at(winner.theta).regrouped()))


def _draw(shape: ProcessModel, task: Task, starts: int, seed: int) -> ProcessModel:
    """(starts, ...) denominators: rates log-uniform between 1 / duration and half the Nyquist
    frequency, dampings likewise in 0.05 .. 2.

    The zeros are put where the poles are on average, for `_inner_products` to start from.
    """
    m, n, q = shape.zeros.shape[0], shape.poles.shape[0], shape.frequencies.shape[0]
    unit = qmc.LatinHypercube(n + 2 * q, rng=seed).random(starts)
    slowest, fastest = 1 / task.duration, 0.5 * np.pi / task.dt
    rates = slowest * (fastest / slowest) ** unit[:, : n + q]
    zeros = np.repeat(np.exp(np.mean(np.log(rates), axis=1, keepdims=True)), m, axis=1)
    return ProcessModel(
        np.ones(starts), zeros, rates[:, :n], rates[:, n:], 0.05 * 40 ** unit[:, n + q :]
    )


@functools.cache
def _products():
    """tiled(_inner_products); made on first use, since it asks for the devices."""
    return tiled(_inner_products)


def _inner_products(common, plant: ProcessModel):
    """(m+3, m+3) between 1, the outputs w_0 .. w_m and y over the fitted samples; w_k is simulated
    with the numerator (1 - s / a)^k, where a is the m-fold zero of the plant given, so that the
    numerator enters linearly.
    """
    task, u, y, fitted = common
    outputs = [
        played(
            Machine(dataclasses.replace(plant, zeros=plant.zeros[:k])), task, u, jax.random.key(0)
        ).y[:, 0]
        for k in range(plant.zeros.shape[0] + 1)
    ]
    columns = jnp.stack([jnp.ones_like(y[:, 0]), *outputs, y[:, 0]]) * fitted
    return columns @ columns.T


def _numerator(products):
    """Sum of squares that the best bias and numerator leave, and the weights (m+1,) of that
    numerator.
    """
    if not np.all(np.isfinite(products)):
        return np.inf, None
    size = np.sqrt(np.maximum(np.diag(products)[:-1], np.finfo(float).tiny))
    weights = (
        np.linalg.lstsq(products[:-1, :-1] / np.outer(size, size), products[:-1, -1] / size)[0]
        / size
    )
    return float(products[-1, -1] - weights @ products[:-1, -1]), weights[1:]


def _with_numerator(plant: ProcessModel, weights) -> ProcessModel:
    """The plant with the numerator sum_k weights_k (1 - s / a)^k. Of a complex pair of zeros, which
    a ProcessModel cannot have, it gets two real ones apart by the imaginary part: two equal ones
    would have equal derivatives and stay equal.
    """
    roots = np.polynomial.polynomial.polyroots(weights)
    a = plant.zeros[0] if len(roots) else 1.0
    return dataclasses.replace(plant, gain=np.sum(weights), zeros=a * (1 - roots.real - roots.imag))


# What comes out
# --------------------------------------------------------------------------------------------------


def _judged(problem: _Problem, found: _Minimum) -> Identified:
    theta, samples, y = found.theta, problem.samples, problem.record.y
    residual, J = problem.residual(theta), problem.sensitivity(theta) / problem.scale[:, None]
    freedom = samples * problem.plant.n_y - len(theta)
    covariance = (
        np.sum((residual[:samples] / problem.scale) ** 2)
        / freedom
        * _inverse_of_normal(J.reshape(-1, len(theta)))
    )
    half = scipy.special.stdtrit(freedom, 0.5 + CONFIDENCE / 2) * np.sqrt(np.diag(covariance))
    biases = (
        ["bias"] if problem.plant.n_y == 1 else [f"bias[{i}]" for i in range(problem.plant.n_y)]
    )
    named = zip((*problem.names, *biases), theta, half, strict=True)
    whiteness = np.array([_whiteness(residual[:samples, i]) for i in range(problem.plant.n_y)])
    return Identified(
        plant=problem.plant_at(theta),
        parameters={name: Estimate(float(v), float(v - h), float(v + h)) for name, v, h in named},
        covariance=covariance,
        poles=_poles(problem, theta, covariance) if isinstance(problem.plant, ProcessModel) else (),
        samples=samples,
        simulated=y - residual,
        fit=_fit(y[:samples], residual[:samples]),
        validation_fit=_fit(y[samples:], residual[samples:]),
        residual_std=np.sqrt(np.sum(residual[:samples] ** 2, axis=0) * problem.plant.n_y / freedom),
        whiteness=whiteness,
        white=bool(np.all(whiteness >= 0.8)),
        converged=found.converged,
    )


def _inverse_of_normal(J):
    """(J^T J)^-1 from the singular values of J with its columns scaled to length 1; a parameter
    that enters a direction without effect gets inf on the diagonal and 0 beside it."""
    length = np.linalg.norm(J, axis=0)
    length[length == 0] = 1.0
    _, s, directions = np.linalg.svd(np.linalg.qr(J / length, mode="r"))
    dead = s < 1e-10 * s[0]
    undetermined = np.any(np.abs(directions[dead]) > 1e-3, axis=0)
    scaled = directions[~dead] / s[~dead, None]
    inverse = scaled.T @ scaled / np.outer(length, length)
    inverse[undetermined] = inverse[:, undetermined] = 0.0
    inverse[undetermined, undetermined] = np.inf
    return inverse


def _fit(y, residual):
    """(n_y,) 100 (1 - |residual| / |y - mean y|) [%]"""
    if len(y) < 2:
        return np.full(y.shape[1], np.nan)
    return 100 * (
        1 - np.linalg.norm(residual, axis=0) / np.linalg.norm(y - np.mean(y, axis=0), axis=0)
    )


def _whiteness(residual) -> float:
    """Share of the autocorrelations at lags 1 .. LAGS within the 95 % bounds of white noise."""
    e = residual - np.mean(residual)
    lags = range(1, min(LAGS, len(e) // 4) + 1)
    r = np.array([e[lag:] @ e[:-lag] for lag in lags]) / (e @ e)
    return float(np.mean(np.abs(r) <= 1.96 / np.sqrt(len(e))))


def _poles(problem: _Problem, theta, covariance) -> tuple[PoleEstimate, ...]:
    """The poles with the quantiles of draws from the normal distribution of the parameters that
    they depend on.
    """
    which = [
        i
        for i, name in enumerate(problem.names)
        if name.startswith(("poles", "frequencies", "dampings"))
    ]
    names, covariance = tuple(problem.names[i] for i in which), covariance[np.ix_(which, which)]
    known = bool(np.all(np.isfinite(covariance)))
    draws = np.zeros((DRAWS, len(which)))
    if known:
        std = np.sqrt(np.diag(covariance))
        size, directions = np.linalg.eigh(covariance / np.outer(std, std))
        draws = (
            np.random.default_rng(0).normal(size=draws.shape)
            @ (directions * np.sqrt(np.maximum(size, 0.0))).T
            * std
        )
    poles = np.asarray(
        _poles_at(theta[which] + np.vstack([np.zeros(len(which)), draws]), names, problem.plant)
    )

    def estimates(part):
        tails = np.quantile(part[1:], (0.5 - CONFIDENCE / 2, 0.5 + CONFIDENCE / 2), axis=0).T
        return [
            Estimate(v, *(tail if known else (-np.inf, np.inf)))
            for v, tail in zip(part[0].tolist(), tails.tolist(), strict=True)
        ]

    return tuple(
        PoleEstimate(*row)
        for row in zip(poles[0].tolist(), estimates(poles.real), estimates(poles.imag), strict=True)
    )


@functools.partial(jax.jit, static_argnames="names")
def _poles_at(values, names, plant):
    """(rows, poles) of the plant with its parameters `names` set to each row of values."""
    return jax.vmap(lambda row: replaced(plant, dict(zip(names, row, strict=True))).all_poles)(
        values
    )


# Checks
# --------------------------------------------------------------------------------------------------


def _checked(record: Record) -> Record:
    """The record as finite (rows, channels) arrays that belong together."""
    u, y = as_columns("identify", "u", record.u), as_columns("identify", "y", record.y)
    if len(y) != len(u) + 1:
        raise ValueError(
            f"identify: u has {len(u)} rows and y {len(y)}; allowed is one more row in y than in u"
        )
    _require("dt", record.dt, 0 < record.dt < np.inf, "(0, inf)")
    return Record(u, y, float(record.dt))


def _need_samples(samples: int, parameters: int) -> None:
    """Raises ValueError for more parameters than a record can tell."""
    if samples < SAMPLES_PER_PARAMETER * parameters:
        raise ValueError(
            f"identify: the record is too short: {samples} samples to fit {parameters} parameters; "
            f"allowed are at least {SAMPLES_PER_PARAMETER * parameters}, {SAMPLES_PER_PARAMETER} a parameter"
        )


def _problem(record: Record, plant: Plant, names: tuple[str, ...], fit_share: float) -> _Problem:
    (N, n_u), (_, n_y) = record.u.shape, record.y.shape
    if (n_u, n_y) != (plant.n_u, plant.n_y):
        raise ValueError(
            f"identify: the record has {n_u} inputs and {n_y} outputs but the plant {type(plant).__name__} has {plant.n_u} and {plant.n_y}"
        )
    samples = round(fit_share * (N + 1))
    _need_samples(samples * n_y, len(names) + n_y)
    y, u = record.y[:samples], record.u[: samples - 1]
    for i in range(n_y):
        if np.ptp(y[:, i]) == 0:
            raise ValueError(
                f"identify: output {i} is constant over the {samples} samples to fit; it says nothing about the plant"
            )
    if not np.any(u):
        raise ValueError(
            f"identify: the input is 0 over the {samples} samples to fit; it excites nothing"
        )
    return _Problem(
        record,
        plant,
        task_of(plant, record.u, record.dt),
        names,
        _Coordinates.of(plant, names),
        samples,
        np.std(y, axis=0),
    )


def _free(plant: Plant, free: Sequence[str] | None) -> tuple[str, ...]:
    """The elements to fit, one name a number: poles becomes poles[0], poles[1], ..."""
    leaves, names = named_leaves(plant), []
    for path in [free] if isinstance(free, str) else leaves if free is None else free:
        if path not in leaves and re.sub(r"(\[\d+\])+$", "", path) not in leaves:
            raise ValueError(
                f"identify: free = {path!r} is not a leaf of {type(plant).__name__}; known: {', '.join(leaves) or 'none'}"
            )
        try:
            shape = np.shape(get_at(plant, path))
        except KeyError as error:
            raise ValueError(f"identify: free = {error.args[0]}") from None
        names += [path + "".join(f"[{i}]" for i in index) for index in np.ndindex(shape)]
    if not names:
        raise ValueError(f"identify: free = {free!r} leaves nothing to fit")
    return tuple(dict.fromkeys(names))


def _require(name, value, allowed, interval):
    if not allowed:
        raise ValueError(f"identify: {name} = {value} is outside its allowed range {interval}")
