"""What a sweep says: yield, quantiles, worst sample, semi-convergence, per scheme."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..learning.divergence import GROWTH, grown_from

if TYPE_CHECKING:
    import xarray as xr

QUANTILES = (0.05, 0.5, 0.95)


class SchemeSummary(NamedTuple):
    """One scheme over all samples; errors in the unit of the dataset, infinite in a trial that
    diverged (see `divergence`).

    yield_share, yield_low, yield_high: share of samples within tolerance at the last trial, with
    its 95 % Wilson interval
    median, low, high, worst, worst_sample: (J,) by trial: quantiles 50, 5, 95 %, largest error and
    the sample it belongs to
    semi_converged: share of samples that have grown: above 1 + `growth` times their best at the
    last trial, though none diverged
    grown_from: the earliest trial from which on one of these stays above, 0 if there are none
    diverged: share of samples of which any trial diverged;  diverged_at: the earliest of these
    trials, 0 if there are none
    """

    scheme: str
    yield_share: float
    yield_low: float
    yield_high: float
    median: np.ndarray
    low: np.ndarray
    high: np.ndarray
    worst: np.ndarray
    worst_sample: np.ndarray
    semi_converged: float
    grown_from: int
    diverged: float
    diverged_at: int


def summarise(
    dataset: xr.Dataset, tolerance: float, *, figure: str = "settled_error", growth: float = GROWTH
) -> list[SchemeSummary]:
    """The summary of each scheme.

    tolerance: largest `figure` that passes, in its unit;  figure: a variable over (scheme, sample,
    trial); with several channels the largest of them counts;  growth: relative rise above the best
    trial that counts as growing again
    Raises ValueError for a tolerance that is not positive or a figure that is not there.
    """
    if not tolerance > 0:
        raise ValueError(
            f"summarise: tolerance = {tolerance:g} is outside its allowed range (0, inf)"
        )
    if figure not in dataset or not {"scheme", "sample", "trial"} <= set(dataset[figure].dims):
        names = [
            n for n, v in dataset.data_vars.items() if {"scheme", "sample", "trial"} <= set(v.dims)
        ]
        raise ValueError(
            f"summarise: figure = {figure!r} is not one of {', '.join(sorted(map(str, names)))}"
        )
    errors = dataset[figure]
    errors = errors.max(
        [d for d in errors.dims if d not in ("scheme", "sample", "trial")], skipna=False
    )
    sound = dataset["finite"] & ~dataset["diverged"] if "diverged" in dataset else dataset["finite"]
    errors = errors.where(sound).transpose("scheme", "sample", "trial").fillna(np.inf)
    return [
        _one_scheme(str(name), errors.sel(scheme=name).values, tolerance, growth)
        for name in dataset["scheme"].values
    ]


def _one_scheme(name: str, errors: np.ndarray, tolerance: float, growth: float) -> SchemeSummary:
    from scipy.stats import binomtest

    passed, samples = int(np.sum(errors[:, -1] <= tolerance)), len(errors)
    interval = binomtest(passed, samples).proportion_ci(method="wilson")
    low, median, high = np.quantile(errors, QUANTILES, axis=0, method="inverted_cdf")
    since, lost = grown_from(errors, growth), ~np.isfinite(errors)
    return SchemeSummary(
        scheme=name,
        yield_share=passed / samples,
        yield_low=float(interval.low),
        yield_high=float(interval.high),
        median=median,
        low=low,
        high=high,
        worst=errors.max(axis=0),
        worst_sample=errors.argmax(axis=0),
        semi_converged=float(np.mean(since > 0)),
        grown_from=int(min(since[since > 0], default=0)),
        diverged=float(np.mean(lost.any(axis=1))),
        diverged_at=1 + int(lost.any(axis=0).argmax()) if lost.any() else 0,
    )
