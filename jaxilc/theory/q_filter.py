"""Is a Q-filter safe, and how far may one go: |Q (1 - L P)| of a family of machines or of records.

A machine that is simulated has a loop, and its curve is enclosed between the lines of the grid. A
machine that was measured has lines with a scatter: on the line k of a record the plant lies within
s_k = sigmas std_k of what was measured, and

    |Q (1 - L P_k)| + |Q L| s_k < 1

is enough for all these plants. Between the lines, below the first and above the last, nothing is
proved: a resonance that is narrower than the spacing of the lines does not show.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import NamedTuple

import numpy as np
from scipy.signal import find_peaks, peak_widths

from ..filters import ZeroPhaseButterworth
from ..filters.zero_phase import need_cutoff
from ..learning.machine import Machine
from ..pytree.aliases import Value
from ..pytree.named_paths import child_of, get_at, replaced
from ..pytree.ranges import require
from ..schemes import Filtered, LearningFilter, PIDType, Scheme
from ..signals.task import Task
from ..uncertainty import Population, Uncertainty, drawn_machines
from .frequency import Tried, WholeSet, bound_of_set, grid, largest_of, tried_plants
from .law import law_of, law_on
from .learning_map import maps_of, view_of
from .linearity import invariant_loop, linear_law, not_whole, of_last_trial
from .loop import Loop, responses, stable
from .on_lines import (
    Change,
    Curves,
    Lines,
    MeasuredResponse,
    best_lead,
    curves_of,
    largest_cutoff,
    largest_gain,
    low_pass,
    rounded,
)
from .rounding import ball_of

CUTOFF, GAIN, LEAD = "largest cutoff", "largest gain", "best lead, largest cutoff"
GAINS = {PIDType: ("gamma_p", "gamma_i", "gamma_d"), LearningFilter: ("L",)}
POINTS = 600  # lines of the grid, beside those around the poles
RESONANT = 0.5  # damping ratio below which a pair of poles is a resonance
ATTEMPTS = 5  # to keep the margin between the lines too
FINENESS = 1e-4
NEAREST = 4  # of the worst plants on the grid, whose largest value is enclosed for an offer
LEADS = 30  # longest change of the lead that is tried, at least [samples]
MOST_LEAD = 1000  # that is tried, or asked for on a record: each takes its time [samples]
LINES_IN_WIDTH = 4  # lines within the half-power width of a resonance that show it well
HEIGHT = 3.0  # dB by which a peak stands out
FEWEST = 3  # lines below the cutoff


class Offer(NamedTuple):
    """A changed law that keeps the margin, and what it buys.

    what:    what was changed
    settings: the values by path in the scheme, as `--set` takes them
    change:  against the law as it is
    peak:    largest |Q (1 - L P)| of the family
    learned_up_to: as in `Curves` [Hz]
    floor:   root mean square error at the limit on the nominal machine [unit of y]; nan if unknown
    adds_filter: whether a filter is put around a law that has none
    """

    what: str
    settings: dict
    change: Change
    peak: float
    learned_up_to: float
    floor: float
    adds_filter: bool = False


class Resonance(NamedTuple):
    """A pair of poles of the nominal loop.

    frequency: [Hz]
    damping:   ratio
    """

    frequency: float
    damping: float


# Where cutoff, gain and lead stand in a scheme, and the scheme with other ones
# --------------------------------------------------------------------------------------------------


class Places(NamedTuple):
    """The paths of the numbers that a change of the law sets; empty where there is no such number.

    cutoff: of the zero-phase Butterworth filter
    gains:  all the gains of the learning
    lead:   of the learning
    order:  of the filter
    """

    cutoff: str
    gains: tuple[str, ...]
    lead: str
    order: int

    def of(self, scheme: Scheme, change: Change) -> dict[str, Value]:
        """The values by path that make a change: only those that differ from the scheme's."""
        values: dict[str, Value] = {}
        if self.cutoff and np.isfinite(change.cutoff):
            values[self.cutoff] = change.cutoff
        for path in self.gains if change.gain != 1 else ():
            values[path] = np.asarray(get_at(scheme, path)) * change.gain
        if self.lead and change.lead:
            values[self.lead] = get_at(scheme, self.lead) + change.lead
        return {p: v for p, v in values.items() if not np.array_equal(v, get_at(scheme, p))}


def places_in(scheme: Scheme) -> Places:
    """Where cutoff, gain and lead of a scheme stand."""
    path, found = _first(scheme, _is_low_pass)
    of_law, law = _first(scheme, _is_known)
    names = () if law is None else next(v for k, v in GAINS.items() if isinstance(law, k))
    gains = tuple(f"{of_law}{name}" for name in names if np.any(np.asarray(getattr(law, name))))
    return Places(
        "" if found is None else f"{path}filter.cutoff",
        gains,
        f"{of_law}lead" if law is not None else "",
        2 if found is None else found.filter.order,
    )


def without_low_pass(scheme: Scheme) -> Scheme:
    """The scheme without its zero-phase Butterworth filter on what is learned."""
    return _changed(scheme, _is_low_pass, lambda filtered: child_of(filtered, "scheme")) or scheme


def with_law(scheme: Scheme, law: Scheme) -> Scheme:
    """The scheme with another learning law in place of its own and the filter around that.

    Raises ValueError where the scheme has no part of a kind that is known here.
    """
    made = _changed(scheme, lambda one: _is_low_pass(one) or _is_known(one), lambda _: law)
    if made is not None:
        return made
    known = ", ".join(kind.__name__ for kind in GAINS)
    raise ValueError(
        f"{type(scheme).__name__} has no learning part that can be replaced; allowed is one of "
        f"{known}, or a Filtered around it"
    )


def scheme_of(scheme: Scheme, places: Places, change: Change) -> Scheme:
    """The scheme with a change; with a filter around its learning part where it has none."""
    made = replaced(scheme, places.of(scheme, change))
    if places.cutoff or not np.isfinite(change.cutoff):
        return made
    q = ZeroPhaseButterworth(change.cutoff, order=change.order)
    return _changed(made, _is_known, lambda law: Filtered(law, q)) or made


def _is_low_pass(scheme) -> bool:
    return isinstance(scheme, Filtered) and isinstance(scheme.filter, ZeroPhaseButterworth)


def _is_known(scheme: Scheme) -> bool:
    return isinstance(scheme, tuple(GAINS))


def _changed(
    scheme: Scheme, wanted: Callable[[Scheme], bool], change: Callable[[Scheme], Scheme]
) -> Scheme | None:
    """The scheme with its first part that is wanted changed; None where it has none."""
    at, part = _first(scheme, wanted)
    if part is None:
        return None
    return replaced(scheme, {at.removesuffix("."): change(part)}) if at else change(part)


def _first(scheme: Scheme, wanted: Callable[[Scheme], bool], at: str = "") -> tuple[str, Value]:
    """The first part that is wanted, from the outside in, with the path before its fields."""
    if wanted(scheme):
        return at, scheme
    for name, part in scheme._fields_that_are_schemes().items():
        path, found = _first(part, wanted, f"{at}{name}.")
        if found is not None:
            return path, found
    return "", None


# Of a machine that is simulated
# --------------------------------------------------------------------------------------------------


class Question(NamedTuple):
    """The answer for one scheme on a family of machines.

    tried:  the machines and their largest values
    curves: over frequency
    proof:  over the whole set, and not only over the machines tried
    resonances: of the nominal loop, slowest first
    places: of cutoff, gain and lead in the scheme
    now:    the law as it is, with its floor
    rounding: root mean square error that rounding may add to the floor on the nominal machine
        [unit of y]; 0 where nothing is rounded, nan where learning is not safe
    """

    tried: Tried
    curves: Curves
    proof: WholeSet
    resonances: list[Resonance]
    places: Places
    now: Offer
    rounding: float

    @property
    def stable(self) -> bool:
        """Whether each loop that was tried is stable without learning; else nothing is claimed."""
        return stable(float(np.max(self.tried.radii)))

    @property
    def peak(self) -> float:
        """The largest value that was found, or that is proved if larger; nan if not `stable`."""
        if not self.stable:
            return np.nan
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

    Of a machine that rounds it is that of the one that does not.

    Raises ValueError for a scheme whose law is not linear, or that has several channels, and where
    machine, scheme and task do not fit.
    """
    need_linear(machine, scheme, task, uncertainty)
    population = Population(machine, uncertainty, count=machines, seed=seed, sampling=sampling)
    tried = tried_plants(population, scheme, task, climbers=0)
    law = law_of(scheme, task)
    f = grid(task, points=POINTS, near=np.linalg.eigvals(tried.loops[0].A))
    f = np.unique(np.concatenate([f, tried.worst[np.isfinite(tried.worst)]]))
    P = responses(tried.loops, f, task.dt)
    whole, inner = (
        Lines(f, P, np.zeros(P.shape), *law_on(one, task, f), task.dt)
        for one in (scheme, without_low_pass(scheme))
    )
    curves = curves_of(whole)
    proof = bound_of_set(population, scheme, task, law, tried)
    settled = stable(float(np.max(tried.radii)))
    top, places = float(tried.values[tried.top]) if settled else np.nan, places_in(scheme)
    cutoff = float(get_at(scheme, places.cutoff)) if places.cutoff else np.inf
    change, floor = Change(1.0, 0, cutoff, places.order), floor_of(machine, scheme, task, top)
    now = Offer("as it is", {}, change, top, curves.learned_up_to, floor)
    left, light = rounding_of(machine, scheme, task, top), resonances_of(tried.loops[0], task.dt)
    return Question(tried, curves, proof, light, places, now, left), inner


def floor_of(machine: Machine, scheme: Scheme, task: Task, top: float) -> float:
    """The root mean square error at the limit of learning; nan where learning is not safe.

    It is that of the whole trial, its ends included, with the reference and all that repeats.
    """
    if not top < 1:
        return np.nan
    nominal = drawn_machines(machine.noiseless().unlimited().unrounded(), {}, {})
    floor = float(maps_of(nominal, scheme.unlimited(), task).limit()[2][0])
    return floor if np.isfinite(floor) else np.nan


def rounding_of(machine: Machine, scheme: Scheme, task: Task, top: float) -> float:
    """The root mean square error that rounding may add; nan where learning is not safe."""
    if not top < 1:
        return np.nan
    nominal, law = drawn_machines(machine.noiseless().unlimited(), {}, {}), scheme.unlimited()
    ball = ball_of(nominal, law, task, view_of(law, task))
    return 0.0 if ball is None else float(ball.error[0])


def resonances_of(loop: Loop, dt: float) -> list[Resonance]:
    """The lightly damped pairs of poles of a loop."""
    poles = np.linalg.eigvals(loop.A) if len(loop.A) else np.zeros(0)
    s = np.log(poles[(np.abs(poles) > 1e-6) & (poles.imag > 1e-9)]) / dt
    found = [Resonance(abs(one) / (2 * np.pi), -one.real / abs(one)) for one in s]
    return sorted(one for one in found if one.damping < RESONANT)


def need_linear(
    machine: Machine, scheme: Scheme, task: Task, uncertain: Collection[str] = ()
) -> None:
    """Raises ValueError unless loop and law are linear and of one channel, and trials are whole."""
    name, found = type(scheme).__name__, not_whole(machine, uncertain)
    if found:
        raise ValueError(
            f"|Q (1 - L P)| is that of trials which start alike, of records that come whole and in "
            f"time. Found: {found}. Take it out to judge the filter; with it, `jaxilc certify` "
            "says what it can claim, and `jaxilc sweep` simulates"
        )
    if not scheme.learns:
        raise ValueError(f"{name} does not learn; allowed is a scheme with a linear learning law")
    laws = (linear_law(scheme, task), of_last_trial(scheme, task))
    for held in (*laws, invariant_loop(machine.unrounded(), scheme, task)):
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


# How far a law may go with a margin
# --------------------------------------------------------------------------------------------------


def offers_of(
    found: Question, inner: Lines, machine: Machine, scheme: Scheme, task: Task, margin: float
) -> list[Offer]:
    """The largest cutoff, the largest gain and the best lead that keep a margin.

    Each is changed alone, except that the best lead comes with the largest cutoff that it allows.
    Where the scheme has no filter, one is offered on top of it. What the lines of the grid allow is
    enclosed between them on the worst plants, and reduced until the margin is kept there too.
    Nothing is offered where a loop is not stable.
    """
    places, offers, allowed = found.places, [], 1 - margin
    if not found.stable:
        return offers
    lead = int(get_at(scheme, places.lead)) if places.lead else 0
    for what in kinds(places):
        target = allowed
        for _ in range(ATTEMPTS):
            change = changed(what, [inner], found.now.change, target, 2 / task.duration, lead)
            if change is None:
                break
            offer = _offer(what, change, found, inner, scheme, task)
            if offer.peak <= allowed:
                made = scheme_of(scheme, places, change)
                offers.append(offer._replace(floor=floor_of(machine, made, task, offer.peak)))
                break
            target -= 2 * (offer.peak - allowed) + FINENESS
    return offers


def kinds(places: Places | None = None) -> list[str]:
    """What can be changed in a law."""
    if places is None:
        return [CUTOFF, GAIN, LEAD]
    filtered = bool(places.cutoff or places.gains)
    return [CUTOFF] * filtered + [GAIN] * bool(places.gains) + [LEAD] * bool(places.lead)


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
    tried = range(-lead, max(0, min(max(LEADS, 2 * lead), MOST_LEAD - lead)) + 1)
    best = best_lead(several, now, allowed, tried, lowest)
    return None if best is None else now._replace(lead=best[0], cutoff=rounded(best[1]))


def _offer(
    what: str, change: Change, found: Question, inner: Lines, scheme: Scheme, task: Task
) -> Offer:
    """The offer of a change, without its floor."""
    made = scheme_of(scheme, found.places, change)
    law, (keep, L) = law_of(made, task), law_on(made, task, inner.f)
    sizes = np.max(np.abs(keep - L * inner.P), axis=1)
    worst = {0, *np.argsort(-sizes)[:NEAREST].tolist()}
    top = max(float(largest_of(law, found.tried.loops[i], task).value) for i in worst)
    reach = curves_of(inner._replace(keep=keep, L=L)).learned_up_to
    settings = found.places.of(scheme, change)
    adds = not found.places.cutoff and bool(np.isfinite(change.cutoff))
    return Offer(what, settings, change, top, reach, np.nan, adds)


# Of a machine that was measured
# --------------------------------------------------------------------------------------------------


class PLaw(NamedTuple):
    """u_{j+1} = Q (u_j + gain e_j[k+1+lead]), with Q as `ZeroPhaseButterworth`.

    gain:   [unit of u per unit of y]
    lead:   up to 1000 [samples]; a loop that answers later is sampled more slowly than it is
    cutoff: [Hz]
    order:  of one pass of Q
    dt:     sample time [s]
    """

    gain: float
    lead: int
    cutoff: float
    order: int
    dt: float

    @property
    def scheme(self) -> Filtered:
        learning = PIDType(gamma_p=self.gain, lead=self.lead)
        return Filtered(learning, ZeroPhaseButterworth(self.cutoff, order=self.order))

    def check(self) -> None:
        """Raises ValueError for a number that is not allowed."""
        require("", "dt", self.dt, "(0, inf)")
        require("", "lead", self.lead, f"[0, {MOST_LEAD}]", whole=True)
        require("", "order", self.order, "[1, 100]", whole=True)
        if not np.isfinite(self.gain) or self.gain == 0:
            raise ValueError(f"gain = {self.gain:g} is not allowed; allowed is any other number")
        need_cutoff("", self.cutoff, self.dt)


class Spacing(NamedTuple):
    """A resonance of a record, and how many of its lines lie within its half-power width.

    frequency, width: [Hz]
    lines: number of lines within the width
    """

    frequency: float
    width: float
    lines: float

    @property
    def fine(self) -> bool:
        return self.lines >= LINES_IN_WIDTH


class RecordTest(NamedTuple):
    """The answer for one record.

    curves: on its lines; `high` is the robust value |Q (1 - L P)| + |Q L| s
    peak:   the largest robust value
    worst:  its frequency [Hz]
    resonances: of the record
    ends:   first and last line [Hz]
    unseen: largest |Q| beyond the last line
    """

    curves: Curves
    peak: float
    worst: float
    resonances: list[Spacing]
    ends: tuple[float, float]
    unseen: float


class MeasuredQuestion(NamedTuple):
    """The answer over several records: a test of each, the largest of them, and offers."""

    tests: list[RecordTest]
    offers: list[Offer]
    now: Offer

    @property
    def peak(self) -> float:
        return max(test.peak for test in self.tests)

    @property
    def top(self) -> int:
        """The index of the worst record."""
        return int(np.argmax([test.peak for test in self.tests]))


def measured_question(
    records: Sequence[MeasuredResponse], law: PLaw, *, sigmas: float = 3.0, margin: float = 0.1
) -> MeasuredQuestion:
    """The test of a law on records, and how far it may go with a margin on every line.

    sigmas: s_k in units of the standard deviation of a line, where it is exact. A line lies further
            away with the probability exp(-sigmas^2), if its scatter is complex normal

    Raises ValueError for a number outside its range, a line above the Nyquist frequency, and a
    record that starts above the cutoff or has fewer than 3 lines below it.
    """
    law.check()
    require("", "sigmas", sigmas, "[0, inf)")
    for i, record in enumerate(records):
        need_lines(record, law, f"record {i + 1}" if len(records) > 1 else "the record")
    inner = [lines_of(record, law, sigmas) for record in records]
    tests = [
        _tested(lines, law, record, sigmas) for lines, record in zip(inner, records, strict=True)
    ]
    now = Change(1.0, 0, law.cutoff, law.order)
    lowest = max(float(record.frequencies[0]) for record in records)
    offers = []
    for what in kinds():
        change = changed(what, inner, now, 1 - margin, lowest, law.lead)
        if change is not None:
            offers.append(_offer_on_records(what, change, law, records, sigmas))
    peak = max(test.peak for test in tests)
    reach = min(test.curves.learned_up_to for test in tests)
    return MeasuredQuestion(tests, offers, Offer("as it is", {}, now, peak, reach, np.nan))


def need_lines(record: MeasuredResponse, law: PLaw, name: str) -> None:
    """Raises ValueError where a record has no lines that a law can be tested on."""
    f, nyquist = record.frequencies, 0.5 / law.dt
    if f[-1] > nyquist * (1 + 1e-9):
        raise ValueError(
            f"{name} has a line at {f[-1]:.10g} Hz; allowed is up to {nyquist:.10g} Hz, Nyquist at "
            f"dt = {law.dt:g} s"
        )
    below = int(np.sum(f <= law.cutoff))
    if below < FEWEST:
        raise ValueError(
            f"{name} starts at {f[0]:g} Hz and has {below} lines up to the cutoff of "
            f"{law.cutoff:g} Hz; needed are {FEWEST} at least"
        )


def lines_of(record: MeasuredResponse, law: PLaw, sigmas: float) -> Lines:
    """The lines of a record with the law without its filter."""
    f = np.asarray(record.frequencies, float)
    L = law.gain * np.exp(2j * np.pi * f * law.dt * (1 + law.lead))
    P, scatter = np.asarray(record.response)[None], np.asarray(record.scatter(sigmas))[None]
    return Lines(f, P, scatter, np.ones(len(f), complex), L, law.dt)


def spacings(record: MeasuredResponse, sigmas: float = 3.0) -> list[Spacing]:
    """The resonances of a record, by peaks of |P| that stand out by 3 dB, with their widths.

    sigmas: scatter that does not lift a peak above the lines around it, as for `measured_question`
    """
    f, size = record.frequencies, np.abs(record.response)
    level = 20 * np.log10(np.maximum(size, 1e-300))
    peaks, around = find_peaks(level, prominence=HEIGHT)
    scatter = record.scatter(sigmas)
    least = np.maximum(*((size + scatter)[around[f"{side}_bases"]] for side in ("left", "right")))
    peaks = peaks[(size - scatter)[peaks] > least]
    ends = np.zeros_like(peaks), np.full_like(peaks, len(f) - 1)
    half_power = peak_widths(size**2, peaks, prominence_data=(size[peaks] ** 2, *ends))
    at = np.arange(len(f))
    return [
        Spacing(float(f[p]), float(np.interp(b, at, f) - np.interp(a, at, f)), float(width))
        for p, width, _, a, b in zip(peaks, *half_power, strict=True)
    ]


def _tested(inner: Lines, law: PLaw, record: MeasuredResponse, sigmas: float) -> RecordTest:
    Q = low_pass(inner.f, law.cutoff, law.dt, law.order)
    curves = curves_of(inner._replace(keep=Q * inner.keep, L=Q * inner.L))
    top = int(np.argmax(curves.high))
    ends = float(inner.f[0]), float(inner.f[-1])
    unseen = float(Q[-1]) if ends[1] < 0.499 / law.dt else 0.0
    return RecordTest(
        curves, float(curves.high[top]), float(inner.f[top]), spacings(record, sigmas), ends, unseen
    )


def _offer_on_records(what, change: Change, law: PLaw, records, sigmas: float) -> Offer:
    made = law._replace(
        gain=law.gain * change.gain, lead=law.lead + change.lead, cutoff=change.cutoff
    )
    tests = [_tested(lines_of(record, made, sigmas), made, record, sigmas) for record in records]
    now, then = law._asdict(), made._asdict()
    settings = {name: then[name] for name in ("gain", "lead", "cutoff") if then[name] != now[name]}
    reach = min(test.curves.learned_up_to for test in tests)
    return Offer(what, settings, change, max(test.peak for test in tests), reach, np.nan)
