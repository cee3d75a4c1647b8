"""Is a Q-filter safe, and how far may one go: |Q (1 - L P)| of a family of machines or of records.

A machine that is simulated has a loop, and its curve is enclosed between the lines of the grid. A
machine that was measured has lines with a scatter, and between them nothing is proved.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..learning.machine import Machine
from ..pytree.named_paths import get_at
from ..schemes import Scheme
from ..signals.task import Task
from ..uncertainty import Uncertainty, drawn_machines
from .affine import view_of
from .family import Tried, tried_plants
from .filtered_law import (
    Change,
    Lines,
)
from .law import law_of, law_response
from .linearity import invariant_loop, linear_law, of_last_trial
from .loop import Loop, responses
from .outlook import maps_of
from .over_frequency import grid
from .parts_of_law import Places, places_in, without_low_pass
from .rounding import ball_of
from .whole_set import WholeSet, bound_of_set

POINTS = 600  # lines of the grid, beside those around the poles
BLOCKED = 1e-6  # |Q| below which Q (1 - L P) says nothing of 1 - L P
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


def curves_of(whole: Lines) -> Curves:
    """The curves of a law, its filter included: Q is what it keeps, and L P the rest by Q."""
    Q = whole.keep
    seen = np.abs(Q) > BLOCKED
    L = whole.L / np.where(seen, Q, 1.0)
    sizes = np.abs(whole.keep - whole.L * whole.P)
    spread = np.abs(whole.L) * whole.scatter
    without = np.max(np.abs(1 - L * whole.P) + np.abs(L) * whole.scatter, axis=0)
    return Curves(
        whole.f,
        whole.P[0],
        Q,
        L * whole.P[0],
        sizes[0],
        np.min(np.maximum(sizes - spread, 0), axis=0),
        np.max(sizes + spread, axis=0),
        np.where(seen, without, np.nan),
    )


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

    Of a machine that rounds it is that of the one that does not.

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
        Lines(f, P, np.zeros(P.shape), *law_on(one, task, f), task.dt)
        for one in (scheme, without_low_pass(scheme))
    )
    curves = curves_of(whole)
    proof = bound_of_set(machine, scheme, task, law, uncertainty, tried)
    top = float(tried.values[tried.top])
    places = places_in(scheme)
    cutoff = float(get_at(scheme, places.cutoff)) if places.cutoff else np.inf
    change = Change(1.0, 0, cutoff, places.order)
    now = Offer(
        "as it is", {}, change, top, curves.learned_up_to, floor_of(machine, scheme, task, top)
    )
    left = rounding_of(machine, scheme, task, top)
    return Question(
        tried, curves, proof, resonances_of(tried.loops[0], task.dt), places, now, left
    ), inner


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


def need_linear(machine: Machine, scheme: Scheme, task: Task) -> None:
    """Raises ValueError unless loop and law are linear and of one channel."""
    name = type(scheme).__name__
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


def law_on(scheme: Scheme, task: Task, f) -> tuple[np.ndarray, np.ndarray]:
    """(F,) keep and L of a law with one channel, at frequencies f (F,) [Hz]."""
    keep, L = (np.asarray(part)[:, 0, 0] for part in law_response(scheme, task, f))
    return keep, L
