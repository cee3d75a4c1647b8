"""A learned law in time and in frequency, beside the inverse of the plant."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from .style import COLOURS, grid, labelled, new_axes

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from ..design import Learned

SHOWN = 1e-3  # share of the largest |L| down to which it is shown
SLOWEST = 2e-4  # of the last frequency
PALEST = 0.4  # opacity of the last segment


def learned_law_figure(learned: Learned, dt: float, *, unit: str = "", ax=None) -> Axes:
    """The taps of L and Q over time, and their responses beside 1 / P; four axes.

    The law is u_{j+1} = Q u_j + L e_j, so that L is Q / P where it inverts the plant. Below stand
    |L| with |1 / P| and |Q / P| of the nominal machine, and |Q| with |Q - L P| of the nominal
    machine and the largest of the family. Of several channels each pair has a colour of its own,
    and the segments of a scheduled law are the paler the later they are; |Q| and |Q - L P| are then
    the largest singular values.

    dt: sample time [s]
    unit: of L, input per output
    Raises ValueError for a law that was refused at its gate, which has no taps.
    """
    if learned.passed is None:
        raise ValueError(f"learned_law_figure: the law was refused: {learned.refused}")
    filters, window, family = learned.passed.filters, learned.window, learned.family
    axes = new_axes(ax, 2, 2, size=(9.0, 6.4), sharex=False)
    L, keep = (_whole(taps, bool(window.starts)) for taps in filters)
    for one, taps, middle, name in (
        (axes[0, 0], L, 1 + window.lead, "L"),
        (axes[0, 1], keep, 0, "Q"),
    ):
        _show_taps(one, taps, middle, dt, name)
    axes[0, 0].set_ylabel(labelled("L", unit))
    f = family.frequencies
    of_L, of_keep = window.responses(f, dt)
    L, keep = (
        np.einsum("fp,spij->sfij", of, taps) for of, taps in ((of_L, L), (of_keep + 0j, keep))
    )
    P = family.P[:, :, None, None] if family.P.ndim == 2 else family.P
    _show_L(axes[1, 0], f, L, keep, P[0], unit)
    _show_sizes(axes[1, 1], f, L, keep, P)
    for one in axes[1]:
        one.set(xlabel="frequency [Hz]", xlim=(max(f[0], SLOWEST * f[-1]), f[-1]))
        one.legend(fontsize="small", loc="best")
    for one in axes.flat:
        grid(one)
    return axes


def _show_taps(ax, taps, middle: int, dt: float, name: str) -> None:
    """The taps (S, p, n, m) over the time by which they look ahead."""
    p = taps.shape[1]
    shift = 1e3 * dt * (middle + np.arange(p) - p // 2)
    for look, label, line in _each(taps, name):
        ax.plot(shift, line, ".-", markersize=3, linewidth=0.8, label=label, **look)
    _key_of_segments(ax, len(taps))
    ax.axvline(0.0, color="k", linewidth=0.8)
    ax.set(xlabel="looks ahead by [ms]", title=f"{p} taps of {name}")
    if taps[:, 0].size > 1:
        ax.legend(fontsize="x-small", loc="best", ncols=2 if taps[0, 0].size > 1 else 1)


def _show_L(ax, f, L, keep, P, unit: str) -> None:
    """|L| of each segment and pair beside |Q / P|, and beside |1 / P| of one channel."""
    alone = L[:, 0].size == 1
    inverse = keep @ np.linalg.pinv(P)
    for values, style, label, colour in (
        (L, "-", "|L|, learned", 0),
        (inverse, "--", "|Q / P|", 1),
    ):
        for look, _, line in _each(values, ""):
            if alone:
                look = {"color": COLOURS[colour], "label": label}
            ax.loglog(f, np.abs(line), style, **look)
        if not alone:
            ax.plot([], [], style, color="0.4", label=label)
    if L[0, 0].size == 1:
        ax.loglog(f, 1 / np.abs(P[:, 0, 0]), ":", color="0.4", label="|1 / P|, the inverse")
    top = np.max(np.abs(L))
    ax.set(ylim=(SHOWN * top, 10 * top), ylabel=labelled("magnitude", unit))


def _show_sizes(ax, f, L, keep, P) -> None:
    """|Q|, |Q - L P| of the nominal machine, and the largest of the family and of all segments."""

    def size(matrices):
        return np.linalg.norm(matrices, ord=2, axis=(-2, -1))

    sizes = np.max([size(Q - one @ P) for Q, one in zip(keep, L, strict=True)], axis=0)
    for i, Q in enumerate(size(keep)):
        label = "|Q|" if len(keep) == 1 else f"|Q|, segment {i + 1}"
        ax.semilogx(f, Q, "--", color="0.2", alpha=_opacity(i, len(keep)), label=label)
    ax.semilogx(f, sizes[0], color=COLOURS[0], label="|Q − L P|, nominal")
    ax.semilogx(f, np.max(sizes, axis=0), color=COLOURS[1], label=f"largest of {len(P)}")
    ax.axhline(1.0, color="k", linewidth=0.8)
    ax.set(ylim=(0, 1.25), ylabel="magnitude")


def _each(values, name: str) -> list[tuple[dict[str, Any], str | None, np.ndarray]]:
    """Look, label and line of each segment and pair of channels of values (S, K, n, m).

    The label names the pair, once for all segments.
    """
    S, _, n, m = values.shape
    found = []
    for s in range(S):
        for pair, (i, j) in enumerate(np.ndindex(n, m)):
            look = {"color": COLOURS[pair % len(COLOURS)], "alpha": _opacity(s, S)}
            label = f"{name}{i + 1}{j + 1}" if n * m > 1 else name
            found.append((look, None if s else label, values[s, :, i, j]))
    return found


def _key_of_segments(ax, segments: int) -> None:
    for s in range(segments if segments > 1 else 0):
        ax.plot([], [], color="0.2", alpha=_opacity(s, segments), label=f"segment {s + 1}")


def _opacity(segment: int, segments: int) -> float:
    return float(np.linspace(1.0, PALEST, segments)[segment])


def _whole(taps, scheduled: bool) -> np.ndarray:
    """Taps as (S, p, n, m), also of one segment and of one channel."""
    taps = np.asarray(taps, float)
    taps = taps if scheduled else taps[None]
    return taps if taps.ndim == 4 else taps[:, :, None, None]
