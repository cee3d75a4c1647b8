"""The verdict of `reproduce`: how many numbers are met, and the next command."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from ..tables import number
from .next_command import Asked, Verdict


def reproduce_verdict(rows: Sequence[dict[str, Any]]) -> Verdict:
    """How many published numbers are met, and which one is farthest from ours.

    rows: rows of `reproduction.reproduce`, as dictionaries
    """
    met = sum(row["verdict"] == "met" for row in rows)
    open_rows = [row for row in rows if row["verdict"] == "open"]
    said = (
        f"{met} of {len(rows)} published numbers are met within 30 %, "
        f"{len(rows) - met - len(open_rows)} in shape, {len(open_rows)} open."
    )
    if not rows:
        return Verdict((said,))
    farthest = max(open_rows or rows, key=_off)
    at = f", trial {farthest['trial']}" if farthest["trial"] else ""
    second = (
        f"The farthest{' open' if open_rows else ''} one is that of {farthest['scenario']}, "
        f"{farthest['scheme']}{at}: ours is {number(farthest['ratio'])} times the printed "
        f"{farthest['value']:g} {farthest['unit']}".rstrip()
        + "."
    )
    settings = tuple(f"{name}={value}" for name, value in farthest["options"].items())
    asked = Asked(farthest["scenario"], set=settings, trials=farthest["trial"])
    return Verdict((said, second), "that number", asked.following("run", scheme=farthest["scheme"]))


def _off(row: dict[str, Any]) -> float:
    ratio = row["ratio"]
    return abs(math.log(ratio)) if 0 < ratio < math.inf else math.inf
