"""What a condition on the frequency response is made of: a loop, a learning law, their premises."""

from __future__ import annotations

from typing import NamedTuple

import jax
import numpy as np

from ..learning.machine import Machine
from ..learning.over_trials import check
from ..schemes import Scheme
from ..signals.task import Task
from .affine import limit_names
from .condition import Premise, premise
from .enclosure import Arc, arc_of_loop, arc_of_taps, balanced
from .law import Law, law_of
from .linearity import invariant_loop, linear_law, of_last_trial
from .loop import Loop, linear_loop, minimal
from .outlook import NO_LIMIT, WHOLE, decays, outlooks
from .over_frequency import radius_of

STABLE = "loop stable"


class Parts(NamedTuple):
    """A loop and a learning law, for a condition on both.

    loop:     balanced where it is stable
    law:      its taps
    causal:   whether both are causal and the trial cuts the law off at its ends as it does the loop
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
    """The parts of the conditions of a machine under a scheme.

    Raises ValueError where machine, scheme and task do not fit, or for a scheme that learns no
    feedforward.
    """
    check(machine, scheme, task)
    loop, law = reduced(machine, scheme, task), law_of(scheme, task)
    premises = [
        invariant_loop(machine, scheme, task),
        of_poles([loop], task),
        linear_law(scheme, task),
        of_last_trial(scheme, task),
        law.invariant,
    ]
    return Parts(loop, law, law.causal and law.cut_off(scheme, task), premises)


def reduced(machine: Machine, scheme: Scheme | None, task: Task) -> Loop:
    """The minimal loop without limits, balanced where it is stable."""
    loop = _compiled_loop(machine.unlimited(), None if scheme is None else scheme.unlimited(), task)
    loop = minimal(loop, task.N)
    return balanced(loop) if radius_of(loop) < 1 - 1e-9 else loop


def of_poles(loops: list[Loop], task: Task) -> Premise:
    """The premise that loops are stable."""
    radius = max(map(radius_of, loops))
    return premise(STABLE, radius < 1 - 1e-9, f"largest |pole| {radius:.6g}")


def of_trial(machines: Machine, scheme: Scheme, task: Task, causal: bool) -> list[Premise]:
    """The premises that the whole trial learns as the middle of a long one, and meets no limit.

    They are looked at on each of the machines.
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


_compiled_loop = jax.jit(linear_loop)
