"""What is left of a fit is asked for what is not linear: a suspicion with its evidence, by name.

A linear plant P was fitted. Each suspicion is a change of it with one number, and a column c that
this number would add to the output:

    friction            P[-sign(v)], v the speed of the output: a force against the motion
    backlash            P[-direction of u], held while u rests: a gap that u has to cross
    gain by amplitude   P[u^3 / max u^2]
    saturation          P[what exceeds a level of u], the level searched
    gain by position    P[u y],  gain by time  P[u t]

The residual e and each c lose what linear filters of u explain, since that is another linear
plant. With r the correlation of what is left of them, r^2 is the share of the residual that the
suspicion explains; it is significant where r exceeds its standard deviation, which slow signals
have larger (Bartlett 1935):

    var r = sum over lags of rho_e rho_c / N
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg
from scipy.signal import butter, fftconvolve, filtfilt

from ..plants import Plant
from ..pytree.in_short import in_short
from ..pytree.named_paths import get_at
from ..pytree.ranges import require
from .problem import free_elements, simulated_output
from .records import Record, as_columns, delayed, task_of
from .verdict import WIDE, Estimate, Identified, estimates, fit_of, inverse_of_normal, widened

SIMPLE = 6  # order up to which a plant does not imitate what is not linear
LEAST = 0.2  # share of the residual that a suspicion explains at least
SURE = 4.0  # standard deviations of r that it has at least
AS_GOOD = 1.25  # times the least rms: what leaves no more is as good
SLOW = 0.02  # of the largest speed, below which an axis stands
LEVELS = np.linspace(0.3, 0.95, 14)  # of the largest input, at which it may saturate
MOST = 20_000  # samples that are looked at
MORE = 4  # lags of u and y beyond the order, of the linear filter
RESTS = 5  # samples without a movement that count as rest
MOVES = 0.05  # of its range, that the input changes meanwhile
GRID = 1e-4  # of a step of the encoder, by which the others may miss its multiples

NEXT = {
    "friction": "record one direction after the other at an offset of speed, and fit mass and "
    "friction by `friction_of`",
    "backlash": "record the same motion at a tenth and at ten times the amplitude: a gap keeps its "
    "size",
    "gain by amplitude": "record at half and at twice the amplitude",
    "saturation": "record at an amplitude below that level",
    "gain by position": "record small motions at several places",
    "gain by time": "record twice in a row, warm, and compare",
    "rounding": "record a larger motion, or a finer encoder",
}


class Suspicion(NamedTuple):
    """What may be in a machine beside its linear plant.

    name: of `NEXT`
    rms: what linear plant and suspicion leave together, in the unit of the output
    share: of the power of the residual that it explains, 0 to 1
    value: its number: a force or gap in the unit of the input, a relative change of the gain, a
        level of the input, or a step of the encoder
    evidence: what was seen, in words
    """

    name: str
    order: int
    rms: float
    share: float
    value: float
    evidence: str
    __repr__ = in_short


class Answers(NamedTuple):
    """What a plant of one input and one output answers to the record, and to one sample of 1.

    modelled: (N+1,) output to the record, with what a start in motion adds
    impulse: (N+1,) output to one sample of 1, from rest
    """

    order: int
    modelled: np.ndarray
    impulse: np.ndarray

    @classmethod
    def of(cls, fit: Plant | Identified, record: Record) -> Answers:
        """The answers of a plant, from rest, or of a fit, by the program that has fitted it."""
        plant = fit.plant if isinstance(fit, Identified) else fit
        names, u = free_elements(plant, None), record.u
        values = np.array([float(get_at(plant, name)) for name in names])
        task, size = task_of(plant, u, record.dt), np.max(np.abs(u))
        kick = np.zeros(np.shape(u))
        kick[0] = size
        both = [simulated_output(values, names, plant, task, one)[:, 0] for one in (u, kick)]
        modelled = fit.simulated[:, 0] if isinstance(fit, Identified) else np.asarray(both[0])
        return cls(getattr(plant, "order", 4), modelled, np.asarray(both[1]) / size)


class Seen(NamedTuple):
    """One record, all of the same rows: u (N,), y (N,), e (N,), and the plant.

    impulse: (N,) answer of the plant to one sample of 1
    up: 1, or -1 where a positive input moves the output down
    """

    order: int
    u: np.ndarray
    y: np.ndarray
    e: np.ndarray
    impulse: np.ndarray
    up: float

    def P(self, inputs: np.ndarray) -> np.ndarray:
        """(N, m) the response of the linear plant to inputs (N, m)."""
        return fftconvolve(inputs, self.impulse[:, None], axes=0)[: len(inputs)]


def suspicions(record: Record, plants: Sequence[Plant | Identified | Answers]) -> list[Suspicion]:
    """What explains the residuals of linear plants, least left first; empty where nothing does.

    A plant of high order imitates what is not linear, by poles that no machine has; so the plants
    of lower orders are asked, too. Of each suspicion the lowest order is told that leaves hardly
    more than the best, and of the suspicions those that leave hardly more than the first, and than
    a plant of at most 6 poles alone.

    record: one experiment with one input and one output; of others nothing is said
    plants: fits to it, of one input and one output, or what they answer
    """
    u, y = as_columns("suspicions", "u", record.u), as_columns("suspicions", "y", record.y)
    if record.trials != 1 or u.shape[1] != 1 or y.shape[1] != 1 or not np.ptp(u) > 0:
        return []
    record = record._replace(u=u, y=y)
    answers = (one if isinstance(one, Answers) else Answers.of(one, record) for one in plants)
    seen = [one for one in (_seen(record, of) for of in answers) if one is not None]
    told = [one for each in seen for one in _suspected(each)]
    if not told:
        return []
    alone = [float(np.std(one.e)) for one in seen if one.order <= SIMPLE]
    least = min([*(one.rms for one in told), *alone])
    good = [one for one in told if one.rms <= AS_GOOD * least]
    lowest = {one.name: one for one in sorted(good, key=lambda one: -one.order)}
    return sorted(lowest.values(), key=lambda one: one.rms)


def sentences(told: Sequence[Suspicion], rms: float, order: int) -> list[str]:
    """One sentence for each suspicion, and what to measure next for the first.

    rms, order: of the best linear plant alone
    """
    lines = []
    for one in told:
        begins = "As well it may be" if lines else "What is left suggests"
        lines.append(
            f"{begins} {one.name}: {one.evidence}. It explains {100 * one.share:.3g} % of the "
            f"residual: with it a plant of order {one.order} leaves an rms of {one.rms:.3g}, "
            f"without it one of order {order} leaves {rms:.3g}."
        )
    return lines + [f"To tell, {NEXT[one.name]}." for one in told[:1]]


def _suspected(seen: Seen) -> list[Suspicion]:
    """The suspicions that explain enough of one residual."""
    within = _linear(seen, 2 * seen.order + MORE)
    e = seen.e - within @ (within.T @ seen.e)
    told = [_judged(name, of(seen), within, e, seen) for name, of in CANDIDATES.items()]
    return [one for one in [*told, _rounding(seen)] if one is not None]


def _seen(record: Record, of: Answers) -> Seen | None:
    n = min(len(record.u), MOST)
    u, y, modelled = np.asarray(record.u)[:n, 0], np.asarray(record.y)[:n, 0], of.modelled[:n]
    e = y - modelled
    e = e - np.mean(e)
    if not np.ptp(u) > 0 or not np.std(e) > 0 or not np.all(np.isfinite(e)):
        return None
    up = -1.0 if u @ np.gradient(modelled) < 0 else 1.0  # what moves it does work on it
    return Seen(of.order, u, y, e, of.impulse[:n], up)


def _linear(seen: Seen, lags: int) -> np.ndarray:
    """An orthonormal basis of what filters of u with about the poles of P make."""
    modelled = seen.y - seen.e
    late = [delayed(x, k) for x in (seen.u, modelled) for k in range(lags)]
    X = np.column_stack([np.ones(len(seen.u)), *late])
    Q, R, _ = scipy.linalg.qr(X, mode="economic", pivoting=True)
    size = np.abs(np.diag(R))
    return Q[:, size > 1e-9 * size[0]]


def _moving(x: np.ndarray) -> np.ndarray:
    """-1, 0, 1: the direction of a signal, 0 where it hardly moves."""
    v = np.gradient(x)
    return np.sign(v) * (np.abs(v) > SLOW * np.max(np.abs(v)))


def _held(direction: np.ndarray) -> np.ndarray:
    """The direction, held while nothing moves."""
    at = np.maximum.accumulate(np.where(direction != 0, np.arange(len(direction)), 0))
    return direction[at]


# Each gives the input (N,) that a suspicion adds, the sign of its number (0 for either) and its
# evidence, a function of that number; the saturation gives several, of which the best is taken.


class Candidate(NamedTuple):
    added: np.ndarray
    sign: int
    evidence: Callable[[float], str]
    level: float | None = None


def _friction(seen: Seen) -> list[Candidate]:
    direction = _moving(seen.y - seen.e)
    if not (np.any(direction > 0) and np.any(direction < 0)):
        return []
    forth, back = (np.mean(seen.e[direction == s]) for s in (1, -1))
    rest = _resting(seen)
    stands = f"; the output stands in {100 * rest:.2g} % of the samples while the input moves"

    def evidence(force):
        return (
            f"a force of {force:.3g} against the motion, in units of the input; the mean residual "
            f"is {forth:.2g} forth and {back:.2g} back" + stands * (rest > 0.01)
        )

    return [Candidate(-seen.up * direction, 1, evidence)]


def _backlash(seen: Seen) -> list[Candidate]:
    said = "a gap of {:.3g} in units of the input, crossed at each reversal"
    return [Candidate(-_held(_moving(seen.u)), 1, lambda half: said.format(2 * half))]


def _amplitude(seen: Seen) -> list[Candidate]:
    def evidence(change):
        more = f"{100 * abs(change):.2g} % " + ("larger" if change > 0 else "smaller")
        return f"at the largest input the gain is {more} than at small ones"

    return [Candidate(seen.u**3 / np.max(np.abs(seen.u)) ** 2, 0, evidence)]


def _saturation(seen: Seen) -> list[Candidate]:
    def at(level):
        over = seen.u - np.clip(seen.u, -level, level)
        return Candidate(-over, 1, lambda _: f"nothing of the input beyond {level:.3g} acts", level)

    return [at(float(level)) for level in np.max(np.abs(seen.u)) * LEVELS]


def _changing(over: str, along: Callable[[Seen], np.ndarray]) -> Callable[[Seen], list[Candidate]]:
    """A gain that changes along something; `along` runs over a range of 1."""

    def of(seen: Seen) -> list[Candidate]:
        said = f"over the {over} the gain changes by {{:.2g}} %"
        return [Candidate(seen.u * along(seen), 0, lambda by: said.format(100 * abs(by)))]

    return of


CANDIDATES: dict[str, Callable[[Seen], list[Candidate]]] = {
    "friction": _friction,
    "backlash": _backlash,
    "gain by amplitude": _amplitude,
    "saturation": _saturation,
    "gain by position": _changing(
        "range of the output", lambda seen: (seen.y - np.mean(seen.y)) / np.ptp(seen.y)
    ),
    "gain by time": _changing("record", lambda seen: np.linspace(-0.5, 0.5, len(seen.u))),
}


def _judged(name, candidates, within, e, seen) -> Suspicion | None:
    """The suspicion, by the candidate that explains most; None where it is not significant."""
    if not candidates:
        return None
    columns, best = seen.P(np.column_stack([one.added for one in candidates])), None
    for one, column in zip(candidates, columns.T, strict=True):
        c = column - within @ (within.T @ column)
        if not np.linalg.norm(c) > 1e-9 * np.linalg.norm(column):
            continue
        value, r = float(c @ e / (c @ c)), float(c @ e / np.sqrt((c @ c) * (e @ e)))
        if one.sign * value < 0 or abs(r) < SURE * _deviation(c, e):
            continue
        if r * r >= LEAST and (best is None or r * r > best.share):
            left = float(np.sqrt(max(1 - r * r, 0.0)) * np.linalg.norm(e) / np.sqrt(len(e)))
            number = value if one.level is None else one.level
            best = Suspicion(name, seen.order, left, r * r, number, one.evidence(value))
    return best


def _deviation(c, e) -> float:
    """The standard deviation of the correlation of two signals that have nothing in common."""
    n = len(e)
    power = [np.abs(np.fft.rfft(x, 2 * n)) ** 2 for x in (c, e)]
    rho = [np.fft.irfft(p)[:n] for p in power]
    product = (rho[0] / rho[0][0]) * (rho[1] / rho[1][0])
    return float(np.sqrt(max(1.0 + 2 * np.sum(product[1:]), 1.0) / n))


def _resting(seen: Seen) -> float:
    """Share of the samples at which the output rests for a while during which the input moves."""
    step = np.abs(np.diff(seen.y))
    still = np.concatenate([[False], step <= 1e-9 * np.ptp(seen.y), [False]])
    edges = np.flatnonzero(np.diff(still.astype(int)))
    rests = zip(edges[::2], edges[1::2], strict=True)
    moved = MOVES * np.ptp(seen.u)
    rested = [b - a for a, b in rests if b - a >= RESTS and np.ptp(seen.u[a:b]) > moved]
    return sum(rested) / len(step)


def _rounding(seen: Seen) -> Suspicion | None:
    """The step of the encoder, where it explains much of the residual."""
    q = _step(seen.y)
    if not q:
        return None
    share = min(q * q / 12 / float(np.var(seen.e)), 1.0)
    if share < LEAST:
        return None
    left, said = float(np.std(seen.e)) * np.sqrt(1 - share), f"the output moves in steps of {q:.3g}"
    return Suspicion("rounding", seen.order, left, share, q, said)


def _step(position: np.ndarray) -> float:
    """The step of the encoder, the smallest change, where all are its multiples; else 0."""
    steps = np.abs(np.diff(position))
    moved = steps[steps > 1e-9 * np.ptp(position)]
    q = float(np.min(moved, initial=np.inf))
    off = np.max(np.abs(moved / q - np.round(moved / q)), initial=0.0)
    return q if len(moved) and off <= GRID * np.max(moved) / q else 0.0


# Friction, fitted to a motion
# --------------------------------------------------------------------------------------------------

ORDER, LEAST_SAMPLES = 4, 50  # of the filter; samples at which the axis moves
SLOWEST = 0.02  # of the largest speed, below which the sign of a speed is not taken
RINGS = 1.5  # periods of the cutoff, during which the filter answers a jump
ABOVE, LOWEST = 30.0, 12.0  # times the highest frequency of the motion: the cutoff of the filter
ROUNDING = 1e-4  # share of the power of the acceleration that the encoder's step may add


class FrictionModel(NamedTuple):
    """Mass and friction with their 95 % intervals, which hold if nothing else acts.

    The step of an encoder, found in the position, adds to the acceleration and lets the mass seem
    smaller. The interval of the mass has that share on each side; for other noise of the position,
    which is not known, choose the cutoff. A single sinusoid is rounded alike in each period, and
    the interval may be too narrow for it.
    What the relation leaves counts as noise of its own colour. A force that differs between
    motions, such as a cable or a friction by place, is none: on seven motions of one printer axis,
    with fits of 92 to 96 %, the masses were 0.79 to 0.87 with half-widths of 0.01 to 0.03.

    mass: [unit of force per unit of acceleration]
    viscous: [unit of force per unit of speed]
    coulomb, offset: [unit of force]
    fit: 100 (1 - |residual| / |force - mean force|) [%]
    """

    mass: Estimate
    viscous: Estimate
    coulomb: Estimate
    offset: Estimate
    fit: float
    __repr__ = in_short


def friction_of(force, position, dt: float, *, cutoff: float | None = None) -> FrictionModel:
    """Mass, viscous and Coulomb friction and offset of an axis that moves both ways.

        force = mass a + viscous v + coulomb sign(v) + offset        (Janot and others, of EMPS)

    Speed and acceleration are central differences of the position, filtered forth and back; the
    force is filtered alike, so that the filter cancels. The model is linear in its numbers. Samples
    at which the axis hardly moves say nothing of the sign of its speed and are left out.

    force: (N,) force or torque that acts on the axis;  position: (N,) of the same samples
    dt: sample time [s]
    cutoff: of the filter [Hz]: above the motion, below the noise of the encoder and resonances;
        None: 30 times the frequency below which 99 % of the power of the position lie, and down to
        12 times, until the step of the encoder is next to nothing of the acceleration
    Raises ValueError for signals of different lengths or that are not finite, a cutoff outside its
    range, and a motion that goes one way only or rests.
    """
    force, position = (np.asarray(x, float).ravel() for x in (force, position))
    require("friction_of", "dt", dt, "(0, inf)")
    require("friction_of", "cutoff", cutoff, f"(0, {float(0.4 / dt)}]", optional=True)
    if len(force) != len(position) or not np.all(np.isfinite([force, position])):
        raise ValueError(
            f"friction_of: force has {len(force)} samples and position {len(position)}; allowed "
            "are as many, all finite"
        )
    if len(force) < LEAST_SAMPLES:
        raise ValueError(f"friction_of: {len(force)} samples; allowed are at least {LEAST_SAMPLES}")
    if cutoff is None:
        power = np.cumsum(np.abs(np.fft.rfft(position - np.mean(position))) ** 2)
        highest = np.fft.rfftfreq(len(position), dt)[np.searchsorted(power, 0.99 * power[-1])]
        highest = max(highest, 1 / (dt * len(position)))
        cutoff = float(min(ABOVE * highest, 0.1 / dt))
        slow = min(LOWEST * highest, cutoff)
        smooth = filtfilt(*butter(ORDER, 2 * dt * slow), position)
        acceleration = np.gradient(np.gradient(smooth, dt), dt)
        added = _of_step(position, dt, cutoff) / max(np.var(acceleration), 1e-300)
        cutoff = max(slow, cutoff * min(1.0, (ROUNDING / max(added, 1e-300)) ** 0.2))
    b, a = butter(ORDER, 2 * dt * cutoff)
    smooth = filtfilt(b, a, position)
    speed = np.gradient(smooth, dt)
    columns = np.stack([np.gradient(speed, dt), speed, np.sign(speed), np.ones(len(speed))], axis=1)
    moving = np.abs(speed) > SLOWEST * np.max(np.abs(speed))
    if min(np.sum(moving & (speed > 0)), np.sum(moving & (speed < 0))) < LEAST_SAMPLES:
        raise ValueError(
            "friction_of: the axis does not move both ways; record a motion forth and back"
        )
    columns[:, 2] = filtfilt(b, a, np.where(moving, columns[:, 2], 0.0))
    held = (force + np.r_[force[:1], force[:-1]]) / 2  # of the hold before and after a sample
    wanted = filtfilt(b, a, held)
    # One sample in so many: what passes the filter has no more independent values.
    every = max(1, int(0.25 / (cutoff * dt)))
    still, rings = ~moving, round(RINGS / (cutoff * dt))
    still[[0, -1]] = True  # the filter begins and ends there
    which = np.flatnonzero(np.convolve(still, np.ones(2 * rings + 1), "same") < 0.5)[::every]
    if len(which) < LEAST_SAMPLES:
        raise ValueError(
            f"friction_of: {len(which)} samples in motion and apart from its reversals, a filter's "
            f"length each; allowed are at least {LEAST_SAMPLES}; record longer or raise the cutoff"
        )
    J, y = columns[which], wanted[which]
    found, *_ = np.linalg.lstsq(J, y, rcond=None)
    residual = y - J @ found
    covariance = inverse_of_normal(J) * float(residual @ residual) / max(len(y) - 4, 1)
    covariance = widened(covariance, J[:, None], residual[:, None])
    half = WIDE * np.sqrt(np.diag(covariance))
    half[0] += abs(found[0]) * min(_of_step(position, dt, cutoff) / np.var(J[:, 0]), 1.0)
    (fit,) = fit_of(y[:, None], residual[:, None])
    return FrictionModel(**estimates(FrictionModel._fields[:-1], found, half), fit=float(fit))


def _of_step(position: np.ndarray, dt: float, cutoff: float) -> float:
    """The power that the step of an encoder adds to an acceleration filtered at a cutoff [Hz]."""
    return _step(position) ** 2 / 12 * 2 * dt * (2 * np.pi) ** 4 * cutoff**5 / 5
