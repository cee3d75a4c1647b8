"""What an identification found, in sentences."""

from __future__ import annotations

import numpy as np

from ..plants import ProcessModel
from .orders import not_significant
from .verdict import Identified

NOT_WHITE = (
    "The residual is not white: another structure may fit better, and the intervals are too narrow."
)
NOT_CONVERGED = "The fit did not meet its tolerances: the structure may be too large."
LEAST_DELAY = 1e-6  # samples, or ms where there are none, below which a delay is none
MUCH = 1.5  # residual over std from which on the structure, or the std, is doubted


def verdict(found: Identified, dt: float | None) -> list[str]:
    """Sentences on how good the fit is and what in it the record does not show, the fit first.

    dt: sample time [s], in which a delay is told; None: in ms
    """
    fit, share = float(np.min(found.fit)), float(np.min(found.validation_fit))
    what = "the measured response" if found.of_response else "the output"
    said = f"{described(found, dt)} fits {fit:.4g} % of {what}"
    if np.isfinite(share):
        said += f" ({share:.4g} % of the part that was not fitted)"
    ratio = float(found.residual_std[0])
    doubted = found.of_response and ratio > MUCH and found.std_known
    if found.white and not doubted:
        said += ", and the residual is white"
    lines = [said + "."]
    if doubted:
        lines.append(
            f"The residual is {ratio:.3g} times the standard deviation of the lines: another "
            "structure may fit better, or that deviation is too small."
        )
    if not found.white:
        lines.append(NOT_WHITE)
    if not found.converged:
        lines.append(NOT_CONVERGED)
    return lines + [sentence(text) for text in not_significant(found)]


def sentence(text: str) -> str:
    """The text with a capital letter and a full stop."""
    return text[:1].upper() + text[1:].removesuffix(".") + "."


def described(found: Identified, dt: float | None) -> str:
    """A plant in words, such as `Order 3 with a delay of 4 samples`."""
    plant = found.plant
    if not isinstance(plant, ProcessModel):
        return type(plant).__name__
    late = float(plant.delay) / (dt or 1e-3) > LEAST_DELAY
    return f"Order {plant.order}" + (f" with a delay of {delay_in(plant, dt)}" * late)


def delay_in(plant: ProcessModel, dt: float | None) -> str:
    """The delay of a plant in samples, or in ms without a sample time."""
    if dt is None:
        return f"{1e3 * plant.delay:.4g} ms"
    samples = plant.delay / dt
    return f"{samples:.4g} sample" + "s" * (round(samples, 9) != 1)
