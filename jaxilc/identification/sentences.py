"""What an identification found, in sentences."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from ..plants import ModalModel, ProcessModel
from .estimation import not_significant
from .verdict import Identified

if TYPE_CHECKING:
    from ..theory.on_lines import MeasuredResponse
    from .grown_response import LineModel

NOT_WHITE = (
    "The residual is not white: another structure may fit better. The intervals are widened to "
    "what its spectrum says."
)
IN_MOTION = (
    "It is fitted clearly better as a record that does not begin at rest at an input of 0: what "
    "its start then adds to the output, free motions of the poles, is fitted, too."
)
WIDENED = (
    "The residual is not white: neighbouring lines err alike, and the intervals are wider for it."
)
NOISY = 0.8  # share of the squared error from which on what is left is noise
NOT_CONVERGED = "The fit did not meet its tolerances: the structure may be too large."
LEAST_DELAY = 1e-6  # samples, or ms where there are none, below which a delay is none
MUCH = 1.5  # residual over std from which on the structure, or the std, is doubted


def verdict(found: Identified, dt: float | None) -> list[str]:
    """Sentences on how good the fit is and what in it the record does not show, the fit first.

    dt: sample time [s], in which a delay is told; None: in ms
    """
    fit, share = float(np.min(found.fit)), float(np.fmin.reduce(found.validation_fit))
    what = "the measured response" if found.of_response else "the output"
    said = f"{described(found, dt)} fits {fit:.4g} % of {what}"
    if share >= 0:
        said += f" ({share:.4g} % of the part that was not fitted)"
    elif share < 0:
        said += " (a constant would fit the part that was not fitted better)"
    elif found.samples < len(found.simulated) - 1 and not found.of_response:
        said += " (in the part that was not fitted it rests, which tests nothing)"
    ratio = float(found.residual_std[0])
    doubted = found.of_response and ratio > MUCH and found.std_known
    if found.white and not doubted:
        said += ", and the residual is white"
    lines = [said + "."]
    if not found.from_rest:
        lines.append(IN_MOTION)
    if doubted:
        lines.append(
            f"The residual is {ratio:.3g} times the standard deviation of the lines: another "
            "structure may fit better, or that deviation is too small."
        )
    if not found.white:
        grown = found.of_response and isinstance(found.plant, ModalModel)
        lines.append(WIDENED if grown else NOT_WHITE)
    if not found.converged:
        lines.append(NOT_CONVERGED)
    return lines + [sentence(text) for text in not_significant(found)]


def on_lines(
    orders: Sequence[LineModel], chosen: LineModel, measured: MeasuredResponse
) -> list[str]:
    """Why a grown model of a response has its order, how well it fits, and what is left."""
    order, noise, known = chosen.parts.order, chosen.share_of_noise, measured.std_known
    least = min(orders, key=lambda one: one.bic)
    below = [one for one in orders if one.parts.order < order]
    why = f"Order {order} is chosen of {len(orders)}"
    if below:
        gained = below[-1].held_out - chosen.held_out
        why += (
            f": on lines that were held out its log likelihood is {gained / 2:.3g} a line above "
            f"that of order {below[-1].parts.order}"
        )
    if least is not chosen:
        why += (
            f", and that of order {least.parts.order}, whose criterion is the smallest, is not "
            "clearly better"
        )
    elif chosen is orders[-1]:
        why += "; it is the largest that was tried, and more parts may be there"
    ten, thirty = (100 * share for share in chosen.within)
    lines = [
        why,
        f"Of the lines that are known well, the error is {100 * chosen.median:.3g} % of the "
        f"response at the median, within 10 % on {ten:.3g} % and within 30 % on {thirty:.3g} % of "
        "them",
    ]
    if known or noise > 0:
        averages = "" if known else f", as of {1 / max(chosen.scale, 1e-9):.3g} averages,"
        lines.append(
            f"The scatter of the lines{averages} explains {100 * noise:.3g} % of the squared error "
            "of a median line"
        )
    if not np.any(measured.std):
        lines.append(
            f"What is left is {100 * chosen.floor:.3g} % of the response; how much of it is noise "
            "the lines do not tell: a column of their coherence or std would"
        )
    elif noise < NOISY:
        lines.append(
            f"What is left is {100 * chosen.floor:.3g} % of the response, and no noise: parts that "
            "the order does not have, or a machine that is not linear (friction, backlash) or "
            "changes with time or place; a second response at another amplitude or place tells"
        )
    return [sentence(text) for text in lines]


def sentence(text: str) -> str:
    """The text with a capital letter and a full stop."""
    return text[:1].upper() + text[1:].removesuffix(".") + "."


def described(found: Identified, dt: float | None) -> str:
    """A plant in words, such as `Order 3 with a delay of 4 samples`."""
    plant = found.plant
    if not isinstance(plant, ProcessModel | ModalModel):
        return type(plant).__name__
    delay = float(plant.delay) / (dt or 1e-3)
    unit = "ms" if dt is None else "sample" + "s" * (round(delay, 9) != 1)
    return f"Order {plant.order}" + f" with a delay of {delay:.4g} {unit}" * (delay > LEAST_DELAY)
