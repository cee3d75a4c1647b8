"""Published numbers compared with ours, with a verdict on each.

    met      within 30 % of the printed number; not above it where it is printed as a bound
    shape    in the printed order, larger or smaller, with every comparable row, and at most twice
             and at least half of the printed number
    open     neither of these; the reason is given

An improvement in percent is held to both of its sides: 100 - 89 and 100 - 97 are both "about 90 %",
but what is left of the error differs by a factor of four. It is judged by that one of the two
ratios, of the improvement and of what is left, which is farther from 1.

A number that other software computed from the same equations is held to more. It agrees, `agrees`,
where ours differs by no more than its own `Published.agreement`, or it is open.

The factor of two is needed because the order alone would accept any size. Two is 6 dB, the usual
least gain margin of a loop, so that a curve of the same shape does not mislead a design with this
margin. It is also the step from one row to the next in the printed tables of errors by trial (Cao
2019, Table 1: from 18 to 0.3 µm in six steps), so that a number beyond it would belong to another
row.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np

from .. import scenarios
from ..learning.metrics import Keep, best_trial
from ..learning.over_trials import learn
from . import Published, Scenario
from .loading import with_reading
from .published import OVER_TRIALS

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
        fit = self.published.fitted
        of_print = self.published._asdict() | {
            "options": dict(self.published.options),
            "fitted": "" if fit is None else str(fit),
            "free_numbers": len(fit.names) if fit else 0,
            "among_fitted": bool(fit and fit.among),
        }
        return (
            {"scenario": self.scenario}
            | of_print
            | {name: getattr(self, name) for name in self._fields[2:]}
        )


def reproduce(
    names: Iterable[str] = (),
    reading: str | None = None,
    *,
    progress: Callable[[int, int, str], object] | None = None,
) -> list[Row]:
    """Simulate every published number of the named scenarios; without names, of all scenarios.

    reading: name of a reading, for scenarios that have several; None: of each the one that is taken
    progress: called before each scenario with the number of rows done, that of all rows, and a name
    Raises ValueError naming the allowed scenarios or readings.
    """
    chosen = {
        name: scenarios.load(name, **with_reading(name, reading)).published
        for name in names or scenarios.SCENARIOS
    }
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
    due: dict[str, list[Published]] = {}
    for p in rows:
        for scheme in dict.fromkeys((p.scheme, p.against or p.scheme)):
            due.setdefault(scheme, []).append(p)
    found = {scheme: _metrics_by_trial(scenario, scheme, of) for scheme, of in due.items()}
    ours = {}
    for p in rows:
        value = _at(found[p.scheme], p)
        if p.against:
            share = 100 * value / _at(found[p.against], p)
            ours[p] = share if p.quantity.endswith("_share") else 100 - share
        else:
            ours[p] = scenario.shown(p.quantity)[0] * value
    return ours


def _metrics_by_trial(scenario: Scenario, scheme: str, rows: list[Published]) -> dict[str, Any]:
    """The metrics of each trial of a scheme, as far as the rows need them.

    A scheme that does not learn runs once, unless a row asks for its spread over trials.
    """
    law = scenario.schemes[scheme]
    repeats = law.learns or any(p.quantity in OVER_TRIALS for p in rows)
    trials = max(p.trial or 1 for p in rows) if repeats else 1
    keep = Keep.of(scenario.functions)
    history = learn(scenario.machine, law, scenario.task, trials, save=keep)
    return (
        history.metrics._asdict()
        | history.saved
        | {"best_trial": best_trial(history.rms), "diverged": history.diverged}
        | rises(history.rms)
    )


def _at(metrics: Mapping[str, Any], row: Published) -> float:
    """The number of a row, largest over channels, without scale; infinite after a divergence."""
    trial = min(row.trial or 1, len(metrics["diverged"])) - 1
    if metrics["diverged"][trial]:
        return np.inf
    return float(np.max(np.asarray(metrics[row.base])[trial]))


def rises(rms) -> dict[str, np.ndarray]:
    """How the rms error changes over the first j trials, for j = 1..J, each (J,) [unit of y].

    rms_rise: largest rise from one trial to the next, 0 where it only falls
    rms_spread: difference of the largest and the smallest

    rms: (J, n_y) rms errors; of several outputs the largest counts [unit of y]
    """
    largest = np.max(np.asarray(rms, float), axis=1)
    rise = np.maximum(np.diff(largest, prepend=largest[:1]), 0.0)
    spread = np.maximum.accumulate(largest) - np.minimum.accumulate(largest)
    return dict(zip(OVER_TRIALS, (np.maximum.accumulate(rise), spread), strict=True))


def _verdict(i: int, published: tuple[Published, ...], ours: list[float]) -> tuple[str, str]:
    """The verdict on row i, and the reason if it is open."""
    here, x = published[i], np.asarray(ours)
    ratio, of = _judged_ratio(here, x[i])
    if here.agreement is not None:
        return _agreement(ratio, here.agreement)
    if met(here, x[i]):
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
    size = f"{ratio:.2f} times {of}"
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


def met(here: Published, ours: float) -> bool:
    """Whether our number is near the printed one: within 30 %, or within its `agreement`."""
    within = MET if here.agreement is None else here.agreement
    return ours <= here.value if here.at_most else abs(_judged_ratio(here, ours)[0] - 1) <= within


def _judged_ratio(here: Published, ours: float) -> tuple[float, str]:
    """The ratio by which a row is judged, and of which number it is."""
    ratio, of = ours / here.value, "the printed number"
    if not here.quantity.endswith("_improvement") or ratio <= 0:
        return ratio, of
    left = (100 - ours) / (100 - here.value)
    return (ratio, of) if max(ratio, 1 / ratio) > max(left, 1 / left) else (left, "what is left")


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
    alike = (a.quantity, a.against) == (b.quantity, b.against)
    return alike and (a.scheme == b.scheme) != one_setting
