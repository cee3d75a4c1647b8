"""Tables and lines of scenarios, runs, sweeps and identified plants, for a terminal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ..learning.divergence import CEILING, GROWTH
from ..learning.known_metrics import ERRORS
from ..pytree.ranges import value_text
from ..scenarios.loading import with_reading
from ..schemes.parts import trials_of_step
from .numbers import shown_trials
from .titled_table import Table

NOTHING = 1e-12  # of the interval of a quantity, below which it is shown as 0
MOST_ORDERS = 12  # rows of a table of orders
HEADS = tuple(m.head or m.name.replace("_", " ") for m in ERRORS)
OF_CONTOUR = {"max_error": "contour_max", "rms": "contour_rms"}  # metrics of an axis, of a contour

if TYPE_CHECKING:
    from ..identification import Order
    from ..scenarios import Scenario


def settable_table(scenario: Scenario) -> Table:
    """The table of all that `--set` can set in a scenario, with values and allowed ranges."""
    table = Table(title=scenario.title)
    table.add_column("--set", whole=True)
    table.add_column("value")
    table.add_column("allowed")
    for option, default in scenario.options.items():
        table.add_row(option, str(default), "option of the scenario")
    for path, value in scenario.settable().items():
        table.add_row(path, _brief(value), scenario.allowed(path))
    return table


def run_table(scenario: Scenario, numbers: dict[str, Any]) -> Table:
    """The table of the metric by which the scenario is judged, for each trial and scheme.

    A published value is shown in brackets, and the title says so where there is one.
    """
    metric, (_, unit) = scenario.judged_by, scenario.shown(scenario.judged_by)
    rows_by_trial, printed = [], ""
    for j in shown_trials(scenario):
        cells = []
        for rows in numbers["schemes"].values():
            values = [
                p["value"] for p in rows["published"] if p["quantity"] == metric and p["trial"] == j
            ]
            printed = ", published value in brackets" if values else printed
            cells.append(number(rows[metric][str(j)]) + "".join(f" ({v:g})" for v in values))
        rows_by_trial.append((str(j), *cells))
    what = f"{metric.replace('_', ' ')} [{unit}] by trial{printed}"
    table = Table(title=f"{scenario.title}\n{what}")
    table.add_column("trial", justify="right")
    for name in scenario.schemes:
        table.add_column(name, justify="right")
    for row in rows_by_trial:
        table.add_row(*row)
    return table


def other_rows(scenario: Scenario, numbers: dict[str, Any]) -> list[str]:
    """The published numbers that have no cell in `run_table`, one line each."""
    in_table = {(scenario.judged_by, j) for j in shown_trials(scenario)}
    lines = []
    for name, rows in numbers["schemes"].items():
        for p in rows["published"]:
            if p["ours"] is not None and (p["quantity"], p["trial"]) not in in_table:
                at = f" at trial {p['trial']}" if p["trial"] else ""
                ours = f"{p['quantity'].replace('_', ' ')}{at} {number(p['ours'])} {p['unit']}"
                lines.append(f"{name}: {ours} (published {p['value']:g})")
    return lines


def reading_lines(scenario: Scenario, numbers: dict[str, Any]) -> list[str]:
    """A sentence where ours and published numbers part: what is simulated, what `reproduce` judges.

    A paper can be read in several ways, and `run` takes another one than `reproduce` by default.
    """
    beside = [p for rows in numbers["schemes"].values() for p in rows["published"]]
    near = [p["met"] for p in beside if p["met"] is not None]
    if all(near):
        return []
    judged = {name: value for p in scenario.due for name, value in p.options}
    judged |= with_reading(scenario.name, None)
    other = [name for name, value in judged.items() if scenario.options.get(name) != value]
    here = ", ".join(f"{name}={scenario.options[name]}" for name in other)
    there = " ".join(f"--set {name}={judged[name]}" for name in other)
    said = [f"{near.count(True)} of {len(near)} published numbers are met within 30 %"]
    if other:
        said[0] += f": simulated is {here}"
        said.append(f"The paper is judged with {there}")
    return [". ".join([*said, f"jaxilc reproduce {scenario.name} says how each number was read."])]


def last_trial_table(numbers: dict[str, Any]) -> Table:
    """The table of the errors of the last trial of a run by every metric, and of the best trial."""
    last = str(numbers["trials"])
    table = Table(title=f"trial {last}, errors in {numbers['unit'] or 'the unit of y'}")
    for column in ("scheme", *HEADS, "best trial (by rms)"):
        table.add_column(column, justify="left" if column == "scheme" else "right")
    for name, rows in numbers["schemes"].items():
        errors = (number(rows[m.name][last]) for m in ERRORS)
        table.add_row(name, *errors, str(rows["best"]))
    return table


def axes_table(numbers: dict[str, Any]) -> Table | None:
    """The table of the errors of the last trial of a run, axis by axis, and of the contour.

    None for a single output.
    """
    if not any("axes" in rows for rows in numbers["schemes"].values()):
        return None
    last = str(numbers["trials"])
    table = Table(title=f"trial {last} by axis, errors in {numbers['unit'] or 'the unit of y'}")
    for column in ("scheme", "axis", *HEADS):
        table.add_column(column, justify="left" if column in ("scheme", "axis") else "right")
    for name, rows in numbers["schemes"].items():
        for axis, errors in rows["axes"].items():
            table.add_row(name, axis, *(number(errors[m.name][last]) for m in ERRORS))
        if "contour_max" in rows:
            contour = {of: number(rows[m][last]) for of, m in OF_CONTOUR.items()}
            table.add_row(name, "contour", *(contour.get(m.name, "") for m in ERRORS))
    return table


def swept_axes_table(numbers: dict[str, Any]) -> Table | None:
    """The table of the largest errors of the last trial of a sweep, axis by axis, and contour.

    None for a single output.
    """
    if "axes" not in numbers:
        return None
    tolerance, unit = numbers["tolerance"], numbers["unit"]
    within = () if tolerance is None else (f"within {tolerance:g}",)
    table = Table(title=f"largest error [{unit}] of trial {numbers['trials']} by axis")
    for column in ("scheme", "axis", *within, "median", "95 %", "worst (machine)"):
        table.add_column(column, justify="left" if column in ("scheme", "axis") else "right")
    for name, axes in numbers["axes"].items():
        for axis, at in axes.items():
            share = [] if tolerance is None else [f"{at['yield']:.1%}"]
            worst = f"{number(at['worst'])} ({at['worst_sample']})"
            table.add_row(name, axis, *share, number(at["median"]), number(at["high"]), worst)
    return table


def course_lines(numbers: dict[str, Any]) -> list[str]:
    """A line for each scheme of a run that diverged, or whose error has grown."""
    lines = []
    for name, rows in numbers["schemes"].items():
        if rows["diverged_at"]:
            lines.append(
                f"{name}: diverged at trial {rows['diverged_at']}: not finite, "
                f"or an error of {CEILING:g} times the reference"
            )
        elif rows["grown_from"]:
            lines.append(
                f"{name}: the rms error has grown {number(rows['grown_to'])} times since trial "
                f"{rows['best']}; from trial {rows['grown_from']} on it is more than "
                f"{1 + GROWTH:g} times its least"
            )
    return lines


def experiment_lines(scenario: Scenario) -> list[str]:
    """A line for each scheme that makes experiments, with the trials that are none."""
    lines = []
    for name, scheme in scenario.schemes.items():
        each = trials_of_step(scheme, scenario.task)
        if each > 1:
            lines.append(
                f"{name}: what was learned is played in trials 1, {1 + each}, {1 + 2 * each} and "
                "so on; the trials between are experiments, whose errors say nothing of it"
            )
    return lines


def sweep_lines(numbers: dict[str, Any]) -> list[str]:
    """A line for each scheme of a sweep under which machines diverged, or their errors grew."""
    lines = []
    for name, row in numbers["schemes"].items():
        if row["diverged"]:
            lines.append(
                f"{name}: {row['diverged']:.1%} of the machines diverged, the first at trial "
                f"{row['diverged_at']}"
            )
        if row["semi_converged"]:
            lines.append(
                f"{name}: on {row['semi_converged']:.1%} of the machines the {numbers['figure']} "
                f"has grown since its best trial, up to {number(row['grown_to'])} times"
            )
    if numbers["tolerance"] is None:
        lines.append("no yield: give --tolerance, or `tolerance` in the file")
    return lines


def yield_table(numbers: dict[str, Any]) -> Table:
    """The table of yields with their intervals, and of shares that have grown or diverged.

    There is no column of yields without a tolerance. The number in brackets, `(from)`, is the
    earliest trial from which on one of these machines has grown or diverged.
    """
    known = numbers["tolerance"] is not None
    within = f" within {numbers['tolerance']:g} {numbers['unit']}" if known else ""
    what = f"{numbers['figure']} of trial {numbers['trials']}{within}"
    table = Table(title=f"{numbers['samples']} machines, {what}")
    yields = ("yield (95 % interval)",) if known else ()
    for column in ("scheme", *yields, "grown (from)", "diverged (from)"):
        table.add_column(column, justify="left" if column == "scheme" else "right")
    for name, row in numbers["schemes"].items():
        low, high = row["yield_interval"] or (0.0, 0.0)
        table.add_row(
            name,
            *([f"{row['yield']:.1%} ({low:.1%} – {high:.1%})"] if known else []),
            _share(row["semi_converged"], row["grown_from"]),
            _share(row["diverged"], row["diverged_at"]),
        )
    return table


def _share(share: float, trial: int) -> str:
    """A text `5.2% (43)`: the share of such machines, and the earliest trial of one of them."""
    return f"{share:.1%}" + (f" ({trial})" if trial else "")


def grid_table(numbers: dict[str, Any]) -> Table | None:
    """The table of the best point of each scheme, to which all other tables belong.

    None for a sweep without a grid.
    """
    if "grid" not in numbers:
        return None
    axes, best = numbers["grid"]["axes"], numbers["grid"]["best"]
    count = f"{np.prod([*axes.values()], dtype=int)} points"
    table = Table(title=f"best of {count}: 95 % {numbers['figure']} [{numbers['unit']}]")
    for column in ("scheme", *axes, "95 %", "points within twice", "points that diverge"):
        table.add_column(column, justify="left" if column == "scheme" else "right")
    for name, row in best.items():
        at = [value_text(x) for x in row["point"].values()]
        shares = (f"{row['near']:.1%}", f"{row['diverged']:.1%}")
        table.add_row(name, *at, number(row["error"]), *shares)
    return table


def spread_table(numbers: dict[str, Any]) -> Table:
    """The table of quantiles over the machines in the last trial, and of the worst machine."""
    last = str(numbers["trials"])
    table = Table(title=f"{numbers['figure']} [{numbers['unit']}] of trial {last}")
    for column in ("scheme", "median", "5 %", "95 %", "worst", "its machine"):
        table.add_column(column, justify="left" if column == "scheme" else "right")
    for name, row in numbers["schemes"].items():
        at = row["by_trial"][last]
        quantiles = (number(at[of]) for of in ("median", "low", "high", "worst"))
        table.add_row(name, *quantiles, str(at["worst_sample"]))
    return table


def band_table(numbers: dict[str, Any]) -> Table:
    """The table of the median and the 95 % quantile for each trial and scheme."""
    table = Table(title=f"{numbers['figure']} [{numbers['unit']}] by trial: median (95 % quantile)")
    table.add_column("trial", justify="right")
    for name in numbers["schemes"]:
        table.add_column(name, justify="right")
    for j in next(iter(numbers["schemes"].values()))["by_trial"]:
        rows = [row["by_trial"][j] for row in numbers["schemes"].values()]
        table.add_row(j, *(f"{number(r['median'])} ({number(r['high'])})" for r in rows))
    return table


def identification_table(title: str, rows: Sequence[tuple[str, float, float, float]]) -> Table:
    """The table of identified quantities with their 95 % intervals."""
    table = Table(title=f"{title}: identified, with 95 % intervals")
    for column in ("quantity", "value", "low", "high"):
        table.add_column(column, justify="left" if column == "quantity" else "right")
    for name, *values in rows:
        largest = NOTHING * np.max(np.abs(values), where=np.isfinite(values), initial=0.0)
        shown = [0.0 if abs(v) < largest else v for v in values]
        table.add_row(name, *(f"{v:.6g}" if np.isfinite(v) else "–" for v in shown))
    return table


def orders_table(orders: Sequence[Order], best: Order, dt: float | None = None) -> Table:
    """The table of the structures that were fitted, of which the best one is marked.

    The column rms is that of the residual, in the unit of the output; of a frequency response,
    divided by the standard deviation of each line. The column valid. is the fit of the part that
    was not fitted. Of many fits, those of the smallest criterion are shown.

    dt: sample time, in which the delay is told [s]; None: in ms
    """
    of_response, delayed = best.found.of_response, any(_delay(one) > 0 for one in orders)
    shown = list(orders)
    if len(shown) > MOST_ORDERS:
        shown = sorted(shown, key=lambda one: one.bic)[:MOST_ORDERS]
    count = (
        f"{len(shown)} of {len(orders)} structures" if len(shown) < len(orders) else "structures"
    )
    table = Table(title=f"{count} by BIC, above the smallest ({best.bic:.1f})")
    delay = ("delay" if dt else "delay [ms]",) * delayed
    last = () if of_response else ("valid. [%]",)
    rms = "rms / std" if of_response else "rms"
    for column in ("poles", "pairs", "zeros", *delay, rms, "BIC", *last, ""):
        table.add_column(column, justify="right")
    for one in shown:
        counts = (one.poles, one.pairs, one.zeros)
        late = (f"{_delay(one) / (dt or 1e-3):.4g}",) * delayed
        values = (f"{one.rms:.4g}", f"{one.bic - best.bic:+.1f}")
        share = () if of_response else (f"{one.validation_fit:.4g}",)
        sound = "" if one.found.converged else "no minimum"
        row = (*map(str, counts), *late, *values, *share)
        table.add_row(*row, "chosen" if one is best else sound)
    return table


def _delay(one: Order) -> float:
    """The delay of a fitted plant [s]."""
    return float(getattr(one.found.plant, "delay", 0.0))


def number(value: float) -> str:
    """A number with three significant digits; ∞ for an error that diverged, – for NaN."""
    if not np.isfinite(value):
        return "∞" if value == np.inf else "–"
    if value == 0 or 1e-3 <= abs(value) < 1e5:
        return np.format_float_positional(value, precision=3, fractional=False, trim="-")
    return f"{value:.2e}"


def _brief(value: Any) -> str:
    if value is None or isinstance(value, str | int | tuple):
        return str(value)
    return np.array2string(np.asarray(value), precision=6, threshold=6)
