"""Candidates judged on machines that no step of the design has seen, and what limits the best."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np

from ..learning.machine import Machine
from ..learning.over_trials import learn
from ..schemes import Scheme
from ..signals.task import Task
from ..sweeps.summary import SchemeSummary
from .candidates import Candidate

LONG = 3, 60, 200  # the sweep has so many times the trials asked for, within these bounds
LIKE = 1.01  # errors within this factor count as equal; the simpler law is then taken
SETTLED = 1.05  # factor above the error that is kept, within which a trial counts as settled
GROWN = 2.0  # factor by which the error may not have grown at the end of the sweep


def judged_trials(trials: int) -> int:
    """The number of trials over which candidates are judged."""
    times, least, most = LONG
    return max(trials, min(max(times * trials, least), most))


class Verdict(NamedTuple):
    """How a candidate did on the machines of the sweep.

    candidate: the law
    error: 95 % of the machines are at or below it in the last trial asked for, and in each trial of
        the sweep after that [unit of the metric]
    median: the same for 50 %
    worst: the same for all machines
    settled_at: first trial whose 95 % error is at most 5 % above `error`
    tolerated_from: first trial from which on 95 % of the machines stay within the tolerance, 0 if
        there is none
    lost: why the law is out of question, empty if it is not
    summary: of the sweep
    """

    candidate: Candidate
    error: float
    median: float
    worst: float
    settled_at: int
    tolerated_from: int
    lost: str
    summary: SchemeSummary


def verdict(
    candidate: Candidate, summary: SchemeSummary, trials: int, tolerance: float | None
) -> Verdict:
    """The verdict on a candidate from its sweep, which may have more trials than asked for."""
    last = trials - 1
    lost = ""
    if summary.diverged > 0:
        lost = f"{summary.diverged:.1%} of the machines diverge, from trial {summary.diverged_at}"
    elif summary.worst[-1] > GROWN * summary.worst[last]:
        factor = summary.worst[-1] / summary.worst[last]
        lost = f"the error grows {factor:.1f} times from trial {trials} to {len(summary.worst)}"
    high, error = summary.high, float(np.max(summary.high[last:]))
    if not lost and error >= high[0]:
        lost = f"it leaves {error / high[0]:.2g} times the error of the first trial"
    return Verdict(
        candidate,
        error=error,
        median=float(np.max(summary.median[last:])),
        worst=float(np.max(summary.worst[last:])),
        settled_at=1 + int(np.argmax(high <= SETTLED * error)),
        tolerated_from=_stays_from(high, tolerance),
        lost=lost,
        summary=summary,
    )


def _stays_from(high: np.ndarray, tolerance: float | None) -> int:
    """The first trial from which on the errors stay within the tolerance, 0 if there is none."""
    beyond = np.flatnonzero(~(high <= (np.inf if tolerance is None else tolerance)))
    if tolerance is None or (len(beyond) and beyond[-1] == len(high) - 1):
        return 0
    return 1 + (int(beyond[-1]) + 1 if len(beyond) else 0)


def ranked(verdicts: Sequence[Verdict]) -> list[Verdict]:
    """The laws that hold: the simplest one whose error is near the least, then by their errors.

    verdicts: from the simplest law to the most complex one
    """
    sound = [one for one in verdicts if not one.lost]
    least = min((one.error for one in sound), default=np.inf)
    first = next((one for one in sound if one.error <= LIKE * least), None)
    return sorted(sound, key=lambda one: (one is not first, one.error))


class Limits(NamedTuple):
    """The error of the last trial as one cause after the other is added [unit of the metric].

    law:     of the nominal machine without noise and limits: what filter and trials leave
    limits:  with the limits of actuator and scheme
    noise:   with noise, disturbances and resolution too
    machines: of 95 % of the uncertain machines
    """

    law: float
    limits: float
    noise: float
    machines: float

    @property
    def largest(self) -> str:
        """The name of the cause that adds most."""
        steps = np.diff([0.0, *self])
        return self._fields[int(np.argmax(steps))]


def limits_of(
    scheme: Scheme, machine: Machine, task: Task, trials: int, metric: str, machines: float
) -> Limits:
    """What limits the error of a scheme.

    machines: the error of 95 % of the uncertain machines
    """

    def error(machine: Machine, scheme: Scheme) -> float:
        history = learn(machine, scheme, task, trials, key=jax.random.key(0))
        return float(np.max(np.asarray(getattr(history.metrics, metric))[-1]))

    quiet = machine.noiseless()
    return Limits(
        law=error(quiet.unlimited(), scheme.unlimited()),
        limits=error(quiet, scheme),
        noise=error(machine, scheme),
        machines=machines,
    )
