"""Conditions on the frequency response: what learning does to each frequency, trial after trial.

    |Q (keep - L P)| < 1

P(z) leads from what is learned to y. Q keep and Q L lead from what was learned, and from e, to what
is learned next. P is that of the simulator's own step (`loop`); the law is that of the scheme's own
learning (`law`), filters included. The largest value is enclosed (`enclosure`), so that no peak
lies between the lines of a grid. Frequencies are in Hz throughout.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..learning.machine import Machine
from ..learning.over_trials import check
from ..plants import StateSpace
from ..schemes import NormOptimal, Scheme, WithFeedback
from ..signals.task import Task
from ..uncertainty import drawn_machines
from .condition import Premise, premise
from .enclosure import Arc, arc_of_loop, balanced
from .law import Law
from .law_and_loop import Parts, of_poles, of_trial, parts_of, reduced
from .linearity import invariant_loop
from .loop import Loop
from .outlook import WHOLE, decays
from .over_frequency import (
    FrequencyTest,
    Largest,
    enclosed,
    largest_on,
    on_supremum,
    radius_of,
    weight_on,
)

CAUSAL = (
    "sup |Q (keep - L P)| < 1, law and loop causal: in every trial what is learned comes nearer to "
    "its limit by this factor or more in "
    "the 2-norm (Norrlöf, Gunnarsson 2002; Bristow 2006; Li 2020, eq. 9 for Q = keep = 1)"
)
LEARNING = (
    "sup |Q (keep - L P)| < 1: far from the ends of a long trial each frequency of what is learned "
    "comes nearer to its limit by this "
    "factor or more in every trial (Norrlöf, Gunnarsson 2002; Bristow 2006; Li 2020, eq. 9); the "
    "whole trial converges as its premise says"
)
NORM_OPTIMAL = (
    "|W_D + W_e G* (G - G_t)| < W_e |G|^2 + W_u + W_D: far from the ends of a long trial, "
    "norm-optimal learning with the model G "
    "contracts each frequency on the plant G_t (MILC 2024, eq. 7 and 8, frequency by frequency)"
)


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

    def bounds(centre, h):
        return largest_on(parts.nominal(centre, h), h)

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
    premises = [invariant_loop(one, scheme, task) for one in (model, machine)] + [
        of_poles([G, G_t], task)
    ]

    def of_whole():
        of_functions = any(map(callable, weights))
        return [] if of_functions else [_of_norm_optimal(G, machine, scheme, task, weights)]

    def bounds(centre, h):
        e, u, delta = (weight_on(w, centre, h, task.dt) for w in weights)
        return largest_on(
            _norm_optimal(*(arc_of_loop(loop, centre, h) for loop in (G, G_t)), e, u, delta, h), h
        )

    return on_supremum(bounds, NORM_OPTIMAL, [G, G_t], task, premises, of_whole, frequencies)


def largest_of(law: Law, loop: Loop, task: Task, f) -> Largest:
    """sup |Q (keep - L P)| of a law over a minimal loop.

    f: (F,) lines [Hz] at which the first crossing of 1 is looked for
    """
    loop = balanced(loop) if radius_of(loop) < 1 - 1e-9 else loop
    parts = Parts(loop, law, False, [])
    return enclosed(lambda centre, h: largest_on(parts.nominal(centre, h), h), [loop], task, f)[1]


# How it is done
# --------------------------------------------------------------------------------------------------


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
    """The premise that norm-optimal learning with these weights converges on the whole trial."""
    w_e, w_u, w_delta = weights
    try:
        learning = NormOptimal(StateSpace(G.A, G.B, G.C, dt=task.dt), w_q=w_e, w_s=w_u, w_r=w_delta)
    except ValueError as error:
        return premise(WHOLE, False, str(error))
    feedback = getattr(feedback, "feedback", feedback)
    scheme: Any = learning if feedback is None else WithFeedback(learning, feedback)
    decay = decays(drawn_machines(machine, {}, {}), scheme, task)
    return premise(WHOLE, decay.trials[0] > 0, decay.told(0))
