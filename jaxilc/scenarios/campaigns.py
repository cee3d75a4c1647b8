"""Campaigns on a real machine whose scheme and task come from a scenario or a plant file.

The recipe of a campaign says how scheme, task and rules were made. It is stored in the journal, so
that later calls need not repeat the arguments of the first one.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import jax

from ..hardware.campaign import Campaign
from ..hardware.checks import Rules
from ..hardware.journal import Journal, Manifest
from ..hardware.prediction import Subject
from ..hardware.trial_files import Measured
from ..learning.machine import Machine
from ..pytree.closest import known_names
from ..pytree.ranges import is_number
from ..runtime.provenance import differences
from ..storage.sealed import as_json
from .campaign_source import digest_of, said_of_change
from .from_file import SCENARIOS, with_options
from .parameters import differing, warn_of_another, with_parameters
from .scenario import Scenario

# Rules that are kept from the first call on, until a new value is given.
KEPT_RULES = ("limit", "correction", "saturation", "repeatability", "growth")


class Given(NamedTuple):
    """The arguments of a call; None takes the value of the existing campaign.

    scenario: name of a scenario, or a plant file
    scheme: name of the scheme; it may be None where only one scheme learns
    params: parameter file, as `jaxilc run --params` takes it
    settings: values by path, which replace those that are kept
    rules: numbers of `KEPT_RULES` by name
    predict: whether the errors are predicted; kept from call to call, and true at first
    accept_saturation, stop_on_growth, accept: fields of `Rules`, for this call only
    """

    scenario: str | None = None
    scheme: str | None = None
    params: Path | None = None
    settings: dict[str, str] | None = None
    predict: bool | None = None
    rules: dict[str, float | None] | None = None
    accept_saturation: bool = False
    stop_on_growth: bool = False
    accept: tuple[str, ...] = ()


class Opened(NamedTuple):
    """A campaign with the scenario that its scheme and task are from.

    campaign: the campaign
    scenario: its scenario, with the settings and parameters of the campaign
    """

    campaign: Campaign
    scenario: Scenario

    @property
    def recipe(self) -> Manifest:
        """How scheme, task and rules were made, see `campaign_source`."""
        return self.campaign.recipe

    @property
    def subject(self) -> Subject:
        """What is predicted for this campaign."""
        scenario, campaign = self.scenario, self.campaign
        return Subject(scenario.machine, campaign.scheme, campaign.task, scenario.uncertainty)


def open_campaign(state: Path, given: Given, *, new: bool, dry_run: bool = False) -> Opened:
    """The campaign in a folder, to continue it, or a new one.

    new: whether to start a new campaign
    dry_run: whether a new campaign is only checked, and not stored
    Raises ValueError naming what is missing, wrong, or different from the start of the campaign,
    and FileNotFoundError where there is no campaign to continue.
    """
    before = {} if new else _kept(Journal(state))
    recipe = _recipe(before, given)
    rules = Rules(
        **recipe["rules"],
        accept_saturation=given.accept_saturation,
        stop_on_growth=given.stop_on_growth,
        accept=given.accept,
    )
    try:
        bare, settings = with_options(recipe["scenario"], recipe["settings"])
    except FileNotFoundError as error:
        moved = f"{error.strerror}; if it was moved, name it by --scenario"
        raise FileNotFoundError(error.errno, moved, error.filename) from None
    name = recipe["scheme"] = _learning_scheme(bare, recipe["scheme"])
    if given.params is not None:
        found = _parameters(bare, name, given.params)
        recipe["parameters"] = found if new else _as_begun(state, before, found)
    values = recipe.get("parameters", {}).get("values", {})
    chosen = bare.with_values({f"{name}.{path}": value for path, value in values.items()})
    chosen = chosen.with_values(settings)
    if new and given.params is not None:
        warn_of_another(chosen, given.params, settings)
    need_one_reference("a campaign", chosen.machine)
    recipe["stop"] = None if chosen.potential is None else chosen.potential.stop
    subject = (state, chosen.schemes[name], chosen.task)
    actuator = chosen.machine.actuator
    if new:
        campaign = Campaign.start(
            *subject, actuator=actuator, rules=rules, recipe=recipe, dry_run=dry_run
        )
        return Opened(campaign, chosen)
    try:
        campaign = Campaign.open(*subject, actuator=actuator, rules=rules, recipe=recipe)
        return Opened(campaign, chosen)
    except ValueError as error:
        changed = said_of_change(recipe, "so this campaign cannot go on with it")
        raise ValueError("; ".join(text for text in (str(error), changed) if text)) from None


def need_one_reference(what: str, machine: Machine) -> None:
    """Raises ValueError for a machine whose references change."""
    if machine.variation is not None and machine.variation.references is not None:
        raise ValueError(
            f"{what} follows the reference of the task in every trial, but machine.variation has "
            "references that change; leave them out, and take one for each reference"
        )


def need_recorded(machine: Machine, campaign: Campaign, record: Measured) -> None:
    """Raises ValueError where what a feedback did in a trial would be computed from rest.

    A feedback that goes on from trial to trial did not begin there.
    """
    scheme = campaign.scheme
    state = scheme.initial_state(campaign.task)
    lacking = {*scheme.signals(state)} - {*record.others} | ({"u"} if record.u is None else set())
    if machine.carries and jax.tree.leaves(state) and lacking:
        raise ValueError(
            f"{record.source} has no {' and '.join(sorted(lacking))}: machine.variation.carried "
            "makes the feedback go on from trial to trial, so what it did in one cannot be "
            "computed from rest; record it, in a column of that name"
        )


def _parameters(bare: Scenario, scheme: str, path: Path) -> Manifest:
    """The values of a parameter file for the scheme, as the recipe holds them."""
    tuned = with_parameters(bare, path, (scheme,))
    values = as_json(differing(tuned.schemes[scheme], bare.schemes[scheme]))
    return {"given": str(path), "sha256": digest_of(path), "values": values}


def _as_begun(state: Path, before: Manifest, found: Manifest) -> Manifest:
    """The parameters with which a campaign was started, if those of a file are the same.

    Raises ValueError naming those that differ.
    """
    kept = before.get("parameters", {"values": {}})
    wrong = differences(kept.get("values"), found["values"])
    if wrong:
        raise ValueError(
            f"{found['given']} has other parameters than {state} was started with: "
            f"{'; '.join(wrong)}; leave out --params, or start a campaign in another folder"
        )
    return kept if "given" in kept else found


def _kept(journal: Journal) -> Manifest:
    """The recipe of a campaign; raises ValueError for one that `jaxilc next` does not write."""
    recipe = journal.last_known()["recipe"]
    kinds: dict[str, type] = {"scenario": str, "scheme": str, "predict": bool}
    kinds |= dict.fromkeys(("settings", "rules", "file", "parameters"), dict)
    rules = recipe.get("rules", {})
    if (
        not all(isinstance(recipe.get(name, kind()), kind) for name, kind in kinds.items())
        or not all(name in KEPT_RULES and is_number(value) for name, value in rules.items())
        or not isinstance(recipe.get("parameters", {}).get("values", {}), dict)
    ):
        raise ValueError(
            f"{journal.path} was not started by `jaxilc next`, or its last recipe is damaged; "
            "--undo cannot mend it"
        )
    return recipe


def _recipe(before: Manifest, given: Given) -> Manifest:
    """The recipe of this call: the one before, with the values that are given now."""
    source = given.scenario
    if source is None and "scenario" not in before:
        raise ValueError("the first call needs --scenario")
    besides = {name: before[name] for name in ("file", "parameters") if name in before}
    if source is not None:
        besides.pop("file", None)
    if source is not None and source not in SCENARIOS and Path(source).suffix:
        besides["file"] = {"given": source, "sha256": digest_of(Path(source))}
        source = str(Path(source).absolute())  # a later call may come from another folder
    rules = {name: value for name, value in (given.rules or {}).items() if value is not None}
    return {
        "scenario": source or before["scenario"],
        "scheme": given.scheme or before.get("scheme"),
        "settings": before.get("settings", {}) | (given.settings or {}),
        "rules": before.get("rules", {}) | rules,
        "predict": before.get("predict", True) if given.predict is None else given.predict,
    } | besides


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
