"""Is a Q-filter safe, and how far may one go: |Q (1 - L P)| of a family of machines or of records.

A machine that is simulated has a loop, and its curve is enclosed between the lines of the grid. A
machine that was measured has lines with a scatter, and between them nothing is proved.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..filters import ZeroPhaseButterworth
from ..learning.machine import Machine
from ..pytree.named_paths import get_at
from ..schemes import Filtered, Scheme
from ..signals.task import Task
from ..uncertainty import Uncertainty, drawn_machines
from .by_frequency import largest_of
from .family import Tried, tried_plants
from .filtered_law import (
    Change,
    Lines,
    best_lead,
    largest_cutoff,
    largest_gain,
)
from .law import law_of, law_response
from .linearity import invariant_loop, linear_law
from .loop import Loop, responses
from .outlook import maps_of
from .over_frequency import grid, lines
from .parts_of_law import Places, places_in, rounded, with_change, without_low_pass
from .whole_set import WholeSet, bound_of_set

POINTS = 600  # lines of the grid, beside those around the poles
NEAREST = 4  # of the worst plants on the grid, whose largest value is enclosed for an offer
LEADS = 30  # longest change of the lead that is tried, at least [samples]
BLOCKED = 1e-6  # |Q| below which Q (1 - L P) says nothing of 1 - L P
CUTOFF, GAIN, LEAD = "largest cutoff", "largest gain", "best lead, largest cutoff"
ATTEMPTS = 5  # to keep the margin between the lines too
FINENESS = 1e-4
TENTH = 0.1
RESONANT = 0.5  # damping ratio below which a pair of poles is a resonance


class Resonance(NamedTuple):
    """A pair of poles of the nominal loop.

    frequency: [Hz]
    damping:   ratio
    """

    frequency: float
    damping: float


class Curves(NamedTuple):
    """What a figure shows of a law on the nominal plant and on a family, at F frequencies [Hz].

    P, Q, LP: (F,) complex, of the nominal plant
    nominal:  (F,) |Q (1 - L P)|
    low, high: (F,) least and largest of the family, the scatter of a record included
    without:  (F,) largest |1 - L P| of the family, without the filter
    """

    f: np.ndarray
    P: np.ndarray
    Q: np.ndarray
    LP: np.ndarray
    nominal: np.ndarray
    low: np.ndarray
    high: np.ndarray
    without: np.ndarray

    @property
    def first_above(self) -> float:
        """The first frequency at which |1 - L P| exceeds 1 without Q [Hz]; inf if it never does."""
        above = np.flatnonzero(self.without > 1)
        return float(self.f[above[0]]) if len(above) else np.inf

    @property
    def left(self) -> np.ndarray:
        """(F,) |1 - Q| / |1 - Q (1 - L P)|: the share of a repeated error that is never learned."""
        with np.errstate(divide="ignore", invalid="ignore"):
            share = np.abs(1 - self.Q) / np.abs(1 - self.Q + self.Q * self.LP)
        return np.where(np.isnan(share), 0.0, share)

    @property
    def learned_up_to(self) -> float:
        """The frequency up to which a repeated error falls to a tenth or less [Hz]."""
        worse = np.flatnonzero(self.left > TENTH)
        if not len(worse):
            return float(self.f[-1])
        return float(self.f[worse[0] - 1]) if worse[0] else 0.0


def curves_of(whole: Lines, inner: Lines) -> Curves:
    """The curves of a law and of the same law without its filter."""
    P = whole.P[0]
    with np.errstate(divide="ignore", invalid="ignore"):
        Q = whole.keep / inner.keep
        L = inner.L / inner.keep
    sizes = np.abs(whole.keep - whole.L * whole.P)
    spread = np.abs(whole.L) * whole.scatter
    without = np.max(np.abs(1 - L * inner.P) + np.abs(L) * inner.scatter, axis=0, initial=0.0)
    return Curves(
        whole.f,
        P,
        Q,
        L * P,
        sizes[0],
        np.min(np.maximum(sizes - spread, 0), axis=0),
        np.max(sizes + spread, axis=0),
        without,
    )


class Offer(NamedTuple):
    """A changed law that keeps the margin, and what it buys.

    what:    what was changed
    settings: the values by path in the scheme, as `--set` takes them
    change:  against the law as it is
    peak:    largest |Q (1 - L P)| of the family
    learned_up_to: as in `Curves` [Hz]
    floor:   root mean square error at the limit on the nominal machine [unit of y]; nan if unknown
    """

    what: str
    settings: dict
    change: Change
    peak: float
    learned_up_to: float
    floor: float


class Question(NamedTuple):
    """The answer for one scheme on a family of machines.

    tried:  the machines and their largest values
    curves: over frequency
    proof:  over the whole set, and not only over the machines tried
    resonances: of the nominal loop, slowest first
    places: of cutoff, gain and lead in the scheme
    now:    the law as it is, with its floor
    """

    tried: Tried
    curves: Curves
    proof: WholeSet
    resonances: list[Resonance]
    places: Places
    now: Offer

    @property
    def peak(self) -> float:
        """The largest value that was found, or that is proved if that is larger."""
        found = float(self.tried.values[self.tried.top])
        return max(found, self.proof.bound) if self.proof.proved else found


def question(
    machine: Machine,
    scheme: Scheme,
    task: Task,
    uncertainty: Uncertainty,
    *,
    machines: int = 32,
    sampling: str = "latin-hypercube",
    seed: int = 0,
) -> tuple[Question, Lines]:
    """|Q (1 - L P)| of a scheme over a family, and the lines of its law without the filter.

    Raises ValueError for a scheme whose law is not linear, or that has several channels, and where
    machine, scheme and task do not fit.
    """
    need_linear(machine, scheme, task)
    tried = tried_plants(
        machine,
        uncertainty,
        scheme,
        task,
        machines=machines,
        sampling=sampling,
        seed=seed,
        climbers=0,
    )
    law = law_of(scheme, task)
    f = grid(task, points=POINTS, near=np.linalg.eigvals(tried.loops[0].A))
    f = np.unique(np.concatenate([f, tried.worst[np.isfinite(tried.worst)]]))
    P = responses(tried.loops, f, task.dt)
    whole, inner = (
        Lines(f, P, np.zeros(P.shape), *_law_on(one, task, f), task.dt)
        for one in (scheme, without_low_pass(scheme))
    )
    curves = curves_of(whole, inner)
    proof = bound_of_set(machine, scheme, task, law, uncertainty, tried)
    top = float(tried.values[tried.top])
    places = places_in(scheme)
    cutoff = float(get_at(scheme, places.cutoff)) if places.cutoff else np.inf
    change = Change(1.0, 0, cutoff, places.order)
    now = Offer(
        "as it is", {}, change, top, curves.learned_up_to, floor_of(machine, scheme, task, top)
    )
    return Question(
        tried, curves, proof, resonances_of(tried.loops[0], task.dt), places, now
    ), inner


def offers_of(
    found: Question, inner: Lines, machine: Machine, scheme: Scheme, task: Task, margin: float
) -> list[Offer]:
    """The largest cutoff, the largest gain and the best lead that keep a margin.

    Each is changed alone, except that the best lead comes with the largest cutoff that it allows.
    Where the scheme has no filter, one is offered on top of it. What the lines of the grid allow is
    enclosed between them on the worst plants, and reduced until the margin is kept there too.
    """
    offers, lead, allowed = [], _lead(scheme, found.places), 1 - margin
    for what in kinds(found.places):
        target = allowed
        for _ in range(ATTEMPTS):
            change = changed(what, [inner], found.now.change, target, 2 / task.duration, lead)
            if change is None:
                break
            offer = _offer(what, change, found, inner, machine, scheme, task)
            if offer.peak <= allowed:
                top = offer.peak
                scheme_then = _with(scheme, found.places, change)
                offers.append(offer._replace(floor=floor_of(machine, scheme_then, task, top)))
                break
            target -= 2 * (offer.peak - allowed) + FINENESS
    return offers


def kinds(places: Places | None = None) -> list[str]:
    """What can be changed in a law."""
    if places is None:
        return [CUTOFF, GAIN, LEAD]
    return [CUTOFF, *([GAIN] * bool(places.gains)), *([LEAD] * bool(places.lead))]


def changed(
    what: str, several: Sequence[Lines], now: Change, allowed: float, lowest: float, lead: int
) -> Change | None:
    """The change that is offered, on lines of laws without their filter; None if there is none.

    what:   CUTOFF, GAIN or LEAD
    lowest: [Hz] least cutoff that is offered
    lead:   of the law as it is, which the change must not make negative [samples]
    """
    if what == GAIN:
        gain = largest_gain(several, now, allowed)
        return None if gain is None else now._replace(gain=rounded(gain))
    if what == CUTOFF:
        cutoff = largest_cutoff(several, now, allowed, lowest)
        return None if cutoff is None else now._replace(cutoff=rounded(cutoff))
    tried = range(-lead, max(LEADS, 2 * lead) + 1)
    best = best_lead(several, now, allowed, tried, lowest)
    return None if best is None else now._replace(lead=best[0], cutoff=rounded(best[1]))


def floor_of(machine: Machine, scheme: Scheme, task: Task, top: float) -> float:
    """The root mean square error at the limit of learning; nan where learning is not safe.

    It is that of the whole trial, its ends included, with the reference and all that repeats.
    """
    if not top < 1:
        return np.nan
    nominal = drawn_machines(machine.noiseless().unlimited(), {}, {})
    floor = float(maps_of(nominal, scheme.unlimited(), task).limit()[2][0])
    return floor if np.isfinite(floor) else np.nan


def resonances_of(loop: Loop, dt: float) -> list[Resonance]:
    """The lightly damped pairs of poles of a loop."""
    poles = np.linalg.eigvals(loop.A) if len(loop.A) else np.zeros(0)
    s = np.log(poles[(np.abs(poles) > 1e-6) & (poles.imag > 1e-9)]) / dt
    found = [Resonance(abs(one) / (2 * np.pi), -one.real / abs(one)) for one in s]
    return sorted(one for one in found if one.damping < RESONANT)


def need_linear(machine: Machine, scheme: Scheme, task: Task) -> None:
    """Raises ValueError unless loop and law are linear and of one channel."""
    name = type(scheme).__name__
    if not scheme.learns:
        raise ValueError(f"{name} does not learn; allowed is a scheme with a linear learning law")
    for held in (linear_law(scheme, task), invariant_loop(machine, scheme, task)):
        if not held.held:
            raise ValueError(
                f"{name}: the condition |Q (1 - L P)| < 1 needs: {held.name}. Found: {held.detail}"
            )
    law = law_of(scheme, task)
    if law.keep.taps.shape[1:] != (1, 1) or law.L.taps.shape[1:] != (1, 1):
        raise ValueError(
            f"{name} learns {law.L.taps.shape[1]} inputs from {law.L.taps.shape[2]} outputs; "
            "allowed is one of each. `jaxilc certify` takes several"
        )
    if not law.invariant.held:
        raise ValueError(f"{name}: needed is a {law.invariant.name}: {law.invariant.detail}")


# How it is done
# --------------------------------------------------------------------------------------------------


def _with(scheme: Scheme, places: Places, change: Change) -> Scheme:
    """The scheme with a change; with a filter on top where it has none."""
    made = with_change(scheme, places.of(scheme, change))
    if not places.cutoff and np.isfinite(change.cutoff):
        return Filtered(made, ZeroPhaseButterworth(change.cutoff, order=change.order))
    return made


def _offer(what, change: Change, found: Question, inner: Lines, machine, scheme, task) -> Offer:
    """The offer of a change, without its floor."""
    made = _with(scheme, found.places, change)
    law, (keep, L) = law_of(made, task), _law_on(made, task, inner.f)
    sizes = np.max(np.abs(keep - L * inner.P), axis=1)
    worst = {0, *np.argsort(-sizes)[:NEAREST].tolist()}
    top = max(_enclosed(law, found.tried.loops[i], task) for i in worst)
    shifted = inner._replace(L=change.gain * _shift(inner, change.lead) * inner.L)
    reach = curves_of(inner._replace(keep=keep, L=L), shifted).learned_up_to
    return Offer(what, found.places.of(scheme, change), change, top, reach, np.nan)


def _law_on(scheme: Scheme, task: Task, f) -> tuple[np.ndarray, np.ndarray]:
    keep, L = (np.asarray(part)[:, 0, 0] for part in law_response(scheme, task, f))
    return keep, L


def _enclosed(law, loop: Loop, task: Task) -> float:
    return float(largest_of(law, loop, task, lines(task, None, [loop])).value)


def _shift(of: Lines, samples: int) -> np.ndarray:
    return np.exp(2j * np.pi * of.f * of.dt * samples)


def _lead(scheme: Scheme, places: Places) -> int:
    return int(get_at(scheme, places.lead)) if places.lead else 0
