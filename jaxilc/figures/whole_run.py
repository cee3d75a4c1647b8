"""All figures of one run of a scenario, saved in a folder."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from .by_frequency import spectrum, time_frequency
from .by_trial import error_by_trial
from .saving import save
from .within_trial import contour, tracking

if TYPE_CHECKING:
    import xarray as xr

    from ..scenarios import Scenario

CURVES = (2, 20)  # trials that are drawn besides the last one


def save_run(
    scenario: Scenario,
    dataset: xr.Dataset,
    folder: Path,
    shown: Sequence[int],
    *,
    progress: Callable[[str, int, int], object] | None = None,
) -> list[Path]:
    """Draw a run, save its figures, and return the files that were written.

    error-by-trial.png      the metric by which the scenario is judged, with the published values
    tracking-SCHEME.png     reference and output of some trials
    spectrum-SCHEME.png, time-frequency-SCHEME.png    of the error, for a scheme that learns
    contour-SCHEME.png      for two axes whose contour is a metric

    dataset: result of `run_schemes`
    folder: folder for the figures
    shown: trials that have a row in the table of the run
    progress: called before each scheme with its name, the number of schemes done, and of all
    """
    in_unit = {"scale": scenario.shown_scale, "unit": scenario.shown_unit}
    scale, unit = scenario.shown(scenario.judged_by)
    axes = error_by_trial(
        dataset, metric=scenario.judged_by, published=scenario.due, scale=scale, unit=unit
    )
    paths = [save(axes, folder / "error-by-trial.png")]
    last = scenario.trials
    trials = [j for j in shown if j in (*CURVES, last)] or [last]
    for done, (name, scheme) in enumerate(scenario.schemes.items()):
        if progress is not None:
            progress(name, done, len(scenario.schemes))
        drawn: dict[str, Callable] = {"tracking": tracking}
        if scheme.learns:
            drawn |= {"spectrum": spectrum, "time-frequency": time_frequency}
        if scenario.task.outputs == 2 and "contour_max" in scenario.quantities:
            drawn |= {"contour": contour}
        for kind, draw in drawn.items():
            axes = draw(dataset, name, trials, **in_unit)
            paths.append(save(axes, folder / f"{kind}-{name}.png"))
    return paths
