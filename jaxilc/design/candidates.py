"""The learning laws that a design tries, each with weights that the frequency responses allow.

Each law has a few weights. A grid of them is looked at in frequency, over all machines of a
`Family` at once. Kept are the weights with the smallest predicted error among those for which

    |Q (1 - L P)| <= 1 - margin    at each frequency, on each machine

Of P-type and PD-type laws the best by this prediction are simulated (`simulated`), since their lead
costs the end of the trial.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from ..filters import ZeroPhaseBandStop, ZeroPhaseButterworth
from ..filters.inversion import stable_inverse
from ..plants import StateSpace
from ..schemes import (
    ErrorFiltered,
    Filtered,
    NormOptimal,
    PIDType,
    Scheme,
    WithFeedback,
    learning_filter,
)
from ..signals.task import Task
from ..theory.loop import minimal
from .responses import Family, resonance_band
from .safe_weights import ORDER, Found, best_simulated, response_of_pd, widest

GAINS = (0.1, 0.2, 0.35, 0.5, 0.7, 0.85, 1.0)  # of the inverse of the largest steady gain
INVERSE_GAINS = (0.2, 0.35, 0.5, 0.7, 0.85, 1.0)
RATES = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0)  # derivative times, in samples times 1 + lead
LEADS, LONGEST = 36, 500  # number of leads tried, and the longest [samples]
NOTCHES = (1.05, 1.25)  # factors from the resonances of the machines to the edges tried at first
WIDER = 4.0  # factor by which a tuning may change a weight, to either side
TOLERANCES = (1e-9, 1e-7, 1e-5, 1e-4)  # shares of the largest tap that are left out
EDGES_WIDER, APART = 1.5, 1.001  # the same for the edges of a notch, which stay apart
FREER = 100.0  # the same for the weights of norm-optimal learning


class Candidate(NamedTuple):
    """A law with weights that are safe by its frequency response.

    name:    such as p-type
    words:   what the law is, in a few words
    scheme:  with its feedback, if the machine has one
    bounds:  {name of a weight: (low, high)} within which it may be tuned
    largest: |Q (1 - L P)| at its largest, over the machines and frequencies of the family
    predicted: root mean square error of the last trial, of the worst machine, with the weights that
        frequency allows [unit of y]
    """

    name: str
    words: str
    scheme: Scheme
    bounds: dict[str, tuple[float, float]]
    largest: float
    predicted: float


class Absent(NamedTuple):
    """A law for which no safe weights were found, and why."""

    name: str
    why: str


def candidates(
    family: Family,
    feedback: Scheme | None,
    task: Task,
    trials: int,
    margin: float,
    names: Sequence[str],
) -> Iterator[Candidate | Absent]:
    """Each of the laws with its safe weights, or the reason why it has none.

    trials: number of the trial whose error is predicted
    margin: least distance of |Q (1 - L P)| from 1
    names: of `LAWS`
    """
    for name in names:
        found = LAWS[name](family, feedback, task, trials, margin)
        yield found if isinstance(found, Absent) else found._replace(name=name)


# The laws
# --------------------------------------------------------------------------------------------------


def p_type(family, feedback, task, trials, margin) -> Candidate | Absent:
    """Q (u + gamma_p z^(1 + lead) e)"""
    return _pd_type(family, feedback, task, trials, margin, derivative=False)


def pd_type(family, feedback, task, trials, margin) -> Candidate | Absent:
    """Q (u + z^(1 + lead) (gamma_p + gamma_d (1 - z^-1)) e)"""
    return _pd_type(family, feedback, task, trials, margin, derivative=True)


def p_type_notch(family, feedback, task, trials, margin) -> Candidate | Absent:
    """Q (u + gamma_p z^(1 + lead) F e), where F stops the band of the highest resonance"""
    band = resonance_band(family, task.dt)
    if band is None:
        return Absent("p-type-notch", "no machine has a lightly damped resonance")
    if _sign(family) == 0:
        return Absent("p-type-notch", _NO_SIGN)
    found = [
        one
        for wider in NOTCHES
        if band[1] * wider < 0.45 / task.dt
        and (one := _best_pd(family, task, trials, margin, (0.0,), band / [wider, 1 / wider]))
    ]
    if not found:
        return Absent("p-type-notch", _NO_WEIGHTS)
    best = min(found, key=lambda one: one.predicted)
    low, high = best.weights["low"], best.weights["high"]
    learning = ErrorFiltered(_pid_type(best, ("gamma_p",)), ZeroPhaseBandStop(low, high))
    middle = (low * high) ** 0.5
    bounds = {
        "scheme.scheme.gamma_p": _around(best.weights["gamma_p"]),
        "scheme.filter.low": (low / EDGES_WIDER, min(low * EDGES_WIDER, middle / APART)),
        "scheme.filter.high": (
            max(high / EDGES_WIDER, middle * APART),
            min(high * EDGES_WIDER, 0.49 / task.dt),
        ),
    }
    words = "P-type with lead, a notch around the resonance, and filter"
    return _candidate(words, learning, best, feedback, bounds, task, family.highest)


def model_inverse(family, feedback, task, trials, margin) -> Candidate | Absent:
    """u' = Q u + gamma (Q P^-1) e, with the stable inverse of the nominal loop.

    Q P^-1 is one filter. If P^-1 came first and was cut off at the end of the trial, as in
    Q (u + gamma P^-1 e), what the inverse makes of the jump there would not be smoothed by Q, and
    learning diverges from the end of the trial after some hundred trials.
    """
    try:
        inverse = stable_inverse(_model(family, task))
    except ValueError as error:
        return Absent("model-inverse", str(error))
    L = 1 / family.P[0]
    found = widest(
        family,
        ({"gamma_p": gain, "L": gain * L} for gain in INVERSE_GAINS),
        task,
        trials,
        margin,
    )
    if not found:
        return Absent("model-inverse", _NO_WEIGHTS)
    gain, cutoff = (found[0].weights[name] for name in ("gamma_p", "cutoff"))
    for tolerance in TOLERANCES:
        try:
            law = learning_filter(
                inverse, ZeroPhaseButterworth(cutoff, ORDER), gain=gain, tolerance=tolerance
            )
            law.check(task)
        except ValueError as error:
            why = str(error)
            continue
        words = f"model inverse with a filter as one, gain = {gain:.3g}, cutoff = {cutoff:.4g} Hz"
        scheme = _under(law, feedback)
        return Candidate("model-inverse", words, scheme, {}, found[0].largest, found[0].predicted)
    return Absent("model-inverse", why)


def norm_optimal(family, feedback, task, trials, margin) -> Candidate | Absent:
    """Q argmin |e|^2 + w_r |u' - u|^2 + w_s |u'|^2, by the nominal loop"""
    G = family.P[0]
    size = float(np.max(np.abs(G))) ** 2

    def laws():
        for w_r in size * np.geomspace(1e-4, 1e0, 5):
            for w_s in size * np.geomspace(1e-8, 1e-2, 4):
                keep = (np.abs(G) ** 2 + w_r) / (np.abs(G) ** 2 + w_r + w_s)
                L = np.conj(G) / (np.abs(G) ** 2 + w_r)
                yield {"w_r": float(w_r), "w_s": float(w_s), "L": L, "keep": keep}

    found = widest(family, laws(), task, trials, margin)
    if not found:
        return Absent("norm-optimal", _NO_WEIGHTS)
    found = found[0]
    weights = {w: found.weights[w] for w in ("w_r", "w_s")}
    learning = NormOptimal(_model(family, task), w_r=weights["w_r"], w_s=weights["w_s"])
    bounds = {f"scheme.{w}": (value / FREER, value * FREER) for w, value in weights.items()}
    words = "norm-optimal by the nominal model, with a filter"
    return _candidate(words, learning, found, feedback, bounds, task, family.highest)


LAWS: dict[str, Callable[..., Candidate | Absent]] = {
    "p-type": p_type,
    "pd-type": pd_type,
    "p-type-notch": p_type_notch,
    "model-inverse": model_inverse,
    "norm-optimal": norm_optimal,
}
_NO_WEIGHTS = "no weights keep the margin on every machine"
_NO_SIGN = "the sign of the steady gain is not the same on all machines"


# How it is done
# --------------------------------------------------------------------------------------------------


def _pd_type(family, feedback, task, trials, margin, *, derivative: bool) -> Candidate | Absent:
    name = "pd-type" if derivative else "p-type"
    if _sign(family) == 0:
        return Absent(name, _NO_SIGN)
    found = _best_pd(family, task, trials, margin, RATES if derivative else (0.0,))
    if found is None:
        return Absent(name, _NO_WEIGHTS)
    names = ("gamma_p", "gamma_d")[: 1 + derivative]
    bounds = {f"scheme.{w}": _around(found.weights[w]) for w in names}
    words = f"{name[:-5].upper()}-type with lead and filter"
    return _candidate(words, _pid_type(found, names), found, feedback, bounds, task, family.highest)


def _best_pd(family, task, trials, margin, rates, band=None) -> Found | None:
    """The best P-type or PD-type law by simulation, with a notch if a band (low, high) is given."""
    size = _sign(family) / np.max(np.abs(family.P[:, 0].real))
    longest = max(1, min(LONGEST, task.N // 8))
    leads = np.unique(np.r_[0, np.geomspace(1, longest, LEADS).astype(int)])
    notch = {} if band is None else dict(zip(("low", "high"), map(float, band), strict=True))

    def laws():
        for lead in map(int, leads):
            for gain in GAINS:
                for rate in rates:
                    gamma_p = float(size * gain)
                    law = {"gamma_p": gamma_p, "gamma_d": gamma_p * rate * (1 + lead), "lead": lead}
                    yield law | notch | {"L": response_of_pd(family, law | notch, task.dt)}

    found = widest(family, laws(), task, trials, margin)
    return best_simulated(family, found, task, trials, margin) if found else None


def _sign(family) -> float:
    """The sign of the steady gain, 0 if it is not the same on all machines."""
    steady = family.P[:, 0].real
    return 0.0 if np.any(steady * steady[0] <= 0) else float(np.sign(steady[0]))


def _pid_type(found: Found, names: Sequence[str]) -> PIDType:
    return PIDType(**{w: found.weights[w] for w in names}, lead=int(found.weights["lead"]))


def _candidate(words, learning, found: Found, feedback, bounds, task, highest: float) -> Candidate:
    """A law under the robustness filter whose cutoff was found, with a bound of it at most."""
    cutoff = found.weights["cutoff"]
    scheme = Filtered(learning, ZeroPhaseButterworth(cutoff=cutoff, order=ORDER))
    bounds["filter.cutoff"] = (cutoff / WIDER, min(cutoff * WIDER, 0.49 / task.dt, highest))
    return Candidate(
        "",
        words,
        _under(scheme, feedback),
        _named(bounds, feedback),
        found.largest,
        found.predicted,
    )


def _around(value: float) -> tuple[float, float]:
    low, high = sorted((value / WIDER, value * WIDER))
    return low, high


def _under(scheme: Scheme, feedback: Scheme | None) -> Scheme:
    return scheme if feedback is None else WithFeedback(scheme, feedback)


def _named(bounds: dict[str, Any], feedback: Scheme | None) -> dict[str, Any]:
    """The bounds by the names that the weights have under the feedback."""
    return bounds if feedback is None else {f"learning.{w}": b for w, b in bounds.items()}


def _model(family: Family, task: Task) -> StateSpace:
    return StateSpace(*minimal(family.loops[0], task.N), dt=task.dt)
