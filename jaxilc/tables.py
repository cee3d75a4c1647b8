"""What the command line prints, as plain numbers under stable keys and as tables."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from .divergence import CEILING, GROWTH
from .theory import VERDICTS
from .theory.condition import is_linear
from .titled_table import Table

if TYPE_CHECKING:
    import xarray as xr

    from .scenarios import Scenario
    from .summary import SchemeSummary
    from .theory import Certificate, PremiseShare

FIGURES = ("settled_error", "max_error", "rms", "best_trial")


def shown_trials(scenario: Scenario) -> list[int]:
    """The trials worth a row: those of the scenario and the last."""
    return sorted({j for j in scenario.show_trials if j <= scenario.trials} | {scenario.trials})


def run_figures(scenario: Scenario, dataset: xr.Dataset) -> dict[str, Any]:
    """A run's figures [shown unit] by scheme, figure and trial, beside the published ones; the largest channel counts.

    The errors of a trial that diverged are infinite (see `divergence`).
    """
    schemes: dict[str, Any] = {}
    for name in scenario.schemes:
        chosen = dataset.sel(scheme=name).max("channel", skipna=False)
        shown = {f: scenario.shown(f)[0] * chosen[f] for f in (*FIGURES, *scenario.quantities)}
        shown |= {f: shown[f].where(~chosen["diverged"], np.inf) for f in shown if f != "best_trial"}
        figures = {f: {str(j): float(values.sel(trial=j)) for j in shown_trials(scenario)} for f, values in shown.items()}
        published = []
        for p in scenario.due:
            if p.scheme == name:
                trial = p.trial or 1
                ours = float(shown[p.quantity].sel(trial=trial)) if trial <= scenario.trials else None
                row = {"trial": p.trial, "quantity": p.quantity, "value": p.value, "unit": scenario.shown(p.quantity)[1]}
                published.append(row | {"source": p.source, "ours": ours})
        course = {name: int(chosen[name]) for name in ("diverged_at", "grown_from")}
        schemes[name] = figures | course | {"published": published}
    return {"scenario": scenario.name, "trials": scenario.trials, "unit": scenario.shown_unit, "schemes": schemes}


def run_table(scenario: Scenario, figures: dict[str, Any]) -> Table:
    """The figure the scenario is judged by, by trial and scheme, the published value in brackets."""
    figure, (_, unit) = scenario.judged_by, scenario.shown(scenario.judged_by)
    table = Table(title=f"{scenario.title}\n{figure.replace('_', ' ')} [{unit}] by trial, published value in brackets")
    table.add_column("trial", justify="right")
    for name in scenario.schemes:
        table.add_column(name, justify="right")
    for j in shown_trials(scenario):
        cells = []
        for rows in figures["schemes"].values():
            printed = [p["value"] for p in rows["published"] if p["quantity"] == figure and p["trial"] == j]
            cells.append(number(rows[figure][str(j)]) + "".join(f" ({value:g})" for value in printed))
        table.add_row(str(j), *cells)
    return table


def other_rows(scenario: Scenario, figures: dict[str, Any]) -> list[str]:
    """The published figures that have no cell in `run_table`, a line each."""
    in_table = {(scenario.judged_by, j) for j in shown_trials(scenario)}
    lines = []
    for name, rows in figures["schemes"].items():
        for p in rows["published"]:
            if p["ours"] is not None and (p["quantity"], p["trial"]) not in in_table:
                what = p["quantity"].replace("_", " ") + (f" at trial {p['trial']}" if p["trial"] else "")
                lines.append(f"{name}: {what} {number(p['ours'])} {p['unit']} (published {p['value']:g})")
    return lines


def course_lines(figures: dict[str, Any]) -> list[str]:
    """Where learning went wrong in a run: a line for each scheme that diverged or has grown."""
    lines = []
    for name, rows in figures["schemes"].items():
        if rows["diverged_at"]:
            lines.append(f"{name}: diverged at trial {rows['diverged_at']}: not finite, or an error of {CEILING:g} times the reference")
        elif rows["grown_from"]:
            lines.append(f"{name}: from trial {rows['grown_from']} on the rms error is more than {1 + GROWTH:g} times its least")
    return lines


def sweep_figures(scenario: Scenario, summary: Sequence[SchemeSummary], tolerance: float, samples: int) -> dict[str, Any]:
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
                    "worst_sample": int(row.worst_sample[j - 1]),
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
    """One row a scheme: yield with its interval, and which shares have grown again or diverged, from which trial on."""
    last, unit = figures["trials"], figures["unit"]
    table = Table(title=f"{figures['samples']} machines, {figures['figure']} of trial {last} within {figures['tolerance']:g} {unit}")
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
        table.add_row(name, *(number(at[of]) for of in ("median", "low", "high", "worst")), str(at["worst_sample"]))
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


def certificate_figures(found: Certificate, shares: tuple[list[PremiseShare], dict[str, int]] | None, seconds: float) -> dict[str, Any]:
    """Verdicts, how they compare with simulation, and the premises of the bounds where there are any."""
    figures = {
        "verdicts": {v: int(np.sum(found.verdict == v)) for v in VERDICTS},
        "confusion": found.confusion(),
        "linear": found.linear,
        "linear_errors": bool(np.all(is_linear(found.departure))),
        "sigma": {"min": float(np.min(found.sigma)), "median": float(np.median(found.sigma)), "max": float(np.max(found.sigma))},
        "growth": {"median": float(np.median(found.growth)), "max": float(np.max(found.growth))},
        "turning": {"predicted": float(np.median(found.turning)), "observed": float(np.median(found.observed_turning))},
        "certified_yet_grew": found.broken_promises().tolist(),
        "seconds_a_sample": seconds / len(found.sigma),
    }
    if shares is not None:
        figures["premises"] = {p.name: {"held": p.held, "share_broken": p.share_broken} for p in shares[0]}
        figures["bound"] = shares[1]
    return figures


def certificate_tables(name: str, trials: int, figures: dict[str, Any]) -> list[Table]:
    """Predicted against observed verdicts, and the premises."""
    sigma, growth, turning = figures["sigma"], figures["growth"], figures["turning"]
    why = "estimates frozen at their start" if figures["linear_errors"] else "errors to come not linear in an error"
    what = "linear law" if figures["linear"] else f"{why}: a prediction, not a guarantee"
    confusion = Table(
        title=f"{name}, {trials} trials ({what})\nlargest singular value {sigma['min']:.4f} – {sigma['max']:.4f}, predicted growth up to "
        f"{number(growth['max'])}, best trial (median) predicted {turning['predicted']:g}, observed {turning['observed']:g}"
    )
    confusion.add_column("theory says, of machines")
    for verdict in VERDICTS:
        confusion.add_column(f"simulated: {verdict}", justify="right")
    for verdict, row in figures["confusion"].items():
        confusion.add_row(f"{verdict} ({figures['verdicts'][verdict]})", *(str(row[v]) for v in VERDICTS))
    tables = [confusion]
    if "premises" in figures:
        bound = ", ".join(f"{verdict} {count}" for verdict, count in figures["bound"].items())
        premises = Table("premise", title=f"{name}: premises of the bound of Cao 2019, machines; the bound: {bound}")
        premises.add_column("held on", justify="right")
        premises.add_column("broken share of (k, j)", justify="right")
        for premise, row in figures["premises"].items():
            premises.add_row(premise, str(row["held"]), f"{row['share_broken']:.2%}")
        tables.append(premises)
    return tables


def reproduction_table(figures: Sequence[dict[str, Any]]) -> Table:
    """One row a published number."""
    met = {v: sum(f["verdict"] == v for f in figures) for v in ("met", "shape", "open")}
    table = Table(title=f"{len(figures)} published numbers: {met['met']} met within 30 %, {met['shape']} in shape, {met['open']} open")
    for column in ("scenario", "scheme", "trial", "quantity", "published", "ours", "ratio", "verdict", "source", "reading"):
        table.add_column(column, justify="right" if column in ("trial", "published", "ours", "ratio") else "left")
    for f in figures:
        trial = "" if f["trial"] is None else str(f["trial"])
        ours = (f"{'< ' * f['at_most']}{f['value']:g} {f['unit']}", number(f["ours"]), f"{f['ratio']:.2f}")
        reading = "; ".join([*(f"{k} {v}" for k, v in f["options"].items() if k != "plant"), f["reading"]])
        table.add_row(f["scenario"], f["scheme"], trial, f["quantity"].replace("_", " "), *ours, f["verdict"], f["source"], reading)
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
