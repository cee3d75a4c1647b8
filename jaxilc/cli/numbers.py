"""The results of runs, sweeps and certificates, as dictionaries of numbers with stable keys.

The option `--json` writes these dictionaries. Keys keep their names in all versions: the key
`samples` counts machines, and `figure` names a metric.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ..learning.divergence import GROWTH
from ..learning.known_metrics import ERRORS, OF_TRIALS
from ..scenarios.reproduction import met
from ..sweeps.summary import summarise
from ..theory.certificates import CLAIMS, CONVERGES, COURSES, MONOTONE, NOTHING
from ..theory.chance import STILL, SURELY

if TYPE_CHECKING:
    import xarray as xr

    from ..scenarios import Published, Scenario
    from ..sweeps.points import BestPoint
    from ..sweeps.summary import SchemeSummary
    from ..theory.bounds import Checked
    from ..theory.certificates import Certificate, OfScheme

GREW = 1e-9  # of an error, below which it is rounding that has grown
NUMBER = re.compile(r"(?<![\w.])\d+(?:\.\d+)?(?:e[+-]?\d+)?(?![\w])")


def shown_trials(scenario: Scenario) -> list[int]:
    """The trials that have a row in a table: those that the scenario names, and the last one.

    Where it names none, they are 1, 2, 5, 10, 20 and so on.
    """
    decades = range(len(str(scenario.trials)))
    named = scenario.show_trials or [n * 10**k for k in decades for n in (1, 2, 5)]
    return sorted({j for j in named if j <= scenario.trials} | {scenario.trials})


def run_numbers(scenario: Scenario, dataset: xr.Dataset) -> dict[str, Any]:
    """The metrics of a run [shown unit] by scheme, metric and trial, with the published ones.

    With several channels the largest counts. The errors of a trial that diverged are infinite (see
    `learning.divergence`).

    dataset: result of `run_schemes`
    """
    schemes: dict[str, Any] = {}
    for name in scenario.schemes:
        chosen = _largest(dataset, name)
        known = (*(m.name for m in OF_TRIALS), *scenario.quantities)
        shown = {m: scenario.shown(m)[0] * chosen[m] for m in known}
        shown |= {
            m: shown[m].where(~chosen["diverged"], np.inf) for m in shown if m != "best_trial"
        }
        by_metric = {
            m: {str(j): float(values.sel(trial=j)) for j in shown_trials(scenario)}
            for m, values in shown.items()
        }
        published = [_beside(p, scenario, shown) for p in scenario.due if p.scheme == name]
        axes = _by_axis(scenario, dataset.sel(scheme=name))
        course = {event: int(chosen[event]) for event in ("diverged_at", "grown_from")}
        schemes[name] = by_metric | course | _grown(chosen) | axes | {"published": published}
    return {
        "scenario": scenario.name,
        "trials": scenario.trials,
        "unit": scenario.shown_unit,
        "schemes": schemes,
    }


def errors_by_trial(scenario: Scenario, dataset: xr.Dataset) -> dict[str, list[float]]:
    """The metric by which a scenario is judged, of every trial by scheme [shown unit].

    Errors are those of `run_numbers`.
    """
    scale = scenario.shown(scenario.judged_by)[0]
    found = {}
    for name in scenario.schemes:
        chosen = _largest(dataset, name)
        errors = (scale * chosen[scenario.judged_by]).where(~chosen["diverged"], np.inf)
        found[name] = [float(error) for error in errors.fillna(np.inf)]
    return found


def _largest(dataset: xr.Dataset, scheme: str) -> xr.Dataset:
    """The results of one scheme, of several outputs or inputs the largest."""
    return dataset.sel(scheme=scheme).max(["channel", "input"], skipna=False)


def _by_axis(scenario: Scenario, chosen: xr.Dataset) -> dict[str, Any]:
    """The errors of each output by its name and trial [shown unit]; nothing for a single output.

    chosen: metrics of one scheme
    """
    if scenario.task.outputs == 1:
        return {}
    sound = ~chosen["diverged"]
    axes = {
        called: {
            metric.name: {
                str(j): scenario.shown(metric.name)[0]
                * float(chosen[metric.name].isel(channel=i).where(sound, np.inf).sel(trial=j))
                for j in shown_trials(scenario)
            }
            for metric in ERRORS
        }
        for i, called in enumerate(output_names(scenario))
    }
    return {"axes": axes}


def output_names(scenario: Scenario) -> list[str]:
    """What the outputs are called: their names, or `output 0`, `output 1`, ..."""
    labels = scenario.task.labels
    return [one if isinstance(one, str) else f"output {one}" for one in labels]


def axes_numbers(
    scenario: Scenario, dataset: xr.Dataset, tolerance: float | None
) -> dict[str, Any]:
    """The largest error of the last trial over the machines of a sweep, by scheme and axis.

    Besides the outputs there is the contour, where it is a metric. All are in the shown unit, with
    the share of machines within the tolerance. A sweep of a single output has none.

    tolerance: largest error that passes [unit of the dataset]; None if none is known
    """
    if scenario.task.outputs == 1:
        return {}
    errors = {
        called: dataset["max_error"].isel(channel=i)
        for i, called in enumerate(output_names(scenario))
    }
    errors |= {"contour": dataset["contour_max"]} if "contour_max" in scenario.quantities else {}
    found: dict[str, Any] = {}
    for called, values in errors.items():
        named = dataset[["finite", "diverged"]].assign(error=values)
        for row in summarise(named, tolerance, metric="error"):
            last = {"median": row.median, "low": row.low, "high": row.high, "worst": row.worst}
            at = {of: scenario.shown_scale * float(x[-1]) for of, x in last.items()}
            share = None if tolerance is None else row.yield_share
            found.setdefault(row.scheme, {})[called] = at | {
                "worst_sample": int(row.worst_machine[-1]),
                "yield": share,
            }
    return {"axes": found}


def _grown(chosen: xr.Dataset) -> dict[str, Any]:
    """The rms error of the last trial in units of that of the best trial, and its number.

    chosen: metrics of one scheme by trial
    """
    rms = chosen["rms"].values
    best = int(np.nanargmin(np.where(np.isfinite(rms), rms, np.inf)))
    return {"best": best + 1, "grown_to": float(rms[-1] / rms[best]) if rms[best] > 0 else 1.0}


def _beside(p: Published, scenario: Scenario, shown: dict[str, xr.DataArray]) -> dict[str, Any]:
    """A published number and ours, which is None for a trial that was not run.

    `met` is whether they are near, as `reproduce` judges it.
    """
    trial = p.trial or 1
    ours = float(shown[p.quantity].sel(trial=trial)) if trial <= scenario.trials else None
    near = None if ours is None else met(p, ours)
    return {
        "trial": p.trial,
        "quantity": p.quantity,
        "value": p.value,
        "unit": scenario.shown(p.quantity)[1],
        "source": p.source,
        "ours": ours,
        "met": near,
    }


def sweep_numbers(
    scenario: Scenario, summary: Sequence[SchemeSummary], tolerance: float | None, machines: int
) -> dict[str, Any]:
    """The summary of a sweep [shown unit] by scheme, with quantiles and the worst machine by trial.

    tolerance: largest metric that passes [unit of the dataset]; None, and null for the yields, if
        none is known
    machines: number S of machines
    """
    k, unit = scenario.shown(scenario.judged_by)
    schemes = {
        row.scheme: {
            "yield": None if tolerance is None else row.yield_share,
            "yield_interval": None if tolerance is None else [row.yield_low, row.yield_high],
            "semi_converged": row.semi_converged,
            "grown_from": row.grown_from,
            "grown_to": row.grown_to,
            "diverged": row.diverged,
            "diverged_at": row.diverged_at,
            "by_trial": {
                str(j): {
                    "median": k * float(row.median[j - 1]),
                    "low": k * float(row.low[j - 1]),
                    "high": k * float(row.high[j - 1]),
                    "worst": k * float(row.worst[j - 1]),
                    "worst_sample": int(row.worst_machine[j - 1]),
                }
                for j in shown_trials(scenario)
            },
        }
        for row in summary
    }
    return {
        "scenario": scenario.name,
        "trials": scenario.trials,
        "samples": machines,
        "tolerance": None if tolerance is None else k * tolerance,
        "unit": unit,
        "figure": scenario.judged_by.replace("_", " "),
        "schemes": schemes,
    }


def grid_numbers(
    scenario: Scenario, best: Sequence[BestPoint], axes: Mapping[str, int]
) -> dict[str, Any]:
    """The best point of each scheme of a grid, with its error [shown unit].

    axes: the number of values of each axis
    """
    k, _ = scenario.shown(scenario.judged_by)
    found = {}
    for of in best:
        row = of._asdict() | {"error": k * of.error}
        row["yield"] = None if np.isnan(of.yield_share) else of.yield_share
        found[row.pop("scheme")] = {n: x for n, x in row.items() if n != "yield_share"}
    return {"grid": {"axes": dict(axes), "best": found}}


def certificate_numbers(of_scheme: OfScheme) -> dict[str, Any]:
    """The content of a certificate, as counts of machines.

    The keys of the dictionary are:

    claims, reasons: claims for an unlimited number of trials, with their reasons
    floor: largest error left in the long run on the machines with a claim; where something is drawn
        for each trial, its root mean square over all that is drawn; NaN where it is not known
    rounding: largest part of it that is due to rounding or hysteresis; None without it
    held_by: which of them; likewise
    senses: number of machines with a claim, by the sense in which it holds for single runs; empty
        where nothing is drawn
    most: largest error that a late trial of one of these machines exceeds with a chance of 5 % or
        less, by theory; None where nothing is drawn, or where it is not known
    first, quantile: largest root mean square error of the first trial, where something is drawn or
        rounded, and that of the last one below which 95 % of the simulated runs end, where
        something is drawn; else None
    expected, observed, confusion: course of the error in J trials, by theory and by simulation
    transient: how far the error grows before it falls, where learning is claimed to converge, in
        units of the first error, in which trial, and on how many machines; and about how far noise
        grows where no power of the learning map is known to contract
    premises, bound, care: see `bounds_numbers`, for a scheme that has bounds
    """
    found = of_scheme.certificate
    claimed = np.isin(found.claim, (MONOTONE, CONVERGES))
    drawn = ~np.isin(found.sense, (SURELY, STILL))
    ball = np.zeros(len(claimed)) if found.ball is None else found.ball.error
    floor = np.where(drawn, found.left, found.floor + found.doubt + ball)
    known = np.isfinite(found.most[claimed])
    rounds = found.ball is not None and bool(np.any(claimed))
    last = None if found.runs is None else np.quantile(found.runs[:, :, -1], 0.95, axis=1)
    numbers = {
        "claims": {claim: int(np.sum(found.claim == claim)) for claim in CLAIMS},
        "monotone_in_the_error": int(np.sum(found.of_error)),
        "reasons": {
            claim: told(found.reason[found.claim == claim])
            for claim in CLAIMS
            if np.any(found.claim == claim)
        },
        "floor": float(np.max(floor[claimed])) if np.any(claimed) else None,
        "rounding": float(np.max(ball[claimed])) if rounds else None,
        "held_by": found.ball.of[0] if rounds else None,
        "senses": told(found.sense[(found.sense != SURELY) & (found.claim != NOTHING)]),
        "most": float(np.max(found.most[claimed])) if np.all(known) and np.any(claimed) else None,
        "first": None if last is None and not rounds else float(np.max(found.simulated[:, 0])),
        "quantile": None if last is None else float(np.max(last)),
        "expected": {course: int(np.sum(found.expected == course)) for course in COURSES},
        "observed": {course: int(np.sum(found.observed == course)) for course in COURSES},
        "confusion": found.confusion(),
        "growth": {"median": float(np.median(found.growth)), "max": float(np.max(found.growth))},
        "transient": _transient(found, claimed),
        "turning": {
            "predicted": float(np.median(found.turning)),
            "observed": float(np.median(found.observed_turning)),
        },
        "contradicted": found.broken_promises().tolist(),
        "seconds_a_machine": of_scheme.seconds / len(found.claim),
    }
    if of_scheme.checked is not None:
        numbers |= bounds_numbers(of_scheme.checked)
    return numbers


def bounds_numbers(found: Checked) -> dict[str, Any]:
    """The numbers of the bounds of Cao 2019 over machines.

    premises: on how many machines each held, and where it was broken
    bound: on how many it is claimed and holds, is claimed and fails, and is not claimed
    care: how many times the bound is above what was observed; None without a claim
    """
    of_premises = {p.name: {"held": p.held, "share_broken": p.share_broken} for p in found.premises}
    return {"premises": of_premises, "bound": found.verdicts, "care": found.care}


def watched_numbers(scenario: Scenario, dataset: xr.Dataset) -> dict[str, dict[str, Any]]:
    """What a `BoundsWatch` found of each scheme that learns, over machines and trials, by scheme.

    Over a grid each machine counts at each point, and the last trial of a point with fewer trials
    than another counts again.

    d2, left_out: smallest, median and largest over the machines; null where nothing is proved
    norm, pointwise: median over the machines of the median and of the largest ratio over the trials
    growing: share of the trials, of all machines, after which the 2-norm of the error was larger,
        of those before which it was above rounding
    The other numbers are those of `bounds_numbers`.
    """
    from ..theory.bounds import OF_MACHINES, OF_TRIALS, checked

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


def _transient(found: Certificate, claimed: np.ndarray) -> dict[str, Any]:
    grows, of_any = claimed & (found.peak > 1 + GROWTH), np.zeros(len(claimed))
    if found.outlook is not None:
        decay = found.outlook.decay
        of_any = np.where(claimed & (decay.trials == 0) & ~found.of_error, decay.growth, 0.0)
    worst = int(np.argmax(np.where(grows, found.peak, 0.0)))
    return {
        "growth": float(found.peak[worst]) if np.any(grows) else None,
        "trial": int(found.peak_trial[worst]) if np.any(grows) else None,
        "of_noise": float(np.max(of_any)) if np.any(of_any) else None,
        "machines": int(np.sum(grows | (of_any > 0))),
    }


def told(reasons) -> dict[str, int]:
    """The number of times that each reason is given.

    Reasons that differ only in their numbers are counted together, with the range of each number.
    """
    groups: dict[str, list[list[float]]] = {}
    for reason in reasons:
        groups.setdefault(NUMBER.sub("{}", reason), []).append(
            [float(x) for x in NUMBER.findall(reason)]
        )
    return {
        text.format(*map(_range, zip(*rows, strict=True))): len(rows)
        for text, rows in groups.items()
    }


def _range(values) -> str:
    low, high = (f"{end(values):.6g}" for end in (min, max))
    return low if low == high else f"{low} to {high}"
