"""What a command leaves behind: folders, and files of numbers and of parameters."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from .console import out

if TYPE_CHECKING:
    from ..scenarios import Scenario
    from ..tuning import Tuned


def folder_of(folder: Path | None, default: str) -> Path:
    """The folder for results, made if it is not there; out/DEFAULT where none was asked for."""
    folder = folder or Path("out") / default
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def unless_there(place: Path, resume: bool) -> Path:
    """The place that a command keeps its state in, inside the folder for results.

    Raises FileExistsError if it is there already and `--resume` was not given.
    """
    if place.exists() and not resume:
        raise FileExistsError(
            f"{place} exists already; add --resume to go on with it, or choose another --out"
        )
    return place


def parameter_file(
    path: Path,
    chosen: Scenario,
    *,
    command: str,
    source: str,
    scheme: str,
    tuned: Tuned,
    **obtained: Any,
) -> Path:
    """Write the parameters in which a tuned scheme differs from that of its scenario.

    command: that found them
    obtained: what else is worth knowing of that, as JSON
    source: name or file that the scenario was loaded from
    """
    from ..scenarios.from_file import load_scenario
    from ..scenarios.parameters import differing, write_parameters

    printed = load_scenario(source, chosen.options).schemes[scheme]
    changed = {scheme: differing(tuned.scheme, printed)}
    how = {"command": command, "options": dict(chosen.options), **obtained}
    return write_parameters(path, chosen.name, changed, how)


def written(paths: list[Path], json_file: Path | None, numbers: dict | list) -> None:
    """Write the numbers to the file of `--json`, if there is one, and say what was written."""
    from ..storage.sealed import write_json

    if json_file is not None:
        json_file.parent.mkdir(parents=True, exist_ok=True)
        write_json(json_file, numbers)
        paths = [*paths, json_file]
    if paths:
        out.print("written: " + ", ".join(map(str, paths)), highlight=False, soft_wrap=True)
