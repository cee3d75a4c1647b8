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

import itertools
from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from ..learning.machine import Machine
from ..plants import ProcessModel, StateSpace
from ..schemes import Scheme
from ..signals.task import Task
from ..uncertainty import Uncertainty, drawn_machine
from .family import CORNERS, Tried, loops_at
from .law import Law
from .loop import linear_loop
from .process_boxes import SHAPES, Boxes
from .structure import AFFINE, dependence

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
            why = "the loop is more than the plant and a delay of whole samples"
        else:
            return WholeSet(*box.bound(float(tried.values[tried.top])))
    return WholeSet(np.inf, f"{what}, and {why}: nothing is proved between the plants tried")


# How it is done
# --------------------------------------------------------------------------------------------------


def _curved(machine, scheme, task, uncertainty: Uncertainty) -> list[str]:
    """The numbers of which P is not affine while the others are held, wherever these are.

    A, B and C are affine in each number by the program. A matrix that the program calls affine may
    never move, since 0 times a number counts as affine in it. It does not move with a number if it
    is the same at both ends of each edge of the box along that number, since it is affine in the
    other numbers too.
    """
    names, n = list(uncertainty), len(uncertainty)
    plant = machine.plant
    if isinstance(plant, StateSpace) and all(
        name in ("plant.B", "plant.C") and uncertainty[name].relative for name in names
    ):  # the zero-order hold is linear in B, which the program of a matrix exponential hides
        machine = machine.sampled(task.dt)
    fixed = (machine.unlimited(), scheme.unlimited(), task)
    middle = {name: jnp.asarray(np.mean(uncertainty[name].corners())) for name in names}

    def loop(fixed, value, name):
        *common, values = fixed
        machine = drawn_machine(common[0], uncertainty, values | {name: value})
        return linear_loop(machine, *common[1:])

    curved = [
        name
        for name in names
        if max(_orders(partial(loop, name=name), (*fixed, middle), middle[name])) > AFFINE
    ]
    if curved or n > CORNERS:
        return curved
    corners = np.array(list(itertools.product(*(uncertainty[name].corners() for name in names))))
    loops = loops_at(machine, scheme, task, uncertainty, corners)
    at = [np.stack(one).reshape((2,) * n + (-1,)) for one in zip(*loops, strict=True)]
    for i, name in enumerate(names):
        A, B, C = (bool(np.any(np.diff(part, axis=i))) for part in at)
        if A or (B and C):
            curved.append(name)
    return curved


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
