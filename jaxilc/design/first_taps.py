"""The taps with which a tuning begins: where they lie, and on which machines they are found.

The taps of L are tried at several leads (`window.leads_of`), and where those of the safe law lie
that they are taken from. Then an exchange: a law that keeps the bound on the machines of a family
may break it on one between them, whose resonance lies elsewhere. It is watched on others, and the
worst of them join the family, until none of fresh ones breaks it. The machines that watch are not
those of the gate, which judges what is found.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg

from ..schemes import Scheme
from ..signals.task import Task
from ..theory.law import law_of, learning_law
from ..tuning.risks import Risk
from .by_response import by_response, sizes_of
from .candidates import impulse_response
from .responses import Family
from .window import Filters, Window, leads_of

BRIEF = 150  # steps at each lead, and after machines have joined
APART = 12  # leads closer than the number of taps divided by this count as one
SHORT, ENDS = 200, 4  # of the trial of both ends: least samples, and samples by the reach of taps
ROUNDS, JOIN = 5, 16  # of the exchange, and machines that join in each


class FirstTaps(NamedTuple):
    """The taps with which a tuning begins.

    filters: the taps of a law that is the same in all samples
    lead:    of the middle tap of L, see `Window`
    besides: {name: (S,)} numbers of the machines that joined the family
    """

    filters: Filters
    lead: int
    besides: dict[str, np.ndarray]


def best_of_leads(
    family: Family,
    window: Callable[[int], Window],
    starts: Sequence[Scheme | None],
    task: Task,
    trials: int,
    below: float,
    risk: Risk,
) -> tuple[int, Filters]:
    """The lead with the least loss of the taps that a brief search finds, and these taps.

    They are those of a law that is the same in all samples.

    Taps with which the ends of the trial are safe too come first, see `radius_in_a_trial`.

    window: of a lead
    starts: laws that the taps are taken from; None is one that learns nothing
    """
    leads = leads_of(family, task)
    for start in starts:
        if start is not None:
            L = law_of(start, task).L
            weight = np.sum(np.asarray(L.taps) ** 2, axis=(1, 2))
            leads.append(max(0, round(float(np.sum(L.powers * weight) / np.sum(weight))) - 1))
    tried: dict[int, tuple[tuple[bool, float], Filters]] = {}
    for lead in leads:
        one = window(lead).unscheduled()
        if any(abs(lead - other) <= len(one.of_L) / APART for other in tried):
            continue
        each = []
        for start in starts:
            found, loss = by_response(
                family, one, held(one, start, task), task, trials, below, steps=BRIEF, risk=risk
            )
            each.append(((radius_in_a_trial(family, one, found, task) >= 1, loss), found))
        tried[one.lead] = min(each, key=lambda pair: pair[0])
    lead = min(tried, key=lambda lead: tried[lead][0])
    return lead, tried[lead][1]


def radius_in_a_trial(
    family: Family, window: Window, filters: Filters, task: Task, machine: int = 0
) -> float:
    """Largest |eigenvalue| of the learning map of a machine, in a trial of its ends.

    The test by frequency holds far from the ends of a trial. At its end L looks for errors that do
    not exist, and a law may diverge there that is safe elsewhere. Of a scheduled law it is that of
    the last segment. Of several channels it is 0, as it is not computed.
    """
    reach = window.lead + len(window.of_L) + len(window.of_keep)
    N = min(task.N, max(SHORT, ENDS * reach))
    if family.P.ndim > 2 or not family.loops:
        return 0.0
    if window.starts:
        window, filters = window.unscheduled(), Filters(filters.L[-1], filters.keep[-1])
    law = learning_law(window.of(filters), Task(np.zeros(N + 1), dt=task.dt))
    P = scipy.linalg.toeplitz(impulse_response(family.loops[machine], N), np.zeros(N))
    return float(np.max(np.abs(np.linalg.eigvals(law.keep - law.L @ P))))


def held(window: Window, start: Scheme | None, task: Task) -> Filters:
    """The taps of a law as far as they lie in a window; None is a law that learns nothing."""
    return window.nothing() if start is None else window.holding(law_of(start, task))


def exchanged(
    family: Family,
    joined: Callable[[dict[str, np.ndarray]], Family],
    watch: Callable[[int], Family],
    window: Window,
    first: Filters,
    task: Task,
    trials: int,
    below: float,
    most: float,
    risk: Risk,
) -> FirstTaps:
    """Taps by frequency response that keep a bound on the machines that watch, as far as possible.

    joined: the family with machines of these numbers besides
    watch: the machines that watch in a round, others in each
    first: taps from which the search begins
    below: bound on |keep - L P| in the search;  most: on the machines that watch
    """
    found, _ = by_response(family, window, first, task, trials, below, risk=risk)
    besides: dict[str, np.ndarray] = {}
    for turn in range(ROUNDS if family.drawn else 0):
        others = watch(turn)
        sizes = np.max(sizes_of(others, window, found, task.dt), axis=1)
        worst = np.argsort(-sizes)[:JOIN]
        worst = worst[sizes[worst] > most]
        if not len(worst):
            break
        besides = {
            name: np.concatenate([besides.get(name, np.zeros(0)), np.asarray(values)[worst]])
            for name, values in others.drawn.items()
        }
        family = joined(besides)
        found, _ = by_response(family, window, found, task, trials, below, steps=BRIEF, risk=risk)
    return FirstTaps(found, window.lead, besides)
