"""The best point of a grid for each scheme, how flat it is there, and where machines diverge."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np

from ..pytree.aliases import Value
from ..pytree.in_short import in_short
from ..pytree.ranges import share_text, value_text
from .grid import STEPS, TRIALS, labels_along
from .summary import QUANTILES, axes_of, errors_of, learned_errors

if TYPE_CHECKING:
    import xarray as xr

Ends: TypeAlias = dict[str, tuple[Value, Value]]
NEAR = 2.0  # a point is near the best one if its error is at most so many times as large


class BestPoint(NamedTuple):
    """The best point of a scheme: of the largest yield, and of these of the least error.

    The error of a point is the 95 % quantile over its machines, at the last trial, in the unit of
    the dataset; infinite where more machines diverge.

    point: its values by the first name of each axis; `point_of` has those of all names
    yield_share: share of its machines within the tolerance; NaN without a tolerance
    near: share of the points whose error is at most `NEAR` times as large
    along: for each axis the first and the last value next to it, without a gap, that are near, the
        other axes as at the best point
    diverged: share of the points at which a machine diverges
    edges: for each axis the nearest value below, and above, at which a machine diverges, the other
        axes as at the best point; None where there is none
    sentences: which point is best, how flat it is there, where the edge to divergence runs, and at
        the end of which axes of the scheme it lies, by the names and values that an axis of several
        schemes has for this one
    """

    scheme: str
    point: dict[str, Value]
    yield_share: float
    error: float
    near: float
    along: Ends
    diverged: float
    edges: Ends
    sentences: tuple[str, ...]

    def __repr__(self) -> str:
        return in_short(self)

    @property
    def rank(self) -> tuple[float, float]:
        """Less for a better point."""
        return -float(np.nan_to_num(self.yield_share)), self.error

    @property
    def anywhere(self) -> bool:
        """Whether a yield or a finite error makes this point the best one."""
        return self.yield_share > 0 or bool(np.isfinite(self.error))


def best_points(
    dataset: xr.Dataset, tolerance: float | None = None, *, metric: str = "settled_error"
) -> list[BestPoint]:
    """The best point of each scheme of a sweep over a grid.

    tolerance, metric: as for `summarise`
    Raises ValueError for a dataset of a sweep that is not complete.
    """
    axes = axes_of(dataset)
    last = last_errors(dataset, metric).values
    error = np.quantile(last, QUANTILES[-1], axis=-1, method="inverted_cdf")
    unknown = np.full_like(error, np.nan)
    passed = unknown if tolerance is None else np.mean(last <= tolerance, axis=-1)
    lost = (dataset["diverged_at"] > 0).any("sample").transpose("scheme", *axes).values
    return [
        _best(str(name), dataset, passed[i], error[i], lost[i])
        for i, name in enumerate(dataset["scheme"].values)
    ]


def point_of(dataset: xr.Dataset, point: Mapping[str, Value]) -> dict[str, Value]:
    """The values of a point by all names of its axes, as `Scenario.with_values` takes them.

    point: a value of each axis by its first name, as a `BestPoint` has it
    Those of an array are tuples; of an axis with more than 16 numbers in all they are text with the
    digits of its labels.
    """
    here = dataset.coords.to_dataset().sel(point)
    found = {name: here[name].item() for name in labels_of(dataset)}
    grid = dataset.attrs.get("configuration", {}).get("grid", {"axes": []})
    known = {name: values for axis in grid["axes"] for name, values in axis["values"].items()}
    for name, label in found.items():
        if isinstance(label, str) and "." in name:
            of = known.get(name)
            of = of if isinstance(of, list) else []
            exact = dict(zip(labels_along(of).tolist(), of, strict=True)).get(label)
            if isinstance(exact, list):
                found[name] = tuple(exact)
            elif not of:
                found[name] = label.replace(" ", ",")
    return found


def at_best(dataset: xr.Dataset, best: list[BestPoint]) -> xr.Dataset:
    """The dataset of a sweep without a grid: each scheme at its best point.

    Where their numbers of trials differ, it has the most of them, and those of each scheme as the
    coordinate `trials`: a shorter one has no values after its last trial, by which it is judged.
    """
    import xarray as xr

    found = [dataset.sel(scheme=[of.scheme]).sel(of.point) for of in best]
    trials = [int(of.coords.get(TRIALS, dataset.sizes["trial"])) for of in found]
    found = [of.drop_vars(labels_of(dataset)) for of in found]
    whole = xr.concat(found, "scheme", data_vars="minimal", coords="minimal", compat="override")
    own = {TRIALS: ("scheme", trials)} if len({*trials}) > 1 else {}
    return whole.isel(trial=slice(max(trials))).assign_coords(own)


def last_errors(dataset: xr.Dataset, metric: str) -> xr.DataArray:
    """(scheme, axes, sample) the metric of the last trial, as `learned_errors` has it.

    Where `trials` is on an axis it is the last trial of each point.
    """
    if STEPS not in dataset.coords and TRIALS not in dataset.coords:
        dataset = dataset.isel(trial=[-1])
    errors = learned_errors(errors_of(dataset, metric))
    return errors.sel(trial=dataset.coords.get(TRIALS, errors["trial"][-1]))


def labels_of(dataset: xr.Dataset) -> list[str]:
    """The coordinates along the axes of the grid, axis by axis, the name of the axis first."""
    of = {str(name): x.dims[0] for name, x in dataset.coords.items() if x.ndim and name != STEPS}
    axes = axes_of(dataset)
    found = (name for name, axis in of.items() if axis in axes)
    return sorted(found, key=lambda name: (axes.index(of[name]), name != of[name], name))


def labels_for(dataset: xr.Dataset, axis: str, scheme: str) -> xr.DataArray:
    """The values along an axis by the name that belongs to a scheme, or else by its own name."""
    own = (
        of
        for name, of in dataset.coords.items()
        if of.dims == (axis,) and str(name).startswith(f"{scheme}.")
    )
    return dataset[axis] if axis.startswith(f"{scheme}.") else next(own, dataset[axis])


def _best(
    name: str, dataset: xr.Dataset, passed: np.ndarray, error: np.ndarray, lost: np.ndarray
) -> BestPoint:
    axes = axes_of(dataset)
    order = np.lexsort((error.ravel(), -passed.ravel()))
    best = np.unravel_index(order[0], error.shape)
    near = error <= NEAR * error[best]

    def told(labels: list[xr.DataArray]) -> BestPoint:
        """The best point by the names and values of these labels, without sentences."""
        point: dict[str, Value] = {}
        along: Ends = {}
        edges: Ends = {}
        for i, label in enumerate(labels):
            line, label_name = (*best[:i], slice(None), *best[i + 1 :]), str(label.name)
            order = np.arange(label.size)
            if label.values.dtype.kind in "fi":  # below and above are those of the values
                order = np.argsort(label.values, kind="stable")
            known, here = label.values[order].tolist(), int(np.flatnonzero(order == best[i])[0])
            below, above = _ends(~near[line][order], here)
            low, high = _ends(lost[line][order], here)
            point[label_name] = known[here]
            along[label_name] = known[below + 1], known[above - 1]
            edges[label_name] = (
                known[low] if low >= 0 else None,
                known[high] if high < len(known) else None,
            )
        shares = float(near.mean()), along, float(lost.mean())
        return BestPoint(name, point, float(passed[best]), float(error[best]), *shares, edges, ())

    found = told([dataset[axis] for axis in axes])
    if not found.anywhere:
        nowhere = f"{name}: more than 5 % of the machines diverge at every point."
        return found._replace(sentences=(nowhere,))
    labels = [labels_for(dataset, axis, name) for axis in axes]
    least = bool(np.isfinite(found.error)) and found.error <= float(error.min())
    at_end = []
    for i, label in enumerate(labels):
        line = (*best[:i], slice(None), *best[i + 1 :])
        if str(label.name).startswith(f"{name}."):
            at_end += _at_end(label, best[i], passed[line], error[line])
    return found._replace(sentences=(*_sentences(told(labels), least), *at_end))


def _at_end(label: xr.DataArray, at: int, passed: np.ndarray, error: np.ndarray) -> list[str]:
    """A sentence if the best point lies at an end of an axis, towards which it gets better.

    passed, error: along the axis
    """
    values = label.values
    if values.dtype.kind not in "fi" or len(values) < 2:
        return []
    order = np.argsort(values)
    for end, near, word in ((order[0], order[1], "least"), (order[-1], order[-2], "largest")):
        same = np.array_equal((passed[near], error[near]), (passed[at], error[at]), equal_nan=True)
        if at == end and not same:
            best = f"{label.name} = {value_text(values[at].item())}"
            return [f"{best} is the {word} value that was tried: beyond it may be a better one."]
    return []


def _sentences(best: BestPoint, least: bool) -> tuple[str, ...]:
    """The sentences on a best point; `least`: whether it has the least error of all points."""
    at = " and ".join(f"{axis} = {value_text(value)}" for axis, value in best.point.items())
    flat = f"The error is at most twice as large at {share_text(best.near)} of the points"
    wide = " and ".join(
        f"{axis} = {value_text(low)} to {value_text(high)}"
        for axis, (low, high) in best.along.items()
        if low != high
    )
    ends = [
        f"{axis} = {value_text(end)} {words}"
        for axis, of in best.edges.items()
        for end, words in zip(of, ("down", "up"), strict=True)
        if end is not None
    ]
    gone = f"A machine diverges at {share_text(best.diverged)} of the points"
    gone += f", seen from the best one from {' and from '.join(ends)}" if ends else ""
    wide = f", along the axes for {wide}." if wide else "."
    if not np.isfinite(best.error):
        flat, wide = "More than 5 % of the machines diverge there", "."
    return (
        f"{best.scheme} has its {'least error' if least else 'largest yield'} at {at}.",
        flat + wide,
        f"{gone}." if best.diverged else "No machine diverges at any point.",
    )


def _ends(marked: np.ndarray, at: int) -> tuple[int, int]:
    """The nearest marked positions below and above a position; -1 and the length if none is."""
    below, above = np.flatnonzero(marked[:at]), np.flatnonzero(marked[at + 1 :])
    return (
        int(below[-1]) if len(below) else -1,
        int(above[0]) + at + 1 if len(above) else len(marked),
    )
