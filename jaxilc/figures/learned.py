"""A learned law in time and in frequency, beside the inverse of the plant."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from .description import FREQUENCY, Axis, Curve, Figure, Layer, Panel, Rule
from .paper import drawn
from .style import COLOURS, GREY, colour_of

if TYPE_CHECKING:
    from ..design import Learned

SHOWN = 1e-3  # share of the largest |L| down to which it is shown
SLOWEST = 2e-4  # of the last frequency
DARK = "#333333"
PALEST = 0.4  # opacity of the last segment


@drawn
def learned_law_figure(learned: Learned, dt: float, *, unit: str = "") -> Figure:
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
    L, keep = (_whole(taps, bool(window.starts)) for taps in filters)
    taps = [_taps(L, 1 + window.lead, dt, "L", unit), _taps(keep, 0, dt, "Q", "")]
    f = family.frequencies
    of_L, of_keep = window.responses(f, dt)
    L, keep = (
        np.einsum("fp,spij->sfij", of, taps) for of, taps in ((of_L, L), (of_keep + 0j, keep))
    )
    P = family.P[:, :, None, None] if family.P.ndim == 2 else family.P
    along, top = FREQUENCY._replace(ends=(max(f[0], SLOWEST * f[-1]), f[-1])), np.max(np.abs(L))
    of_law = Axis("magnitude", unit, log=True, ends=(SHOWN * top, 10 * top))
    of_sizes = Axis("magnitude", ends=(0, 1.25))
    return Figure(
        [*taps, Panel(along, of_law, _inverses(f, L, keep, P[0]), legend="best"),
         Panel(along, of_sizes, _sizes(f, L, keep, P), legend="best")],
        "The law in time, the look-ahead of each tap, and in frequency, beside the inverse of the "
        "plant.",
        columns=2, size=(9.0, 6.4), shares="",
    )  # fmt: skip


def _taps(taps, middle: int, dt: float, name: str, unit: str) -> Panel:
    """The taps (S, p, n, m) over the time by which they look ahead."""
    p = taps.shape[1]
    shift = 1e3 * dt * (middle + np.arange(p) - p // 2)
    look: dict[str, Any] = {"mark": ".", "size": 3, "width": 0.8}
    layers: list[Layer] = [Curve(shift, line, **look, **of) for of, line in _each(taps, name)]
    layers += [
        Curve([], [], colour=GREY, alpha=_opacity(s, len(taps)), name=f"segment {s + 1}")
        for s in range(len(taps) if len(taps) > 1 else 0)
    ]
    layers.append(Rule(0.0, "x"))
    several = taps[:, 0].size > 1
    return Panel(
        Axis("looks ahead by [ms]"), Axis("L" * (name == "L"), unit), layers, f"{p} taps of {name}",
        "best" if several else "", 2 if taps[0, 0].size > 1 else 1,
    )  # fmt: skip


def _inverses(f, L, keep, P) -> list[Layer]:
    """|L| of each segment and pair beside |Q / P|, and beside |1 / P| of one channel."""
    alone, layers = L[:, 0].size == 1, []
    for values, dash, name, colour in (
        (L, "-", "|L|, learned", COLOURS[0]),
        (keep @ np.linalg.pinv(P), "--", "|Q / P|", COLOURS[1]),
    ):
        for look, line in _each(values, ""):
            look |= {"colour": colour, "name": name} if alone else {}
            layers.append(Curve(f, np.abs(line), dash, **look))
        if not alone:
            layers.append(Curve([], [], dash, colour=GREY, name=name))
    if L[0, 0].size == 1:
        inverse = 1 / np.abs(P[:, 0, 0])
        layers.append(Curve(f, inverse, ":", colour=GREY, name="|1 / P|, the inverse"))
    return layers


def _sizes(f, L, keep, P) -> list[Layer]:
    """|Q|, |Q - L P| of the nominal machine, and the largest of the family and of all segments."""

    def size(matrices):
        return np.linalg.norm(matrices, ord=2, axis=(-2, -1))

    sizes = np.max([size(Q - one @ P) for Q, one in zip(keep, L, strict=True)], axis=0)
    layers: list[Layer] = []
    for i, Q in enumerate(size(keep)):
        name = "|Q|" if len(keep) == 1 else f"|Q|, segment {i + 1}"
        pale = _opacity(i, len(keep))
        layers.append(Curve(f, Q, "--", colour=DARK, alpha=pale, name=name))
    largest = np.max(sizes, axis=0)
    return [
        *layers,
        Curve(f, sizes[0], name="|Q − L P|, nominal"),
        Curve(f, largest, colour=COLOURS[1], name=f"largest of {len(P)}"),
        Rule(1.0),
    ]


def _each(values, name: str) -> list[tuple[dict[str, Any], np.ndarray]]:
    """Look and line of each segment and pair of channels of values (S, K, n, m).

    The name tells the pair, in the first segment.
    """
    S, _, n, m = values.shape
    found = []
    for s in range(S):
        for pair, (i, j) in enumerate(np.ndindex(n, m)):
            label = f"{name}{i + 1}{j + 1}" if n * m > 1 else name
            look = {"colour": colour_of(pair), "alpha": _opacity(s, S), "name": label * (not s)}
            found.append((look, values[s, :, i, j]))
    return found


def _opacity(segment: int, segments: int) -> float:
    return float(np.linspace(1.0, PALEST, segments)[segment])


def _whole(taps, scheduled: bool) -> np.ndarray:
    """Taps as (S, p, n, m), also of one segment and of one channel."""
    taps = np.asarray(taps, float)
    taps = taps if scheduled else taps[None]
    return taps if taps.ndim == 4 else taps[:, :, None, None]
