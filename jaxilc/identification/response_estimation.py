"""Identification fits a ProcessModel to a measured frequency response."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple, cast

import jax
import numpy as np
import scipy

from ..plants import Plant, ProcessModel
from ..plants.process_model import LONGEST_DELAY, cascade, samples_of
from ..pytree.named_paths import get_at, replaced
from ..pytree.ranges import SEEDS, require
from ..theory.on_lines import MeasuredResponse
from .estimation import (
    REFINED,
    STRUCTURES,
    Order,
    Structure,
    best_refined,
    drawn_plants,
    fitted_to_each,
    information,
    with_as_many,
    with_numerator,
)
from .problem import LARGEST, SAMPLES_PER_PARAMETER, Coordinates, Minimum, free_elements, minimum
from .verdict import (
    CONFIDENCE,
    WHITE,
    Estimate,
    Identified,
    correlations,
    estimates,
    inverse_of_normal,
    poles_of,
)

ROUNDS, SETTLED = 50, 1e-5  # of model and scatter in turn; relative change that ends them
IN_DISC = 1.7308  # sqrt(-ln 0.05): |r| <= this / sqrt(F) in 95 % of cases, r complex and normal


def identify_response(
    measured: MeasuredResponse,
    *,
    poles: int = 1,
    pairs: int = 1,
    zeros: int = 1,
    dt: float | None = None,
    delay: float | None = None,
    starts: int = 256,
    seed: int = 0,
) -> Identified:
    """Fit a ProcessModel to a measured frequency response by weighted least squares.

        minimise over theta:  sum_k |G_k - P(f_k; theta)|^2 / std_k^2
        covariance = (J^T J)^-1

    With complex normal errors of these standard deviations, independent from line to line, that is
    maximum likelihood, and the covariance is that of the Fisher information (Pintelon, Schoukens
    2012, section 9.11). J holds the exact derivatives of the parts of P, times sqrt(2) / std. Where
    no standard deviation is known, the relative error is minimised (std_k = |G_k| times a factor
    that follows from the residual). A line without one among others has the smallest of the others.

    Of a std that n averages tell, a line that scatters little by chance would count too much. Their
    maximum likelihood is that of the scatter about the model, found in turn with it:

        minimise over theta:  sum_k n log(1 + |G_k - P_k|^2 / ((n - 1) std_k^2))
        std_k^2 becomes       std_k^2 + |G_k - P_k|^2 / (n - 1)
        covariance = n / (n - 1) (J^T J)^-1

    poles, pairs, zeros, starts, seed: as for `identify`
    dt: sample time [s]; P(z) then leads from the samples of u, held over each sample, to those of
        y, as a controller measures them, and is the response of `plant.sampled(dt)`. None: G(s)
        from u to y in continuous time, as an analyser measures between two voltages; a hold in
        the path would be fitted as poles and delay
    delay: dead time [s]; None where it is fitted, between 0 and 25 periods of the fastest line

    In the result `simulated` is the complex response of the fit, and a row of `parameters` is
    `delay` [s] where it was fitted.
    Raises ValueError for a value outside its range, lines at or above half the sampling rate, a
    response that is zero, and too few lines for the parameters.
    """
    require("identify_response", "seed", seed, SEEDS, whole=True)
    require("identify_response", "starts", starts, "[1, inf)", whole=True)
    plant = with_as_many("identify_response", poles, pairs, zeros)
    checked_lines(measured, dt, delay)
    need_lines(measured, 1 + zeros + plant.order + (delay is None))
    problem = response_problem(measured, plant, dt, delay)
    return _judged(*_with_scatter(problem, best_of_many_starts(problem, starts, seed)))


def compare_response_orders(
    measured: MeasuredResponse,
    *,
    structures: Sequence[Structure] = STRUCTURES,
    dt: float | None = None,
    delay: float | None = None,
    starts: int = 64,
    seed: int = 0,
    each: Callable[[Structure], object] = lambda structure: None,
) -> list[Order]:
    """Fits of several structures to a measured response, as `compare_orders` has them for a record.

        BIC = chi^2 + p ln(2 F),    chi^2 = sum_k 2 |G_k - P_k|^2 / std_k^2

    for F lines of known standard deviation, or twice the sum of `identify_response` where averages
    tell it, else the criterion of `information`. The delay of each structure is fitted, or that
    given [s]. Structures of too many parameters are left out, except the first one. `rms` is the
    root mean square of |G - P| / std.
    """
    found = []
    given = {"dt": dt, "delay": delay, "starts": starts, "seed": seed}
    fit_of_each = functools.partial(identify_response, measured, **given)
    enough = functools.partial(enough_lines, measured)
    for structure, fit in fitted_to_each(structures, enough, fit_of_each, each):
        problem = response_problem(measured, cast(ProcessModel, fit.plant), dt, delay)
        error = problem.weights * (measured.response - fit.simulated[:, 0])
        parts, number = np.concatenate([error.real, error.imag]), len(fit.parameters)
        bic = float(_chi_squared(error, measured.averages) + number * np.log(len(parts)))
        if not measured.std_known:
            bic = information(parts, number, 1e-9)
        rms = float(np.sqrt(np.mean(parts**2)))
        found.append(Order(*structure, number, rms, bic, np.nan, fit))
    return found


def _chi_squared(error: np.ndarray, averages: float) -> float:
    """-2 log likelihood of complex errors (F,) that are divided by std / sqrt(2)."""
    size = np.abs(error) ** 2
    if np.isfinite(averages):
        size = 2 * averages * np.log1p(size / (2 * averages - 2))
    return float(np.sum(size))


def _with_scatter(problem: ResponseProblem, found: Minimum) -> tuple[ResponseProblem, Minimum]:
    """The minimum with the scatter about the model, where averages tell it, and its problem."""
    given, of = 2 / problem.weights**2, problem.measured.averages - 1
    for _ in range(ROUNDS if np.isfinite(of) and np.any(problem.measured.std) else 0):
        error = np.abs(problem.measured.response - problem.response(found.theta)) ** 2
        problem = problem._replace(weights=np.sqrt(2 / (given + error / of)))
        before, found = found, minimum(problem, found.theta)
        if np.allclose(found.theta, before.theta, rtol=SETTLED, atol=0.0):
            break
    return problem, found


def checked_lines(measured: MeasuredResponse, dt: float | None, delay: float | None) -> None:
    """Raises ValueError for lines that cannot be fitted with this sample time and delay."""
    f, G, std = (np.asarray(x) for x in measured[:3])
    if not (f.ndim == 1 and f.shape == G.shape == std.shape and len(f) >= 2):
        raise ValueError(
            f"identify_response: frequencies {f.shape}, response {G.shape} and std {std.shape} do "
            "not fit; allowed is (F,) of each, with 2 lines or more"
        )
    if not (np.all(np.isfinite(f)) and np.all(np.isfinite(G)) and np.all(np.isfinite(std))):
        raise ValueError("identify_response: the measured response has values that are not finite")
    if f[0] <= 0 or np.any(np.diff(f) <= 0) or np.any(std < 0):
        raise ValueError(
            "identify_response: allowed are frequencies above 0 that increase, and std from 0 on; "
            "sort the lines, and keep one of each frequency"
        )
    c = measured.coherence
    if c is not None and not (np.shape(c) == f.shape and np.all((c > 0) & (c <= 1))):
        raise ValueError(
            "identify_response: allowed is a coherence in (0, 1] for each line; leave other lines "
            "out"
        )
    if not np.any(G):
        raise ValueError("identify_response: the response is 0 at all lines")
    if not 1 / LARGEST <= np.max(np.abs(G)) <= LARGEST:
        raise ValueError(
            f"identify_response: the largest |response| is {np.max(np.abs(G)):.3g}; allowed is "
            f"[{1 / LARGEST:g}, {LARGEST:g}]"
        )
    if dt is not None:
        require("identify_response", "dt", dt, "(0, inf)")
        if f[-1] >= 0.5 / dt:
            raise ValueError(
                f"identify_response: the line at {f[-1]:g} Hz is not below {0.5 / dt:g} Hz, half "
                f"the rate of dt = {dt:g} s; leave such lines out, or give another dt"
            )
    if delay is not None:
        allowed = "[0, inf)" if dt is None else f"[0, {LONGEST_DELAY * dt:g}]"
        require("identify_response", "delay", delay, allowed)


def enough_lines(measured: MeasuredResponse, parameters: int) -> bool:
    """Whether there are enough lines, of two numbers each, for so many parameters."""
    return 2 * len(measured.frequencies) >= SAMPLES_PER_PARAMETER * parameters


def need_lines(measured: MeasuredResponse, parameters: int) -> None:
    """Raises ValueError where there are too few lines for so many parameters."""
    if not enough_lines(measured, parameters):
        raise ValueError(
            f"identify_response: {len(measured.frequencies)} lines are too few to fit {parameters} "
            f"parameters; allowed are at least {-(-SAMPLES_PER_PARAMETER * parameters // 2)}"
        )


def _judged(problem: ResponseProblem, found: Minimum) -> Identified:
    """The result at the minimum, with its intervals, poles and tests of the residual."""
    theta, measured = found.theta, problem.measured
    known = measured.std_known
    residual = problem.residual(theta)[:, 0]
    freedom = max(len(residual) - len(theta), 1)
    n = measured.averages
    told = n / (n - 1) if np.isfinite(n) else 1.0
    ratio = float(np.sqrt(told * (residual @ residual) / freedom))
    covariance = inverse_of_normal(problem.sensitivity(theta)[:, 0]) * (told if known else ratio**2)
    tail = 0.5 + CONFIDENCE / 2
    width = scipy.special.ndtri(tail) if known else scipy.special.stdtrit(freedom, tail)
    weighted = problem.weights * measured.response
    error = residual[: len(weighted)] + 1j * residual[len(weighted) :]
    P = problem.response(theta)
    fitted = problem.plant_at(theta), problem.names, theta, covariance, width, P
    return of_lines(*fitted, error, weighted, ratio, known=known, converged=found.converged)


def of_lines(
    plant: Plant,
    names: Sequence[str],
    theta: np.ndarray,
    covariance: np.ndarray,
    width: float,
    P: np.ndarray,
    error: np.ndarray,
    weighted: np.ndarray,
    std: float,
    *,
    known: bool,
    converged: bool,
    apart: dict[str, Estimate] | None = None,
) -> Identified:
    """The result of a fit to the lines of a response.

    names, theta: (P,) what was fitted;  width: of an interval, in standard deviations
    P: (F,) response of the plant;  error, weighted: (F,) weighted residual and measured response
    std: `residual_std`;  known, apart: `std_known` and `apart` of the result
    """
    whiteness = whiteness_of_lines(error)
    return Identified(
        plant=plant,
        parameters=estimates(names, theta, width * np.sqrt(np.diag(covariance))),
        covariance=covariance,
        poles=poles_of(plant, names, theta, covariance),
        samples=len(error),
        simulated=P[:, None],
        fit=np.array([100 * (1 - np.linalg.norm(error) / np.linalg.norm(weighted))]),
        validation_fit=np.array([np.nan]),
        residual_std=np.array([std]),
        whiteness=np.array([whiteness]),
        white=whiteness >= WHITE,
        converged=converged,
        of_response=True,
        std_known=known,
        apart=apart,
    )


def whiteness_of_lines(error) -> float:
    """Share of the residual's correlations between lines 1 .. 20 apart within their 95 % bound.

    Over F lines of independent complex normal errors, such a correlation is complex and normal of
    variance 1 / F, so that it lies within a disc of radius 1.73 / sqrt(F) in 95 % of cases.
    """
    r = correlations(error)
    return float(np.mean(np.abs(r) <= IN_DISC / np.sqrt(len(error)))) if len(r) else 1.0


# The least-squares problem
# --------------------------------------------------------------------------------------------------

SEARCHED = 400  # lines at most in the search from many starts
PERIODS = 25  # of the fastest line, the longest delay that is looked for
STEPS = 8  # delays a period of the fastest line, for the starts


class ResponseProblem(NamedTuple):
    """The least-squares problem of a response: theta (P,) holds the values of `names`.

    plant: a ProcessModel of the structure that is fitted
    names: elements of the plant that are fitted, and `delay` last where it is
    weights: (F,) numbers by which the complex residuals are multiplied; sqrt(2) / std makes their
        parts of variance 1
    dt: sample time of the hold [s]; None for continuous time
    delay: the delay where it is fixed [s]
    longest: the longest delay that is allowed [s]
    """

    measured: MeasuredResponse
    plant: ProcessModel
    names: tuple[str, ...]
    coordinates: Coordinates
    weights: np.ndarray
    dt: float | None
    delay: float | None
    longest: float

    @property
    def samples(self) -> int:
        return 2 * len(self.weights)

    @property
    def scale(self) -> np.ndarray:
        return np.ones(1)

    def _evaluated(self, theta):
        values = theta if self.delay is None else np.append(theta, self.delay)
        response, slopes = response_and_slopes(
            values, counts_of(self.plant), self.measured.frequencies, self.dt
        )
        return response, slopes[:, : len(theta)]

    def response(self, theta):
        """(F,) the model's response."""
        return self._evaluated(theta)[0]

    def residual(self, theta):
        """(2 F, 1) the weighted measured response minus that of the model: real parts first."""
        with np.errstate(all="ignore"):  # a step that is too long; the optimiser shortens it
            try:
                error = self.weights * (self.measured.response - self.response(theta))
            except np.linalg.LinAlgError:
                error = np.full(len(self.weights), np.inf)
        parts = np.concatenate([error.real, error.imag])
        return np.where(np.isfinite(parts), parts, 1e100)[:, None]

    def sensitivity(self, theta):
        """(2 F, 1, P) derivatives of the weighted response of the model, exact."""
        slopes = self.weights[:, None] * self._evaluated(theta)[1]
        return np.concatenate([slopes.real, slopes.imag])[:, None, :]

    def start(self, plant: ProcessModel) -> np.ndarray:
        """The vector theta of a plant."""
        values = [float(get_at(plant, name)) for name in self.names if name != "delay"]
        return np.array(values + [plant.delay] * (self.delay is None))

    def plant_at(self, theta) -> ProcessModel:
        """The plant with the values theta."""
        values = dict(zip(self.names, map(float, theta), strict=True))
        delay = values.pop("delay", self.delay)
        return dataclasses.replace(replaced(self.plant, values), delay=delay)


def response_problem(
    measured: MeasuredResponse, plant: ProcessModel, dt: float | None, delay: float | None
) -> ResponseProblem:
    """The problem of a measured response; delay: [s], None where it is fitted."""
    f, G, std = (np.asarray(x) for x in measured[:3])
    names = free_elements(plant, None)
    coordinates = Coordinates.of(plant, names)
    longest = longest_delay(f, dt)
    if delay is None:  # the coordinate of the bias of a record is that of the delay
        names = (*names, "delay")
        coordinates.low[-1], coordinates.high[-1] = 0.0, longest
    else:
        coordinates = Coordinates(*(of[:-1] for of in coordinates))
    scatter = std if std.any() else np.maximum(np.abs(G), 1e-9 * np.max(np.abs(G)))
    scatter = np.maximum(scatter, np.min(scatter[scatter > 0]))
    return ResponseProblem(
        measured, plant, names, coordinates, np.sqrt(2) / scatter, dt, delay, longest
    )


def longest_delay(f: np.ndarray, dt: float | None) -> float:
    """The longest delay [s] that lines at frequencies f [Hz] are searched for."""
    longest = float(min(PERIODS / f[-1], 0.5 / np.median(np.diff(f))))
    return longest if dt is None else min(longest, LONGEST_DELAY * dt)


def best_of_many_starts(problem: ResponseProblem, starts: int, seed: int) -> Minimum:
    """The best fit from many drawn structures, as `from_many_starts` finds it for a record.

    Each structure is scored with each of many delays by the least squares of its numerator. There,
    the hold is (1 - exp(-s dt)) / (s dt), without the aliases. Of more than 400 lines, every n-th
    is taken for the search.
    """
    every = -(-len(problem.weights) // SEARCHED)
    if every > 1:
        f, G, std = (np.asarray(of)[::every] for of in problem.measured[:3])
        measured = MeasuredResponse(f, G, std)
        thinned = problem._replace(measured=measured, weights=problem.weights[::every])
        return minimum(problem, best_of_many_starts(thinned, starts, seed).theta)
    f = problem.measured.frequencies
    rates = (np.pi * f[0], 4 * np.pi * f[-1])
    drawn = drawn_plants(problem.plant, rates, starts, seed)
    delays = [problem.delay]
    if problem.delay is None:
        delays = np.linspace(0.0, problem.longest, 2 + int(STEPS * problem.longest * f[-1]))
    scored = [
        _scored(problem, jax.tree.map(lambda leaf, i=i: np.asarray(leaf)[i], drawn), delays)
        for i in range(starts)
    ]
    scored = sorted((one for one in scored if np.isfinite(one[0])), key=lambda one: one[0])
    return best_refined(problem, [plant for _, plant in scored[:REFINED]])


def _scored(problem: ResponseProblem, plant: ProcessModel, delays):
    """The least sum of squares of a denominator, and the plant with its numerator and delay."""
    measured, w = problem.measured, problem.weights
    s, m = 2j * np.pi * measured.frequencies, np.size(plant.zeros)
    held = 1.0 if problem.dt is None else -np.expm1(-s * problem.dt) / (s * problem.dt)
    slow = np.prod(1 + s[:, None] / plant.poles, axis=1)
    at = s[:, None] / plant.frequencies
    slow = slow * np.prod(1 + 2 * plant.dampings * at + at**2, axis=1)
    zero = 1 - s / (plant.zeros[0] if m else 1.0)
    basis = (w * held / slow)[:, None] * zero[:, None] ** np.arange(m + 1)
    size = np.linalg.norm(basis, axis=0)
    if not (np.all(np.isfinite(size)) and np.all(size)):
        return np.inf, plant
    basis = basis / size
    wanted = (w * measured.response)[:, None] * np.exp(np.outer(s, delays))
    products = np.real(basis.conj().T @ wanted)
    weights = np.linalg.pinv(np.real(basis.conj().T @ basis), hermitian=True) @ products
    left = np.sum(np.abs(w * measured.response) ** 2) - np.sum(weights * products, axis=0)
    best = int(np.argmin(left))
    found = with_numerator(plant, weights[:, best] / size)
    return left[best], dataclasses.replace(found, delay=float(delays[best]))


# The response of a fitted plant
# --------------------------------------------------------------------------------------------------

# Of the complex step; the derivative is exact to rounding, since nothing is subtracted.
STEP = 1e-30


def counts_of(plant: ProcessModel) -> tuple[int, int, int]:
    """The numbers of zeros, real poles and pairs."""
    return np.size(plant.zeros), np.size(plant.poles), np.size(plant.frequencies)


def response_and_slopes(
    values: np.ndarray, counts: tuple[int, int, int], f: np.ndarray, dt: float | None
) -> tuple[np.ndarray, np.ndarray]:
    """(F,) response and (F, P) its derivatives by the parameters.

        P(z) = z^-d C (z I - A)^-1 (B_0 + z^-1 B_1)

    The derivatives of A, B_0, B_1 and C are found by a complex step (Squire, Trapp 1998), those of
    P follow from them.

    values: (P,) gain, zeros, poles, frequencies, dampings, delay [s]
    f: (F,) frequencies [Hz]
    dt: sample time of the zero-order hold [s]; None for continuous time
    """
    s = 2j * np.pi * f
    whole = 0 if dt is None else samples_of(values[-1], dt)[0]
    z = s if dt is None else np.exp(s * dt)
    A, B, C = _matrices(values, counts, dt, whole)
    steps = values + 1j * STEP * np.eye(len(values))
    slopes = [[M.imag / STEP for M in _matrices(row, counts, dt, whole)] for row in steps]
    outer = np.exp(-s * values[-1]) if dt is None else z ** (-whole)
    powers = np.stack([np.ones_like(z), 1 / z])[: B.shape[1]]
    inner = z[:, None, None] * np.eye(len(A)) - A
    x = np.linalg.solve(inner, (B @ powers).T[:, :, None])[:, :, 0]
    left = np.linalg.solve(np.swapaxes(inner, 1, 2), np.broadcast_to(C.T, (len(f), len(A), 1)))
    left = left[:, :, 0]
    response = outer * (x @ C[0])
    derivatives = np.empty((len(f), len(values)), complex)
    for i, (dA, dB, dC) in enumerate(slopes):
        driven = x @ dA.T + (dB @ powers).T
        derivatives[:, i] = outer * (x @ dC[0] + np.sum(left * driven, axis=1))
    if dt is None:
        derivatives[:, -1] = -s * response
    return response, derivatives


def _matrices(values, counts, dt, whole):
    """A (n, n), B (n, 1) or (n, 2) with B_0 and B_1, and C (1, n)."""
    m, n, q = counts
    gain, zeros, poles, frequencies, dampings, delay = np.split(values, np.cumsum([1, m, n, q, q]))
    A, B, C = cascade(gain[0], zeros, poles, frequencies, dampings, array=np.array)
    if dt is None:
        return A, B, C
    rest = delay[0] - whole * dt
    A_d, B_now = _held(A, B, dt - rest)
    A_rest, B_rest = _held(A, B, rest)
    return A_rest @ A_d, np.hstack([B_now, A_d @ B_rest]), C


def _held(A, B, dt):
    """Exact zero-order hold over a time dt, as `plants.linear.zoh` has it."""
    n = len(A)
    block = np.zeros((n + 1, n + 1), np.result_type(A, B, dt))
    block[:n, :n], block[:n, n:] = A * dt, B * dt
    transition = scipy.linalg.expm(block)
    return transition[:n, :n], transition[:n, n:]
