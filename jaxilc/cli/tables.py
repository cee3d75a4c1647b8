"""What the command line prints, as plain numbers under stable keys and as tables."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ..learning.divergence import CEILING, GROWTH
from ..scenarios.reproduction import SHAPE
from ..theory.certificates import (
    CLAIMS,
    CONVERGES,
    COURSES,
    DIVERGES,
    GROWS,
    MONOTONE,
    NOTHING,
    TURNS,
)
from .titled_table import Table

if TYPE_CHECKING:
    import xarray as xr

    from ..scenarios import Scenario
    from ..sweeps.summary import SchemeSummary
    from ..theory import Certificate, PremiseShare

FIGURES = ("settled_error", "max_error", "rms", "best_trial")
NUMBER = re.compile(r"(?<![\w.])\d+(?:\.\d+)?(?:e[+-]?\d+)?(?![\w])")
COURSE_WORDS = {TURNS: "have a best trial and then turn", GROWS: "end above their start"}


def shown_trials(scenario: Scenario) -> list[int]:
    """The trials worth a row: those of the scenario and the last."""
    return sorted({j for j in scenario.show_trials if j <= scenario.trials} | {scenario.trials})


def run_figures(scenario: Scenario, dataset: xr.Dataset) -> dict[str, Any]:
    """A run's figures [shown unit] by scheme, figure and trial, beside the published ones; the
    largest channel counts.

    The errors of a trial that diverged are infinite (see `divergence`).
    """
    schemes: dict[str, Any] = {}
    for name in scenario.schemes:
        chosen = dataset.sel(scheme=name).max("channel", skipna=False)
        shown = {f: scenario.shown(f)[0] * chosen[f] for f in (*FIGURES, *scenario.quantities)}
        shown |= {
            f: shown[f].where(~chosen["diverged"], np.inf) for f in shown if f != "best_trial"
        }
        figures = {
            f: {str(j): float(values.sel(trial=j)) for j in shown_trials(scenario)}
            for f, values in shown.items()
        }
        published = []
        for p in scenario.due:
            if p.scheme == name:
                trial = p.trial or 1
                ours = (
                    float(shown[p.quantity].sel(trial=trial)) if trial <= scenario.trials else None
                )
                row = {
                    "trial": p.trial,
                    "quantity": p.quantity,
                    "value": p.value,
                    "unit": scenario.shown(p.quantity)[1],
                }
                published.append(row | {"source": p.source, "ours": ours})
        course = {name: int(chosen[name]) for name in ("diverged_at", "grown_from")}
        schemes[name] = figures | course | {"published": published}
    return {
        "scenario": scenario.name,
        "trials": scenario.trials,
        "unit": scenario.shown_unit,
        "schemes": schemes,
    }


def run_table(scenario: Scenario, figures: dict[str, Any]) -> Table:
    """The figure the scenario is judged by, by trial and scheme, the published value in brackets."""
    figure, (_, unit) = scenario.judged_by, scenario.shown(scenario.judged_by)
    table = Table(
        title=f"{scenario.title}\n{figure.replace('_', ' ')} [{unit}] by trial, published value in brackets"
    )
    table.add_column("trial", justify="right")
    for name in scenario.schemes:
        table.add_column(name, justify="right")
    for j in shown_trials(scenario):
        cells = []
        for rows in figures["schemes"].values():
            printed = [
                p["value"] for p in rows["published"] if p["quantity"] == figure and p["trial"] == j
            ]
            cells.append(
                number(rows[figure][str(j)]) + "".join(f" ({value:g})" for value in printed)
            )
        table.add_row(str(j), *cells)
    return table


def other_rows(scenario: Scenario, figures: dict[str, Any]) -> list[str]:
    """The published figures that have no cell in `run_table`, a line each."""
    in_table = {(scenario.judged_by, j) for j in shown_trials(scenario)}
    lines = []
    for name, rows in figures["schemes"].items():
        for p in rows["published"]:
            if p["ours"] is not None and (p["quantity"], p["trial"]) not in in_table:
                what = p["quantity"].replace("_", " ") + (
                    f" at trial {p['trial']}" if p["trial"] else ""
                )
                lines.append(
                    f"{name}: {what} {number(p['ours'])} {p['unit']} (published {p['value']:g})"
                )
    return lines


def course_lines(figures: dict[str, Any]) -> list[str]:
    """Where learning went wrong in a run: a line for each scheme that diverged or has grown."""
    lines = []
    for name, rows in figures["schemes"].items():
        if rows["diverged_at"]:
            lines.append(
                f"{name}: diverged at trial {rows['diverged_at']}: not finite, or an error of {CEILING:g} times the reference"
            )
        elif rows["grown_from"]:
            lines.append(
                f"{name}: from trial {rows['grown_from']} on the rms error is more than {1 + GROWTH:g} times its least"
            )
    return lines


def sweep_figures(
    scenario: Scenario, summary: Sequence[SchemeSummary], tolerance: float, samples: int
) -> dict[str, Any]:
    """A sweep's summary [shown unit] by scheme; quantiles and the worst sample by trial."""
    k, unit = scenario.shown(scenario.judged_by)
    schemes = {
        row.scheme: {
            "yield": row.yield_share,
            "yield_interval": [row.yield_low, row.yield_high],
            "semi_converged": row.semi_converged,
            "grown_from": row.grown_from,
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
        "samples": samples,
        "tolerance": k * tolerance,
        "unit": unit,
        "figure": scenario.judged_by.replace("_", " "),
        "schemes": schemes,
    }


def yield_table(figures: dict[str, Any]) -> Table:
    """One row a scheme: yield with its interval, and which shares have grown again or diverged,
    from which trial on.
    """
    last, unit = figures["trials"], figures["unit"]
    table = Table(
        title=f"{figures['samples']} machines, {figures['figure']} of trial {last} within {figures['tolerance']:g} {unit}"
    )
    for column in ("scheme", "yield (95 % interval)", "grown (from)", "diverged (from)"):
        table.add_column(column, justify="left" if column == "scheme" else "right")
    for name, row in figures["schemes"].items():
        low, high = row["yield_interval"]
        table.add_row(
            name,
            f"{row['yield']:.1%} ({low:.1%} – {high:.1%})",
            _share(row["semi_converged"], row["grown_from"]),
            _share(row["diverged"], row["diverged_at"]),
        )
    return table


def spread_table(figures: dict[str, Any]) -> Table:
    """One row a scheme: quantiles of the last trial over the machines, and the worst one."""
    last = str(figures["trials"])
    table = Table(title=f"{figures['figure']} [{figures['unit']}] of trial {last}")
    for column in ("scheme", "median", "5 %", "95 %", "worst", "its sample"):
        table.add_column(column, justify="left" if column == "scheme" else "right")
    for name, row in figures["schemes"].items():
        at = row["by_trial"][last]
        table.add_row(
            name,
            *(number(at[of]) for of in ("median", "low", "high", "worst")),
            str(at["worst_sample"]),
        )
    return table


def _share(share: float, trial: int) -> str:
    """`5.2% (43)`: of the machines, and from which trial on the first of them."""
    return f"{share:.1%}" + (f" ({trial})" if trial else "")


def band_table(figures: dict[str, Any]) -> Table:
    """Median and 95 % quantile by trial and scheme."""
    table = Table(title=f"{figures['figure']} [{figures['unit']}] by trial: median (95 % quantile)")
    table.add_column("trial", justify="right")
    for name in figures["schemes"]:
        table.add_column(name, justify="right")
    for j in next(iter(figures["schemes"].values()))["by_trial"]:
        rows = [row["by_trial"][j] for row in figures["schemes"].values()]
        table.add_row(j, *(f"{number(r['median'])} ({number(r['high'])})" for r in rows))
    return table


def certificate_figures(
    found: Certificate, shares: tuple[list[PremiseShare], dict[str, int]] | None, seconds: float
) -> dict[str, Any]:
    """Claims for the long run with their reasons, the course of J trials beside simulation, and the
    premises of the bounds, if any.
    """
    claimed = np.isin(found.claim, (MONOTONE, CONVERGES))
    figures = {
        "claims": {claim: int(np.sum(found.claim == claim)) for claim in CLAIMS},
        "monotone_in_the_error": int(np.sum(found.of_error)),
        "reasons": {
            claim: told(found.reason[found.claim == claim])
            for claim in CLAIMS
            if np.any(found.claim == claim)
        },
        "floor": float(np.max((found.floor + found.doubt)[claimed])) if np.any(claimed) else None,
        "expected": {course: int(np.sum(found.expected == course)) for course in COURSES},
        "observed": {course: int(np.sum(found.observed == course)) for course in COURSES},
        "confusion": found.confusion(),
        "growth": {"median": float(np.median(found.growth)), "max": float(np.max(found.growth))},
        "turning": {
            "predicted": float(np.median(found.turning)),
            "observed": float(np.median(found.observed_turning)),
        },
        "contradicted": found.broken_promises().tolist(),
        "seconds_a_machine": seconds / len(found.claim),
    }
    if shares is not None:
        figures["premises"] = {
            p.name: {"held": p.held, "share_broken": p.share_broken} for p in shares[0]
        }
        figures["bound"] = shares[1]
    return figures


def told(reasons) -> dict[str, int]:
    """How often each reason is given; those that differ in their numbers alone as one, with the
    range of each number.
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


def certificate_sentence(
    name: str, trials: int, figures: dict[str, Any], scale: float, unit: str
) -> str:
    """What a certificate says, in words."""
    claims, machines = figures["claims"], sum(figures["claims"].values())
    certified = claims[MONOTONE] + claims[CONVERGES]
    parts = []
    if certified:
        in_error, floor = figures["monotone_in_the_error"], scale * figures["floor"]
        monotone = (
            f"{claims[MONOTONE]} in every trial ({in_error} in the error itself)"
            if claims[MONOTONE]
            else ""
        )
        converging = f"{claims[CONVERGES]} in the end" if claims[CONVERGES] else ""
        which = " and ".join(filter(None, (monotone, converging)))
        left = f"it leaves an error of {number(floor)} {unit}".rstrip() + " at most"
        parts.append(
            f"in the long run {certified} of {machines} machines come nearer to their limit, {which}; {left}"
        )
    if claims[DIVERGES]:
        parts.append(f"{claims[DIVERGES]} diverge")
    if claims[NOTHING]:
        parts.append(
            f"of {claims[NOTHING]} nothing is claimed"
            if certified or claims[DIVERGES]
            else "of the long run nothing is claimed"
        )
    expected, observed, turning = figures["expected"], figures["observed"], figures["turning"]
    bad = {c: (expected[c], observed[c]) for c in (TURNS, GROWS) if expected[c] or observed[c]}
    courses = ", ".join(
        f"{e} machines {COURSE_WORDS[c]} by theory and {o} by simulation"
        for c, (e, o) in bad.items()
    )
    seen = (
        courses
        or "the error of every machine ends lower than it began, by theory and by simulation"
    )
    best = (
        f"; the best trial is {turning['predicted']:g} by theory and {turning['observed']:g} by simulation (median)"
        if bad
        else ""
    )
    return f"{name}: {', '.join(parts)}. Within {trials} trials {seen}{best}."


def certificate_tables(name: str, trials: int, figures: dict[str, Any]) -> list[Table]:
    """The claims with their reasons, the expected against the observed course, and the premises of
    the bounds.
    """
    claims = Table(
        "in the long run",
        "machines",
        "why",
        title=f"{name}: what is claimed, however many trials are run",
    )
    for claim, reasons in figures["reasons"].items():
        for i, (reason, count) in enumerate(reasons.items()):
            claims.add_row("" if i else claim, str(count), reason)
    courses = Table(
        "by theory",
        title=f"{name}: machines by what their error does within {trials} trials, by theory and simulated",
    )
    for course in COURSES:
        courses.add_column(course, justify="right")
    for course, row in figures["confusion"].items():
        courses.add_row(
            f"{course} ({figures['expected'][course]})", *(str(row[c]) for c in COURSES)
        )
    tables = [claims, courses]
    if "premises" in figures:
        bound, machines = figures["bound"], sum(figures["bound"].values())
        tested = "; ".join(
            f"it {verdict} on {count}"
            for verdict, count in bound.items()
            if count and verdict != "not claimed"
        )
        title = (
            tested or f"it was claimed on none of {machines} machines, so nothing of it was tested"
        )
        premises = Table("premise", title=f"{name}: the bound of Cao 2019: {title}")
        premises.add_column("held throughout on", justify="right")
        premises.add_column("broken at, of samples and trials", justify="right")
        for premise, row in figures["premises"].items():
            held = f"{row['held']} of {machines}" if row["held"] else "no machine"
            premises.add_row(premise, held, _of_all(row["share_broken"]))
        tables.append(premises)
    return tables


def reproduction_table(figures: Sequence[dict[str, Any]]) -> Table:
    """One row a published number. reading: how the paper was read, what was fitted, and why a row
    is open
    """
    met = {v: sum(f["verdict"] == v for f in figures) for v in ("met", "shape", "open")}
    in_shape = f"{met['shape']} in shape (the printed order, within a factor of {SHAPE:g})"
    table = Table(
        title=f"{len(figures)} published numbers: {met['met']} met within 30 %, {in_shape}, {met['open']} open"
    )
    for column in (
        "scenario",
        "scheme",
        "trial",
        "quantity",
        "published",
        "ours",
        "ratio",
        "verdict",
        "source",
        "reading",
    ):
        table.add_column(
            column, justify="right" if column in ("trial", "published", "ours", "ratio") else "left"
        )
    for f in figures:
        trial = "" if f["trial"] is None else str(f["trial"])
        ours = (
            f"{'< ' * f['at_most']}{f['value']:g} {f['unit']}",
            number(f["ours"]),
            f"{f['ratio']:.2f}",
        )
        reading = [
            *(f"{k} {v}" for k, v in f["options"].items() if k != "plant"),
            f["reading"],
            f["fitted"],
        ]
        reading = "; ".join([*reading, f"open: {f['reason']}"] if f["reason"] else reading)
        table.add_row(
            f["scenario"],
            f["scheme"],
            trial,
            f["quantity"].replace("_", " "),
            *ours,
            f["verdict"],
            f["source"],
            reading,
        )
    return table


def identification_table(title: str, rows: Sequence[tuple[str, float, float, float]]) -> Table:
    """Identified quantities with their 95 % intervals."""
    table = Table(title=f"{title}: identified, with 95 % intervals")
    for column in ("quantity", "value", "low", "high"):
        table.add_column(column, justify="left" if column == "quantity" else "right")
    for name, *values in rows:
        table.add_row(name, *(f"{v:.6g}" if np.isfinite(v) else "–" for v in values))
    return table


def number(value: float) -> str:
    """Three significant digits, as one reads them; ∞ for an error that diverged."""
    if not np.isfinite(value):
        return "∞" if value == np.inf else "–"
    if value == 0 or 1e-3 <= abs(value) < 1e5:
        return np.format_float_positional(value, precision=3, fractional=False, trim="-")
    return f"{value:.2e}"


def _range(values) -> str:
    low, high = (f"{end(values):.6g}" for end in (min, max))
    return low if low == high else f"{low} to {high}"


def _of_all(share: float) -> str:
    """A share in percent; one that is not zero never reads as zero."""
    return "nowhere" if share == 0 else "< 0.01 %" if share < 1e-4 else f"{100 * share:.2f} %"
