"""The interactive figures of the page of a command; none where no page is asked for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import xarray as xr

    from ..figures.interactive import Live
    from ..scenarios import Scenario
    from ..sweeps.summary import SchemeSummary
    from ..theory.of_schemes import OfScheme

EXPLORED = ("error-by-trial", "tracking-")  # figures of a run that interactive ones replace


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


def left_of_run(paths: Sequence[Path]) -> list[Path]:
    """The figures of a run that no interactive figure replaces."""
    return [path for path in paths if not path.stem.startswith(EXPLORED)]


def of_sweep(
    page: Path | None,
    dataset: xr.Dataset,
    summary: Sequence[SchemeSummary],
    shown: Mapping[str, Any],
) -> list[Live | None]:
    """The errors by trial of all machines, and each machine against its parameters.

    shown: metric, tolerance, scale and unit
    """
    if page is None:
        return []
    from ..figures import browsers, interactive

    drawn = {
        str(name): values.values
        for name, values in dataset.coords.items()
        if values.dims[:1] == ("sample",) and name != "sample"
    }
    return [
        interactive.band(summary, **shown),
        browsers.machines(dataset, drawn, **shown),
    ]


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
