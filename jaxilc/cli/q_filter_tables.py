"""Tables, sentences and numbers of `jaxilc filter`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from .tables import number
from .titled_table import Table

if TYPE_CHECKING:
    from ..theory.filtered_law import Change
    from ..theory.q_filter import Curves, Offer

PASSED = 0.1  # |Q| from which on a resonance lies inside the band


def answer_table(title: str, rows: Sequence[tuple[str, str]]) -> Table:
    """The table of what was found, a row for each."""
    table = Table(title=title, show_header=False)
    table.add_column()
    table.add_column()
    for row in rows:
        table.add_row(*row)
    return table


def offers_table(now: Offer, offers: Sequence[Offer], margin: float, scale=1.0, unit="") -> Table:
    """The table of how far the law may go; the error that is left only where it is known."""
    known = any(np.isfinite(one.floor) for one in (now, *offers))
    table = Table(title=f"how far it may go with a margin of {margin:g}, and what that buys")
    table.add_column("law")
    table.add_column("set")
    table.add_column("largest", justify="right")
    table.add_column("learned to 1/10 up to", justify="right")
    if known:
        table.add_column(f"rms left [{unit or 'y'}]", justify="right")
    for one in (now, *offers):
        reach = f"{number(one.learned_up_to)} Hz" if one.peak < 1 else "–"
        left = [number(scale * one.floor)] if known else []
        table.add_row(
            one.what,
            changes_said(one),
            number(one.peak),
            reach,
            *left,
        )
    return table


def changes_said(one: Offer) -> str:
    """What an offer sets, and the filter that it adds where the law has none."""
    parts = settings_of(one.settings)
    if one.adds_filter:
        parts.append(f"a filter of {one.change.cutoff:g} Hz")
    return ", ".join(parts) or "–"


def settings_of(values: Mapping[str, Any], before: str = "") -> list[str]:
    """Values as `--set` takes them."""
    return [f"{before}{path}={_plain(value)}" for path, value in values.items()]


def _plain(value) -> str:
    array = np.asarray(value)
    if array.ndim:
        return "[" + ",".join(f"{v:.4g}" for v in array) + "]"
    return f"{array.item():.6g}"


def inside(curves: Curves, frequencies: Sequence[float]) -> list[bool]:
    """Whether the filter passes a frequency."""
    return [bool(np.interp(f, curves.f, np.abs(curves.Q)) > PASSED) for f in frequencies]


def first_above(curves: Curves) -> str:
    """Where |1 - L P| first exceeds 1 without the filter, in words."""
    at = curves.first_above
    return f"from {number(at)} Hz" if np.isfinite(at) else "nowhere"


def best_of(offers: Sequence[Offer]) -> Offer | None:
    """The offer that learns furthest."""
    return max(offers, key=lambda one: one.learned_up_to, default=None)


def offer_numbers(one: Offer, scale: float = 1.0) -> dict[str, Any]:
    """An offer as JSON; the error that is left in the unit shown."""
    change: Change = one.change
    return {
        "what": one.what,
        "set": {path: np.asarray(value).tolist() for path, value in one.settings.items()},
        "gain_factor": change.gain,
        "lead_change": change.lead,
        "cutoff": change.cutoff,
        "peak": one.peak,
        "margin": 1 - one.peak,
        "learned_to_a_tenth_up_to": one.learned_up_to,
        "rms_left": scale * one.floor,
    }


def curve_numbers(curves: Curves) -> dict[str, list[float]]:
    """The curves of the figure as JSON."""
    found = {name: getattr(curves, name).tolist() for name in ("f", "nominal", "low", "high")}
    return found | {"Q": np.abs(curves.Q).tolist(), "LP": np.abs(curves.LP).tolist()}


def intervals_said(uncertainty: Mapping[str, Any]) -> str:
    """The uncertainty in words, as `plant.gain ±15 %`."""
    parts = []
    for name, d in uncertainty.items():
        low, high = sorted(map(float, d.corners()))
        even = d.relative and abs((low + high) / 2 - 1) < 1e-9
        parts.append(
            f"{name} ±{50 * (high - low):.3g} %"
            if even
            else f"{name} {'x ' if d.relative else ''}{low:.4g} to {high:.4g}"
        )
    return " and ".join(parts)


def machine_said(at: Mapping[str, float], uncertainty: Mapping[str, Any]) -> str:
    """The numbers of a machine in words; relative ones as factors."""
    return ", ".join(
        f"{name} {'x ' if uncertainty[name].relative else '= '}{value:.4g}"
        for name, value in at.items()
    )
