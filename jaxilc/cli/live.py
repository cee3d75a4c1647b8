"""The interactive figures of the page of a command; none where no page is asked for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import xarray as xr

    from ..figures.page import Live
    from ..scenarios import Scenario
    from ..sweeps.points import BestPoint
    from ..sweeps.summary import SchemeSummary
    from ..theory.certificates import OfScheme
    from ..tuning.worst_machine import WorstMachine

# Figures by the beginning of their names, which interactive ones replace on a page.
EXPLORED = (
    *("error-by-trial", "tracking-"),
    *("worst-case", "front", "trials", "record", "validation", "response"),
)


def of_run(page: Path | None, chosen: Scenario, dataset: xr.Dataset) -> list[Live]:
    """The errors by trial, and a trial that a slider chooses."""
    if page is None:
        return []
    from ..figures import browsers, by_trial
    from ..figures.page import live

    scale, unit = chosen.shown(chosen.judged_by)
    errors = by_trial.error_by_trial.described(
        dataset,
        metric=chosen.judged_by,
        scale=scale,
        unit=unit,
        published=chosen.due,
        tolerance=chosen.tolerance,
    )
    within = browsers.trials(dataset, scale=chosen.shown_scale, unit=chosen.shown_unit)
    return [live(errors), within]


def unexplored(paths: Sequence[Path]) -> list[Path]:
    """The figures that no interactive figure replaces."""
    return [path for path in paths if not path.stem.startswith(EXPLORED)]


def of_sweep(
    page: Path | None,
    dataset: xr.Dataset,
    summary: Sequence[SchemeSummary],
    shown: Mapping[str, Any],
    grid: xr.Dataset | None = None,
    best: list[BestPoint] | None = None,
) -> list[Live | None]:
    """The errors by trial of all machines, and each machine against its parameters.

    shown: metric, tolerance, scale and unit
    grid, best: a grid of which the dataset has the best points, for its map; None for no map
    """
    if page is None:
        return []
    from ..figures import browsers, live_grid
    from ..figures.band import band_together
    from ..figures.page import live

    drawn = {
        str(name): values.values
        for name, values in dataset.coords.items()
        if values.dims[:1] == ("sample",) and name != "sample"
    }
    return [
        live_grid.grid(grid, best=best, **shown) if grid is not None and best else None,
        live(band_together(summary, **shown)),
        browsers.machines(dataset, drawn, **shown),
    ]


def of_a_store(page: Path | None, chosen: Scenario, dataset: xr.Dataset) -> list[Live | None]:
    """The same of machines on which laws were judged, in the units of the scenario."""
    if page is None:
        return []
    from ..sweeps.summary import summarise

    scale, unit = chosen.shown(chosen.judged_by)
    limit = None if chosen.tolerance is None else chosen.tolerance / scale
    summary = summarise(dataset, limit, metric=chosen.judged_by)
    shown = {"metric": chosen.judged_by, "tolerance": limit, "scale": scale, "unit": unit}
    return of_sweep(page, dataset, summary, shown)


def of_worst_case(page: Path | None, chosen: Scenario, worst: WorstMachine) -> list[Live]:
    """The machines drawn and those searched for, and what each search found with what effort."""
    if page is None:
        return []
    from ..figures.page import live
    from ..figures.searches import worst_against_chance, worst_by_effort

    shown = {"metric": chosen.judged_by, "unit": chosen.shown(chosen.judged_by)[1]}
    found = {name: one.value for name, one in worst.searches.items()}
    machines = {name: one.case.values for name, one in worst.searches.items()}
    chance = worst_against_chance.described(
        worst.by_chance, found, nominal=worst.nominal, machines=machines, **shown
    )
    return [live(chance), live(worst_by_effort.described(worst.searches, **shown))]


def of_trade_off(page: Path | None, numbers: Mapping[str, Any], names: Sequence[str]) -> list[Live]:
    """The front of two objectives, or the error for each number of trials.

    names: the objectives as they were asked for; none for numbers of trials
    """
    if page is None:
        return []
    from ..figures.page import live
    from ..figures.searches import final_error_by_trials, pareto_front

    if names:
        rows = {None if name == "given" else float(name): row
                for name, row in numbers["points"].items()}  # fmt: skip
        given, points = rows[None], [share for share in rows if share is not None]
        tuned: list[Any] = [SimpleNamespace(share=share, **rows[share]) for share in points]
        front = pareto_front.described(
            tuned, first=names[0], second=names[1], given=(given["first"], given["second"]),
            weights={share: row["weights"] for share, row in rows.items()},
        )  # fmt: skip
        return [live(front)]
    rows = numbers["budgets"]
    errors = ([[row[w]["median"], row[w]["worst"]] for row in rows.values()]
              for w in ("given", "tuned"))  # fmt: skip
    weights = {name: [row["weights"][name] for row in rows.values()]
               for name in next(iter(rows.values()))["weights"]}  # fmt: skip
    shown = {"metric": numbers["figure"], "unit": numbers["unit"]}
    trials = [int(J) for J in rows]
    return [live(final_error_by_trials.described(trials, *errors, weights=weights, **shown))]


def of_certificates(
    page: Path | None, chosen: Scenario, found: Mapping[str, OfScheme], drawn: Mapping[str, Any]
) -> list[Live]:
    """The errors of each machine by trial, in the colour of its claim, for each scheme."""
    if page is None:
        return []
    from ..figures.by_trial import certificate
    from ..figures.page import live

    shown: dict[str, Any] = {
        "scale": chosen.shown_scale,
        "unit": chosen.shown_unit,
        "parameters": drawn,
    }
    return [
        live(certificate.described(one.certificate, title=name, parameters=drawn, **shown))
        for name, one in found.items()
    ]
