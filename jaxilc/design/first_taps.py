"""The taps with which a tuning begins: where they lie, and on which machines they are found.

The taps of L are tried at several leads (`window.leads_of`), and where those of the safe law lie
that they are taken from. Then an exchange: a law that keeps the bound on the machines of a family
may break it on one between them, whose resonance lies elsewhere. It is watched on many others, and
the worst of them join the family, until none breaks it. The machines that watch are not those of
the gate, which judges what is found.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ..schemes import Scheme
from ..signals.task import Task
from ..theory.law import law_of
from ..tuning.risks import Risk
from .by_response import by_response, searched, sizes_of
from .responses import Family
from .window import Filters, Window, leads_of

BRIEF = 150  # steps at each lead
APART = 12  # leads closer than the number of taps divided by this count as one
ROUNDS, JOIN = 5, 16  # of the exchange, and machines that join in each


class FirstTaps(NamedTuple):
    """The taps with which a tuning begins.

    filters: the taps
    lead:    of the middle tap of L, see `Window`
    besides: {name: (S,)} numbers of the machines that joined the family
    """

    filters: Filters
    lead: int
    besides: dict[str, np.ndarray]


def best_lead(
    family: Family,
    window: Callable[[int], Window],
    start: Scheme | None,
    task: Task,
    trials: int,
    below: float,
    risk: Risk,
) -> int:
    """The lead at which the taps that are found by a brief search have the least loss.

    window: of a lead
    start: law of a few weights that the taps are taken from, None for one that learns nothing
    """
    leads = leads_of(family, task)
    if start is not None:
        L = law_of(start, task).L
        weight = np.sum(np.asarray(L.taps) ** 2, axis=(1, 2))
        leads.append(max(0, round(float(np.sum(L.powers * weight) / np.sum(weight))) - 1))
    tried: dict[int, float] = {}
    for lead in leads:
        one = window(lead).unscheduled()
        if any(abs(lead - other) <= len(one.of_L) / APART for other in tried):
            continue
        tried[one.lead] = searched(
            family, one, held(one, start, task), task, trials, below, steps=BRIEF, risk=risk
        )[1]
    return min(tried, key=lambda lead: tried[lead])


def held(window: Window, start: Scheme | None, task: Task) -> Filters:
    """The taps of a law as far as they lie in a window; None is a law that learns nothing."""
    return window.nothing() if start is None else window.holding(law_of(start, task))


def exchanged(
    family: Family,
    joined: Callable[[dict[str, np.ndarray]], Family],
    watch: Callable[[], Family],
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
    watch: the machines that watch
    first: taps from which the search begins
    below: bound on |keep - L P| in the search;  most: on the machines that watch
    """
    found = by_response(family, window, first, task, trials, below, risk=risk)
    besides: dict[str, np.ndarray] = {}
    others = watch() if family.drawn else family
    for _ in range(ROUNDS):
        sizes = np.max(sizes_of(others, window, found, task.dt), axis=1)
        worst = np.argsort(-sizes)[:JOIN]
        worst = worst[sizes[worst] > most]
        if not len(worst) or not family.drawn:
            break
        besides = {
            name: np.concatenate([besides.get(name, np.zeros(0)), np.asarray(values)[worst]])
            for name, values in others.drawn.items()
        }
        family = joined(besides)
        found = by_response(family, window, found, task, trials, below, risk=risk)
    return FirstTaps(found, window.lead, besides)
