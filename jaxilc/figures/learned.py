"""A learned law in time and in frequency, beside the inverse of the plant."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .style import COLOURS, grid, labelled, new_axes

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from ..design import Learned

SHOWN = 1e-3  # share of the largest |L| down to which it is shown
SLOWEST = 2e-4  # of the last frequency


def learned_law_figure(learned: Learned, dt: float, *, unit: str = "", ax=None) -> Axes:
    """The taps of L and Q over time, and their responses beside 1 / P; four axes.

    The law is u_{j+1} = Q u_j + L e_j, so that L is Q / P where it inverts the plant. Below stand
    |L| with |1 / P| and |Q / P| of the nominal machine, and |Q| with |Q - L P| of the nominal
    machine and the largest of the family.

    dt: sample time [s]
    unit: of L, input per output
    Raises ValueError for a law that was refused at its gate, which has no taps.
    """
    if learned.passed is None:
        raise ValueError(f"learned_law_figure: the law was refused: {learned.refused}")
    filters, window, family = learned.passed.filters, learned.window, learned.family
    axes = new_axes(ax, 2, 2, size=(9.0, 6.4), sharex=False)
    for one, taps, middle, name in (
        (axes[0, 0], filters.L, 1 + window.lead, "L"),
        (axes[0, 1], filters.keep, 0, "Q"),
    ):
        shift = 1e3 * dt * (middle + np.arange(len(taps)) - len(taps) // 2)
        one.plot(shift, taps, ".-", color=COLOURS[0], markersize=3, linewidth=0.8)
        one.axvline(0.0, color="k", linewidth=0.8)
        one.set(xlabel="looks ahead by [ms]", title=f"{len(taps)} taps of {name}")
    axes[0, 0].set_ylabel(labelled("L", unit))
    f, P = family.frequencies, family.P
    of_L, of_keep = window.responses(f, dt)
    L, Q = of_L @ filters.L, of_keep @ filters.keep
    sizes = np.abs(Q - L * P)
    below, right = axes[1]
    below.loglog(f, np.abs(L), color=COLOURS[0], label="|L|, learned")
    below.loglog(f, np.abs(Q / P[0]), "--", color=COLOURS[1], label="|Q / P|")
    below.loglog(f, 1 / np.abs(P[0]), ":", color="0.4", label="|1 / P|, the inverse")
    top = np.max(np.abs(L))
    below.set(ylim=(SHOWN * top, 10 * top), ylabel=labelled("magnitude", unit))
    right.semilogx(f, np.abs(Q), color="0.4", linestyle="--", label="|Q|")
    right.semilogx(f, sizes[0], color=COLOURS[0], label="|Q − L P|, nominal")
    right.semilogx(f, np.max(sizes, axis=0), color=COLOURS[1], label=f"largest of {len(P)}")
    right.axhline(1.0, color="k", linewidth=0.8)
    right.set(ylim=(0, 1.25), ylabel="magnitude")
    for one in (below, right):
        one.set(xlabel="frequency [Hz]", xlim=(max(f[0], SLOWEST * f[-1]), f[-1]))
    for one in axes.flat:
        grid(one)
    below.legend(fontsize="small", loc="lower left")
    right.legend(fontsize="small", loc="best")
    return axes
