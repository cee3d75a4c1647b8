"""The values that the settings of a tuning may have."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..pytree.closest import not_one_of
from ..pytree.ranges import SEEDS, require
from ..schemes import Scheme
from ..schemes.experiments import trials_of_step
from ..signals.task import Task
from .optimisers import OPTIMISERS

WHOLE = dict.fromkeys(("trials", "machines"), "[1, inf)") | {"held_out": "[0, inf)"}
WHOLE |= dict.fromkeys(("steps", "starts", "validate_every", "lanes"), "[1, inf)")
WHOLE |= {"patience": "[0, inf)", "seed": SEEDS}
REAL = {"rate": "(0, inf)", "clip": "(0, inf]", "ceiling": "(0, inf)", "scatter": "[0, inf)"}
CHOICES = {"mode": ("auto", "forward", "reverse"), "optimiser": OPTIMISERS}


def need_learned_at_last(owner: str, scheme: Scheme, task: Task, trials: int) -> None:
    """Raises ValueError where the last trial is an experiment, which says nothing of learning."""
    each = trials_of_step(scheme, task)
    if (trials - 1) % each:
        raise ValueError(
            f"{owner}: trials = {trials} ends with an experiment, whose error says nothing of what "
            f"was learned; allowed are 1, {1 + each}, {1 + 2 * each} and so on"
        )


def check_settings(settings: Mapping[str, Any]) -> None:
    """Check the settings of a tuning.

    settings: fields of `Tuning` by name, whose scheme fits its task
    Raises ValueError naming the setting, its value and what is allowed.
    """
    for name, allowed in WHOLE.items():
        require("Tuning", name, settings[name], allowed, whole=True)
    for name, allowed in REAL.items():
        require("Tuning", name, settings[name], allowed)
    if settings["truncate"] is not None:
        require("Tuning", "truncate", settings["truncate"], "[1, inf)", whole=True)
    for name, choices in CHOICES.items():
        value = settings[name]
        if isinstance(value, str) and value not in choices:
            raise ValueError(not_one_of(f"Tuning: {name} = {value!r}", value, choices))
    need_learned_at_last("Tuning", *(settings[name] for name in ("scheme", "task", "trials")))
