"""Campaigns on a real machine whose scheme and task come from a scenario or a plant file.

The recipe of a campaign says how scheme, task and rules were made. It is kept in the journal, so
that a later call need not repeat what the first one was given.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from ..hardware.campaign import Campaign
from ..hardware.checks import Rules
from ..hardware.journal import Journal
from ..pytree.ranges import is_number
from .from_file import load_scenario
from .loading import SCENARIOS
from .scenario import Scenario

# Rules that hold from the first call on, until one is given anew.
KEPT_RULES = ("limit", "correction", "saturation", "repeatability", "growth")


class Given(NamedTuple):
    """What a call is given; a None is taken from the campaign that is there.

    scenario: a name or a file
    plant_file: in its place, a TOML or JSON file
    scheme: may be None where one scheme learns
    settings: values by path, over those kept
    rules: numbers of `KEPT_RULES` by name
    accept_saturation, stop_on_growth: of `Rules`, for this call alone
    """

    scenario: str | None = None
    plant_file: Path | None = None
    scheme: str | None = None
    settings: dict[str, str] | None = None
    rules: dict[str, float | None] | None = None
    accept_saturation: bool = False
    stop_on_growth: bool = False


def campaign(state: Path, given: Given, *, new: bool, dry_run: bool = False) -> Campaign:
    """The campaign in a folder, to go on with, or a new one.

    dry_run: a new campaign is checked, and not stored
    Raises ValueError naming what is missing, wrong, or not as the campaign was started;
    FileNotFoundError where there is no campaign to go on with.
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
    """The recipe of a campaign. Raises ValueError for one that `jaxilc next` does not write."""
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
    """The recipe of this call: as before, except for what is given anew."""
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
    """The name of the scheme, which may be left out where only one learns."""
    learning = [name for name, scheme in chosen.schemes.items() if scheme.learns]
    name = name or (learning[0] if len(learning) == 1 else None)
    if name is None and learning:
        raise ValueError(f"--scheme is missing; those that learn are {', '.join(learning)}")
    if name not in learning:
        raise ValueError(
            f"scheme = {name!r} is not one of those that learn: {', '.join(learning) or 'none'}"
        )
    return name
