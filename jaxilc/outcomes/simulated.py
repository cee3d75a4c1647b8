"""What a run and a sweep show of a scenario: trials, outputs, and trials that are experiments."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..learning.known_metrics import ERRORS
from ..schemes.parts import trials_of_step

if TYPE_CHECKING:
    from ..scenarios import Scenario

HEADS = tuple(m.head or m.name.replace("_", " ") for m in ERRORS)


def shown_trials(scenario: Scenario) -> list[int]:
    """The trials that have a row in a table: those that the scenario names, and the last one.

    Where it names none, they are 1, 2, 5, 10, 20 and so on.
    """
    decades = range(len(str(scenario.trials)))
    named = scenario.show_trials or [n * 10**k for k in decades for n in (1, 2, 5)]
    return sorted({j for j in named if j <= scenario.trials} | {scenario.trials})


def output_names(scenario: Scenario) -> list[str]:
    """What the outputs are called: their names, or `output 0`, `output 1`, ..."""
    labels = scenario.task.labels
    return [one if isinstance(one, str) else f"output {one}" for one in labels]


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
