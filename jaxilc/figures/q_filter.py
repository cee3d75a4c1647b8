"""Whether a Q-filter is safe: plant, filter, L P and |Q (1 - L P)| of a family over frequency."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from .style import grid, labelled, legend_beside, new_axes, style_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from ..theory.q_filter import Curves

SEEN = 1e-2  # |Q| below which nothing of L P is shown
SLOWEST = 1e-3  # of the last frequency shown
FLOOR = 1e-3  # least magnitude of P shown, against the largest
SHARES = (0.01, 10.0)  # of |Q| and |L P| that are shown


def q_filter_figure(
    families: Mapping[str, Curves], *, margin: float = 0.0, unit: str = "", ax=None
) -> Axes:
    """|P|, then |Q| and |L P|, then |Q (1 - L P)| with its band, against frequency; three axes.

    The band is from the least to the largest value of the family; of a measured response it is its
    scatter. The largest value is marked. The frequencies shown end where |Q| has fallen to 0.01.

    families: curves by name, from `theory.q_filter`
    margin:   that was asked for; 0 for no line
    unit:     of P, output per input
    """
    axes = new_axes(ax, 3, size=(7.2, 7.6))
    for i, (name, curves) in enumerate(families.items()):
        f, style = curves.f, style_of(i)
        if not any(_same_plant(curves, other) for other in list(families.values())[:i]):
            axes[0].loglog(f, np.abs(curves.P), **style, label=name)
        LP = np.where(np.abs(curves.Q) > SEEN, np.abs(curves.LP), np.nan)
        axes[1].loglog(f, LP, **style, label=f"|L P|, {name}")
        shade = {"color": str(0.5 * i / len(families)), "linestyle": style["linestyle"]}
        axes[1].loglog(f, np.abs(curves.Q), **shade, label=f"|Q|, {name}")
        top = int(np.argmax(curves.high))
        peak = f"{curves.high[top]:.3g} at {f[top]:.3g} Hz"
        axes[2].semilogx(f, curves.nominal, **style, label=f"{name}\nat most {peak}")
        axes[2].fill_between(f, curves.low, curves.high, color=style["color"], alpha=0.2, lw=0)
        axes[2].plot(f[top], curves.high[top], "o", color=style["color"], markersize=5)
    first = next(iter(families.values()))
    axes[2].semilogx(
        first.f, first.without, color="0.5", linestyle=":", label="|1 − L P| without Q,\nlargest"
    )
    axes[2].axhline(1.0, color="k", linewidth=0.8)
    if margin:
        axes[2].axhline(1 - margin, color="k", linewidth=0.8, linestyle="--")
    _limits(axes, list(families.values()))
    axes[0].set_ylabel(labelled("|P|", unit))
    axes[1].set_ylabel("|Q|, |L P|")
    axes[2].set(ylabel="|Q (1 − L P)|", xlabel="frequency [Hz]")
    for axis in axes:
        grid(axis)
        legend_beside(axis)
    return axes


def _limits(axes, families) -> None:
    """Frequencies up to which Q passes anything, and magnitudes within three decades."""
    passed = max(np.max(c.f[np.abs(c.Q) > SEEN], initial=c.f[0]) for c in families)
    lowest = max(min(c.f[0] for c in families), SLOWEST * passed)
    axes[0].set_xlim(lowest, passed)
    sizes = [np.abs(c.P[(c.f >= lowest) & (c.f <= passed)]) for c in families]
    largest = max(float(np.max(values)) for values in sizes)
    least = min(float(np.min(values)) for values in sizes)
    axes[0].set_ylim(max(least, FLOOR * largest) / 2, 2 * largest)
    axes[1].set_ylim(*SHARES)
    tall = max(float(np.max(c.high)) for c in families)
    axes[2].set_ylim(0, max(1.3, min(1.2 * tall, 5.0)))


def _same_plant(one: Curves, other: Curves) -> bool:
    seen = np.interp(one.f, other.f, np.abs(other.P))
    return bool(np.allclose(np.abs(one.P), seen, rtol=0.02))
