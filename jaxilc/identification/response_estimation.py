"""Identification fits a ProcessModel to a measured frequency response."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import cast

import numpy as np
import scipy

from ..plants import ProcessModel
from ..plants.process_model import LONGEST_DELAY
from ..pytree.ranges import SEEDS, require
from ..theory.on_lines import MeasuredResponse
from .estimation import MOST
from .orders import STRUCTURES, Order, information
from .problem import SAMPLES_PER_PARAMETER, Minimum
from .response_problem import ResponseProblem, best_of_many_starts, response_problem
from .verdict import CONFIDENCE, LAGS, WHITE, Estimate, Identified, inverse_of_normal, poles_of

LARGEST = 1e100  # of a response, whose square must be a number
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

    measured: the lines
    poles, pairs, zeros, starts, seed: as for `identify`
    dt: sample time [s] of the zero-order hold within the response; None for a response between
        two signals in continuous time. `model_response` says what P is in each case
    delay: dead time [s]; None where it is fitted, between 0 and 25 periods of the fastest line

    In the result `simulated` is the complex response of the fit, and a row of `parameters` is
    `delay` [s] where it was fitted.
    Raises ValueError for a value outside its range, lines at or above half the sampling rate, a
    response that is zero, and too few lines for the parameters.
    """
    require("identify_response", "seed", seed, SEEDS, whole=True)
    require("identify_response", "starts", starts, "[1, inf)", whole=True)
    for name, value in (("poles", poles), ("pairs", pairs), ("zeros", zeros)):
        require("identify_response", name, value, f"[0, {MOST}]", whole=True)
    order = poles + 2 * pairs
    require("identify_response", "zeros", zeros, f"[0, {order})", note=", the order")
    checked_lines(measured, dt, delay)
    parameters = 1 + zeros + order + (delay is None)
    if not enough_lines(measured, parameters):
        raise ValueError(
            f"identify_response: {len(measured.frequencies)} lines are too few to fit {parameters} "
            f"parameters; allowed are at least {-(-SAMPLES_PER_PARAMETER * parameters // 2)}"
        )
    plant = ProcessModel(1.0, np.ones(zeros), np.ones(poles), np.ones(pairs), np.ones(pairs))
    problem = response_problem(measured, plant, dt, delay)
    return _judged(problem, best_of_many_starts(problem, starts, seed))


def compare_response_orders(
    measured: MeasuredResponse,
    *,
    structures: Sequence[tuple[int, int, int]] = STRUCTURES,
    dt: float | None = None,
    delay: float | None = None,
    starts: int = 64,
    seed: int = 0,
    each: Callable[[tuple[int, int, int]], object] = lambda structure: None,
) -> list[Order]:
    """Fits of several structures to a measured response, as `compare_orders` has them for a record.

        BIC = chi^2 + p ln(2 F),    chi^2 = sum_k 2 |G_k - P_k|^2 / std_k^2

    for F lines of known standard deviation, else the criterion of `information`. The delay of each
    structure is fitted, or that given [s]. Structures of too many parameters are left out, except
    the first one. `rms` is the root mean square of |G - P| / std.
    """
    found = []
    for i, (poles, pairs, zeros) in enumerate(structures):
        if i and not enough_lines(measured, 2 + poles + 2 * pairs + zeros):
            continue
        each((poles, pairs, zeros))
        fit = identify_response(
            measured,
            poles=poles,
            pairs=pairs,
            zeros=zeros,
            dt=dt,
            delay=delay,
            starts=starts,
            seed=seed,
        )
        problem = response_problem(measured, cast(ProcessModel, fit.plant), dt, delay)
        error = problem.weights * (measured.response - fit.simulated[:, 0])
        parts, number = np.concatenate([error.real, error.imag]), len(fit.parameters)
        bic = float(parts @ parts + number * np.log(len(parts)))
        if not (np.any(measured.std) and measured.averages_known):
            bic = information(parts, number, 1e-9)
        rms = float(np.sqrt(np.mean(parts**2)))
        found.append(Order(poles, pairs, zeros, number, rms, bic, np.nan, fit))
    return found


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


def _judged(problem: ResponseProblem, found: Minimum) -> Identified:
    """The result at the minimum, with its intervals, poles and tests of the residual."""
    theta, measured = found.theta, problem.measured
    known = bool(np.any(measured.std)) and measured.averages_known
    residual = problem.residual(theta)[:, 0]
    freedom = max(len(residual) - len(theta), 1)
    ratio = float(np.sqrt(residual @ residual / freedom))
    covariance = inverse_of_normal(problem.sensitivity(theta)[:, 0]) * (1.0 if known else ratio**2)
    tail = 0.5 + CONFIDENCE / 2
    width = scipy.special.ndtri(tail) if known else scipy.special.stdtrit(freedom, tail)
    half = width * np.sqrt(np.diag(covariance))
    named = zip(problem.names, theta, half, strict=True)
    plant, delay = problem.plant_at(theta), problem.delay_at(theta)
    weighted = problem.weights * measured.response
    error = residual[: len(weighted)] + 1j * residual[len(weighted) :]
    whiteness = whiteness_of_lines(error)
    return Identified(
        plant=dataclasses.replace(plant, delay=delay),
        parameters={name: Estimate(float(v), float(v - h), float(v + h)) for name, v, h in named},
        covariance=covariance,
        poles=poles_of(problem, theta, covariance),
        samples=len(weighted),
        simulated=problem.response(theta)[:, None],
        fit=np.array([100 * (1 - np.linalg.norm(error) / np.linalg.norm(weighted))]),
        validation_fit=np.array([np.nan]),
        residual_std=np.array([ratio]),
        whiteness=np.array([whiteness]),
        white=whiteness >= WHITE,
        converged=found.converged,
        of_response=True,
        std_known=known,
    )


def whiteness_of_lines(error) -> float:
    """Share of the residual's correlations between lines 1 .. 20 apart within their 95 % bound.

    Over F lines of independent complex normal errors, such a correlation is complex and normal of
    variance 1 / F, so that it lies within a disc of radius 1.73 / sqrt(F) in 95 % of cases.
    """
    lags = range(1, min(LAGS, len(error) // 4) + 1)
    power = max(float(np.real(np.vdot(error, error))), np.finfo(float).tiny)
    r = np.array([np.vdot(error[:-lag], error[lag:]) for lag in lags]) / power
    return float(np.mean(np.abs(r) <= IN_DISC / np.sqrt(len(error)))) if len(r) else 1.0
