"""A plant that is known, fitted again to what a campaign measured, and never made worse by it.

The trials of a campaign follow one slow motion, and excite little. So

    kept      a number of the plant that the trials determine less well than it was known before
              keeps its value and its interval: the known plant's own sensitivity and the residual
              of a free fit say how well. A pole beyond the Nyquist frequency was not seen either
    judged    the last trials are not fitted; where the known plant predicts them as well as the
              fitted one does, it stays
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from ..filters.inversion import zeros_and_gain
from ..plants import Plant, ProcessModel
from ..pytree.in_short import in_short
from ..pytree.named_paths import get_at
from ..uncertainty import Normal, Uncertainty
from .estimation import identify, validated
from .problem import checked_record, free_elements, problem_of
from .records import Record
from .verdict import WIDE, Estimate, Identified, inverse_of_normal, widened

UNKNOWN = 0.5  # half-width of a number without an interval, as a share of it
FITTED = 0.7  # share of the record
ROUNDED = 1e-6  # share up to which the imaginary part of a zero, or a zero, is rounding
_OF_POLES = ("poles", "frequencies")


class Refit(NamedTuple):
    """A plant fitted again.

    found: the fit, with the numbers that were kept among its parameters
    kept: {name of a number: why it was kept}
    before, after: rms of the error of prediction of what was not fitted, of the known plant and of
        the fitted one [unit of y]
    """

    found: Identified
    kept: dict[str, str]
    before: float
    after: float

    def __repr__(self) -> str:
        return in_short(self)

    @property
    def better(self) -> bool:
        """Whether the fitted plant predicts better."""
        return self.after < self.before


def refit(record: Record, plant: Plant, uncertainty: Uncertainty | None = None) -> Refit:
    """A plant fitted again to a record, from its known values.

    uncertainty: what was known of it: distributions by names such as `plant.gain`
    Raises ValueError as `identify` does, and where the record determines no number better than it
    was known.
    """
    known = known_intervals(plant, uncertainty or {})
    found = identify(record, plant, fit_share=FITTED)
    kept = _not_excited(record, plant, found, known)
    if kept:
        found = _fitted(record, plant, known, kept)
    beyond = beyond_nyquist(found, record.dt) - set(kept)
    if beyond:
        kept |= dict.fromkeys(beyond, "the fit puts it beyond the Nyquist frequency")
        found = _fitted(record, plant, known, kept)
    before, after = held_out(record, plant), held_out(record, found.plant)
    return Refit(_with_kept(found, known), kept, before, after)


def known_intervals(plant: Plant, uncertainty: Uncertainty) -> dict[str, Estimate]:
    """The known numbers of a plant with their 95 % intervals, infinite where none is given."""
    intervals = {}
    for name in free_elements(plant, None):
        value = float(get_at(plant, name))
        given = uncertainty.get(f"plant.{name}") or uncertainty.get(f"plant.{name.split('[')[0]}")
        if given is None:
            intervals[name] = Estimate(value, -np.inf, np.inf)
            continue
        if isinstance(given, Normal):
            low, high = given.mean - WIDE * given.std, given.mean + WIDE * given.std
        else:
            low, high = given.low, given.high
        low, high = sorted((low * value, high * value)) if given.relative else (low, high)
        intervals[name] = Estimate(value, float(low), float(high))
    return intervals


def process_model_of(plant: Plant) -> ProcessModel | None:
    """The transfer function of a plant as a ProcessModel, None where it has not that form.

    It has that form with one input and one output, stable poles, and real zeros that are not 0.
    """
    system = plant if isinstance(plant, ProcessModel) else plant.continuous()
    if system is None or isinstance(system, ProcessModel):
        return system
    A, B, C = (np.asarray(getattr(system, name), float) for name in "ABC")
    if B.shape[1] != 1 or len(C) != 1:
        return None
    poles, gain = np.linalg.eigvals(A), -(C @ np.linalg.pinv(A) @ B).item()
    if np.any(poles.real >= 0):
        return None
    zeros, _ = zeros_and_gain(A, B, C, 0.0)
    least = ROUNDED * np.max(np.abs(poles))
    if np.any((np.abs(zeros.imag) > ROUNDED * np.abs(zeros)) | (np.abs(zeros) < least)):
        return None
    pairs = poles[poles.imag > 0]
    single = -poles[poles.imag == 0].real
    size = np.abs(pairs)
    return ProcessModel(gain, np.sort(zeros.real), np.sort(single), size, -pairs.real / size)


def beyond_nyquist(found: Identified, dt: float) -> set[str]:
    """The names of the poles and pairs of a fitted plant that no sample can have seen."""
    return {
        name
        for name, estimate in found.parameters.items()
        if name.startswith(_OF_POLES) and abs(estimate.value) > np.pi / dt
    }


def held_out(record: Record, plant: Plant) -> float:
    """The rms of the error with which a plant predicts the part of a record that is not fitted."""
    return float(np.sqrt(np.mean(validated(record, plant, FITTED).rms ** 2)))


# How it is done
# --------------------------------------------------------------------------------------------------


def _not_excited(
    record: Record, plant: Plant, found: Identified, known: Mapping[str, Estimate]
) -> dict[str, str]:
    """The numbers that the record determines less well than they are known.

    One number after the other is kept, the least determined first: without it the others are
    determined better.
    """
    problem = problem_of(checked_record(record), plant, free_elements(plant, None), FITTED)
    names, biases = list(problem.names), plant.n_y
    residual = (problem.record.y - found.simulated)[: problem.samples]
    J = problem.sensitivity(problem.start(plant))
    free, kept = list(range(len(names))), {}
    while free:
        which = [*free, *range(len(names), len(names) + biases)]
        of_these = J[:, :, which] / problem.scale[:, None]
        covariance = inverse_of_normal(of_these.reshape(-1, len(which)))
        covariance = covariance * float(np.mean((residual / problem.scale) ** 2))
        covariance = widened(covariance, of_these, residual / problem.scale)
        half = WIDE * np.sqrt(np.diag(covariance))[: len(free)]
        with np.errstate(divide="ignore"):  # a number that is 0 without an interval stays 0
            ratios = half / [_half_width(known[names[i]]) for i in free]
        worst = int(np.argmax(ratios))
        if not ratios[worst] >= 1:
            break
        kept[names[free.pop(worst)]] = "the trials say less of it than was known"
    if not free:
        raise ValueError(
            "the trials determine no number of the plant better than it is known: the plant file "
            "stays as it is"
        )
    return kept


def _half_width(known: Estimate) -> float:
    wide = (known.high - known.low) / 2
    return wide if np.isfinite(wide) else UNKNOWN * abs(known.value)


def _fitted(
    record: Record, plant: Plant, known: Mapping[str, Estimate], kept: Mapping[str, str]
) -> Identified:
    free = [name for name in known if name not in kept]
    if not free:
        raise ValueError(
            "the fit puts every pole beyond the Nyquist frequency: the plant file stays as it is"
        )
    return identify(record, plant, free=free, fit_share=FITTED)


def _with_kept(found: Identified, known: Mapping[str, Estimate]) -> Identified:
    """The fit with the numbers that were kept among its parameters, in the order of the plant."""
    parameters = {name: found.parameters.get(name, of) for name, of in known.items()}
    biases = {n: of for n, of in found.parameters.items() if n not in known}
    return found._replace(parameters=parameters | biases)
