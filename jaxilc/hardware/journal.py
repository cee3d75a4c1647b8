"""The journal of a campaign: an append-only folder of entries 000000, 000001, ...

Each entry is a manifest (JSON) and arrays (npz). It is written under another name and renamed when
it is on the disk, so that the journal is complete whenever the process is stopped. An undo is also
an entry, which points to an earlier one, so that no measurement is lost. Every file has a checksum,
and the manifest is stored twice, so that damage is found. An entry that cannot be read is left out
by going back to a trial before it.
"""

from __future__ import annotations

import csv
import dataclasses
import datetime
import io
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..learning.known_metrics import GATHERED
from ..pytree.ranges import is_number
from ..storage.files import UNFINISHED, atomically, whole_folder
from ..storage.sealed import Damaged, archive, json_text, read_arrays, read_json, sealed, unsealed

FORMAT, UNCHECKED = 2, 1  # the first format had neither checksums nor a copy of the manifest
MANIFEST, COPY = "manifest.json", "manifest.copy.json"
DAMAGED = "damaged"  # the event of an entry that cannot be read
BACK = "--undo goes back to an earlier trial"
_ENTRY = re.compile(r"^\d{6}$")
METRICS = "figures"  # key of a trial's metrics, as in the first campaigns
_NEEDED = {"trial": int, "recipe": dict, "configuration": dict}
_NEEDED_OF = {
    "start": {},
    "trial": {
        "parent": int,
        "hashes": dict,
        METRICS: dict,
        "findings": list,
        "source": str,
        "learned": bool,
    },
    "undo": {"to": int},
}


@dataclasses.dataclass(frozen=True)
class Journal:
    """The journal in a folder, which need not exist yet.

    A manifest holds `serial`, `time`, `event` (start, trial or undo), `trial` (the last one
    measured), and `parent`, the serial of the preceding entry. The manifest of an undo also holds
    `to`, the serial of the entry to which it goes back. If an entry cannot be read, its event is
    `damaged`, and `wrong` says why.
    """

    path: Path

    @property
    def exists(self) -> bool:
        """Whether the journal has an entry."""
        return self.path.is_dir() and bool(self._entries())

    def create(self) -> None:
        """Make the folder; raises FileExistsError for an existing one that is not empty."""
        if self.path.exists() and (
            not self.path.is_dir() or any(UNFINISHED not in f.name for f in self.path.iterdir())
        ):
            raise FileExistsError(
                f"{self.path} exists already; choose another folder, "
                "or go on with the campaign there"
            )
        self.path.mkdir(parents=True, exist_ok=True)

    def manifests(self) -> list[dict[str, Any]]:
        """The manifests of all entries, in order.

        Raises FileNotFoundError where there are none, and ValueError where none can be read.
        """
        if not self.exists:
            raise FileNotFoundError(f"{self.path} holds no campaign; start one without --measured")
        manifests = [self._manifest(serial) for serial in range(self._next())]
        if all(m["event"] == DAMAGED for m in manifests):
            raise ValueError(
                f"{manifests[0]['wrong']}, nor any other entry; start a campaign in another folder"
            )
        return manifests

    def last_known(self) -> dict[str, Any]:
        """The last manifest that can be read; raises as `manifests` does."""
        return next(m for m in reversed(self.manifests()) if m["event"] != DAMAGED)

    def live(self) -> list[dict[str, Any]]:
        """The manifests of the start and of all trials that were not undone, in order.

        Raises ValueError where one of them is damaged.
        """
        manifests = self.manifests()
        return _led_to(manifests, manifests[-1])

    def behind(self) -> list[dict[str, Any]]:
        """The manifests to which an undo can go back.

        These are the manifests of `live` without the last one. Where one of them is damaged, these
        are all manifests whose entries can be read from the start on.
        """
        manifests = self.manifests()
        try:
            return _led_to(manifests, manifests[-1])[:-1]
        except Damaged:
            return [
                m for m in manifests if m["event"] in ("start", "trial") and _is_whole(manifests, m)
            ]

    def arrays(self, manifest: Mapping[str, Any], name: str) -> dict[str, np.ndarray]:
        """The arrays in a file of an entry; raises ValueError for a damaged file."""
        file = self.path / f"{manifest['serial']:06d}" / name
        try:
            return read_arrays(file, checked=manifest.get("format") != UNCHECKED)
        except (OSError, Damaged) as error:
            raise ValueError(f"{file} cannot be read ({_said(error)}); {BACK}") from None

    def append(self, manifest: Mapping[str, Any], arrays: Mapping[str, Mapping[str, Any]]) -> None:
        """Append an entry.

        arrays: arrays by name, in a dictionary by the name of their file
        Raises ValueError where it cannot be written; the journal is then unchanged.
        """
        serial = self._next()
        common = {
            "format": FORMAT,
            "serial": serial,
            "time": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        }
        try:
            with whole_folder(
                self.path / f"{serial:06d}"
            ) as unfinished:  # fails if another process has made this entry
                for name, values in arrays.items():
                    (unfinished / name).write_bytes(archive(values))
                for name in (MANIFEST, COPY):
                    (unfinished / name).write_text(
                        json_text(sealed(common | dict(manifest))), encoding="utf-8"
                    )
        except OSError as error:
            raise ValueError(
                f"{self.path}: entry {serial} could not be written ({error.strerror}); "
                "the campaign is as it was"
            ) from None

    def log(self) -> list[dict[str, Any]]:
        """A row for every entry in order: event, trial, metrics, warnings.

        `live` says whether the entry still counts, or was undone.
        """
        manifests = self.manifests()
        live = (
            {m["serial"] for m in _led_to(manifests, manifests[-1])}
            if _is_whole(manifests, manifests[-1])
            else set()
        )
        rows = []
        for m in manifests:
            metrics, findings = (
                m.get(name, {}) if m["event"] == "trial" else {} for name in (METRICS, "findings")
            )
            row = {
                name: m.get(name, "")
                for name in ("serial", "time", "event", "trial", "learned", "source")
            }
            row |= {"live": m["serial"] in live, "rms_error": metrics.get("error", "")}
            for name, _ in GATHERED:
                row |= {f"{name}_{i}": value for i, value in enumerate(metrics.get(name, ()))}
            warnings = [text for kind, text in findings if kind == "warning"]
            warnings += [m["wrong"]] if "wrong" in m else []
            rows.append(row | {"warnings": "; ".join(warnings)})
        return rows

    def _entries(self) -> list[Path]:
        return sorted(f for f in self.path.iterdir() if _ENTRY.match(f.name))

    def _next(self) -> int:
        """The serial of the next entry."""
        entries = self._entries()
        return int(entries[-1].name) + 1 if entries else 0

    def _manifest(self, serial: int) -> dict[str, Any]:
        entry, wrong = self.path / f"{serial:06d}", []
        for name in (MANIFEST, COPY):
            try:
                return _checked(read_json(entry / name), serial)
            except (OSError, Damaged) as error:
                wrong.append(f"{entry / name} cannot be read ({_said(error)})")
        return {"serial": serial, "event": DAMAGED, "trial": 0, "wrong": wrong[0]}


def _checked(content: Any, serial: int) -> dict[str, Any]:
    """The manifest of an entry; raises Damaged naming what is wrong with it."""
    unchecked = isinstance(content, dict) and content.get("format") == UNCHECKED
    manifest = content if unchecked else unsealed(content)
    if (manifest.get("format"), manifest.get("serial")) not in (
        (FORMAT, serial),
        (UNCHECKED, serial),
    ):
        found = f"entry {manifest.get('serial')} of format {manifest.get('format')}"
        raise Damaged(f"it is {found}; needed are {serial} and {FORMAT}")
    kinds = _NEEDED_OF.get(str(manifest.get("event")))
    if kinds is None:
        raise Damaged(f"its event {manifest.get('event')!r} is none of {', '.join(_NEEDED_OF)}")
    for name, kind in {**_NEEDED, **kinds}.items():
        if not isinstance(manifest.get(name), kind):
            raise Damaged(f"its {name!r} is missing, or not of the kind {kind.__name__}")
    if METRICS in kinds and not isinstance(manifest[METRICS].get("error"), float):
        raise Damaged(f"its {METRICS!r} hold no error")
    if METRICS in kinds and not all(
        _are_numbers(manifest[METRICS].get(name, [])) for name, _ in GATHERED
    ):
        raise Damaged(f"its {METRICS!r} are not numbers of each channel")
    if "findings" in kinds and not all(map(_is_finding, manifest["findings"])):
        raise Damaged("its 'findings' are not pairs of a kind and a text")
    for name in ("parent", "to"):
        if name in kinds and not 0 <= manifest[name] < serial:
            raise Damaged(f"its {name!r} is {manifest[name]}; allowed are entries before it")
    return manifest


def _are_numbers(value: Any) -> bool:
    return isinstance(value, list) and all(map(is_number, value))


def _is_finding(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(isinstance(x, str) for x in value)


def _led_to(manifests: Sequence[dict[str, Any]], last: dict[str, Any]) -> list[dict[str, Any]]:
    """The manifests from the start to the entry `last`; raises Damaged where one is damaged."""
    chain = [manifests[last["to"]] if last["event"] == "undo" else last]
    while chain[0]["event"] == "trial":
        chain.insert(0, manifests[chain[0]["parent"]])
    if chain[0]["serial"] != 0:  # entry 0 is always the start
        wrong = chain[0].get("wrong", f"entry {chain[0]['serial']} is no trial to go on from")
        raise Damaged(f"{wrong}; {BACK}")
    return chain


def _is_whole(manifests: Sequence[dict[str, Any]], last: dict[str, Any]) -> bool:
    try:
        return bool(_led_to(manifests, last))
    except Damaged:
        return False


def _said(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error)


def write_log(path: str | Path, rows: Sequence[dict[str, Any]]) -> Path:
    """Write the rows of `Journal.log` with a column for each name; missing values are empty."""
    text = io.StringIO()
    names = list(dict.fromkeys(name for row in rows for name in row))
    writer = csv.DictWriter(text, names, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    atomically(path, lambda file: file.write(text.getvalue().encode()))
    return Path(path)


def units(journal: Journal) -> tuple[str, str]:
    """The units of the output and of the input; empty texts where the campaign has none."""
    task = journal.last_known()["configuration"].get("task")
    task = task if isinstance(task, dict) else {}
    return str(task.get("unit", "")), str(task.get("input_unit", ""))
