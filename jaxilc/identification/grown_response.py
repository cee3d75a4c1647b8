"""Models of flexible machines from a measured frequency response: their order is grown.

The error of a line is that of its measurement and that of the model, which is wrong by about a
share `floor` of the response:

    var_k = scale std_k^2 + floor^2 |P_k|^2 sqrt(f_k / mean f)

Both are found by maximum likelihood beside poles and numerators. scale is 1 where the standard
deviation of the lines is known, and fitted where only a coherence is known and not the number of
its averages. Without the floor, a few lines that are measured best would decide everything. What a
model has wrong is alike over a share of the frequency, so over many lines at high ones, which then
count less each; an exponent of 0 or 1 in place of the root had smaller likelihoods.

That of a coherence c over n averages is |P| sqrt((1 - c) / (c n)) with the response of the model:
with that of the measurement, lines that are too small by chance would count too much.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple, TypeAlias

import numpy as np
import scipy

from ..plants import ModalModel, ProcessModel
from ..plants.process_model import samples_of
from ..pytree.aliases import Numbers
from ..pytree.in_short import in_short
from ..pytree.named_paths import get_at
from ..pytree.ranges import require
from ..theory.on_lines import MeasuredResponse
from .problem import Parts, Projected, free_elements, projected, searched, unit_columns
from .response_estimation import (
    checked_lines,
    counts_of,
    enough_lines,
    longest_delay,
    need_lines,
    of_lines,
    response_and_slopes,
)
from .verdict import (
    CONFIDENCE,
    WIDE,
    Estimate,
    Identified,
    correlations,
    estimates,
    inverse_of_normal,
)

HIGHEST = 20  # order that is looked for
ALL_UP_TO = 8  # order from which on only the best of these are grown further
KEPT = 2
PATIENCE = 3  # orders without a smaller criterion, after which growing ends
GRID, DAMPINGS_TRIED = 80, (0.01, 0.05, 0.3, 1.1, 4.0)  # modes that are tried
DELAYS = 60  # that are tried for a first part
PLACES = 3  # of those, so many are refined
APART = 0.15  # of the logarithm of the frequency, between two of them
ROUNDS = 2  # of noise and model in turn
SHORT, LONG = 1e-4, 1e-8  # relative decrease that ends a search which compares, and the last
EASED = 5.0  # what the damping of a search is divided by after a step
FLOORS = (1e-6, 3.0)
HELD_OUT = 5  # every so many lines are held out in turn
COVERED = 0.9  # of the lines, whose spread machines that are drawn independently reach
MOST_SCALED = 2.0  # times the width of an interval, to cover them
POSITIVE, CLOSEST = ("poles", "frequencies", "dampings"), 0.9  # share of a value of its interval
GOOD = 0.9  # coherence, from which on lines are counted in the shares within 10 and 30 %
STEP = 1e-6  # of a logarithm, in central differences
UNIT = 2 * np.pi  # [rad/s] by which integrators are scaled, so that columns have like sizes
DAMPED = (1e-4, 30.0)  # that are looked for; from 1 on, a mode is two real poles
BESIDE = 1e-7  # of damping 1, where the two poles of a mode coincide, in which 1 is not taken
BELOW, ABOVE = 1 / 30, 4.0  # times the first and the last line, rates that are looked for
LINES, LOWEST = 400, 1e-4  # frequencies of a band, and the lowest one as a share of the sample rate
MOST_SPREAD = 5.0  # standard deviation of log |P| that is told at most
SHARE = 0.95  # of half the sample rate, up to which rates are looked for
Response: TypeAlias = tuple[tuple[str, ...], Numbers, Numbers]


# Least squares of sums of parts on lines
# --------------------------------------------------------------------------------------------------


def columns(parts: Parts, f: Numbers, dt: float | None) -> Numbers:
    """(F, numerators) responses of the parts: integrators, lags, modes (a and b by turns), direct.

    They are those of `ModalModel`, in units of 1 / (2 pi s) for integrators: in s without dt, else
    of `sampled(dt)`.
    """
    s, delay = (2j * np.pi * f)[:, None], float(parts.delay)
    p, (w, zeta) = np.exp(parts.lags), np.exp(parts.modes).T
    if dt is None:
        late = np.exp(-s * delay)
        integrators = late * (UNIT / s) ** np.arange(1, 1 + parts.integrators)
        lags, direct = late / (1 + s / p), late
        mode = late / (1 + 2 * zeta * s / w + (s / w) ** 2)
        modes = mode, s / w * mode
    else:
        whole, rest = samples_of(delay, dt, "ModalModel")
        z, now = np.exp(s * dt), dt - rest
        late = z**-whole
        first = (now + rest / z) / (z - 1)
        second = (dt * first + rest * (dt - rest / 2) / z + now**2 / 2) / (z - 1)
        both = np.hstack([late * UNIT * first, late * UNIT**2 * second])
        integrators, direct = both[:, : parts.integrators], late / z
        lags = late * p * _held(-p, z, dt, rest)
        apart = zeta + BESIDE * (np.abs(zeta - 1) < BESIDE)
        root = w * np.sqrt(apart**2 - 1 + 0j)
        one, other = -apart * w + root, -apart * w - root
        of_one, of_other = _held(one, z, dt, rest), _held(other, z, dt, rest)
        scaled = late * w / (one - other)
        modes = scaled * w * (of_one - of_other), scaled * (one * of_one - other * of_other)
    turns = np.stack(modes, axis=2).reshape(len(f), -1)
    return np.hstack([integrators, lags, turns, direct[:, : int(parts.direct)]])


def _held(pole: Numbers, z: Numbers, dt: float, rest: float) -> Numbers:
    """(F, poles) 1 / (s - pole) behind a hold, delayed by a part of a sample."""
    now = dt - rest
    after = np.exp(pole * now) * np.expm1(pole * rest) / pole
    return (np.expm1(pole * now) / pole + after / z) / (z - np.exp(pole * dt))


def slopes(parts: Parts, f: Numbers, dt: float | None, N: Numbers) -> Numbers:
    """(F, theta) derivatives of the response by theta, by differences of the part that moves.

    N: (numerators,), which do not move
    """
    n, q, late = len(parts.lags), len(parts.modes), parts.delay
    moving = [Parts(lags=lag, delay=late) for lag in parts.lags[:, None]]
    moving += 2 * [Parts(mode, delay=late) for mode in parts.modes[:, None]]
    elements = np.repeat([0, 0, 1, n + 2 * q], [n, q, q, 1])
    first = parts.integrators + np.array([*range(n), *2 * [*range(n, n + 2 * q, 2)]], int)
    found = np.empty((len(f), len(elements)), complex)
    for i, (own, of, at) in enumerate(zip([*moving, parts], elements, [*first, 0], strict=True)):
        of_delay = own is parts
        step = STEP / f[-1] if of_delay else STEP
        ahead, behind = theta_of(own), theta_of(own)
        ahead[of] += step
        behind[of] -= min(step, late) if of_delay else step
        moved = columns(parts_at(own, ahead), f, dt) - columns(parts_at(own, behind), f, dt)
        found[:, i] = moved @ N[at : at + own.numerators] / (ahead[of] - behind[of])
    return found


class Problem(NamedTuple):
    """Weighted least squares on lines.

    f, G: (F,) frequencies [Hz] and measured response
    weights: (F,) by which complex residuals are multiplied
    dt: sample time of the hold [s]; None for continuous time
    longest: the longest delay that is allowed [s]
    delay: where it is fixed [s]; None where it is fitted
    """

    f: Numbers
    G: Numbers
    weights: Numbers
    dt: float | None
    longest: float
    delay: float | None

    def bounds(self, parts: Parts) -> tuple[Numbers, Numbers]:
        """The least and largest theta."""
        rates = 2 * np.pi * np.array([BELOW * self.f[0], ABOVE * self.f[-1]])
        if self.dt is not None:
            rates[1] = min(rates[1], SHARE * np.pi / self.dt)
        late = (0.0, self.longest) if self.delay is None else (self.delay, self.delay)
        sizes = [len(parts.lags) + len(parts.modes), len(parts.modes)]
        low, high = (
            np.append(np.repeat(np.log(ends), sizes), d)
            for *ends, d in zip(rates, DAMPED, late, strict=True)
        )
        return low, high

    def projected(self, parts: Parts) -> Projected:
        """The best numerators of these parts, and what they leave; real parts stand first."""
        A = stacked(self.weights[:, None] * columns(parts, self.f, self.dt))
        return projected(theta_of(parts), A, stacked(self.weights * self.G))

    def least_squares(
        self, parts: Parts, steps: int, tolerance: float
    ) -> tuple[Parts, Projected, bool]:
        """The parts of the minimum near these, what is found there, and whether it is one."""

        def of_residual(at: Projected) -> Numbers:
            by_theta = slopes(parts_at(parts, at.theta), self.f, self.dt, at.N)
            return -stacked(self.weights[:, None] * by_theta)

        at, ended = searched(
            lambda theta: self.projected(parts_at(parts, theta)), of_residual, theta_of(parts),
            self.bounds(parts), steps=steps, tolerance=tolerance, eased=EASED,
            furthest=np.append(np.ones(len(parts.x)), np.inf),  # of logarithms, not of the delay
        )  # fmt: skip
        return parts_at(parts, at.theta), at, ended


def numbers(parts: Parts) -> int:
    """How many values are fitted, the delay among them."""
    return len(theta_of(parts)) + parts.numerators


def theta_of(parts: Parts) -> Numbers:
    """Logarithms of the rates of the lags, of the frequencies and of the dampings; the delay."""
    return np.concatenate([parts.lags, *parts.modes.T, [parts.delay]])


def parts_at(parts: Parts, theta: Numbers) -> Parts:
    """The parts with another theta."""
    lags, modes, late = np.split(theta, [len(parts.lags), len(theta) - 1])
    return parts._replace(lags=lags, modes=modes.reshape(2, -1).T, delay=late[0])


def stacked(values: Numbers) -> Numbers:
    """Real parts, then imaginary parts."""
    return np.concatenate([values.real, values.imag])


def jacobian(parts: Parts, N: Numbers, f: Numbers, dt: float | None) -> Numbers:
    """(F, numbers) derivatives by what `values_of` answers, the delay last."""
    by_theta, rates = slopes(parts, f, dt, N), np.exp(theta_of(parts)[:-1])
    by_numerators = columns(parts, f, dt) / _units(parts)
    return np.hstack([by_theta[:, :-1] / rates, by_numerators, by_theta[:, -1:]])


def _units(parts: Parts) -> Numbers:
    """What each numerator is multiplied by, in a ModalModel."""
    units = np.ones(parts.numerators)
    units[: parts.integrators] = UNIT ** np.arange(1.0, 1 + parts.integrators)
    return units


def values_of(parts: Parts, N: Numbers) -> Numbers:
    """Rates, frequencies, dampings, numerators and delay as a ModalModel has them."""
    theta = theta_of(parts)
    return np.concatenate([np.exp(theta[:-1]), N * _units(parts), theta[-1:]])


def names_of(parts: Parts) -> tuple[str, ...]:
    """The paths of these values in a ModalModel."""
    n, q = len(parts.lags), len(parts.modes)
    poles = [f"poles[{i}]" for i in range(n)]
    poles += [f"{name}[{i}]" for name in ("frequencies", "dampings") for i in range(q)]
    single = ["integrator", "double_integrator"][: parts.integrators]
    gains = [f"pole_gains[{i}]" for i in range(n)]
    gains += [f"{name}[{i}]" for i in range(q) for name in ("mode_gains", "mode_rates")]
    return (*poles, *single, *gains, *["direct"] * parts.direct, "delay")


def model_of(parts: Parts, N: Numbers) -> ModalModel:
    """The plant of these parts and numerators."""
    i, n, q = parts.integrators, len(parts.lags), len(parts.modes)
    single, R, modes, direct = np.split(N * _units(parts), np.cumsum([i, n, 2 * q]))
    once, twice = (*map(float, single), None, None)[:2]
    at_once = float(direct[0]) if parts.direct else None
    p, (w, zeta), delay = np.exp(parts.lags), np.exp(parts.modes).T, float(parts.delay)
    return ModalModel(p, R, w, zeta, modes[::2], modes[1::2], once, twice, at_once, delay=delay)


def response_of(plant: ModalModel, f: Numbers, dt: float | None) -> Response:
    """Names of the numbers (n) of a plant of one channel, (F,) response, (F, n) its derivatives."""
    modes = np.log(np.column_stack([plant.frequencies, plant.dampings]))
    integrators = plant.order - np.size(plant.poles) - 2 * len(modes)
    direct = plant.direct is not None
    parts = Parts(modes, np.log(plant.poles), integrators, direct, plant.delay)
    names = names_of(parts)
    values = np.array([np.squeeze(get_at(plant, name)) for name in names[len(parts.x) : -1]])
    N = values / _units(parts)
    return names, columns(parts, f, dt) @ N, jacobian(parts, N, f, dt)


# The growth
# --------------------------------------------------------------------------------------------------

# Of what is grown; each of them gets one mode after the other.
ONE_LAG, ONE_MODE = Parts(lags=np.zeros(1)), Parts(np.zeros((1, 2)))
BEGUN = (Parts(), ONE_LAG, Parts(integrators=1), Parts(integrators=2), Parts(direct=True))


class LineModel(NamedTuple):
    """A model of one order.

    found: poles, numerators and residual
    floor: error of the model, relative to the response
    scale: by which the given variances of the lines were multiplied
    bic: Bayesian information criterion, from the likelihood
    held_out: mean over the lines of -2 log likelihood, each when it was not fitted
    within: shares of the lines whose error is at most 10 and 30 % of the response; those of a
        coherence above 0.9 where it is known
    median: of the relative error of these lines
    fit: 100 (1 - |G - P| / |G|) [%] over all lines, not weighted
    share_of_noise: of the squared errors of a median line, that its standard deviation explains
    """

    parts: Parts
    found: Projected
    floor: float
    scale: float
    bic: float
    held_out: float
    within: tuple[float, float]
    median: float
    fit: float
    share_of_noise: float
    __repr__ = in_short

    @property
    def noise(self) -> tuple[float, float]:
        return self.floor, self.scale


def grow_response(
    measured: MeasuredResponse,
    *,
    dt: float | None = None,
    delay: float | None = None,
    highest: int = HIGHEST,
    each: Callable[[int], object] = lambda order: None,
) -> tuple[list[LineModel], LineModel]:
    """The best model of each order, and the one that is chosen.

    From nothing, one lag, one or two integrators, and a direct term, one mode after the other is
    added: where it explains most of the residual, refined together with all others. The smallest
    order is chosen whose likelihood on lines that were held out is not worse than that of the order
    of the smallest criterion, by more than a standard error of the difference.

    measured: the lines;  dt, delay: as for `identify_response`
    highest: largest order that is tried; each: called with every order before it is tried
    Raises ValueError as `identify_response` does.
    """
    require("grow_response", "highest", highest, "[1, 60]", whole=True)
    checked_lines(measured, dt, delay)
    need_lines(measured, numbers(ONE_LAG))
    growing = _Growing(measured, dt, delay)
    best: dict[int, LineModel] = {}
    paths = [growing.path(begun, highest) for begun in BEGUN]
    for order in range(2, highest + 2, 2):
        each(order)
        reached = [(one, path) for path in paths if (one := next(path, None))]
        for one, _ in reached:
            of_order = one.parts.order
            best[of_order] = min(best.get(of_order, one), one, key=lambda one: one.bic)
        reached.sort(key=lambda pair: pair[0].bic)
        paths = [path for _, path in reached[: KEPT if order >= ALL_UP_TO else None]]
        least = min(best, key=lambda n: best[n].bic)
        if not paths or order - least > 2 * PATIENCE:
            break
    orders = [best[n] for n in sorted(best)]
    scored = [growing.held_out(one) for one in orders]
    orders = [
        one._replace(held_out=float(np.mean(s))) for one, s in zip(orders, scored, strict=True)
    ]
    least = int(np.argmin([one.bic for one in orders]))
    for i in range(least + 1):
        worse = scored[i] - scored[least]
        if np.mean(worse) <= np.std(worse) / np.sqrt(len(worse)):
            return orders, orders[i]
    return orders, orders[least]


class _Growing:
    """The lines, and what is tried on them."""

    def __init__(self, measured: MeasuredResponse, dt: float | None, delay: float | None) -> None:
        f, G, std = (np.asarray(of) for of in measured[:3])
        self.measured, self.f, self.G, self.std = measured, f, G, std
        self.dt, self.delay, self.longest = dt, delay, longest_delay(f, dt)
        self.relative = measured.coherence is not None
        self.scaled = measured.std_known
        self.size = np.abs(G)
        self.alike = np.sqrt(f / np.exp(np.mean(np.log(f))))

    def variances(self, P: Numbers, floor: float, scale: float) -> Numbers:
        """(F,) expected squared errors of the lines around a model P."""
        size = np.maximum(np.abs(P), 1e-9 * np.max(np.abs(P)))
        own = self.std
        if self.relative:
            own = own * size / np.maximum(self.size, np.finfo(float).tiny)
        return scale * own**2 + (floor * size) ** 2 * self.alike

    def criterion(self, P: Numbers, floor: float, scale: float, numbers: int) -> float:
        """-2 log likelihood of complex normal errors, and a penalty for each number."""
        v = self.variances(P, floor, scale)
        minus_log = 2 * float(np.sum(np.log(np.pi * v) + np.abs(self.G - P) ** 2 / v))
        return minus_log + numbers * float(np.log(2 * len(v)))

    def problem(self, variances: Numbers, among: Numbers | slice = slice(None)) -> Problem:
        weights = np.sqrt(2 / variances[among])
        f, G = self.f[among], self.G[among]
        return Problem(f, G, weights, self.dt, self.longest, self.delay)

    def noise(self, P: Numbers) -> tuple[float, float]:
        """floor and scale of the largest likelihood, for the residual of a model."""
        e = np.abs(self.G - P) ** 2
        unknown = not self.scaled and bool(np.any(self.std))

        def minus_log(x: Numbers) -> float:
            v = self.variances(P, math.exp(x[0]), math.exp(2 * x[1]) if unknown else 1.0)
            return float(np.sum(np.log(v) + e / v))

        low, high = np.log(FLOORS)
        starts = [[np.log(k), s] for k in (1e-3, 0.1) for s in ((0.0, -2.0) if unknown else (0.0,))]
        bounds = [(low, high), (-8.0, 3.0) if unknown else (0.0, 0.0)]
        found = min(
            (scipy.optimize.minimize(minus_log, x, bounds=bounds) for x in starts),
            key=lambda one: one.fun,
        )
        return math.exp(found.x[0]), math.exp(2 * found.x[1]) if unknown else 1.0

    def path(self, begun: Parts, highest: int) -> Iterator[LineModel]:
        """Models of one mode more each, from what is begun."""
        parts, noise, P = begun, (0.1, 1.0), self.G
        if parts.numerators:
            begin = self._first(self.problem(self.variances(P, *noise)), parts)
            one = self._refined(begin, noise, P)
            parts, noise, P = one.parts, one.noise, self.curve(one.parts, one.found)
            if parts.order:
                yield one
        while parts.order + 2 <= highest and enough_lines(self.measured, numbers(parts) + 4):
            begin = self._with_one_more(self.problem(self.variances(P, *noise)), parts)
            one = self._moved(self._refined(begin, noise, P))
            parts, noise, P = one.parts, one.noise, self.curve(one.parts, one.found)
            yield one

    def curve(self, parts: Parts, found: Projected) -> Numbers:
        """(F,) the response of a model."""
        return columns(parts, self.f, self.dt) @ found.N

    def _delays(self) -> Numbers:
        if self.delay is not None:
            return np.array([self.delay])
        return np.linspace(0.0, self.longest, DELAYS)

    def _first(self, problem: Problem, parts: Parts) -> Parts:
        """The best ones of a grid, for at most one lag."""
        rates = np.log(2 * np.pi * np.geomspace(self.f[0], self.f[-1], 12))
        lags = rates[:, None] if len(parts.lags) else np.zeros((1, 0))
        places = [parts._replace(lags=of, delay=d) for of in lags for d in self._delays()]
        return min(places, key=lambda place: problem.projected(place).cost)

    def _with_one_more(self, problem: Problem, parts: Parts) -> Parts:
        """These parts and one mode more, where it explains most."""
        at = problem.projected(parts)
        delays = [parts.delay] if parts.numerators else self._delays()
        low, high = problem.bounds(ONE_MODE)
        size = np.abs(at.left[: len(self.f)] + 1j * at.left[len(self.f) :])
        peaks = self.f[np.argsort(-size)[:10]]
        frequencies = np.append(np.linspace(low[0], high[0], GRID), np.log(2 * np.pi * peaks))
        frequencies = np.clip(frequencies, low[0], high[0])
        tried = np.reshape(np.meshgrid(frequencies, np.log(DAMPINGS_TRIED)), (2, -1)).T
        places: list[tuple[float, Parts]] = []
        for late in delays:
            A = columns(Parts(tried, delay=late), problem.f, self.dt)
            A = stacked(problem.weights[:, None] * A)
            A = A - at.Q @ (at.Q.T @ A)
            A = A / np.maximum(np.linalg.norm(A, axis=0), np.finfo(float).tiny)
            on, shared = at.left @ A, np.sum(A[:, ::2] * A[:, 1::2], axis=0)
            # squared length of what is left, in the plane of both columns
            apart = np.maximum(1 - shared**2, 1e-9)
            explained = on[::2] ** 2 + (on[1::2] - shared * on[::2]) ** 2 / apart
            best = np.argsort(-explained)[: 20 * PLACES]
            places += [(explained[i], Parts(tried[[i]], delay=late)) for i in best]
        places.sort(key=lambda place: -place[0])
        chosen: list[Parts] = []
        for _, own in places:
            apart = [np.abs(own.modes[0] - one.modes[0]) for one in chosen]
            if all(w > APART or zeta > 1 for w, zeta in apart) and len(chosen) < PLACES:
                chosen.append(own)
        begin = [parts.joined(own)._replace(delay=own.delay) for own in chosen]
        refined = [problem.least_squares(one, 25, SHORT) for one in begin]
        return min(refined, key=lambda found: found[1].cost)[0]

    def _refined(self, parts: Parts, noise: tuple[float, float], P: Numbers) -> LineModel:
        """The minimum near these parts, with the noise that its residual has."""
        at = self.problem(self.variances(P, *noise)).projected(parts)
        for _ in range(ROUNDS):
            P = self.curve(parts, at)
            noise = self.noise(P)
            problem = self.problem(self.variances(P, *noise))
            parts, at, _ = problem.least_squares(parts, 30, SHORT)
        return self._judged(at, parts, *noise)

    def _judged(self, at: Projected, parts: Parts, floor: float, scale: float) -> LineModel:
        P = self.curve(parts, at)
        error, number = np.abs(self.G - P), numbers(parts) - (self.delay is not None)
        coherence = self.measured.coherence
        good = np.ones(len(P), bool) if coherence is None else coherence > GOOD
        share = error / np.maximum(self.size, np.finfo(float).tiny)
        share = share[good] if good.any() else share
        bic = self.criterion(P, floor, scale, number)
        within = float(np.mean(share <= 0.1)), float(np.mean(share <= 0.3))
        fit = 100 * (1 - float(np.linalg.norm(error) / np.linalg.norm(self.G)))
        of_noise = self.variances(P, 0.0, scale) / self.variances(P, floor, scale)
        median, of_noise = (float(np.median(of)) for of in (share, of_noise))
        return LineModel(parts, at, floor, scale, bic, np.nan, within, median, fit, of_noise)

    def _moved(self, one: LineModel) -> LineModel:
        """The model after its least mode was taken out and put in where it explains most."""
        if len(one.parts.modes) < 2:
            return one
        P = self.curve(one.parts, one.found)
        problem = self.problem(self.variances(P, *one.noise))
        without = map(one.parts.without_mode, range(len(one.parts.modes)))
        least = min(without, key=lambda parts: problem.projected(parts).cost)
        other = self._refined(self._with_one_more(problem, least), one.noise, P)
        return other if other.bic < one.bic else one

    def held_out(self, one: LineModel) -> Numbers:
        """(F,) -2 log likelihood of each line, when it was not fitted."""
        v = self.variances(self.curve(one.parts, one.found), *one.noise)
        found = np.empty(len(v))
        for i in range(HELD_OUT):
            out = np.arange(len(v)) % HELD_OUT == i
            problem = self.problem(v, ~out)
            parts, at, _ = problem.least_squares(one.parts, 8, SHORT)
            P = self.curve(parts, at)
            own = self.variances(P, *one.noise)[out]
            found[out] = 2 * (np.log(own) + np.abs(self.G - P)[out] ** 2 / own)
        return found


def criterion(measured: MeasuredResponse, one: LineModel, P: Numbers, numbers: int) -> float:
    """The information criterion of another response P (F,), with the noise of a grown model.

    numbers: values that were fitted
    """
    return _Growing(measured, None, None).criterion(P, *one.noise, numbers)


def identified_response(
    measured: MeasuredResponse, one: LineModel, dt: float | None, delay: float | None
) -> Identified:
    """The plant of a grown model, refined to its tolerances, with its reliability.

    The covariance is that of the lines' variances, widened by what the residuals of neighbouring
    lines have in common: their number counts no more than it says.
    """
    growing = _Growing(measured, dt, delay)
    problem = growing.problem(growing.variances(growing.curve(one.parts, one.found), *one.noise))
    parts, at, converged = problem.least_squares(one.parts, 200, LONG)
    values, names = values_of(parts, at.N), names_of(parts)
    fitted = len(names) - (delay is not None)
    names = names[:fitted]
    J_of = jacobian(parts, at.N, growing.f, dt)[:, :fitted]
    J = J_of * problem.weights[:, None]
    P, known = growing.curve(parts, at), growing.scaled
    residual = at.left
    error = residual[: len(growing.f)] + 1j * residual[len(growing.f) :]
    freedom = max(2 * len(error) - fitted, 1)
    ratio = float(np.sqrt(residual @ residual / freedom))
    covariance = inverse_of_normal(stacked(J))
    covariance = covariance * max(ratio, 1.0) ** 2 * _in_common(error)
    determined = np.where(np.isfinite(covariance), covariance, 0.0)
    spread = np.sum((J_of @ determined) * J_of.conj(), axis=1).real
    spread = spread + growing.variances(P, one.floor, 0.0)
    apart = _apart(J_of, covariance, spread, dict(zip(names, values, strict=False)))
    width = scipy.special.stdtrit(freedom, 0.5 + CONFIDENCE / 2)
    of_error = growing.variances(P, 0.0, 1.0) if known else np.abs(P) ** 2
    told = np.abs(growing.G - P) / np.sqrt(np.maximum(of_error, np.min(of_error[of_error > 0])))
    told *= np.sqrt(2) if known else 1.0  # each line has two numbers
    std = float(np.sqrt(np.sum(told**2) / (freedom if known else len(error))))
    fitted = model_of(parts, at.N), names, values[: len(names)], covariance, width, P
    weighted = problem.weights * growing.G
    return of_lines(*fitted, error, weighted, std, known=known, converged=converged, apart=apart)


def _apart(
    J: Numbers, covariance: Numbers, spread: Numbers, values: dict[str, float]
) -> dict[str, Estimate]:
    """Intervals v_i +- h_i of values that are drawn as if they were independent.

    Uniform draws of them spread the response of line k by sum_i |J_ki|^2 h_i^2 / 3. This is fitted
    to `spread` by non-negative least squares, above the variance that each value has where all
    others are known, and widened, at most MOST_SCALED times, to reach it on COVERED of the lines.
    Joint intervals that are drawn independently would spread it some hundred times as far: values
    that make up for each other, such as a slow mode and an integrator, are known together much
    better than alone. So a value may well lie outside of its interval here.

    J: (F, n) derivatives of the response;  spread: (F,) E |true - model|^2 of each line
    """
    names = [name for name in values if name != "delay"]
    n = len(names)
    finite = np.isfinite(np.diag(covariance))
    least = np.zeros(len(values))
    std = np.sqrt(np.diag(covariance)[finite])
    alike = covariance[np.ix_(finite, finite)] / np.outer(std, std)
    least[finite] = std**2 / np.maximum(np.diag(np.linalg.pinv(alike, hermitian=True)), 1.0)
    A = np.abs(J[:, :n]) ** 2 / spread[:, None]
    scaled, size = unit_columns(A)
    missing = np.maximum(1 - A @ least[:n], 0.0)
    variance = least[:n] + scipy.optimize.nnls(scaled, missing)[0] / size
    reached = A @ variance
    variance = variance * float(np.clip(np.quantile(1 / reached, COVERED), 1.0, MOST_SCALED**2))
    half, found = np.sqrt(3 * variance), np.array([values[name] for name in names])
    positive = [name.startswith(POSITIVE) for name in names]
    return estimates(names, found, np.where(positive, np.minimum(half, CLOSEST * found), half))


def _in_common(error: Numbers) -> float:
    """The factor 1 + 2 sum of the correlations between lines, at least 1 (Bartlett 1946)."""
    r = correlations(error).real.tolist()
    first = next((i for i, value in enumerate(r) if value < 2 / np.sqrt(len(error))), len(r))
    return 1 + 2 * sum(r[:first])


# The band of a response
# --------------------------------------------------------------------------------------------------


class ResponseBand(NamedTuple):
    """A frequency response with its 95 % band.

    f:      (F,) frequencies [Hz]
    P:      (F,) complex response
    phase:  (F,) its phase without jumps [deg]
    factor: (F,) the band is from |P| / factor to |P| factor; None where a parameter is not
        determined by the record
    half:   (F,) half of the band of the phase [deg]; None likewise
    """

    f: np.ndarray
    P: np.ndarray
    phase: np.ndarray
    factor: np.ndarray | None
    half: np.ndarray | None


def response_band(identified: Identified, dt: float) -> ResponseBand:
    """The response of the plant up to half of the sample rate, with its 95 % band.

    With the covariance S of the parameters and the derivatives g of log P by them, the standard
    deviations of log |P| and of the phase are those of Re(g)^T S Re(g) and Im(g)^T S Im(g).

    dt: sample time of the record [s]
    Raises ValueError for a plant that is not a `ProcessModel` or a `ModalModel` of one input and
    one output.
    """
    plant = identified.plant
    if not isinstance(plant, ProcessModel | ModalModel) or plant.n_u != 1 or plant.n_y != 1:
        raise ValueError(
            f"response_band: the plant is a {type(plant).__name__}; allowed is a ProcessModel or a "
            "ModalModel of one input and one output"
        )
    f = np.geomspace(LOWEST / dt, 0.5 / dt, LINES)
    if isinstance(plant, ModalModel):
        names, P, slopes = response_of(plant, f, dt)
    else:
        names, P, slopes = _of_process(plant, f, dt)
    bare = (name.replace("[0][0]", "") for name in identified.parameters)  # (1, 1) is one number
    which, columns = np.transpose([(k, names.index(n)) for k, n in enumerate(bare) if n in names])
    g, S = (slopes / P[:, None])[:, columns], identified.covariance[np.ix_(which, which)]
    phase = np.unwrap(np.angle(P)) * 180 / np.pi
    if not np.all(np.isfinite(S)):
        return ResponseBand(f, P, phase, None, None)
    variances = [np.einsum("fi,ij,fj->f", part, S, part) for part in (g.real, g.imag)]
    of_log, of_phase = np.sqrt(np.maximum(variances, 0))
    factor = np.exp(WIDE * np.minimum(of_log, MOST_SPREAD))
    return ResponseBand(f, P, phase, factor, WIDE * np.minimum(of_phase, np.pi) * 180 / np.pi)


def _of_process(plant: ProcessModel, f: Numbers, dt: float) -> Response:
    """What `response_of` answers, of a ProcessModel."""
    names = (*free_elements(plant, None), "delay")
    values = np.array([*(float(get_at(plant, name)) for name in names[:-1]), plant.delay])
    return names, *response_and_slopes(values, counts_of(plant), f, dt)
