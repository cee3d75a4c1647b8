"""Campaigns on a real machine whose scheme and task come from a scenario or a plant file.

The recipe of a campaign says how scheme, task and rules were made. It is stored in the journal, so
that later calls need not repeat the arguments of the first one.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from ..hardware.campaign import Campaign
from ..hardware.checks import Rules
from ..hardware.journal import Journal
from ..pytree.closest import known_names
from ..pytree.ranges import is_number
from .from_file import load_scenario
from .loading import SCENARIOS
from .scenario import Scenario

# Rules that are kept from the first call on, until a new value is given.
KEPT_RULES = ("limit", "correction", "saturation", "repeatability", "growth")


class Given(NamedTuple):
    """The arguments of a call; None takes the value of the existing campaign.

    scenario: name or file of a scenario
    plant_file: a TOML or JSON file in place of the scenario
    scheme: name of the scheme; it may be None where only one scheme learns
    settings: values by path, which replace those that are kept
    rules: numbers of `KEPT_RULES` by name
    accept_saturation, stop_on_growth: fields of `Rules`, for this call only
    """

    scenario: str | None = None
    plant_file: Path | None = None
    scheme: str | None = None
    settings: dict[str, str] | None = None
    rules: dict[str, float | None] | None = None
    accept_saturation: bool = False
    stop_on_growth: bool = False


def campaign(state: Path, given: Given, *, new: bool, dry_run: bool = False) -> Campaign:
    """The campaign in a folder, to continue it, or a new one.

    new: whether to start a new campaign
    dry_run: whether a new campaign is only checked, and not stored
    Raises ValueError naming what is missing, wrong, or different from the start of the campaign,
    and FileNotFoundError where there is no campaign to continue.
    """
    recipe = _recipe({} if new else _kept(Journal(state)), given)
    rules = Rules(
        **recipe["rules"],
        accept_saturation=given.accept_saturation,
        stop_on_growth=given.stop_on_growth,
    )
    chosen = load_scenario(recipe["scenario"], recipe["settings"])
    recipe["scheme"] = _learning_scheme(chosen, recipe["scheme"])
    subject = (state, chosen.schemes[recipe["scheme"]], chosen.task)
    common = {"actuator": chosen.machine.actuator, "rules": rules, "recipe": recipe}
    if new:
        return Campaign.start(*subject, **common, dry_run=dry_run)
    return Campaign.open(*subject, **common)


def _kept(journal: Journal) -> dict[str, Any]:
    """The recipe of a campaign; raises ValueError for one that `jaxilc next` does not write."""
    recipe = journal.last_known()["recipe"]
    kinds = {"scenario": str, "scheme": str, "settings": dict, "rules": dict}
    rules = recipe.get("rules", {})
    if not all(
        isinstance(recipe.get(name, kind()), kind) for name, kind in kinds.items()
    ) or not all(name in KEPT_RULES and is_number(value) for name, value in rules.items()):
        raise ValueError(
            f"{journal.path} was not started by `jaxilc next`, or its last recipe is damaged; "
            "--undo cannot mend it"
        )
    return recipe


def _recipe(before: dict[str, Any], given: Given) -> dict[str, Any]:
    """The recipe of this call: the one before, with the values that are given now."""
    if given.scenario is not None and given.plant_file is not None:
        raise ValueError("--scenario and --plant-file exclude each other")
    source = given.scenario if given.plant_file is None else str(given.plant_file)
    if source is None and "scenario" not in before:
        raise ValueError("the first call needs --scenario or --plant-file")
    if source is not None and source not in SCENARIOS and Path(source).suffix:
        source = str(Path(source).absolute())  # a later call may come from another folder
    rules = {name: value for name, value in (given.rules or {}).items() if value is not None}
    return {
        "scenario": source or before["scenario"],
        "scheme": given.scheme or before.get("scheme"),
        "settings": before.get("settings", {}) | (given.settings or {}),
        "rules": before.get("rules", {}) | rules,
    }


def _learning_scheme(chosen: Scenario, name: str | None) -> str:
    """The name of the scheme, which may be None where only one scheme learns."""
    learning = [name for name, scheme in chosen.schemes.items() if scheme.learns]
    name = name or (learning[0] if len(learning) == 1 else None)
    if name is None and learning:
        raise ValueError(f"--scheme is missing; those that learn are {', '.join(learning)}")
    if name not in learning:
        raise ValueError(
            f"scheme = {name!r} is not one of those that learn; {known_names(name, learning)}"
        )
    return name
