"""Published numbers compared with ours, with a verdict on each.

    met      within 30 % of the printed number; not above it where it is printed as a bound
    shape    in the printed order, larger or smaller, with every comparable row, and at most twice
             and at least half of the printed number
    open     neither of these; the reason is given

An improvement in percent is held to both of its sides: 100 - 89 and 100 - 97 are both "about 90 %",
but what is left of the error differs by a factor of four. It is judged by that one of the two
ratios, of the improvement and of what is left, which is farther from 1.

What a paper concludes is compared as well: a conclusion holds where our numbers have its order, and
does not hold otherwise (`Conclusion`).

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
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from .. import scenarios
from ..learning.metrics import Keep, best_trial
from ..learning.over_trials import learn
from ..pytree.aliases import Leaf
from ..theory.certificates import printed_conditions
from ..theory.loop import linear_loop, pole_radius
from . import Published, Scenario
from .from_file import with_reading
from .published import FALLS, NOTHING, NUMBER, OVER_TRIALS, Conclusion

MET = 0.3
SHAPE = 2.0
VERDICTS = ("met", "shape", "open")
# What the papers say of a loop and not of an error, as functions of a scenario and a scheme's name.
CONDITIONS: dict[str, Callable[[Scenario, str], float]] = {
    "eq_36": lambda of, name: float(
        printed_conditions(of.schemes[name], of.task)["Xu 2024, eq. 36"].value
    ),
    "loop_radius": lambda of, name: pole_radius(linear_loop(of.machine, of.schemes[name], of.task)),
}
SHARES = (0.03, 0.1, MET)  # within which the printed numbers are counted


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


class Judged(NamedTuple):
    """What a paper concludes, and our numbers.

    scenario: name of the scenario
    conclusion: what it says, and what was simulated for it
    ours: our number for each of its sides [unit]
    unit: unit of the numbers
    holds: whether our numbers have the order that it names
    """

    scenario: str
    conclusion: Conclusion
    ours: tuple[float, ...]
    unit: str
    holds: bool

    def as_dict(self) -> dict[str, object]:
        """The conclusion without nested fields, for JSON."""
        of = self.conclusion._asdict()
        of["sides"] = [s if isinstance(s, float) else described(s) for s in of["sides"]]
        return of | {name: x for name, x in self._asdict().items() if name != "conclusion"}


def reproduce(
    names: Iterable[str] = (),
    reading: str | None = None,
    *,
    progress: Callable[[int, int, str], object] | None = None,
) -> list[Row]:
    """Every published number beside ours, see `compared`; no conclusion is simulated."""
    return compared(names, reading, progress=progress, conclusions=False)[0]


def compared(
    names: Iterable[str] = (),
    reading: str | None = None,
    *,
    progress: Callable[[int, int, str], object] | None = None,
    conclusions: bool = True,
) -> tuple[list[Row], list[Judged]]:
    """Simulate every published number and conclusion of the named scenarios; else of all.

    reading: name of a reading, for scenarios that have several; None: of each the one that is taken
    progress: called before each scenario with the number of rows done, that of all rows, and a name
    conclusions: whether these are simulated, too
    Raises ValueError naming the allowed scenarios or readings.
    """
    chosen = {name: with_reading(name, reading) for name in names or scenarios.SCENARIOS}
    loaded = {name: scenarios.load(name, **of) for name, of in chosen.items()}
    rows: list[Row] = []
    judged: list[Judged] = []
    for name, scenario in loaded.items():
        if progress is not None:
            progress(len(rows), sum(len(of.published) for of in loaded.values()), name)
        concluded = scenario.conclusions if conclusions else ()
        of_rows, of_conclusions = _of_scenario(name, scenario.published, concluded)
        rows += of_rows
        judged += of_conclusions
    return rows, judged


def counted(rows: Iterable[Row]) -> dict[str, dict[str, int]]:
    """How many printed numbers are met, `fitted` and `predicted` ones apart.

    Counted are those of papers that are printed for the first time. Each entry has the `numbers`,
    those within 3, 10 and 30 % by these names (printed bounds are not among them), the printed
    `bounds`, those that are `kept`, and the verdicts `met`, `shape` and `open`.
    """
    found = {}
    printed = [
        row for row in rows if row.published.agreement is None and row.published.kind == NUMBER
    ]
    for name in ("fitted", "predicted"):
        of = [
            row for row in printed if (row.published.fitted or NOTHING).among == (name == "fitted")
        ]
        sides = [
            _judged_ratio(row.published, row.ours)[0] for row in of if not row.published.at_most
        ]
        bounds = [row for row in of if row.published.at_most]
        found[name] = (
            {"numbers": len(of)}
            | {f"{100 * w:g} %": sum(abs(r - 1) <= w for r in sides) for w in SHARES}
            | {"bounds": len(bounds), "kept": sum(row.verdict == "met" for row in bounds)}
            | {verdict: sum(row.verdict == verdict for row in of) for verdict in VERDICTS}
        )
    return found


def _of_scenario(
    name: str, published: tuple[Published, ...], concluded: tuple[Conclusion, ...]
) -> tuple[list[Row], list[Judged]]:
    sides = [side for one in concluded for side in one.sides if isinstance(side, Published)]
    wanted = [*published, *sides]
    settings = {(p.options, p.set): scenarios.load(name, **dict(p.options)) for p in wanted}
    ours: dict[Published, float] = {}
    for (options, changed), scenario in settings.items():
        of = [p for p in wanted if (p.options, p.set) == (options, changed)]
        ours |= _simulated(scenario.with_values(dict(changed)), of)
    values = [ours[p] for p in published]

    def unit(p: Published) -> str:
        scenario = settings[p.options, p.set]
        return "" if p.quantity in CONDITIONS else scenario.shown(p.quantity)[1]

    rows = [
        Row(name, p, value, value / p.value, unit(p), *_verdict(i, published, values))
        for i, (p, value) in enumerate(zip(published, values, strict=True))
    ]
    return rows, [_concluded(name, one, ours, unit) for one in concluded]


def _concluded(
    name: str, one: Conclusion, ours: Mapping[Published, float], unit: Callable[[Published], str]
) -> Judged:
    """A conclusion with our numbers, and whether it holds."""
    x = [ours[side] if isinstance(side, Published) else side for side in one.sides]
    pairs = [*pairwise(x)]
    match one.order:
        case _ if not np.all(np.isfinite(x)):  # a divergence is larger than any number
            holds = one.order == FALLS and all(np.isfinite(b) and a > b for a, b in pairs)
        case "falls":
            holds = all(a > b for a, b in pairs)
        case "does not rise":
            holds = all(a >= b for a, b in pairs)
        case _:
            holds = 0 < max(x) <= SHAPE * min(x)
    simulated = next(side for side in one.sides if isinstance(side, Published))
    return Judged(name, one, tuple(x), unit(simulated), holds)


def described(side: Published) -> str:
    """What was simulated for a side of a conclusion, as text."""
    at = f", trial {side.trial}" if side.trial else ""
    of = [(name, of) for name, of in side.options if name not in ("plant", "reading")]
    return f"{side.scheme}{at}" + "".join(f", {name}={x}" for name, x in (*of, *side.set))


def _simulated(scenario: Scenario, rows: list[Published]) -> dict[Published, float]:
    """Our value for each row of one setting, infinite for a trial that diverged.

    Each scheme learns once, up to the last trial that its rows need.
    """
    ours = {p: CONDITIONS[p.quantity](scenario, p.scheme) for p in rows if p.quantity in CONDITIONS}
    rows = [p for p in rows if p not in ours]
    due: dict[str, list[Published]] = {}
    for p in rows:
        for scheme in dict.fromkeys((p.scheme, p.against or p.scheme)):
            due.setdefault(scheme, []).append(p)
    found = {scheme: _metrics_by_trial(scenario, scheme, of) for scheme, of in due.items()}
    for p in rows:
        value = _at(found[p.scheme], p)
        if p.against:
            share = 100 * value / _at(found[p.against], p)
            ours[p] = share if p.quantity.endswith("_share") else 100 - share
        else:
            ours[p] = scenario.shown(p.quantity)[0] * value
    return ours


def _metrics_by_trial(scenario: Scenario, scheme: str, rows: list[Published]) -> dict[str, Leaf]:
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


def _at(metrics: Mapping[str, Leaf], row: Published) -> float:
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
    if met(here, x[i]):
        return "met" if here.agreement is None else "agrees", ""
    if not np.isfinite(ratio):
        return "open", "ours is not finite"
    if here.agreement is not None:
        off = abs(ratio - 1.0)
        return "open", f"ours differs by {off:.2g} of it, beyond {here.agreement:.2g}"
    others = [
        k
        for k, p in enumerate(published)
        if k != i and _comparable(here, p) and p.value != here.value
    ]
    printed = np.array([p.value for p in published])
    alike = np.isfinite(x) & (np.sign(x[i] - x) == np.sign(here.value - printed))
    against = [k for k in others if not alike[k]]
    size = f"{ratio:.2f} times {of}"
    if not others:
        return "open", f"{size}, and no other row to compare with"
    if against:
        among = f"{len(against)} of {len(others)} comparable rows"
        return "open", f"{size}, and not in the printed order with {among}"
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


def _comparable(a: Published, b: Published) -> bool:
    """Whether two rows can be put in order.

    They can if they belong to one scheme at different trials or settings, or to different schemes
    at one trial and setting. A scheme that does not learn has the same value at every trial.
    """
    one_trial = a.trial == b.trial or None in (a.trial, b.trial)
    one_setting = one_trial and a.options == b.options
    alike = (a.quantity, a.against) == (b.quantity, b.against)
    return alike and (a.scheme == b.scheme) != one_setting
