"""Figures of searches: a tuning step by step, a trade-off, the worst machine."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from .style import (
    COLOURS,
    DASHES,
    MARKS,
    grid,
    legend_above,
    legend_beside,
    limits_of,
    new_axes,
)
from .units import name_axis, written

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from ..tuning.problem import Tuned
    from ..tuning.trade_off import Point

NEAR = (0.12, 0.06)  # shares of the axes within which two points have one label


def loss_by_step(tuned: Tuned, *, ax: Axes | None = None) -> Axes:
    """A tuning: the loss against the step for each start, on the machines of the tuning.

    The loss on the held-out machines is shown at the steps at which it was computed.
    """
    ax = new_axes(ax)
    for k, losses in enumerate(tuned.loss.T):
        ax.plot(
            losses,
            color=COLOURS[0],
            linewidth=0.8,
            alpha=0.8,
            label="machines tuned on" if k == 0 else None,
        )
    for k, losses in enumerate(tuned.held_out.T):
        looked = np.flatnonzero(np.isfinite(losses))
        ax.plot(
            looked,
            losses[looked],
            "o--",
            color=COLOURS[1],
            markersize=3,
            linewidth=0.5,
            label="held-out machines" if k == 0 else None,
        )
    ax.plot(tuned.step, tuned.after, "k*", markersize=10, label="chosen")
    ax.set(xlabel="step", ylabel="loss")
    ax.set_title("loss by step of the tuning", fontsize="medium")
    grid(ax)
    legend_beside(ax)
    return ax


def worst_against_chance(
    drawn, found: Mapping[str, float], *, nominal: float, metric: str = "", unit: str = "", ax=None
) -> Axes:
    """A search for the worst machine: the metric of drawn machines and the result of each search.

    The curve shows which share of the drawn machines errs no more than so much; it ends below 100 %
    where some are not finite. The nominal machine
    is where the curve begins, or it is marked; each search is a line at the error that it found.

    drawn: (S,) the metric of the machines drawn at random
    found: the largest value by the name of the search
    nominal: the value of the nominal machine
    metric, unit: name and unit of the metric
    """
    ax = new_axes(ax)
    count, drawn = np.size(drawn), np.sort(np.asarray(drawn)[np.isfinite(drawn)])
    share = 100 * np.arange(1, len(drawn) + 1) / max(count, 1)
    label = f"{count} machines drawn: share that errs less"
    ax.plot(drawn, share, color="0.45", drawstyle="steps-post", linewidth=1.4, label=label)
    ax.fill_between(drawn, share, step="post", color="0.45", alpha=0.12, linewidth=0)
    marked = {"nominal machine": (nominal, "k", ":")}
    for i, (name, value) in enumerate(found.items()):
        marked[name] = (value, COLOURS[i % len(COLOURS)], DASHES[i % len(DASHES)])
    for name, (value, colour, dash) in marked.items():
        if np.isfinite(value):
            said = f"{name}: {written(value, unit, 4)}"
            ax.axvline(value, color=colour, linestyle=dash, linewidth=1.4, label=said)
    held = limits_of([*drawn, *(value for value, _, _ in marked.values())], pad=1.05)
    if held and held[1] > 3 * held[0]:
        ax.set_xscale("log")
        ax.set_xlim(*held)
    ax.set(ylim=(0, 103), ylabel="machines drawn [%]")
    grid(ax)
    name_axis(ax.xaxis, metric, unit)
    legend_above(ax, 1)
    return ax


def pareto_front(
    points: Iterable[Point],
    *,
    first: str = "",
    second: str = "",
    given: tuple[float, float] | None = None,
    ax: Axes | None = None,
) -> Axes:
    """A trade-off: both objectives of each point, labelled with the share of the first one.

    points: points from `tuning.pareto`
    first, second: names of the objectives
    given: both objectives with the weights as given
    """
    ax = new_axes(ax)
    points = sorted(points, key=lambda p: p.first)
    ax.plot(
        [p.first for p in points],
        [p.second for p in points],
        "o-",
        color=COLOURS[0],
        drawstyle="steps-post",
        label="tuned; beside: share of the first",
    )
    if given is not None:
        ax.plot(*given, "o", mfc="none", color=COLOURS[1], label="given")
    ax.margins(0.12)
    for at, shares in _together(points, ax):
        ax.annotate(
            ", ".join(f"{share:g}" for share in sorted(shares)),
            at,
            textcoords="offset points",
            xytext=(-6, 5) if _is_right(at, ax) else (6, 5),
            ha="right" if _is_right(at, ax) else "left",
            fontsize="small",
        )
    legend_above(ax)
    ax.set(xlabel=first, ylabel=second)
    grid(ax)
    return ax


def _together(points: Sequence[Point], ax: Axes) -> list[tuple[tuple[float, float], list[float]]]:
    """The shares of points that would be written over each other, at the first of them."""
    found: list[tuple[tuple[float, float], list[float]]] = []
    for p in points:
        for at, shares in found:
            apart = ax.transData.transform([at, (p.first, p.second)])
            apart = np.abs(np.diff(ax.transAxes.inverted().transform(apart), axis=0)).ravel()
            if np.all(apart < NEAR):
                shares.append(p.share)
                break
        else:
            found.append(((p.first, p.second), [p.share]))
    return found


def _is_right(at: tuple[float, float], ax: Axes) -> bool:
    """Whether a point is in the right half of the axes."""
    return ax.transAxes.inverted().transform(ax.transData.transform(at))[0] > 0.5


def final_error_by_trials(
    trials: Sequence[int], given, tuned, *, metric: str = "", unit: str = "", ax: Axes | None = None
) -> Axes:
    """The metric of trial J with the weights as given, and with those tuned for J trials; log axis.

    trials: (n,) J
    given, tuned: (n, 2) median and worst over machines [unit]; the worst is dashed
    metric, unit: name and unit of the metric
    """
    ax = new_axes(ax)
    for name, values, colour in (
        ("given", given, COLOURS[1]),
        ("tuned for that many trials", tuned, COLOURS[0]),
    ):
        for column, quantile in enumerate(("median", "worst")):
            shown = {
                "color": colour,
                "marker": MARKS[column],
                "linestyle": DASHES[column],
                "label": f"{name}, {quantile}",
            }
            ax.semilogy(trials, np.asarray(values)[:, column], **shown)
    ax.set(xticks=list(trials), xlabel="number of trials")
    grid(ax)
    name_axis(ax.yaxis, f"{metric.replace('_', ' ')} of the last trial", unit)
    legend_above(ax)
    return ax
