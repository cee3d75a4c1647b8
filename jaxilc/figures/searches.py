"""Figures of searches: a tuning step by step, a trade-off, the worst machine."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from .description import Axis, Band, Curve, Figure, Layer, Panel, Rule, Tips
from .paper import drawn
from .style import BLACK, COLOURS, DASHES, GREY, MARKS, colour_of, limits_of, written

if TYPE_CHECKING:
    from ..tuning.trade_off import Point
    from ..tuning.weights import Tuned
    from ..tuning.worst_case import Search

NEAR = (0.12, 0.06)  # shares of the axes within which two points have one label
WIDE = 10.0  # ratio of the ends of an axis beyond which it is logarithmic
NO_NUMBER = "without a number"
ROOM = 0.12  # share of the spread of points beyond them


@drawn
def loss_by_step(tuned: Tuned, *, name: str = "loss") -> Figure:
    """A tuning: the loss against the step for each start, on the machines of the tuning.

    The loss on the held-out machines is shown at the steps at which it was computed.

    name: what the loss is, such as "mean of log-final"
    """
    layers: list[Layer] = [
        Curve(range(len(tuned.loss)), tuned.loss.T, name="machines tuned on", width=0.8, alpha=0.8)
    ]
    for losses in tuned.held_out.T:
        at = np.flatnonzero(np.isfinite(losses))
        layers.append(
            Curve(at, losses[at], dash="--", width=0.5, mark="o", size=3,
                  name="held-out machines", colour=COLOURS[1])
        )  # fmt: skip
    chosen = Curve(
        [tuned.step], [tuned.after], dash="", mark="*", size=10, name="chosen", colour=BLACK
    )
    layers.append(chosen)
    panel = Panel(Axis("step", whole=True), Axis(name), layers, "loss by step of the tuning")
    held = limits_of(panel.heights())
    wide = held is not None and np.min(tuned.loss) > 0 and held[1] > WIDE * held[0]
    return Figure([replace(panel, y=Axis(name, log=wide, ends=held if wide else None))])


@drawn
def worst_against_chance(
    drawn,
    found: Mapping[str, float],
    *,
    nominal: float,
    metric: str = "",
    unit: str = "",
    machines: Mapping[str, Mapping[str, float]] | None = None,
) -> Figure:
    """A search for the worst machine: the metric of drawn machines and the result of each search.

    The curve shows which share of the drawn machines errs no more than so much; it ends below 100 %
    where some diverged, or a quantity is not a number. Each search is a line at the error that it
    found, and the nominal machine has one, too; the legend says which of them have none, and why.

    drawn: (S,) the metric of the machines drawn at random, as `WorstMachine.by_chance`
    found: the largest value by the name of the search
    nominal: the value of the nominal machine
    metric, unit: name and unit of the metric
    machines: parameters by path of the machine that each search found, for the pointer
    """
    count, unknown = np.size(drawn), {"diverged": np.isinf(drawn), NO_NUMBER: np.isnan(drawn)}
    drawn = np.sort(np.asarray(drawn)[np.isfinite(drawn)])
    share = 100 * np.arange(1, len(drawn) + 1) / max(count, 1)
    without = "".join(f", {np.sum(of)} {why}" for why, of in unknown.items() if np.any(of))
    name = f"{count} machines drawn{without}: share that errs less"
    layers: list[Layer] = [
        Curve(drawn, share, steps=True, width=1.4, name=name, colour=GREY),
        Band(drawn, 0.0 * share, share, steps=True, colour=GREY, alpha=0.12),
    ]
    looks = [(BLACK, ":"), *zip(COLOURS, DASHES, strict=True)]
    values = {"nominal machine": nominal, **found}
    for i, (name, value) in enumerate(values.items()):
        colour, dash = looks[i and 1 + (i - 1) % len(COLOURS)]
        if not np.isfinite(value):
            why = NO_NUMBER if np.isnan(value) else "diverged"
            layers.append(Curve([], [], dash, name=f"{name}: {why}", colour=colour))
            continue
        tips = {path: [of] for path, of in (machines or {}).get(name, {}).items()}
        said = f"{name}: {written(value, unit, 4)}"
        layers.append(Rule(value, "x", width=1.4, tips=tips, dash=dash, name=said, colour=colour))
    held = limits_of([*drawn, *values.values()], pad=1.05)
    log = held is not None and held[1] > 3 * held[0]
    across = Axis(metric, unit, log=log, ends=held if log else None)
    up = Axis("machines drawn [%]", ends=(0, 103))
    return Figure(
        [Panel(across, up, layers, legend="above")],
        "The curve says which share of the machines drawn by chance errs no more than so much; "
        "each line is a machine that was searched for. Under the pointer on a line stand the "
        "parameters of that machine.",
    )


@drawn
def worst_by_effort(searches: Mapping[str, Search], *, metric: str = "", unit: str = "") -> Figure:
    """The largest metric that each search of a `WorstMachine` has found, by its evaluations."""
    word = metric.replace("_", " ")
    layers: list[Layer] = []
    for i, (name, one) in enumerate(searches.items()):
        course = np.asarray(one.course)
        changed = np.flatnonzero(course[1:] != course[:-1]) + 1
        at = np.unique([0, *changed, len(course) - 1])
        spent = one.case.evaluations / len(course) * (at + 1)
        layers.append(
            Curve(spent, course[at], mark="o", size=4, steps=True, name=name, colour=colour_of(i),
                  dash=DASHES[i % len(DASHES)])
        )  # fmt: skip
    along = Axis("evaluations of the learning", log=True)
    return Figure(
        [Panel(along, Axis(metric, unit), layers)],
        f"The largest {word} that each search has found so far, against the evaluations of the "
        "learning that it has spent; a gradient counts as three more.",
    )


@drawn
def pareto_front(
    points: Iterable[Point],
    *,
    first: str = "",
    second: str = "",
    given: tuple[float, float] | None = None,
    weights: Mapping[float | None, Mapping[str, float]] | None = None,
) -> Figure:
    """A trade-off: both objectives of each point, labelled with the share of the first one.

    points: points from `tuning.pareto`
    first, second: names of the objectives
    given: both objectives with the weights as given
    weights: of each point by its share, None for those given; for the pointer
    """
    points = sorted(points, key=lambda p: p.first)
    xs, ys = [p.first for p in points], [p.second for p in points]

    def tips_of(shares: Sequence[float | None]) -> dict[str, list[float]]:
        of = [dict((weights or {}).get(share, {})) for share in shares]
        return {name: [one.get(name, np.nan) for one in of] for name in (of[0] if of else ())}

    shares = [p.share for p in points]
    tips: Tips = {"share of the first": shares, **tips_of(shares)}
    name = "tuned; beside: share of the first"
    layers: list[Layer] = [
        Curve(xs, ys, mark="o", steps=True, texts=_shares_beside(points), tips=tips, name=name)
    ]
    if given is not None:
        layers.append(
            Curve([given[0]], [given[1]], dash="", mark="o", filled=False, colour=COLOURS[1],
                  tips=tips_of([None]), name="given")
        )  # fmt: skip
        xs, ys = [*xs, given[0]], [*ys, given[1]]
    along, up = Axis(first, ends=_room(xs)), Axis(second, ends=_room(ys))
    return Figure(
        [Panel(along, up, layers, legend="above")],
        "Both objectives of each point on the held-out machines; less is better. Under the pointer "
        "stand the share of the first objective and the weights.",
    )


def _room(values: Sequence[float] | np.ndarray) -> tuple[float, float] | None:
    """The ends of an axis with room beyond the points; None for a single one."""
    found = np.asarray(values, float)
    found = found[np.isfinite(found)]
    room = ROOM * np.ptp(found) if found.size else 0.0
    return (found.min() - room, found.max() + room) if room > 0 else None


def _shares_beside(points: Sequence[Point]) -> list[str]:
    """The share at each point; those that would be written over each other at the first of them."""
    at = np.array([(p.first, p.second) for p in points], float).reshape(-1, 2)
    at /= [np.ptp(_room(of) or (0.0, 1.0)) for of in at.T]
    texts: list[list[float]] = [[] for _ in points]
    for i, point in enumerate(points):
        near = [j for j in range(i) if texts[j] and np.all(np.abs(at[i] - at[j]) < NEAR)]
        texts[near[0] if near else i].append(point.share)
    return [", ".join(f"{share:g}" for share in sorted(of)) for of in texts]


@drawn
def final_error_by_trials(
    trials: Sequence[int],
    given,
    tuned,
    *,
    metric: str = "",
    unit: str = "",
    weights: Mapping[str, Sequence[float]] | None = None,
) -> Figure:
    """The metric of trial J with the weights as given, and with those tuned for J trials; log axis.

    trials: (n,) J
    given, tuned: (n, 2) median and worst over machines [unit]; the worst is dashed
    metric, unit: name and unit of the metric
    weights: (n,) tuned values of each weight, for the pointer
    """
    tips = {f"tuned {name}": list(values) for name, values in (weights or {}).items()}
    layers = [
        Curve(trials, np.asarray(values)[:, column], name=f"{name}, {quantile}", colour=colour,
              mark=MARKS[column], dash=DASHES[column], tips=tips)
        for name, values, colour in (("given", given, COLOURS[1]),
                                     ("tuned for that many trials", tuned, COLOURS[0]))
        for column, quantile in enumerate(("median", "worst"))
    ]  # fmt: skip
    word = metric.replace("_", " ")
    along = Axis("number of trials", ticks=tuple(trials))
    up = Axis(f"{word} of the last trial", unit, log=True)
    return Figure(
        [Panel(along, up, layers, legend="above", columns=2)],
        f"The {word} of trial J over machines that no tuning has seen, with the weights as given "
        "and with those tuned for J trials. Under the pointer stand the tuned weights.",
    )
