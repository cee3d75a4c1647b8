"""Where a design is written: the plant file beside the one given, and the folder of its state."""

from __future__ import annotations

import shutil
from pathlib import Path


def target_of(plant_file: Path, out_file: Path | None, what: str, *, replace: bool) -> Path:
    """The plant file to write; raises ValueError or FileExistsError where it may not be written.

    what: the middle of its name where no file is asked for, axis.design.toml for `design`
    """
    from ..scenarios.design_file import design_path, need_same_folder

    if plant_file.suffix not in (".toml", ".json"):
        raise ValueError(
            f"{plant_file} is no plant file; allowed is a TOML or JSON file, such as `jaxilc init` "
            "writes. A scenario of a paper has laws of its own: `jaxilc tune` changes their weights"
        )
    target = out_file or design_path(plant_file, what)
    need_same_folder(plant_file, target)
    if target.exists() and not replace:
        raise FileExistsError(f"{target} exists already; add --force to replace it")
    return target


def place_of(state: Path, *, force: bool, resume: bool) -> Path:
    """The folder for the state, without that of an earlier run if it is to be replaced."""
    if state.exists() and not resume:
        if not force:
            raise FileExistsError(
                f"{state} exists already; add --resume to go on with it, --force to begin anew, "
                "or choose another --state"
            )
        shutil.rmtree(state)
    return state
