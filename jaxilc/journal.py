"""The journal of a campaign: a folder of entries 000000, 000001, ..., each a manifest (JSON) and arrays (npz), only ever appended to.

An entry is written under another name and renamed when it is on the disk: killed at any moment, the journal is whole. To undo is an
entry too, which points back, so nothing that was measured is lost.
"""

from __future__ import annotations

import dataclasses
import datetime
import json
import os
import re
import shutil
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

FORMAT = 1
MANIFEST = "manifest.json"
UNFINISHED = ".unfinished"
_ENTRY = re.compile(r"^\d{6}$")


@dataclasses.dataclass(frozen=True)
class Journal:
    """The entries in a folder, which need not exist yet.

    A manifest holds `serial`, `time`, `event` (start, trial or undo), `trial` (the last one measured), and `parent`, the serial of the
    entry it follows on; that of an undo holds `to`, the serial it goes back to.
    """

    path: Path

    @property
    def exists(self) -> bool:
        """Whether there is an entry."""
        return self.path.is_dir() and bool(self._entries())

    def create(self) -> None:
        """Make the folder. Raises FileExistsError if there is one with something in it."""
        if self.path.exists() and (not self.path.is_dir() or any(not f.name.startswith(UNFINISHED) for f in self.path.iterdir())):
            raise FileExistsError(f"{self.path} exists already; choose another folder, or go on with the campaign there")
        self.path.mkdir(parents=True, exist_ok=True)

    def manifests(self) -> list[dict[str, Any]]:
        """Of all entries, in order. Raises FileNotFoundError where there are none, ValueError where one is damaged or missing."""
        if not self.exists:
            raise FileNotFoundError(f"{self.path} holds no campaign; start one without --measured")
        manifests = []
        for entry in self._entries():
            try:
                manifest = json.loads((entry / MANIFEST).read_text(encoding="utf-8"))
            except (OSError, ValueError) as error:
                raise ValueError(f"{entry / MANIFEST} cannot be read ({error})") from None
            if (manifest["format"], manifest["serial"]) != (FORMAT, len(manifests)):
                raise ValueError(
                    f"{entry} is entry {manifest['serial']} of format {manifest['format']}; needed are {len(manifests)} and {FORMAT}"
                )
            manifests.append(manifest)
        return manifests

    def live(self) -> list[dict[str, Any]]:
        """The manifests that led to where the campaign stands, from the start on, without what was undone."""
        manifests = self.manifests()
        last = manifests[-1]
        chain = [manifests[last["to"]] if last["event"] == "undo" else last]
        while chain[0]["parent"] is not None:
            chain.insert(0, manifests[chain[0]["parent"]])
        return chain

    def arrays(self, manifest: Mapping[str, Any], name: str) -> dict[str, np.ndarray]:
        """What an entry's file holds. Raises ValueError for one that is damaged."""
        file = self.path / f"{manifest['serial']:06d}" / name
        try:
            with open(file, "rb") as stored, np.load(stored, allow_pickle=False) as arrays:
                return dict(arrays)
        except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
            raise ValueError(f"{file} cannot be read ({error}); --undo goes back to an earlier trial") from None

    def append(self, manifest: Mapping[str, Any], arrays: Mapping[str, Mapping[str, Any]]) -> None:
        """One more entry. arrays: of each file. Raises ValueError where it cannot be written; the journal then is as it was."""
        serial = len(self._entries())
        common = {"format": FORMAT, "serial": serial, "time": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")}
        unfinished = self.path / f"{UNFINISHED}-{os.getpid()}-{serial}"
        try:
            shutil.rmtree(unfinished, ignore_errors=True)
            unfinished.mkdir()
            for name, values in arrays.items():
                with open(unfinished / name, "wb") as file:
                    kept: dict[str, Any] = {key: np.asarray(value) for key, value in values.items()}
                    np.savez(file, **kept)
                    _to_disk(file)
            with open(unfinished / MANIFEST, "w", encoding="utf-8") as file:
                file.write(json.dumps(common | dict(manifest), indent=1) + "\n")
                _to_disk(file)
            os.rename(unfinished, self.path / f"{serial:06d}")  # fails where another process was quicker
        except OSError as error:
            raise ValueError(f"{self.path}: entry {serial} could not be written ({error.strerror}); the campaign is as it was") from None
        finally:
            shutil.rmtree(unfinished, ignore_errors=True)
        if hasattr(os, "O_DIRECTORY"):  # the renaming itself, on the disk
            folder = os.open(self.path, os.O_DIRECTORY)
            os.fsync(folder)
            os.close(folder)

    def log(self) -> list[dict[str, Any]]:
        """A row for every entry, in order: what happened, the trial, its figures, and whether it still counts (`live`)."""
        live = {m["serial"] for m in self.live()}
        rows = []
        for m in self.manifests():
            figures = m.get("figures", {})
            row = {name: m.get(name, "") for name in ("serial", "time", "event", "trial", "learned", "source")}
            row |= {"live": m["serial"] in live, "rms_error": figures.get("error", "")}
            for name in ("rms", "max_error", "settled_error", "effort"):
                row |= {f"{name}_{i}": value for i, value in enumerate(figures.get(name, ()))}
            rows.append(row | {"warnings": "; ".join(text for kind, text in m.get("findings", ()) if kind == "warning")})
        return rows

    def _entries(self) -> list[Path]:
        return sorted(f for f in self.path.iterdir() if _ENTRY.match(f.name))


def _to_disk(file) -> None:
    file.flush()
    os.fsync(file.fileno())
