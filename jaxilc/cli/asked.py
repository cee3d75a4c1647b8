"""Objects of the library from the options of a command: scenario, uncertainty, tuning problem.

Each function reads the values of options, and raises ValueError naming what is allowed.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .console import log_jax
from .terms import objective_of, risk_of, weights_of

if TYPE_CHECKING:
    from ..scenarios import Scenario
    from ..tuning import Tuning
    from ..tuning.objectives import Objective
    from ..uncertainty import Uncertainty


def begin(precision: str) -> None:
    """Start JAX, with a cache of compiled programs that is kept on the disk."""
    from ..runtime.start import keep_programs, setup

    setup(precision=precision)
    log_jax(keep_programs())


def settings_of(given: list[str] | None) -> dict[str, str]:
    """The values of the options `--set PATH=VALUE`, by path."""
    values = {}
    for setting in given or []:
        path, equals, value = setting.partition("=")
        if not equals:
            raise ValueError(f"--set {setting!r} is not PATH=VALUE")
        values[path.strip()] = value.strip()
    return values


def chosen_scenario(
    name: str,
    schemes: list[str] | None,
    trials: int | None,
    settings: list[str] | None,
    params: Path | None = None,
) -> Scenario:
    """The scenario with its settings: first its options, then the parameter file, then the others.

    name: name of a scenario, or a TOML or JSON file
    schemes: names of schemes, None for all
    trials: number of trials, None for that of the scenario
    settings: texts of the options `--set`
    params: parameter file that `jaxilc tune` wrote, or the folder of a grid for its best point
    """
    from .. import scenarios
    from ..scenarios.from_file import load_scenario
    from ..scenarios.parameters import with_parameters

    trials, settings, params = expanded(name, schemes, trials, settings, params)
    values = settings_of(settings)
    known = scenarios.options(name) if name in scenarios.SCENARIOS else {}
    chosen = load_scenario(name, {path: value for path, value in values.items() if path in known})
    if not chosen.schemes:
        raise ValueError(f"{name} has no scheme; needed is a table [schemes.NAME] at least")
    if params is not None:
        chosen = with_parameters(chosen, params)
    chosen = chosen.with_values(
        {path: value for path, value in values.items() if path not in known}
    )
    if trials is not None:
        if trials < 1:
            raise ValueError(f"--trials {trials} is outside its allowed range [1, inf)")
        chosen = dataclasses.replace(chosen, trials=trials)
    chosen = chosen.select(tuple(schemes or ()))
    chosen.check()
    return chosen


def expanded(
    name: str,
    schemes: list[str] | None,
    trials: int | None,
    settings: list[str] | None,
    params: Path | None,
) -> tuple[int | None, list[str] | None, Path | None]:
    """The options `--trials`, `--set` and `--params`, with a point in place of a stored grid.

    name, ...: as for `chosen_scenario`; what is set stands after the point, and so counts
    Raises ValueError as `stored_grid.best_of` does, and for an axis that no option can set.
    """
    if params is None or not params.is_dir():
        return trials, settings, params
    from .. import scenarios
    from .stored_grid import best_of

    def load(of: Mapping[str, str]) -> Scenario:
        return chosen_scenario(name, schemes, trials, [f"{k}={text}" for k, text in of.items()])

    point = best_of(params, settings_of(settings), load)
    known = scenarios.options(name) if name in scenarios.SCENARIOS else {}
    for axis in point:
        if axis.startswith("task.") or ("." not in axis and axis not in {*known, "trials"}):
            raise ValueError(f"--params {params}: the axis {axis} is not one that --set can set")
    of_point = point.pop("trials", None)
    trials = of_point if trials is None else trials
    return trials, [*(f"{axis}={x}" for axis, x in point.items()), *(settings or ())], None


def scenario_to_design(
    file: Path, scheme: str | None, trials: int | None, settings: list[str] | None
) -> Scenario:
    """The scenario of a plant file, which need not have schemes, for the design of a law.

    scheme: name of the only scheme whose feedback counts, None for all
    trials, settings: as for `chosen_scenario`
    """
    from ..scenarios.from_file import load_scenario

    chosen = load_scenario(file, settings_of(settings))
    if trials is not None:
        chosen = dataclasses.replace(chosen, trials=trials)
    return chosen.select(() if scheme is None else (scheme,))


def grid_asked(
    chosen: Scenario, given: list[str] | None, load: Callable[[str], Scenario]
) -> dict[str, Any]:
    """The grid of the scenario with the axes of `--grid`, for `Sweep`.

    load: the scenario with a further setting, for an axis that is an option of the scenario
    """
    grid, read = dict(chosen.grid), set()
    for axis in given or []:
        name, equals, values = (part.strip() for part in axis.partition("="))
        if not equals:
            raise ValueError(f"--grid {axis!r} is not PATH=VALUES")
        if name in read:
            raise ValueError(f"--grid {name} is given twice; allowed is once")
        read.add(name)
        labels = [label.strip() for label in values.split(",")]
        if name in chosen.options and len({*labels}) < len(labels):
            raise ValueError(f"--grid {axis!r} has equal values; allowed are different ones")
        of_option = name in chosen.options
        grid[name] = {x: load(f"{name}={x}") for x in labels} if of_option else values
    return grid


def spread_of(chosen: Scenario, spread: float | None) -> Uncertainty:
    """The uncertainty of the scenario, with the half-width of `--spread` if that is given."""
    from ..uncertainty import with_spread

    return chosen.uncertainty if spread is None else with_spread(chosen.uncertainty, spread)


def objective_asked(chosen: Scenario, text: str, option: str = "--objective") -> Objective:
    """The objective that the text of an option describes.

    A term without `@METRIC` uses the metric by which the scenario is judged.
    """
    return objective_of(text, chosen.judged_by, chosen.shown(chosen.judged_by)[0], option)


def tuning_problem(
    chosen: Scenario,
    scheme: str,
    *,
    weights: str,
    bounds: list[str] | None,
    spread: float | None,
    objective: Objective,
    risk: str,
    options: Mapping[str, Any],
) -> Tuning:
    """The tuning problem of one scheme of the scenario.

    weights, bounds, spread, risk: values of the options of the same name
    options: further arguments of `Tuning`, by name
    """
    from ..tuning.problem import Tuning

    return Tuning(
        chosen.machine,
        chosen.schemes[scheme],
        chosen.task,
        chosen.trials,
        weights=weights_of(weights, bounds),
        uncertainty=spread_of(chosen, spread),
        objective=objective,
        risk=risk_of(risk),
        quantities=chosen.functions,
        **options,
    )
