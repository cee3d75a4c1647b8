"""The choice of an order, by fits of several, and what in a fit the record does not show."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from ..plants import ProcessModel
from ..pytree.in_short import in_short
from .estimation import identify
from .problem import SAMPLES_PER_PARAMETER
from .records import Record
from .verdict import Identified

# (poles, pairs, zeros): orders 1 to 4. A pair may have two real poles.
STRUCTURES = ((1, 0, 0), (0, 1, 0), (0, 1, 1), (1, 1, 0), (1, 1, 1), (0, 2, 0), (0, 2, 1))
SMALLEST = 1e-9  # of the output's standard deviation; a smaller residual is rounding


class Order(NamedTuple):
    """The fit of one structure.

    poles, pairs, zeros: numbers of real poles, pairs of poles and zeros
    parameters: number of fitted numbers, with the bias, and with the delay where it is not 0
    rms: root mean square of the residual over the fitted part [unit of y]
    bic: Bayesian information criterion, see `information`
    validation_fit: fit over the validation part [%]
    found: the identification
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
    structures: Sequence[tuple[int, int, int]] = STRUCTURES,
    delay: int = 0,
    starts: int = 64,
    seed: int = 0,
    each: Callable[[tuple[int, int, int]], object] = lambda structure: None,
) -> list[Order]:
    """Fits of several structures to a record of one input and one output, in the order given.

    structures: (poles, pairs, zeros) of each
    delay: dead time of all of them in samples
    starts, seed: as for `identify`; the first 70 % of the record are fitted
    each: called with each structure before it is fitted
    A structure of too many parameters for the record is left out, except the first one.
    Raises ValueError as `identify` does.
    """
    found = []
    for i, (poles, pairs, zeros) in enumerate(structures):
        if i and not long_enough(record, 2 + poles + 2 * pairs + zeros):
            continue
        each((poles, pairs, zeros))
        fit = identify(
            record, poles=poles, pairs=pairs, zeros=zeros, delay=delay, starts=starts, seed=seed
        )
        residual = (np.asarray(record.y).reshape(len(fit.simulated), -1) - fit.simulated)[
            : fit.samples, 0
        ]
        smallest = SMALLEST * float(np.std(np.asarray(record.y)[: fit.samples]))
        number = len(fit.parameters) + (delay > 0)
        found.append(
            Order(
                poles,
                pairs,
                zeros,
                number,
                float(np.sqrt(np.mean(residual**2))),
                information(residual, number, smallest),
                float(fit.validation_fit[0]),
                fit,
                delay,
            )
        )
    return found


def long_enough(record: Record, parameters: int) -> bool:
    """Whether the fitted part of a record has enough samples for so many parameters."""
    return round(0.7 * len(record.y)) >= SAMPLES_PER_PARAMETER * parameters


def information(residual, parameters: int, smallest: float = 0.0) -> float:
    """The Bayesian information criterion of a fit with Gaussian residuals (Schwarz 1978).

        BIC = n ln(sum e^2 / n) + p ln n

    residual: (n,);  parameters: p;  smallest: root mean square below which the residual is rounding
    """
    n = len(residual)
    mean = max(float(np.mean(np.asarray(residual) ** 2)), smallest**2, np.finfo(float).tiny)
    return n * float(np.log(mean)) + parameters * float(np.log(n))


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
