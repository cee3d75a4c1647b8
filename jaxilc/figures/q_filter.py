"""Whether a Q-filter is safe: plant, filter, L P and |Q (1 - L P)| of a family over frequency."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from .description import FREQUENCY, Axis, Band, Curve, Figure, Layer, Panel, Rule
from .paper import drawn
from .style import GREY, numbers_of, style_of

if TYPE_CHECKING:
    from ..theory.q_filter import Curves

SEEN = 1e-2  # |Q| below which nothing of L P is shown
SLOWEST = 1e-3  # of the last frequency shown
FLOOR = 1e-3  # least magnitude of P shown, against the largest
SHARES = (0.01, 10.0)  # of |Q| and |L P| that are shown


@drawn
def q_filter_figure(
    families: Mapping[str, Curves], *, margin: float = 0.0, unit: str = ""
) -> Figure:
    """|P|, then |Q| and |L P|, then |Q (1 - L P)| with its band, against frequency; three axes.

    The band is from the least to the largest value of the family; of a measured response it is its
    scatter. The largest value is marked. The frequencies shown end where |Q| has fallen to 0.01.

    families: curves by name, from `theory.q_filter`
    margin:   that was asked for; 0 for no line
    unit:     of P, output per input
    """
    plants: list[Layer] = []
    parts: list[Layer] = []
    sizes: list[Layer] = []
    looks = numbers_of(families)
    for i, (name, curves) in enumerate(families.items()):
        f, style = curves.f, style_of(looks[i])
        if not any(_same_plant(curves, other) for other in list(families.values())[:i]):
            plants.append(Curve(f, np.abs(curves.P), name=name, **style))
        LP = np.where(np.abs(curves.Q) > SEEN, np.abs(curves.LP), np.nan)
        parts.append(Curve(f, LP, name=f"|L P|, {name}", **style))
        shade = f"#{3 * f'{127 * i // len(families):02x}'}"
        parts.append(Curve(f, np.abs(curves.Q), style["dash"], name=f"|Q|, {name}", colour=shade))
        top = int(np.argmax(curves.high))
        said = f"{name}; shaded: its family\nat most {curves.high[top]:.3g} at {f[top]:.3g} Hz"
        colour: dict[str, Any] = {"name": said, "colour": style["colour"]}
        sizes += [
            Curve(f, curves.nominal, name=said, **style),
            Band(f, curves.low, curves.high, alpha=0.2, **colour),
            Curve([f[top]], [curves.high[top]], dash="", mark="o", size=5, **colour),
        ]
    first = next(iter(families.values()))
    without = "|1 − L P| without Q,\nlargest"
    sizes += [Curve(first.f, first.without, dash=":", name=without, colour=GREY)]
    sizes.append(Rule(1.0, name="1: learning may diverge"))
    if margin:
        sizes.append(Rule(1 - margin, dash="--", name=f"{1 - margin:g}: asked for"))
    found, of_P, tall = _ends([*families.values()])
    along = FREQUENCY._replace(ends=found)
    return Figure(
        [Panel(along, Axis("|P|", unit, log=True, ends=of_P), plants),
         Panel(along, Axis("|Q|, |L P|", log=True, ends=SHARES), parts),
         Panel(along, Axis("|Q (1 − L P)|", ends=(0, max(1.3, min(1.2 * tall, 5.0)))), sizes)],
        "Whether the Q-filter is safe: |Q (1 − L P)| must stay below 1.",
        size=(7.2, 7.6),
    )  # fmt: skip


def _ends(families: Sequence[Curves]) -> tuple[tuple[float, float], tuple[float, float], float]:
    """Frequencies up to which Q passes anything, |P| within three decades, and the largest test."""
    passed = max(np.max(c.f[np.abs(c.Q) > SEEN], initial=c.f[0]) for c in families)
    lowest = max(min(c.f[0] for c in families), SLOWEST * passed)
    sizes = [np.abs(c.P[(c.f >= lowest) & (c.f <= passed)]) for c in families]
    largest = max(float(np.max(values)) for values in sizes)
    least = min(float(np.min(values)) for values in sizes)
    tall = max(float(np.max(c.high)) for c in families)
    return (lowest, passed), (max(least, FLOOR * largest) / 2, 2 * largest), tall


def _same_plant(one: Curves, other: Curves) -> bool:
    seen = np.interp(one.f, other.f, np.abs(other.P))
    return bool(np.allclose(np.abs(one.P), seen, rtol=0.02))
