"""Conditions on the frequency response: what learning does to each frequency, trial after trial.

    |Q (keep - L P)| < 1        P(z) from what is learned to y, Q keep and Q L from what was learned
    and from e to what is learned next

P is that of the simulator's own step (`loop`), the law that of the scheme's own learning (`law`),
filters included. The largest value is enclosed (`enclosure`), so that no peak lies between the
lines of a grid. Frequencies are in Hz throughout.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from ..learning.machine import Machine
from ..learning.over_trials import check
from ..plants import StateSpace
from ..schemes import NormOptimal, Scheme, WithFeedback
from ..signals.task import Task
from ..uncertainty import drawn_machines
from .affine import limit_names
from .condition import Condition, Premise, condition, premise
from .enclosure import Arc, arc_of_loop, arc_of_taps, balanced, size, supremum
from .law import Law, law_of
from .linearity import invariant_loop, linear_law
from .loop import Loop, linear_loop, minimal
from .outlook import NO_LIMIT, WHOLE, decays, outlooks

CAUSAL = (
    "sup |Q (keep - L P)| < 1, law and loop causal: in every trial what is learned comes nearer to its limit by this factor or more in "
    "the 2-norm (Norrlöf, Gunnarsson 2002; Bristow 2006; Li 2020, eq. 9 for Q = keep = 1)"
)
LEARNING = (
    "sup |Q (keep - L P)| < 1: far from the ends of a long trial each frequency of what is learned comes nearer to its limit by this "
    "factor or more in every trial (Norrlöf, Gunnarsson 2002; Bristow 2006; Li 2020, eq. 9); the whole trial converges as its premise says"
)
NORM_OPTIMAL = (
    "|W_D + W_e G* (G - G_t)| < W_e |G|^2 + W_u + W_D: far from the ends of a long trial, norm-optimal learning with the model G "
    "contracts each frequency on the plant G_t (MILC 2024, eq. 7 and 8, frequency by frequency)"
)
STABLE = "loop stable"


class FrequencyTest(NamedTuple):
    """A condition with the curve behind it.

    condition: on the supremum, whose value is enclosed from above;  frequencies: (F,) [Hz];
    magnitude: (F,) what must stay below 1
    worst: frequency of the supremum [Hz];  critical: first frequency at which the magnitude reaches
    1 [Hz], inf if none does
    """

    condition: Condition
    frequencies: np.ndarray
    magnitude: np.ndarray
    worst: float
    critical: float


def learning_condition(
    machine: Machine, scheme: Scheme, task: Task, *, frequencies=None
) -> FrequencyTest:
    """sup_w |Q (keep - L P)| < 1, with the critical frequency; of Li 2020, eq. 9, |1 - phi z G/(1 +
    C G)| < 1, for P-type over feedback.

    frequencies: (F,) [Hz] ascending, at which the curve is shown, None for `grid`; the supremum is
    over all. Several channels: the largest singular value. Raises ValueError where machine, scheme
    and task do not fit.
    """
    parts = parts_of(machine, scheme, task)

    def bounds(centre, h):
        return _largest(parts.nominal(centre, h), h)

    def of_whole():
        return of_trial(drawn_machines(machine, {}, {}), scheme, task, parts.causal)

    return on_supremum(
        bounds,
        CAUSAL if parts.causal else LEARNING,
        [parts.loop],
        task,
        parts.premises,
        of_whole,
        frequencies,
    )


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
    """sup_w |W_D + W_e G* (G - G_t)| / (W_e |G|^2 + W_u + W_D) < 1 for norm-optimal learning with
    the model G of the plant G_t.

    Frequency by frequency J = W_e |e|^2 + W_u |u|^2 + W_D |u - u_j|^2 is least at u_{j+1} = (W_e
    |G|^2 + W_u + W_D)^-1 ((W_D + W_e |G|^2) u_j + W_e G* e_j), and e_j = r - G_t u_j. Several
    channels: the norm of H^-1 (W_D I + W_e G^H (G - G_t)).
    model, machine: G and G_t, both under the feedback of `scheme` (None: none)
    w_e, w_u, w_delta: numbers, or functions of f [Hz], which are then taken as constant from line
    to line, and say nothing of the ends
    """
    for one in (model, machine):
        one.check(task) if scheme is None else check(one, scheme, task)
    G, G_t = (reduced(one, scheme, task) for one in (model, machine))
    weights = (w_e, w_u, w_delta)
    premises = [invariant_loop(one, scheme, task) for one in (model, machine)] + [
        of_poles([G, G_t], task)
    ]

    def of_whole():
        of_functions = any(map(callable, weights))
        return [] if of_functions else [_of_norm_optimal(G, machine, scheme, task, weights)]

    def bounds(centre, h):
        e, u, delta = (weight_on(w, centre, h, task.dt) for w in weights)
        return _largest(
            _norm_optimal(*(arc_of_loop(loop, centre, h) for loop in (G, G_t)), e, u, delta, h), h
        )

    return on_supremum(bounds, NORM_OPTIMAL, [G, G_t], task, premises, of_whole, frequencies)


class Parts(NamedTuple):
    """What the conditions of a law and a loop are made of.

    loop: balanced where it is stable;  law: its taps;  causal: both, and the trial cuts the law off
    at its ends as it cuts the loop off
    premises: on loop and law, for a trial of any length
    """

    loop: Loop
    law: Law
    causal: bool
    premises: list[Premise]

    def gain(self, centre, h) -> Arc:
        """Q L P on arcs."""
        return arc_of_taps(self.law.L, centre, h).times(arc_of_loop(self.loop, centre, h), h)

    def nominal(self, centre, h) -> Arc:
        """Q (keep - L P) on arcs."""
        return arc_of_taps(self.law.keep, centre, h).minus(self.gain(centre, h))


def parts_of(machine: Machine, scheme: Scheme, task: Task) -> Parts:
    """Raises ValueError where machine, scheme and task do not fit, or for a scheme that learns no
    feedforward.
    """
    check(machine, scheme, task)
    loop, law = reduced(machine, scheme, task), law_of(scheme, task)
    premises = [
        invariant_loop(machine, scheme, task),
        of_poles([loop], task),
        linear_law(scheme, task),
        law.invariant,
    ]
    return Parts(loop, law, law.causal and law.cut_off(scheme, task), premises)


def reduced(machine: Machine, scheme: Scheme | None, task: Task) -> Loop:
    """The minimal loop without limits, balanced where it is stable."""
    loop = _compiled_loop(machine.unlimited(), None if scheme is None else scheme.unlimited(), task)
    loop = minimal(loop, task.N)
    return balanced(loop) if _radius(loop) < 1 - 1e-9 else loop


def of_poles(loops: list[Loop], task: Task) -> Premise:
    """The premise that loops are stable."""
    radius = max(map(_radius, loops))
    return premise(STABLE, radius < 1 - 1e-9, f"largest |pole| {radius:.6g}")


def of_trial(machines: Machine, scheme: Scheme, task: Task, causal: bool) -> list[Premise]:
    """The premises that the whole trial learns as the middle of a long one does, and that no limit
    is met, on each of the machines.
    """
    if not limit_names(machines, scheme, task):
        if causal:
            return [premise(WHOLE, True, "law and loop are causal")]
        decay = decays(machines, scheme, task)
        return [premise(WHOLE, decay.trials > 0, decay.told(int(np.argmax(decay.factor))))]
    ahead = outlooks(machines, scheme, task)
    whole = premise(
        WHOLE,
        causal | (ahead.decay.trials > 0),
        ahead.decay.told(int(np.argmax(ahead.decay.factor))),
    )
    return [whole, premise(NO_LIMIT, ahead.clear, ahead.told(int(np.argmin(ahead.clear))))]


def grid(task: Task, *, points: int = 1000, near=()) -> np.ndarray:
    """(F,) frequencies [Hz], equidistant in the logarithm from 0.001 / duration to the Nyquist
    frequency, and denser around poles z.
    """
    nyquist, near = 0.5 / task.dt, np.asarray(near, complex)
    near = near[np.abs(near) > 1e-3]
    centre, width = np.abs(np.angle(near)), np.abs(np.log(np.abs(near)))
    around = (centre[:, None] + width[:, None] * np.linspace(-3, 3, 31)).ravel() / (
        2 * np.pi * task.dt
    )
    lowest = 1e-3 / task.duration
    return np.unique(
        np.concatenate(
            [np.geomspace(lowest, nyquist, points), around[(around > lowest) & (around < nyquist)]]
        )
    )


class Largest(NamedTuple):
    """value: the supremum, enclosed from above;  worst: its frequency [Hz];  critical: where 1 is
    first reached [Hz];  radius: |pole|
    """

    value: float
    worst: float
    critical: float
    radius: float


def on_supremum(
    bounds: Callable,
    theorem: str,
    loops: list[Loop],
    task: Task,
    premises: list[Premise],
    of_whole: Callable,
    frequencies,
) -> FrequencyTest:
    """The condition on the supremum of a function of the angle that `enclosure.supremum` can
    enclose.

    of_whole: () -> further premises, on the whole trial; not asked for where the condition fails
    anyway
    """
    f = lines(task, frequencies, loops)
    curve, found = _enclosed(bounds, loops, task, f)
    premises = [*premises, *(of_whole() if found.value < 1 else [])]
    return FrequencyTest(
        condition(found.value, theorem, premises=premises), f, curve, found.worst, found.critical
    )


def largest_of(law: Law, loop: Loop, task: Task, f) -> Largest:
    """sup |Q (keep - L P)| of a law over a minimal loop, with the lines f (F,) [Hz] to look for its
    first crossing of 1.
    """
    loop = balanced(loop) if _radius(loop) < 1 - 1e-9 else loop
    parts = Parts(loop, law, False, [])
    return _enclosed(lambda centre, h: _largest(parts.nominal(centre, h), h), [loop], task, f)[1]


def _enclosed(bounds: Callable, loops: list[Loop], task: Task, f):
    """The curve on the lines, and what it is at most. Where a loop is unstable, the lines alone
    count, since nothing is claimed.
    """
    to_angle, radius = 2 * np.pi * task.dt, max(map(_radius, loops))

    def magnitude(f):
        angle = to_angle * np.asarray(f, float)
        return np.nan_to_num(bounds(angle, np.zeros_like(angle))[0], nan=np.inf, posinf=np.inf)

    curve = magnitude(f)
    value, worst = float(np.max(curve)), float(f[np.argmax(curve)])
    if radius < 1 - 1e-9:
        found = supremum(bounds, 0.0, np.pi)
        worst = found.angle / to_angle if found.value > value else worst
        value = max(found.bound, value)
    return curve, Largest(value, worst, _first_crossing(magnitude, f, curve, worst), radius)


def lines(task: Task, frequencies, loops: list[Loop]) -> np.ndarray:
    """The frequencies asked for, checked, or a `grid` that is denser around the poles."""
    if frequencies is None:
        return grid(
            task,
            near=np.concatenate(
                [[], *(np.linalg.eigvals(loop.A) for loop in loops if np.all(np.isfinite(loop.A)))]
            ),
        )
    f = np.asarray(frequencies, float)
    if (
        f.ndim != 1
        or len(f) < 2
        or f[0] <= 0
        or f[-1] > 0.5 / task.dt * (1 + 1e-9)
        or np.any(np.diff(f) <= 0)
    ):
        raise ValueError(
            f"frequencies = {f} must ascend within (0, {0.5 / task.dt:g}] Hz, Nyquist at dt = {task.dt:g} s"
        )
    return f


def weight_on(weight, centre, h, dt) -> np.ndarray:
    """(F,) a weight on arcs: a number, or the largest value of a function of f [Hz] at the middle
    and the ends of each arc.
    """
    if not callable(weight):
        return np.broadcast_to(np.asarray(weight, float), np.shape(centre))
    at = np.clip(np.stack([centre - h, centre, centre + h]), 0.0, np.pi) / (2 * np.pi * dt)
    return np.max(np.stack([np.broadcast_to(weight(f), f.shape) for f in at]), axis=0).astype(float)


# How it is done
# --------------------------------------------------------------------------------------------------


_compiled_loop = jax.jit(linear_loop)


def _radius(loop: Loop) -> float:
    return (
        float(np.max(np.abs(np.linalg.eigvals(loop.A)), initial=0.0))
        if np.all(np.isfinite(loop.A))
        else np.inf
    )


def _largest(arc: Arc, h):
    """What `supremum` wants of a response on arcs."""
    return size(arc.value), np.max(arc.ends(h), axis=0) + h**2 * arc.curve


def _norm_optimal(G: Arc, G_t: Arc, w_e, w_u, w_delta, h) -> Arc:
    """H^-1 (W_D I + W_e G^H (G - G_t)) on arcs."""
    one = np.broadcast_to(np.eye(G.value.shape[-1]), (len(h), *(G.value.shape[-1],) * 2)).astype(
        complex
    )
    still = Arc(one, np.zeros_like(one), np.zeros(len(h)))
    pull = _scaled(G.adjoint, w_e)
    H = pull.times(G, h).plus(_scaled(still, w_u + w_delta))
    return H.inverse(h).times(_scaled(still, w_delta).plus(pull.times(G.minus(G_t), h)), h)


def _scaled(arc: Arc, factor) -> Arc:
    return Arc(
        arc.value * factor[:, None, None], arc.slope * factor[:, None, None], arc.curve * factor
    )


def _of_norm_optimal(
    G: Loop, machine: Machine, feedback: Scheme | None, task: Task, weights
) -> Premise:
    """That norm-optimal learning with these weights converges on the whole trial, its ends
    included.
    """
    w_e, w_u, w_delta = weights
    try:
        learning = NormOptimal(StateSpace(G.A, G.B, G.C, dt=task.dt), w_q=w_e, w_s=w_u, w_r=w_delta)
    except ValueError as error:
        return premise(WHOLE, False, str(error))
    feedback = getattr(feedback, "feedback", feedback)
    scheme: Any = learning if feedback is None else WithFeedback(learning, feedback)
    decay = decays(drawn_machines(machine, {}, {}), scheme, task)
    return premise(WHOLE, decay.trials[0] > 0, decay.told(0))


def _first_crossing(magnitude, f, curve, worst) -> float:
    """The first frequency at which the curve reaches 1, narrowed down between the lines; that of
    its peak where no line does.
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
