"""Published numbers compared with ours, with a verdict on each.

    met      within 30 % of the printed number, or below it where it is printed as "less than"
    shape    in the printed order, larger or smaller, with every comparable row, and at most twice
             and at least half of the printed number
    open     neither of these; the reason is given

A number that other software computed from the same equations is held to more. It agrees, `agrees`,
where ours differs by no more than its own `Published.agreement`, or it is open.

The factor of two is needed because the order alone would accept any size. Two is 6 dB, the usual
least gain margin of a loop, so that a curve of the same shape does not mislead a design with this
margin. It is also the step from one row to the next in the printed tables of errors by trial (Cao
2019, Table 1: from 18 to 0.3 µm in six steps), so that a number beyond it would belong to another
row.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np

from .. import scenarios
from ..learning.metrics import Keep, best_trial
from ..learning.over_trials import learn
from . import Published, Scenario

MET = 0.3
SHAPE = 2.0


class Row(NamedTuple):
    """A published number and ours.

    scenario: name of the scenario
    published: the printed number, how it was read and what was fitted
    ours: our number [unit]
    ratio: our number divided by the printed one
    unit: unit in which the scenario shows both numbers
    verdict: `met`, `shape`, `agrees` or `open`, as this module says
    reason: why a row is open, empty for the others
    """

    scenario: str
    published: Published
    ours: float
    ratio: float
    unit: str
    verdict: str
    reason: str = ""

    def as_dict(self) -> dict[str, object]:
        """The row without nested fields, for JSON and CSV."""
        fitted = "" if self.published.fitted is None else str(self.published.fitted)
        of_print = self.published._asdict() | {
            "options": dict(self.published.options),
            "fitted": fitted,
        }
        return (
            {"scenario": self.scenario}
            | of_print
            | {name: getattr(self, name) for name in self._fields[2:]}
        )


def reproduce(
    names: Iterable[str] = (), *, progress: Callable[[int, int, str], object] | None = None
) -> list[Row]:
    """Simulate every published number of the named scenarios; without names, of all scenarios.

    progress: called before each scenario with the number of rows done, that of all rows, and a name
    Raises ValueError naming the allowed scenarios.
    """
    chosen = {name: scenarios.load(name).published for name in names or scenarios.SCENARIOS}
    rows: list[Row] = []
    for name, published in chosen.items():
        if progress is not None:
            progress(len(rows), sum(map(len, chosen.values())), name)
        rows += _of_scenario(name, published)
    return rows


def _of_scenario(name: str, published: tuple[Published, ...]) -> list[Row]:
    settings = {p.options: scenarios.load(name, **dict(p.options)) for p in published}
    ours = {}
    for options, scenario in settings.items():
        ours |= _simulated(scenario, [p for p in published if p.options == options])
    values = [ours[p] for p in published]
    return [
        Row(
            name,
            p,
            value,
            value / p.value,
            settings[p.options].shown(p.quantity)[1],
            *_verdict(i, published, values),
        )
        for i, (p, value) in enumerate(zip(published, values, strict=True))
    ]


def _simulated(scenario: Scenario, rows: list[Published]) -> dict[Published, float]:
    """Our value for each row of one setting, infinite for a trial that diverged.

    Each scheme learns once, up to the last trial that its rows need.
    """
    ours = {}
    for scheme in {p.scheme: None for p in rows}:
        due = [p for p in rows if p.scheme == scheme]
        trials, keep = max(p.trial or 1 for p in due), Keep.of(scenario.functions)
        history = learn(
            scenario.machine, scenario.schemes[scheme], scenario.task, trials, save=keep
        )
        metrics = (
            history.metrics._asdict() | history.saved | {"best_trial": best_trial(history.rms)}
        )
        for p in due:
            trial = (p.trial or 1) - 1
            largest = (
                np.inf
                if history.diverged[trial]
                else np.max(np.asarray(metrics[p.quantity])[trial])
            )
            ours[p] = scenario.shown(p.quantity)[0] * float(largest)
    return ours


def _verdict(i: int, published: tuple[Published, ...], ours: list[float]) -> tuple[str, str]:
    """The verdict on row i, and the reason if it is open."""
    here, x = published[i], np.asarray(ours)
    ratio = x[i] / here.value
    if here.agreement is not None:
        return _agreement(ratio, here.agreement)
    if abs(ratio - 1.0) <= MET or (here.at_most and x[i] <= here.value):
        return "met", ""
    if not np.isfinite(ratio):
        return "open", "ours is not finite"
    others = [
        k
        for k, p in enumerate(published)
        if k != i and _comparable(here, p) and p.value != here.value
    ]
    against = [
        k
        for k in others
        if not (
            np.isfinite(x[k]) and np.sign(x[i] - x[k]) == np.sign(here.value - published[k].value)
        )
    ]
    size = f"{ratio:.2f} times the printed number"
    if not others:
        return "open", f"{size}, and no other row to compare with"
    if against:
        return (
            "open",
            f"{size}, and not in the printed order with {len(against)} of {len(others)} "
            "comparable rows",
        )
    if not 1 / SHAPE <= ratio <= SHAPE:
        return "open", f"in the printed order, but {size}, beyond a factor of {SHAPE:g}"
    return "shape", ""


def _agreement(ratio: float, within: float) -> tuple[str, str]:
    """The verdict on a number of other software, and the reason if it is open."""
    if not np.isfinite(ratio):
        return "open", "ours is not finite"
    if abs(ratio - 1.0) <= within:
        return "agrees", ""
    return "open", f"ours differs by {abs(ratio - 1.0):.2g} of it, beyond {within:.2g}"


def _comparable(a: Published, b: Published) -> bool:
    """Whether two rows can be put in order.

    They can if they belong to one scheme at different trials or settings, or to different schemes
    at one trial and setting. A scheme that does not learn has the same value at every trial.
    """
    one_trial = a.trial == b.trial or None in (a.trial, b.trial)
    one_setting = one_trial and a.options == b.options
    return a.quantity == b.quantity and (a.scheme == b.scheme) != one_setting
