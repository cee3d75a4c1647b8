"""What repeats in the error of a motion, and what is new in each trial: over time and frequency."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .description import FREQUENCY, TIME, Axis, Band, Curve, Figure, Layer, Panel, Rule
from .paper import drawn
from .style import COLOURS, GREY

if TYPE_CHECKING:
    from ..identification.potential import Potential
    from ..identification.repeats import Repeats


@drawn
def potential_figure(repeats: Repeats, found: Potential) -> Figure:
    """The error that repeats, each trial less that, and the densities of both; three axes.

    The density is the root of the power density. The line is the cutoff up to which learning pays.
    """
    e, unit, spectrum = repeats.e, repeats.unit, found.spectrum
    alike = e[found.trials - found.alike :]
    mean, time = alike.mean(axis=0), np.arange(e.shape[1]) * repeats.dt
    differences: list[Layer] = [
        Curve(time, one, width=0.6, colour=COLOURS[1], name="new in each trial")
        for one in alike - mean
    ]
    if found.start:
        first = Curve(time, e[0] - mean, width=0.8, colour=GREY, name="first trial, left out")
        differences.insert(0, first)
    f = spectrum.frequencies
    low, high = np.sqrt(np.clip(spectrum.ratio * spectrum.new, 0.0, None))
    new, repeatable = (
        np.sqrt(np.clip(of, 0.0, None)) for of in (spectrum.new, spectrum.repeatable)
    )
    seen = np.where(repeatable > 0, repeatable, np.nan)
    densities: list[Layer] = [
        Curve(f, seen, mark="o", size=3, name="repeats"),
        Band(f, np.where(low > 0, low, np.nan), np.where(low > 0, high, np.nan), name="repeats"),
        Curve(f, new, mark="s", size=3, colour=COLOURS[1], name="new in each trial"),
    ]
    if found.cutoff.value:
        densities.append(Rule(found.cutoff.value, "x", dash="--", name="worth learning up to here"))
    return Figure(
        [Panel(TIME, Axis("error that repeats", unit), [Curve(time, mean, width=1)]),
         Panel(TIME, Axis("trial less that", unit), differences),
         Panel(FREQUENCY, Axis("density", f"{unit}/√Hz" if unit else "", log=True), densities)],
        "What repeats, which learning can remove, and what is new in each trial.",
        size=(7.2, 7.6), shares="",
    )  # fmt: skip
