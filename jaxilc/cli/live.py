"""The interactive figures of the page of a command; none where no page is asked for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import xarray as xr

    from ..figures.live_axes import Live
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
    from ..figures import browsers, interactive

    scale, unit = chosen.shown(chosen.judged_by)
    errors = interactive.learning(
        dataset,
        metric=chosen.judged_by,
        scale=scale,
        unit=unit,
        published=chosen.due,
        tolerance=chosen.tolerance,
    )
    within = browsers.trials(dataset, scale=chosen.shown_scale, unit=chosen.shown_unit)
    return [errors, within]


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
    from ..figures import browsers, interactive, live_grid

    drawn = {
        str(name): values.values
        for name, values in dataset.coords.items()
        if values.dims[:1] == ("sample",) and name != "sample"
    }
    return [
        live_grid.grid(grid, best=best, **shown) if grid is not None and best else None,
        interactive.band(summary, **shown),
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
    from ..figures.live_searches import chance, climbing

    shown = {"metric": chosen.judged_by, "unit": chosen.shown(chosen.judged_by)[1]}
    return [chance(worst, **shown), climbing(worst, **shown)]


def of_trade_off(page: Path | None, numbers: Mapping[str, Any], names: Sequence[str]) -> list[Live]:
    """The front of two objectives, or the error for each number of trials.

    names: the objectives as they were asked for; none for numbers of trials
    """
    if page is None:
        return []
    from ..figures.live_searches import budgets, front

    if names:
        return [front(numbers["points"], first=names[0], second=names[1])]
    return [budgets(numbers["budgets"], metric=numbers["figure"], unit=numbers["unit"])]


def of_certificates(
    page: Path | None, chosen: Scenario, found: Mapping[str, OfScheme], drawn: Mapping[str, Any]
) -> list[Live]:
    """The errors of each machine by trial, in the colour of its claim, for each scheme."""
    if page is None:
        return []
    from ..figures.interactive import certified

    scale, unit = chosen.shown_scale, chosen.shown_unit
    return [
        certified(one.certificate, drawn, name=name, scale=scale, unit=unit)
        for name, one in found.items()
    ]
