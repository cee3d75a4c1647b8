"""What a campaign on a real machine belongs to: its plant file, scheme and weights.

The recipe of a campaign names them, so they are known without loading the file:

    scenario     name of a scenario, or the absolute path of a plant file
    file         of a plant file: `given`, its path as it was given, and `sha256`, its checksum
    scheme       name of the scheme
    parameters   of `--params`: `given` and `sha256` of the file, and `values` by path in the scheme
    settings     of `--set`: values by path
    rules        numbers of the rules for what is refused
    predict      whether the errors of the trials are predicted
    stop         that of `[potential]` of the scenario, None without it
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from ..pytree.closest import first_of
from ..pytree.ranges import is_number
from ..storage.reading import LARGEST_TREE, read_bytes
from ..storage.sealed import checksum

if TYPE_CHECKING:
    from ..pytree.aliases import Value

SHOWN = 12  # characters of a checksum that are printed
WEIGHTS = 6  # weights that are printed; there may be hundreds


def digest_of(path: str | Path) -> str:
    """SHA-256 of the content of a file; raises OSError, and ValueError for what is no file."""
    return checksum(read_bytes(path, LARGEST_TREE))


def belongs_to(recipe: Mapping[str, Value]) -> dict[str, Value]:
    """What a campaign belongs to, as JSON.

    source: the scenario, or the plant file as it was given
    sha256: checksum of the plant file at the start; None for a scenario, or where it is not known
    sha256_now: its checksum now; None also where it cannot be read
    scheme: name of the scheme
    parameters: parameter file as it was given, None if none was
    weights: values of the parameter file and of `--set`, by path
    """
    file, parameters, settings = (_table(recipe, n) for n in ("file", "parameters", "settings"))
    scheme, now = recipe.get("scheme"), None
    if file:
        try:
            now = digest_of(str(recipe.get("scenario")))
        except (OSError, ValueError):
            now = None
    tuned = {f"{scheme}.{path}": value for path, value in _table(parameters, "values").items()}
    return {
        "source": file.get("given", recipe.get("scenario")),
        "sha256": file.get("sha256"),
        "sha256_now": now,
        "scheme": scheme,
        "parameters": parameters.get("given"),
        "weights": tuned | settings,
    }


def for_verdict(recipe: Mapping[str, Value], trials_of_step: Value) -> dict[str, Value]:
    """The numbers by which a verdict on a campaign judges, those that are known, by name.

    trials_of_step: that of an entry of the journal, which somebody may have made by hand
    """
    found = {"trials_of_step": trials_of_step, "stop": recipe.get("stop")}
    known = {name: of for name, of in found.items() if of is not None and is_number(of) and of > 0}
    growth = _table(recipe, "rules").get("growth")
    return known | {"growth": growth} if is_number(growth) else known


def said_of_source(recipe: Mapping[str, Value]) -> list[str]:
    """Sentences on what a campaign belongs to."""
    found = belongs_to(recipe)
    digest = f", sha256 {str(found['sha256'])[:SHOWN]}" if found["sha256"] else ""
    said = [f"the campaign belongs to {found['source']}{digest}; its scheme is {found['scheme']}"]
    weights = [f"{path} = {_brief(value)}" for path, value in found["weights"].items()]
    listed = first_of(weights, WEIGHTS)
    if found["parameters"]:
        listed = f"those of {found['parameters']}" + (f": {listed}" if listed else "")
    return [*said, f"weights: {listed}"] if listed else said


def said_of_change(recipe: Mapping[str, Value], meaning: str) -> str:
    """A sentence that says that the plant file has changed; an empty text where it has not.

    meaning: what follows from the change, for the end of the sentence
    """
    found = belongs_to(recipe)
    before, now, source = (found[name] for name in ("sha256", "sha256_now", "source"))
    if before is None or before == now:
        return ""
    if now is None:
        return f"{source} cannot be read any more, {meaning}"
    was, is_now = str(before)[:SHOWN], now[:SHOWN]
    return (
        f"{source} has changed since the campaign took it (sha256 {was}, now {is_now}), {meaning}"
    )


def _table(content: Mapping[str, Value], name: str) -> dict[str, Value]:
    """A table of a recipe, which somebody may have made by hand; empty where it is none."""
    found = content.get(name)
    return found if isinstance(found, dict) else {}


def _brief(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    text = str(value)
    return text if len(text) <= 40 else f"{text[:37]}..."
