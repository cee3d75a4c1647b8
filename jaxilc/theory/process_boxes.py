"""The response of a `ProcessModel` over boxes of frequency and of its numbers.

With its poles l_i and one sample of dt under zero-order hold

    P(z) = gain (1 + sum_i r_i (z - 1) / (z - exp(l_i dt))),
    r_i  = -prod_m (1 - l_i / zeros_m) / prod_{k /= i} (1 - l_i / l_k)

A delay of whole samples multiplies it by a power of z. It is enclosed by arithmetic of discs
(`discs`), and the boxes are split until none exceeds the largest value found by more than 2 %
(branch and bound). P is linear in the gain, so that |Q (keep - L P)| is largest at one of its ends.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..plants import ProcessModel
from ..pytree.named_paths import get_at
from ..uncertainty import Uncertainty
from .discs import Disc, exactly
from .enclosure import arc_of_taps, size
from .family import Tried
from .law import Law
from .loop import responses

WIDE = 0.02  # relative distance of the bound from the largest value found
LOOKED_AT = 400_000  # boxes before the bound is left as wide as it is
CHUNK = 40_000  # boxes at a time
SHAPES = ("gain", "zeros", "poles", "frequencies", "dampings")


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
            upper, split = (
                np.concatenate(x)
                for x in zip(
                    *(
                        self._upper(lows[i : i + CHUNK], highs[i : i + CHUNK])
                        for i in range(0, len(lows), CHUNK)
                    ),
                    strict=True,
                )
            )
            left = upper > top
            if looked > LOOKED_AT and np.any(left):
                reached = float(np.max(upper))
                said = (
                    f"after {looked} boxes of frequency and {n} numbers it is {reached:.3g} or less"
                )
                return (reached if reached < 1 else np.inf), said
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
        keep, L = (_disc_of_taps(part, centre, h) for part in (self.law.keep, self.law.L))
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
        zeros = [
            _interval(a, b).inverse() for a, b in zip(low["zeros"], high["zeros"], strict=True)
        ]
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


# How it is done
# --------------------------------------------------------------------------------------------------


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


def _disc_of_taps(taps, centre, h) -> Disc:
    arc = arc_of_taps(taps, centre, h)
    return Disc(arc.value[:, 0, 0], h * size(arc.slope) + h**2 * arc.curve)


def _halves(lows, highs, split):
    """Each box as two, halved across one side."""
    rows = np.arange(len(lows))
    middle = (lows[rows, split] + highs[rows, split]) / 2
    first, second = highs.copy(), lows.copy()
    first[rows, split], second[rows, split] = middle, middle
    return np.concatenate([lows, second]), np.concatenate([first, highs])
