"""Weights that are safe by frequency, and the best of them with the ends of the trial in view."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ..signals.task import Task
from ..theory.filtered_law import Change, Lines, largest_cutoff, low_pass
from .responses import Family
from .simulated import rms_of

ORDER = 2  # of the robustness filter, in one pass
SHARES = (0.98, 0.75, 0.55, 0.4)  # of the largest cutoff that is allowed
ALIKE = 3  # laws of one lead that are kept
SIMULATED = 96  # laws that are simulated, with the ends of the trial


class Found(NamedTuple):
    """Weights of the least predicted error, with that error and the largest contraction."""

    weights: dict[str, float]
    predicted: float
    largest: float


def widest(family: Family, laws, task: Task, trials: int, margin: float) -> list[Found]:
    """Laws with cutoffs that keep the margin: of each lead the `ALIKE` of least predicted error.

    They come in the order of their predicted errors.

    laws: dictionaries of weights, with the response `L` (F,) of u' = keep (u + L e) before the
        filter, and `keep` where it is not 1
    """
    lowest, highest = min(2 / task.duration, 0.05 / task.dt), 0.45 / task.dt
    still = Change(1.0, 0, np.inf, ORDER)
    found: dict[Any, list[Found]] = {}
    for law in laws:
        L, keep = law.pop("L"), law.pop("keep", np.ones(len(family.frequencies)))
        lines = Lines(family.frequencies, family.P, 0.0 * family.P.real, keep, keep * L, task.dt)
        most = largest_cutoff([lines], still, 1 - margin, lowest)
        for share in SHARES:
            if most is None:
                break
            cutoff = min(share * most, highest)
            with_filter = keep * low_pass(family.frequencies, cutoff, task.dt, ORDER)
            weights = law | {"cutoff": float(cutoff)}
            alike = found.setdefault(law.get("lead"), [])
            _add(family, alike, weights, with_filter, L, trials, margin)
    return sorted((one for alike in found.values() for one in alike), key=lambda one: one.predicted)


def _add(family, alike: list[Found], weights, Q, L, trials, margin) -> None:
    """Add weights that keep the margin to the best ones, if they are among these."""
    full = len(alike) == ALIKE
    if full and alike[-1].predicted <= family.rms(Q, L, trials, [0])[0]:
        return  # without a look at the other machines
    largest = float(family.largest(Q, L))
    if not largest <= 1 - margin:
        return
    predicted = float(np.max(family.rms(Q, L, trials)))
    if not full or predicted < alike[-1].predicted:
        alike.append(Found(weights, predicted, largest))
        alike.sort(key=lambda one: one.predicted)
        del alike[ALIKE:]


def best_simulated(family: Family, found: list[Found], task: Task, trials: int) -> Found:
    """The law of least error where the ends of the trial count too, of those found.

    What noise adds to each is that of the frequency response.
    """
    found = found[:SIMULATED]
    sizes = np.abs(family.P).sum(axis=1)
    which = np.unique(np.r_[0, np.argsort(sizes)[:: max(1, len(sizes) // 4)], np.argmax(sizes)])
    loops = [family.loops[i] for i in which]
    laws = [one.weights for one in found]
    errors = rms_of(loops, family.first_error, laws, task.dt, trials, ORDER)
    quiet = family._replace(error=0 * family.error)
    noise = [
        np.max(quiet.rms(low_pass(family.frequencies, law["cutoff"], task.dt, ORDER),
                         response_of_pd(family, law, task.dt), trials))
        for law in laws
    ]  # fmt: skip
    both = np.hypot(np.max(errors, axis=1), noise)
    at = int(np.argmin(np.nan_to_num(both, nan=np.inf)))
    return found[at]._replace(predicted=float(both[at]))


def response_of_pd(family: Family, law, dt: float) -> np.ndarray:
    """(F,) L of a P-type or PD-type law."""
    change = 1 - family.advance(-1, dt)
    return family.advance(1 + law["lead"], dt) * (law["gamma_p"] + law["gamma_d"] * change)
