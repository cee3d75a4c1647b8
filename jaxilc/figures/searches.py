"""Figures of searches: a tuning step by step, a trade-off, the worst machine."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from .style import COLOURS, DASHES, MARKS, grid, labelled, legend_above, legend_beside, new_axes

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from ..tuning.problem import Tuned
    from ..tuning.trade_off import Point


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
            label="plants tuned on" if k == 0 else None,
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
            label="held-out plants" if k == 0 else None,
        )
    ax.plot(tuned.step, tuned.after, "k*", markersize=10, label="chosen")
    ax.set(xlabel="step", ylabel="loss")
    grid(ax)
    legend_beside(ax)
    return ax


def worst_against_chance(
    drawn, found: Mapping[str, float], *, nominal: float, metric: str = "", unit: str = "", ax=None
) -> Axes:
    """A search for the worst machine: the metric of drawn machines and the result of each search.

    drawn: (S,) the metric of the machines drawn at random, shown as a distribution with a log axis
    found: the largest value by the name of the search
    nominal: the value of the nominal machine
    metric, unit: name and unit of the metric
    """
    ax = new_axes(ax)
    drawn = np.asarray(drawn)
    drawn = drawn[np.isfinite(drawn) & (drawn > 0)]
    low, high = drawn.min(), drawn.max() * (1 + 1e-9)
    ax.hist(
        drawn,
        bins=np.geomspace(low, high, 60) if high > 1.01 * low else 10,
        color="#999999",
        label=f"{len(drawn)} machines drawn",
    )
    ax.axvline(nominal, color="k", linewidth=0.8, label=f"nominal {nominal:.4g}")
    for i, (name, value) in enumerate(found.items()):
        if np.isfinite(value):
            ax.axvline(
                value,
                color=COLOURS[i % len(COLOURS)],
                linestyle=DASHES[i % len(DASHES)],
                label=f"{name} {value:.4g}",
            )
    ax.set(xscale="log", yscale="log", xlabel=labelled(metric, unit), ylabel="machines")
    grid(ax)
    legend_above(ax)
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
    for p in points:
        ax.annotate(
            f"{p.share:g}",
            (p.first, p.second),
            textcoords="offset points",
            xytext=(6, 4),
            fontsize="small",
        )
    if given is not None:
        ax.plot(*given, "o", mfc="none", color=COLOURS[1], label="given")
    legend_above(ax)
    ax.set(xlabel=first, ylabel=second)
    grid(ax)
    return ax


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
    ax.set(
        xticks=list(trials),
        xlabel="number of trials",
        ylabel=f"{labelled(metric, unit)} of the last trial",
    )
    grid(ax)
    legend_above(ax)
    return ax
