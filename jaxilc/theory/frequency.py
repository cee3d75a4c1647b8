"""Conditions on the frequency response: what learning does to each frequency, trial after trial.

    |Q (keep - L P)| < 1

P(z) leads from what is learned to y. Q keep and Q L lead from what was learned, and from e, to what
is learned next. P is that of the simulator's own step (`loop`); the law is that of the scheme's own
learning (`law`), filters included. It is asked of one machine (`learning_condition`), of
norm-optimal learning with a model (`norm_optimal_condition`), of every plant within a bound
(`robust_condition`) and of a set of plants (`family_condition`). The largest value is enclosed
(`enclosure`), so that no peak lies between the lines of a grid. Frequencies are in Hz throughout.

On every plant P (1 + W D) with a stable D of |D| <= 1, |Q (keep - L P)| + |Q L P W| < 1 is enough
far from the ends of a long trial, and everywhere for a causal law. With a lead or a zero-phase
filter the ends need a proof of their own. On a trial of N samples M = X + Y D with

    X = Q (keep - L G),   Y = -Q L G W,   D lower triangular and Toeplitz, |D v| <= |v| for each v

where W is the causal operator of minimum phase. D commutes with each causal Psi, so that |Psi D v|
<= |Psi v|. If a matrix R fulfils

    R >= Psi'Psi + X'R X + X'R Y (Psi'Psi - Y'R Y)^-1 Y'R X,    Psi'Psi > Y'R Y

then |M v|_R <= |v|_R for all those D at once (S-procedure). If the inequality is strict, learning
converges on each plant. |Psi|^2 is taken as the share |Y| / (|X| + |Y|) of each frequency, and R is
found by iterating the right-hand side from the identity.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jax import lax

from ..learning.machine import Machine
from ..learning.over_trials import check
from ..plants import ProcessModel, StateSpace
from ..plants.structure import AFFINE, dependence
from ..pytree.in_short import in_short
from ..pytree.named_paths import get_at
from ..runtime.earlier_names import takes_also
from ..runtime.tiles import tiled_with
from ..schemes import NormOptimal, Scheme, WithFeedback
from ..signals.task import Task
from ..uncertainty import Normal, Population, Uncertainty, drawn_machine, drawn_machines
from .condition import Condition, Premise, condition, premise, share_alike
from .enclosure import Arc, Disc, arc_of_loop, arc_of_taps, balanced, exactly, size, supremum
from .law import Law, Taps, at_points, law_of, law_response, learning_law
from .learning_map import limit_names
from .lifted import lifted_plant
from .linearity import invariant_loop, linear_law, of_last_trial, whole_trials
from .loop import (
    Loop,
    each_of,
    linear_loop,
    minimal,
    on_circle,
    pole_radius,
    radius_of,
    response,
    responses,
    stable,
)
from .outlook import WHOLE, decays, outlooks
from .trials import shortened

__all__ = [
    "FamilyTest",
    "FrequencyTest",
    "Loop",
    "family_condition",
    "grid",
    "law_response",
    "learning_condition",
    "linear_loop",
    "norm_optimal_condition",
    "pole_radius",
    "response",
    "robust_condition",
]

STABLE = "loop stable"
WITHOUT_LIMIT = "machine and scheme have no limit"
CAUSAL = (
    "sup |Q (keep - L P)| < 1, law and loop causal: in every trial what is learned comes nearer to "
    "its limit by this factor or more in "
    "the 2-norm (Norrlöf, Gunnarsson 2002; Bristow 2006; Li 2020, eq. 9 for Q = keep = 1)"
)
LEARNING = (
    "sup |Q (keep - L P)| < 1: far from the ends of a long trial each frequency of what is learned "
    "comes nearer to its limit by this factor or more in every trial (Norrlöf, Gunnarsson 2002; "
    "Bristow 2006; Li 2020, eq. 9); the whole trial converges as its premise says"
)
NORM_OPTIMAL = (
    "|W_D + W_e G* (G - G_t)| < W_e |G|^2 + W_u + W_D: far from the ends of a long trial, "
    "norm-optimal learning with the model G "
    "contracts each frequency on the plant G_t (MILC 2024, eq. 7 and 8, frequency by frequency)"
)
ROBUST = (
    "sup |Q| (|keep - L P| + |L P W|) < 1, for every plant P (1 + W D) with a stable |D| <= 1: far "
    "from the ends of a long trial each frequency comes nearer to its limit by this factor or "
    "more in every trial (Bristow 2006); the whole trial as its premise says"
)
CAUSAL_WHOLE = premise(WHOLE, True, "law and loop are causal")
TRIED = (
    "sup |Q (keep - L P)| < 1 for each of the plants that were tried: samples of the box, its "
    "corners, and where gradient ascent from the "
    "worst of them ended. Of the plants between them nothing is proved. For each one tried: "
)
DENSE = 256  # samples of the trial at which the ends are looked at
POINTS = 2048  # frequencies of a spectral factor
FADED = 1e-6  # share of a response that counts as forgotten
SLACK = 1e-3  # by which R is made larger in each iteration
ITERATIONS = 200
BETWEEN = 65  # lines of the ascent between those next to the largest
CORNERS = 8  # names up to which all corners of the box are tried


class FrequencyTest(NamedTuple):
    """A condition with the curve behind it.

    condition:   on the supremum, whose value is enclosed from above
    frequencies: (F,) [Hz]
    magnitude:   (F,) what must stay below 1
    worst:       frequency of the supremum [Hz]
    critical:    first frequency at which the magnitude reaches 1 [Hz]; inf if it never does
    """

    condition: Condition
    frequencies: np.ndarray
    magnitude: np.ndarray
    worst: float
    critical: float


class FamilyTest(NamedTuple):
    """A condition over a parametric set of plants.

    condition: on the supremum over the plants tried and over all frequencies
    at:        the numbers of the worst plant, by name
    worst:     the frequency at which it is worst [Hz]
    values:    (S,) supremum of each plant tried
    critical:  (S,) critical frequency of each plant tried [Hz]
    drawn:     {name: (S,)} the numbers of each plant tried
    """

    condition: Condition
    at: dict[str, float]
    worst: float
    values: np.ndarray
    critical: np.ndarray
    drawn: dict[str, np.ndarray]
    __repr__ = in_short


# A loop, a learning law, and the premises that conditions on both share
# --------------------------------------------------------------------------------------------------


class Parts(NamedTuple):
    """A loop and a learning law, for a condition on both.

    loop:     balanced where it is stable
    law:      its taps
    causal:   whether both are causal and the trial cuts the law off at its ends as it does the loop
    premises: on loop and law, for a trial of any length
    """

    loop: Loop
    law: Law
    causal: bool = False
    premises: tuple[Premise, ...] = ()

    def gain(self, centre, h) -> Arc:
        """Q L P on arcs."""
        return arc_of_taps(self.law.L, centre).times(arc_of_loop(self.loop, centre, h), h)

    def nominal(self, centre, h) -> Arc:
        """Q (keep - L P) on arcs."""
        return arc_of_taps(self.law.keep, centre).minus(self.gain(centre, h))

    def bounds(self, centre, h):
        """|Q (keep - L P)| as `supremum` asks for it."""
        return self.nominal(centre, h).bounds(h)


def parts_of(machine: Machine, scheme: Scheme, task: Task) -> Parts:
    """The parts of the conditions of a machine under a scheme, after its last change.

    Raises ValueError where machine, scheme and task do not fit, or for a scheme that learns no
    feedforward.
    """
    check(machine, scheme, task)
    task = machine.at_trial(task, None)[1]
    loop, law = reduced(machine, scheme, task), law_of(scheme, task)
    premises = (
        invariant_loop(machine, scheme, task),
        of_poles([loop]),
        linear_law(scheme, task),
        of_last_trial(scheme, task),
        whole_trials(machine, scheme, task),
        law.invariant,
    )
    return Parts(loop, law, law.causal and law.cut_off(scheme, task), premises)


def reduced(machine: Machine, scheme: Scheme | None, task: Task) -> Loop:
    """The minimal loop without limits, balanced where it is stable."""
    loop = _compiled_loop(machine.unlimited(), None if scheme is None else scheme.unlimited(), task)
    return balanced(minimal(loop, task.N))


def of_poles(loops: list[Loop]) -> Premise:
    """The premise that loops are stable."""
    radius = max(map(radius_of, loops))
    return premise(STABLE, stable(radius), f"largest |pole| {radius:.6g}")


def of_trial(machines: Machine, scheme: Scheme, task: Task, causal: bool) -> list[Premise]:
    """The premises that the whole trial learns as the middle of a long one, and meets no limit.

    They are looked at on each of the machines.
    """
    limited = bool(limit_names(machines, scheme, task))
    if causal and not limited:
        return [CAUSAL_WHOLE]
    ahead = outlooks(machines, scheme, task) if limited else None
    decay = decays(machines, scheme, task) if ahead is None else ahead.decay
    return [decay.of_whole(causal), *([ahead.of_limits] if ahead is not None else [])]


# A curve over frequency
# --------------------------------------------------------------------------------------------------


def grid(task: Task, *, points: int = 1000, near=()) -> np.ndarray:
    """(F,) frequencies [Hz] from 0.001 / duration to the Nyquist frequency.

    They are equidistant in the logarithm, and denser around the poles z that `near` gives.
    """
    nyquist, near = 0.5 / task.dt, np.asarray(near, complex)
    near = near[np.abs(near) > 1e-3]
    centre, width = np.abs(np.angle(near)), np.abs(np.log(np.abs(near)))
    around = centre[:, None] + width[:, None] * np.linspace(-3, 3, 31)
    around = around.ravel() / (2 * np.pi * task.dt)
    lowest = 1e-3 / task.duration
    inside = around[(around > lowest) & (around < nyquist)]
    return np.unique(np.concatenate([np.geomspace(lowest, nyquist, points), inside]))


def lines(task: Task, frequencies, loops: list[Loop]) -> np.ndarray:
    """The frequencies asked for, checked; or a `grid` that is denser around the poles."""
    if frequencies is None:
        finite = [loop.A for loop in loops if np.all(np.isfinite(loop.A))]
        return grid(task, near=np.concatenate([[], *map(np.linalg.eigvals, finite)]))
    f, nyquist = np.asarray(frequencies, float), 0.5 / task.dt
    ascends = f.ndim == 1 and len(f) >= 2 and f[0] > 0 and not np.any(np.diff(f) <= 0)
    if not ascends or f[-1] > nyquist * (1 + 1e-9):
        raise ValueError(
            f"frequencies = {f} must ascend within (0, {nyquist:g}] Hz, Nyquist at dt = "
            f"{task.dt:g} s"
        )
    return f


class Largest(NamedTuple):
    """The largest value of a curve.

    value:    the supremum, enclosed from above
    worst:    its frequency [Hz]
    critical: frequency at which 1 is first reached [Hz]
    radius:   largest |pole| of the loops
    """

    value: float
    worst: float
    critical: float
    radius: float


def largest_of(law: Law, loop: Loop, task: Task, frequencies=None) -> Largest:
    """sup |Q (keep - L P)| of a law over a minimal loop.

    frequencies: (F,) [Hz] at which the first crossing of 1 is looked for; None for `lines`
    """
    f, loop = lines(task, frequencies, [loop]), balanced(loop)
    return enclosed(Parts(loop, law).bounds, [loop], task, f)[1]


def on_supremum(
    bounds: Callable,
    theorem: str,
    loops: list[Loop],
    task: Task,
    premises: Iterable[Premise],
    of_whole: Callable[[], list[Premise]] = list,
    frequencies=None,
) -> FrequencyTest:
    """The condition on the supremum of a function of the angle.

    bounds:   the function, as `enclosure.supremum` takes it
    of_whole: () -> further premises, on the whole trial; not called where the condition fails
              anyway
    """
    f = lines(task, frequencies, loops)
    curve, found = enclosed(bounds, loops, task, f)
    premises = [*premises, *(of_whole() if found.value < 1 else [])]
    claimed = condition(found.value, theorem, premises=premises)
    return FrequencyTest(claimed, f, curve, found.worst, found.critical)


def enclosed(bounds: Callable, loops: list[Loop], task: Task, f) -> tuple[np.ndarray, Largest]:
    """The curve on the lines f (F,) [Hz], and its largest value.

    Where a loop is unstable nothing is claimed, and the largest value is that on the lines.
    """
    to_angle, radius = 2 * np.pi * task.dt, max(map(radius_of, loops))

    def magnitude(f):
        angle = to_angle * np.asarray(f, float)
        return np.nan_to_num(bounds(angle, np.zeros_like(angle))[0], nan=np.inf, posinf=np.inf)

    curve = magnitude(f)
    value, worst = float(np.max(curve)), float(f[np.argmax(curve)])
    if stable(radius):
        found = supremum(bounds)
        worst = found.angle / to_angle if found.value > value else worst
        value = max(found.bound, value)
    return curve, Largest(value, worst, _first_crossing(magnitude, f, curve, worst), radius)


def _first_crossing(magnitude, f, curve, worst) -> float:
    """The first frequency at which the curve reaches 1, refined between the lines.

    Where no line reaches 1, it is the frequency of the peak, if that does.
    """
    if not np.any(curve >= 1):
        return float(worst) if magnitude([worst])[0] >= 1 else np.inf
    i = int(np.argmax(curve >= 1))
    low, high = f[max(i - 1, 0)], f[i]
    for _ in range(4 if i else 0):
        fine = np.linspace(low, high, 33)
        i = max(int(np.argmax(magnitude(fine) >= 1)), 1)
        low, high = fine[i - 1], fine[i]
    return float(high)


def weight_on(weight, centre, h, dt) -> np.ndarray:
    """(F,) a weight on arcs.

    weight: a number; or a function of f [Hz], of which the largest value at the middle and the ends
            of each arc is taken
    """
    if not callable(weight):
        return np.broadcast_to(np.asarray(weight, float), np.shape(centre))
    at = np.clip(np.stack([centre - h, centre, centre + h]), 0.0, np.pi) / (2 * np.pi * dt)
    return np.max(np.stack([np.broadcast_to(weight(f), f.shape) for f in at]), axis=0).astype(float)


# The conditions
# --------------------------------------------------------------------------------------------------


def learning_condition(
    machine: Machine, scheme: Scheme, task: Task, *, frequencies=None
) -> FrequencyTest:
    """sup_w |Q (keep - L P)| < 1, with the critical frequency.

    For P-type learning over feedback it is Li 2020, eq. 9: |1 - phi z G / (1 + C G)| < 1. Of
    several channels it is the largest singular value.

    frequencies: (F,) [Hz] ascending, at which the curve is shown; None for `grid`. The supremum is
                 over all frequencies

    Raises ValueError where machine, scheme and task do not fit.
    """
    parts = parts_of(machine, scheme, task)

    def of_whole():
        return of_trial(drawn_machines(machine, {}, {}), scheme, task, parts.causal)

    theorem, loops = CAUSAL if parts.causal else LEARNING, [parts.loop]
    return on_supremum(parts.bounds, theorem, loops, task, parts.premises, of_whole, frequencies)


def norm_optimal_condition(
    model: Machine,
    machine: Machine,
    scheme: Scheme | None,
    task: Task,
    *,
    w_e,
    w_u,
    w_delta,
    frequencies=None,
) -> FrequencyTest:
    """sup_w |W_D + W_e G* (G - G_t)| / (W_e |G|^2 + W_u + W_D) < 1, of norm-optimal learning.

    G is the model that the scheme learns with, and G_t is the plant. Frequency by frequency

        J = W_e |e|^2 + W_u |u|^2 + W_D |u - u_j|^2,    e_j = r - G_t u_j

    is least at u_{j+1} = (W_e |G|^2 + W_u + W_D)^-1 ((W_D + W_e |G|^2) u_j + W_e G* e_j). Of
    several channels it is the norm of H^-1 (W_D I + W_e G^H (G - G_t)).

    model, machine: G and G_t, both under the feedback of `scheme`; None is no feedback
    w_e, w_u, w_delta: numbers, or functions of f [Hz]. Functions are taken as constant from line to
                    line, and no premise then covers the ends of the trial
    """
    for one in (model, machine):
        one.check(task) if scheme is None else check(one, scheme, task)
    G, G_t = (reduced(one, scheme, task) for one in (model, machine))
    weights = (w_e, w_u, w_delta)
    premises = [invariant_loop(one, scheme, task) for one in (model, machine)]

    def of_whole():
        of_functions = any(map(callable, weights))
        return [] if of_functions else [_of_norm_optimal(G, machine, scheme, task, weights)]

    def bounds(centre, h):
        """|H^-1 (W_D I + W_e G^H (G - G_t))|"""
        e, u, delta = (weight_on(w, centre, h, task.dt) for w in weights)
        of_G, of_G_t = (arc_of_loop(loop, centre, h) for loop in (G, G_t))
        one = np.broadcast_to(np.eye(G.B.shape[1]), (len(h), *(G.B.shape[1],) * 2)).astype(complex)
        still, pull = Arc(one, np.zeros_like(one), np.zeros(len(h))), of_G.adjoint.scaled(e)
        H = pull.times(of_G, h).plus(still.scaled(u + delta))
        left = still.scaled(delta).plus(pull.times(of_G.minus(of_G_t), h))
        return H.inverse(h).times(left, h).bounds(h)

    premises.append(of_poles([G, G_t]))
    return on_supremum(bounds, NORM_OPTIMAL, [G, G_t], task, premises, of_whole, frequencies)


def _of_norm_optimal(
    G: Loop, machine: Machine, feedback: Scheme | None, task: Task, weights
) -> Premise:
    """The premise that norm-optimal learning with these weights converges on the whole trial."""
    w_e, w_u, w_delta = weights
    try:
        learning = NormOptimal(StateSpace(G.A, G.B, G.C, dt=task.dt), w_q=w_e, w_s=w_u, w_r=w_delta)
    except ValueError as error:
        return premise(WHOLE, False, str(error))
    feedback = getattr(feedback, "feedback", feedback)
    scheme = learning if feedback is None else WithFeedback(learning, feedback)
    return decays(drawn_machines(machine, {}, {}), scheme, task).of_whole()


def robust_condition(
    machine: Machine, scheme: Scheme, task: Task, weight, *, frequencies=None
) -> FrequencyTest:
    """sup_w |Q| (|keep - L P| + |L P W|) < 1, for all plants P (1 + W D) with |D| <= 1.

    weight:      |W|, a number or a function of f [Hz], taken as constant from line to line of the
                 grid
    frequencies: as for `learning_condition`

    Raises ValueError where machine, scheme and task do not fit, or for a weight that is negative.
    """
    parts = parts_of(machine, scheme, task)
    weights = weight_on(weight, np.linspace(0, np.pi, POINTS + 1), 0.0, task.dt)
    if not np.all(weights >= 0):
        least = np.min(weights)
        raise ValueError(
            f"robust_condition: weight is {least:g} at some frequency; allowed is [0, inf)"
        )

    def bounds(centre, h):
        nominal, gain = parts.nominal(centre, h), parts.gain(centre, h)
        W = weight_on(weight, centre, h, task.dt)
        at_ends = np.max(nominal.ends(h) + W * gain.ends(h), axis=0)
        curve = nominal.curve + W * gain.curve
        return size(nominal.value) + W * size(gain.value), at_ends + h**2 * curve

    limits = limit_names(drawn_machines(machine, {}, {}), scheme, task)
    said = f"{', '.join(limits)}: whether one is met depends on the plant" if limits else "none"
    premises = [*parts.premises, premise(WITHOUT_LIMIT, not limits, said)]

    def of_whole():
        if parts.causal:
            return [CAUSAL_WHOLE]
        return [_whole_trial(machine, scheme, task, parts, weights)]

    return on_supremum(bounds, ROBUST, [parts.loop], task, premises, of_whole, frequencies)


@takes_also(samples="machines")
def family_condition(
    machine: Machine,
    uncertainty: Uncertainty,
    scheme: Scheme,
    task: Task,
    *,
    machines: int = 128,
    sampling: str = "latin-hypercube",
    seed: int = 0,
    climbers: int = 8,
    steps: int = 60,
    frequencies=None,
) -> FamilyTest:
    """sup |Q (keep - L P)| over the box of numbers that the distributions span.

    Plants are drawn at random, the corners of the box are added, and from the worst of them
    gradient ascent goes on:

        p <- clip(p + h g / |g|),  g = d/dp max_w |Q (keep - L P(p))|

    h grows by 1.5 after a gain and is halved after a loss. The ascent runs on a grid of frequencies
    for each plant it starts from, and keeps a plant only if it is worse than the one before. Every
    plant that is tried is then enclosed over all frequencies, so that the worst of them is found
    reliably.

    machines, sampling, seed: as for `uncertainty.draw`; a number that a normal distribution puts
                  outside the box is moved into it; `samples` is an earlier name of `machines`
    climbers:    how many of the worst plants the ascent starts from; 0 for no ascent
    steps:       of each ascent
    frequencies: (F,) at which the ascent looks [Hz]; None for a `grid`

    Premises that differ from plant to plant are looked at for every plant tried. Raises ValueError
    as `draw` does.
    """
    population = Population(machine, uncertainty, count=machines, seed=seed, sampling=sampling)
    found = tried_plants(
        population, scheme, task, climbers=climbers, steps=steps, frequencies=frequencies
    )
    top, parts = found.top, parts_of(machine, scheme, task)
    radius = np.max(found.radii)
    poles = premise(STABLE, stable(found.radii), f"largest |pole| {radius:.6g}")
    held = [poles if p.name == STABLE else p for p in parts.premises]
    if found.values[top] < 1:
        every = drawn_machines(machine, uncertainty, found.drawn)
        held += of_trial(every, scheme, task, parts.causal)
    theorem = TRIED + (CAUSAL if parts.causal else LEARNING)
    claimed, worst = condition(found.values[top], theorem, premises=held), float(found.worst[top])
    return FamilyTest(claimed, found.at, worst, found.values, found.critical, found.drawn)


class Tried(NamedTuple):
    """The plants of a box that were tried, without the premises of a claim.

    names:    of the numbers that differ
    points:   (S, names) the numbers of each plant
    values, worst, critical: (S,) supremum, its frequency and the critical frequency [Hz]
    radii:    (S,) largest |pole| of each loop
    loops:    the minimal loop of each plant
    """

    names: tuple[str, ...]
    points: np.ndarray
    values: np.ndarray
    worst: np.ndarray
    critical: np.ndarray
    radii: np.ndarray
    loops: list[Loop]

    @property
    def top(self) -> int:
        """The index of the worst plant."""
        return int(np.argmax(self.values))

    @property
    def at(self) -> dict[str, float]:
        """The numbers of the worst plant, by name."""
        return dict(zip(self.names, map(float, self.points[self.top]), strict=True))

    @property
    def drawn(self) -> dict[str, np.ndarray]:
        return {name: self.points[:, i] for i, name in enumerate(self.names)}


def tried_plants(
    population: Population,
    scheme: Scheme,
    task: Task,
    *,
    climbers: int = 8,
    steps: int = 60,
    frequencies=None,
) -> Tried:
    """sup |Q (keep - L P)| of each plant that `family_condition` tries; the options are its own.

    Without uncertainty the one plant is the machine itself. Raises ValueError as `draw` does.
    """
    machine, uncertainty = population.machine, population.uncertainty
    check(machine, scheme, task)
    task = machine.at_trial(task, None)[1]
    names, law = tuple(uncertainty.items()), law_of(scheme, task)
    points = _points(population)
    common = (machine, scheme.unlimited(), task)

    def tried(points):
        whole = loops_at(machine, scheme, task, uncertainty, points)
        loops = [minimal(one, task.N) for one in whole]
        found = [largest_of(law, loop, task, frequencies) for loop in loops]
        return [np.array(x) for x in zip(*found, strict=True)], loops

    numbers, loops = tried(points)
    if climbers and names:
        first = np.argsort(-numbers[0])[:climbers]
        f = np.unique(np.concatenate([lines(task, frequencies, []), numbers[1][first]]))
        taps = tuple(Taps(*map(jnp.asarray, part)) for part in (law.keep, law.L))
        fixed = (*common, jnp.asarray(f), taps, *map(jnp.asarray, _box(uncertainty)))
        climb = tiled_with(_climb, names=names, steps=steps)
        climbed = np.asarray(climb(fixed, jnp.asarray(points[first])))
        further, loops_there = tried(climbed)
        points, loops = np.concatenate([points, climbed]), loops + loops_there
        numbers = [np.concatenate(x) for x in zip(numbers, further, strict=True)]
    return Tried(tuple(uncertainty), points, *numbers, loops)


def loops_at(
    machine: Machine, scheme: Scheme, task: Task, uncertainty: Uncertainty, points
) -> list[Loop]:
    """The loop of each plant, with all its states, without limits.

    points: (S, names) the numbers of each plant
    """
    common = (machine, scheme.unlimited(), task)
    run = tiled_with(_loop_of, names=tuple(uncertainty.items()))
    return each_of(run(common, jnp.asarray(points)))


_compiled_loop = jax.jit(linear_loop)


# The whole trial on every plant P (1 + W D)
# --------------------------------------------------------------------------------------------------


def _whole_trial(machine: Machine, scheme: Scheme, task: Task, parts: Parts, weights) -> Premise:
    """The premise, by the matrix R, that learning converges on every plant over a whole trial."""
    short = shortened(task, min(task.N, DENSE))
    try:
        scheme.check(short)
    except ValueError as error:
        return premise(WHOLE, False, f"looked at in {short.N} samples, where {error}")
    memory = _memory(parts)
    if short.N < task.N and memory > short.N // 2:
        said = f"looked at in {short.N} samples, but loop and law take {memory} to forget"
        return premise(WHOLE, False, said)
    machine, scheme = machine.unlimited(), scheme.unlimited()
    G, law = lifted_plant(machine, scheme, short), learning_law(scheme, short)
    width = G.shape[1] // short.N
    W = _causal(weights, short.N, width)
    X, Y = law.keep - law.L @ G, law.L @ G @ W
    steps = _iterated(X, Y, _causal(np.sqrt(_shares(parts, weights)), short.N, width))
    seen = "found" if steps else "not found"
    said = f"a norm that falls on every plant was {seen} for a trial of {short.N} samples"
    return premise(WHOLE, steps > 0, said)


def _memory(parts: Parts) -> int:
    """The number of samples in which the responses of loop and law fade."""
    radius = np.clip(radius_of(parts.loop), 1e-6, 1 - 1e-12)
    reach = [int(np.ceil(np.log(FADED) / np.log(radius)))]
    for taps in (parts.law.keep, parts.law.L):
        counts = size(taps.taps) > FADED * np.max(size(taps.taps), initial=0.0)
        reach.append(int(np.max(np.abs(taps.powers[counts]), initial=0)))
    return max(reach)


def _shares(parts: Parts, weights) -> np.ndarray:
    """(POINTS+1,) |Y| / (|X| + |Y|) of each frequency, kept away from 0 and 1."""
    angle = np.linspace(0, np.pi, POINTS + 1)
    still = np.zeros_like(angle)
    nominal, gain = size(parts.nominal(angle, still).value), size(parts.gain(angle, still).value)
    total = nominal + weights * gain
    share = np.clip(weights * gain / np.maximum(total, 1e-300), SLACK, 1 - SLACK)
    return share * np.max(total) ** 2


def _causal(magnitude, N: int, width: int):
    """(N width, N width) the lower triangular operator of minimum phase with a given magnitude.

    The magnitude (POINTS+1,) is given at equidistant angles.
    """
    cepstrum = np.fft.irfft(np.log(np.maximum(magnitude, 1e-9 * np.max(magnitude, initial=1e-200))))
    folded = np.concatenate(
        [cepstrum[:1], 2 * cepstrum[1:POINTS], cepstrum[POINTS : POINTS + 1], np.zeros(POINTS - 1)]
    )
    taps = np.fft.irfft(np.exp(np.fft.rfft(folded)))[:N]
    return np.kron(scipy.linalg.toeplitz(taps, np.zeros(N)), np.eye(width))


def _iterated(X, Y, Psi) -> int:
    """The number of iterations after which R fulfils its inequality; 0 if it is not seen to."""
    share, R = Psi.T @ Psi, np.eye(len(X))
    for i in range(ITERATIONS):
        RX, RY = R @ X, R @ Y
        try:
            factor = scipy.linalg.cho_factor(share - Y.T @ RY)
        except scipy.linalg.LinAlgError:
            return 0
        wanted = share + X.T @ RX + RX.T @ Y @ scipy.linalg.cho_solve(factor, Y.T @ RX)
        wanted = (wanted + wanted.T) / 2
        if _positive(R - wanted):
            return i + 1
        R = (1 + SLACK) * wanted
    return 0


def _positive(M) -> bool:
    try:
        np.linalg.cholesky(M - 1e-9 * np.max(np.abs(np.diag(M))) * np.eye(len(M)))
    except np.linalg.LinAlgError:
        return False
    return True


# The plants of a box
# --------------------------------------------------------------------------------------------------


def _box(uncertainty: Uncertainty) -> np.ndarray:
    """(2, names) the least and the largest number by each distribution."""
    return np.sort([d.corners() for d in uncertainty.values()]).T


def _corners(uncertainty: Uncertainty) -> np.ndarray:
    """(2^names, names) the corners of the box; the last number changes first."""
    return np.array(list(itertools.product(*_box(uncertainty).T)))


def _points(population: Population) -> np.ndarray:
    """(S, names) the plants drawn, moved into the box, and its corners."""
    if not population.uncertainty:
        return np.zeros((1, 0))
    points = np.stack([*population.drawn.values()], axis=1)
    points = np.clip(points, *_box(population.uncertainty))
    if len(population.uncertainty) > CORNERS:
        return points
    return np.concatenate([points, _corners(population.uncertainty)])


def _loop_of(common, point, *, names):
    machine, scheme, task = common
    values = {name: point[i] for i, (name, _) in enumerate(names)}
    return linear_loop(drawn_machine(machine, dict(names), values).unlimited(), scheme, task)


def _climb(common, start, *, names, steps):
    """Where projected gradient ascent from `start` ends.

    Both are in the units of the numbers drawn; the ascent runs in the unit box.
    """
    machine, scheme, task, f, (keep, L), low, high = common
    z = on_circle(f, task.dt)
    law = at_points(keep, z), at_points(L, z)

    def sizes(loop, f, law):
        M = law[0] - law[1] @ response(loop, f, task.dt)
        if M.shape[1:] == (1, 1):
            return jnp.abs(M[:, 0, 0])
        return jnp.linalg.svd(M, compute_uv=False)[:, 0]

    def peak(x):
        """The largest size on the grid, and then between its neighbours.

        So no line of the grid is a local maximum only because it is a line of the grid.
        """
        loop = _loop_of((machine, scheme, task), low + (high - low) * x, names=names)
        i = jnp.argmax(sizes(loop, f, law))
        between = jnp.linspace(f[jnp.maximum(i - 1, 0)], f[jnp.minimum(i + 1, len(f) - 1)], BETWEEN)
        z = on_circle(between, task.dt)
        found = sizes(loop, between, (at_points(keep, z), at_points(L, z)))
        return found[jnp.argmax(found)]

    def ascend(_, now):
        x, value, g, h = now
        free = jnp.where(((x <= 0) & (g < 0)) | ((x >= 1) & (g > 0)), 0.0, g)
        length = jnp.maximum(jnp.linalg.norm(free), jnp.finfo(float).tiny)
        moved = jnp.clip(x + h * free / length, 0.0, 1.0)
        there, slope = jax.value_and_grad(peak)(moved)
        better, value = there > value, jnp.maximum(there, value)
        x, g = jnp.where(better, moved, x), jnp.where(better, slope, g)
        return x, value, g, h * jnp.where(better, 1.5, 0.5)

    x = (start - low) / (high - low)
    x = lax.fori_loop(0, steps, ascend, (x, *jax.value_and_grad(peak)(x), jnp.asarray(0.1)))[0]
    return low + (high - low) * x


# What is proved of the whole box
# --------------------------------------------------------------------------------------------------

MOST_NUMBERS = 3  # beside the gain, over which boxes are split
SAME = 1e-8  # relative difference of the formula from the loop that rounding explains
WIDE = 0.02  # relative distance of the bound from the largest value found
LOOKED_AT = 400_000  # boxes before the bound is left as wide as it is
CHUNK = 40_000  # boxes at a time
SHAPES = ("gain", "zeros", "poles", "frequencies", "dampings")


class WholeSet(NamedTuple):
    """What is proved of |Q (keep - L P)| over all plants of the box and all frequencies.

    bound: no plant of the box exceeds it; inf where nothing is proved
    how:   how it was proved, or why nothing is
    """

    bound: float
    how: str

    @property
    def proved(self) -> bool:
        return bool(np.isfinite(self.bound))


def bound_of_set(
    population: Population, scheme: Scheme, task: Task, law: Law, tried: Tried
) -> WholeSet:
    """The bound over the box that the distributions span. Two sets have one:

    - P is affine in each uncertain number while the others are held, as in a gain, in `plant.B` or
      in `plant.C`. Then |Q (keep - L P)| is convex in each number, so that it is largest at a
      corner of the box. Whether P is so is read off the program.
    - P is a `ProcessModel` without a feedback, and up to three of its zeros, poles, frequencies and
      dampings are uncertain beside the gain. With its poles l_i and one sample of dt under
      zero-order hold

          P(z) = gain (1 + sum_i r_i (z - 1) / (z - exp(l_i dt))),
          r_i  = -prod_m (1 - l_i / zeros_m) / prod_{k /= i} (1 - l_i / l_k)

      A delay of whole samples multiplies it by a power of z. It is enclosed by arithmetic of discs
      over boxes of frequency and of these numbers, which are split until none exceeds the largest
      value found by more than 2 % (branch and bound). P is linear in the gain, so that
      |Q (keep - L P)| is largest at one of its ends.

    law:   of the scheme
    tried: the plants that were tried, such as the corners of the box; some may lie beyond it
    """
    machine, uncertainty = population.machine, population.uncertainty
    if not np.all(stable(tried.radii)):
        return WholeSet(np.inf, "a loop that was tried is not stable")
    if not uncertainty:
        return WholeSet(float(tried.values[tried.top]), "there is one plant only")
    curved = _curved(machine, scheme, task, uncertainty)
    low, high = _box(uncertainty)
    at_end = np.isclose(tried.points[:, None], [low, high], rtol=1e-12, atol=0)
    corners = np.unique(np.argmax(at_end, 1)[np.all(np.any(at_end, 1), 1)], axis=0)
    within = (low <= tried.points) & (tried.points <= high) | np.any(at_end, 1)
    largest = float(np.max(tried.values[np.all(within, 1)], initial=tried.values[0]))
    normal = ", ".join(name for name, d in uncertainty.items() if isinstance(d, Normal))
    ends = f"; the box ends two standard deviations from the mean of {normal}" if normal else ""
    few = len(uncertainty) <= CORNERS  # else what moves is not looked at
    if not curved and few and len(corners) == 2 ** len(uncertainty):
        how = "P is affine in each uncertain number, so the worst plant is a corner of the box"
        return WholeSet(largest, how + ends)
    what = "not all corners were tried" if few else f"more than {CORNERS} numbers are uncertain"
    what = f"P is not affine in {', '.join(curved)}" if curved else what
    why = _not_a_process_model(machine, scheme, uncertainty)
    if not why and law.L.taps.shape[1:] != (1, 1):
        why = "the law has several channels"
    if not why:
        box = Boxes.of(machine, task, law, uncertainty)
        if box.departure(tried) > share_alike(SAME):
            why = "the loop is more than the plant and a delay of whole samples"
        else:
            bound, how = box.bound(largest)
            return WholeSet(bound, how + ends)
    return WholeSet(np.inf, f"{what}, and {why}: nothing is proved between the plants tried")


# By the corners of the box
# --------------------------------------------------------------------------------------------------


def _curved(machine, scheme, task, uncertainty: Uncertainty) -> list[str]:
    """The numbers of which P is not affine while the others are held, wherever these are.

    A, B and C are affine in each number by the program. A matrix that the program calls affine may
    never move, since 0 times a number counts as affine in it. It does not move with a number if it
    is the same at both ends of each edge of the box along that number, since it is affine in the
    other numbers too.
    """
    names, n = list(uncertainty), len(uncertainty)
    plant = machine.plant
    if isinstance(plant, StateSpace) and all(
        name in ("plant.B", "plant.C") and uncertainty[name].relative for name in names
    ):  # the zero-order hold is linear in B, which the program of a matrix exponential hides
        machine = machine.sampled(task.dt)
    fixed = (machine, scheme.unlimited(), task)
    middle = {name: jnp.asarray(np.mean(uncertainty[name].corners())) for name in names}

    def loop(fixed, value, name):
        *common, values = fixed
        machine = drawn_machine(common[0], uncertainty, values | {name: value})
        return linear_loop(machine.unlimited(), *common[1:])

    def curves(name):
        parts = dependence(partial(loop, name=name), (*fixed, middle), middle[name])
        return max(part.order for part in parts) > AFFINE

    curved = [name for name in names if curves(name)]
    if curved or n > CORNERS:
        return curved
    loops = loops_at(machine, scheme, task, uncertainty, _corners(uncertainty))
    at = [np.stack(one).reshape((2,) * n + (-1,)) for one in zip(*loops, strict=True)]
    for i, name in enumerate(names):
        A, B, C = (bool(np.any(np.diff(part, axis=i))) for part in at)
        if A or (B and C):
            curved.append(name)
    return curved


def _not_a_process_model(machine, scheme, uncertainty: Uncertainty) -> str:
    """Why the formula of a `ProcessModel` does not serve; empty where it does."""
    plant = machine.plant
    if not isinstance(plant, ProcessModel):
        return f"the plant is a {type(plant).__name__}, no ProcessModel"
    if machine.variation is not None and machine.variation.change is not None:
        return "the plant changes"
    if not scheme.plays_back:
        return "there is a feedback"
    shapes = [name.removeprefix("plant.").split("[")[0] for name in uncertainty]
    if not set(shapes) <= set(SHAPES) or not all(n.startswith("plant.") for n in uncertainty):
        return "a number is uncertain that is none of the process model's"
    if sum(shape != "gain" for shape in shapes) > MOST_NUMBERS:
        return f"more than {MOST_NUMBERS} numbers beside the gain are uncertain"
    return ""


# By boxes of frequency and of the numbers of a process model
# --------------------------------------------------------------------------------------------------


class Boxes(NamedTuple):
    """The response of a process model over boxes of angle and numbers.

    plant:  at its nominal values
    law:    taps
    gains:  (2,) the ends of the gain
    scale:  what the number drawn for the gain is multiplied by
    names:  of the other uncertain numbers, with the leaf, the index and whether it is relative
    low, high: (n,) their ends
    """

    plant: ProcessModel
    law: Law
    dt: float
    gains: np.ndarray
    scale: float
    names: list[tuple[str, int | None, bool]]
    low: np.ndarray
    high: np.ndarray

    @classmethod
    def of(cls, machine, task, law, uncertainty: Uncertainty) -> Boxes:
        gains, names, ends = np.repeat(float(machine.plant.gain), 2), [], []
        scale = 1.0
        for name, d in uncertainty.items():
            leaf, _, index = name.removeprefix("plant.").partition("[")
            low, high = sorted(d.corners())
            if leaf == "gain":
                scale = float(get_at(machine, name)) if d.relative else 1.0
                gains = scale * np.array([low, high])
            else:
                names.append((leaf, int(index[:-1]) if index else None, bool(d.relative)))
                ends.append((low, high))
        low, high = np.array(ends, float).reshape(-1, 2).T
        return cls(machine.plant, law, float(task.dt), gains, scale, names, low, high)

    def bound(self, best: float) -> tuple[float, str]:
        """The bound, and how it was found, from the largest value that is known so far."""
        n = len(self.names)
        edges = np.linspace(0.0, np.pi, 257)
        lows = np.column_stack([edges[:-1], *np.repeat(self.low[:, None], 256, axis=1)])
        highs = np.column_stack([edges[1:], *np.repeat(self.high[:, None], 256, axis=1)])
        looked, top = 0, best * (1 + WIDE)
        while len(lows):
            looked += len(lows)
            chunks = [slice(i, i + CHUNK) for i in range(0, len(lows), CHUNK)]
            found = [self._upper(lows[some], highs[some]) for some in chunks]
            upper, split = (np.concatenate(x) for x in zip(*found, strict=True))
            left = upper > top
            if looked > LOOKED_AT and np.any(left):
                reached = float(np.max(upper))
                what = f"after {looked} boxes of frequency and {n} numbers"
                return (reached if reached < 1 else np.inf), f"{what} it is {reached:.3g} or less"
            lows, highs = _halves(lows[left], highs[left], split[left])
        how = f"by {looked} boxes of frequency and {n} uncertain numbers, within {100 * WIDE:g} %"
        return top, how

    def _upper(self, lows, highs):
        """Upper bounds over boxes, and the side of each that makes it widest."""
        middle = (lows + highs) / 2
        angles, at = np.unique(middle[:, 0], return_inverse=True)  # many boxes have the same angle
        arcs = [Arc(*(of[at] for of in arc_of_taps(taps, angles))) for taps in self.law[:2]]
        upper = self._size(arcs, lows, highs).max(axis=0)
        alone = []
        for i in range(lows.shape[1]):
            a, b = middle.copy(), middle.copy()
            a[:, i], b[:, i] = lows[:, i], highs[:, i]
            alone.append(self._size(arcs, a, b).max(axis=0))
        return upper, np.argmax(np.nan_to_num(np.array(alone), posinf=1e300), axis=0)

    def _size(self, arcs: list[Arc], lows, highs) -> np.ndarray:
        """(2, B) the largest |keep - L P| on boxes, at both ends of the gain; arcs: keep and L."""
        centre, h = (lows[:, 0] + highs[:, 0]) / 2, (highs[:, 0] - lows[:, 0]) / 2
        keep, L = (arc.disc(h) for arc in arcs)
        LP = L.times(self._unit(lows, highs, Disc(np.exp(1j * centre), h)))
        return np.stack([keep.minus(LP.times(exactly(g))).largest for g in self.gains])

    def _unit(self, lows, highs, z: Disc) -> Disc:
        """P of gain 1 on boxes."""
        leaves = {
            name: [np.full(len(lows), v) for v in np.asarray(getattr(self.plant, name), float)]
            for name in SHAPES[1:]
        }
        low, high = dict(leaves), {name: list(values) for name, values in leaves.items()}
        for i, (leaf, index, relative) in enumerate(self.names):
            for j in range(len(low[leaf])) if index is None else [index]:
                scale = low[leaf][j] if relative else 1.0
                ends = np.sort([lows[:, i + 1] * scale, highs[:, i + 1] * scale], axis=0)
                low[leaf][j], high[leaf][j] = ends
        poles = [_interval(-b, -a) for a, b in zip(low["poles"], high["poles"], strict=True)]
        for j in range(len(low["frequencies"])):
            poles += _pair(*(x[n][j] for n in ("frequencies", "dampings") for x in (low, high)))
        ends = zip(low["zeros"], high["zeros"], strict=True)
        zeros = [_interval(a, b).inverse() for a, b in ends]
        late = round(self.plant.delay / self.dt)
        turned = z.centre**-late
        return _sampled(poles, zeros, z, self.dt).times(Disc(turned, late * z.radius))

    def departure(self, tried: Tried) -> float:
        """The largest relative difference of the formula from the loop, at plants that were tried.

        They are the nominal one and the last ones, which are corners of the box.
        """
        f, worst = np.linspace(0.01, 0.49, 41) / self.dt, 0.0
        kept = [i for i, name in enumerate(tried.names) if name != "plant.gain"]
        gain = [i for i, name in enumerate(tried.names) if name == "plant.gain"]
        z = exactly(np.exp(2j * np.pi * f * self.dt))
        for i in {0, len(tried.points) - 2, len(tried.points) - 1}:
            point = np.tile([0.0, *tried.points[i, kept]], (len(f), 1))
            P = responses([tried.loops[i]], f, self.dt)[0]
            scale = self.scale * tried.points[i, gain[0]] if gain else self.gains[0]
            ours = scale * self._unit(point, point, z).centre
            worst = max(worst, float(np.max(np.abs(P - ours)) / np.max(np.abs(P))))
        return worst


def _sampled(poles: list[Disc], inverse_zeros: list[Disc], z: Disc, dt: float) -> Disc:
    """P of gain 1 under zero-order hold, by its partial fractions."""
    one = exactly(np.ones(z.centre.shape))
    P = one
    for i, pole in enumerate(poles):
        residue = exactly(-np.ones(z.centre.shape))
        for inverse in inverse_zeros:
            residue = residue.times(one.minus(pole.times(inverse)))
        for k, other in enumerate(poles):
            if k != i:
                residue = residue.times(one.minus(pole.times(other.inverse())).inverse())
        decay = Disc(pole.centre * dt, pole.radius * dt).exponential()
        # (z - 1) / (z - a) = 1 - (1 - a) / (z - a)
        lag = one.minus(one.minus(decay).times(z.minus(decay).inverse()))
        P = P.plus(residue.times(lag))
    return P


def _pair(w_low, w_high, low, high) -> list[Disc]:
    """The two poles w exp(+- i (pi - acos damping)) of a pair; infinite at a damping of 1."""
    bad = high >= 1
    turn_low, turn_high = (np.arccos(np.minimum(end, 1.0)) for end in (high, low))
    w, turn = (w_low + w_high) / 2, (turn_low + turn_high) / 2
    radius = (w_high - w_low) / 2 + w_high * (turn_high - turn_low) / 2
    radius = np.where(bad, np.inf, radius)
    centre = -w * np.exp(-1j * turn)
    return [Disc(centre, radius), Disc(np.conj(centre), radius)]


def _interval(low, high) -> Disc:
    return Disc((low + high) / 2 + 0j, (high - low) / 2)


def _halves(lows, highs, split):
    """Each box as two, halved across one side."""
    rows = np.arange(len(lows))
    middle = (lows[rows, split] + highs[rows, split]) / 2
    first, second = highs.copy(), lows.copy()
    first[rows, split], second[rows, split] = middle, middle
    return np.concatenate([lows, second]), np.concatenate([first, highs])
