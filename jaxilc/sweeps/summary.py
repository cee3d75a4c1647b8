"""The summary of a sweep for each scheme: yield, quantiles, worst machine, semi-convergence."""

from __future__ import annotations

import math
from collections.abc import Mapping
from statistics import NormalDist
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..learning.divergence import GROWTH, grown_from
from ..pytree.in_short import in_short
from ..pytree.ranges import brief, require
from .grid import STEPS

if TYPE_CHECKING:
    import xarray as xr

OVER = ("scheme", "sample", "trial")  # the dimensions of a metric of one number a trial
QUANTILES = (0.05, 0.5, 0.95)
CONFIDENCE = 0.95  # of the interval of the yield
FEWEST = 12  # machines whose spread is explained


class SchemeSummary(NamedTuple):
    """The summary of one scheme over all machines, by one metric.

    The metric has the unit of the dataset, and is infinite in a trial that diverged (see
    `learning.divergence`). Yield and growth leave out experiments, whose errors say nothing of what
    was learned; the quantiles have all trials.

    yield_share: share of machines within the tolerance at the last trial; NaN without a tolerance
    yield_low, yield_high: ends of the 95 % Wilson interval of this share, by the machines that were
        drawn: machine 0 is always the nominal one. NaN where none was drawn, as with corners
    median, low, high: (J,) quantiles of 50, 5 and 95 % for each trial; where `at_best` has kept
        the `trials` of each scheme, J is the number of this one
    worst, worst_machine: (J,) largest value for each trial, and the number of its machine
    semi_converged: share of machines whose error has grown: at the last trial it is above
        1 + `growth` times their best, though none of their trials diverged
    grown_from: earliest trial from which on one of these machines stays above that level, 0 if
        there are none
    grown_to: the largest error of one of these machines at the last trial, in units of the least
        error of the same machine; 1 if there are none
    diverged: share of machines with at least one trial that diverged
    diverged_at: earliest trial that diverged, 0 if there are none
    """

    scheme: str
    yield_share: float
    yield_low: float
    yield_high: float
    median: np.ndarray
    low: np.ndarray
    high: np.ndarray
    worst: np.ndarray
    worst_machine: np.ndarray
    semi_converged: float
    grown_from: int
    grown_to: float
    diverged: float
    diverged_at: int

    def __repr__(self) -> str:
        return in_short(self)


def summarise(
    dataset: xr.Dataset,
    tolerance: float | None,
    *,
    metric: str = "settled_error",
    growth: float = GROWTH,
) -> list[SchemeSummary]:
    """The summary of each scheme, also of a selection: one scheme, or some machines or trials.

    tolerance: the largest value of the metric that passes, in its unit; None if none is known
    metric: name of a variable over (scheme, sample, trial); with several channels the largest
        counts
    growth: relative rise above the best trial from which on the error counts as grown
    Raises ValueError for a tolerance that is not positive and finite, a metric that is not there,
    a grid, a dataset of `run_schemes`, and one of a sweep that is not complete.
    """
    if not hasattr(dataset, "data_vars"):
        raise ValueError(
            f"summarise: dataset is a {type(dataset).__name__}; allowed is a dataset of results, "
            "as Sweep.run gives it"
        )
    if axes_of(dataset):
        raise ValueError(
            f"summarise: the dataset has a grid over {', '.join(axes_of(dataset))}; allowed is one "
            "point, dataset.sel({...}), or at_best(dataset, best_points(dataset))"
        )
    require("summarise", "tolerance", tolerance, "(0, inf)", optional=True)
    dataset = over_all(dataset)
    if not {*OVER} <= {*dataset.dims}:
        raise ValueError(
            f"summarise: the dataset is not over {', '.join(OVER)}, as that of run_schemes, of one "
            "machine; allowed is that of Sweep.run"
        )
    if metric not in dataset or not {*OVER} <= {*dataset[metric].dims}:
        names = [n for n, v in dataset.data_vars.items() if {*OVER} <= {*v.dims}]
        raise ValueError(
            f"summarise: metric = {metric!r} is not one of {', '.join(sorted(map(str, names)))}"
        )
    errors = errors_by_scheme(dataset, metric)
    made_with = dataset.attrs.get("configuration", {})
    corners = isinstance(made_with, Mapping) and made_with.get("sampling") == "corners"
    rows = []
    for name, of in zip(dataset["scheme"].values, errors, strict=True):
        machines, trials = (
            of[d].values if d in of.coords else first + np.arange(of.sizes[d])
            for d, first in (("sample", 0), ("trial", 1))
        )
        drawn = (machines != 0) & (not corners)
        learned = learned_errors(of).values
        of_scheme = str(name), of.values, learned, machines, drawn, trials
        rows.append(_one_scheme(*of_scheme, tolerance, growth))
    return rows


def over_all(dataset: xr.Dataset) -> xr.Dataset:
    """The dataset over scheme, sample and trial again, where a selection has left one label."""
    return dataset.expand_dims([d for d in OVER if d in dataset.coords and d not in dataset.dims])


def errors_of(dataset: xr.Dataset, metric: str) -> xr.DataArray:
    """The metric over (scheme, sample, trial): the largest channel, infinite where one diverged.

    The axes of a grid, if there is one, are between scheme and sample. One point of an axis of
    trials has its own trials alone.
    Raises ValueError for a dataset of a sweep that is not complete, and for one without a machine
    or without a trial.
    """
    if 0 in dataset[metric].shape:
        sizes = dict(dataset[metric].sizes)
        raise ValueError(f"the dataset has the sizes {sizes}; allowed is one of each at least")
    if "diverged_at" in dataset and (left := int((dataset["diverged_at"] < 0).sum())):
        raise ValueError(
            f"{left} of {dataset['diverged_at'].size} results of the dataset are not computed; "
            "resume the sweep, or select schemes, points and machines of which all are, where "
            "dataset.diverged_at is not -1"
        )
    errors, order = dataset[metric], ("scheme", *axes_of(dataset), "sample", "trial")
    errors = errors.max([d for d in errors.dims if d not in order], skipna=False)
    sound = dataset["finite"] & ~dataset["diverged"] if "diverged" in dataset else dataset["finite"]
    return _own(errors.where(sound).transpose(*order).fillna(np.inf))


def learned_errors(errors: xr.DataArray) -> xr.DataArray:
    """Errors as `errors_of` has them, where an experiment has that of the learned trial before it.

    Infinite ones are kept, and so are those of a selection before its first learned trial.
    """
    if STEPS not in errors.coords:
        return errors
    j = errors["trial"].copy(data=np.arange(errors.sizes["trial"]))
    played = j.where((errors["trial"] - 1) % errors[STEPS] == 0, -1)
    at = played.copy(data=np.maximum.accumulate(played.values, played.get_axis_num("trial")))
    held = errors.drop_vars("trial").isel(trial=at.where(at >= 0, j))
    return held.where(np.isfinite(errors), np.inf).transpose(*errors.dims)


def errors_by_scheme(dataset: xr.Dataset, metric: str) -> list[xr.DataArray]:
    """The same of each scheme, up to its own last trial where `at_best` has kept that."""
    return [_own(of) for of in errors_of(dataset, metric)]


def _own(errors: xr.DataArray) -> xr.DataArray:
    """The errors of the trials that one point of an axis of trials has; all if it is not one."""
    last = errors.coords.get("trials")
    if last is None or last.ndim:
        return errors
    if not np.any(run := errors["trial"].values <= int(last)):
        raise ValueError(
            f"trial = {brief(errors['trial'].values.tolist())} of the dataset is none of its "
            f"point, whose last trial is {int(last)}"
        )
    return errors.isel(trial=run)


def last_errors(values: Mapping[str, np.ndarray], metric: str) -> np.ndarray:
    """As `errors_of`, of the last trial: (machines,), from arrays over (machines, trials, ...)."""
    errors = values[metric][:, -1].reshape(len(values[metric]), -1).max(axis=1)
    return np.where(values["finite"][:, -1] & ~values["diverged"][:, -1], errors, np.inf)


def axes_of(dataset: xr.Dataset) -> tuple[str, ...]:
    """The axes of the grid of a dataset; none for a sweep of one point."""
    dims = map(str, dataset["finite"].dims)
    return tuple(dim for dim in dims if dim not in OVER)


def _one_scheme(
    name: str,
    errors: np.ndarray,
    learned: np.ndarray,
    machines: np.ndarray,
    drawn: np.ndarray,
    trials: np.ndarray,
    tolerance: float | None,
    growth: float,
) -> SchemeSummary:
    """learned: as `learned_errors`;  machines, trials: their numbers;  drawn: which were drawn"""
    share, interval = math.nan, (math.nan, math.nan)
    if tolerance is not None:
        passed = learned[:, -1] <= tolerance
        share = float(np.mean(passed))
        if drawn.any():
            interval = wilson_interval(int(np.sum(passed & drawn)), int(np.sum(drawn)))
    of_a_trial = errors.T.copy()  # quantiles of adjacent numbers take less time
    low, median, high = np.quantile(
        of_a_trial, QUANTILES, axis=1, method="inverted_cdf", overwrite_input=True
    )
    since, lost = grown_from(learned, growth), ~np.isfinite(errors)
    grown = learned[since > 0]
    least = grown.min(axis=1)
    times = np.divide(grown[:, -1], least, out=np.full(len(grown), np.inf), where=least > 0)
    return SchemeSummary(
        scheme=name,
        yield_share=share,
        yield_low=interval[0],
        yield_high=interval[1],
        median=median,
        low=low,
        high=high,
        worst=errors.max(axis=0),
        worst_machine=machines[errors.argmax(axis=0)],
        semi_converged=float(np.mean(since > 0)),
        grown_from=int(trials[min(since[since > 0]) - 1]) if np.any(since > 0) else 0,
        grown_to=float(max(times, default=1.0)),
        diverged=float(np.mean(lost.any(axis=1))),
        diverged_at=int(trials[lost.any(axis=0).argmax()]) if lost.any() else 0,
    )


def wilson_interval(passed: int, machines: int) -> tuple[float, float]:
    """The ends of the Wilson interval of a share, with a confidence of 95 % (Wilson 1927).

        (k + z^2 / 2 -+ z sqrt(k (n - k) / n + z^2 / 4)) / (n + z^2)

    scipy.stats has it too, but takes longer to import than a sweep of many machines to run.

    passed, machines: k and n
    """
    z = NormalDist().inv_cdf(0.5 + CONFIDENCE / 2)
    half = z * math.sqrt(passed * (machines - passed) / machines + z**2 / 4)
    low, high = ((passed + z**2 / 2 + sign * half) / (machines + z**2) for sign in (-1, 1))
    return (low if passed else 0.0), (high if passed < machines else 1.0)


def explained_shares(parameters: Mapping[str, np.ndarray], errors: np.ndarray) -> dict[str, float]:
    """How much of the spread of the errors each uncertain parameter explains by itself.

    It is the share of the variance of their ranks:

        1 - sum_i (R_{i+1} - R_i)^2 / (2 (S - 1) var(R))

    R_i is the rank of the error of the i-th machine in the order of the parameter: if the parameter
    explains everything, neighbours have nearly the same rank. It estimates the first-order
    sensitivity index (Gamboa, Gremaud, Klein, Lagnoux 2022) for any shape of the dependence. Ranks
    are used since errors differ by decades, and one that diverged has a rank, too. Without any
    effect the standard deviation of the estimate is about 1 / S^(1/2).

    parameters: (S,) values by name
    errors: (S,) errors, inf for a machine that diverged
    Returns shares from 0 to 1; 0 where all errors are equal, NaN of fewer than 12 machines.
    Raises ValueError for numbers of machines that differ.
    """
    from scipy.stats import rankdata

    errors = np.asarray(errors, float)
    ranks, machines = rankdata(np.nan_to_num(errors, nan=np.inf)), len(errors)
    # machines with equal values, such as corners, stand in no order among themselves
    shuffled = np.random.default_rng(0).permutation(machines)
    shares = {}
    for name, values in parameters.items():
        if len(values) != machines:
            raise ValueError(
                f"explained_shares: {name} has {len(values)} values; allowed are {machines}"
            )
        if machines < FEWEST or np.ptp(ranks) == 0 or np.ptp(values) == 0:
            shares[name] = np.nan if machines < FEWEST else 0.0
            continue
        order = shuffled[np.argsort(np.asarray(values)[shuffled], kind="stable")]
        steps = np.sum(np.diff(ranks[order]) ** 2) / (2 * (machines - 1) * np.var(ranks))
        shares[name] = float(np.clip(1.0 - steps, 0.0, 1.0))
    return shares
