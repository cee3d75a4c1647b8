"""What may be asked of the learning of a law."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..pytree.closest import not_one_of
from ..pytree.ranges import require

STARTS = {
    "safe": ("p-type", "pd-type", "p-type-notch", "model-inverse"),
    "p-type": ("p-type",),
    "inverse": ("model-inverse",),
    "nothing": (),
}


def check_settings(asked: Any) -> None:
    """Raises ValueError for a `LearnedLaw`, naming the setting, its value and what is allowed."""
    require("LearnedLaw", "margin", asked.margin, "(0, 0.9)")
    for name, least in (("trained_on", 1), ("held_out", 0), ("steps", 0)):
        require("LearnedLaw", name, getattr(asked, name), f"[{least}, inf)", whole=True)
    if asked.start not in STARTS:
        raise ValueError(not_one_of(f"start = {asked.start!r}", asked.start, STARTS))
    if asked.task.inputs * asked.task.outputs > 1 and asked.start in ("p-type", "inverse"):
        raise ValueError(
            f"LearnedLaw: start = {asked.start!r} is not possible with {asked.task.inputs} inputs "
            f"and {asked.task.outputs} outputs; allowed is 'nothing'"
        )
    if asked.limit is not None:
        require("LearnedLaw", "limit", float(np.min(asked.limit)), "(0, inf)")
    most = min(1001, 2 * ((asked.task.N - 1) // 2) - 1)
    if len(asked.taps) != 2 or any(
        n != int(n) or n % 2 == 0 or not 1 <= n <= most for n in asked.taps
    ):
        raise ValueError(
            f"LearnedLaw: taps = {asked.taps} are not allowed; allowed are two odd numbers, of "
            f"L and of Q, from 1 to {most} for a trial of {asked.task.N} samples"
        )
    places = (0, *asked.starts, asked.task.N)
    if any(k != int(k) for k in places) or np.any(np.diff(places) <= 0):
        raise ValueError(
            f"LearnedLaw: starts = {asked.starts} are not allowed; allowed are whole samples "
            f"that rise within a trial of {asked.task.N}"
        )
