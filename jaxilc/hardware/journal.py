"""The journal of a campaign: an append-only folder of entries 000000, 000001, ...

Each entry is a manifest (JSON) and arrays (npz). It is written under another name and renamed when
it is on the disk, so that the journal is complete whenever the process is stopped. An undo is also
an entry, which points to an earlier one, so that no measurement is lost. Every file has a checksum,
and the manifest is stored twice, so that damage is found. An entry that cannot be read is left out
by going back to a trial before it.

What is whole may still be in a wrong place. A manifest holds the checksums of the files of its
entry and of the manifest before, and a head holds those of all manifests. So a file or an entry
that was exchanged, borrowed from another campaign or removed is found, as a damaged one is.
"""

from __future__ import annotations

import contextlib
import csv
import dataclasses
import datetime
import functools
import io
import re
import secrets
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np

from ..learning.known_metrics import GATHERED
from ..pytree.aliases import Leaf, Value
from ..pytree.ranges import is_number
from ..storage.files import is_temporary, whole_folder, write_file
from ..storage.sealed import (
    Damaged,
    archive,
    as_json,
    checksum,
    json_content,
    json_of,
    json_text,
    read_arrays,
    read_json,
    seal_of,
    sealed,
    unsealed,
    write_json,
)

# The first format had neither checksums nor a copy of the manifest, the second does not say which
# files belong to an entry.
FORMAT, UNBOUND, UNCHECKED = 3, 2, 1
MANIFEST, COPY, HEAD = "manifest.json", "manifest.copy.json", "head.json"
OTHER = "it is whole, but not the entry that was written here"
DAMAGED = "damaged"  # the event of an entry that cannot be read
BACK = "--undo goes back to an earlier trial"
MISSING = 1000  # entries, from which on the last folder is none
_ENTRY = re.compile(r"^\d{6}$")
MOST = 10**6  # entries that a head may name
ENDED = "the trial ended"  # so begins the note on a trial that ended early
METRICS = "figures"  # key of a trial's metrics, as in the first campaigns
Manifest: TypeAlias = dict[str, Value]  # of an entry, as JSON
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
            not self.path.is_dir() or not all(map(is_temporary, self.path.iterdir()))
        ):
            raise FileExistsError(
                f"{self.path} exists already; choose another folder, "
                "or go on with the campaign there"
            )
        self.path.mkdir(parents=True, exist_ok=True)

    def manifests(self) -> list[Manifest]:
        """The manifests of all entries, in order.

        Raises FileNotFoundError where there are none, and ValueError where none can be read.
        """
        if not self.exists:
            raise FileNotFoundError(
                f"{self.path} holds no campaign; `jaxilc next` without --measured starts one"
            )
        manifests, _ = self._read()
        if all(m["event"] == DAMAGED for m in manifests):
            raise ValueError(
                f"{manifests[0]['wrong']}, nor any other entry; start a campaign in another folder"
            )
        return manifests

    def last_known(self) -> Manifest:
        """The last manifest that can be read; raises as `manifests` does."""
        return next(m for m in reversed(self.manifests()) if m["event"] != DAMAGED)

    def live(self) -> list[Manifest]:
        """The manifests of the start and of all trials that were not undone, in order.

        Raises ValueError where one of them is damaged.
        """
        manifests, (_, head) = self.manifests(), self._read()
        unnamed = sum(m.get("format") == FORMAT for m in manifests[len(head) :])
        if unnamed > bool(head or len(manifests) == 1):  # one, if its writing was stopped
            raise Damaged(
                f"{self.path / HEAD} is missing, damaged or another campaign's: {unnamed} entries "
                f"are not named there, so the last ones may be missing; {BACK}"
            )
        return _led_to(manifests, manifests[-1])

    @property
    def bound(self) -> bool:
        """Whether a head says which entries belong here; campaigns of before have none."""
        return (self.path / HEAD).exists()

    def bind(self) -> None:
        """Write the head that names all entries that are there."""
        self._write_head(*self._read())

    def behind(self) -> list[Manifest]:
        """The manifests to which an undo can go back.

        These are the manifests of `live` without the last one. Where `live` raises, these are all
        manifests of what was live whose entries can be read from the start on; `wrong` says of one
        that it may have been undone.
        """
        try:
            return self.live()[:-1]
        except Damaged:
            manifests = self.manifests()
            return [m for m in _branch(manifests) if _is_whole(manifests, m)]

    def arrays(self, manifest: Manifest, name: str) -> dict[str, np.ndarray]:
        """The arrays in a file of an entry; raises ValueError for a damaged file."""
        file = self.path / f"{manifest['serial']:06d}" / name
        try:
            checked, known = manifest.get("format") != UNCHECKED, manifest.get("files", {})
            if manifest.get("format") == FORMAT and name not in known:
                raise Damaged(f"{file} is no file of this entry")
            return read_arrays(file, checked=checked, sha256=known.get(name))
        except (OSError, Damaged) as error:
            raise ValueError(f"{file} cannot be read ({_said(error)}); {BACK}") from None

    def append(self, manifest: Manifest, arrays: Mapping[str, Mapping[str, Leaf]]) -> None:
        """Append an entry.

        arrays: arrays by name, in a dictionary by the name of their file
        Raises ValueError where it cannot be written; the journal is then unchanged.
        """
        serial = self._next()
        before, head = self._read() if serial else ([], [])
        files = {name: archive(values) for name, values in arrays.items()}
        whole = dict(manifest) | {
            "format": FORMAT,
            "serial": serial,
            "time": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
            "files": {name: checksum(content) for name, content in files.items()},
            "previous": _seal(before[-1]) if before else secrets.token_hex(32),
        }
        try:
            if len(head) < len(before):
                self._write_head(before, head)  # at most one entry is not named there
            # fails if another process has made this entry
            with whole_folder(self.path / f"{serial:06d}") as unfinished:
                for name, content in files.items():
                    (unfinished / name).write_bytes(content)
                for name in (MANIFEST, COPY):
                    (unfinished / name).write_text(json_text(sealed(whole)), encoding="utf-8")
        except OSError as error:
            made = isinstance(error, FileExistsError)
            why = "another process has made it meanwhile" if made else error.strerror
            raise ValueError(
                f"{self.path}: entry {serial} could not be written ({why}); "
                "the campaign is as it was"
            ) from None
        with contextlib.suppress(OSError):  # the entry is there, and names the one before it
            self._write_head([*before, as_json(whole)], head)

    def log(self) -> list[Manifest]:
        """A row for every entry in order: event, trial, metrics, warnings.

        `live` says whether the entry still counts, or was undone.
        """
        manifests = self.manifests()
        led = _led_to(manifests, manifests[-1]) if _is_whole(manifests, manifests[-1]) else []
        live = {m["serial"] for m in led}
        rows = []
        for m in manifests:
            metrics, findings = (
                m.get(name, {}) if m["event"] == "trial" else {} for name in (METRICS, "findings")
            )
            shown = ("serial", "time", "event", "trial", "learned", "source")
            row = {name: m.get(name, "") for name in shown}
            row |= {"live": m["serial"] in live, "rms_error": metrics.get("error", "")}
            for name, _ in GATHERED:
                row |= {f"{name}_{i}": value for i, value in enumerate(metrics.get(name, ()))}
            warnings = [text for kind, text in findings if kind == "warning"]
            warnings += [m["wrong"]] if "wrong" in m else []
            rows.append(row | {"warnings": "; ".join(warnings)})
        return rows

    def _read(self) -> tuple[list[Manifest], list[str]]:
        """The manifests of all entries, and the head; an empty one if it is another campaign's."""
        for head in (self._head(), []):
            found = [self._manifest(serial, head) for serial in range(self._next())]
            if not head or any(seal for _, seal in found[: len(head)]):
                break
        manifests, seals = [dict(m) for m, _ in found], [seal for _, seal in found]
        for serial in range(max(1, len(head)), len(manifests)):
            allowed = (None, "", seals[serial - 1])
            if seals[serial - 1] and manifests[serial].get("previous") not in allowed:
                for k in range(serial - (serial > len(head)), serial + 1):  # either may be another
                    file = self.path / f"{k:06d}" / MANIFEST
                    wrong = f"{file} cannot be read ({OTHER})"
                    manifests[k] |= {"event": DAMAGED, "wrong": wrong, "trial": 0}
        return manifests, head

    def _entries(self) -> list[Path]:
        return sorted(f for f in self.path.iterdir() if _ENTRY.match(f.name))

    def _next(self) -> int:
        """The serial of the next entry.

        Raises ValueError for a folder that is named like an entry, but far behind all others.
        """
        entries, head = self._entries(), len(self._head())
        following = int(entries[-1].name) + 1 if entries else 0
        if following - max(len(entries), head) > MISSING:
            raise Damaged(
                f"{entries[-1]} is no entry of this campaign, which has {len(entries) - 1} others; "
                "move it elsewhere"
            )
        return max(following, head)

    def _head(self) -> list[str]:
        """The checksums of the manifests by serial; none where there is no head, or a damaged one.

        An entry that could not be read when the head was written has an empty text.
        """
        try:
            found = unsealed(read_json(self.path / HEAD)).get("entries")
        except (OSError, Damaged):
            return []
        known = isinstance(found, list) and all(isinstance(one, str) for one in found)
        return found if known and len(found) < MOST else []

    def _write_head(self, manifests: Sequence[Manifest], known: Sequence[str]) -> None:
        entries = [*known, *map(_seal, manifests[len(known) :])]
        write_json(self.path / HEAD, sealed({"entries": entries}))

    def _manifest(self, serial: int, head: Sequence[str]) -> tuple[Manifest, str]:
        """The manifest of an entry, and its checksum: an empty text where it cannot be read."""
        entry, wrong = self.path / f"{serial:06d}", []
        for name in (MANIFEST, COPY):
            try:
                manifest, seal = _read_once(entry / name, json_content(entry / name), serial)
                if serial < len(head) and seal != head[serial]:
                    raise Damaged(OTHER)
                return manifest, seal
            except (OSError, Damaged) as error:
                wrong.append(f"{entry / name} cannot be read ({_said(error)})")
        return {"serial": serial, "event": DAMAGED, "trial": 0, "wrong": wrong[0]}, ""


@functools.lru_cache(maxsize=2**15)  # a command reads every manifest some thirty times
def _read_once(file: Path, text: str, serial: int) -> tuple[Manifest, str]:
    """The manifest in the text of a file, and its checksum; raises as `_checked`."""
    manifest = _checked(json_of(file, text), serial)
    return manifest, seal_of(manifest)


def _checked(content: Value, serial: int) -> Manifest:
    """The manifest of an entry; raises Damaged naming what is wrong with it."""
    unchecked = isinstance(content, dict) and content.get("format") == UNCHECKED
    manifest = content if unchecked else unsealed(content)
    known = manifest.get("format") in (FORMAT, UNBOUND, UNCHECKED)
    if not known or manifest.get("serial") != serial:
        found = f"entry {manifest.get('serial')} of format {manifest.get('format')}"
        raise Damaged(f"it is {found}; needed are {serial} and {FORMAT}")
    kinds = _NEEDED_OF.get(str(manifest.get("event")))
    if kinds is None:
        raise Damaged(f"its event {manifest.get('event')!r} is none of {', '.join(_NEEDED_OF)}")
    binding = {"files": dict, "previous": str} if manifest["format"] == FORMAT else {}
    for name, kind in {**_NEEDED, **kinds, **binding}.items():
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


def _seal(manifest: Manifest) -> str:
    """The checksum of a manifest; an empty text for one that cannot be read."""
    return "" if manifest["event"] == DAMAGED else seal_of(manifest)


def _are_numbers(value: object) -> bool:
    return isinstance(value, list) and all(map(is_number, value))


def _is_finding(value: object) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(isinstance(x, str) for x in value)


def _led_to(manifests: Sequence[Manifest], last: Manifest) -> list[Manifest]:
    """The manifests from the start to the entry `last`; raises Damaged where one is damaged."""
    chain = [manifests[last["to"]] if last["event"] == "undo" else last]
    while chain[-1]["event"] == "trial":
        chain.append(manifests[chain[-1]["parent"]])
    first = chain[-1]
    if first["serial"] != 0:  # entry 0 is always the start
        wrong = first.get("wrong", f"entry {first['serial']} is no trial to go on from")
        raise Damaged(f"{wrong}; {BACK}")
    return chain[::-1]


def _branch(manifests: Sequence[Manifest]) -> list[Manifest]:
    """The entries that led to the last one, those that cannot be read left out, in order.

    A trial is stored after the last one that was live then, and so is an undo. So what was live
    before an entry that cannot be read is what the entry before it led to, unless it is an undo
    itself; it is none where an entry that can be read names it as the one before.
    """
    serial, found, doubt, named = len(manifests) - 1, list[Manifest](), "", False
    while serial >= 0:
        now = manifests[serial]
        if now["event"] == DAMAGED and not (named or doubt):
            doubt = f"entry {serial} cannot be read, and may be an undo of"
        if now["event"] in ("start", "trial"):
            of = f"trial {now['trial']}, {now.get('source')} of {now.get('time')}"
            found.insert(0, now | ({"wrong": f"{doubt} {of}"} if doubt and now["trial"] else {}))
        named = now["event"] != DAMAGED
        before = {"start": -1, "trial": now.get("parent", -1), "undo": now.get("to", -1)}
        serial = before.get(now["event"], serial - 1)
    return found


def is_part(manifest: Manifest) -> bool:
    """Whether a trial ended early, so that its error is that of a part."""
    return any(text.startswith(ENDED) for _, text in manifest.get("findings", ()))


def whole_trials(live: Sequence[Manifest]) -> list[Manifest]:
    """The manifests of the trials that did not end early; the first of `live` is the start."""
    return [m for m in live[1:] if not is_part(m)]


def _is_whole(manifests: Sequence[Manifest], last: Manifest) -> bool:
    try:
        return bool(_led_to(manifests, last))
    except Damaged:
        return False


def _said(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error)


def write_log(path: str | Path, rows: Sequence[Manifest]) -> Path:
    """Write the rows of `Journal.log` with a column for each name; missing values are empty."""
    text = io.StringIO()
    names = list(dict.fromkeys(name for row in rows for name in row))
    writer = csv.DictWriter(text, names, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_file(path, text.getvalue())
    return Path(path)


def units(journal: Journal) -> tuple[str, str]:
    """The units of the output and of the input; empty texts where the campaign has none."""
    task = journal.last_known()["configuration"].get("task")
    task = task if isinstance(task, dict) else {}
    return str(task.get("unit", "")), str(task.get("input_unit", ""))
