"""Published numbers beside ours, with a verdict on each."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from . import scenarios
from .learning import learn
from .metrics import Keep, best_trial
from .scenarios import Published, Scenario

MET = 0.3


class Row(NamedTuple):
    """A published number and ours [the unit the scenario shows].

    verdict: `met` within 30 %, or below where the print says less than; `shape` where the row stands to every comparable row as in print,
    larger or smaller; else `open`
    reading: what the paper leaves open and how it was read here
    """

    scenario: str
    published: Published
    ours: float
    ratio: float
    unit: str
    verdict: str

    def as_dict(self) -> dict[str, object]:
        """The row flat, as JSON and CSV take it."""
        of_print = self.published._asdict() | {"options": dict(self.published.options)}
        return {"scenario": self.scenario} | of_print | {"ours": self.ours, "ratio": self.ratio, "unit": self.unit, "verdict": self.verdict}


def reproduce(names: Iterable[str] = ()) -> list[Row]:
    """Every published number of the scenarios named (all if none is), simulated anew.

    Raises ValueError naming the allowed scenarios.
    """
    chosen = {name: scenarios.load(name).published for name in names or scenarios.SCENARIOS}
    return [row for name, published in chosen.items() for row in _of_scenario(name, published)]


def _of_scenario(name: str, published: tuple[Published, ...]) -> list[Row]:
    settings = {p.options: scenarios.load(name, **dict(p.options)) for p in published}
    ours = {}
    for options, scenario in settings.items():
        ours |= _simulated(scenario, [p for p in published if p.options == options])
    values = [ours[p] for p in published]
    return [
        Row(name, p, value, value / p.value, settings[p.options].shown(p.quantity)[1], _verdict(i, published, values))
        for i, (p, value) in enumerate(zip(published, values, strict=True))
    ]


def _simulated(scenario: Scenario, rows: list[Published]) -> dict[Published, float]:
    """Our value for each row of one setting, infinite for a trial that diverged: each scheme learns once, as long as its last row asks."""
    ours = {}
    for scheme in {p.scheme: None for p in rows}:
        due = [p for p in rows if p.scheme == scheme]
        trials, keep = max(p.trial or 1 for p in due), Keep.of(scenario.functions)
        history = learn(scenario.machine, scenario.schemes[scheme], scenario.task, trials, save=keep)
        figures = history.metrics._asdict() | history.saved | {"best_trial": best_trial(history.rms)}
        for p in due:
            trial = (p.trial or 1) - 1
            largest = np.inf if history.diverged[trial] else np.max(np.asarray(figures[p.quantity])[trial])
            ours[p] = scenario.shown(p.quantity)[0] * float(largest)
    return ours


def _verdict(i: int, published: tuple[Published, ...], ours: list[float]) -> str:
    here, x = published[i], np.asarray(ours)
    if abs(x[i] / here.value - 1.0) <= MET or (here.at_most and x[i] <= here.value):
        return "met"
    others = [k for k, p in enumerate(published) if k != i and _comparable(here, p) and p.value != here.value]
    agree = [np.isfinite(x[[i, k]]).all() and np.sign(x[i] - x[k]) == np.sign(here.value - published[k].value) for k in others]
    return "shape" if agree and all(agree) else "open"


def _comparable(a: Published, b: Published) -> bool:
    """Whether an order between two rows means something: one scheme at several trials or settings, or several schemes at one.

    A scheme that does not learn is the same at every trial.
    """
    one_trial = a.trial == b.trial or None in (a.trial, b.trial)
    one_setting = one_trial and a.options == b.options
    return a.quantity == b.quantity and (a.scheme == b.scheme) != one_setting
