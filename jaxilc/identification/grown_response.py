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
from .problem import Projected, free_elements, projected, searched, unit_columns
from .response_estimation import (
    checked_lines,
    counts_of,
    enough_lines,
    longest_delay,
    need_lines,
    of_lines,
    response_and_slopes,
)
from .verdict import CONFIDENCE, WIDE, Estimate, Identified, correlations, inverse_of_normal

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


class Parts(NamedTuple):
    """Which parts a model has.

    The values theta of its poles and delay are the logarithms of the rates of the lags, of the
    frequencies and of the dampings of the modes, and the delay [s].
    """

    lags: int = 0
    modes: int = 0
    integrators: int = 0
    direct: bool = False

    @property
    def order(self) -> int:
        return self.lags + 2 * self.modes + self.integrators

    @property
    def numerators(self) -> int:
        return self.integrators + self.lags + 2 * self.modes + self.direct

    @property
    def numbers(self) -> int:
        """Values that are fitted, the delay among them."""
        return self.numerators + self.lags + 2 * self.modes + 1


def columns(theta: Numbers, parts: Parts, f: Numbers, dt: float | None) -> Numbers:
    """(F, numerators) responses of the parts: integrators, lags, modes (a and b by turns), direct.

    They are those of `ModalModel`, in units of 1 / (2 pi s) for integrators: in s without dt, else
    of `sampled(dt)`.
    """
    s, delay = (2j * np.pi * f)[:, None], float(theta[-1])
    p, w, zeta = np.split(np.exp(theta[:-1]), np.cumsum([parts.lags, parts.modes]))
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


def slopes(theta: Numbers, parts: Parts, f: Numbers, dt: float | None, numerators: Numbers):
    """(F, theta) derivatives of the response by theta, by differences of the part that moves."""
    found = np.empty((len(f), len(theta)), complex)
    lags, modes = parts.lags, parts.modes
    for i in range(len(theta)):
        if i < lags:
            own, at, first, of = Parts(lags=1), [i, -1], parts.integrators + i, 0
        elif i < len(theta) - 1:
            mode = (i - lags) % modes
            own, at = Parts(modes=1), [lags + mode, lags + modes + mode, -1]
            first, of = parts.integrators + lags + 2 * mode, (i - lags) // modes
        else:
            own, at, first, of = parts, list(range(len(theta))), 0, i
        step = STEP if own is not parts else STEP / f[-1]
        ahead, behind = theta[at], theta[at]
        ahead[of] += step
        behind[of] -= step if own is not parts else min(step, theta[-1])
        moved = columns(ahead, own, f, dt) - columns(behind, own, f, dt)
        N = numerators[first : first + own.numerators]
        found[:, i] = moved @ N / (ahead[of] - behind[of])
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
        both = [np.repeat(rates[i], parts.lags + parts.modes) for i in (0, 1)]
        low, high = (
            np.append(np.log([*both[i], *[DAMPED[i]] * parts.modes]), late[i]) for i in (0, 1)
        )
        return low, high

    def projected(self, theta: Numbers, parts: Parts) -> Projected:
        """The best numerators at theta, and what they leave; real parts stand first."""
        A = stacked(self.weights[:, None] * columns(theta, parts, self.f, self.dt))
        return projected(theta, A, stacked(self.weights * self.G))

    def least_squares(
        self, theta: Numbers, parts: Parts, steps: int, tolerance: float
    ) -> tuple[Projected, bool]:
        """The minimum near theta, and whether it is one, see `searched`."""

        def of_residual(at: Projected) -> Numbers:
            by_theta = slopes(at.theta, parts, self.f, self.dt, at.N)
            return -stacked(self.weights[:, None] * by_theta)

        return searched(
            lambda theta: self.projected(theta, parts), of_residual, theta, self.bounds(parts),
            steps=steps, tolerance=tolerance, eased=EASED,
            furthest=np.append(np.ones(len(theta) - 1), np.inf),  # of logarithms, not of the delay
        )  # fmt: skip


def stacked(values: Numbers) -> Numbers:
    """Real parts, then imaginary parts."""
    return np.concatenate([values.real, values.imag])


def jacobian(theta: Numbers, N: Numbers, parts: Parts, f: Numbers, dt: float | None) -> Numbers:
    """(F, numbers) derivatives by what `values_of` answers, the delay last."""
    d_theta = slopes(theta, parts, f, dt, N)
    d_numerators = columns(theta, parts, f, dt) / _units(parts)
    return np.hstack([d_theta[:, :-1] / np.exp(theta[:-1]), d_numerators, d_theta[:, -1:]])


def _units(parts: Parts) -> Numbers:
    """What each numerator is multiplied by, in a ModalModel."""
    return np.append(
        UNIT ** np.arange(1.0, 1 + parts.integrators), np.ones(parts.numerators - parts.integrators)
    )


def values_of(at: Projected, parts: Parts) -> Numbers:
    """Rates, frequencies, dampings, numerators and delay as a ModalModel has them."""
    return np.concatenate([np.exp(at.theta[:-1]), at.N * _units(parts), at.theta[-1:]])


def names_of(parts: Parts) -> tuple[str, ...]:
    """The paths of these values in a ModalModel."""
    n, q = parts.lags, parts.modes
    poles = [f"poles[{i}]" for i in range(n)]
    poles += [f"{name}[{i}]" for name in ("frequencies", "dampings") for i in range(q)]
    single = ["integrator", "double_integrator"][: parts.integrators]
    gains = [f"pole_gains[{i}]" for i in range(n)]
    gains += [f"{name}[{i}]" for i in range(q) for name in ("mode_gains", "mode_rates")]
    return (*poles, *single, *gains, *["direct"] * parts.direct, "delay")


def model_of(values: Numbers, parts: Parts) -> ModalModel:
    """The plant of these values."""
    n, q, i = parts.lags, parts.modes, parts.integrators
    p, w, zeta, single, R, modes, direct, delay = np.split(
        values, np.cumsum([n, q, q, i, n, 2 * q, parts.direct])
    )
    once, twice = (float(single[k]) if k < i else None for k in (0, 1))
    at_once = float(direct[0]) if parts.direct else None
    of_modes = w, zeta, modes[::2], modes[1::2]
    return ModalModel(p, R, *of_modes, once, twice, at_once, delay=float(delay[0]))


def response_of(plant: ModalModel, f: Numbers, dt: float | None) -> Response:
    """Names of the numbers (n) of a plant of one channel, (F,) response, (F, n) its derivatives."""
    n, q = np.size(plant.poles), np.size(plant.frequencies)
    parts = Parts(n, q, plant.order - n - 2 * q, plant.direct is not None)
    names = names_of(parts)
    values = np.array([*(np.squeeze(get_at(plant, name)) for name in names[:-1]), plant.delay])
    rates, N = np.split(values[:-1], [n + 2 * q])
    theta, N = np.append(np.log(rates), plant.delay), N / _units(parts)
    return names, columns(theta, parts, f, dt) @ N, jacobian(theta, N, parts, f, dt)


# The growth
# --------------------------------------------------------------------------------------------------

# Of what is grown; each of them gets one mode after the other.
BEGUN = (Parts(), Parts(lags=1), Parts(integrators=1), Parts(integrators=2), Parts(direct=True))


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
    need_lines(measured, Parts(lags=1).numbers)
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
        self.scaled = bool(np.any(std)) and measured.averages_known
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
        parts, theta = begun, np.zeros(begun.lags + 1)
        noise, P = (0.1, 1.0), self.G
        if parts.numerators:
            theta = self._first(self.problem(self.variances(P, *noise)), parts)
            one = self._refined(theta, parts, noise, P)
            theta, noise, P = one.found.theta, one.noise, self.curve(one)
            if parts.order:
                yield one
        while parts.order + 2 <= highest:
            parts = parts._replace(modes=parts.modes + 1)
            if not enough_lines(self.measured, parts.numbers):
                return
            problem = self.problem(self.variances(P, *noise))
            begin = self._with_one_more(problem, theta, parts)
            one = self._moved(self._refined(begin, parts, noise, P))
            theta, noise, P = one.found.theta, one.noise, self.curve(one)
            yield one

    def curve(self, one: LineModel) -> Numbers:
        """(F,) the response of a model."""
        return columns(one.found.theta, one.parts, self.f, self.dt) @ one.found.N

    def _delays(self) -> Numbers:
        if self.delay is not None:
            return np.array([self.delay])
        return np.linspace(0.0, self.longest, DELAYS)

    def _first(self, problem: Problem, parts: Parts) -> Numbers:
        """The best theta of a grid, for at most one lag."""
        rates = np.log(2 * np.pi * np.geomspace(self.f[0], self.f[-1], 12))
        lags = [[rate] for rate in rates] if parts.lags else [[]]
        places = [np.array([*lag, d]) for lag in lags for d in self._delays()]
        return min((problem.projected(t, parts) for t in places), key=lambda at: at.cost).theta

    def _with_one_more(self, problem: Problem, theta: Numbers, parts: Parts) -> Numbers:
        """theta of these parts, where a mode more than those of theta explains most."""
        before = parts._replace(modes=parts.modes - 1)
        y = stacked(problem.weights * problem.G)
        if before.numerators:
            at = problem.projected(theta, before)
            Q, left, delays = at.Q, at.left, theta[-1:]
        else:
            Q, left, delays = np.zeros((len(y), 0)), y, self._delays()
        low, high = problem.bounds(Parts(modes=1))
        size = np.abs(left[: len(self.f)] + 1j * left[len(self.f) :])
        peaks = self.f[np.argsort(-size)[:10]]
        frequencies = np.append(np.linspace(low[0], high[0], GRID), np.log(2 * np.pi * peaks))
        frequencies = np.clip(frequencies, low[0], high[0])
        w, zeta = (of.ravel() for of in np.meshgrid(frequencies, np.log(DAMPINGS_TRIED)))
        tried = Parts(modes=len(w))
        places: list[tuple[float, Numbers]] = []
        for late in delays:
            A = columns(np.concatenate([w, zeta, [late]]), tried, problem.f, self.dt)
            A = stacked(problem.weights[:, None] * A)
            A = A - Q @ (Q.T @ A)
            A = A / np.maximum(np.linalg.norm(A, axis=0), np.finfo(float).tiny)
            on, shared = left @ A, np.sum(A[:, ::2] * A[:, 1::2], axis=0)
            # squared length of what is left, in the plane of both columns
            apart = np.maximum(1 - shared**2, 1e-9)
            explained = on[::2] ** 2 + (on[1::2] - shared * on[::2]) ** 2 / apart
            best = np.argsort(-explained)[: 20 * PLACES]
            places += [(explained[i], np.array([w[i], zeta[i], late])) for i in best]
        places.sort(key=lambda place: -place[0])
        chosen: list[Numbers] = []
        for _, own in places:
            far = all(abs(own[0] - c[0]) > APART or abs(own[1] - c[1]) > 1 for c in chosen)
            if far and len(chosen) < PLACES:
                chosen.append(own)
        n, q = before.lags, before.modes
        begin = [
            np.concatenate([theta[: n + q], own[:1], theta[n + q : n + 2 * q], own[1:2], own[2:]])
            for own in chosen
        ]
        refined = [problem.least_squares(t, parts, 25, SHORT)[0] for t in begin]
        return min(refined, key=lambda at: at.cost).theta

    def _refined(
        self, theta: Numbers, parts: Parts, noise: tuple[float, float], P: Numbers
    ) -> LineModel:
        """The minimum near theta, with the noise that its residual has."""
        at = self.problem(self.variances(P, *noise)).projected(theta, parts)
        for _ in range(ROUNDS):
            P = columns(at.theta, parts, self.f, self.dt) @ at.N
            noise = self.noise(P)
            problem = self.problem(self.variances(P, *noise))
            at, _ = problem.least_squares(at.theta, parts, 30, SHORT)
        return self._judged(at, parts, *noise)

    def _judged(self, at: Projected, parts: Parts, floor: float, scale: float) -> LineModel:
        P = columns(at.theta, parts, self.f, self.dt) @ at.N
        error, number = np.abs(self.G - P), parts.numbers - (self.delay is not None)
        coherence = self.measured.coherence
        good = np.ones(len(P), bool) if coherence is None else coherence > GOOD
        share = error / np.maximum(self.size, np.finfo(float).tiny)
        share = share[good] if good.any() else share
        bic = self.criterion(P, floor, scale, number)
        within = float(np.mean(share <= 0.1)), float(np.mean(share <= 0.3))
        fit = 100 * (1 - float(np.linalg.norm(error) / np.linalg.norm(self.G)))
        median = float(np.median(share))
        return LineModel(parts, at, floor, scale, bic, np.nan, within, median, fit)

    def _moved(self, one: LineModel) -> LineModel:
        """The model after its least mode was taken out and put in where it explains most."""
        parts, theta = one.parts, one.found.theta
        n, q = parts.lags, parts.modes
        if q < 2:
            return one
        P = self.curve(one)
        problem = self.problem(self.variances(P, *one.noise))
        less = parts._replace(modes=q - 1)
        without = [np.delete(theta, [n + i, n + q + i]) for i in range(q)]
        least = min((problem.projected(t, less) for t in without), key=lambda at: at.cost)
        begin = self._with_one_more(problem, least.theta, parts)
        other = self._refined(begin, parts, one.noise, P)
        return other if other.bic < one.bic else one

    def held_out(self, one: LineModel) -> Numbers:
        """(F,) -2 log likelihood of each line, when it was not fitted."""
        v = self.variances(self.curve(one), *one.noise)
        found = np.empty(len(v))
        for i in range(HELD_OUT):
            out = np.arange(len(v)) % HELD_OUT == i
            problem = self.problem(v, ~out)
            at, _ = problem.least_squares(one.found.theta, one.parts, 8, SHORT)
            P = columns(at.theta, one.parts, self.f, self.dt) @ at.N
            own = self.variances(P, *one.noise)[out]
            found[out] = 2 * (np.log(own) + np.abs(self.G - P)[out] ** 2 / own)
        return found


def share_of_noise(measured: MeasuredResponse, one: LineModel, dt: float | None) -> float:
    """The share of the squared errors of a median line that its standard deviation explains."""
    growing = _Growing(measured, dt, None)
    P = growing.curve(one)
    whole = growing.variances(P, *one.noise)
    return float(np.median(growing.variances(P, 0.0, one.scale) / whole))


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
    parts = one.parts
    problem = growing.problem(growing.variances(growing.curve(one), *one.noise))
    at, converged = problem.least_squares(one.found.theta, parts, 200, LONG)
    values, names = values_of(at, parts), names_of(parts)
    fitted = len(names) - (delay is not None)
    names = names[:fitted]
    J_of = jacobian(at.theta, at.N, parts, growing.f, dt)[:, :fitted]
    J = J_of * problem.weights[:, None]
    P, known = columns(at.theta, parts, growing.f, dt) @ at.N, growing.scaled
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
    fitted = model_of(values, parts), names, values[: len(names)], covariance, width, P
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
    found = {}
    for name, v in zip(names, variance, strict=True):
        half, value = float(np.sqrt(3 * v)), values[name]
        if name.startswith(POSITIVE):
            half = min(half, CLOSEST * value)
        found[name] = Estimate(float(value), float(value - half), float(value + half))
    return found


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
