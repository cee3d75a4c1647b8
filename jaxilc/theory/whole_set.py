"""A bound of |Q (keep - L P)| over a whole set of plants, not only over the plants that were tried.

Two sets have one:

- P is affine in each uncertain number while the others are held, as in a gain, in `plant.B` or in
  `plant.C`. Then |Q (keep - L P)| is convex in each number, so that it is largest at a corner of
  the box. Whether P is so is read off the program.
- P is a `ProcessModel` without a feedback, and up to three of its zeros, poles, frequencies and
  dampings are uncertain beside the gain: by branch and bound over boxes of these and of frequency
  (`process_boxes`).

For every other set nothing is proved between the plants that were tried, and `WholeSet` says why.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from ..learning.machine import Machine
from ..plants import ProcessModel
from ..schemes import Scheme
from ..signals.task import Task
from ..uncertainty import Uncertainty, drawn_machine
from .family import CORNERS, Tried
from .law import Law
from .loop import linear_loop
from .process_boxes import SHAPES, Boxes
from .structure import AFFINE, CONSTANT, dependence

MOST_NUMBERS = 3  # beside the gain, over which boxes are split
SAME = 1e-8  # relative difference of the formula from the loop that rounding explains


class WholeSet(NamedTuple):
    """What is proved of |Q (keep - L P)| over all plants of the box and all frequencies.

    bound: no plant of the box exceeds it; inf where nothing is proved
    how:   how it was proved, or why nothing is
    """

    bound: float
    how: str

    @property
    def proved(self) -> bool:
        return bool(np.isfinite(self.bound))


def bound_of_set(
    machine: Machine, scheme: Scheme, task: Task, law: Law, uncertainty: Uncertainty, tried: Tried
) -> WholeSet:
    """The bound over the box that the distributions span.

    law:   of the scheme
    tried: the plants of the box that were tried, its corners among them up to 8 numbers
    """
    if np.any(tried.radii >= 1 - 1e-9):
        return WholeSet(np.inf, "a loop that was tried is not stable")
    if not uncertainty:
        return WholeSet(float(tried.values[tried.top]), "there is one plant only")
    curved = _curved(machine, scheme, task, uncertainty)
    if not curved and len(uncertainty) <= CORNERS:
        how = "P is affine in each uncertain number, so the worst plant is a corner of the box"
        return WholeSet(float(tried.values[tried.top]), how)
    what = f"P is not affine in {', '.join(curved)}" if curved else f"over {CORNERS} numbers"
    why = _not_a_process_model(machine, scheme, uncertainty)
    if not why and law.L.taps.shape[1:] != (1, 1):
        why = "the law has several channels"
    if not why:
        box = Boxes.of(machine, task, law, uncertainty)
        if box.departure(tried) > SAME:
            why = "the loop is more than the plant alone"
        else:
            return WholeSet(*box.bound(float(tried.values[tried.top])))
    return WholeSet(np.inf, f"{what}, and {why}: nothing is proved between the plants tried")


# How it is done
# --------------------------------------------------------------------------------------------------


def _curved(machine, scheme, task, uncertainty: Uncertainty) -> list[str]:
    """The numbers of which P is not affine while the others are held."""
    names = list(uncertainty)
    middle = {name: float(np.mean(uncertainty[name].corners())) for name in names}
    machine, scheme = machine.unlimited(), scheme.unlimited()

    def loop(fixed, value, name):
        machine, scheme, task, values = fixed
        return linear_loop(
            drawn_machine(machine, uncertainty, values | {name: value}), scheme, task
        )

    found: list[str] = []
    for name in names:
        values = {other: jnp.asarray(v) for other, v in middle.items()}
        fixed = (machine, scheme, task, values)
        A, B, C = _orders(partial(loop, name=name), fixed, values[name])
        if A != CONSTANT or max(B, C) > AFFINE or CONSTANT not in (B, C):
            found.append(name)
    return found


def _orders(f, fixed, varying) -> list[int]:
    """How A, B and C depend on what varies: CONSTANT, AFFINE or OTHERWISE."""
    return [dependence(lambda a, b, i=i: f(a, b)[i], fixed, varying).order for i in range(3)]


def _not_a_process_model(machine, scheme, uncertainty: Uncertainty) -> str:
    """Why the formula of a `ProcessModel` does not serve; empty where it does."""
    plant = machine.plant
    if not isinstance(plant, ProcessModel):
        return f"the plant is a {type(plant).__name__}, no ProcessModel"
    if not scheme.plays_back:
        return "there is a feedback"
    shapes = [name.removeprefix("plant.").split("[")[0] for name in uncertainty]
    if not set(shapes) <= set(SHAPES) or not all(n.startswith("plant.") for n in uncertainty):
        return "a number is uncertain that is none of the process model's"
    if sum(shape != "gain" for shape in shapes) > MOST_NUMBERS:
        return f"more than {MOST_NUMBERS} numbers beside the gain are uncertain"
    return ""
