"""Errors against the trial, with a logarithmic axis: of one machine, and of many at a glance."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from textwrap import wrap
from typing import TYPE_CHECKING

import numpy as np

from ..pytree.ranges import share_text
from .description import TRIAL, Axis, Band, Bars, Curve, Figure, Layer, Panel, Rule, tips_of
from .paper import draw, drawn
from .style import (
    BLACK,
    BOUND,
    COLOURS,
    GREY,
    colour_of,
    limits_of,
    marks_of,
    names_of,
    numbers_of,
    readable,
    style_of,
    written,
)

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from numpy.typing import ArrayLike

    from ..sweeps.summary import SchemeSummary
    from ..theory import Certificate

# Colours of what is claimed: monotone, converges, diverges, not claimed.
HUES = (COLOURS[0], COLOURS[2], COLOURS[1], GREY)
SAID = {"monotone": "claimed monotone", "converges": "claimed to converge",
        "diverges": "claimed to diverge", "not claimed": "nothing claimed"}  # fmt: skip


@drawn
def error_by_trial(
    dataset: xr.Dataset,
    *,
    metric: str = "settled_error",
    scale: float = 1.0,
    unit: str = "",
    published: Iterable = (),
    tolerance: float | None = None,
) -> Figure:
    """The error of one machine against the trial, for each scheme, with printed values.

    A printed value has the scheme's colour; it is an open circle, or a caret below a printed upper
    bound. A trial that diverged is left out. The legend says in which trial learning diverged, and
    from which trial on an error has grown.

    dataset: over (scheme, trial), as `run_schemes` gives it
    metric: name of a variable over these
    scale, unit: the errors are shown as `scale` times those of the dataset, in `unit`
    published: rows with scheme, trial (None for a scheme that does not learn, shown at trial 1),
        quantity, value [unit], at_most
    tolerance: largest error that passes [unit of the dataset], a dashed line
    Raises ValueError for a dataset of many machines, which `error_band` shows.
    """
    if dataset.sizes.get("sample", 1) > 1:
        raise ValueError(
            f"error_by_trial: the dataset has {dataset.sizes['sample']} machines; allowed is one, "
            "and error_band shows many"
        )
    trials, word = dataset["trial"].values, metric.replace("_", " ")
    due = [p for p in published if p.quantity == metric and (p.trial or 1) <= len(trials)]
    layers: list[Layer] = []
    printed: list[Layer] = []
    for i, name in zip(numbers_of(names := names_of(dataset)), names, strict=True):
        errors = dataset[metric].sel(scheme=name)
        errors = scale * errors.max([d for d in errors.dims if d != "trial"])
        if "diverged" in dataset:
            errors = errors.where(~dataset["diverged"].sel(scheme=name))
        called = name + _course(dataset, name)
        style = style_of(i) | marks_of(i, len(trials))
        layers.append(Curve(trials, errors.values, name=called, **style))
        for mark, size, said in (("o", 6, "published"), (BOUND, 9, "published: less")):
            rows = [p for p in due if p.scheme == name and p.at_most == (mark == BOUND)]
            at, values = [p.trial or 1 for p in rows], [p.value for p in rows]
            if rows:
                printed.append(
                    Curve(at, values, dash="", mark=mark, size=size, filled=False, name=said,
                          colour=colour_of(i))
                )  # fmt: skip
    layers += sorted(printed, key=lambda of: of.name)
    if tolerance is not None:
        layers.append(Rule(scale * tolerance, dash="--"))
    panel = Panel(TRIAL, Axis(metric, unit, log=True), layers, f"{word} by trial, one machine")
    return Figure(
        [panel],
        f"The {word} of each trial. A click on a name hides its curve and shows it again; under "
        "the pointer stand the numbers.",
    )


def _course(dataset: xr.Dataset, name: str) -> str:
    """The text for the legend: in which trial a scheme diverged, or its error began to grow."""
    for since, said in (("diverged_at", "diverged at trial {}"),
                        ("grown_from", "grown from trial {} on")):  # fmt: skip
        trial = int(dataset[since].sel(scheme=name)) if since in dataset else 0
        if trial:
            return f" ({said.format(trial)})"
    return ""


@drawn
def certificate(
    found: Certificate,
    *,
    scale: float = 1.0,
    unit: str = "",
    title: str = "",
    parameters: Mapping[str, ArrayLike] | None = None,
) -> Figure:
    """What theory claims of each machine, and the errors that it predicts and simulation has.

    Above, the RMS error of each machine by trial, in the colour of its claim; the median prediction
    is dashed. Below, how many machines have each claim. Two axes.

    found: certificate from `theory.certify`
    scale, unit: the errors are shown as `scale` times those found, in `unit`
    parameters: (S,) values of the uncertain parameters by path, for the pointer
    """
    from ..theory.certificates import CLAIMS

    trial, total = np.arange(1, found.predicted.shape[1] + 1), len(found.claim)
    simulated = np.where(np.isfinite(found.simulated), scale * found.simulated, np.nan)
    values = tips_of(parameters or {})
    layers: list[Layer] = []
    claims = []
    for claim, hue in zip(CLAIMS, HUES, strict=False):
        which = np.flatnonzero(found.claim == claim)
        if len(which):
            claims.append((SAID.get(claim, claim), len(which), hue))
            many, name = len(which) > 3, f"simulated, {claims[-1][0]}"
            tips = {"machine": which} | {name: of[which] for name, of in values.items()}
            layers.append(
                Curve(trial, simulated[which], name=name, colour=hue, tips=tips,
                      width=0.6 if many else 1.2, alpha=0.6 if many else 1.0)
            )  # fmt: skip
    sure = np.where(np.isfinite(found.predicted) & (found.predicted > 0), found.predicted, np.nan)
    known = np.any(np.isfinite(sure), axis=0)
    middle = np.full(len(trial), np.nan)
    middle[known] = scale * np.nanmedian(sure[:, known], axis=0)
    if known.any():
        said = "predicted, median machine"
        layers.append(Curve(trial, middle, dash="--", width=1.4, name=said, colour=BLACK))
    ends = limits_of([*simulated.ravel(), *middle])
    first = scale * np.nanmax(np.where(np.isfinite(sure[:, 0]), sure[:, 0], 0), initial=0)
    if ends and first > 0:
        ends = ends[0], min(ends[1], 1e3 * first)
    names, counts, hues = zip(*claims or [(SAID[CLAIMS[0]], 0, HUES[0])], strict=True)
    errors = Panel(
        TRIAL, Axis("RMS error", unit, log=True, ends=ends), layers,
        f"{title}: {total} machines".removeprefix(": "),
    )  # fmt: skip
    machines = Axis("machines", whole=True, most=8, ends=(0, 1.12 * total))
    down = Axis(names=names, ends=(len(names) - 0.5, -0.5))
    return Figure(
        [errors, Panel(machines, down, [Bars(counts, hues)])],
        f"{title}: the RMS error of each machine by trial, in the colour of what theory claims of "
        "it, and how many machines have each claim. Under the pointer stands which machine it is, "
        "and its parameters.".removeprefix(": "),
        size=(7.2, 5.2), shares="", heights=(3.2, 1),
    )  # fmt: skip


# A sweep: one panel a scheme, and the yield against the tolerance beside them
# --------------------------------------------------------------------------------------------------


GROWS = 10.0  # an error is shown up to so many times that of the first trial
RATIOS = (0.1, 1e3)  # of given and tuned errors that are shown
SAME = 1e-3  # relative difference of medians below which no trial is better than the others
TITLE = 26  # letters of a line of a title, which is no wider than its panel
MANY = 4  # schemes from which on three panels stand side by side
ALONE = (-0.2, 0.2)  # from where to where a single trial is drawn, around its number


def error_band(
    dataset: xr.Dataset,
    *,
    metric: str = "settled_error",
    tolerance: float | None = None,
    scale: float = 1.0,
    unit: str = "",
    summary: list[SchemeSummary] | None = None,
) -> np.ndarray:
    """A sweep: a panel for each scheme, and the share of machines within any tolerance; n+1 axes.

    A panel shows the median, the band of 5 to 95 %, the worst machine, the tolerance, and the trial
    of the least median. All panels have the same limits, which follow from the errors. What leaves
    them at the top, such as a scheme that diverges, is cut off there and told in the panel. The
    last axes show which share of the machines ends within a tolerance, against the tolerance.

    dataset: over (scheme, sample, trial), one machine a sample, or a selection
    metric: name of a variable over these
    tolerance: largest error that passes [unit of the dataset]
    scale, unit: the errors are shown as `scale` times those of the dataset, in `unit`
    summary: what `summarise` gives for this dataset and metric, None to have it computed
    """
    from ..sweeps.summary import errors_by_scheme, learned_errors, over_all, summarise

    dataset = over_all(dataset)
    rows = summarise(dataset, tolerance, metric=metric) if summary is None else summary
    limit = None if tolerance is None else scale * tolerance
    limits = _limits(rows, scale, limit)
    by_scheme = errors_by_scheme(dataset, metric)
    last = scale * np.array([learned_errors(of)[:, -1] for of in by_scheme])
    lengths = sorted({len(row.median) for row in rows})
    numbers = dataset["trial"].values if "trial" in dataset.coords else 1 + np.arange(lengths[-1])
    looks = numbers_of(row.scheme for row in rows)
    panels = [
        _panel(row, look, scale, limit, (metric, unit), limits, numbers[: lengths[-1]])
        for row, look in zip(rows, looks, strict=True)
    ]
    shares = _shares(names_of(dataset), last, (metric, unit, limit), limits)
    axes = draw(Figure([*panels, shares], shares=""), _axes(len(rows)))
    for i, (ax, row) in enumerate(zip(axes, rows, strict=False)):
        colour = readable(colour_of(looks[i]))
        title = "\n".join(wrap(row.scheme, TITLE))
        ax.set_title(title, fontsize="small", loc="left", color=colour, fontweight="bold")
        place, below = ax.get_subplotspec(), i + _columns(len(rows)) < len(rows)
        ax.tick_params(labelleft=place.is_first_col(), labelbottom=not below)
        ax.set_ylabel(ax.get_ylabel() if place.is_first_col() else "")
        ax.set_xlabel("" if below else ax.get_xlabel())
    axes[-1].set_title("yield against tolerance", fontsize="small", loc="left")
    axes[-1].tick_params(axis="x", labelrotation=30)
    figure, machines = axes[-1].figure, dataset.sizes["sample"]
    _explain(figure, limit, unit)
    trials = " to ".join(map(str, lengths[:: max(len(lengths) - 1, 1)]))
    said = f"{machines} machine{'s' * (machines != 1)}, {trials} trial{'s' * (lengths != [1])}"
    figure.suptitle(said, fontsize="medium")
    return axes


def band_together(
    rows: Sequence[SchemeSummary],
    *,
    metric: str,
    tolerance: float | None = None,
    scale: float = 1.0,
    unit: str = "",
) -> Figure:
    """The same in one panel, for a page, whose legend hides schemes."""
    layers: list[Layer] = []
    seen: list[float] = []
    for i, row in zip(numbers_of(row.scheme for row in rows), rows, strict=True):
        low, median, high, worst = _quantiles(row, scale)
        top = top_of(median)
        seen += [*np.minimum(high, top), *low]
        clip = np.minimum(high, 1e3 * top if np.isfinite(top) else np.finfo(float).max / 1e9)
        pale = 0.2 if np.all(high <= top) else 0.05  # a band without an end would tint all others
        trials = np.arange(1, len(median) + 1)
        name, hue = row.scheme, colour_of(i)
        told = [written(x, unit, 4) if np.isfinite(x) else "diverged" for x in worst]
        layers += [
            Band(trials, low, clip, alpha=pale, name=name, colour=hue),
            Curve(trials, median, mark="o", size=3, tips={"worst": told}, name=name, colour=hue),
            Curve(trials, worst, dash=":", name=name, colour=hue),
        ]
    if tolerance is not None:
        layers.append(Rule(scale * tolerance, dash="--"))
    word = metric.replace("_", " ")
    return Figure(
        [Panel(TRIAL, Axis(metric, unit, log=True, ends=limits_of(seen)), layers)],
        f"The {word} by trial over all machines: the line is the median, the band holds 90 % of "
        "them, the dots are the worst machine of each trial. A click on a name hides a scheme and "
        "shows it again.",
    )


def _columns(count: int) -> int:
    """How many panels stand side by side."""
    return 3 if count > MANY else min(count, 2)


def _axes(count: int) -> np.ndarray:
    """The axes of the panels, which share both axes, and those of the shares beside them."""
    from matplotlib.figure import Figure as Paper

    columns = _columns(count)
    rows = math.ceil(count / columns)
    size = (3.4 + 2.4 * columns + 0.8 * (columns == 1), 1.3 + 2.1 * max(rows, 1.4))
    paper = Paper(figsize=size, layout="constrained", dpi=150)
    ratios = (*[1.0] * columns, 1.35 if columns > 1 else 1.0)
    cells = paper.add_gridspec(rows, columns + 1, width_ratios=ratios)
    made: list[Axes] = []
    for i in range(count):
        shared = made[0] if made else None
        cell = cells[i // columns, i % columns]
        made.append(paper.add_subplot(cell, sharex=shared, sharey=shared))
    return np.array([*made, paper.add_subplot(cells[:, columns])])


def _quantiles(row: SchemeSummary, scale: float) -> list[np.ndarray]:
    """Low end, median, high end and worst machine by trial."""
    return [scale * np.asarray(x, float) for x in (row.low, row.median, row.high, row.worst)]


def _limits(rows, scale: float, limit: float | None) -> tuple[float, float]:
    """Limits that hold what learns, and the tolerance; a scheme that grows counts up to GROWS."""
    shown = [] if limit is None else [limit]
    for row in rows:
        low, median, high, _ = _quantiles(row, scale)
        top = top_of(median)
        for values in (low, median, high):
            kept = values[np.isfinite(values) & (values > 0)]
            shown += np.minimum(kept, top).tolist()
    return limits_of(shown) or (0.1, 10.0)


@drawn
def given_and_tuned(
    dataset: xr.Dataset, *, metric: str = "settled_error", scale: float = 1.0, unit: str = ""
) -> Figure:
    """A tuning judged: the errors by trial of both laws, and below them their ratio.

    Each machine has its ratio, given over tuned; above 1 the tuned law is better on it. A machine
    on which one law diverges has the ratio 0 or infinity, and where both do it has none.

    dataset: over (scheme, sample, trial) with the schemes `given` and `tuned`
    metric, scale, unit: as for `error_band`
    """
    from ..sweeps.summary import errors_of, summarise

    rows = summarise(dataset, None, metric=metric)
    above = band_together(rows, metric=metric, scale=scale, unit=unit)
    errors = errors_of(dataset, metric)
    tuned, given = (errors.sel(scheme=name).values for name in ("tuned", "given"))
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.where((tuned == 0) & (given == 0), 1.0, given / tuned)
    parts = np.full((4, ratio.shape[1]), np.nan)  # as in a trial in which no machine has a ratio
    has = ~np.all(np.isnan(ratio), axis=0)
    quantiles = (0.0, 0.05, 0.5, 0.95)
    parts[:, has] = np.nanquantile(ratio[:, has], quantiles, axis=0, method="inverted_cdf")
    trials = np.arange(1, ratio.shape[1] + 1)
    layers: list[Layer] = [
        Band(trials, *np.minimum(parts[[1, 3]], RATIOS[1]), name="5 to 95 % of the machines"),
        Curve(trials, parts[2], name="median machine"),
        Curve(trials, parts[0], dash=":", name="least ratio"),
        Rule(1.0, name="above 1: tuning gains"),
    ]
    ends = limits_of([*np.clip(parts[1:], *RATIOS).ravel(), 1.0], pad=1.2)
    below = Panel(TRIAL, Axis("given / tuned", log=True, ends=ends), layers)
    return Figure(
        [*above.panels, below],
        "Above, the errors by trial over the nominal machine and others that no step has seen: the "
        "line is the median, the band holds 90 % of the machines, the dots are the worst one. "
        "Below, the error with the given weights over that with the tuned ones, of each machine.",
    )


def top_of(median) -> float:
    """Up to where the errors are shown whose first median is positive; infinite for others."""
    return GROWS * median[0] if 0 < median[0] < np.inf else np.inf


def _panel(
    row: SchemeSummary, i: int, scale: float, limit: float | None, shown: tuple[str, str], limits,
    numbers: np.ndarray,
) -> Panel:  # fmt: skip
    """Median, band, worst machine, tolerance and best trial of one scheme.

    shown: metric, unit;  numbers: of the trials of the panel with most of them
    """
    hue, top = colour_of(i), limits[1]
    low, median, high, worst = _quantiles(row, scale)
    trial = numbers[: len(median)]
    at = trial if len(trial) > 1 else trial + np.array(ALONE)
    band = np.where(low < top, low, np.nan), np.minimum(high, top)  # none that begins beyond it
    lower, upper, middle, most = (np.resize(of, len(at)) for of in (*band, median, worst))
    layers: list[Layer] = [
        Band(at, lower, upper, alpha=0.22, colour=hue),
        Curve(at, most, dash=":", width=1, colour=hue),
        Curve(at, middle, width=1.6, colour=hue),
    ]
    if limit is not None:
        layers.append(Rule(limit, dash="--"))
    known = median[np.isfinite(median) & (median > 0)]
    if known.size and known.max() > (1 + SAME) * known.min():
        best = int(np.argmin(np.where(np.isfinite(median) & (median > 0), median, np.inf)))
        here = [trial[best]], [median[best]]
        layers.append(Curve(*here, dash="", mark="o", filled=False, colour=hue))
    along = TRIAL._replace(most=6, ends=(numbers[0] - 0.5, numbers[-1] + 0.5))
    note = _said(row, high > top * 1.001, worst > top * 1.001, written(worst[-1], shown[1]), trial)
    return Panel(along, Axis(shown[0], shown[1], log=True, ends=limits), layers, note=note)


def _said(row, band: np.ndarray, worst: np.ndarray, last: str, trial: np.ndarray) -> str:
    """What a panel tells in words: the yield, machines that diverged, and what leaves it.

    band, worst: in which trials the band and the worst machine do;  last: the worst error at last
    trial: their numbers
    """
    lines = []
    if np.isfinite(row.yield_share):
        lines.append(f"{share_text(row.yield_share)} within tolerance")
    if row.diverged:
        lines.append(f"{share_text(row.diverged)} diverged")
    last = f"{last} in the last" if np.isfinite(row.worst[-1]) else ""
    if np.any(band):
        lines.append(f"band cut off at the top\n{_when(band, trial)}")
        lines += [f"worst machine {last}"] * bool(last)
    elif np.any(worst):
        lines.append(
            f"worst machine beyond the top\n{_when(worst, trial)}" + f", {last}" * bool(last)
        )
    return "\n".join(lines)


def _when(holds: np.ndarray, trial: np.ndarray) -> str:
    """In which trials something holds that does in some."""
    first = np.argmax(holds)
    always = f"from trial {trial[first]} on"
    return always if np.all(holds[first:]) else f"in {np.sum(holds)} of {len(holds)} trials"


def _shares(names, last: np.ndarray, shown: tuple, held: tuple[float, float]) -> Panel:
    """The share of the machines whose last error is within a tolerance, against the tolerance.

    last: (schemes, machines) errors, inf where one diverged;  held: ends of the axis
    shown: name of the metric, its unit, and the tolerance
    """
    metric, unit, limit = shown
    layers: list[Layer] = []
    for name, i, errors in zip(names, numbers_of(names), last, strict=True):
        found = np.sort(errors[(errors > held[0]) & (errors <= held[1])])
        zero = np.mean(errors <= held[0])
        share = np.concatenate([[zero], zero + np.arange(1, len(found) + 1) / len(errors)])
        at, share = [held[0], *found, held[1]], 100 * np.append(share, share[-1])
        layers.append(Curve(at, share, steps=True, width=1.6, name=name, colour=colour_of(i)))
    if limit is not None:
        layers.append(Rule(limit, "x", dash="--"))
    along = Axis(f"last {metric.replace('_', ' ')} at most", unit, log=True, ends=held)
    return Panel(along, Axis("machines within [%]", ends=(-3, 103)), layers, legend="")


def _explain(figure, limit: float | None, unit: str) -> None:
    """One line below all panels that says what the lines are."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles: list[Artist] = [
        Line2D([], [], color="0.3", linewidth=1.6, label="median"),
        Patch(color="0.3", alpha=0.22, linewidth=0, label="5 to 95 %"),
        Line2D([], [], color="0.3", linestyle=":", label="worst machine"),
        Line2D([], [], color="0.3", marker="o", mfc="none", linestyle="", label="best trial"),
    ]
    if limit is not None:
        said = f"tolerance {written(limit, unit)}"
        handles.append(Line2D([], [], color="k", linestyle="--", linewidth=0.8, label=said))
    figure.legend(handles=handles, loc="outside lower center", ncols=5, fontsize="small")
