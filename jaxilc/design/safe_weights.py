"""Weights that are safe by frequency, and the best of them with the ends of the trial in view."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ..signals.task import Task
from ..theory.on_lines import Change, Lines, largest_cutoff, low_pass
from .responses import Family
from .simulated import notch_of, rms_of

ORDER = 2  # of the robustness filter, in one pass
SHARES = (0.98, 0.75, 0.55, 0.4)  # of the largest cutoff that is allowed
ALIKE = 3  # laws of one lead that are kept
SIMULATED = 96  # laws that are simulated, with the ends of the trial
ROUNDS, STRIDE, SHORTEST = 12, 1.5, 1.06  # of the search around the best one: number, factors
LOWER = 0.998  # share of the error that counts as lower
# of this search: powers of the factor for gain and cutoff, and steps of the lead
STEPS = (
    (1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1),
    (1, -1, 0), (-1, 1, 0), (0, 1, -1), (0, -1, 1), (1, 0, -1), (-1, 0, 1),
)  # fmt: skip
EDGES = ((1, 0), (-1, 0), (0, 1), (0, -1), (-1, 1), (1, -1))  # and for both edges of a notch
NARROWER = 0.25  # power of the factor for an edge


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
    lowest, highest = min(2 / task.duration, 0.05 / task.dt), min(0.45 / task.dt, family.highest)
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


def best_simulated(
    family: Family, found: list[Found], task: Task, trials: int, margin: float
) -> Found:
    """The law of least error where the ends of the trial count too: the best found, and around it.

    What noise adds to each is that of the frequency response. From the best law found the search
    goes on by steps of gain, cutoff and lead, alone and in pairs, that keep the margin and lower
    the error; where none does, the steps become shorter.
    """
    found = found[:SIMULATED]
    sizes = np.abs(family.P).sum(axis=1)
    which = np.unique(np.r_[0, np.argsort(sizes)[:: max(1, len(sizes) // 4)], np.argmax(sizes)])
    loops = [family.loops[i] for i in which]
    quiet = family._replace(error=0 * family.error)

    def errors_of(laws):
        errors = rms_of(loops, family.first_error, laws, task.dt, trials, ORDER)
        noise = [np.max(quiet.rms(*_responses(family, law, task.dt), trials)) for law in laws]
        return np.nan_to_num(np.hypot(np.max(errors, axis=1), noise), nan=np.inf)

    errors = errors_of([one.weights for one in found])
    best, stride = found[int(np.argmin(errors))]._replace(predicted=float(np.min(errors))), STRIDE
    for _ in range(ROUNDS):
        near = [one for law in _around(best.weights, stride, task)
                if (one := _kept(family, law, task.dt, margin))]  # fmt: skip
        errors = errors_of([one.weights for one in near]) if near else np.array([np.inf])
        if np.min(errors) < LOWER * best.predicted:
            best = near[int(np.argmin(errors))]._replace(predicted=float(np.min(errors)))
        elif stride < SHORTEST:
            break
        else:
            stride = stride**0.5
    return best


def _around(weights: dict[str, Any], stride: float, task: Task) -> list[dict[str, Any]]:
    """Laws beside one: its gain, cutoff and edges by a factor, its lead by some samples."""
    lead, cutoff = int(weights["lead"]), weights["cutoff"]
    some = max(1, round(lead * (stride - 1) / 2))
    laws = []
    for gain, width, longer in STEPS:
        changed = weights | {name: weights[name] * stride**gain for name in ("gamma_p", "gamma_d")}
        changed |= {"lead": lead + longer * some, "cutoff": cutoff * stride**width}
        if 0 <= changed["lead"] < task.N // 2 and changed["cutoff"] < 0.45 / task.dt:
            laws.append(changed)
    for steps in EDGES if "low" in weights else ():
        low, high = (
            weights[edge] * stride ** (NARROWER * step)
            for edge, step in zip(("low", "high"), steps, strict=True)
        )
        if low < high < 0.45 / task.dt:
            laws.append(weights | {"low": low, "high": high})
    return laws


def _kept(family: Family, law: dict[str, Any], dt: float, margin: float) -> Found | None:
    """The law with its contraction, or None if it does not keep the margin or the cutoff."""
    if law["cutoff"] > family.highest:
        return None
    largest = float(family.largest(*_responses(family, law, dt)))
    return Found(law, np.inf, largest) if largest <= 1 - margin else None


def _responses(family: Family, law: dict[str, Any], dt: float) -> tuple[np.ndarray, np.ndarray]:
    """(F,) Q and L of a P-type or PD-type law, with its notch if it has one."""
    return low_pass(family.frequencies, law["cutoff"], dt, ORDER), response_of_pd(family, law, dt)


def response_of_pd(family: Family, law, dt: float) -> np.ndarray:
    """(F,) L of a P-type or PD-type law, with its notch if it has one."""
    change = 1 - family.advance(-1, dt)
    L = family.advance(1 + law["lead"], dt) * (law["gamma_p"] + law["gamma_d"] * change)
    if "low" not in law:
        return L
    return L * notch_of(law, np.pi * dt * family.frequencies, dt)
