"""The gate after the learning of a law: a law that is not safe on a dense family does not pass."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from .by_response import sizes_of
from .responses import Family
from .window import Filters, Window

WAYS = np.linspace(0.0, 1.0, 21)  # from what was learned to a law that is known to be safer


class Passed(NamedTuple):
    """Taps that pass.

    filters: the taps
    way:     share of the way back on which they lie: 0 for those that were learned
    largest: |keep - L P| at its largest, on the machines and lines of the family
    """

    filters: Filters
    way: float
    largest: float


def gate(
    family: Family,
    window: Window,
    learned: Filters,
    safer: Sequence[Filters],
    dt: float,
    most: float,
    ends: Callable[[Filters, int], bool] = lambda filters, machine: True,
) -> Passed | str:
    """The taps that were learned, taken back no further than |keep - L P| <= most asks, or why not.

    A tuning of a few trials may also end at taps with which learning diverges late, from an end of
    the trial, which the frequency does not tell; these are taken back too.

    Since |keep - L P| is convex in the taps, what lies between two laws is at no frequency worse
    than the worse of them, so a way back to a safe law ends at a safe law.

    safer: laws towards which the taps are taken back, one after the other
    ends: whether taps are safe at the ends of a trial of a machine of this number; it is asked of
        the nominal machine and of the worst one
    """
    for filters in safer:
        for way in WAYS:
            between = learned.towards(filters, float(way))
            sizes = np.max(sizes_of(family, window, between, dt), axis=1)
            worst, largest = int(np.argmax(sizes)), float(np.max(sizes))
            if largest <= most and all(ends(between, machine) for machine in {0, worst}):
                return Passed(between, float(way), largest)
    return _refusal(family, sizes_of(family, window, learned, dt), most)


def _refusal(family: Family, sizes: np.ndarray, most: float) -> str:
    which, line = np.unravel_index(int(np.argmax(sizes)), sizes.shape)
    if sizes[which, line] <= most:
        return (
            "learning would diverge from an end of the trial, where L looks for errors that do not "
            "exist, and no law on the way back to the start is safe there"
        )
    on = ", ".join(f"{name} = {values[which]:.4g}" for name, values in family.drawn.items())
    return (
        f"|Q (1 - L P)| is {sizes[which, line]:.3g} at {family.frequencies[line]:.3g} Hz"
        f"{f' on the machine with {on}' if on else ''}; allowed is {most:.3g}, and no law on the "
        "way back to the start keeps it"
    )
