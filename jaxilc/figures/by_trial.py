"""Errors against the trial, with a logarithmic axis."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

import numpy as np

from .description import TRIAL, Axis, Bars, Curve, Figure, Layer, Panel, Rule, tips_of
from .paper import drawn
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
    style_of,
)

if TYPE_CHECKING:
    import xarray as xr
    from numpy.typing import ArrayLike

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
