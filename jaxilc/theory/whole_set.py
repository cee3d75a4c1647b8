"""A bound of |Q (keep - L P)| over a whole set of plants, not only over the plants that were tried.

Two sets have one:

- P is affine in each uncertain number while the others are held, as in a gain, in `plant.B` or in
  `plant.C`. Then |Q (keep - L P)| is convex in each number, so that it is largest at a corner of
  the box. Whether P is so is read off the program.
- P is a `ProcessModel` without a feedback, and up to three of its zeros, poles, frequencies and
  dampings are uncertain beside the gain. With its poles l_i and one sample of dt under zero-order
  hold

      P(z) = gain (1 + sum_i r_i (z - 1) / (z - exp(l_i dt))),
      r_i  = -prod_m (1 - l_i / zeros_m) / prod_{k /= i} (1 - l_i / l_k)

  A delay of whole samples multiplies it by a power of z. It is enclosed by arithmetic of discs over
  boxes of frequency and of these numbers, which are split until none exceeds the largest value
  found by more than 2 % (branch and bound). P is linear in the gain, so that |Q (keep - L P)| is
  largest at one of its ends.

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
from ..plants.structure import AFFINE, dependence
from ..pytree.named_paths import get_at
from ..schemes import Scheme
from ..signals.task import Task
from ..uncertainty import Uncertainty, drawn_machine
from .enclosure import Disc, arc_of_taps, exactly
from .frequency import CORNERS, Tried, loops_at
from .law import Law
from .loop import linear_loop, responses, stable

MOST_NUMBERS = 3  # beside the gain, over which boxes are split
SAME = 1e-8  # relative difference of the formula from the loop that rounding explains
WIDE = 0.02  # relative distance of the bound from the largest value found
LOOKED_AT = 400_000  # boxes before the bound is left as wide as it is
CHUNK = 40_000  # boxes at a time
SHAPES = ("gain", "zeros", "poles", "frequencies", "dampings")


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
    if not np.all(stable(tried.radii)):
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


# By the corners of the box
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


# By boxes of frequency and of the numbers of a process model
# --------------------------------------------------------------------------------------------------


class Boxes(NamedTuple):
    """The response of a process model over boxes of angle and numbers.

    plant:  at its nominal values
    law:    taps
    gains:  (2,) the ends of the gain
    scale:  what the number drawn for the gain is multiplied by
    names:  of the other uncertain numbers, with the leaf, the index and whether it is relative
    low, high: (n,) their ends
    """

    plant: ProcessModel
    law: Law
    dt: float
    gains: np.ndarray
    scale: float
    names: list[tuple[str, int | None, bool]]
    low: np.ndarray
    high: np.ndarray

    @classmethod
    def of(cls, machine, task, law, uncertainty: Uncertainty) -> Boxes:
        gains, names, ends = np.repeat(float(machine.plant.gain), 2), [], []
        scale = 1.0
        for name, d in uncertainty.items():
            leaf, _, index = name.removeprefix("plant.").partition("[")
            low, high = sorted(d.corners())
            if leaf == "gain":
                scale = float(get_at(machine, name)) if d.relative else 1.0
                gains = scale * np.array([low, high])
            else:
                names.append((leaf, int(index[:-1]) if index else None, bool(d.relative)))
                ends.append((low, high))
        low, high = np.array(ends, float).reshape(-1, 2).T
        return cls(machine.plant, law, float(task.dt), gains, scale, names, low, high)

    def bound(self, best: float) -> tuple[float, str]:
        """The bound, and how it was found, from the largest value that is known so far."""
        n = len(self.names)
        edges = np.linspace(0.0, np.pi, 257)
        lows = np.column_stack([edges[:-1], *np.repeat(self.low[:, None], 256, axis=1)])
        highs = np.column_stack([edges[1:], *np.repeat(self.high[:, None], 256, axis=1)])
        looked, top = 0, best * (1 + WIDE)
        while len(lows):
            looked += len(lows)
            chunks = [slice(i, i + CHUNK) for i in range(0, len(lows), CHUNK)]
            found = [self._upper(lows[some], highs[some]) for some in chunks]
            upper, split = (np.concatenate(x) for x in zip(*found, strict=True))
            left = upper > top
            if looked > LOOKED_AT and np.any(left):
                reached = float(np.max(upper))
                what = f"after {looked} boxes of frequency and {n} numbers"
                return (reached if reached < 1 else np.inf), f"{what} it is {reached:.3g} or less"
            lows, highs = _halves(lows[left], highs[left], split[left])
        how = f"by {looked} boxes of frequency and {n} uncertain numbers, within {100 * WIDE:g} %"
        return top, how

    def _upper(self, lows, highs):
        """Upper bounds over boxes, and the side of each that makes it widest."""
        middle = (lows + highs) / 2
        upper = self._size(lows, highs).max(axis=0)
        alone = []
        for i in range(lows.shape[1]):
            a, b = middle.copy(), middle.copy()
            a[:, i], b[:, i] = lows[:, i], highs[:, i]
            alone.append(self._size(a, b).max(axis=0))
        return upper, np.argmax(np.nan_to_num(np.array(alone), posinf=1e300), axis=0)

    def _size(self, lows, highs) -> np.ndarray:
        """(2, B) the largest |keep - L P| on boxes, at both ends of the gain."""
        centre, h = (lows[:, 0] + highs[:, 0]) / 2, (highs[:, 0] - lows[:, 0]) / 2
        keep, L = (arc_of_taps(of, centre).disc(h) for of in (self.law.keep, self.law.L))
        LP = L.times(self._unit(lows, highs, Disc(np.exp(1j * centre), h)))
        return np.stack([keep.minus(LP.times(exactly(g))).largest for g in self.gains])

    def _unit(self, lows, highs, z: Disc) -> Disc:
        """P of gain 1 on boxes."""
        leaves = {
            name: [np.full(len(lows), v) for v in np.asarray(getattr(self.plant, name), float)]
            for name in SHAPES[1:]
        }
        low, high = dict(leaves), {name: list(values) for name, values in leaves.items()}
        for i, (leaf, index, relative) in enumerate(self.names):
            for j in range(len(low[leaf])) if index is None else [index]:
                scale = low[leaf][j] if relative else 1.0
                ends = np.sort([lows[:, i + 1] * scale, highs[:, i + 1] * scale], axis=0)
                low[leaf][j], high[leaf][j] = ends
        poles = [_interval(-b, -a) for a, b in zip(low["poles"], high["poles"], strict=True)]
        for j in range(len(low["frequencies"])):
            poles += _pair(*(x[n][j] for n in ("frequencies", "dampings") for x in (low, high)))
        ends = zip(low["zeros"], high["zeros"], strict=True)
        zeros = [_interval(a, b).inverse() for a, b in ends]
        late = round(self.plant.delay / self.dt)
        turned = z.centre**-late
        return _sampled(poles, zeros, z, self.dt).times(Disc(turned, late * z.radius))

    def departure(self, tried: Tried) -> float:
        """The largest relative difference of the formula from the loop, at plants that were tried.

        They are the nominal one and the last ones, which are corners of the box.
        """
        f, worst = np.linspace(0.01, 0.49, 41) / self.dt, 0.0
        kept = [i for i, name in enumerate(tried.names) if name != "plant.gain"]
        gain = [i for i, name in enumerate(tried.names) if name == "plant.gain"]
        z = exactly(np.exp(2j * np.pi * f * self.dt))
        for i in {0, len(tried.points) - 2, len(tried.points) - 1}:
            point = np.tile([0.0, *tried.points[i, kept]], (len(f), 1))
            P = responses([tried.loops[i]], f, self.dt)[0]
            scale = self.scale * tried.points[i, gain[0]] if gain else self.gains[0]
            ours = scale * self._unit(point, point, z).centre
            worst = max(worst, float(np.max(np.abs(P - ours)) / np.max(np.abs(P))))
        return worst


def _sampled(poles: list[Disc], inverse_zeros: list[Disc], z: Disc, dt: float) -> Disc:
    """P of gain 1 under zero-order hold, by its partial fractions."""
    one = exactly(np.ones(z.centre.shape))
    P = one
    for i, pole in enumerate(poles):
        residue = exactly(-np.ones(z.centre.shape))
        for inverse in inverse_zeros:
            residue = residue.times(one.minus(pole.times(inverse)))
        for k, other in enumerate(poles):
            if k != i:
                residue = residue.times(one.minus(pole.times(other.inverse())).inverse())
        decay = Disc(pole.centre * dt, pole.radius * dt).exponential()
        # (z - 1) / (z - a) = 1 - (1 - a) / (z - a)
        lag = one.minus(one.minus(decay).times(z.minus(decay).inverse()))
        P = P.plus(residue.times(lag))
    return P


def _pair(w_low, w_high, low, high) -> list[Disc]:
    """The two poles w exp(+- i (pi - acos damping)) of a pair; infinite at a damping of 1."""
    bad = high >= 1
    turn_low, turn_high = (np.arccos(np.minimum(end, 1.0)) for end in (high, low))
    w, turn = (w_low + w_high) / 2, (turn_low + turn_high) / 2
    radius = (w_high - w_low) / 2 + w_high * (turn_high - turn_low) / 2
    radius = np.where(bad, np.inf, radius)
    centre = -w * np.exp(-1j * turn)
    return [Disc(centre, radius), Disc(np.conj(centre), radius)]


def _interval(low, high) -> Disc:
    return Disc((low + high) / 2 + 0j, (high - low) / 2)


def _halves(lows, highs, split):
    """Each box as two, halved across one side."""
    rows = np.arange(len(lows))
    middle = (lows[rows, split] + highs[rows, split]) / 2
    first, second = highs.copy(), lows.copy()
    first[rows, split], second[rows, split] = middle, middle
    return np.concatenate([lows, second]), np.concatenate([first, highs])
