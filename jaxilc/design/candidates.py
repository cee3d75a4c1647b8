"""The learning laws that a design tries, each with weights that the frequency responses allow.

Each law has a few weights. A grid of them is looked at in frequency, over all machines of a
`Family` at once. Kept are the weights with the smallest predicted error among those for which

    |Q (1 - L P)| <= 1 - margin    at each frequency, on each machine

Of P-type and PD-type laws the best by this prediction are simulated (`simulated`), since their
lead costs the end of the trial, and compared by the metric that judges, if it is an error.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import NamedTuple, TypeAlias

import jax
import numpy as np
import scipy.fft

from ..filters import ZeroPhaseBandStop, ZeroPhaseButterworth
from ..filters.inversion import stable_inverse
from ..plants import StateSpace
from ..pytree.named_paths import get_at, replaced
from ..schemes import ErrorFiltered, Filtered, NormOptimal, PIDType, Scheme, learning_filter
from ..signals.task import Task, Trial
from ..theory.law import law_of
from ..theory.loop import Loop, impulse_blocks, minimal
from ..theory.on_lines import Change, Lines, largest_cutoff, low_pass
from ..tuning import Tuning
from ..tuning.objectives import EveryTrial, Holding, Objective
from ..tuning.over_family import OverFamily
from ..tuning.risks import CVaR
from .responses import Family, resonance_band, under

GAINS = (0.1, 0.2, 0.35, 0.5, 0.7, 0.85, 1.0)  # of the inverse of the largest steady gain
INVERSE_GAINS = (0.2, 0.35, 0.5, 0.7, 0.85, 1.0)
RATES = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0)  # derivative times, in samples times 1 + lead
LEADS, LONGEST = 36, 500  # number of leads tried, and the longest [samples]
NOTCHES = (1.05, 1.25)  # factors from the resonances of the machines to the edges tried at first
WIDER = 4.0  # factor by which a tuning may change a weight, to either side
TOLERANCES = (1e-9, 1e-7, 1e-5, 1e-4)  # shares of the largest tap that are left out
EDGES_WIDER, APART = 1.5, 1.001  # the same for the edges of a notch, which stay apart
FREER = 100.0  # the same for the weights of norm-optimal learning
Bounds: TypeAlias = dict[str, tuple[float, float]]


class Candidate(NamedTuple):
    """A law with weights that are safe by its frequency response.

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
    bounds: Bounds
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
    """Each of the laws of these names with its safe weights, or the reason why it has none."""
    within = "" if feedback is None else "learning."
    for name in names:
        found = LAWS[name](family, task, trials, margin)
        if isinstance(found, str):
            yield Absent(name, found)
            continue
        bounds = {within + weight: ends for weight, ends in found.bounds.items()}
        yield found._replace(name=name, scheme=under(found.scheme, feedback), bounds=bounds)


# The laws without feedback, each with its safe weights, or why it has none
# --------------------------------------------------------------------------------------------------


def pd_type(family, task, trials, margin, *, derivative=True) -> Candidate | str:
    """Q (u + z^(1 + lead) (gamma_p + gamma_d (1 - z^-1)) e); P-type without the derivative."""
    if _sign(family) == 0:
        return _NO_SIGN
    found = _best_pd(family, task, trials, margin, RATES if derivative else (0.0,))
    if found is None:
        return _NO_WEIGHTS
    names = ("gamma_p", "gamma_d")[: 1 + derivative]
    bounds = {f"scheme.{w}": _around(found.weights[w]) for w in names}
    words = f"{'PD' if derivative else 'P'}-type with lead and filter"
    return _candidate(words, _pid_type(found, names), found, bounds, family, task)


def p_type_notch(family, task, trials, margin) -> Candidate | str:
    """Q (u + gamma_p z^(1 + lead) F e), where F stops the band of the highest resonance"""
    band = resonance_band(family, task.dt)
    if band is None:
        return "no machine has a lightly damped resonance"
    if _sign(family) == 0:
        return _NO_SIGN
    found = [
        one
        for wider in NOTCHES
        if band[1] * wider < 0.45 / task.dt
        and (one := _best_pd(family, task, trials, margin, (0.0,), band / [wider, 1 / wider]))
    ]
    if not found:
        return _NO_WEIGHTS
    best = min(found, key=lambda one: one.judged)
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
    return _candidate(words, learning, best, bounds, family, task)


def model_inverse(family, task, trials, margin) -> Candidate | str:
    """u' = Q u + gamma (Q P^-1) e, with the stable inverse of the nominal loop.

    Q P^-1 is one filter. If P^-1 came first and was cut off at the end of the trial, as in
    Q (u + gamma P^-1 e), what the inverse makes of the jump there would not be smoothed by Q, and
    learning diverges from the end of the trial after some hundred trials.
    """
    try:
        inverse = stable_inverse(_model(family, task))
    except ValueError as error:
        return str(error)
    L = 1 / family.P[0]
    found = widest(
        family, ({"gamma_p": gain, "L": gain * L} for gain in INVERSE_GAINS), task, trials, margin
    )
    if not found:
        return _NO_WEIGHTS
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
        return Candidate("", words, law, {}, found[0].largest, found[0].predicted)
    return why


def norm_optimal(family, task, trials, margin) -> Candidate | str:
    """Q argmin |e|^2 + w_r |u' - u|^2 + w_s |u'|^2, by the nominal loop"""
    G = family.P[0]
    size = float(np.max(np.abs(G))) ** 2

    def laws():
        for w_r in size * np.geomspace(1e-4, 1e0, 5):
            for w_s in size * np.geomspace(1e-8, 1e-2, 4):
                keep = (np.abs(G) ** 2 + w_r) / (np.abs(G) ** 2 + w_r + w_s)
                L = np.conj(G) / (np.abs(G) ** 2 + w_r)
                yield {"w_r": float(w_r), "w_s": float(w_s), "L": L, "keep": keep}

    safe = widest(family, laws(), task, trials, margin)
    if not safe:
        return _NO_WEIGHTS
    found = safe[0]
    weights = {w: found.weights[w] for w in ("w_r", "w_s")}
    learning = NormOptimal(_model(family, task), w_r=weights["w_r"], w_s=weights["w_s"])
    bounds = {f"scheme.{w}": (value / FREER, value * FREER) for w, value in weights.items()}
    words = "norm-optimal by the nominal model, with a filter"
    return _candidate(words, learning, found, bounds, family, task)


LAWS: dict[str, Callable[..., Candidate | str]] = {
    "p-type": partial(pd_type, derivative=False),
    "pd-type": pd_type,
    "p-type-notch": p_type_notch,
    "model-inverse": model_inverse,
    "norm-optimal": norm_optimal,
}
_NO_WEIGHTS = "no weights keep the margin on every machine"
_NO_SIGN = "the sign of the steady gain is not the same on all machines"


# How it is done
# --------------------------------------------------------------------------------------------------


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


def _candidate(words, learning, found: Found, bounds, family, task) -> Candidate:
    """A law under the robustness filter whose cutoff was found."""
    cutoff = found.weights["cutoff"]
    scheme = Filtered(learning, ZeroPhaseButterworth(cutoff=cutoff, order=ORDER))
    bounds["filter.cutoff"] = (cutoff / WIDER, min(cutoff * WIDER, 0.49 / task.dt, family.highest))
    return Candidate("", words, scheme, bounds, found.largest, found.predicted)


def _around(value: float) -> tuple[float, float]:
    low, high = sorted((value / WIDER, value * WIDER))
    return low, high


def _model(family: Family, task: Task) -> StateSpace:
    return StateSpace(*minimal(family.loops[0], task.N), dt=task.dt)


# Weights that are safe by frequency
# --------------------------------------------------------------------------------------------------

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
    """Weights of the least predicted error, with that error and the largest contraction.

    judged: the error by the metric that judges, of a law that is simulated
    """

    weights: dict[str, float]
    predicted: float
    largest: float
    judged: float = np.inf


def widest(family: Family, laws, task: Task, trials: int, margin: float) -> list[Found]:
    """Laws with cutoffs that keep the margin: of each lead the `ALIKE` of least predicted error.

    They come in the order of their predicted errors.

    laws: dictionaries of weights, with the response `L` (F,) of u' = keep (u + L e) before the
        filter, and `keep` where it is not 1
    """
    lowest, highest = min(2 / task.duration, 0.05 / task.dt), min(0.45 / task.dt, family.highest)
    still = Change(1.0, 0, np.inf, ORDER)
    found: dict[float | None, list[Found]] = {}
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

    The error is by the metric that judges, if that is the largest one of the trial or of its
    settled part, else the root mean square. The search goes on from the best one, and from that of
    least root mean square, by steps of gain, cutoff and lead, alone and in pairs, that keep the
    margin and lower the error; where none does, they become shorter.
    """
    sizes = np.abs(family.P).sum(axis=1)
    which = np.unique(np.r_[0, np.argsort(sizes)[:: max(1, len(sizes) // 4)], np.argmax(sizes)])
    judged = partial(_judged, family, which=which, task=task, trials=trials)
    error, size = attrgetter("judged"), attrgetter("predicted")

    def lowest(best: Found) -> Found:
        stride = STRIDE
        for _ in range(ROUNDS):
            near = [one for law in _beside(best.weights, stride, task)
                    if (one := _kept(family, law, task.dt, margin))]  # fmt: skip
            if near and (lower := min(judged(near), key=error)).judged < LOWER * best.judged:
                best = lower
            elif stride < SHORTEST:
                break
            else:
                stride = stride**0.5
        return best

    first = judged(found[:SIMULATED])
    starts = {str(one.weights): one for one in (min(first, key=error), min(first, key=size))}
    return min(map(lowest, starts.values()), key=error)


def _judged(family: Family, laws: list[Found], which, task: Task, trials: int) -> list[Found]:
    """Laws with the errors of the last trial on some machines, by simulation.

    Where the largest error judges, it is that of the trials from this one to the end of the sweep.
    What noise adds to each is that of the frequency response, and its largest of n samples
    sqrt(2 ln n) times its root mean square.
    """
    loops, quiet = [family.loops[i] for i in which], family._replace(error=0 * family.error)
    weights, dt = [one.weights for one in laws], task.dt
    errors = simulated(loops, family.first_error, weights, dt, judged_trials(trials))
    e = next(itertools.islice(errors, trials - 1, None))
    noise = np.array([np.max(quiet.rms(*_responses(family, law, dt), trials)) for law in weights])
    rms = judged = np.hypot(np.max(rms_of(e), axis=1), noise)
    window = {"max_error": slice(1, None), "settled_error": task.settled}.get(family.metric)
    if window is not None:
        many = max(1.0, np.sqrt(2 * np.log(e[0, 0, window].size)))
        of_trials = itertools.chain((e,), errors)
        each = [np.max(np.abs(one[..., window]), axis=(1, 2)) for one in of_trials]
        judged = np.hypot(np.max(each, axis=0), many * noise)
    rms, judged = (np.where(np.isnan(x), np.inf, x).tolist() for x in (rms, judged))
    both = zip(laws, rms, judged, strict=True)
    return [one._replace(predicted=r, judged=j) for one, r, j in both]


def _beside(weights: dict[str, float], stride: float, task: Task) -> list[dict[str, float]]:
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


def _kept(family: Family, law: dict[str, float], dt: float, margin: float) -> Found | None:
    """The law with its contraction, or None if it does not keep the margin or the cutoff."""
    if law["cutoff"] > family.highest:
        return None
    largest = float(family.largest(*_responses(family, law, dt)))
    return Found(law, np.inf, largest) if largest <= 1 - margin else None


def _responses(family: Family, law: dict[str, float], dt: float) -> tuple[np.ndarray, np.ndarray]:
    """(F,) Q and L of a P-type or PD-type law, with its notch if it has one."""
    return low_pass(family.frequencies, law["cutoff"], dt, ORDER), response_of_pd(family, law, dt)


def response_of_pd(family: Family, law, dt: float) -> np.ndarray:
    """(F,) L of a P-type or PD-type law, with its notch if it has one."""
    change = 1 - family.advance(-1, dt)
    L = family.advance(1 + law["lead"], dt) * (law["gamma_p"] + law["gamma_d"] * change)
    if "low" not in law:
        return L
    return L * notch_of(law, np.pi * dt * family.frequencies, dt)


# P-type and PD-type laws with the ends of the trial
# --------------------------------------------------------------------------------------------------

LONG = 3, 60, 200  # the sweep has so many times the trials asked for, within these bounds


def judged_trials(trials: int) -> int:
    """The number of trials over which candidates are judged."""
    times, least, most = LONG
    return max(trials, min(max(times * trials, least), most))


def rms_of(e) -> np.ndarray:
    """(...) root mean square errors of trials (..., N+1), over their samples after the first."""
    return np.sqrt(np.mean(e[..., 1:] ** 2, axis=-1))


def simulated(
    loops: Sequence[Loop], error, laws: Sequence[dict[str, float]], dt: float, trials: int
) -> Iterator[np.ndarray]:
    """(laws, S, N+1) error of each trial.

        e_j = e_1 - P u_j,  u_{j+1} = Q (u_j + gamma_p d_j[k+1+m] + gamma_d (d_j[k+1+m] - d_j[k+m]))

    with d_j = F e_j. P is a convolution with the impulse response; Q and the band-stop filter F,
    where a law has one, mirror the trial at its ends and are products after a cosine transform.
    It is NumPy, since JAX would compile anew for each lead. Noise and limits are left out. A lead
    beyond the delay of the plant leaves the last samples of a trial without an error to learn from,
    of which the frequency response knows nothing.

    error: (N+1,) of the first trial, in which nothing was learned
    laws: numbers gamma_p, gamma_d, lead and cutoff of each, and the edges low and high of F
    """
    error = np.asarray(error, float)
    N = len(error) - 1
    size = scipy.fft.next_fast_len(2 * N, real=True)
    P = scipy.fft.rfft(np.stack([impulse_response(loop, N) for loop in loops]), size)
    cutoffs = np.array([law["cutoff"] for law in laws])
    lines = np.arange(N) / (2 * N * dt)
    Q = low_pass(lines, cutoffs[:, None], dt, ORDER)[:, None]
    angles = np.pi / 2 * np.arange(N + 1) / (N + 1)
    F = np.stack([notch_of(law, angles, dt) for law in laws])[:, None]
    u = np.zeros((len(laws), len(loops), N))
    for _ in range(trials):
        e = _error(error, P, u, size)
        yield e
        e = _weighted(F, e)
        u = u + np.stack([_step(law, one) for law, one in zip(laws, e, strict=True)])
        u = _weighted(Q, u)


def notch_of(law: dict[str, float], angles, dt: float) -> np.ndarray:
    """(F,) the filter F of a law at pi f dt = angles, 1 if it has none."""
    if "low" not in law:
        return np.ones(len(angles))
    return np.asarray(_response(ZeroPhaseBandStop(law["low"], law["high"]), angles, dt))


_response = jax.jit(lambda notch, angles, dt: notch.response(angles, dt))


def impulse_response(loop: Loop, samples: int) -> np.ndarray:
    """(N,) C A^k B of a loop of one input and output."""
    return np.concatenate([*impulse_blocks(loop, samples)])[:, 0, 0]


def _error(error, P, u, size: int) -> np.ndarray:
    """(laws, S, N+1) the error of the trial in which u (laws, S, N) is played."""
    y = scipy.fft.irfft(P * scipy.fft.rfft(u, size), size)[..., : u.shape[-1]]
    return error - np.concatenate([np.zeros((*u.shape[:-1], 1)), y], axis=-1)


def _weighted(response, signal) -> np.ndarray:
    """Signals (..., N), mirrored at their ends, through zero-phase filters."""
    if np.all(response == 1):
        return signal
    return scipy.fft.idct(response * scipy.fft.dct(signal, norm="ortho"), norm="ortho")


def _step(law: dict[str, float], e) -> np.ndarray:
    """(S, N) L e of errors (S, N+1); beyond the end of the trial they count as zero."""
    lead, N = int(law["lead"]), e.shape[-1] - 1
    step = np.zeros((len(e), N))
    step[:, : N - lead] = law["gamma_p"] * e[:, 1 + lead :]
    change = np.diff(e, axis=-1)[:, lead:]
    step[:, : N - lead] += law["gamma_d"] * change
    return step


# Tuned by gradient, and kept safe by the frequency test
# --------------------------------------------------------------------------------------------------

LATE = 0.25  # share of the trials, the last ones, of which the largest error counts
EARLY = 0.02  # weight of the errors of all trials, beside that
WORST = 0.75  # level of the conditional value at risk: the mean of the worst quarter of machines
UNSAFE = 20.0  # weight of the logarithm of |keep - L P| beyond what is allowed
SHARPNESS = 4000.0  # with 400, it would ask for 2.5 % less than a law that just keeps the bound
STEPS_BACK = (1.0, 0.8, 0.6, 0.4, 0.2)  # ways from the safe weights to the tuned ones, in logarithm


def tuned(
    candidate: Candidate,
    family: Family,
    task: Task,
    trials: int,
    *,
    metric: str,
    margin: float,
    out: Path,
    resume: bool = False,
    progress: Callable[[int, np.ndarray, float], None] | None = None,
    machines: int,
    held_out: int,
    steps: int,
    quantities: Mapping[str, Callable[[Trial], jax.Array]],
) -> Candidate:
    """The candidate with tuned weights, or as near to them as |Q (1 - L P)| <= 1 - margin allows.

    The tuning minimises the largest error of the last trials and, with a smaller weight, the errors
    of all trials, in the mean of the worst quarter of the machines. As it sees a few trials only,
    it may end at weights that diverge later. So the weights are then moved back towards the safe
    ones of the candidate, until the frequency test holds with its margin over the family.

    out: folder of the tuning's state;  resume: go on with what is there
    machines, held_out, steps, quantities: as for `Tuning`
    """
    if not candidate.bounds:
        return candidate
    first = max(1, round((1 - LATE) * trials))
    problem = Tuning(
        family.population, candidate.scheme, task, trials, weights=candidate.bounds,
        objective=Holding(first, metric) + EARLY * EveryTrial(metric) + penalty(family, 1 - margin),
        risk=CVaR(WORST), machines=machines, held_out=held_out, steps=steps, quantities=quantities,
    )  # fmt: skip
    found = problem.run(out, resume=resume, progress=progress)
    for way in STEPS_BACK:
        weights = {
            name: _between(float(get_at(candidate.scheme, name)), value, way)
            for name, value in found.values.items()
        }
        scheme = replaced(candidate.scheme, weights)
        largest = contraction(family, scheme, task)
        if largest <= 1 - margin:
            return candidate._replace(scheme=scheme, largest=largest)
    return candidate


def penalty(family: Family, below: float) -> Objective:
    """The monotone condition as a term of a tuning: what |keep - L P| above a bound costs."""
    return UNSAFE * OverFamily(family.frequencies, family.P, below, SHARPNESS)


def contraction(family: Family, scheme: Scheme, task: Task) -> float:
    """The largest |Q (keep - L P)| of a scheme on the machines and lines of a family."""
    return float(np.max(family.sizes_of_law(law_of(scheme, task), task.dt)))


def _between(start: float, end: float, way: float) -> float:
    """A weight on the way from one value to another of the same sign, even in its logarithm."""
    if start * end <= 0:
        return start + way * (end - start)
    return float(start * (end / start) ** way)
