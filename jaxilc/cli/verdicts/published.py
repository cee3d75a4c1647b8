"""The verdict of `reproduce`: how many numbers are met, and the next command."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from ..reproduction_tables import NEAR, parted
from ..tables import number
from .next_command import Asked, Verdict


def reproduce_verdict(rows: Sequence[dict[str, Any]]) -> Verdict:
    """How many published numbers are met, and which one is farthest from ours.

    rows: rows of `reproduction.reproduce`, as dictionaries
    """
    open_rows = [row for row in rows if row["verdict"] == "open"]
    said = _counted(rows)
    if not rows:
        return Verdict((said,))
    farthest = max(open_rows or rows, key=_off)
    at = f", trial {farthest['trial']}" if farthest["trial"] else ""
    value = f"{farthest['value']:g} {farthest['unit']}".rstrip()
    off = abs(farthest["ratio"] - 1.0)
    ours = (
        f"differs by {off:.2g} of the {value} of other software"
        if farthest["agreement"] is not None and off < NEAR
        else f"is {number(farthest['ratio'])} times the printed {value}"
    )
    second = (
        f"The farthest{' open' if open_rows else ''} one is that of {farthest['scenario']}, "
        f"{farthest['scheme']}{at}: ours {ours}."
    )
    settings = tuple(f"{name}={value}" for name, value in farthest["options"].items())
    asked = Asked(farthest["scenario"], set=settings, trials=farthest["trial"])
    return Verdict((said, second), "that number", asked.following("run", scheme=farthest["scheme"]))


def _counted(rows: Sequence[dict[str, Any]]) -> str:
    """How many numbers of papers are met, and how many of other software agree."""
    of_papers = [row for row in rows if row["agreement"] is None]
    printed = [row["verdict"] for row in of_papers]
    others = [row["verdict"] for row in rows if row["agreement"] is not None]
    said = []
    if printed or not others:
        said.append(
            f"{printed.count('met')} of {len(printed)} published numbers are met within 30 %, "
            f"{printed.count('shape')} in shape, {printed.count('open')} open"
            + (f" ({parted(of_papers)})." if of_papers else ".")
        )
    if others:
        agree = f"{others.count('agrees')} of {len(others)} numbers of other software agree"
        said.append(f"{agree}, {others.count('open')} open.")
    return " ".join(said)


def _off(row: dict[str, Any]) -> float:
    ratio = row["ratio"]
    return abs(math.log(ratio)) if 0 < ratio < math.inf else math.inf
