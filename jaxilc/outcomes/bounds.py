"""The bounds of Cao 2019 over machines, as numbers and tables of a sweep and of certificates."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from ..theory.bounds import OF_MACHINES, OF_TRIALS, checked
from .outcome import Numbers, Table

if TYPE_CHECKING:
    import xarray as xr

    from ..scenarios import Scenario
    from ..theory.bounds import Checked

GREW = 1e-9  # of an error, below which it is rounding that has grown


def bounds_numbers(found: Checked) -> Numbers:
    """The numbers of the bounds of Cao 2019 over machines.

    premises: on how many machines each held, and where it was broken
    bound: on how many it is claimed and holds, is claimed and fails, and is not claimed
    care: how many times the bound is above what was observed; None without a claim
    """
    of_premises = {p.name: {"held": p.held, "share_broken": p.share_broken} for p in found.premises}
    return {"premises": of_premises, "bound": found.verdicts, "care": found.care}


def watched_numbers(scenario: Scenario, dataset: xr.Dataset) -> dict[str, Numbers]:
    """What a `BoundsWatch` found of each scheme that learns, over machines and trials, by scheme.

    Over a grid each machine counts at each point, and the last trial of a point with fewer trials
    than another counts again. Besides those of `bounds_numbers` there are:

    d2, left_out: smallest, median and largest over the machines; null where nothing is proved
    norm, pointwise: median over the machines of the median and of the largest ratio over the trials
    growing: share of the trials, of all machines, after which the 2-norm of the error was larger,
        of those before which it was above rounding
    """
    trial, found = dataset["trial"], {}
    if "trials" in dataset.coords:
        dataset = dataset.sel(trial=np.minimum(trial, dataset["trials"]))
    for name in (name for name, scheme in scenario.schemes.items() if scheme.learns):
        of = dataset.sel(scheme=name).transpose(..., "trial")
        sizes = dict.fromkeys(OF_TRIALS, (-1, trial.size)) | dict.fromkeys(OF_MACHINES, (-1,))
        one = {key: of[key].values.reshape(size) for key, size in sizes.items() if key in of}
        norm, worst, median = (
            one[f"contraction_{of}"][:, 1:] for of in ("norm", "worst", "median")
        )
        found[name] = bounds_numbers(checked(one)) | {
            "d2": _spread(one["d2"]),
            "left_out": _spread(one["left_out"]),
            "norm": _typical(norm, norm),
            "pointwise": _typical(median, worst),
            "growing": float(np.mean(norm[~np.isnan(norm)] > 1.0 + GREW)),
        }
    return found


def _typical(of_most, of_worst) -> list[float] | None:
    """The median over machines of the median, and of the largest, over the trials (S, J)."""
    if np.any(np.all(np.isnan(of_most), axis=1)):
        return None
    typical, worst = np.nanmedian(of_most, axis=1), np.nanmax(of_worst, axis=1)
    return [float(np.median(typical)), float(np.median(worst))]


def _spread(values) -> list[float] | None:
    values = np.asarray(values, float)
    if not np.all(np.isfinite(values)):
        return None
    return [float(of(values)) for of in (np.min, np.median, np.max)]


def premises_table(name: str, numbers: Numbers) -> Table:
    """The number of machines on which each premise of the bounds held, and where it failed."""
    machines = sum(numbers["bound"].values())
    tested = "; ".join(
        f"it {verdict} on {count}"
        for verdict, count in numbers["bound"].items()
        if count and verdict != "not claimed"
    )
    if numbers["care"]:
        tested += f"; d2 is {numbers['care']:.4g} times the largest ratio, in the median"
    nothing = f"it was claimed on none of {machines} machines, so nothing of it was tested"
    title = f"{name}: the bound of Cao 2019: {tested or nothing}"
    table = Table("premise", right=("held on", "broken at, of all samples"), title=title)
    for premise, row in numbers["premises"].items():
        held = f"{row['held']} of {machines}" if row["held"] else "no machine"
        table.add_row(premise, held, _of_all(row["share_broken"]))
    return table


def contraction_table(numbers: dict[str, Numbers]) -> Table:
    """How much smaller each trial made the error, beside d2 of the plant, by scheme."""
    title = "contraction of a trial: d2 of the plant, and |e_j| / |e_j-1| as observed"
    observed = ("norm, median", "norm, worst", "samples, median", "samples, worst")
    columns = ("d2", "left out by its theory", *observed, "trials that grew")
    table = Table("scheme", right=columns, title=title)
    for name, row in numbers.items():
        d2 = "not proved" if row["d2"] is None else f"{row['d2'][0]:.5g} to {row['d2'][2]:.5g}"
        left = "" if row["left_out"] is None else f"{100 * row['left_out'][1]:.5g} %"
        pairs = [row[of] or ("", "") for of in ("norm", "pointwise")]
        ratios = [value and f"{value:.4g}" for pair in pairs for value in pair]
        table.add_row(name, d2, left, *ratios, _of_all(row["growing"]))
    return table


def _of_all(share: float) -> str:
    """A share in percent as text; one above zero is never shown as zero, one of none not at all."""
    if math.isnan(share):
        return ""
    return "nowhere" if share == 0 else "< 0.01 %" if share < 1e-4 else f"{100 * share:.2f} %"


def bounds_tables(numbers: Numbers) -> list[Table]:
    """The tables of `watched_numbers`, none without any; the premises are those of all points."""
    at_best = numbers.get("bounds", {})
    of_all = numbers.get("grid", {}).get("bounds", at_best)
    where = " at all points" if "grid" in numbers else ""
    proved = [name for name, row in of_all.items() if row["d2"] is not None]
    tables = [premises_table(f"{name}{where}", of_all[name]) for name in proved]
    return [contraction_table(at_best), *tables] if at_best else []
