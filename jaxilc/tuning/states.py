"""The folder of a descent: its configuration, its newest state, and the state before that.

All three files have checksums. A state also holds the configuration, so that a tuning survives
damage to any single file: it continues from the undamaged files, and ends with the same numbers,
bit for bit.
"""

from __future__ import annotations

import json
import logging
import os
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import jax
import numpy as np

from ..runtime.provenance import need_same
from ..storage.files import (
    atomically,
    need_free,
    only_one,
    remove_leftovers,
    to_disk,
    whole_folder,
)
from ..storage.reading import tree_of
from ..storage.sealed import (
    Damaged,
    archive,
    as_json,
    json_text,
    read_arrays,
    read_json,
    sealed,
    unsealed,
    write_json,
)
from .descent import State

CONFIGURATION = "configuration.json"
STATE, PREVIOUS, FRESH = "state.npz", "previous.npz", "fresh.npz"

log = logging.getLogger("jaxilc")


class Folder:
    """The folder of a descent, which no other process can open while it is open here."""

    def __init__(self, path: Path, configuration: dict[str, Any], resume: bool):
        """Open the folder, or make it.

        Raises FileExistsError, and ValueError for a folder that is in use, does not belong to a
        tuning, or was made with another configuration, as `Tuning.run` says.
        """
        self.path, self._recipe = path, json_text(configuration)
        if not path.exists():
            with whole_folder(path) as unfinished:
                write_json(unfinished / CONFIGURATION, sealed(configuration))
        elif not resume:
            need_free(path)
        with ExitStack() as closing:
            closing.enter_context(only_one(path))
            remove_leftovers(path)
            self._whole, self._damaged = _states(path)
            need_same(path, self._configuration(), json.loads(self._recipe))
            self._leave_others()
            self._newest_is_whole = STATE in self._whole
            self._closing = closing.pop_all()

    def __enter__(self) -> Folder:
        return self

    def __exit__(self, *_) -> None:
        self._closing.close()

    def write(self, state: State) -> None:
        """Store the newest state, so that at any moment one of the two states is undamaged."""
        leaves = {f"arr_{i}": leaf for i, leaf in enumerate(jax.tree.leaves(state))}
        content = archive(leaves | {"configuration": np.asarray(self._recipe)})
        atomically(self.path / FRESH, lambda file: file.write(content))
        if self._newest_is_whole:  # else only the state before it is undamaged
            os.replace(self.path / STATE, self.path / PREVIOUS)
        os.replace(self.path / FRESH, self.path / STATE)
        self._newest_is_whole = True
        to_disk(self.path)

    def latest(self, state: State) -> State:
        """The newest undamaged state, or the given one if none was stored.

        Raises ValueError where both stored states are damaged.
        """
        if self._damaged and not self._whole and (self.path / PREVIOUS).exists():
            raise ValueError(f"{'; '.join(self._damaged)}; remove {self.path} and start again")
        for damage in self._damaged:
            log.warning("%s; the tuning goes on from the state before it", damage)
        if not self._whole:
            return state
        name, newest = next(iter(self._whole.items()))
        leaves, structure = jax.tree.flatten(state)
        found = [newest.get(f"arr_{i}") for i in range(len(leaves))]
        if [_kind(leaf) for leaf in found] != [_kind(leaf) for leaf in leaves]:
            said = f"{self.path / name} is not a state of this tuning"
            raise ValueError(f"{said}; remove {self.path} and start again")
        return jax.tree.unflatten(structure, found)

    def _leave_others(self) -> None:
        """Count a state that holds another configuration, such as a borrowed one, as damaged."""
        for name, state in list(self._whole.items()):
            file = self.path / name
            try:
                made = tree_of(str(state.get("configuration")), json.loads, file)
                need_same(file, made, json.loads(self._recipe))
            except ValueError as error:
                self._damaged.append(str(error))
                del self._whole[name]

    def _configuration(self) -> dict[str, Any]:
        """The configuration of the folder; a damaged file is repaired from a state."""
        file, found = self.path / CONFIGURATION, None
        try:
            return as_json(unsealed(read_json(file)))
        except (OSError, Damaged):
            for name, state in list(self._whole.items())[:1]:
                found = tree_of(str(state.get("configuration")), json.loads, self.path / name)
        if not isinstance(found, dict):
            said = f"{self.path} is not a tuning that can be resumed; remove it and start again"
            raise ValueError(said)
        log.warning("%s was missing or damaged, and is written again", file)
        write_json(file, sealed(found))
        return found


def stored_lanes(path: Path) -> int | None:
    """The lanes in the configuration of a folder; None where it has no such undamaged file."""
    try:
        lanes = as_json(unsealed(read_json(path / CONFIGURATION))).get("lanes")
    except (OSError, Damaged, AttributeError):
        return None
    return lanes if type(lanes) is int and lanes >= 1 else None


def _kind(leaf: Any) -> tuple[Any, ...]:
    return np.shape(leaf), np.asarray(leaf).dtype


def _states(path: Path) -> tuple[dict[str, dict[str, Any]], list[str]]:
    """The undamaged states by name, the newest first, and what is wrong with the others."""
    whole: dict[str, dict[str, Any]] = {}
    damaged: list[str] = []
    for name in (STATE, PREVIOUS):
        try:
            whole[name] = read_arrays(path / name)
        except FileNotFoundError:
            continue
        except Damaged as error:
            damaged.append(str(error))
    return whole, damaged
